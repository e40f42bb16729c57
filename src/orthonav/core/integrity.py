"""Integrity of a position: the probability of an error beyond a limit, and the limit for a risk.

A position is off because its place is wrong, or because a right place is measured badly. Errors of
right places have heavier tails than a Gaussian of the stated covariance: they follow a bivariate
Student distribution (docs/decisions/integrity.md)."""

import math

import numpy as np
from numpy.typing import NDArray

DEGREES = 5.0
"""Degrees of freedom of the distribution of errors."""
DEFAULT_RISK = 1e-3
"""Probability of an error beyond the protection level."""
STEPS = 40  # of bisection: 1e-12 of the interval
_QUADRANT = np.cos((np.arange(16) + 0.5) * np.pi / 32) ** 2

Array = NDArray[np.float64]


def probability_beyond(cov_en_m2: Array, limit_m: float) -> float:
    """That the error of a right place exceeds a limit; NaN for an unknown covariance."""
    scales = _scales_m2(cov_en_m2)
    return float(_beyond(scales, limit_m))


def protection_level_m(place_probability: float, cov_en_m2: Array, risk: float) -> float:
    """Smallest limit that the error exceeds with a probability of at most `risk`.

    `place_probability`: that the place is right. Infinite where a wrong place alone is likelier
    than that, and for an unknown covariance."""
    scales = _scales_m2(cov_en_m2)
    if not (place_probability > 0 and np.isfinite(scales).all()):
        return math.inf
    allowed = (risk - (1 - place_probability)) / place_probability
    if not allowed > 0:
        return math.inf
    deviations = math.sqrt(DEGREES * (allowed ** (-2 / DEGREES) - 1)) if allowed < 1 else 0.0
    low, high = (math.sqrt(float(each)) * deviations for each in (scales.min(), scales.max()))
    for _ in range(STEPS):
        middle = (low + high) / 2
        low, high = (low, middle) if _beyond(scales, middle) <= allowed else (middle, high)
    return high


def _scales_m2(cov_en_m2: Array) -> Array:
    """Squared scale (16,) of the error along directions that are equally likely."""
    if not np.isfinite(cov_en_m2).all():
        return np.full(1, math.nan)
    minor, major = np.maximum(np.linalg.eigvalsh(cov_en_m2), 0.0)
    return np.asarray((minor + (major - minor) * _QUADRANT) * (DEGREES - 2) / DEGREES)


def _beyond(scales_m2: Array, limit_m: float) -> float:
    squares = limit_m**2 / (DEGREES * np.maximum(scales_m2, 1e-12))
    return float(((1 + squares) ** (-DEGREES / 2)).mean())
