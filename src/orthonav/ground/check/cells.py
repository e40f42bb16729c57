"""Square cells that a check predicts for, ground that the map covers, and places of trials."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError
from orthonav.core.geo.grid import TileGrid
from orthonav.core.register.window import GreyPyramid
from orthonav.ground.planning.area import Area, Extent

Array = NDArray[np.float64]
MAX_POINTS = 500_000
"""Of a grid over the box of a band."""


@dataclass(frozen=True)
class CellGrid:
    """Square cells of `side_m` from a north-west corner, row 0 in the north."""

    west_m: float
    north_m: float
    side_m: float
    rows: int
    cols: int

    @classmethod
    def over(cls, extent: Extent, side_m: float) -> "CellGrid":
        west, south, east, north = extent
        rows, cols = (max(1, math.ceil(d / side_m - 1e-9)) for d in (north - south, east - west))
        return cls(west, north, side_m, rows, cols)

    @property
    def extent_en_m(self) -> Extent:
        east_m, south_m = self.cols * self.side_m, -self.rows * self.side_m
        return self.west_m, self.north_m + south_m, self.west_m + east_m, self.north_m

    @property
    def centres_en_m(self) -> Array:
        """Centres (rows * cols, 2) of the cells, row by row."""
        east = self.west_m + (np.arange(self.cols) + 0.5) * self.side_m
        north = self.north_m - (np.arange(self.rows) + 0.5) * self.side_m
        return np.stack(np.meshgrid(east, north), axis=-1).reshape(-1, 2)

    def drawn(self, rng: np.random.Generator) -> Array:
        off = rng.uniform(-0.5, 0.5, (self.rows * self.cols, 2)) * self.side_m
        return np.asarray(self.centres_en_m + off)

    def numbers(self, points_en_m: Array, margin: int = 0) -> NDArray[np.intp]:
        """Number (...) of the cell, row by row, under each of points (..., 2); -1 outside.

        `margin` cells are added and counted on each side.
        """
        cols = np.floor((points_en_m[..., 0] - self.west_m) / self.side_m).astype(np.intp) + margin
        rows = np.floor((self.north_m - points_en_m[..., 1]) / self.side_m).astype(np.intp) + margin
        height, width = self.rows + 2 * margin, self.cols + 2 * margin
        inside = (rows >= 0) & (cols >= 0) & (rows < height) & (cols < width)
        return np.where(inside, rows * width + cols, -1)

    def counts(self, points_en_m: Array) -> NDArray[np.int32]:
        found = np.bincount(self.numbers(points_en_m) + 1, minlength=self.rows * self.cols + 1)
        return found[1:].astype(np.int32).reshape(self.rows, self.cols)


@dataclass(frozen=True, eq=False)
class MapCoverage:
    """Where a map has imagery: `valid` (rows, cols) of the pixels of a raster."""

    pixels: CellGrid
    valid: NDArray[np.bool_]

    @classmethod
    def of(cls, layer: GreyPyramid, grid: TileGrid) -> "MapCoverage":
        level = 0
        while level < layer.levels - 1 and max(layer.shape(level)) > 2048:
            level += 1
        rows, cols = layer.shape(level)
        _, valid = layer.read(level, 0, 0, rows, cols)
        return cls(CellGrid(grid.west_m, grid.north_m, grid.gsd_m * 2**level, rows, cols), valid)

    def of_each(self, at_en_m: Callable[[Array], Array]) -> Array:
        """Values (rows, cols) at the pixels, a row at a time."""
        rows = self.pixels.centres_en_m.reshape(*self.valid.shape, 2)
        return np.stack([at_en_m(row) for row in rows])

    def covers(self, points_en_m: Array) -> NDArray[np.bool_]:
        numbers = self.pixels.numbers(points_en_m)
        return np.asarray((numbers >= 0) & self.valid.ravel()[numbers])

    def seen_share(self, points_en_m: Array, side_m: float) -> Array:
        """Fraction (N,) of squares of a side around points (N, 2) that the map covers."""
        side = max(1, round(side_m / self.pixels.side_m))
        padded = np.pad(self.valid.astype(np.float32), side)
        share = cv2.blur(padded, (side, side), borderType=cv2.BORDER_CONSTANT)
        numbers = self.pixels.numbers(points_en_m, side)
        return np.where(numbers >= 0, np.asarray(share, np.float64).ravel()[numbers], 0.0)

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
    side_m = math.sqrt((east - west) * (north - south) / MAX_POINTS)
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
    """A quarter of a view, unless that gives more than 4,000 cells, the most a page can show."""
    return max(view_side_m / 4, math.sqrt(area_m2 / 4000))


def trial_places(
    coverage: MapCoverage,
    area: Area | None,
    extent: Extent,
    wanted_m2: float,
    count: int,
    rng: np.random.Generator,
) -> Array:
    """Some `count` places (N, 2), spread evenly at random over `wanted_m2` of checked imagery."""
    side_m = math.sqrt(wanted_m2 / count)
    all_m2 = (extent[2] - extent[0]) * (extent[3] - extent[1])
    cells = CellGrid.over(extent, max(side_m, math.sqrt(all_m2 / MAX_POINTS)))

    def usable(points: Array) -> NDArray[np.bool_]:
        covered = coverage.covers(points)
        return covered if area is None else covered & area.contains(points)

    points = cells.drawn(rng)
    good = usable(points)
    for _ in range(6):  # another point of a cell on the border may be usable
        again = cells.drawn(rng)
        better = ~good & usable(again)
        points[better] = again[better]
        good |= better
    found = points[good]
    if len(found) > count:  # of a band that is narrower than a cell
        found = found[np.linspace(0, len(found) - 1, count).round().astype(int)]
    return found
