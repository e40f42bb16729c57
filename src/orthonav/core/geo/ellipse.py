"""The error ellipse of a position."""

import math

import numpy as np
from numpy.typing import NDArray

_ROUNDING = 1e-9
"""Negative eigenvalues up to this share of the largest one are rounding errors."""


def error_ellipse(cov_en: NDArray[np.float64]) -> tuple[float, float, float]:
    """One-sigma error ellipse of a (2, 2) covariance of east and north.

    Returns the semi-major and the semi-minor axis (square root of the unit of the covariance) and
    the direction of the major axis in degrees clockwise from north, 0 to 180. All are NaN where the
    covariance is not finite or has a negative eigenvalue.
    """
    cov = np.asarray(cov_en, dtype=np.float64)
    if not np.isfinite(cov).all():
        return math.nan, math.nan, math.nan
    values, vectors = np.linalg.eigh(cov / 2 + cov.T / 2)
    if values[0] < -_ROUNDING * abs(values[1]) or values[1] < 0:
        return math.nan, math.nan, math.nan
    east, north = vectors[:, 1]
    direction_deg = math.degrees(math.atan2(east, north)) % 180.0 % 180.0  # -1e-20 gives 180
    minor, major = np.sqrt(np.maximum(values, 0.0)).tolist()
    return major, minor, direction_deg
