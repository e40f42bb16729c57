"""Random hills, and what a camera sees of them."""

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera
from orthonav.ground.simulate.render import Array, Raster, coloured, met, rays_enu


def seen_view(
    imagery: Raster,
    heights: Raster,
    camera: Camera,
    attitude_deg: tuple[float, float, float],
    position_m: Array,
    finer: int = 2,
) -> tuple[NDArray[np.uint8], Array]:
    """What a camera sees (H, W) or (H, W, C) uint8, and the ground points (h, w, 3) of its rays.
    `position_m` (3,): east, north and above the zero of `heights`. `finer`: rays along both sides
    of a pixel."""
    ground = met(heights, rays_enu(camera, attitude_deg, finer), position_m)
    return coloured(imagery, ground, camera, position_m), ground


def random_relief(
    shape: tuple[int, int],
    posting_m: float,
    slope: float,
    shortest_m: float,
    seed: int,
    roughness: float = 2.0,
) -> NDArray[np.float32]:
    """Heights (H, W) of random hills from 0 up with a slope (root mean square of the gradient).
    Wavelengths from `shortest_m` up; amplitudes grow with this power of them: by 2 the hills of
    every octave are as steep, by less the short ones are steeper."""
    rng = np.random.default_rng(seed)
    rows, cols = np.fft.fftfreq(shape[0], posting_m), np.fft.rfftfreq(shape[1], posting_m)
    frequency = np.hypot(rows[:, None], cols)
    frequency[0, 0] = 1.0
    power = frequency**-roughness * np.exp(-((frequency * shortest_m) ** 2))
    power[0, 0] = 0.0
    noise = np.fft.rfft2(rng.standard_normal(shape))
    heights = np.fft.irfft2(noise * power, s=shape)
    steep = np.sqrt(sum(np.mean(part**2) for part in np.gradient(heights, posting_m)))
    heights = heights * (slope / steep) if slope > 0 else heights * 0
    return np.asarray(heights - heights.min(), np.float32)
