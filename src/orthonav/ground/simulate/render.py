"""Rendering of camera views of flat ground, with the degradation of real images."""

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
    undistort,
)
from orthonav.ground.simulate.clouds import CloudLayer

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ViewEffects:
    """Image degradation.

    `exposure_std`: standard deviation of the logarithm of the exposure, 0..1. `blur_px`: standard
    deviation of the blur in pixels, 0..50. `noise_std`: standard deviation of the sensor noise in
    grey levels, 0..128. `jpeg_quality`: 1..100. Raises `FlightError` outside these ranges.
    """

    exposure_std: float = 0.15
    blur_px: float = 0.6
    noise_std: float = 2.0
    jpeg_quality: int = 90

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
    """Image (H, W, 3) of flat ground.

    `ground_rgb` (h, w, 3) is an orthophoto with `gsd_m` metres per pixel; `ground_corner_en_m` is
    its north-west corner, metres from the nadir of the camera. `attitude`: yaw, pitch, roll (deg)
    and height (m).
    """
    picture = _projected(camera, attitude, ground_rgb, ground_corner_en_m, gsd_m)
    return degraded(picture, effects, rng, clouds)


def degraded(
    picture: NDArray[np.uint8],
    effects: ViewEffects,
    rng: np.random.Generator,
    clouds: CloudLayer | None = None,
) -> NDArray[np.uint8]:
    """A perfect image (H, W, 3) with clouds, blur, exposure and noise."""
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
