"""Negatives, views from outside a map: other places, mirrored views, water, blank views."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray

from orthonav.core.flight import open_flight
from orthonav.core.flight.folder import read_image

Grey = NDArray[np.uint8]
SHARES = {
    "other places": 0.4,
    "mirrored": 0.3,
    "forest": 0.1,
    "water": 0.1,
    "noise": 0.06,
    "blank": 0.04,
}
WATER_WINDOW_PX, WATER_SHARE = (48, 64), 0.98
FOREST_WINDOW_PX = (360, 480)
FOREST_SHARE = 0.03
"""Share of all windows of a map that is taken as forest: dark, green, rough, and even."""


@dataclass(frozen=True)
class Sources:
    """Real imagery for negatives. `water` needs near infrared as its fourth band."""

    other_places: Sequence[Path]
    mirrored_flights: Sequence[Path]
    water: Path
    forest: Path


def negatives(
    sources: Sources, count: int, size: tuple[int, int], seed: int
) -> Iterator[tuple[str, Grey]]:
    """About `count` pictures of `size` (height, width) in the proportions of `SHARES`."""
    rng = np.random.default_rng([seed, 5])
    makers: dict[str, Callable[[], Grey]] = {
        "other places": _OtherPlaces(sources.other_places, rng).cut,
        "mirrored": _Mirrored(sources.mirrored_flights, rng).picture,
        "forest": _Windows(rng, *_forest(sources.forest)).cut,
        "water": _Windows(rng, *_water(sources.water)).cut,
        "noise": lambda: _noise(rng, size),
        "blank": lambda: _blank(rng, size),
    }
    for kind, share in SHARES.items():
        for _ in range(max(1, round(share * count))):
            picture = makers[kind]()
            if picture.shape != size:
                made = cv2.resize(picture, size[::-1], interpolation=cv2.INTER_CUBIC)
                picture = np.asarray(made, np.uint8)
            yield kind, picture


class _OtherPlaces:
    """Windows of orthophotos of other places, half to all of their size, as if at that height."""

    def __init__(self, paths: Sequence[Path], rng: np.random.Generator) -> None:
        self._pictures = [_rgb(path).mean(axis=0).astype(np.uint8) for path in paths]
        self._rng = rng

    def cut(self) -> Grey:
        """One window, four by three, turned by a multiple of a right angle."""
        picture = self._pictures[int(self._rng.integers(len(self._pictures)))]
        turned = np.rot90(picture, int(self._rng.integers(4)))
        rows, cols = turned.shape
        height = int(min(rows, cols * 0.75) * self._rng.uniform(0.5, 1.0))
        width = height * 4 // 3
        row, col = self._rng.integers(rows - height + 1), self._rng.integers(cols - width + 1)
        return np.ascontiguousarray(turned[row : row + height, col : col + width])


class _Mirrored:
    """Views of flights over the map's own ground, mirrored: one after the other."""

    def __init__(self, flights: Sequence[Path], rng: np.random.Generator) -> None:
        paths = [view.path for flight in flights for view in open_flight(flight).views]
        self._paths = [paths[i] for i in rng.permutation(len(paths))]
        self._next = 0

    def picture(self) -> Grey:
        """The next view, left and right exchanged."""
        path = self._paths[self._next % len(self._paths)]
        self._next += 1
        return np.ascontiguousarray(read_image(path)[:, ::-1])


class _Windows:
    """Windows of one picture that are known to show one kind of ground."""

    def __init__(
        self,
        rng: np.random.Generator,
        picture: Grey,
        corners: NDArray[np.intp],
        size: Sequence[int],
    ) -> None:
        self._rng, self._picture = rng, picture
        self._corners, self._size = corners, size

    def cut(self) -> Grey:
        """One of the windows, mirrored or not."""
        row, col = self._corners[int(self._rng.integers(len(self._corners)))]
        made = self._picture[row : row + self._size[0], col : col + self._size[1]]
        return np.ascontiguousarray(made[:, :: 1 if self._rng.random() < 0.5 else -1])


def _rgb(path: Path) -> NDArray[np.float32]:
    """The first three bands (3, H, W)."""
    with rasterio.open(path) as source:
        return np.asarray(source.read([1, 2, 3]), np.float32)


def _water(path: Path) -> tuple[Grey, NDArray[np.intp], Sequence[int]]:
    """Windows that are water: dark in near infrared."""
    with rasterio.open(path) as source:
        bands = source.read().astype(np.float32)
    grey = bands[:3].mean(axis=0).astype(np.uint8)
    wet = ((bands[3] < bands[1]) & (bands[:3].sum(axis=0) > 0)).astype(np.float32)
    return grey, _corners(wet, WATER_WINDOW_PX, WATER_SHARE), WATER_WINDOW_PX


def _forest(path: Path) -> tuple[Grey, NDArray[np.intp], Sequence[int]]:
    """Windows that are most likely forest: dark and green, rough close by, even from far."""
    red, green, blue = _rgb(path)
    grey = (red + green + blue) / 3
    broad = cv2.GaussianBlur(grey, (0, 0), 24)
    rough = cv2.GaussianBlur(np.abs(grey - cv2.GaussianBlur(grey, (0, 0), 6)), (0, 0), 24)
    uneven = np.abs(broad - cv2.GaussianBlur(grey, (0, 0), 96))
    worth = rough + (green - red) - 0.2 * broad - uneven
    mean = _means(worth, FOREST_WINDOW_PX)
    rows, cols = np.nonzero(mean >= np.quantile(mean, 1 - FOREST_SHARE))
    return grey.astype(np.uint8), np.stack([rows, cols], axis=1), FOREST_WINDOW_PX


def _corners(inside: NDArray[np.float32], size: tuple[int, int], share: float) -> NDArray[np.intp]:
    mean = _means(inside, size)
    rows, cols = np.nonzero(mean >= min(share, float(mean.max())))
    return np.stack([rows, cols], axis=1)


def _means(values: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float64]:
    """Mean of the window of `size` that begins at each pixel."""
    total = cv2.integral(values, sdepth=cv2.CV_64F)
    height, width = size
    sums = total[height:, width:] - total[:-height, width:]
    sums = sums - total[height:, :-width] + total[:-height, :-width]
    return np.asarray(sums / (height * width), np.float64)


def _noise(rng: np.random.Generator, size: tuple[int, int]) -> Grey:
    """Noise of a few scales at once, from pixels to a quarter of the picture."""
    total = np.zeros(size, np.float32)
    for cells in rng.choice([4, 16, 64, 256, 960], size=int(rng.integers(1, 4)), replace=False):
        small = rng.standard_normal((int(cells), int(cells) * 4 // 3)).astype(np.float32)
        total += cv2.resize(small, size[::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(128 + 40 * total / total.std(), 0, 255), np.uint8)


def _blank(rng: np.random.Generator, size: tuple[int, int]) -> Grey:
    """One grey level, fading to the edges or not, with the noise of a sensor."""
    rows, cols = np.indices(size, dtype=np.float32)
    away = ((rows / size[0] - 0.5) ** 2 + (cols / size[1] - 0.5) ** 2) * rng.uniform(0, 60)
    level = rng.uniform(20, 235) - away + rng.normal(0, rng.uniform(0, 4), size)
    return np.asarray(np.clip(level, 0, 255), np.uint8)
