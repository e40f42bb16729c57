"""Lens models in the camera plane, and their inverses.

Brown: Brown (1966), "Decentering distortion of lenses", with three radial and two tangential
numbers. Fisheye: Kannala and Brandt (2006), "A generic camera model and calibration method",
with four numbers of the angle off the optical axis. Both as OpenCV writes them.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Numbers = tuple[float, ...]
_STEPS = 50
_CLOSE = 1e-9
_EXACT = 1e-14
"""Largest step at which the iteration of all points has converged."""


def brown_distort(distortion: Numbers, xy: Array) -> Array:
    """Distorted points (..., 2) of ideal ones; NaN from the radius where the model folds back."""
    k1, k2, _, _, k3 = (*distortion, 0.0)[:5]
    out, r2 = _brown(distortion, xy), (xy**2).sum(axis=-1)
    out[r2 >= _fold_r2(k1, k2, k3)] = np.nan
    return out


def brown_undistort(distortion: Numbers, xy: Array) -> Array:
    """Ideal points (..., 2) of distorted ones, by Newton's method; NaN if there is none."""
    k1, k2, p1, p2, k3 = (*distortion, 0.0)[:5]
    ideal = np.array(xy, dtype=np.float64)
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            x, y = ideal[..., 0], ideal[..., 1]
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)
            dxx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
            dxy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
            dyy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
            error = _brown(distortion, ideal) - xy
            if np.abs(error).max(initial=0.0) < _EXACT:
                break  # NaN never converges: points beyond the lens take all steps
            step = np.stack(
                [
                    dyy * error[..., 0] - dxy * error[..., 1],
                    dxx * error[..., 1] - dxy * error[..., 0],
                ],
                axis=-1,
            )
            ideal = ideal - step / (dxx * dyy - dxy * dxy)[..., None]
        found = np.abs(_brown(distortion, ideal) - xy).max(axis=-1) < _CLOSE
        found &= (ideal**2).sum(axis=-1) < _fold_r2(k1, k2, k3)
    ideal[~found] = np.nan
    return ideal


def fisheye_distort(distortion: Numbers, xy: Array) -> Array:
    """Distorted points (..., 2) of ideal ones; NaN from the angle where the model folds back."""
    radius = np.hypot(xy[..., 0], xy[..., 1])
    angle = np.arctan(radius)
    polynomial = _angles(distortion)
    with np.errstate(invalid="ignore"):
        grown = np.where(angle < _fold_angle(polynomial), polynomial(angle), np.nan)
    scale = np.where(radius > 1e-12, grown / np.maximum(radius, 1e-12), 1.0)
    return np.asarray(xy * scale[..., None])


def fisheye_undistort(distortion: Numbers, xy: Array) -> Array:
    """Ideal points (..., 2) of distorted ones; NaN if there is none in front of the camera."""
    radius = np.hypot(xy[..., 0], xy[..., 1])
    polynomial = _angles(distortion)
    slope, end = polynomial.deriv(), min(_fold_angle(polynomial), math.pi / 2)
    low, high = np.zeros_like(radius), np.full_like(radius, end)
    angle = np.clip(radius, 0.0, 0.9 * end)
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):  # Newton's method inside a bracket: far out the slope may vanish
            error = polynomial(angle) - radius
            if np.abs(error).max(initial=0.0) < _EXACT:
                break
            low, high = np.where(error < 0, angle, low), np.where(error >= 0, angle, high)
            newton = angle - error / slope(angle)
            angle = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
        found = (np.abs(polynomial(angle) - radius) < _CLOSE) & (angle < end)
        scale = np.where(radius > 1e-12, np.tan(angle) / np.maximum(radius, 1e-12), 1.0)
    return np.asarray(xy * np.where(found, scale, np.nan)[..., None])


def _brown(distortion: Numbers, xy: Array) -> Array:
    k1, k2, p1, p2, k3 = (*distortion, 0.0)[:5]
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


@lru_cache(maxsize=16)
def _fold_r2(k1: float, k2: float, k3: float) -> float:
    """Squared radius at which the radial model stops growing; infinite if it never does."""
    inverse = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3])  # of 1 / r2: the leading 1 keeps it sound
    largest = inverse.real[np.abs(inverse.imag) < 1e-9].max(initial=0.0)
    return float(1 / largest) if largest > 1e-12 else math.inf


def _angles(distortion: Numbers) -> np.polynomial.Polynomial:
    """Distance from the image centre as a polynomial of the angle from the optical axis."""
    k1, k2, k3, k4 = distortion or (0.0,) * 4
    return np.polynomial.Polynomial([0, 1, 0, k1, 0, k2, 0, k3, 0, k4])


def _fold_angle(polynomial: np.polynomial.Polynomial) -> float:
    """Angle in radians at which the fisheye model stops growing; infinite if it never does."""
    _, k1, k2, k3, k4 = polynomial.coef[1::2]
    inverse = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4])  # of 1 / angle squared, as above
    largest = inverse.real[np.abs(inverse.imag) < 1e-9].max(initial=0.0)
    return float(1 / math.sqrt(largest)) if largest > 1e-12 else math.inf
