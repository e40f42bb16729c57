"""True perspective views of imagery draped over relief: rays of every pixel meet the ground.

Shares no code with what it tests: rays by OpenCV and scipy, the ground by marching along them.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from orthonav.geo.camera import Camera

STRIDE_PX = 1.0
"""Steps along a ray, in pixels of the heights."""
HALVINGS = 12
"""Halvings of the step in which a ray meets the ground."""
MAX_STEPS = 4000
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Raster:
    """Values (H, W) of a plane, pixel-is-area: north-west corner and side of a pixel in metres."""

    values: NDArray[np.float32]
    west_m: float
    north_m: float
    pixel_m: float

    def at(self, east_m: Array, north_m: Array) -> Array:
        """Values (...) between pixels; those of the border beyond it."""
        shape = east_m.shape
        col = ((east_m - self.west_m) / self.pixel_m - 0.5).astype(np.float32).reshape(-1, 1)
        row = ((self.north_m - north_m) / self.pixel_m - 0.5).astype(np.float32).reshape(-1, 1)
        out = np.empty(col.shape, np.float64)
        for start in range(0, len(col), 30_000):  # OpenCV limits the sides of a map
            part = np.s_[start : start + 30_000]
            out[part] = cv2.remap(
                self.values, col[part], row[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
        return out.reshape(shape)

    def holds(self, en_m: Array) -> NDArray[np.bool_]:
        """Whether points (..., 2) lie on it."""
        rows, cols = self.values.shape
        x, y = (en_m[..., 0] - self.west_m), (self.north_m - en_m[..., 1])
        inside = (x >= 0) & (y >= 0) & (x <= cols * self.pixel_m) & (y <= rows * self.pixel_m)
        return np.asarray(inside)


def rays_enu(camera: Camera, attitude_deg: tuple[float, float, float], finer: int) -> Array:
    """Directions (H, W, 3) east, north, up of `finer` rays along both sides of each pixel."""
    shares = (np.arange(finer) + 0.5) / finer
    cols = (np.arange(camera.width_px)[:, None] + shares).reshape(-1)
    rows = (np.arange(camera.height_px)[:, None] + shares).reshape(-1)
    seen = np.stack(np.meshgrid(cols, rows), axis=-1).reshape(-1, 1, 2)
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    lens = np.array(camera.distortion or (0.0, 0, 0, 0))
    right, down = cv2.undistortPoints(seen, matrix, lens)[:, 0].T
    body = np.stack([-down, right, np.ones_like(right)], axis=-1)
    ned = Rotation.from_euler("ZYX", attitude_deg, degrees=True).apply(body)
    return np.asarray(ned[:, [1, 0, 2]] * [1, 1, -1]).reshape(len(rows), len(cols), 3)


def met(heights: Raster, rays: Array, position_m: Array) -> Array:
    """Ground points (H, W, 3) where rays first meet the ground; NaN where they do not."""
    low, high = float(heights.values.min()), float(heights.values.max())
    flat = rays.reshape(-1, 3)
    along = np.hypot(flat[:, 0], flat[:, 1])
    with np.errstate(divide="ignore"):
        down = np.where(flat[:, 2] < -1e-6, -flat[:, 2], np.nan)
    near = np.maximum((position_m[2] - high - 0.1) / down, 0.0)
    far = (position_m[2] - low + 0.1) / down
    longest = float(np.nanmax((far - near) * along, initial=0.0))
    steps = min(max(math.ceil(longest / (STRIDE_PX * heights.pixel_m)), 2), MAX_STEPS)
    step = (far - near) / steps
    before, found = near.copy(), np.zeros(len(flat), np.bool_)
    for number in range(1, steps + 1):
        left = np.flatnonzero(~found & np.isfinite(step))
        if not left.size:
            break
        at = near[left] + number * step[left]
        points = position_m + at[:, None] * flat[left]
        below = points[:, 2] <= heights.at(points[:, 0], points[:, 1])
        found[left[below]] = True
        before[left[~below]] = at[~below]
    first, last = before, before + step
    for _ in range(HALVINGS):
        middle = (first + last) / 2
        points = position_m + middle[:, None] * flat
        below = points[:, 2] <= heights.at(points[:, 0], points[:, 1])
        first, last = np.where(below, first, middle), np.where(below, middle, last)
    points = position_m + ((first + last) / 2)[:, None] * flat
    points[~found] = np.nan
    return np.asarray(points.reshape(rays.shape))


def seen_view(
    grey: Raster,
    heights: Raster,
    camera: Camera,
    attitude_deg: tuple[float, float, float],
    position_m: Array,
    finer: int = 2,
) -> tuple[NDArray[np.uint8], Array]:
    """What a camera sees (H, W) uint8, and the ground points (h, w, 3) of its rays."""
    ground = met(heights, rays_enu(camera, attitude_deg, finer), position_m)
    values = grey.at(np.nan_to_num(ground[..., 0]), np.nan_to_num(ground[..., 1]))
    values[np.isnan(ground[..., 0])] = 200.0  # sky
    size = camera.width_px, camera.height_px
    small = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    return np.rint(np.clip(small, 0, 255)).astype(np.uint8), ground


def random_relief(
    shape: tuple[int, int], posting_m: float, slope: float, shortest_m: float, seed: int
) -> NDArray[np.float32]:
    """Heights (H, W) of random hills from 0 up with a slope (root mean square of the gradient).

    Wavelengths from `shortest_m` up; amplitudes grow with them.
    """
    rng = np.random.default_rng(seed)
    rows, cols = np.fft.fftfreq(shape[0], posting_m), np.fft.rfftfreq(shape[1], posting_m)
    frequency = np.hypot(rows[:, None], cols)
    frequency[0, 0] = 1.0
    power = frequency**-2.0 * np.exp(-((frequency * shortest_m) ** 2))
    power[0, 0] = 0.0
    noise = np.fft.rfft2(rng.standard_normal(shape))
    heights = np.fft.irfft2(noise * power, s=shape)
    steep = np.sqrt(sum(np.mean(part**2) for part in np.gradient(heights, posting_m)))
    heights = heights * (slope / steep) if slope > 0 else heights * 0
    return np.asarray(heights - heights.min(), np.float32)
