"""Heights of the ground as a function of positions, and their mean and spread over an area."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.frames import LocalFrame

Array = NDArray[np.float64]
TerrainHeights = Callable[[Array, Array], Array]
"""Of latitudes and longitudes (deg): heights above mean sea level (m), NaN where unknown."""
LOWEST_M, HIGHEST_M = -500.0, 9000.0
"""Heights above mean sea level: the Dead Sea is at -430 m, Mount Everest at 8,849."""
RELIEF_SLOPES = {"level": 0.01, "rolling": 0.05, "hills": 0.12}
"""RMS gradient of ground whose heights are unknown, by what a map says of it."""
DEFAULT_RELIEF = "rolling"
SIGHT_STEPS = 512


@dataclass(frozen=True)
class Ground:
    """Heights above mean sea level around a position; `known`: share above 0 that has one."""

    height_m: float
    std_m: float
    known: float


def ground_over(terrain: TerrainHeights, lat_deg: Array, lon_deg: Array) -> Ground | None:
    """At equally probable positions; None where no height is known."""
    heights = terrain(lat_deg, lon_deg)
    known = heights[np.isfinite(heights)]
    if not known.size:
        return None
    share = known.size / heights.size
    return Ground(float(known.mean()), float(known.std()), share)


def ground_around(
    terrain: TerrainHeights, place_deg: tuple[float, float], std_m: float
) -> Ground | None:
    """Over a disc around `place_deg` (latitude, longitude); None where unknown."""
    if std_m <= 0:
        return ground_over(terrain, np.array([place_deg[0]]), np.array([place_deg[1]]))
    lat, lon = LocalFrame(*place_deg).latlon_from_en(2 * std_m * _DISC)
    return ground_over(terrain, lat, lon)


def relief_slope(relief: str | None) -> float:
    """RMS gradient of ground whose heights are unknown; `relief`: None: nobody said."""
    return RELIEF_SLOPES[relief or DEFAULT_RELIEF]


def unknown_slope_share(tilt_std_deg: float, relief: str | None = None) -> float:
    """Standard deviation per axis of the camera over ground without terrain, per metre of height.

    A slope of the ground looks like a tilt of the camera by the same angle, so that pictures
    determine only their sum. `tilt_std_deg`: of the reported pitch and roll, 0 or more."""
    slope = relief_slope(relief) / math.sqrt(2)
    tilt = math.radians(tilt_std_deg)
    return tilt * slope / math.hypot(tilt, slope)


def bilinear(
    samples: Callable[[NDArray[np.intp], NDArray[np.intp]], Array],
    shape: tuple[int, int],
    col: Array,
    row: Array,
) -> Array:
    """Heights at fractional samples (0, 0 is the first); NaN beyond half a sample outside.

    `samples` gives heights by rows and columns, those at the border for places outside, the first
    for NaN; beside an unknown one all is unknown."""
    rows, cols = shape
    with np.errstate(invalid="ignore"):
        inside = (col >= -0.5) & (col <= cols - 0.5) & (row >= -0.5) & (row <= rows - 0.5)
    all_inside = bool(inside.all())
    if not all_inside:
        col, row = np.nan_to_num(col), np.nan_to_num(row)
    col, row = np.minimum(np.maximum(col, 0), cols - 1), np.minimum(np.maximum(row, 0), rows - 1)
    left, top = col.astype(np.intp), row.astype(np.intp)
    right, bottom = np.minimum(left + 1, cols - 1), np.minimum(top + 1, rows - 1)
    x, y = col - left, row - top
    upper = (1 - x) * samples(top, left) + x * samples(top, right)
    lower = (1 - x) * samples(bottom, left) + x * samples(bottom, right)
    heights = (1 - y) * upper + y * lower
    return np.asarray(heights if all_inside else np.where(inside, heights, np.nan))


def bilinear_of(heights: Array, col: Array, row: Array) -> Array:
    """As `bilinear`, of samples (rows, cols)."""
    return bilinear(lambda rows, cols: heights[rows, cols], heights.shape, col, row)


def by_value(keys: NDArray[np.intp]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Each value of `keys` (N,), and the indices of those that have it."""
    order = np.argsort(keys, kind="stable")
    found, starts = np.unique(keys[order], return_index=True)
    return zip(found.tolist(), np.split(order, starts[1:]), strict=False)


def sight_on_ground(slope_en: Array, height_m: float, ground_m: Callable[[Array], Array]) -> Array:
    """Metres east and north (2,) where a line of sight first meets the ground, else NaN.

    `slope_en` (2,): its run per metre of descent. `ground_m`: heights at (N, 2) east and north of
    the camera, over the same level as `height_m`, down to 1000 m below."""
    below_m = float(ground_m(np.zeros((1, 2)))[0])
    drops = np.linspace(0.0, height_m - below_m + 1000.0, SIGHT_STEPS)
    above = height_m - drops - ground_m(drops[:, None] * slope_en)
    reached = np.flatnonzero(above <= 0)
    if not reached.size or reached[0] == 0 or not np.isfinite(above[: reached[0]]).all():
        return np.full(2, np.nan)
    last, first = above[reached[0] - 1], above[reached[0]]
    drop = drops[reached[0] - 1] + (drops[1] - drops[0]) * last / (last - first)
    return np.asarray(slope_en * drop)


def _disc() -> Array:
    """Points (N, 2) spread evenly over the unit disc, its centre first."""
    points, rings = [(0.0, 0.0)], 5
    for ring in range(1, rings + 1):
        # Rings of equal area per point: the radius is that of the middle of each ring.
        radius = ring / (rings + 0.5)
        turns = np.arange(6 * ring) * (2 * math.pi / (6 * ring)) + ring
        points += list(zip(radius * np.cos(turns), radius * np.sin(turns), strict=True))
    return np.array(points)


_DISC = _disc()
