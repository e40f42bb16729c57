"""The few figures that stand for a whole check, the same on page, terminal and in JSON."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.check.outcome import Along, CheckResult, Stretch
from orthonav.records import CONFIDENT

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Summary:
    """Figures of a check; those of the route are NaN or None where there is none.

    `confident_share` is the share of the route's length with a probability of `CONFIDENT` or more,
    `error_m` the root mean square error expected of a correct fix, along the route or over the map.
    """

    route_m: float
    route_s: float
    confident_share: float
    error_m: float
    longest: Stretch | None
    unbearable: int


def summarize(result: CheckResult) -> Summary:
    """The figures of a check."""
    along, cells = result.along, result.cells
    if along is None or not len(along.distance_m):
        error_m = _rms(cells.error_m.ravel(), cells.probability.ravel())
        return Summary(math.nan, math.nan, math.nan, error_m, None, 0)
    length_m = float(along.distance_m[-1] - along.distance_m[0])
    weights = stood_for_m(along.distance_m)
    known = np.isfinite(along.probability)
    sure = np.where(known, along.probability, 0.0) >= CONFIDENT
    return Summary(
        route_m=length_m,
        route_s=length_m / result.conditions.speed_mps,
        confident_share=float(weights[sure].sum() / weights.sum()) if known.any() else math.nan,
        error_m=_rms(along.error_m, weights * np.nan_to_num(along.probability)),
        longest=max(result.stretches, key=lambda each: each.length_m, default=None),
        unbearable=sum(not each.bearable for each in result.stretches),
    )


def stood_for_m(distance_m: Array) -> Array:
    """Metres of the route (N,) that each of its points stands for."""
    if len(distance_m) < 2:
        return np.ones(len(distance_m))
    steps = np.diff(distance_m)
    return np.asarray(np.concatenate([steps[:1], steps[1:] + steps[:-1], steps[-1:]]) / 2)


def interval_along(result: CheckResult, along: Along) -> tuple[Array, Array]:
    """Low and high (N,) along the route: those told, else of the cells below; NaN outside them."""
    if along.low is not None and along.high is not None:
        return along.low, along.high
    return at_points(result, result.cells.low, along), at_points(result, result.cells.high, along)


def at_points(result: CheckResult, values: Array, along: Along) -> Array:
    """Values (rows, cols) of the cells at points (N,) of the route; NaN outside them."""
    cells = result.cells
    east, north = along.points_en_m.T
    cols = np.floor((east - cells.west_m) / cells.side_m).astype(np.intp)
    rows = np.floor((cells.north_m - north) / cells.side_m).astype(np.intp)
    height, width = values.shape
    inside = (rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)
    found = np.full(len(rows), np.nan)
    found[inside] = values[rows[inside], cols[inside]]
    return found


def _rms(values: Array, weights: Array) -> float:
    """Weighted root mean square of those that are known; NaN where none is."""
    known = np.isfinite(values) & np.isfinite(weights) & (weights > 0)
    if not known.any():
        return math.nan
    return float(np.sqrt(np.average(values[known] ** 2, weights=weights[known])))
