"""Rectifying a view: as if the camera had looked straight down, north up, at the map's resolution.

The ground is taken as flat. Rolling shutter is ignored.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.geo.camera import (
    Camera,
    axis_on_ground_en_m,
    camera_from_en,
    counted_from_centres,
    distort,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PreparedView:
    """A view thinned so that its pixels are not much finer than the map's, and its camera."""

    grey: NDArray[np.uint8]
    camera: Camera


@dataclass(frozen=True, eq=False)
class Rectified:
    """A rectified view.

    `grey` (S, S) uint8 and `valid` (S, S) bool, north up, grey 0 where not valid; `offset_en_m`
    where the centre of the window lies, metres east and north of the camera.
    """

    grey: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    offset_en_m: Array


def prepare_view(
    grey: NDArray[np.uint8], camera: Camera, agl_m: float, gsd_m: float
) -> PreparedView:
    """Average the view down by whole numbers towards `gsd_m`, so that resampling cannot alias."""
    factor = int(gsd_m / max(camera.gsd_m(agl_m), 1e-9))  # heights may be absurd, not yet refused
    width, height = camera.width_px // max(1, factor), camera.height_px // max(1, factor)
    if factor < 2 or width < 8 or height < 8:
        return PreparedView(grey, camera)
    # Whole multiples only: what is left over at the right and below is not worth a slower path.
    whole = replace(camera, width_px=width * factor, height_px=height * factor)
    used = grey[: whole.height_px, : whole.width_px]
    thinned = cv2.resize(used, (width, height), interpolation=cv2.INTER_AREA)
    return PreparedView(np.asarray(thinned, dtype=np.uint8), whole.resized(width, height))


def rectify(
    view: PreparedView,
    *,
    yaw_deg: float,
    pitch_deg: float,
    roll_deg: float,
    agl_m: float,
    gsd_m: float,
    size_px: int,
) -> Rectified:
    """Rectify a square of `size_px` pixels around the place where the optical axis meets ground.

    The axis must point below the horizon. Pixels that the camera did not see are not valid.
    """
    offset = np.array(axis_on_ground_en_m(yaw_deg, pitch_deg, roll_deg, agl_m))
    half_m = size_px * gsd_m / 2
    en_from_window = np.array(
        [[gsd_m, 0, offset[0] - half_m], [0, -gsd_m, offset[1] + half_m], [0, 0, 1]]
    )
    camera_from_window = camera_from_en(yaw_deg, pitch_deg, roll_deg, agl_m) @ en_from_window
    corners = np.array([[0, 0, 1], [size_px, 0, 1], [size_px, size_px, 1], [0, size_px, 1.0]])
    depth = corners @ camera_from_window[2]
    if view.camera.distortion or depth.min() <= 0:
        grey, valid = _remapped(view, camera_from_window, size_px)
    else:
        grey, valid = _warped(view, camera_from_window, size_px, corners)
    return Rectified(grey, valid, offset)


def _warped(
    view: PreparedView, camera_from_window: Array, size_px: int, corners: Array
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The fast path: no distortion, no horizon, so one homography does it."""
    px_from_window = view.camera.matrix @ camera_from_window
    matrix = counted_from_centres(px_from_window)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    grey = cv2.warpPerspective(
        view.grey, matrix, (size_px, size_px), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    projected = corners @ px_from_window.T
    seen = projected[:, :2] / projected[:, 2:]
    height, width = view.grey.shape
    if (seen >= 0).all() and (seen[:, 0] <= width).all() and (seen[:, 1] <= height).all():
        valid = np.ones((size_px, size_px), dtype=np.bool_)
    else:
        inside = np.full(view.grey.shape, 255, dtype=np.uint8)
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        valid = cv2.warpPerspective(inside, matrix, (size_px, size_px), flags=flags) > 0
        grey = np.where(valid, grey, 0)
    return np.asarray(grey, dtype=np.uint8), np.asarray(valid, dtype=np.bool_)


def _remapped(
    view: PreparedView, camera_from_window: Array, size_px: int
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The general path: every pixel through lens and horizon."""
    centres = np.arange(size_px) + 0.5
    columns, rows = np.meshgrid(centres, centres)
    window = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
    rays = window @ camera_from_window.T
    ahead = rays[..., 2] > 1e-9
    plane = rays[..., :2] / np.where(ahead, rays[..., 2], np.nan)[..., None]
    camera = view.camera
    seen = distort(camera, plane) * [camera.fx_px, camera.fy_px] + [camera.cx_px, camera.cy_px]
    height, width = view.grey.shape
    with np.errstate(invalid="ignore"):
        valid = ahead & (seen >= 0).all(axis=-1) & (seen <= [width, height]).all(axis=-1)
    index = np.where(valid[..., None], seen - 0.5, -10).astype(np.float32)
    grey = cv2.remap(
        view.grey, index[..., 0], index[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.where(valid, grey, 0).astype(np.uint8), np.asarray(valid, dtype=np.bool_)
