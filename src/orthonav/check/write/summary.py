"""The key figures of a check, the same on the page, in the terminal and in JSON."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.check.outcome import CheckResult
from orthonav.records import CONFIDENT

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Summary:
    """Key figures, as `check.json` has them; without a route those of one are NaN, 0 or None.

    `route_share_from_0_9`: share of the length with a probability of `CONFIDENT` or more, 0 to 1.
    `error_m`: expected error of a correct fix (root mean square), along the route or over the map.
    `unrecoverable_stretches`: number of blind stretches without recovery.
    `longest_stretch`: number of the longest blind stretch, from 1.
    """

    area_km2: float
    second_date: bool
    mean_probability: float
    error_m: float
    route_m: float
    route_s: float
    route_share_from_0_9: float
    blind_stretches: int
    unrecoverable_stretches: int
    longest_stretch: int | None


def summarize(result: CheckResult) -> Summary:
    """The key figures of a check."""
    along, cells, stretches = result.along, result.cells, result.stretches
    route_m = share = math.nan
    if along is None or not len(along.distance_m):
        error_m = _rms(cells.error_m.ravel(), cells.probability.ravel())
    else:
        route_m = float(along.distance_m[-1] - along.distance_m[0])
        weights = _length_per_point_m(along.distance_m)
        known = np.isfinite(along.probability)
        confident = np.where(known, along.probability, 0.0) >= CONFIDENT
        share = float(weights[confident].sum() / weights.sum()) if known.any() else math.nan
        error_m = _rms(along.error_m, weights * np.nan_to_num(along.probability))
    longest = max(stretches, key=lambda each: each.length_m, default=None)
    return Summary(
        area_km2=result.area_km2,
        second_date=result.second_date,
        mean_probability=result.mean,
        error_m=error_m,
        route_m=route_m,
        route_s=route_m / result.conditions.speed_mps,
        route_share_from_0_9=share,
        blind_stretches=len(stretches),
        unrecoverable_stretches=sum(not each.recoverable for each in stretches),
        longest_stretch=None if longest is None else stretches.index(longest) + 1,
    )


def _length_per_point_m(distance_m: Array) -> Array:
    """Length of the route (N,) that each of its points represents."""
    if len(distance_m) < 2:
        return np.ones(len(distance_m))
    steps = np.diff(distance_m)
    return np.asarray(np.concatenate([steps[:1], steps[1:] + steps[:-1], steps[-1:]]) / 2)


def _rms(values: Array, weights: Array) -> float:
    """Weighted root mean square of the known values; NaN for none."""
    known = np.isfinite(values) & np.isfinite(weights) & (weights > 0)
    if not known.any():
        return math.nan
    return float(np.sqrt(np.average(values[known] ** 2, weights=weights[known])))
