"""Calibration of `confidence` and consistency of `cov_en_m2`.

A fix states the probability that its error is below its own `radius_m`. In this module a fix is
therefore *right* if its error is at most that radius, or, if it states none (null, or not a
positive finite number), at most the radius of the evaluation.

Arrays only: no records, no files, no plots. Undefined figures are NaN.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.ground.evaluate.figures import FloatArray, frozen, mean, root, share_of, wilson

N_BINS = 10
NEES_LEVELS = (0.5, 0.9, 0.99)
_LEAST_INDEPENDENCE = 1e-12  # of east and north, 1 - rho^2: below it a covariance is singular
_ASYMMETRY = 1e-6  # fraction of the largest element that two mirrored ones may differ by


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
class CovarianceConsistency:
    """Agreement of stated covariances with the errors of the right fixes.

    `n_without`: right fixes without covariance, or with null values in it; `n_unusable`: with one
    that is singular, not positive definite or not symmetric.
    `nees` (K,): normalized estimation error squared e^T C^-1 e of the others, ascending.
    `within`: for each of `NEES_LEVELS` the fraction of `nees` inside its bound.
    """

    n_right: int
    n_without: int
    n_unusable: int
    nees: FloatArray
    nees_mean: float
    nees_median: float
    within: Mapping[float, float]


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
    without a confidence or an error are left out. Raises `ValueError` for a confidence that is not
    0 to 1.
    """
    known = ~np.isnan(confidence) & np.isfinite(errors_m)
    stated = confidence[known]
    if not np.all((stated >= 0.0) & (stated <= 1.0)):
        raise ValueError(f"a confidence must be 0 to 1, got {stated.min():g} to {stated.max():g}")
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
) -> CovarianceConsistency:
    """Consistency of `cov_en_m2` (N, 2, 2) with `errors_en_m` (N, 2), NaN where there is no fix.

    Only right fixes count: the covariance describes a right fix, and the confidence whether a fix
    is right. If C is the covariance of the right ones, the mean of e^T C^-1 e is 2;
    if they are Gaussian too, it follows chi-square with 2 degrees of freedom (Bar-Shalom et al.,
    "Estimation with applications to tracking and navigation", 2001, section 5.4). Larger values
    mean a covariance that is too small. Where `radius_m` is less than about three standard
    deviations, right fixes have no tails, and more than 99 % lie inside the outer bound.
    """
    errors_m = np.hypot(errors_en_m[:, 0], errors_en_m[:, 1])
    right = errors_m <= stated_radius_m(own_radius_m, radius_m)  # NaN is never right
    cov_en_m2 = cov_en_m2[right]
    without = np.isnan(cov_en_m2).any(axis=(1, 2))
    usable = is_covariance(cov_en_m2)
    nees = np.sort(normalized_squared(errors_en_m[right][usable], cov_en_m2[usable]))
    return CovarianceConsistency(
        n_right=int(np.count_nonzero(right)),
        n_without=int(np.count_nonzero(without)),
        n_unusable=int(np.count_nonzero(~usable & ~without)),
        nees=frozen(nees),
        nees_mean=mean(nees),
        nees_median=float(np.median(nees)) if nees.size else math.nan,
        within={level: share_of(nees <= nees_bound(level)) for level in NEES_LEVELS},
    )


def is_covariance(cov_en_m2: FloatArray) -> NDArray[np.bool_]:
    """(N,): which of (N, 2, 2) are finite, symmetric, positive definite and well conditioned."""
    east, north = cov_en_m2[:, 0, 0], cov_en_m2[:, 1, 1]
    with np.errstate(all="ignore"):
        largest = np.maximum(east, north)
        even = np.abs(cov_en_m2[:, 0, 1] - cov_en_m2[:, 1, 0]) <= _ASYMMETRY * largest
        independence = 1.0 - _correlation(cov_en_m2) ** 2
        usable: NDArray[np.bool_] = (
            np.isfinite(cov_en_m2).all(axis=(1, 2))
            & ((east > 0.0) & (north > 0.0))
            & (even & (independence > _LEAST_INDEPENDENCE))
        )
    return usable


def normalized_squared(errors_en_m: FloatArray, cov_en_m2: FloatArray) -> FloatArray:
    """(N,) e^T C^-1 e of (N, 2) errors and (N, 2, 2) positive definite covariances, no unit."""
    rho = _correlation(cov_en_m2)
    with np.errstate(over="ignore"):  # infinite where the covariance is next to nothing
        east = errors_en_m[:, 0] / np.sqrt(cov_en_m2[:, 0, 0])
        north = errors_en_m[:, 1] / np.sqrt(cov_en_m2[:, 1, 1])
        # as a sum of squares: never negative, whatever the rounding
        squared: FloatArray = north**2 + (east - rho * north) ** 2 / (1.0 - rho**2)
    return squared


def nees_bound(level: float) -> float:
    """The `level` quantile of chi-square with 2 degrees of freedom."""
    return -2.0 * math.log1p(-level)


def nees_mean_bounds(n: float) -> tuple[float, float]:
    """The 95 % interval of the mean NEES of `n` independent views; NaN for none.

    Its sum is chi-square distributed with 2 n degrees of freedom.
    """
    if not n > 0:
        return math.nan, math.nan
    wide = 20 * math.sqrt(n) + 40  # the series has converged, and 97.5 % are below
    logs = np.cumsum(np.log(n + np.arange(1, math.ceil(wide + wide) + math.ceil(n))))
    powers = np.arange(len(logs) + 1)
    logs = np.concatenate([[0.0], logs]) + math.lgamma(n + 1)

    def share_below(half: float) -> float:  # the incomplete gamma function, by its series
        return float(np.exp((n + powers) * math.log(half) - half - logs).sum())

    low, high = (2 / n * root(share_below, p, n + wide) for p in (0.025, 0.975))
    return low, high


def _correlation(cov_en_m2: FloatArray) -> FloatArray:
    scale = np.sqrt(cov_en_m2[:, 0, 0]) * np.sqrt(cov_en_m2[:, 1, 1])
    rho: FloatArray = 0.5 * (cov_en_m2[:, 0, 1] + cov_en_m2[:, 1, 0]) / scale
    return rho


def _is_radius(own_radius_m: FloatArray) -> NDArray[np.bool_]:
    return np.isfinite(own_radius_m) & (own_radius_m > 0.0)


def _bin(lower: float, upper: float, stated: FloatArray, right: NDArray[np.bool_]) -> Bin:
    n_right = int(np.count_nonzero(right))
    low, high = wilson(n_right, stated.size)
    return Bin(lower, upper, stated.size, mean(stated), share_of(right), low, high)
