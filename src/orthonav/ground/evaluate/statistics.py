"""Statistics: shares and intervals, APE, RPE, CEP50 and CEP95, calibration of `confidence` and
consistency of `cov_en_m2`.

Pose errors are horizontal: trajectories are positions in an east-north plane, with neither
alignment nor scale correction, and only views with a fix are poses of them. Definitions: evo's
documentation, https://github.com/MichaelGrupp/evo/wiki/Metrics (translation part).

A fix states the probability that its error is below its own `radius_m`. Here a fix is therefore
*right* if its error is at most that radius, or, if it states none (null, or not a positive finite
number), at most the radius of the evaluation. Undefined figures are NaN.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.extras import needed

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

N_BINS = 10
RPE_DISTANCE_M = 100.0
"""The shortest segment of the KITTI odometry benchmark (Geiger et al., CVPR 2012)."""


@dataclass(frozen=True)
class Longest:
    seconds_s: float
    path_m: float


def share(part: int | np.integer, whole: int) -> float:
    """`part` of `whole`, 0 to 1; NaN for a `whole` of 0."""
    return float(part / whole) if whole else math.nan


def share_of(flags: BoolArray, whole: int | None = None) -> float:
    return share(np.count_nonzero(flags), flags.size if whole is None else whole)


def mean(values: FloatArray) -> float:
    return float(values.mean()) if values.size else math.nan


def percentile(values: FloatArray, percent: float) -> float:
    """A percentile of the finite ones of `values` (N,); NaN for none."""
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, percent)) if finite.size else math.nan


def _stats() -> Any:
    return needed("scipy.stats", "geo", "evaluating fixes")


def wilson(part: int, whole: int) -> tuple[float, float]:
    """The 95 % interval of a share, given `part` of `whole`; NaN for a `whole` of 0.

    Wilson, "Probable inference, the law of succession, and statistical inference", 1927: unlike
    the normal interval it stays within 0 to 1 and has a width at 0 and 1.
    """
    if not whole:
        return math.nan, math.nan
    low, high = _stats().binomtest(part, whole).proportion_ci(method="wilson")
    return float(low), float(high)


def upper_bound(part: int, whole: int) -> float:
    """The one-sided 95 % upper bound of a rate, given `part` of `whole`; NaN for a `whole` of 0.

    Clopper and Pearson, "The use of confidence or fiducial limits", 1934: exact for independent
    cases; for 0 of n it is 1 - 0.05^(1 / n), about 3 / n.
    """
    if not whole:
        return math.nan
    counted = _stats().binomtest(part, whole, alternative="less")
    return float(counted.proportion_ci(method="exact").high)


def frozen(values: FloatArray | Sequence[float]) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def runs(flags: BoolArray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def seconds_since_first(times_ns: Sequence[int]) -> FloatArray:
    """(N,) seconds since the first view; all NaN where times fall or stand still.

    Nanoseconds since 1970 do not fit a float64: they are subtracted before they become one.
    """
    seconds = np.array([(time - times_ns[0]) / 1e9 for time in times_ns], dtype=np.float64)
    rises = (np.diff(seconds) >= 0.0).all() and (seconds > 0.0)[-1:].all()
    return seconds if rises or len(seconds) == 1 else np.full(len(seconds), math.nan)


def path_so_far_m(truth_en_m: FloatArray) -> FloatArray:
    steps_m = np.hypot(*np.diff(truth_en_m, axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps_m)])


def longest_stretch(flags: BoolArray, until: FloatArray) -> float:
    """The largest rise of `until` from the start of a run to its end; 0 without runs."""
    last = len(flags) - 1
    steps = [until[min(stop, last)] - until[start] for start, stop in runs(flags)]
    return float(max(steps, default=0.0 if until.size and np.isfinite(until).all() else math.nan))


def longest(flags: BoolArray, seconds_s: FloatArray, path_m: FloatArray) -> Longest:
    return Longest(longest_stretch(flags, seconds_s), longest_stretch(flags, path_m))


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of `n` errors (m), perhaps signed; NaN without any. `std_m` divides by `n`."""

    n: int
    rmse_m: float
    mean_m: float
    median_m: float
    std_m: float
    max_m: float


@dataclass(frozen=True)
class StandardFigures:
    """The standard figures of one flight.

    `ape`: absolute pose error, the distance between a fix and its true position.
    `rpe_frames`: relative pose error from each fix to the next.
    `rpe_distance`: relative pose error over `RPE_DISTANCE_M` of the true path.
    `cep50_m`, `cep95_m`: circular error probable, the radius around the true position that holds
    50 % and 95 % of the fixes.
    """

    ape: ErrorStatistics
    rpe_frames: ErrorStatistics
    rpe_distance: ErrorStatistics
    cep50_m: float
    cep95_m: float


def standard_figures(truth_en_m: FloatArray, fix_en_m: FloatArray) -> StandardFigures:
    """Standard figures of positions (N, 2) in metres, NaN where there is no fix."""
    errors_m = np.hypot(*(fix_en_m - truth_en_m).T)
    fixes = np.flatnonzero(np.isfinite(fix_en_m).all(axis=1))
    frames, distances = (
        error_statistics(np.hypot(*np.diff((fix_en_m - truth_en_m)[chosen], axis=0).T))
        for chosen in (fixes, fixes[_marks(truth_en_m[fixes])])
    )
    return StandardFigures(
        ape=error_statistics(errors_m),
        rpe_frames=frames,
        rpe_distance=distances,
        cep50_m=percentile(errors_m, 50.0),
        cep95_m=percentile(errors_m, 95.0),
    )


def error_statistics(errors_m: FloatArray) -> ErrorStatistics:
    """Of the finite ones of errors (N,)."""
    errors_m = errors_m[np.isfinite(errors_m)]
    if not errors_m.size:
        return ErrorStatistics(0, *[math.nan] * 5)
    return ErrorStatistics(
        n=errors_m.size,
        rmse_m=math.sqrt(float(np.mean(errors_m**2))),
        mean_m=float(errors_m.mean()),
        median_m=float(np.median(errors_m)),
        std_m=float(errors_m.std()),
        max_m=float(errors_m.max()),
    )


def _marks(truth_en_m: FloatArray) -> NDArray[np.intp]:
    """Indices at which the path since the index before reaches `RPE_DISTANCE_M`, as evo's
    consecutive pairs in metres, taken from the reference trajectory."""
    marks, path_m = [], 0.0
    for i, step_m in enumerate(np.hypot(*np.diff(truth_en_m, axis=0).T), start=1):
        path_m += float(step_m)
        if path_m >= RPE_DISTANCE_M:
            marks.append(i)
            path_m = 0.0
    return np.array(marks, dtype=np.intp)


# Calibration of confidence, consistency of covariance.


@dataclass(frozen=True)
class Bin:
    """Fixes of a confidence in [lower, upper), the last bin in [0.9, 1]; interval: Wilson, 95 %."""

    lower: float
    upper: float
    n_fixes: int
    mean_confidence: float
    share_right: float
    right_low: float
    right_high: float


@dataclass(frozen=True)
class ConfidenceCalibration:
    """Agreement of stated confidence with the outcome, over the fixes that state one.

    `n_own_radius`: how many state a radius of their own.
    `ece`: expected calibration error, 0 at best; above 0 for few fixes even if calibrated.
    """

    n_fixes: int
    n_own_radius: int
    ece: float
    brier: float
    mean_confidence: float
    share_right: float
    bins: tuple[Bin, ...]


@dataclass(frozen=True, eq=False)
class Consistency:
    """Agreement of covariances with `n` errors, by the normalized estimation error squared (NEES)
    e^T C^-1 e: 2 expected, more where covariances are too small.

    `n_without`: errors without covariance, or with null values in it; `n_unusable`: with one that
    is singular, not positive definite or not symmetric. `nees` (K,): of the others, ascending.
    `within`: fraction of `nees` inside the bounds of these levels.
    `n_effective`: number of independent errors that they are worth; `low`, `high`: 95 % interval of
    the mean NEES of so many, which decides the verdict.
    """

    n: int
    n_without: int
    n_unusable: int
    nees: FloatArray
    nees_mean: float
    nees_median: float
    within: Mapping[float, float]
    n_effective: float
    low: float
    high: float

    @property
    def verdict(self) -> str:
        """ "" without NEES."""
        if not self.nees.size:
            return ""
        if self.nees_mean > self.high:
            return "over-confident"
        return "under-confident" if self.nees_mean < self.low else "consistent"


def stated_radius_m(own_radius_m: FloatArray, radius_m: float) -> FloatArray:
    """(N,) metres: the radius that each fix states, or `radius_m` where it states none."""
    return np.where(_is_radius(own_radius_m), own_radius_m, radius_m)


def calibrate(
    confidence: FloatArray, errors_m: FloatArray, own_radius_m: FloatArray, radius_m: float
) -> ConfidenceCalibration:
    """Calibration of `confidence` (N,), NaN where unknown, against `errors_m` (N,).

    ECE = sum over bins b of n_b / N * |share right_b - mean confidence_b|, with `N_BINS` bins of
    equal width (Naeini et al., "Obtaining well calibrated probabilities using Bayesian binning",
    AAAI 2015; Guo et al., "On calibration of modern neural networks", ICML 2017, arXiv 1706.04599).
    A bin includes its lower edge, not its upper, so that the last bin is what a criterion of 0.9
    accepts; Guo et al. do the reverse. The Brier score is the mean of (confidence - right)^2. Views
    without a confidence or an error are left out.
    """
    known = ~np.isnan(confidence) & np.isfinite(errors_m)
    stated = confidence[known]
    right = errors_m[known] <= stated_radius_m(own_radius_m[known], radius_m)
    edges = np.arange(N_BINS + 1) / N_BINS
    place = np.searchsorted(edges[1:-1], stated, side="right")
    bins = tuple(
        _bin(float(edges[i]), float(edges[i + 1]), stated[place == i], right[place == i])
        for i in range(N_BINS)
    )
    gaps = [b.n_fixes * abs(b.share_right - b.mean_confidence) for b in bins if b.n_fixes]
    return ConfidenceCalibration(
        n_fixes=stated.size,
        n_own_radius=int(np.count_nonzero(_is_radius(own_radius_m[known]))),
        ece=sum(gaps) / stated.size if stated.size else math.nan,
        brier=mean((stated - right) ** 2),
        mean_confidence=mean(stated),
        share_right=share_of(right),
        bins=bins,
    )


def check_covariance(
    errors_en_m: FloatArray, cov_en_m2: FloatArray, own_radius_m: FloatArray, radius_m: float
) -> Consistency:
    """Consistency of `cov_en_m2` (N, 2, 2) with `errors_en_m` (N, 2), NaN where there is no fix.

    Only right fixes count: the covariance describes a right fix, and the confidence whether a fix
    is right. Where `radius_m` is less than about three standard deviations, right fixes have no
    tails, and more than 99 % lie inside the outer bound.
    """
    errors_m = np.hypot(errors_en_m[:, 0], errors_en_m[:, 1])
    right = errors_m <= stated_radius_m(own_radius_m, radius_m)  # NaN is never right
    return consistency(errors_en_m[right], cov_en_m2[right])


def consistency(
    errors_en_m: FloatArray,
    cov_en_m2: FloatArray,
    effective: Callable[[FloatArray], float] = len,
) -> Consistency:
    """Consistency of errors (N, 2) with their covariances (N, 2, 2).

    If C is the covariance of e, the mean of e^T C^-1 e is 2; if they are Gaussian too, it follows
    chi-square with 2 degrees of freedom (Bar-Shalom et al., "Estimation with applications to
    tracking and navigation", 2001, section 5.4). `effective`: number of independent errors among
    those (N, 2) in units of their covariance.
    """
    without = np.isnan(cov_en_m2).any(axis=(1, 2)) | np.isnan(errors_en_m).any(axis=1)
    usable = is_covariance(cov_en_m2) & ~without
    units = whitened(errors_en_m[usable], cov_en_m2[usable])
    with np.errstate(over="ignore"):  # infinite where a covariance is next to nothing
        nees, n_effective = np.sort((units**2).sum(axis=1)), float(effective(units))
    low, high = nees_mean_bounds(n_effective)
    return Consistency(
        n=len(errors_en_m),
        n_without=int(np.count_nonzero(without)),
        n_unusable=int(np.count_nonzero(~usable & ~without)),
        nees=frozen(nees),
        nees_mean=mean(nees),
        nees_median=percentile(nees, 50.0),
        within={level: share_of(nees <= nees_bound(level)) for level in (0.5, 0.9, 0.95, 0.99)},
        n_effective=n_effective,
        low=low,
        high=high,
    )


def is_covariance(cov_en_m2: FloatArray) -> BoolArray:
    """(N,): which of (N, 2, 2) are finite, symmetric, positive definite and well conditioned."""
    east, north = cov_en_m2[:, 0, 0], cov_en_m2[:, 1, 1]
    with np.errstate(all="ignore"):
        largest = np.maximum(east, north)
        symmetric = np.abs(cov_en_m2[:, 0, 1] - cov_en_m2[:, 1, 0]) <= 1e-6 * largest
        independence = 1.0 - (cov_en_m2[:, 1, 0] / np.sqrt(east) / np.sqrt(north)) ** 2
        usable: BoolArray = (
            np.isfinite(cov_en_m2).all(axis=(1, 2))
            & ((east > 0.0) & (north > 0.0))
            & (symmetric & (independence > 1e-12))
        )
    return usable


def whitened(errors_en_m: FloatArray, cov_en_m2: FloatArray) -> FloatArray:
    """(N, 2) errors in units of their positive definite covariance (N, 2, 2): the solution z of
    L z = e where C = L L^T."""
    lower = np.linalg.cholesky(cov_en_m2)
    return np.asarray(np.linalg.solve(lower, errors_en_m[..., None])[..., 0])


def nees_bound(level: float) -> float:
    """The `level` quantile of chi-square with 2 degrees of freedom."""
    return -2.0 * math.log1p(-level)


def nees_mean_bounds(n: float) -> tuple[float, float]:
    """The 95 % interval of the mean NEES of `n` independent views; NaN for none.

    Its sum is chi-square distributed with 2 n degrees of freedom.
    """
    if not n > 0:
        return math.nan, math.nan
    low, high = _stats().chi2.ppf([0.025, 0.975], 2 * n) / n
    return float(low), float(high)


def _is_radius(own_radius_m: FloatArray) -> BoolArray:
    return np.isfinite(own_radius_m) & (own_radius_m > 0.0)


def _bin(lower: float, upper: float, stated: FloatArray, right: BoolArray) -> Bin:
    n_right = int(np.count_nonzero(right))
    low, high = wilson(n_right, stated.size)
    return Bin(lower, upper, stated.size, mean(stated), share_of(right), low, high)
