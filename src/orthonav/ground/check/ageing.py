"""Persistence: how well the structure of the ground is expected to correlate with another year.

Long lines with contrast last (roads, hedges, field borders); fine texture without direction does
not (crops, tree crowns). The regression was trained on generated landscapes of several seeds, dates
and resolutions (`python -m experiments.persistence`), never on real imagery.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import combinations_with_replacement
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.template import FINE, channels_of

Array = NDArray[np.float32]
PATCH_PX = 24
"""Side of the window over which persistence is averaged, in pixels of its level."""
MARGIN_PX = 40
"""How far a grey level influences the features, about: patch, window and blur."""


@dataclass(frozen=True, eq=False)
class PersistenceModel:
    """Ridge regression on all products of two of F standardized features; `weights` (T,)."""

    mean: NDArray[np.float64]
    spread: NDArray[np.float64]
    weights: NDArray[np.float64]

    def __call__(self, features: Array) -> Array:
        """Expected correlation of gradients (..) with those of another year, 0.005 to 0.95: the
        range of the training data."""
        predicted = terms((features - self.mean) / self.spread) @ self.weights
        return np.asarray(np.clip(predicted, 0.005, 0.95), dtype=np.float32)

    def to_plain(self) -> dict[str, Any]:
        return {name: [float(f"{x:.6g}") for x in value] for name, value in vars(self).items()}


@cache
def default_model() -> PersistenceModel:
    path = resources.files(__package__).joinpath("persistence.json")
    model = json.loads(path.read_text(encoding="utf-8"))["model"]
    return PersistenceModel(**{name: np.array(each, np.float64) for name, each in model.items()})


def reported_persistence(
    grey: NDArray[np.uint8], gsd_m: float, first: int = 0
) -> list[NDArray[np.float32]]:
    """Persistence maps (H, W) of a picture at its own resolution, half of it, and a quarter.

    Coarser detail lasts alike.

    Resolutions finer than that of level `first` repeat its values.
    """
    model, picture = default_model(), grey
    found: list[NDArray[np.float32]] = []
    for level in range(3):
        if level >= first:
            coarse = model(features(picture, gsd_m * 2**level, max(8 >> level, 1)))
            full = cv2.resize(coarse, grey.shape[::-1], interpolation=cv2.INTER_LINEAR)
            found.append(np.asarray(full, np.float32))
        half = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        picture = np.asarray(half, np.uint8)
        if min(picture.shape) < 2 * MARGIN_PX and found:
            break
    return [found[0]] * first + found


def terms(scaled: NDArray[Any]) -> NDArray[Any]:
    """1, features (.., F) and all products of two of them."""
    count = scaled.shape[-1]
    pairs = combinations_with_replacement(range(count), 2)
    products = [scaled[..., i] * scaled[..., j] for i, j in pairs]
    ones = np.ones(scaled.shape[:-1], scaled.dtype)
    return np.stack([ones, *(scaled[..., i] for i in range(count)), *products], axis=-1)


def features(grey: NDArray[np.uint8], gsd_m: float, every_px: int) -> Array:
    """Features (h, w, F) of grey (H, W) every `every_px` pixels, starting at half of that.

    Each is a mean over `PATCH_PX`: coherence of gradients, their energy, fine and medium detail,
    registration evidence; the last is the resolution `gsd_m` (metres per pixel), as a logarithm.
    """
    picture = grey.astype(np.float32)
    found = []
    for blur, side_px in ((1.0, 11), (1.0, 21), (2.0, 29)):
        agreement, energy = _structure(picture, blur, side_px)
        found += [_mean(agreement), np.log(_mean(energy) + np.float32(1e-2))]
    broad, broader = (cv2.blur(picture, (side, side)) for side in (7, 29))
    found += [
        np.log(_mean(np.abs(a - b)) + np.float32(0.1))
        for a, b in ((picture, broad), (broad, broader))
    ]
    strength = channels_of(grey, np.ones(grey.shape, np.bool_), FINE)
    found.append(_mean(strength[..., 0] ** 2 + strength[..., 1] ** 2))
    half = every_px // 2
    thin = [each[half::every_px, half::every_px] for each in found]
    resolution = np.full_like(thin[0], np.log2(gsd_m))
    return np.stack([*thin, resolution], axis=-1)


def _structure(picture: Array, blur: float, side_px: int) -> tuple[Array, Array]:
    """Coherence (0..1) and energy (H, W) of the structure tensor in windows of `side_px`; `blur`:
    standard deviation before the gradient, pixels."""
    smooth = cv2.GaussianBlur(picture, (0, 0), blur)
    east, south = (cv2.Sobel(smooth, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))

    def around(values: Any) -> Array:
        return np.asarray(cv2.blur(values, (side_px, side_px)), np.float32)

    xx, yy, xy = around(east * east), around(south * south), around(east * south)
    energy = xx + yy
    difference = np.sqrt((xx - yy) ** 2 + 4 * xy**2)
    return np.asarray(difference / (energy + np.float32(1e-3))), energy


def _mean(values: Any) -> Array:
    return np.asarray(cv2.blur(values, (PATCH_PX, PATCH_PX)), dtype=np.float32)


BANDS = ((3, 9, 0), (7, 13, 0), (15, 19, 1), (55, 33, 2))
"""Of each band of detail: side of the box filter below it (as wide as Gaussians of 1, 2, 4 and 16
pixels), window in which its strength is measured, and the level of persistence that applies."""
FIELD, VIEW = 0.2, 0.08
"""Standard deviations of the logarithm of persistence from field to field and view to view.

Chosen on generated landscapes (seeds 11 to 13, views 100, 160 and 240 pixels across). Predictions
are 0.06 below what is measured there; a shift of all logarithms by 0.1 halves that and makes
predictions of real imagery too high.
"""


def another_year(
    rng: np.random.Generator,
    grey: NDArray[np.uint8],
    donor: NDArray[np.uint8],
    persistence: Sequence[Array],
) -> NDArray[np.uint8]:
    """`grey` (S, S) with simulated ageing; `donor` (S, S) is mirrored ground of another place.

    `persistence` holds the expected correlation of gradients (S, S), 0 to 1, at this resolution,
    at half of it, and so on. Detail of each scale is mixed with the donor's to reach it; contrast
    changes from field to field and is sometimes inverted; light, blur and noise vary.
    """
    size = grey.shape[0]
    own, light = _bands(grey)
    # Rotated by 180 deg, because the donor also fills holes of `grey`; flipped once more it would
    # be real ground.
    other, _ = _bands(np.ascontiguousarray(donor[::-1, ::-1]))
    cells = int(rng.integers(4, 10))
    log_factor = FIELD * _enlarged(rng.standard_normal((cells, cells)), size)
    log_factor += VIEW * rng.standard_normal()
    factor = np.exp(log_factor)
    gain = 0.6 + 0.8 * _uniform(rng, size, 6)
    # About a fifth of the area inverts its contrast, as on generated and on real ground.
    gain = np.where(_uniform(rng, size, 5) > rng.uniform(0.6, 0.85), -gain, gain)
    detail = np.zeros_like(light)
    for mine, theirs, (_, window_px, level) in zip(own, other, BANDS, strict=True):
        expected = persistence[min(level, len(persistence) - 1)]
        # Doubled angles of mixed gradients correlate as the square of the own share; no two dates
        # are identical.
        share = np.sqrt(np.clip(expected * factor, 0.0, 0.95))
        strength = np.clip(_strength(mine, window_px) / _strength(theirs, window_px), 0.2, 5.0)
        detail += gain * (share * mine + np.sqrt(1 - share**2) * strength * theirs)
    light = light + 30 * (_uniform(rng, size, 4) - 0.5)
    tone = np.power(np.clip(light + detail, 0, 255) / 255, rng.uniform(0.75, 1.35))
    blurred = np.asarray(cv2.GaussianBlur(tone, (0, 0), float(rng.uniform(0.3, 0.9))))
    exposed = blurred * 255 * rng.uniform(0.8, 1.15)
    noisy = exposed + rng.normal(0, rng.uniform(1, 4), grey.shape)
    return np.asarray(np.clip(noisy, 0, 255), dtype=np.uint8)


def displaced(
    rng: np.random.Generator, grey: NDArray[np.uint8], relief_px: float, cell_px: float
) -> NDArray[np.uint8]:
    """`grey` (S, S) with relief displacement: raised objects move away from the middle.

    `relief_px` is the standard deviation of the displacement at the rim of the picture; heights
    vary over about `cell_px` pixels.
    """
    size = grey.shape[0]
    cells = int(np.clip(size / max(cell_px, 1.0), 2, 96))
    along = np.linspace(-1, 1, size, dtype=np.float32)
    shift = relief_px * _enlarged(rng.standard_normal((cells, cells)), size)
    index = np.arange(size, dtype=np.float32)
    cols = index[None, :] - shift * along[None, :]
    rows = index[:, None] - shift * along[:, None]
    moved = cv2.remap(grey, cols, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(moved, dtype=np.uint8)


def _bands(grey: NDArray[np.uint8]) -> tuple[list[Array], Array]:
    """Detail of each scale (S, S), finest first, and the remaining low frequencies."""
    rest = grey.astype(np.float32)
    bands = []
    for side, _, _ in BANDS:
        blurred = np.asarray(cv2.blur(rest, (side, side)), np.float32)
        bands.append(rest - blurred)
        rest = blurred
    return bands, rest


def _strength(band: Array, window_px: int) -> Array:
    power = cv2.blur(band * band, (window_px, window_px))
    return np.asarray(np.sqrt(power + np.float32(0.25)), dtype=np.float32)


def _uniform(rng: np.random.Generator, size: int, cells: int) -> Array:
    """A smooth random field (S, S) around 0.5, `cells` values across."""
    return _enlarged(rng.random((cells, cells)), size)


def _enlarged(values: NDArray[np.float64], size: int) -> Array:
    field = cv2.resize(values.astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC)
    return np.asarray(field, dtype=np.float32)
