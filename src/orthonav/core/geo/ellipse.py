"""The error ellipse of a position."""

import math

import numpy as np
from numpy.typing import NDArray

_ROUNDING = 1e-9  # negative eigenvalues up to this share of the largest are rounding errors


def error_ellipse(cov_en: NDArray[np.float64]) -> tuple[float, float, float]:
    """Semi-major and semi-minor axis (1 sigma), and direction of the major one, 0..180 deg from
    north.

    NaN where the (2, 2) covariance is not finite or has a negative eigenvalue."""
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
