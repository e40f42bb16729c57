"""Imagery to fly over: its coverage, and windows of it, mirrored beyond its border."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError
from orthonav.ground.imagery.mosaic import Mosaic, SheetRaster
from orthonav.ground.planning.area import Area

COVERAGE_PX = 1024
"""Size of the coverage mask; bounds its memory for any imagery."""
Array = NDArray[np.float64]


class Coverage:
    """Mask of the covered area, subsampled to at most `COVERAGE_PX` pixels across."""

    def __init__(self, mosaic: Mosaic, area: Area) -> None:
        self._west, south, east, self._north = area.extent_en_m
        across = max(east - self._west, self._north - south)
        self._gsd_m = max(mosaic.gsd_m, across / COVERAGE_PX)
        width = math.ceil((east - self._west) / self._gsd_m)
        height = math.ceil((self._north - south) / self._gsd_m)
        with mosaic.sheet(
            area.frame,
            west_m=self._west,
            north_m=self._north,
            width_px=width,
            height_px=height,
            gsd_m=self._gsd_m,
        ) as raster:
            self._missing = ~raster.read_grey(0, 0, width, height).valid

    def whole(self, corners_en_m: Array) -> bool:
        """Whether imagery covers all of the convex polygon (N, 2)."""
        x = (corners_en_m[:, 0] - self._west) / self._gsd_m
        y = (self._north - corners_en_m[:, 1]) / self._gsd_m
        height, width = self._missing.shape
        if min(x.min(), y.min()) < 0 or x.max() > width or y.max() > height:
            return False
        left, top = int(x.min()), int(y.min())
        part = self._missing[top : math.ceil(y.max()), left : math.ceil(x.max())]
        if not part.any():
            return True
        inside = np.zeros(part.shape, dtype=np.uint8)
        corners = np.round(np.stack([x - left, y - top], axis=1) - 0.5).astype(np.int32)
        cv2.fillConvexPoly(inside, corners, 1)
        return not (part & (inside > 0)).any()

    def box_en_m(self) -> tuple[float, float, float, float]:
        """West, south, east, north of a box that is fully covered by imagery.

        Raises `AreaError` if the imagery is too fragmented.
        """
        height, width = self._missing.shape
        left, top, right, bottom = 0, 0, width, height
        while left < right and top < bottom:
            part = self._missing[top:bottom, left:right]
            if not part.any():
                break
            sides = [part[:, 0], part[0], part[:, -1], part[-1]]
            worst = int(np.argmax([side.mean() for side in sides]))
            left, top = left + (worst == 0), top + (worst == 1)
            right, bottom = right - (worst == 2), bottom - (worst == 3)
        # One pixel less on every side, because the mask is subsampled.
        left, top, right, bottom = left + 1, top + 1, right - 1, bottom - 1
        if left >= right or top >= bottom:
            raise AreaError("imagery has no part without holes that could be mirrored (--beyond)")
        return (
            self._west + left * self._gsd_m,
            self._north - bottom * self._gsd_m,
            self._west + right * self._gsd_m,
            self._north - top * self._gsd_m,
        )


@dataclass(frozen=True, eq=False)
class GroundImagery:
    """Imagery in a local plane.

    `raster`: the resampled imagery. `west_m`, `north_m`: its north-west corner. `gsd_m`: metres per
    pixel. `mirror_px`: box (left, top, right, bottom) that is mirrored at its sides to fill pixels
    without imagery, None for no filling.
    """

    raster: SheetRaster
    west_m: float
    north_m: float
    gsd_m: float
    mirror_px: tuple[int, int, int, int] | None = None

    def window(self, corners_en_m: Array, margin_px: int) -> tuple[NDArray[np.uint8], Array]:
        """Pixels (H, W, 3) of the box around points (N, 2), and the position (2,) of their
        corner."""
        cols = (corners_en_m[:, 0] - self.west_m) / self.gsd_m
        rows = (self.north_m - corners_en_m[:, 1]) / self.gsd_m
        left, top = math.floor(cols.min()) - margin_px, math.floor(rows.min()) - margin_px
        width = math.ceil(cols.max()) + margin_px - left
        height = math.ceil(rows.max()) + margin_px - top
        pixels = self.raster.read(left, top, width, height)
        rgb = pixels.rgb
        if self.mirror_px is not None and not pixels.valid.all():
            filled = self._mirrored(left, top, width, height)
            rgb = np.where(pixels.valid[..., None], rgb, filled)
        corner = np.array([self.west_m + left * self.gsd_m, self.north_m - top * self.gsd_m])
        return rgb, corner

    def _mirrored(self, left: int, top: int, width: int, height: int) -> NDArray[np.uint8]:
        assert self.mirror_px is not None
        x0, y0, x1, y1 = self.mirror_px
        cols = reflected(np.arange(left, left + width), x0, x1)
        rows = reflected(np.arange(top, top + height), y0, y1)
        x, y = int(cols.min()), int(rows.min())
        part = self.raster.read(x, y, int(cols.max()) + 1 - x, int(rows.max()) + 1 - y)
        return np.asarray(part.rgb[np.ix_(rows - y, cols - x)])


def reflected(index: NDArray[np.int64], low: int, high: int) -> NDArray[np.int64]:
    """Indices reflected into low..high-1 at both ends."""
    size = high - low
    folded = (index - low) % (2 * size)
    return np.asarray(low + np.minimum(folded, 2 * size - 1 - folded))
