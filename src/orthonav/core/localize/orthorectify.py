"""Orthorectifying a view: as if the camera had looked straight down on every point of the ground.

Where `rectify` takes the ground as flat, every node of the window has a height here. It is
projected through attitude and lens into the picture. Rolling shutter is ignored.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera, enu_from_camera, seen_px
from orthonav.core.records import View

NODE_PX = 4
"""Heights and projections are computed at every so many pixels of the window, between them
interpolated: at most one and a half postings of a usual terrain layer."""
MAX_COARSER = 3.0
"""Ground seen more coarsely than this, as a multiple of the window's pixel and of the finest ground
of the view, does not count: it adds less than relief and haze take away."""
SIGHT_STEPS = 48
"""Points along a line of sight, at most, at which the ground may hide what lies behind."""
CLEAR_M = 0.5
"""Ground may rise so far above a line of sight: the error of interpolation."""
Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Orientation:
    """Where a camera was: `position_m` (3,) metres east and north in the sheet and above mean sea
    level; `attitude_deg` (3,): heading, pitch and roll (`orthonav.core.geo.camera`)."""

    position_m: Array
    attitude_deg: Array

    def moved(self, step: Array) -> "Orientation":
        """This orientation after a step (6,): metres and degrees."""
        return Orientation(self.position_m + step[:3], self.attitude_deg + step[3:])

    def seen_px(self, camera: Camera, ground_m: Array) -> Array:
        """Image points (..., 2) of ground points (..., 3); NaN where they cannot be seen."""
        rays = (ground_m - self.position_m) @ enu_from_camera(*self.attitude_deg.tolist())
        return seen_px(camera, rays)


def node_px(shape: tuple[int, int]) -> Array:
    """Pixel coordinates (h, w, 2) of the nodes of a window, x and y."""
    rows, cols = (np.arange(0.5, side + 2 * NODE_PX, NODE_PX) for side in shape)
    return np.stack(np.meshgrid(cols, rows), axis=-1)


def orthorectified(
    view: View, orientation: Orientation, nodes_m: Array, shape: tuple[int, int]
) -> tuple[NDArray[np.uint8], Mask]:
    """Grey and valid (H, W) of a window of ground as a camera saw it; grey 0 where not valid.

    `nodes_m` (h, w, 3): metres east, north and above sea of the nodes (`node_px`) of a window of
    `shape`; NaN where the height is unknown.
    """
    index = orientation.seen_px(view.camera, nodes_m) - 0.5
    usable = np.isfinite(index).all(axis=-1) & _fine(view, index)
    usable &= ~hidden(nodes_m, orientation.position_m)
    seen = np.where(usable[..., None], index, -10.0)
    planes = np.dstack([seen, usable]).astype(np.float32)
    part = np.array([[1 / NODE_PX, 0, 0], [0, 1 / NODE_PX, 0]])
    size = shape[1], shape[0]
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    x, y, counted = cv2.split(cv2.warpAffine(planes, part, size, flags=flags))
    high, wide = view.grey.shape
    valid = (counted > 0.999) & (x >= -0.5) & (y >= -0.5) & (x <= wide - 0.5) & (y <= high - 0.5)
    grey = cv2.remap(view.grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(valid, grey, 0).astype(np.uint8), np.asarray(valid, np.bool_)


def _fine(view: View, index: Array) -> Mask:
    """Which nodes (h, w) of a window with image points (h, w, 2) are seen finely enough."""
    with np.errstate(invalid="ignore"):
        (down_x, right_x), (down_y, right_y) = (
            np.gradient(index[..., axis], NODE_PX) for axis in (0, 1)
        )
        area = np.abs(right_x * down_y - right_y * down_x)
        high, wide = view.grey.shape
        inside = ((index >= 0) & (index <= [wide, high])).all(axis=-1)
        finest = min(float(np.nanmax(area[inside], initial=0.0)), 1.0)
        return np.asarray(area >= finest / MAX_COARSER**2)


def hidden(nodes_m: Array, position_m: Array) -> Mask:
    """Which ground points (h, w, 3) of a window the ground of that window hides from a camera.

    Lines of sight are followed within the window only, towards the camera.
    """
    offset = nodes_m[..., :2] - position_m[:2]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    above = position_m[2] - nodes_m[..., 2]
    none = np.zeros(distance.shape, np.bool_)
    spacing = float(np.hypot(*(nodes_m[0, 1, :2] - nodes_m[0, 0, :2])))
    with np.errstate(invalid="ignore", divide="ignore"):
        steepest = max(
            float(np.nanmax(np.abs(np.diff(nodes_m[..., 2], axis=axis)), initial=0.0)) / spacing
            for axis in (0, 1)
        )
        sight = above / np.maximum(distance, 1e-9)
    # Two axes at once are steeper by up to the root of two.
    if not math.sqrt(2) * steepest > float(np.nanmin(sight, initial=math.inf)):
        return none
    return none | _behind(nodes_m, position_m, sight)


def _behind(nodes_m: Array, position_m: Array, sight: Array) -> Mask:
    """The same, by following every line of sight."""
    origin = nodes_m[0, 0, :2]
    axes = np.stack([nodes_m[0, 1, :2] - origin, nodes_m[1, 0, :2] - origin], axis=1)
    to_camera = np.linalg.solve(axes, position_m[:2] - origin)
    rows, cols = nodes_m.shape[:2]
    x, y = np.meshgrid(np.arange(cols, dtype=np.float64), np.arange(rows, dtype=np.float64))
    left = np.stack([to_camera[0] - x, to_camera[1] - y], axis=-1)
    length = np.maximum(np.hypot(left[..., 0], left[..., 1]), 1e-9)
    heights = np.nan_to_num(nodes_m[..., 2], nan=-1e4).astype(np.float32)
    spacing = float(np.hypot(*axes[:, 0]))
    found = np.zeros(sight.shape, np.bool_)
    rise = float(np.nanmax(nodes_m[..., 2]) - np.nanmin(nodes_m[..., 2]))
    # Farther along, a line of sight is above all ground.
    reach = min(rise / (max(float(np.nanmin(sight)), 1e-3) * spacing), math.hypot(rows, cols))
    for step in np.arange(1.0, reach + 1, max(1.0, reach / SIGHT_STEPS)):
        at = np.minimum(step / length, 1.0)
        col, row = cv2.split((np.dstack([x, y]) + left * at[..., None]).astype(np.float32))
        outside = cv2.BORDER_CONSTANT
        there = cv2.remap(heights, col, row, cv2.INTER_LINEAR, borderMode=outside, borderValue=-1e4)
        found |= there > nodes_m[..., 2] + sight * step * spacing + CLEAR_M
    return found
