"""Position-dependent pseudo-random numbers, independent of the rendered window.

Integer lattice points are hashed to uniform numbers; smooth noise is a cubic B-spline through the
hashed numbers, evaluated separably. Only rounding depends on the window.
"""

import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt32 = NDArray[np.uint32]

_SPREAD = 2.6  # brings B-spline noise of uniform lattice values to about -1..1


def key_of(*parts: object) -> int:
    """Return a 32-bit key for the named random field, the same in every process."""
    return zlib.crc32("/".join(str(part) for part in parts).encode())


def hash_u32(key: int, ix: ArrayLike, iy: ArrayLike = 0) -> UInt32:
    """Return uint32 hashes of integer pairs, broadcast; arrays in, array out (at least 1-d)."""
    x = np.atleast_1d(np.asarray(ix)).astype(np.int64).astype(np.uint32)
    y = np.atleast_1d(np.asarray(iy)).astype(np.int64).astype(np.uint32)
    h = x * np.uint32(0x9E3779B1) ^ _mix(y * np.uint32(0x85EBCA77) + np.uint32(key))
    return _mix(_mix(h) + np.uint32(0x6C8E9CF5))


def _mix(h: UInt32) -> UInt32:
    h = h ^ (h >> np.uint32(15))
    h = h * np.uint32(0x2C1B3C6D)
    h = h ^ (h >> np.uint32(12))
    h = h * np.uint32(0x297A2D39)
    return h ^ (h >> np.uint32(15))


def uniform(key: int, ix: ArrayLike, iy: ArrayLike = 0) -> Float64:
    """Return numbers in [0, 1) for integer pairs, broadcast (at least 1-d)."""
    return hash_u32(key, ix, iy).astype(np.float64) / 4294967296.0


def uniform_at(key: int, ix: int, iy: int = 0) -> float:
    """Return the number in [0, 1) of one integer pair."""
    return float(uniform(key, ix, iy)[0])


def _weights(fraction: Float64) -> list[Float64]:
    """Cubic B-spline weights of the four lattice points around a position, each like `fraction`."""
    f = fraction
    g = 1.0 - f
    return [g**3 / 6, (3 * f**3 - 6 * f**2 + 4) / 6, (3 * g**3 - 6 * g**2 + 4) / 6, f**3 / 6]


def noise_at(key: int, points_en_m: Float64, wavelength_m: float) -> Float64:
    """Return smooth noise (N,) in about -1..1 at points (N, 2)."""
    scaled = points_en_m / wavelength_m
    base = np.floor(scaled)
    i = base.astype(np.int64)
    wx = _weights(scaled[:, 0] - base[:, 0])
    wy = _weights(scaled[:, 1] - base[:, 1])
    total = np.zeros(len(scaled))
    for b in range(4):
        for a in range(4):
            total += wx[a] * wy[b] * (uniform(key, i[:, 0] + a, i[:, 1] + b) - 0.5)
    return total * (2 * _SPREAD)


def _basis(positions_m: Float64, wavelength_m: float) -> tuple[int, Float32]:
    """Return the first lattice index and the (positions, lattice) matrix that interpolates."""
    scaled = positions_m / wavelength_m
    base = np.floor(scaled)
    index = base.astype(np.int64)
    first = int(index.min())
    matrix = np.zeros((len(scaled), int(index.max()) - first + 4), np.float32)
    rows = np.arange(len(scaled))
    for k, weight in enumerate(_weights(scaled - base)):
        matrix[rows, index - first + k] = weight
    return first, matrix


def noise_grid(key: int, east_m: Float64, north_m: Float64, wavelength_m: float) -> Float32:
    """Return smooth noise (H, W) float32 in about -1..1 on the grid of `north_m` x `east_m`."""
    first_x, basis_x = _basis(east_m, wavelength_m)
    first_y, basis_y = _basis(north_m, wavelength_m)
    ix = np.arange(first_x, first_x + basis_x.shape[1])
    iy = np.arange(first_y, first_y + basis_y.shape[1])
    lattice = ((uniform(key, ix[None, :], iy[:, None]) - 0.5) * (2 * _SPREAD)).astype(np.float32)
    return np.asarray(basis_y @ (lattice @ basis_x.T), dtype=np.float32)


def fractal_grid(
    key: int,
    east_m: Float64,
    north_m: Float64,
    wavelengths_m: Sequence[float],
    gain: float = 0.75,
) -> Float32:
    """Return the sum (H, W) of noise at several wavelengths, each `gain` times the one before.

    The sum spreads like one noise, about -1..1.
    Wavelengths below two pixels are omitted (Nyquist limit).
    """
    total = np.zeros((len(north_m), len(east_m)), np.float32)
    step_m = abs(float(east_m[1] - east_m[0])) if len(east_m) > 1 else 0.0
    amplitude = 1.0 / float(np.sqrt(sum(gain ** (2 * k) for k in range(len(wavelengths_m)))))
    for octave, wavelength_m in enumerate(wavelengths_m):
        if wavelength_m >= 1.999 * step_m:  # the step carries rounding of its own
            layer = noise_grid(key + 7919 * octave & 0xFFFFFFFF, east_m, north_m, wavelength_m)
            layer *= np.float32(amplitude)
            total += layer
        amplitude *= gain
    return total


def white_grid(key: int, columns: NDArray[np.int64], rows: NDArray[np.int64]) -> Float32:
    """Return nearly normal noise (H, W), standard deviation 1, one independent number per pixel."""
    h = hash_u32(key, columns[None, :], rows[:, None])
    total = (h & np.uint32(0xFF)).astype(np.float32)
    for shift in (8, 16, 24):
        total += (h >> np.uint32(shift)) & np.uint32(0xFF)
    return (total - np.float32(510.0)) * np.float32(1.0 / 147.8)
