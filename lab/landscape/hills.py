"""Hills under the landscape: smooth heights of the bare ground."""

import functools

import numpy as np

from lab.landscape.noise import Float32, Float64, fractal_grid, key_of

WAVELENGTHS_M = (1700.0, 900.0, 500.0)
BASE_M = 200.0
"""Mean height above sea level."""
GAIN = 0.55


def hills(seed: int, east_m: Float64, north_m: Float64, slope: float) -> Float32:
    """Return heights (H, W) above sea level on the grid of `north_m` x `east_m`.

    `slope`: root mean square of the gradient.
    """
    made = fractal_grid(key_of(seed, "hills"), east_m, north_m, WAVELENGTHS_M, GAIN)
    return np.asarray(BASE_M + made * np.float32(slope / _unit_slope()), np.float32)


@functools.cache
def _unit_slope() -> float:
    """Root mean square of the gradient of noise of amplitude 1."""
    at = np.arange(0.0, 40_000.0, 100.0)
    made = fractal_grid(key_of("hills"), at, at, WAVELENGTHS_M, GAIN)
    return float(np.sqrt(sum(np.mean(part**2) for part in np.gradient(made, 100.0))))
