"""Where a check looks: the ground of a map, all of it or the band of a route, in square cells."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.errors import AreaError
from orthonav.geo.area import Area, Extent
from orthonav.geo.grid import TileGrid
from orthonav.register.reference import GreyPyramid

MOST_CELLS = 4000
CELLS_PER_VIEW = 4.0
"""Cells are this much smaller than a view, where there are not too many of them."""
LEAST_TRIALS, MOST_TRIALS = 240, 1500
TRIALS_PER_VIEW = 4.0
"""Trials per ground that a view covers, within those limits."""
FEWEST_TRIALS = 40
"""Whatever the effort."""
MASK_PX = 2048
_TRIES = 6
_PROBES_ACROSS, _PROBES_PER_BAND, _MOST_PROBES = 400, 4, 1_000_000
_MOST_DRAWN = 1_000_000

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Ground:
    """Where a map shows ground: `valid` (rows, cols) of `pixel_m`, with its north-west corner."""

    west_m: float
    north_m: float
    pixel_m: float
    valid: NDArray[np.bool_]

    @classmethod
    def of(cls, layer: GreyPyramid, grid: TileGrid) -> "Ground":
        """Of the registration layer of a sheet, thinned."""
        level = 0
        while level < layer.levels - 1 and max(layer.shape(level)) > MASK_PX:
            level += 1
        rows, cols = layer.shape(level)
        _, valid = layer.read(level, 0, 0, rows, cols)
        return cls(grid.west_m, grid.north_m, grid.gsd_m * 2**level, valid)

    def shown(self, points_en_m: Array) -> NDArray[np.bool_]:
        """Which of points (N, 2) lie on ground that the map shows."""
        cols = np.floor((points_en_m[:, 0] - self.west_m) / self.pixel_m).astype(int)
        rows = np.floor((self.north_m - points_en_m[:, 1]) / self.pixel_m).astype(int)
        height, width = self.valid.shape
        inside = (rows >= 0) & (cols >= 0) & (rows < height) & (cols < width)
        found = np.zeros(len(points_en_m), np.bool_)
        found[inside] = self.valid[rows[inside], cols[inside]]
        return found

    def seen(self, points_en_m: Array, side_m: float) -> Array:
        """Share (N,) that the map shows of what views of a side see from over points (N, 2)."""
        side = max(1, round(side_m / self.pixel_m))
        shown = cv2.blur(
            np.pad(self.valid.astype(np.float32), side),
            (side, side),
            borderType=cv2.BORDER_CONSTANT,
        )
        cols = (points_en_m[:, 0] - self.west_m) / self.pixel_m + side
        rows = (self.north_m - points_en_m[:, 1]) / self.pixel_m + side
        height, width = shown.shape
        inside = (rows >= 0) & (cols >= 0) & (rows < height) & (cols < width)
        found = np.zeros(len(points_en_m))
        found[inside] = shown[rows[inside].astype(int), cols[inside].astype(int)]
        return found

    def share_shown(self, lattice: "Lattice") -> Array:
        """Share (rows, cols) of every cell that the map shows."""
        scale = lattice.side_m / self.pixel_m
        shift = np.array([lattice.west_m - self.west_m, self.north_m - lattice.north_m])
        left, top = shift / self.pixel_m
        # One sample a quarter of a cell: enough for a share.
        fine = 4
        matrix = np.array(
            [
                [scale / fine, 0, left + scale / fine / 2 - 0.5],
                [0, scale / fine, top + scale / fine / 2 - 0.5],
            ]
        )
        size = (lattice.cols * fine, lattice.rows * fine)
        seen = cv2.warpAffine(
            self.valid.astype(np.float32),
            matrix,
            size,
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )
        parts = np.asarray(seen).reshape(lattice.rows, fine, lattice.cols, fine)
        return np.asarray(parts.mean(axis=(1, 3)), dtype=np.float64)

    @property
    def extent_en_m(self) -> Extent:
        """West, south, east, north of the ground that is shown."""
        rows, cols = np.flatnonzero(self.valid.any(axis=1)), np.flatnonzero(self.valid.any(axis=0))
        if not len(rows):
            raise AreaError("the map shows no ground at all")
        return (
            self.west_m + cols[0] * self.pixel_m,
            self.north_m - (rows[-1] + 1) * self.pixel_m,
            self.west_m + (cols[-1] + 1) * self.pixel_m,
            self.north_m - rows[0] * self.pixel_m,
        )

    @property
    def area_m2(self) -> float:
        """How much is shown."""
        return float(self.valid.sum()) * self.pixel_m**2


@dataclass(frozen=True)
class Lattice:
    """Square cells, row 0 in the north."""

    west_m: float
    north_m: float
    side_m: float
    rows: int
    cols: int

    @classmethod
    def over(cls, extent: Extent, side_m: float) -> "Lattice":
        """Cells over an extent (west, south, east, north)."""
        west, south, east, north = extent
        rows, cols = (max(1, math.ceil(d / side_m - 1e-9)) for d in (north - south, east - west))
        return cls(west, north, side_m, rows, cols)

    @property
    def centres_en_m(self) -> Array:
        """Middles (rows * cols, 2) of the cells, row by row."""
        east = self.west_m + (np.arange(self.cols) + 0.5) * self.side_m
        north = self.north_m - (np.arange(self.rows) + 0.5) * self.side_m
        return np.stack(np.meshgrid(east, north), axis=-1).reshape(-1, 2)

    def drawn(self, rng: np.random.Generator) -> Array:
        """A point at random in every cell (rows * cols, 2)."""
        off = rng.uniform(-0.5, 0.5, (self.rows * self.cols, 2)) * self.side_m
        return np.asarray(self.centres_en_m + off)


def checked_extent(ground: Ground, area: Area | None) -> Extent:
    """What is looked at: the band of a route, beyond the map too, or all that the map shows.

    Raises `AreaError` where the band does not touch the ground that the map shows.
    """
    if area is None:
        return ground.extent_en_m
    if not looked_at_m2(ground, area):
        raise AreaError(
            "the route's band lies nowhere on the map: another map, or latitude and longitude "
            "exchanged?"
        )
    return area.extent_en_m


def looked_at_m2(ground: Ground, area: Area | None) -> float:
    """How much of the ground that a map shows lies in an area; all of it without one."""
    if area is None:
        return ground.area_m2
    west, south, east, north = area.extent_en_m
    side_m = max(east - west, north - south) / _PROBES_ACROSS
    if area.route is not None:
        side_m = min(side_m, min(area.route.bands_m(area.band_m) or (1.0,)) / _PROBES_PER_BAND)
    side_m = max(side_m, math.sqrt((east - west) * (north - south) / _MOST_PROBES))
    points = Lattice.over(area.extent_en_m, side_m).centres_en_m
    return float((area.contains(points) & ground.shown(points)).sum()) * side_m**2


def cell_side_m(area_m2: float, view_side_m: float) -> float:
    """Side of cells for views of a side over an area: few enough to compute and to look at."""
    return max(view_side_m / CELLS_PER_VIEW, math.sqrt(area_m2 / MOST_CELLS))


def trial_places(
    ground: Ground,
    area: Area | None,
    extent: Extent,
    view_side_m: float,
    effort: float,
    rng: np.random.Generator,
) -> Array:
    """Places (N, 2) spread evenly at random over the ground that is looked at."""
    wanted_m2 = looked_at_m2(ground, area)
    per_view = wanted_m2 / view_side_m**2
    count = min(max(TRIALS_PER_VIEW * per_view, LEAST_TRIALS), MOST_TRIALS) * effort
    side_m = math.sqrt(wanted_m2 / max(count, FEWEST_TRIALS))
    all_m2 = (extent[2] - extent[0]) * (extent[3] - extent[1])
    lattice = Lattice.over(extent, max(side_m, math.sqrt(all_m2 / _MOST_DRAWN)))
    points = lattice.drawn(rng)
    good = _good(points, ground, area)
    for _ in range(_TRIES):  # cells on the border: another point of theirs may be good
        again = lattice.drawn(rng)
        better = ~good & _good(again, ground, area)
        points[better] = again[better]
        good |= better
    return points[good]


def _good(points: Array, ground: Ground, area: Area | None) -> NDArray[np.bool_]:
    shown = ground.shown(points)
    return shown if area is None else shown & area.contains(points)
