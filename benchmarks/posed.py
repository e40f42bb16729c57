"""What a user might write to register a view with OpenCV: one similarity measure, many poses.

Every method gets the view rectified by orthonav's own code, once per pose of orthonav's own bank of
headings and heights, whole with a mask, and the whole map. The best value of any pose and place is
the answer. Nothing here needs the orthophoto's file: processes measure their memory.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.view import RectifiedView, downsampled, rectify
from orthonav.core.mapfile import open_map
from orthonav.core.records import View
from orthonav.core.register.search import bank
from orthonav.core.tiles.represent import Canny

Array = NDArray[np.float32]
Place = NDArray[np.float64] | None
TURN_STEP_DEG, SCALE_STEP, SIGMAS = 8.0, 0.13, 3.0
SCALE_STD = 0.1
LEVELS_MI = 6
LOWE, MIN_INLIERS, RANSAC_PX, BORDER_PX = 0.75, 8, 4.0, 9


@dataclass(frozen=True, eq=False)
class Picture:
    """The orthophoto in the plane and pixels of a map, `factor` pixels averaged to one.

    `grey` (H, W) has the mean grey level where `valid` is false.
    """

    grid: TileGrid
    factor: int
    grey: NDArray[np.uint8]
    valid: NDArray[np.bool_]

    @classmethod
    def read(cls, map_path: Path, pixels_path: Path, factor: int) -> "Picture":
        """From the file that `scenes.store` made with a map."""
        with np.load(pixels_path) as stored:
            grey, valid = stored["grey"], stored["valid"]
        size = grey.shape[1] // factor, grey.shape[0] // factor
        part = np.s_[: size[1] * factor, : size[0] * factor]
        small = cv2.resize(grey[part], size, interpolation=cv2.INTER_AREA)
        seen = cv2.resize(valid[part].astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0
        grid = open_map(map_path).manifest.sheets[0].grid
        return cls(grid, factor, np.asarray(small, np.uint8), np.asarray(seen, np.bool_))

    @property
    def gsd_m(self) -> float:
        return self.grid.gsd_m * self.factor

    def place_en_m(self, col_px: float, row_px: float) -> NDArray[np.float64]:
        """Position in the sheet of a pixel coordinate (outer corner of the first pixel: 0, 0)."""
        return np.array(
            [self.grid.west_m + col_px * self.gsd_m, self.grid.north_m - row_px * self.gsd_m]
        )


def poses(heading_known: bool, yaw_std_deg: float | None) -> list[tuple[float, float]]:
    """Turns (deg) and factors of the height that are tried: orthonav's bank."""
    std = math.radians(yaw_std_deg or 0.0) if heading_known else None
    made = bank(
        std,
        SCALE_STD,
        turn_step_rad=math.radians(TURN_STEP_DEG),
        scale_step=SCALE_STEP,
        sigmas=SIGMAS,
    )
    return [(math.degrees(turn), math.exp(log_scale)) for turn, log_scale in made]


def posed(view: View, gsd_m: float, tried: list[tuple[float, float]]) -> Iterator[RectifiedView]:
    """All that the camera sees, north up, under each of the poses."""
    camera, reported = view.camera, view.telemetry
    smaller = downsampled(view, gsd_m)
    yaw_deg = reported.yaw_deg if math.isfinite(reported.yaw_deg) else 0.0
    across = math.hypot(camera.width_px / camera.fx_px, camera.height_px / camera.fy_px)
    for turn_deg, factor in tried:
        agl_m = reported.agl_m * factor
        telemetry = replace(reported, yaw_deg=yaw_deg + turn_deg, agl_m=agl_m)
        yield rectify(
            replace(smaller, telemetry=telemetry),
            gsd_m=gsd_m,
            size_px=2 * math.ceil(across * agl_m / gsd_m / 2),
        )


Surface = Callable[[RectifiedView], Array]
"""Function from a rectified view (S, S) to its score (h, w) with its corner on each pixel."""


class BestOfPoses:
    """The highest value of a surface over all poses."""

    def __init__(self, picture: Picture, surface: Surface, telemetry_only: bool) -> None:
        self._picture, self._surface, self._telemetry_only = picture, surface, telemetry_only

    def locate(self, view: View, heading_known: bool) -> Place:
        """East and north (2,) of the camera in the sheet."""
        tried = poses(heading_known, view.telemetry.yaw_std_deg)
        if self._telemetry_only:
            tried = [(0.0, 1.0)]
        best, place = -math.inf, None
        for seen in posed(view, self._picture.gsd_m, tried):
            surface = self._surface(seen)
            _, value, _, (col, row) = cv2.minMaxLoc(surface)
            if value > best:
                half = seen.grey.shape[0] / 2
                best = value
                place = self._picture.place_en_m(col + half, row + half) - seen.offset_en_m
        return place


class _Spectra:
    """Real FFTs of planes as large as the map; values are valid where the view lies fully on it."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        rows, cols = (cv2.getOptimalDFTSize(side) for side in shape)
        self._padded = np.zeros((rows, cols), np.float32)

    def of(self, plane: NDArray[np.generic], flags: int = 0) -> Array:
        """Spectrum of a plane laid into the corner."""
        height, width = plane.shape
        self._padded[:height, :width] = plane
        made = cv2.dft(self._padded, flags=flags)
        self._padded[:height, :width] = 0
        return np.asarray(made, np.float32)

    def holds(self, seen: RectifiedView) -> bool:
        """Whether a view fits on the map."""
        return bool(min(self._shape) > seen.grey.shape[0])

    def surface(self, one: Array, other: Array, seen: RectifiedView) -> Array:
        """Correlation (h, w) from two spectra, for every place of the view's corner."""
        product = cv2.mulSpectrums(one, other, 0, conjB=True)
        made = cv2.idft(product, flags=cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT)
        rows, cols = (side - seen.grey.shape[0] + 1 for side in self._shape)
        return np.asarray(made[:rows, :cols])


_NOWHERE = np.full((1, 1), -np.inf, np.float32)


class TemplateSurface:
    """Same as `cv2.matchTemplate` TM_CCOEFF_NORMED with a mask, of grey or Canny edges.

    The same numbers by FFT with the map's spectra made once, which is several times faster. The
    mask is what the camera saw: better than the largest square within it.
    """

    def __init__(self, picture: Picture, canny: bool) -> None:
        self._canny = canny
        made = canny_edges(picture.grey, picture.valid) if canny else picture.grey
        plane = made.astype(np.float32) - np.float32(made.mean())
        self._spectra = _Spectra(picture.grey.shape[:2])
        self._map, self._squared = self._spectra.of(plane), self._spectra.of(plane**2)

    def __call__(self, seen: RectifiedView) -> Array:
        """Correlation coefficients (h, w)."""
        if not self._spectra.holds(seen):
            return _NOWHERE
        made = canny_edges(seen.grey, seen.valid) if self._canny else seen.grey
        template = np.where(seen.valid, made - float(made[seen.valid].mean()), 0.0)
        pixels, energy = float(seen.valid.sum()), float((template**2).sum())
        mask = self._spectra.of(seen.valid)
        product = self._spectra.surface(self._map, self._spectra.of(template), seen)
        mean = self._spectra.surface(self._map, mask, seen)
        spread = self._spectra.surface(self._squared, mask, seen) - mean**2 / pixels
        typical = float(np.median(spread))  # a uniform place has no evidence
        return np.asarray(product / np.sqrt(np.maximum(spread, 1e-3 * typical) * energy + 1e-9))


class PhaseSurface:
    """Phase correlation: the whitened cross spectrum; the spectrum of the map is computed once."""

    def __init__(self, picture: Picture) -> None:
        grey = picture.grey.astype(np.float32)
        self._spectra = _Spectra(picture.grey.shape[:2])
        self._map = self._whitened(grey - grey.mean())

    def __call__(self, seen: RectifiedView) -> Array:
        """Heights (h, w) of the phase correlation."""
        if not self._spectra.holds(seen):
            return _NOWHERE
        mean = float(seen.grey[seen.valid].mean())
        soft = cv2.GaussianBlur(
            cv2.erode(seen.valid.astype(np.float32), np.ones((5, 5), np.uint8)), (0, 0), 2
        )
        own = self._whitened((seen.grey - mean) * soft)
        return self._spectra.surface(self._map, own, seen)

    def _whitened(self, plane: Array) -> Array:
        made = self._spectra.of(plane, int(cv2.DFT_COMPLEX_OUTPUT))
        power = cv2.magnitude(made[..., 0], made[..., 1])
        return np.asarray(made / np.maximum(power, 1e-6)[..., None], np.float32)


class MutualSurface:
    """Mutual information of grey levels, each in `LEVELS_MI` classes as full as each other.

    The joint histogram at every position comes from one correlation per pair of classes.
    """

    def __init__(self, picture: Picture) -> None:
        self._spectra = _Spectra(picture.grey.shape[:2])
        classes = _classes(picture.grey, picture.valid)
        self._map = [self._spectra.of(classes == k) for k in range(LEVELS_MI)]

    def __call__(self, seen: RectifiedView) -> Array:
        """Nats (h, w)."""
        if not self._spectra.holds(seen):
            return _NOWHERE
        classes, pixels = _classes(seen.grey, seen.valid), float(seen.valid.sum())
        total: Array = np.zeros((1, 1), np.float32)
        rows: list[Array] = [total] * LEVELS_MI
        for k in range(LEVELS_MI):
            mine = (classes == k) & seen.valid
            spectrum = self._spectra.of(mine)
            for number, theirs in enumerate(self._map):
                counts = self._spectra.surface(theirs, spectrum, seen)
                share = np.maximum(counts, np.float32(1e-3)) / np.float32(pixels)
                total = np.asarray(total + share * cv2.log(share), np.float32)
                rows[number] = np.asarray(rows[number] + share, np.float32)
            own = float(mine.sum()) / pixels
            total = total - np.float32(own * math.log(max(own, 1e-9)))
        for row in rows:
            total = total - row * cv2.log(row)
        return np.asarray(total, np.float32)


class Keypoints:
    """SIFT of the view against all of the map's, through an index that is made once: ratio test,
    RANSAC similarity."""

    def __init__(self, picture: Picture) -> None:
        self._picture = picture
        self._detector: Any = cv2.SIFT_create()  # type: ignore[attr-defined]  # not in its stubs
        self._points, descriptors = self._features(picture.grey, picture.valid)
        self._matcher: Any = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 5}, {"checks": 64})
        self._matcher.add([descriptors])
        self._matcher.train()

    def locate(self, view: View, heading_known: bool) -> Place:
        """Position of the centre of the view; None with too few inliers. No heading is needed."""
        seen = next(posed(view, self._picture.gsd_m, [(0.0, 1.0)]))
        points, descriptors = self._features(seen.grey, seen.valid)
        if len(points) < MIN_INLIERS:
            return None
        pairs = self._matcher.knnMatch(descriptors, k=2)
        good = [a for a, b in (p for p in pairs if len(p) == 2) if a.distance < LOWE * b.distance]
        if len(good) < MIN_INLIERS:
            return None
        matrix, inliers = cv2.estimateAffinePartial2D(
            points[[match.queryIdx for match in good]],
            self._points[[match.trainIdx for match in good]],
            method=cv2.RANSAC,
            ransacReprojThreshold=RANSAC_PX,
        )
        if matrix is None or int(inliers.sum()) < MIN_INLIERS:
            return None
        centre = matrix @ [*(np.array(seen.grey.shape[::-1]) / 2), 1.0]
        return np.asarray(self._picture.place_en_m(*centre) - seen.offset_en_m)

    def _features(
        self, grey: NDArray[np.uint8], valid: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[Any]]:
        kernel = np.ones((BORDER_PX, BORDER_PX), np.uint8)
        mask = cv2.erode(valid.astype(np.uint8), kernel, borderValue=1)
        keypoints, descriptors = self._detector.detectAndCompute(grey, mask)
        return np.array([k.pt for k in keypoints]).reshape(-1, 2) + 0.5, descriptors


def canny_edges(grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Edge map (H, W) of 0 and 255."""
    return np.asarray(Canny()(grey, valid)[0] * 255, dtype=np.uint8)


def _classes(grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.intp]:
    limits = np.quantile(grey[valid], np.arange(1, LEVELS_MI) / LEVELS_MI)
    return np.digitize(grey, limits)
