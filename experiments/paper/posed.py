"""What a user might write to register a view with OpenCV, on the map's picture.

Every method gets the view rectified by orthonav's own code under the reported pose, whole with a
mask, and the whole map.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize import Localizer, RectifiedView, downsampled, rectify
from orthonav.core.mapfile import open_map
from orthonav.core.records import View
from orthonav.core.tiles.represent import Canny
from orthonav.ground.imagery.mosaic import Mosaic

Array = NDArray[np.float32]
Grey = NDArray[np.uint8]
Place = NDArray[np.float64] | None
LEVELS_MI = 6
LOWE, MIN_INLIERS, RANSAC_PX, BORDER_PX = 0.75, 8, 4.0, 9


@dataclass(frozen=True, eq=False)
class Picture:
    """The orthophoto in the plane and pixels of a map, `factor` pixels averaged to one.

    `grey` (H, W) has the mean grey level where `valid` is false.
    """

    grid: TileGrid
    factor: int
    grey: Grey
    valid: NDArray[np.bool_]

    @classmethod
    def read(cls, map_path: Path, pixels_path: Path, factor: int) -> "Picture":
        """From the file that `store` made with a map."""
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


def store(ortho: Path, localizer: Localizer, out: Path) -> Path:
    """Write an orthophoto in the raster of a map, for processes that have no GDAL."""
    grid = localizer.grid
    with Mosaic.open([ortho]).grid_sheet(localizer.sheet.frame, grid) as raster:
        pixels = raster.read(0, 0, grid.width_px, grid.height_px)
    mean = round(float(pixels.grey[pixels.valid].mean()))
    grey = np.where(pixels.valid, pixels.grey, mean).astype(np.uint8)
    out.parent.mkdir(parents=True, exist_ok=True)
    np.savez(out, grey=grey, valid=pixels.valid)
    return out


def posed(view: View, gsd_m: float) -> RectifiedView:
    """All that the camera sees, north up, under the reported pose."""
    camera, agl_m = view.camera, view.telemetry.agl_m
    across = math.hypot(camera.width_px / camera.fx_px, camera.height_px / camera.fy_px)
    size_px = 2 * math.ceil(across * agl_m / gsd_m / 2)
    return rectify(downsampled(view, gsd_m), gsd_m=gsd_m, size_px=size_px)


Surface = Callable[[RectifiedView], Array]
"""Function from a rectified view (S, S) to its score (h, w) with its corner on each pixel."""


class Highest:
    """The place of the highest value of a surface."""

    def __init__(self, picture: Picture, surface: Surface) -> None:
        self._picture, self._surface = picture, surface

    def locate(self, view: View) -> Place:
        """East and north (2,) of the camera in the sheet; None where it does not fit on the map."""
        seen = posed(view, self._picture.gsd_m)
        half = seen.grey.shape[0] / 2
        if min(self._picture.grey.shape) <= seen.grey.shape[0]:
            return None
        _, _, _, (col, row) = cv2.minMaxLoc(self._surface(seen))
        return self._picture.place_en_m(col + half, row + half) - seen.offset_en_m


class TemplateSurface:
    """Normalized correlation coefficient with a mask, of grey levels or Canny edges.

    The mask is what the camera saw: better than the largest square within it.
    """

    def __init__(self, picture: Picture, canny: bool) -> None:
        self._canny = canny
        self._map = self._centred(picture.grey, picture.valid)

    def __call__(self, seen: RectifiedView) -> Array:
        """Correlation coefficients (h, w)."""
        template, mask = self._centred(seen.grey, seen.valid), seen.valid.astype(np.float32)
        found = cv2.matchTemplate(self._map, template, cv2.TM_CCOEFF_NORMED, mask=mask)
        return np.where(np.abs(found) <= 1.0, found, np.float32(-1.0))  # uniform: no evidence

    def _centred(self, grey: Grey, valid: NDArray[np.bool_]) -> Array:
        made = Canny()(grey, valid)[0] * np.float32(255) if self._canny else grey
        return np.asarray(made - made.mean(), np.float32)


class MutualSurface:
    """Mutual information of grey levels, each in `LEVELS_MI` classes as full as each other.

    The joint histogram at every position comes from one correlation per pair of classes.
    """

    def __init__(self, picture: Picture) -> None:
        classes = _classes(picture.grey, picture.valid)
        self._map = [(classes == k).astype(np.float32) for k in range(LEVELS_MI)]

    def __call__(self, seen: RectifiedView) -> Array:
        """Nats (h, w)."""
        classes, pixels = _classes(seen.grey, seen.valid), float(seen.valid.sum())
        total: Array = np.zeros((1, 1), np.float32)
        rows: list[Array] = [total] * LEVELS_MI
        for k in range(LEVELS_MI):
            mine = ((classes == k) & seen.valid).astype(np.float32)
            for number, theirs in enumerate(self._map):
                counts = cv2.matchTemplate(theirs, mine, cv2.TM_CCORR)
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

    def locate(self, view: View) -> Place:
        """Position of the centre of the view; None with too few inliers."""
        seen = posed(view, self._picture.gsd_m)
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


def _classes(grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.intp]:
    limits = np.quantile(grey[valid], np.arange(1, LEVELS_MI) / LEVELS_MI)
    return np.digitize(grey, limits)
