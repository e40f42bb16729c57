"""Rendering of camera views of flat ground, with the degradation of real images and clouds."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError
from orthonav.core.geo.camera import (
    Camera,
    camera_from_en,
    counted_from_centres,
    enu_from_camera,
    footprint_en_m,
    undistort,
)

FEWEST_VIEWS, MOST_VIEWS = 10, 40  # length of a cloudy stretch in views
EDGE = 0.25  # fraction of a stretch, at each end, over which the clouds close
BROKEN = 0.3  # fraction of the stretches whose clouds never close
HEIGHT = 0.5  # height of the clouds as a fraction of the aircraft's
SOFTNESS = 0.25  # width of a cloud edge, as a fraction of the range of cloud cover
TEXTURE_PX, TEXTURE_VIEWS = 512, 4.0  # period: pixels, lengths of a view
BLOB_PX = 40.0  # size of the largest clouds in pixels of the texture
GRID = 8  # clouds are rendered at this fraction of the resolution of the view
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CloudLayer:
    """Clouds in one view: `opacity` (H, W) 0..1 and `grey` (H, W), the grey level of the clouds."""

    opacity: NDArray[np.float32]
    grey: NDArray[np.float32]

    def over(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        behind = picture * (1 - self.opacity[..., None])
        return np.asarray(behind + (self.opacity * self.grey)[..., None], dtype=np.uint8)


class Clouds:
    """Clouds of a flight of `count` views, a `share` (0..1) of which are cloudy."""

    def __init__(self, count: int, share: float, seed: int) -> None:
        rng = np.random.default_rng([seed, 3])
        self._degree, self._stretch = _stretches(count, share, rng)
        self._level = rng.uniform(190, 245, count)
        self._contrast = rng.uniform(0, 12, count)
        self._ranks = _texture(rng)

    def degree(self, number: int) -> float:
        """Cloud cover of a view: 0 clear, 1 fully covered."""
        return float(self._degree[number])

    def before(
        self, number: int, camera: Camera, attitude: tuple[float, float, float, float], en_m: Array
    ) -> CloudLayer | None:
        """Clouds between a view and the ground, None if it is clear. `attitude`: heading, pitch,
        roll (deg) and height (m). `en_m`: position (2,)."""
        degree, stretch = self.degree(number), int(self._stretch[number])
        if degree <= 0:
            return None
        *angles, agl_m = attitude
        below_m = agl_m * (1 - HEIGHT)
        corners = en_m + footprint_en_m(camera, angles[0], angles[1], angles[2], below_m)
        across_m = TEXTURE_VIEWS * below_m * max(camera.extent)
        size = math.ceil(camera.width_px / GRID) + 1, math.ceil(camera.height_px / GRID) + 1
        ranks = _sampled(self._ranks, corners / across_m * TEXTURE_PX + 97.0 * stretch, size)
        inside = np.clip((degree * (1 + SOFTNESS) - ranks) / SOFTNESS, 0, 1)
        opacity = inside * inside * (3 - 2 * inside)
        shade = _sampled(self._ranks, corners / across_m * TEXTURE_PX * 2 + 31.0, size) - 0.5
        grey = self._level[stretch] + self._contrast[stretch] * shade
        whole = (camera.width_px, camera.height_px)
        return CloudLayer(*(_enlarged(part, whole) for part in (opacity, grey)))


def _stretches(
    count: int, share: float, rng: np.random.Generator
) -> tuple[Array, NDArray[np.int64]]:
    """Cloud cover (N,) and number of the stretch (N,) of each view."""
    wanted = round(share * count)
    lengths: list[int] = []
    while sum(lengths) < wanted:
        lengths.append(min(int(rng.integers(FEWEST_VIEWS, MOST_VIEWS + 1)), wanted - sum(lengths)))
    starts = np.sort(rng.integers(0, count - wanted + 1, len(lengths)))
    degree, stretch = np.zeros(count), np.zeros(count, dtype=np.int64)
    passed = 0
    for number, (free, length) in enumerate(zip(starts, lengths, strict=True)):
        first = int(free) + passed
        passed += length
        edge = 1 + EDGE * length
        place = np.arange(length)
        most = rng.uniform(0.4, 0.9) if rng.uniform() < BROKEN else 1.0
        closed = np.minimum(place + 1, length - place) / edge
        degree[first : first + length] = most * np.minimum(closed, 1)
        stretch[first : first + length] = number
    return degree, stretch


def _texture(rng: np.random.Generator) -> NDArray[np.float32]:
    """A seamless periodic random texture (S, S), as ranks: uniform from 0 to 1."""
    frequency = np.fft.fftfreq(TEXTURE_PX)
    radius = np.hypot(frequency[:, None], frequency[None])
    power = (radius**2 + (1 / BLOB_PX) ** 2) ** -1.5
    field = np.fft.ifft2(np.fft.fft2(rng.normal(0, 1, (TEXTURE_PX, TEXTURE_PX))) * power).real
    ranks = np.empty(field.size, dtype=np.float32)
    ranks[np.argsort(field, axis=None, kind="stable")] = np.linspace(0, 1, field.size)
    return ranks.reshape(field.shape)


def _sampled(texture: NDArray[np.float32], corners_px: Array, size: tuple[int, int]) -> Array:
    """The texture (h, w) between four corners (4, 2), clockwise from the top left."""
    across, down = np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1])[:, None, None]
    top = corners_px[0] + across[:, None] * (corners_px[1] - corners_px[0])
    bottom = corners_px[3] + across[:, None] * (corners_px[2] - corners_px[3])
    maps = (top + down * (bottom - top)) % TEXTURE_PX
    wrapped = cv2.copyMakeBorder(texture, 0, 1, 0, 1, cv2.BORDER_WRAP)
    # The stubs of OpenCV require the argument that is None.
    seen = cv2.remap(wrapped, maps.astype(np.float32), None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
    return np.asarray(seen, dtype=np.float64)


def _enlarged(part: Array, size: tuple[int, int]) -> NDArray[np.float32]:
    enlarged = cv2.resize(part.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(enlarged, dtype=np.float32)


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
                raise FlightError(f"{name} must be 0 to {limit:g}, got {getattr(self, name)}")
        if not 1 <= self.jpeg_quality <= 100:
            raise FlightError(f"JPEG quality must be 1 to 100, got {self.jpeg_quality}")


def render_view(
    camera: Camera,
    attitude: tuple[float, float, float, float],
    ground_rgb: NDArray[np.uint8],
    ground_corner_en_m: Array,
    gsd_m: float,
    effects: ViewEffects,
    rng: np.random.Generator,
    clouds: CloudLayer | None = None,
) -> NDArray[np.uint8]:
    """Image (H, W, 3) of flat ground. `ground_rgb` (h, w, 3) is an orthophoto with `gsd_m` metres
    per pixel; `ground_corner_en_m` is its north-west corner, metres from the nadir of the camera.
    `attitude`: yaw, pitch, roll (deg) and height (m)."""
    picture = _projected(camera, attitude, ground_rgb, ground_corner_en_m, gsd_m)
    return degraded(picture, effects, rng, clouds)


def degraded(
    picture: NDArray[np.uint8],
    effects: ViewEffects,
    rng: np.random.Generator,
    clouds: CloudLayer | None = None,
) -> NDArray[np.uint8]:
    if clouds is not None:
        picture = clouds.over(picture)
    if effects.blur_px > 0:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), effects.blur_px), dtype=np.uint8)
    gain = float(np.exp(rng.normal(0, 1) * effects.exposure_std))
    noise = rng.standard_normal(picture.shape[:2], dtype=np.float32) * effects.noise_std
    exposed = picture.astype(np.float32) * gain + noise[..., None]
    return np.asarray(np.clip(exposed, 0, 255), dtype=np.uint8)


def _projected(
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
