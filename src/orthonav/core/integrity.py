"""Integrity of a position: the probability of an error beyond a limit, and the limit for a risk.

A position is off because its place is wrong, or because a right place is measured badly. Errors of
right places have heavier tails than a Gaussian of the stated covariance: they follow a bivariate
Student distribution (docs/decisions/integrity.md)."""

import math

import numpy as np
from numpy.typing import NDArray

DEGREES = 5.0
"""Degrees of freedom of the distribution of errors."""
STEPS = 40  # of bisection: 1e-12 of the interval
_QUADRANT = np.cos((np.arange(16) + 0.5) * np.pi / 32) ** 2

Array = NDArray[np.float64]


def probability_beyond(cov_en_m2: Array, limit_m: float) -> float:
    """That the error of a right place exceeds a limit; NaN for an unknown covariance."""
    if not np.isfinite(cov_en_m2).all():
        return math.nan
    return float(_beyond(_scales_m2(np.asarray(cov_en_m2)[None]), np.array([limit_m]))[0])


def probability_within(place_probability: float, cov_en_m2: Array, limit_m: float) -> float:
    """That a place is right and its error at most a limit; NaN for an unknown covariance."""
    return place_probability * (1 - probability_beyond(cov_en_m2, limit_m))


def protection_level_m(place_probability: float, cov_en_m2: Array, risk: float) -> float:
    """Smallest limit that the error exceeds with a probability of at most `risk`.

    `place_probability`: that the place is right. Infinite where a wrong place alone is likelier
    than that, and for an unknown covariance. Raises `ValueError` unless `risk` is 0 to 1."""
    place, covs = np.array([place_probability]), np.asarray(cov_en_m2)[None]
    return float(protection_levels_m(place, covs, risk)[0])


def protection_levels_m(place_probability: Array, covs_en_m2: Array, risk: float) -> Array:
    """The same (N,) of many: probabilities (N,) and covariances (N, 2, 2)."""
    if not 0 <= risk <= 1:
        raise ValueError(f"a risk is a probability, 0 to 1, got {risk}")
    levels = np.full(len(place_probability), math.inf)
    finite = np.isfinite(covs_en_m2).all(axis=(1, 2)) & (risk - (1 - place_probability) > 0)
    place, scales = place_probability[finite], _scales_m2(covs_en_m2[finite])
    allowed = np.minimum((risk - (1 - place)) / place, 1.0)
    deviations = np.sqrt(DEGREES * (allowed ** (-2 / DEGREES) - 1))
    low, high = (np.sqrt(each(axis=1)) * deviations for each in (scales.min, scales.max))
    for _ in range(STEPS):
        middle = (low + high) / 2
        met = _beyond(scales, middle) <= allowed
        low, high = np.where(met, low, middle), np.where(met, middle, high)
    levels[finite] = high
    return levels


def _scales_m2(covs_en_m2: Array) -> Array:
    """Squared scales (N, 16) of errors along directions that are equally likely."""
    values = np.maximum(np.linalg.eigvalsh(covs_en_m2), 0.0)[:, :, None]
    minor, major = values[:, 0], values[:, 1]
    return np.asarray((minor + (major - minor) * _QUADRANT) * (DEGREES - 2) / DEGREES)


def _beyond(scales_m2: Array, limits_m: Array) -> Array:
    """Probability (N,) that errors of these scales (N, 16) exceed their limits (N,)."""
    squares = limits_m[:, None] ** 2 / (DEGREES * np.maximum(scales_m2, 1e-12))
    return np.asarray(((1 + squares) ** (-DEGREES / 2)).mean(axis=1))
