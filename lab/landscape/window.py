"""The rendered window of the landscape, and drawing on it with sub-pixel corners."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.landscape.noise import Float64

Box = tuple[float, float, float, float]
"""West, south, east and north in metres from the landscape's origin."""

_SHIFT = 6
_ONE = 1 << _SHIFT


@dataclass(frozen=True, eq=False)
class PixelWindow:
    """A grid of pixels, counted from the origin of the landscape.

    Columns count east and rows count south from a corner near the origin (`phase_en_m` away), so
    that two windows on the same grid compute bit-equal coordinates for the pixels they share.
    """

    first_col: int
    first_row: int
    width_px: int
    height_px: int
    gsd_m: float
    phase_en_m: tuple[float, float]

    @classmethod
    def at(
        cls, west_m: float, north_m: float, width_px: int, height_px: int, gsd_m: float
    ) -> "PixelWindow":
        """Return the window whose upper left corner is (west_m, north_m) from the origin."""
        col = int(np.floor(west_m / gsd_m + 1e-6))
        row = int(np.floor(-north_m / gsd_m + 1e-6))
        phase = (_snapped(west_m - col * gsd_m, gsd_m), _snapped(north_m + row * gsd_m, gsd_m))
        return cls(col, row, width_px, height_px, gsd_m, phase)

    def part(self, col: int, row: int, width_px: int, height_px: int) -> "PixelWindow":
        """Return the window that starts at pixel (row, col) of this one; it may reach outside."""
        first = self.first_col + col, self.first_row + row
        return PixelWindow(*first, width_px, height_px, self.gsd_m, self.phase_en_m)

    def finer(self, factor: int) -> "PixelWindow":
        """Return the same window with `factor` times as many pixels along each axis."""
        first = self.first_col * factor, self.first_row * factor
        size = self.width_px * factor, self.height_px * factor
        return PixelWindow(*first, *size, self.gsd_m / factor, self.phase_en_m)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.height_px, self.width_px

    @cached_property
    def columns(self) -> NDArray[np.int64]:
        """Column numbers (W,)."""
        return np.arange(self.first_col, self.first_col + self.width_px, dtype=np.int64)

    @cached_property
    def rows(self) -> NDArray[np.int64]:
        """Row numbers (H,)."""
        return np.arange(self.first_row, self.first_row + self.height_px, dtype=np.int64)

    @cached_property
    def east_m(self) -> Float64:
        """East of the pixel centres (W,), from the origin."""
        return (self.columns.astype(np.float64) + 0.5) * self.gsd_m + self.phase_en_m[0]

    @cached_property
    def north_m(self) -> Float64:
        """North of the pixel centres (H,), from the origin."""
        return self.phase_en_m[1] - (self.rows.astype(np.float64) + 0.5) * self.gsd_m

    @cached_property
    def bounds_m(self) -> Box:
        """(west, south, east, north) of the outer corners, from the origin."""
        half = self.gsd_m / 2
        return (
            float(self.east_m[0]) - half,
            float(self.north_m[-1]) - half,
            float(self.east_m[-1]) + half,
            float(self.north_m[0]) + half,
        )

    def touches(self, box_m: Box) -> bool:
        """Return whether the box (west, south, east, north) shares ground with this window."""
        west, south, east, north = self.bounds_m
        return box_m[0] < east and box_m[2] > west and box_m[1] < north and box_m[3] > south

    def fixed(self, points_en_m: Float64) -> NDArray[np.int32]:
        """Return points (..., 2) as OpenCV fixed point (column, row) of this window.

        Rounded before the window corner is subtracted, so that the window has no influence.
        """
        out = np.empty(points_en_m.shape, np.int64)
        scale = _ONE / self.gsd_m
        half = _ONE // 2  # integer coordinates of OpenCV are pixel centres
        out[..., 0] = np.rint((points_en_m[..., 0] - self.phase_en_m[0]) * scale)
        out[..., 1] = np.rint((self.phase_en_m[1] - points_en_m[..., 1]) * scale)
        out[..., 0] -= self.first_col * _ONE + half
        out[..., 1] -= self.first_row * _ONE + half
        return out.astype(np.int32)

    def fill(
        self,
        image: NDArray[np.integer[Any]],
        points_en_m: Float64,
        value: float | tuple[float, ...],
        smooth: bool = True,
    ) -> None:
        """Fill the polygon (N, 2) in `image`; `smooth` (8-bit images only) blends its border."""
        line = cv2.LINE_AA if smooth else cv2.LINE_8
        colour = value if isinstance(value, tuple) else (value,)
        cv2.fillPoly(image, [self.fixed(points_en_m)], colour, line, _SHIFT)

    @staticmethod
    def fill_face(
        image: NDArray[np.uint8], points: NDArray[np.int32], value: float | tuple[float, ...]
    ) -> None:
        """Fill the convex polygon (N, 2), given in fixed point of this window, border blended."""
        colour = value if isinstance(value, tuple) else (value,)
        cv2.fillConvexPoly(image, points, colour, cv2.LINE_AA, _SHIFT)

    def discs(
        self,
        image: NDArray[np.uint8],
        points_en_m: Float64,
        radius_m: Float64,
        value: NDArray[np.uint8],
    ) -> None:
        """Draw filled discs: centres (N, 2), radii (N,), grey levels (N,), in the given order."""
        centres = self.fixed(points_en_m).tolist()
        radii = np.maximum(np.rint(radius_m * (_ONE / self.gsd_m)), 1).astype(int).tolist()
        for centre, radius, level in zip(centres, radii, value.tolist(), strict=True):
            cv2.circle(image, centre, radius, level, -1, cv2.LINE_AA, _SHIFT)

    def inside(self, points_en_m: Float64, margin_m: float = 0.0) -> NDArray[np.bool_]:
        """Return which of the points (N, 2) lie in the window or within `margin_m` of it."""
        west, south, east, north = self.bounds_m
        x, y = points_en_m[:, 0], points_en_m[:, 1]
        return np.asarray(
            (x > west - margin_m)
            & (x < east + margin_m)
            & (y > south - margin_m)
            & (y < north + margin_m)
        )


def _snapped(phase_m: float, gsd_m: float) -> float:
    """Round away float noise of the window corner, far below a pixel."""
    return round(phase_m / gsd_m * 1e4) * gsd_m / 1e4


def box_of(points_en_m: Float64, grow_m: float = 0.0) -> Box:
    """Return (west, south, east, north) around points (N, 2), grown by `grow_m`."""
    low = points_en_m.min(axis=0) - grow_m
    high = points_en_m.max(axis=0) + grow_m
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def chunks(width_px: int, height_px: int, size_px: int) -> Iterable[tuple[int, int, int, int]]:
    """Yield (col, row, width, height) that cover an image, running along its shorter side."""
    cols = range(0, width_px, size_px)
    rows = range(0, height_px, size_px)
    if width_px >= height_px:
        corners = [(col, row) for col in cols for row in rows]
    else:
        corners = [(col, row) for row in rows for col in cols]
    for col, row in corners:
        yield col, row, min(size_px, width_px - col), min(size_px, height_px - row)
