"""Where a check samples: the imagery of a map, whole or in the band of a route, in square cells."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.register.window import GreyPyramid
from orthonav.ground.changes.record import CellGrid, ChangedGround
from orthonav.ground.planning.area import Area, Extent

# Limits of work and of what a page can show; the benchmark's maps need no more trials.
MAX_CELLS = 4000
CELLS_PER_VIEW = 4.0
"""Cells per side of a view, unless that gives too many."""
MIN_TRIALS, MAX_TRIALS = 240, 1500
TRIALS_PER_VIEW = 4.0
"""Trials per area of a view, within those limits."""
FEWEST_TRIALS = 40
MASK_PX = 2048
"""The coverage of the map is read at the finest level no larger than this."""
_REDRAWS = 6
_PROBES_ACROSS, _PROBES_PER_BAND, _MAX_POINTS = 400, 4, 1_000_000
_SAMPLES_PER_CELL = 4

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MapCoverage:
    """Where a map has imagery: `valid` (rows, cols) of the pixels of a raster."""

    pixels: CellGrid
    valid: NDArray[np.bool_]

    @classmethod
    def of(cls, layer: GreyPyramid, grid: TileGrid) -> "MapCoverage":
        level = 0
        while level < layer.levels - 1 and max(layer.shape(level)) > MASK_PX:
            level += 1
        rows, cols = layer.shape(level)
        _, valid = layer.read(level, 0, 0, rows, cols)
        return cls(CellGrid(grid.west_m, grid.north_m, grid.gsd_m * 2**level, rows, cols), valid)

    def without(self, changes: ChangedGround | None, frame: LocalFrame) -> "MapCoverage":
        if changes is None:
            return self
        changed = changes.covers(self.pixels.centres_en_m, frame).reshape(self.valid.shape)
        return replace(self, valid=self.valid & ~changed)

    def covers(self, points_en_m: Array) -> NDArray[np.bool_]:
        numbers = self.pixels.numbers(points_en_m)
        return np.asarray((numbers >= 0) & self.valid.ravel()[numbers])

    def seen_share(self, points_en_m: Array, side_m: float) -> Array:
        """Fraction (N,) of views of a side, taken over points (N, 2), that the map covers."""
        side = max(1, round(side_m / self.pixels.side_m))
        padded = np.pad(self.valid.astype(np.float32), side)
        share = cv2.blur(padded, (side, side), borderType=cv2.BORDER_CONSTANT)
        numbers = self.pixels.numbers(points_en_m, side)
        return np.where(numbers >= 0, np.asarray(share, np.float64).ravel()[numbers], 0.0)

    def cell_share(self, cells: CellGrid) -> Array:
        """Fraction (rows, cols) of every cell that the map covers."""
        unit_m, fine = self.pixels.side_m, _SAMPLES_PER_CELL
        left = (cells.west_m - self.pixels.west_m) / unit_m
        top = (self.pixels.north_m - cells.north_m) / unit_m
        step = cells.side_m / unit_m / fine
        matrix = np.array([[step, 0, left + step / 2 - 0.5], [0, step, top + step / 2 - 0.5]])
        samples = cv2.warpAffine(
            self.valid.astype(np.float32),
            matrix,
            (cells.cols * fine, cells.rows * fine),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )
        parts = np.asarray(samples).reshape(cells.rows, fine, cells.cols, fine)
        return np.asarray(parts.mean(axis=(1, 3)), dtype=np.float64)

    @property
    def extent_en_m(self) -> Extent:
        rows, cols = np.flatnonzero(self.valid.any(axis=1)), np.flatnonzero(self.valid.any(axis=0))
        if not len(rows):
            raise AreaError("the map has no imagery; build it again from an orthophoto with data")
        return (
            self.pixels.west_m + cols[0] * self.pixels.side_m,
            self.pixels.north_m - (rows[-1] + 1) * self.pixels.side_m,
            self.pixels.west_m + (cols[-1] + 1) * self.pixels.side_m,
            self.pixels.north_m - rows[0] * self.pixels.side_m,
        )

    @property
    def area_m2(self) -> float:
        return float(self.valid.sum()) * self.pixels.side_m**2


def checked_m2(coverage: MapCoverage, area: Area | None) -> float:
    """Area of the map's imagery within `area`, the band of a route; all of it without one.

    Raises `AreaError` where the band does not touch the imagery.
    """
    if area is None:
        return coverage.area_m2
    west, south, east, north = area.extent_en_m
    side_m = max(east - west, north - south) / _PROBES_ACROSS
    if area.route is not None:
        side_m = min(side_m, min(area.route.bands_m(area.band_m) or (1.0,)) / _PROBES_PER_BAND)
    side_m = max(side_m, math.sqrt((east - west) * (north - south) / _MAX_POINTS))
    points = CellGrid.over(area.extent_en_m, side_m).centres_en_m
    count = np.count_nonzero(area.contains(points) & coverage.covers(points))
    if not count:
        left, below, right, above = coverage.extent_en_m
        far_m = math.hypot(max(west - right, left - east, 0), max(south - above, below - north, 0))
        raise AreaError(
            f"the band of the route does not touch the map, {far_m / 1000:,.1f} km from it; give "
            "the map of this route, and check that latitude and longitude are not swapped"
        )
    return float(count) * side_m**2


def cell_side_m(area_m2: float, view_side_m: float) -> float:
    return max(view_side_m / CELLS_PER_VIEW, math.sqrt(area_m2 / MAX_CELLS))


def trial_places(
    coverage: MapCoverage,
    area: Area | None,
    extent: Extent,
    wanted_m2: float,
    view_side_m: float,
    effort: float,
    rng: np.random.Generator,
) -> Array:
    """Places (N, 2) of trials, spread evenly at random over `wanted_m2` of checked imagery."""
    per_view = wanted_m2 / view_side_m**2
    count = min(max(TRIALS_PER_VIEW * per_view, MIN_TRIALS), MAX_TRIALS) * effort
    side_m = math.sqrt(wanted_m2 / max(count, FEWEST_TRIALS))
    all_m2 = (extent[2] - extent[0]) * (extent[3] - extent[1])
    cells = CellGrid.over(extent, max(side_m, math.sqrt(all_m2 / _MAX_POINTS)))

    def usable(points: Array) -> NDArray[np.bool_]:
        covered = coverage.covers(points)
        return covered if area is None else covered & area.contains(points)

    points = cells.drawn(rng)
    good = usable(points)
    for _ in range(_REDRAWS):  # another point of a cell on the border may be usable
        again = cells.drawn(rng)
        better = ~good & usable(again)
        points[better] = again[better]
        good |= better
    return points[good]
