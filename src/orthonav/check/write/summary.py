"""The key figures of a check, the same on the page, in the terminal and in JSON."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.check.outcome import BlindStretch, CheckResult
from orthonav.records import CONFIDENT

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Summary:
    """Key figures; those of a route are NaN or None without one.

    `route_m`, `route_s`: length and duration.
    `confident_share`: share of the length with a probability of `CONFIDENT` or more, 0 to 1.
    `error_m`: expected error of a correct fix (root mean square), along the route or over the map.
    `longest`: longest blind stretch; `unrecoverable`: number of stretches without recovery.
    """

    route_m: float
    route_s: float
    confident_share: float
    error_m: float
    longest: BlindStretch | None
    unrecoverable: int


def summarize(result: CheckResult) -> Summary:
    """The key figures of a check."""
    along, cells = result.along, result.cells
    if along is None or not len(along.distance_m):
        error_m = _rms(cells.error_m.ravel(), cells.probability.ravel())
        return Summary(math.nan, math.nan, math.nan, error_m, None, 0)
    length_m = float(along.distance_m[-1] - along.distance_m[0])
    weights = _length_per_point_m(along.distance_m)
    known = np.isfinite(along.probability)
    confident = np.where(known, along.probability, 0.0) >= CONFIDENT
    share = float(weights[confident].sum() / weights.sum()) if known.any() else math.nan
    return Summary(
        route_m=length_m,
        route_s=length_m / result.conditions.speed_mps,
        confident_share=share,
        error_m=_rms(along.error_m, weights * np.nan_to_num(along.probability)),
        longest=max(result.stretches, key=lambda each: each.length_m, default=None),
        unrecoverable=sum(not each.recoverable for each in result.stretches),
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
