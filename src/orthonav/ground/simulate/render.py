"""Rendering of camera views: of flat ground, or of heights in true perspective, with the
degradation of real images.

Heights may be those of bare ground or of a surface model, whose houses and trees then stand up. The
perspective shares no code with the localizer, which it tests: rays of every pixel by OpenCV and
scipy, the ground by marching along them.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import UsageError
from orthonav.core.geo.camera import (
    Camera,
    camera_from_en,
    counted_from_centres,
    enu_from_camera,
    undistort,
)

MAX_STEPS = 4000  # along a ray, each about a pixel of the heights
Array = NDArray[np.float64]


@dataclass(frozen=True)
class ViewEffects:
    exposure_std: float = 0.15  # standard deviation of the logarithm of the exposure, 0..1
    blur_px: float = 0.6  # standard deviation of the blur in pixels, 0..50
    noise_std: float = 2.0  # standard deviation of the sensor noise in grey levels, 0..128
    jpeg_quality: int = 90  # 1..100

    def __post_init__(self) -> None:
        limits = {"exposure_std": 1.0, "blur_px": 50.0, "noise_std": 128.0}
        for name, limit in limits.items():
            if not 0 <= getattr(self, name) <= limit:
                raise UsageError(f"{name} must be 0 to {limit:g}, got {getattr(self, name)}")
        if not 1 <= self.jpeg_quality <= 100:
            raise UsageError(f"JPEG quality must be 1 to 100, got {self.jpeg_quality}")


def render_view(
    camera: Camera,
    attitude: tuple[float, float, float, float],
    ground_rgb: NDArray[np.uint8],
    ground_corner_en_m: Array,
    gsd_m: float,
    effects: ViewEffects,
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """Image (H, W, 3) of flat ground. `ground_rgb` (h, w, 3) is an orthophoto with `gsd_m` metres
    per pixel; `ground_corner_en_m` is its north-west corner, metres from the nadir of the camera.
    `attitude`: yaw, pitch, roll (deg) and height (m)."""
    picture = projected(camera, attitude, ground_rgb, ground_corner_en_m, gsd_m)
    return degraded(picture, effects, rng)


def degraded(
    picture: NDArray[np.uint8], effects: ViewEffects, rng: np.random.Generator
) -> NDArray[np.uint8]:
    if effects.blur_px > 0:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), effects.blur_px), dtype=np.uint8)
    gain = float(np.exp(rng.normal(0, 1) * effects.exposure_std))
    noise = rng.standard_normal(picture.shape[:2], dtype=np.float32) * effects.noise_std
    exposed = picture.astype(np.float32) * gain + noise[..., None]
    return np.asarray(np.clip(exposed, 0, 255), dtype=np.uint8)


def projected(
    camera: Camera,
    attitude: tuple[float, float, float, float],
    ground_rgb: NDArray[np.uint8],
    corner_en_m: Array,
    gsd_m: float,
) -> NDArray[np.uint8]:
    size = (camera.width_px, camera.height_px)
    ground_from_en = np.array(
        [
            [1 / gsd_m, 0, -corner_en_m[0] / gsd_m],
            [0, -1 / gsd_m, corner_en_m[1] / gsd_m],
            [0, 0, 1],
        ]
    )
    if camera.is_pinhole:
        px_from_en = camera.matrix @ camera_from_en(*attitude)
        ground_from_px = ground_from_en @ np.linalg.inv(px_from_en)
        matrix = counted_from_centres(ground_from_px)
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        border = cv2.BORDER_REPLICATE
        seen = cv2.warpPerspective(ground_rgb, matrix, size, flags=flags, borderMode=border)
        return np.asarray(seen, dtype=np.uint8)
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    seen_from = (pixels - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]
    plane = np.nan_to_num(undistort(camera, seen_from), nan=1e3)  # beyond the lens: far out
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    enu = rays @ enu_from_camera(*attitude[:3]).T
    en = enu[:, :2] * (attitude[3] / np.maximum(-enu[:, 2:], 1e-9))
    index = (en - corner_en_m) / gsd_m * [1, -1] - 0.5
    maps = index.astype(np.float32).reshape(size[1], size[0], 2)
    border = cv2.BORDER_REPLICATE
    # The stubs of OpenCV require the argument that is None.
    seen = cv2.remap(ground_rgb, maps, None, cv2.INTER_CUBIC, borderMode=border)  # type: ignore[call-overload]
    return np.asarray(seen, dtype=np.uint8)


# Perspective over heights.


@dataclass(frozen=True, eq=False)
class Raster:
    """Values (H, W) or (H, W, C) of a plane, pixel-is-area: north-west corner and side of a pixel
    in metres."""

    values: NDArray[Any]
    west_m: float
    north_m: float
    pixel_m: float

    def at(self, east_m: Array, north_m: Array) -> Array:
        """Values (...) or (..., C) between pixels; those of the border beyond it."""
        shape = east_m.shape
        col = ((east_m - self.west_m) / self.pixel_m - 0.5).astype(np.float32).reshape(-1, 1)
        row = ((self.north_m - north_m) / self.pixel_m - 0.5).astype(np.float32).reshape(-1, 1)
        channels = self.values.shape[2:]
        out = np.empty((len(col), *channels), np.float64)
        for start in range(0, len(col), 30_000):  # OpenCV limits the sides of a map
            part = np.s_[start : start + 30_000]
            found = cv2.remap(
                self.values, col[part], row[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            out[part] = found.reshape(-1, *channels)
        return out.reshape((*shape, *channels))

    def holds(self, en_m: Array) -> NDArray[np.bool_]:
        """Whether points (..., 2) lie on it."""
        rows, cols = self.values.shape[:2]
        x, y = (en_m[..., 0] - self.west_m), (self.north_m - en_m[..., 1])
        inside = (x >= 0) & (y >= 0) & (x <= cols * self.pixel_m) & (y <= rows * self.pixel_m)
        return np.asarray(inside)

    def halved(self) -> "Raster":
        """The same at half the resolution; odd rows and columns are cut off."""
        rows, cols = (max(side // 2, 1) for side in self.values.shape[:2])
        even = self.values[: 2 * rows, : 2 * cols]
        made = cv2.resize(even, (cols, rows), interpolation=cv2.INTER_AREA)
        return Raster(np.asarray(made), self.west_m, self.north_m, 2 * self.pixel_m)


def rays_enu(camera: Camera, attitude_deg: tuple[float, float, float], finer: int) -> Array:
    """Directions (H, W, 3) east, north, up of `finer` rays along both sides of each pixel."""
    from scipy.spatial.transform import Rotation  # `orthonav view` has no need of SciPy

    shares = (np.arange(finer) + 0.5) / finer
    cols = (np.arange(camera.width_px)[:, None] + shares).reshape(-1)
    rows = (np.arange(camera.height_px)[:, None] + shares).reshape(-1)
    seen = np.stack(np.meshgrid(cols, rows), axis=-1).reshape(-1, 1, 2)
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    lens = np.array(camera.distortion or (0.0, 0, 0, 0))
    if camera.model == "fisheye":
        plane = cv2.fisheye.undistortPoints(seen, matrix, lens)
    else:  # of the default five steps corners of wide lenses err by pixels
        most = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-4  # steps, pixels
        ideal = cv2.undistortImagePoints(seen, matrix, lens, None, most)
        plane = cv2.undistortPoints(ideal, matrix, None)
    right, down = plane[:, 0].T
    body = np.stack([-down, right, np.ones_like(right)], axis=-1)
    ned = Rotation.from_euler("ZYX", attitude_deg, degrees=True).apply(body)
    return np.asarray(ned[:, [1, 0, 2]] * [1, 1, -1]).reshape(len(rows), len(cols), 3)


def met(heights: Raster, rays: Array, position_m: Array) -> Array:
    """Ground points (H, W, 3) where rays first meet the ground; NaN where they do not."""
    flat = rays.reshape(-1, 3)
    along = np.hypot(flat[:, 0], flat[:, 1])
    down = np.where(flat[:, 2] < -1e-6, -flat[:, 2], np.nan)
    low, high = _between(heights, position_m, flat, down)
    near = np.maximum((position_m[2] - high - 0.1) / down, 0.0)
    far = (position_m[2] - low + 0.1) / down
    with np.errstate(invalid="ignore"):
        steps = np.ceil((far - near) * along / heights.pixel_m)
    steps = np.clip(np.nan_to_num(steps), 1, MAX_STEPS)
    step = (far - near) / steps

    def below(at: Array, rays_of: Array) -> NDArray[np.bool_]:
        points = position_m + at[:, None] * rays_of
        return np.asarray(points[:, 2] <= heights.at(points[:, 0], points[:, 1]))

    before, found = near.copy(), np.zeros(len(flat), np.bool_)
    left = np.flatnonzero(np.isfinite(step))
    for number in range(1, MAX_STEPS + 1):
        if not left.size:
            break
        at = near[left] + number * step[left]
        hit = below(at, flat[left])
        found[left[hit]] = True
        before[left[~hit]] = at[~hit]
        left = left[~hit & (number < steps[left])]
    hits = np.flatnonzero(found)
    first, last, there = before[hits], before[hits] + step[hits], flat[hits]
    for _ in range(8):  # halvings of the step in which a ray meets the ground
        middle = (first + last) / 2
        hit = below(middle, there)
        first, last = np.where(hit, first, middle), np.where(hit, middle, last)
    points = np.full(flat.shape, np.nan)
    points[hits] = position_m + ((first + last) / 2)[:, None] * there
    return np.asarray(points.reshape(rays.shape))


def _between(heights: Raster, position_m: Array, rays: Array, down: Array) -> tuple[float, float]:
    """Least and greatest height of the box in which rays (N, 3) can meet the ground."""
    low = float(heights.values.min())
    if not np.isfinite(down).any():
        return low, low
    far = position_m[:2] + rays[:, :2] * ((position_m[2] - low + 0.1) / down)[:, None]
    corners = np.vstack([position_m[None, :2], np.nanmin(far, axis=0), np.nanmax(far, axis=0)])
    rows, cols = heights.values.shape
    x = (corners[:, 0] - heights.west_m) / heights.pixel_m
    y = (heights.north_m - corners[:, 1]) / heights.pixel_m
    left, right = np.clip([x.min() - 2, x.max() + 2], 0, cols).astype(int)
    top, bottom = np.clip([y.min() - 2, y.max() + 2], 0, rows).astype(int)
    # Beyond the raster the heights of its border go on.
    box = heights.values[min(top, rows - 1) : max(bottom, 1), min(left, cols - 1) : max(right, 1)]
    return float(box.min()), float(box.max())


def coloured(
    imagery: Raster, ground_m: Array, camera: Camera, position_m: Array
) -> NDArray[np.uint8]:
    """The picture (H, W) or (H, W, C) of ground points (h, w, 3), of one or more rays a pixel.
    Where a ray stands for more than a pixel of the imagery, this is averaged, down to 1/32 at most.
    The sky has the grey level 200."""
    level = np.minimum(halved_for(ground_m, camera, position_m, imagery.pixel_m), 5)
    values = np.full((*ground_m.shape[:2], *imagery.values.shape[2:]), 200.0)
    for number in range(int(level.max(initial=-1)) + 1):
        if number:
            imagery = imagery.halved()
        here = level == number
        values[here] = imagery.at(ground_m[here, 0], ground_m[here, 1])
    size = camera.width_px, camera.height_px
    small = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    return np.rint(np.clip(small, 0, 255)).astype(np.uint8)


def halved_for(ground_m: Array, camera: Camera, position_m: Array, pixel_m: float) -> Array:
    """How often (h, w) to halve the resolution of imagery with this pixel before drawing a picture
    of ground points (h, w, 3); -1 where a ray meets none."""
    range_m = np.linalg.norm(ground_m - position_m, axis=-1)
    drop_m = np.maximum(position_m[2] - ground_m[..., 2], 1e-3)
    ray_px = camera.width_px / ground_m.shape[1]
    # A ray stands for range / focal length across and, on level ground, range / cos along.
    ray_m = range_m * ray_px / camera.fx_px * np.sqrt(range_m / drop_m)
    level = np.floor(np.log2(np.maximum(ray_m / pixel_m, 1.0)))
    return np.where(np.isfinite(level), level, -1)
