"""Metrics of a tracked flight (`ViewResult.state`), given ground truth.

States and confidence are those of all results, errors those of the views with a true position. A
view represents the time and the path until the next one. Where times are unknown or do not rise,
figures in seconds are undefined: NaN, and null in JSON.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.flight.fixes import STATES
from orthonav.core.flight.gnss import biases_of, fault_of, gnss_of
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, ViewResult
from orthonav.ground.evaluate.metrics import FAR_M, Comparison, places_en_m
from orthonav.ground.evaluate.statistics import (
    BoolArray,
    Consistency,
    ErrorStatistics,
    FloatArray,
    Longest,
    consistency,
    error_statistics,
    frozen,
    is_covariance,
    longest,
    longest_stretch,
    nees_bound,
    path_so_far_m,
    percentile,
    runs,
    seconds_since_first,
    share_of,
)

RADII_M = (25.0, 60.0)
COURSE_M = 5.0
"""Minimum distance over which a course is measured, in the median."""
STILL_M = 1.0
"""Below this distance the aircraft is stationary and has no course."""


@dataclass(frozen=True)
class After:
    """Errors from the first confirmed fix on, in any state."""

    n_views: int
    n_fixes: int
    error_median_m: float
    error_p95_m: float
    error_max_m: float
    acc_at_m: Mapping[float, float]


@dataclass(frozen=True, eq=False)
class TrackSeries:
    """Time series over the compared views (N,), for figures.

    `sigma_m`: standard deviation along the longer axis of the covariance; `bound_95_m`: the same
    axis of the 95 % ellipse.
    `along_m`, `across_m`: error ahead and to the right of the true position.
    `wrong`: the views that `n_confident_wrong` counts.
    """

    seconds_s: FloatArray
    states: tuple[str, ...]
    sigma_m: FloatArray
    bound_95_m: FloatArray
    along_m: FloatArray
    across_m: FloatArray
    wrong: BoolArray


@dataclass(frozen=True, eq=False)
class TrackMetrics:
    """Metrics of one track.

    `first_view`, `first_s`: number (from 1) and time of the first confirmed fix, that is, one in
    state tracking.
    `low_confidence`: longest stretch without a confident fix (not tracking, or not confident);
    `low_confidence_after`: the same from the first confirmed fix on.
    `n_confident_wrong`: views that are tracking, or confident, with an error above `far_m` and
    above the radius that the fix states; `n_false_locks`: stretches of such views.
    `along`, `across`: signed errors ahead and to the right, of the tracking views.
    """

    n_views: int
    first_view: float
    first_s: float
    after: After
    share_of_views: Mapping[str, float]
    share_of_time: Mapping[str, float]
    n_lost: int
    low_confidence: Longest
    low_confidence_after: Longest
    far_m: float
    n_confident_wrong: int
    n_false_locks: int
    false_lock_longest_s: float
    along: ErrorStatistics
    across: ErrorStatistics
    consistency: Consistency
    series: TrackSeries


def measure_track(
    comparison: Comparison, results: Sequence[ViewResult], radius_m: float
) -> TrackMetrics | None:
    """All metrics of a track; None where no result has a state."""
    if not any(result.state for result in results):
        return None
    number = {result.frame: i for i, result in enumerate(results)}
    rows = np.array([number[frame] for frame in comparison.frames], dtype=np.intp)
    states = np.array([result.state or "" for result in results])
    seconds_s = seconds_since_first([result.time_ns for result in results])
    path_m = np.interp(np.arange(len(results)), rows, path_so_far_m(comparison.truth_en_m))
    confident = np.array([result.is_confident for result in results])
    tracking = states == "tracking"
    confirmed = tracking & np.array([isinstance(result.outcome, Fix) for result in results])
    first = int(np.argmax(confirmed)) if confirmed.any() else len(results)
    far_m = max(FAR_M, radius_m)
    wrong = (confident | tracking)[rows] & (
        comparison.errors_m > np.fmax(far_m, comparison.own_radius_m)
    )
    low_confidence = ~(tracking & confident)
    found = first < len(results)
    after_m = comparison.errors_m[rows >= first]
    series = _series(comparison, states[rows].tolist(), seconds_s[rows], wrong)
    return TrackMetrics(
        n_views=len(results),
        first_view=first + 1 if found else math.nan,
        first_s=float(seconds_s[first]) if found else math.nan,
        after=After(
            n_views=after_m.size,
            n_fixes=int(np.isfinite(after_m).sum()),
            error_median_m=percentile(after_m, 50.0),
            error_p95_m=percentile(after_m, 95.0),
            error_max_m=percentile(after_m, 100.0),
            acc_at_m={r: share_of(after_m <= r) for r in sorted({float(radius_m), *RADII_M})},
        ),
        share_of_views=_shares(states, np.ones(len(states))),
        share_of_time=_shares(states, np.append(np.diff(seconds_s), 0.0)),
        n_lost=len(runs(states == "lost")),
        low_confidence=longest(low_confidence, seconds_s, path_m),
        low_confidence_after=longest(low_confidence[first:], seconds_s[first:], path_m[first:]),
        far_m=far_m,
        n_confident_wrong=int(np.count_nonzero(wrong)),
        n_false_locks=len(runs(wrong)),
        false_lock_longest_s=longest_stretch(wrong, seconds_s[rows]),
        along=error_statistics(series.along_m[tracking[rows]]),
        across=error_statistics(series.across_m[tracking[rows]]),
        consistency=consistency(  # of consecutive views, which are correlated
            (comparison.fix_en_m - comparison.truth_en_m)[tracking[rows]],
            comparison.cov_en_m2[tracking[rows]],
            effective_number,
        ),
        series=series,
    )


def course_en(truth_en_m: FloatArray) -> FloatArray:
    """(N, 2) unit vectors of the course, east and north; NaN where the aircraft stands still.

    Central differences of true positions (N, 2), over 1, 2, 4.. views to either side: the fewest
    over which at least half of the views move by `COURSE_M`.
    """
    number = np.arange(len(truth_en_m))
    last, reach = len(number) - 1, 1
    while True:
        ends = np.minimum(number + reach, last), np.maximum(number - reach, 0)
        path_m = truth_en_m[ends[0]] - truth_en_m[ends[1]]
        length_m = np.hypot(path_m[:, 0], path_m[:, 1])
        if 2 * reach > last // 4 or np.median(length_m) >= COURSE_M:
            break
        reach *= 2
    moves = length_m >= STILL_M
    course = np.full(path_m.shape, math.nan)
    course[moves] = path_m[moves] / length_m[moves, None]
    return course


def effective_number(whitened: FloatArray) -> float:
    """The effective number of independent views for the mean NEES, 1 to N.

    `whitened` (N, 2) are consecutive errors in units of their covariance, two independent parts.
    If these are Gaussian with autocorrelation r_k, their squares have autocorrelation r_k^2
    (Isserlis 1918), so the variance of the mean of N squares is tau / N times that of one, with

        tau = 1 + 2 sum over k of (1 - k / N) r_k^2,    effective number N / tau,

    the mean of both parts. r_k is estimated about zero, since right errors have no bias: a bias is
    one error seen N times. The sum ends before the first r_k that is not positive, where the
    estimate is noise (Geyer, "Practical Markov chain Monte Carlo", 1992, truncates alike).
    """
    n = len(whitened)
    if n < 2:
        return float(n)
    tau = np.mean([_autocorrelation_time(part) for part in whitened.T])
    return float(np.clip(n / tau, 1.0, n))


def _autocorrelation_time(part: FloatArray) -> float:
    """`tau` of `effective_number`, 1 to N, of one part (N,)."""
    n = part.size
    with np.errstate(over="ignore", invalid="ignore"):  # covariances may be next to nothing
        power = np.abs(np.fft.rfft(part, 2 * n)) ** 2
        products = np.fft.irfft(power)[:n] / np.arange(n, 0, -1)
    if not (np.isfinite(products).all() and products[0] > 0.0):
        return float(n)  # always the same
    correlation = np.minimum(products[1:] / products[0], 1.0)
    ends = np.flatnonzero(correlation <= 0.0)
    stop = int(ends[0]) if ends.size else n - 1
    weights = 1.0 - np.arange(1, stop + 1) / n
    return 1.0 + 2.0 * float(weights @ correlation[:stop] ** 2)


def _shares(states: NDArray[np.str_], weights: FloatArray) -> Mapping[str, float]:
    whole = float(weights.sum())
    found = {name: float(weights[states == name].sum()) for name in STATES}
    known = whole > 0.0  # not NaN
    return {name: part / whole if known else math.nan for name, part in found.items()}


def _series(
    comparison: Comparison, states: Sequence[str], seconds_s: FloatArray, wrong: BoolArray
) -> TrackSeries:
    errors_en_m = comparison.fix_en_m - comparison.truth_en_m
    course = course_en(comparison.truth_en_m)
    right = np.stack([course[:, 1], -course[:, 0]], axis=1)
    usable = is_covariance(comparison.cov_en_m2)
    sigma_m = np.full(len(states), math.nan)
    sigma_m[usable] = np.sqrt(np.linalg.eigvalsh(comparison.cov_en_m2[usable])[:, 1])
    return TrackSeries(
        seconds_s=frozen(seconds_s),
        states=tuple(states),
        sigma_m=frozen(sigma_m),
        bound_95_m=frozen(sigma_m * math.sqrt(nees_bound(0.95))),
        along_m=frozen((errors_en_m * course).sum(axis=1)),
        across_m=frozen((errors_en_m * right).sum(axis=1)),
        wrong=wrong,
    )


@dataclass(frozen=True, eq=False)
class GnssMetrics:
    """GNSS and map against ground truth, over the compared views (N,); NaN where one is missing.

    `differences_m`: distance between GNSS and fix; `faults`: reason of the monitor, "" without one.
    `learnt`: biases of GNSS minus map at the last view that has them, by their keys in evidence.
    """

    seconds_s: FloatArray
    errors_m: FloatArray
    map_errors_m: FloatArray
    differences_m: FloatArray
    faults: tuple[str, ...]
    learnt: Mapping[str, float]

    @property
    def alarms(self) -> tuple[tuple[int, int], ...]:
        """First view of each stretch with a fault, and the first one after it."""
        return tuple(runs(np.array([bool(each) for each in self.faults], dtype=bool)))


def measure_gnss(comparison: Comparison, results: Sequence[ViewResult]) -> GnssMetrics | None:
    by_frame = {result.frame: result.outcome.evidence for result in results}
    evidence = [by_frame[frame] for frame in comparison.frames]
    places = [gnss_of(each) for each in evidence]
    if not any(places):
        return None
    en_m = places_en_m(LocalFrame(comparison.lat_deg, comparison.lon_deg), places)
    return GnssMetrics(
        seconds_since_first(comparison.time_ns),
        frozen(np.hypot(*(en_m - comparison.truth_en_m).T)),
        comparison.errors_m,
        frozen(np.hypot(*(en_m - comparison.fix_en_m).T)),
        tuple(fault_of(each) for each in evidence),
        next((found for each in reversed(evidence) if (found := biases_of(each))), {}),
    )
