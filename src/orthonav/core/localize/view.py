"""A view checked and rectified with its own heading up. What cannot be placed becomes a `NoFix`.

Rectified: as if the camera had looked straight down, at the map's resolution, over flat ground,
north up or heading up, or over a terrain. Rolling shutter is ignored."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError
from orthonav.core.geo.camera import (
    Camera,
    axis_on_ground_en_m,
    camera_from_en,
    counted_from_centres,
    enu_from_camera,
    footprint_en_m,
    ground_en_m,
    seen_px,
)
from orthonav.core.records import (
    DEFAULT_AGL_STD,
    DEFAULT_YAW_STD_DEG,
    MIN_YAW_STD_DEG,
    NoFix,
    Telemetry,
    View,
    has_type,
)
from orthonav.core.register.kernel import KERNEL
from orthonav.core.register.template import Levels, ViewTemplates
from orthonav.core.register.window import DirectionPrior

NODE_PX = 4
"""Spacing of heights and projections: at most one and a half postings of a usual terrain."""
MAX_COARSER = 3.0
"""Coarser ground, over the window's pixel and the view's finest ground, does not count."""
Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Orientation:
    """`position_m` (3,): east, north, above sea; `attitude_deg` (3,): heading, pitch, roll."""

    position_m: Array
    attitude_deg: Array

    def moved(self, step: Array) -> "Orientation":
        """By metres and degrees (6,)."""
        return Orientation(self.position_m + step[:3], self.attitude_deg + step[3:])

    def seen_px(self, camera: Camera, ground_m: Array) -> Array:
        """Image points (..., 2) of ground points (..., 3); NaN where they cannot be seen."""
        rays = (ground_m - self.position_m) @ enu_from_camera(*self.attitude_deg.tolist())
        return seen_px(camera, rays)


def node_px(shape: tuple[int, int], finer: int = 1) -> Array:
    """Of the nodes (h, w, 2) of a window, x and y; with so many times as many per axis."""
    step = NODE_PX / finer
    rows, cols = (np.arange(0.5, side + 2 * NODE_PX, step) for side in shape)
    return np.stack(np.meshgrid(cols, rows), axis=-1)


def orthorectified(
    view: View,
    orientation: Orientation,
    nodes_m: Array,
    shape: tuple[int, int],
    sheared_m: tuple[Array, Array] | None = None,
) -> tuple[NDArray[np.uint8], Mask]:
    """Grey and valid (H, W) of a window of ground; grey 0 where not valid.

    `nodes_m` (h, w, 3): east, north, above sea at `node_px`; NaN where unknown. `sheared_m`: where
    houses lean, the nodes where the map shows them, an even grid, and the camera (3,) moved alike.
    """
    index = orientation.seen_px(view.camera, nodes_m) - 0.5
    usable = _fine(view, index) & ~hidden(*(sheared_m or (nodes_m, orientation.position_m)))
    index[~usable] = np.nan
    return _unmasked(view, lambda picture: _at_nodes(picture, index, shape))


def _unmasked(
    view: View, rectified: Callable[[NDArray[np.uint8]], tuple[NDArray[np.uint8], Mask]]
) -> tuple[NDArray[np.uint8], Mask]:
    """Grey and valid (H, W), not valid where the camera's mask hides the ground."""
    grey, valid = rectified(view.grey)
    if view.camera.mask is None:
        return grey, valid
    shown = rectified(view.camera.mask)[0] > 254  # nothing but ground
    return np.where(shown, grey, 0).astype(np.uint8), valid & shown


def _at_nodes(
    picture: NDArray[np.uint8], nodes_px: Array, shape: tuple[int, int]
) -> tuple[NDArray[np.uint8], Mask]:
    """Grey and valid (H, W) by where nodes (h, w, 2) lie, from pixel centres; NaN: not usable."""
    if KERNEL is not None:
        made = np.empty(shape, np.uint8), np.empty(shape, np.bool_)
        KERNEL.rectify(picture, nodes_px.astype(np.float32), *made)
        return made
    usable = np.asarray(np.isfinite(nodes_px).all(axis=-1), np.bool_)
    seen = np.where(usable[..., None], nodes_px, -10.0)
    planes = np.dstack([seen, usable]).astype(np.float32)
    part = np.array([[1 / NODE_PX, 0, 0], [0, 1 / NODE_PX, 0]])
    size = shape[1], shape[0]
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    x, y, counted = cv2.split(cv2.warpAffine(planes, part, size, flags=flags))
    high, wide = picture.shape
    valid = (counted > 0.999) & (x >= -0.5) & (y >= -0.5) & (x <= wide - 0.5) & (y <= high - 0.5)
    grey = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(valid, grey, 0).astype(np.uint8), np.asarray(valid, np.bool_)


def rectified_flat(
    view: View, orientation: Orientation, en_from_window: Array, shape: tuple[int, int]
) -> tuple[NDArray[np.uint8], Mask] | None:
    """As `orthorectified` over flat ground at 0 m, by one homography; None where the lens or the
    tilt needs more. `en_from_window` (3, 3): metres by pixels of the window, pixel-is-area."""
    if not view.camera.is_pinhole:
        return None
    east, north, above_m = orientation.position_m.tolist()
    offset = np.array([[1.0, 0, -east], [0, 1, -north], [0, 0, -above_m]])
    camera_from_en = enu_from_camera(*orientation.attitude_deg.tolist()).T @ offset
    camera_from_window = camera_from_en @ en_from_window
    corners = _corners(shape)
    depth = corners @ camera_from_window[2]
    # Areas of pixels on the ground grow with the cube of the depth: all are fine enough.
    if not 0 < depth.max() < MAX_COARSER ** (2 / 3) * depth.min():
        return None
    return _unmasked(view, partial(_warped, view.camera, camera_from_window, shape, corners))


def _corners(shape: tuple[int, int]) -> Array:
    """Of a window (4, 3), homogeneous."""
    height, width = shape
    return np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1.0]])


def _fine(view: View, index: Array) -> Mask:
    """Which nodes (h, w), with image points (h, w, 2), are seen finely enough."""
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
    """Which ground points (h, w, 3) of a window its own ground hides from the camera."""
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
    for step in np.arange(1.0, reach + 1, max(1.0, reach / 48)):
        at = np.minimum(step / length, 1.0)
        col, row = cv2.split((np.dstack([x, y]) + left * at[..., None]).astype(np.float32))
        outside = cv2.BORDER_CONSTANT
        there = cv2.remap(heights, col, row, cv2.INTER_LINEAR, borderMode=outside, borderValue=-1e4)
        error_m = 0.5  # of interpolation
        found |= there > nodes_m[..., 2] + sight * step * spacing + error_m
    return found


MAX_REACH = 2.0
NEAR_CELLS = 32  # along both sides of a picture, to find how finely it sees the ground


@dataclass(frozen=True, eq=False)
class RectifiedView:
    """A vertical picture (H, W), north up or heading up; grey 0 where not valid.

    `offset_en_m`: centre of the window, metres east and north of the camera."""

    grey: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    offset_en_m: Array


def is_oblique(view: View) -> bool:
    """Far off nadir, or cropped so that the principal point is missing: see `near_part`."""
    camera = view.camera
    inside = 0 <= camera.cx_px <= camera.width_px and 0 <= camera.cy_px <= camera.height_px
    return not inside or off_nadir_deg(view.telemetry) > 45.0


def off_nadir_deg(telemetry: Telemetry) -> float:
    """Of the optical axis."""
    up = enu_from_camera(0.0, telemetry.pitch_deg, telemetry.roll_deg)[2, 2]
    return math.degrees(math.acos(max(-1.0, min(1.0, -float(up)))))


@dataclass(frozen=True)
class NearPart:
    """The part of a view seen finely enough, on flat ground, for a heading of 0: its box `low_m`,
    `high_m`, east and north, what is seen of it, and its finest pixel."""

    low_m: Array
    high_m: Array
    area_m2: float
    finest_m: float


def near_part(view: View, gsd_m: float) -> NearPart | None:
    """Not much coarser than the finest part and than `gsd_m`; None where no ground is seen."""
    camera, telemetry = view.camera, view.telemetry
    cells = [np.linspace(0, side, NEAR_CELLS + 1) for side in (camera.width_px, camera.height_px)]
    px = np.stack(np.meshgrid(*cells), axis=-1).reshape(-1, 2)
    angles = 0.0, telemetry.pitch_deg, telemetry.roll_deg, telemetry.agl_m
    ground = ground_en_m(camera, px, *angles).reshape(NEAR_CELLS + 1, NEAR_CELLS + 1, 2)
    along, down = ground[1:, 1:] - ground[:-1, :-1], ground[1:, :-1] - ground[:-1, 1:]
    with np.errstate(invalid="ignore"):
        # Half the product of the diagonals of each cell.
        area = np.abs(along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0]) / 2
        pixel_m = np.sqrt(area * (NEAR_CELLS**2 / (camera.width_px * camera.height_px)))
        finest_m = float(np.nanmin(pixel_m, initial=math.inf))
        used = pixel_m <= MAX_COARSER * max(finest_m, gsd_m)
    if not used.any():
        return None
    corners = np.stack([ground[:-1, :-1][used], ground[1:, 1:][used], ground[:-1, 1:][used]])
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    return NearPart(low, high, float(area[used].sum()), finest_m)


def downsampled(view: View, gsd_m: float) -> View:
    """Averaged by whole numbers towards `gsd_m`, so that resampling cannot alias."""
    camera, agl_m = view.camera, view.telemetry.agl_m
    pixel_m = camera.gsd_m(agl_m)
    if is_oblique(view) and (near := near_part(view, gsd_m)) is not None:
        pixel_m = near.finest_m
    factor = int(gsd_m / max(pixel_m, 1e-9))  # heights may be absurd, not yet refused
    width, height = camera.width_px // max(1, factor), camera.height_px // max(1, factor)
    if factor < 2 or width < 8 or height < 8:
        return view
    # Whole multiples only: what is left over at the right and below is not worth a slower path.
    rows, cols = height * factor, width * factor
    mask = None if camera.mask is None else camera.mask[:rows, :cols]
    whole = replace(camera, width_px=cols, height_px=rows, mask=mask)
    used = view.grey[:rows, :cols]
    return replace(view, grey=_thinned(used, factor), camera=whole.resized(width, height))


def _thinned(grey: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Means over squares of `factor` pixels, whole multiples of which the sides are."""
    height, width = (side // factor for side in grey.shape)
    # The kernel makes pictures smaller, as OpenCV, by these factors.
    if KERNEL is None or not 3 <= factor <= 256:
        thinned = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
        return np.asarray(thinned, dtype=np.uint8)
    out = np.empty((height, width), np.uint8)
    KERNEL.thin(grey, factor, out)
    return out


def rectify(view: View, *, gsd_m: float, size_px: int) -> RectifiedView:
    """A square, north up, where the optical axis, which must descend, meets the ground."""
    telemetry = view.telemetry
    attitude = telemetry.yaw_deg, telemetry.pitch_deg, telemetry.roll_deg, telemetry.agl_m
    offset = np.array(axis_on_ground_en_m(*attitude))
    grey, valid = _window(view, attitude, offset, gsd_m, (size_px, size_px))
    return RectifiedView(grey, valid, offset)


def rectify_footprint(view: View, *, gsd_m: float, multiple_px: int) -> RectifiedView:
    """What the camera sees, its own heading up, sides whole multiples of `multiple_px`.

    Remainders are cut off, so that a vertical view has no pixels not seen; a tilted one is kept to
    `MAX_REACH` times the half sides of a vertical one. `offset_en_m` is that of a heading of 0."""
    camera, telemetry = view.camera, view.telemetry
    pitch_deg, roll_deg, agl_m = telemetry.pitch_deg, telemetry.roll_deg, telemetry.agl_m
    if is_oblique(view):
        return _rectify_near(view, gsd_m, multiple_px)
    axis = np.array(axis_on_ground_en_m(0.0, pitch_deg, roll_deg, agl_m))
    half_m = np.array(camera.extent) * agl_m / 2
    low, high = axis - MAX_REACH * half_m, axis + MAX_REACH * half_m
    try:
        corners = footprint_en_m(camera, 0.0, pitch_deg, roll_deg, agl_m)
        low, high = np.maximum(low, corners.min(axis=0)), np.minimum(high, corners.max(axis=0))
    except CameraError:
        pass  # the horizon is in the view: as far as it may reach
    width, height = (
        max(1, int(side / gsd_m / multiple_px + 1e-6)) * multiple_px for side in high - low
    )
    middle = (low + high) / 2
    attitude = 0.0, pitch_deg, roll_deg, agl_m
    grey, valid = _window(view, attitude, middle, gsd_m, (height, width))
    return RectifiedView(grey, valid, middle)


def _rectify_near(view: View, gsd_m: float, multiple_px: int) -> RectifiedView:
    telemetry, near = view.telemetry, near_part(view, gsd_m)
    if near is None:
        empty = np.zeros((multiple_px, multiple_px), np.uint8)
        return RectifiedView(empty, empty > 0, np.zeros(2))
    middle = (near.low_m + near.high_m) / 2
    width, height = (
        max(1, int(side / gsd_m / multiple_px)) * multiple_px for side in near.high_m - near.low_m
    )
    px = node_px((height, width)) - [width / 2, height / 2]
    nodes = np.dstack([middle + px * [gsd_m, -gsd_m], np.zeros(px.shape[:2])])
    position = np.array([0.0, 0.0, telemetry.agl_m])
    attitude = np.array([0.0, telemetry.pitch_deg, telemetry.roll_deg])
    made = orthorectified(view, Orientation(position, attitude), nodes, (height, width))
    return RectifiedView(*made, middle)


def _window(
    view: View,
    attitude: tuple[float, float, float, float],
    middle_en_m: Array,
    gsd_m: float,
    shape: tuple[int, int],
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Of the window of ground about `middle_en_m`, metres from the camera."""
    height, width = shape
    west, north = middle_en_m + np.array([-width, height]) * gsd_m / 2
    en_from_window = np.array([[gsd_m, 0, west], [0, -gsd_m, north], [0, 0, 1]])
    camera_from_window = camera_from_en(*attitude) @ en_from_window
    corners = _corners(shape)
    depth = corners @ camera_from_window[2]
    if not view.camera.is_pinhole or depth.min() <= 0:
        return _unmasked(view, partial(_remapped, view.camera, camera_from_window, shape))
    return _unmasked(view, partial(_warped, view.camera, camera_from_window, shape, corners))


def _warped(
    camera: Camera,
    camera_from_window: Array,
    shape: tuple[int, int],
    corners: Array,
    picture: NDArray[np.uint8],
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Without distortion and horizon: one homography."""
    size = shape[1], shape[0]
    px_from_window = camera.matrix @ camera_from_window
    matrix = counted_from_centres(px_from_window)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    grey = cv2.warpPerspective(picture, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    projected = corners @ px_from_window.T
    seen = projected[:, :2] / projected[:, 2:]
    height, width = picture.shape
    if (seen >= -1e-6).all() and (seen <= np.array([width, height]) + 1e-6).all():
        valid = np.ones(shape, dtype=np.bool_)
    else:
        inside = np.full(picture.shape, 255, dtype=np.uint8)
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        valid = cv2.warpPerspective(inside, matrix, size, flags=flags) > 0
        grey = np.where(valid, grey, 0)
    return np.asarray(grey, dtype=np.uint8), np.asarray(valid, dtype=np.bool_)


def _remapped(
    camera: Camera,
    camera_from_window: Array,
    shape: tuple[int, int],
    picture: NDArray[np.uint8],
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Every pixel through lens and horizon."""
    height, width = shape
    # Seldom needed for every pixel: between nodes straight lines are exact enough.
    sides = [np.arange(0.5, side + 3 * NODE_PX, NODE_PX, dtype=np.float64) for side in shape]
    nodes = _seen_px(camera, camera_from_window, *sides) - 0.5
    if _is_smooth(nodes, picture.shape):
        part = np.array([[1 / NODE_PX, 0, 0], [0, 1 / NODE_PX, 0]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        index = cv2.warpAffine(nodes.astype(np.float32), part, (width, height), flags=flags)
    else:  # the view tilts far, or the horizon or the end of the lens lies within
        sides = [np.arange(0.5, side, dtype=np.float64) for side in shape]
        index = (_seen_px(camera, camera_from_window, *sides) - 0.5).astype(np.float32)
    x, y = cv2.split(np.asarray(index, np.float32))
    high, wide = picture.shape
    with np.errstate(invalid="ignore"):
        valid = (x >= -0.5) & (y >= -0.5) & (x <= wide - 0.5) & (y <= high - 0.5)
    x[~valid] = -10
    grey = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    grey[~valid] = 0
    return np.asarray(grey, np.uint8), np.asarray(valid, np.bool_)


def _is_smooth(index: Array, shape: tuple[int, ...]) -> bool:
    """Whether lines between nodes (H, W, 2) miss by less than 0.02 px.

    Between every other node they miss by four times as much, which the skipped nodes show."""
    odd = [side // 2 * 2 - 1 for side in index.shape[:2]]
    even = index[: odd[0] : 2, : odd[1] : 2]
    middle = (even[:-1, :-1] + even[1:, :-1] + even[:-1, 1:] + even[1:, 1:]) / 4
    exact = index[1 : odd[0] : 2, 1 : odd[1] : 2]
    size = np.array(shape[::-1])
    near = (np.abs(exact - size / 2) < 0.6 * size + NODE_PX).all(axis=-1)
    missed = np.abs(middle - exact)[near].max(initial=0.0) / 4
    return bool(np.isfinite(index).all() and missed < 0.02)


def _seen_px(camera: Camera, camera_from_window: Array, rows: Array, cols: Array) -> Array:
    """Of a grid of the window (H, W, 2), NaN where nothing is seen."""
    x, y = np.meshgrid(cols, rows)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ camera_from_window.T
    return seen_px(camera, rays)


@dataclass(frozen=True)
class ViewLimits:
    """What a view must be to be searched for (docs/decisions/registration.md)."""

    max_tilt_deg: float = 65.0
    min_side_px: int = 32  # of the picture
    min_view_px: float = 24.0
    """Of the map: a sixth of the size of views at the final level."""
    max_coarser: float = 4.0  # a pixel of the view, in pixels of the map
    dark: float = 16.0
    bright: float = 250.0
    """Grey levels that 1 % of the view must exceed, or stay below."""
    min_std: float = 3.0  # of the grey levels
    min_agl_std: float = 0.03  # of the log scale searched, whatever is reported
    max_agl_std: float = 0.15
    """Three are scales of 0.64 to 1.57: between these chance was measured to be alike."""
    near_share: float = 0.6
    """A part far off nadir has the levels of one so many times smaller (docs/terrain.md)."""


LIMITS = ViewLimits()


def check_view(view: View, gsd_m: float, heading_known: bool) -> NoFix | None:
    has_type("view", view, View, ", as of View.of(..)")
    refused = check_telemetry(view.telemetry, view.camera, gsd_m, heading_known)
    return refused or check_picture(view.grey, view.camera.mask)


def check_telemetry(
    telemetry: Telemetry, camera: Camera, gsd_m: float | None, heading_known: bool
) -> NoFix | None:
    """Without `gsd_m` its size beside a map is not checked."""
    missing = [name for name in telemetry.missing() if heading_known or name != "yaw_deg"]
    if missing:
        names = ", ".join(missing).replace("yaw_deg", "heading_deg (yaw_deg)")
        return NoFix("missing_telemetry", f"not a number: {names}")
    if telemetry.agl_m <= 0:
        return NoFix("bad_height", f"height above ground is {telemetry.agl_m:.1f} m")
    tilt_deg = off_nadir_deg(telemetry)
    if tilt_deg > LIMITS.max_tilt_deg:
        return NoFix(
            "extreme_tilt",
            f"camera tilts {tilt_deg:.0f} deg, at most {LIMITS.max_tilt_deg:.0f} can be used; "
            "pitch and roll are 0 for a camera that looks down",
        )
    if min(camera.width_px, camera.height_px) < LIMITS.min_side_px:
        return NoFix("too_small", f"view is {camera.width_px} x {camera.height_px} px")
    if gsd_m is None:
        return None
    side_px = footprint_side_m(telemetry, camera) / gsd_m
    if side_px < LIMITS.min_view_px:
        return _too_small(side_px, LIMITS.min_view_px, f"{telemetry.agl_m:.0f} m above ground, ")
    coarser = camera.gsd_m(telemetry.agl_m) / gsd_m
    if coarser > LIMITS.max_coarser:
        return NoFix("too_coarse", f"a pixel of the view covers {coarser:.3g} pixels of the map")
    return None


def footprint_side_m(telemetry: Telemetry, camera: Camera) -> float:
    """Root of the area of flat ground expected from the telemetry."""
    tilt = math.cos(math.radians(telemetry.pitch_deg)) * math.cos(math.radians(telemetry.roll_deg))
    # The area seen grows with the inverse cube of the cosine of the tilt; beyond 60 deg the
    # footprint is cut off.
    across, along = camera.extent
    return telemetry.agl_m * math.sqrt(across * along / max(tilt, 0.5) ** 3)


def check_picture(grey: NDArray[np.uint8], mask: NDArray[np.uint8] | None = None) -> NoFix | None:
    """Too dark, too bright, blank, where the mask of the camera shows ground?"""
    sample = grey[::8, ::8]
    if mask is not None:
        sample = sample[mask[::8, ::8] > 0]
        if sample.size == 0:
            return NoFix("blank", "the mask of the camera leaves too little of the view")
    (low, high), std = np.percentile(sample, (1, 99)), float(sample.std())
    if high < LIMITS.dark:
        return NoFix("too_dark", f"99 % of the view is {high:.0f} of 255 or darker")
    if low > LIMITS.bright:
        return NoFix("too_bright", f"99 % of the view is {low:.0f} of 255 or brighter")
    if std < LIMITS.min_std:
        return NoFix("blank", f"grey levels differ by {std:.1f} of 255 only (standard deviation)")
    return None


def check_rectified(view: RectifiedView, min_valid_share: float) -> NoFix | None:
    share = float(view.valid.mean())
    if share < min_valid_share or share == 0:
        return NoFix(
            "too_small", f"view covers {share:.0%} of a tile, {min_valid_share:.0%} are needed"
        )
    return _check_contrast(view)


def check_footprint(view: RectifiedView, pixel: float, min_side_px: float) -> NoFix | None:
    """`pixel`: size of its pixels in pixels of the map, the unit of `min_side_px`."""
    side = math.sqrt(cv2.countNonZero(view.valid.view(np.uint8))) * pixel
    return _too_small(side, min_side_px) if side < min_side_px else _check_contrast(view)


def _too_small(side_px: float, least_px: float, where: str = "") -> NoFix:
    detail = f"{where}view covers {side_px:.0f} pixels of the map across, {least_px:.0f} needed"
    return NoFix("too_small", detail)


def _check_contrast(view: RectifiedView) -> NoFix | None:
    _, std = cv2.meanStdDev(view.grey, mask=view.valid.view(np.uint8))
    if float(std[0, 0]) < LIMITS.min_std / 2:
        return NoFix("blank", "the part of the view that would be compared is uniform")
    return None


@dataclass(frozen=True, eq=False)
class PreparedView:
    """A view made ready for registration. `side_px`: root of the area seen, `camera_px` (2,): of
    the camera from the middle of the view, right and down; both in pixels of level 0."""

    view: View
    gsd_m: float
    levels: Levels
    templates: ViewTemplates
    side_px: float
    camera_px: NDArray[np.float64]
    prior: DirectionPrior
    _pictures: dict[int, View]

    @property
    def telemetry(self) -> Telemetry:
        return self.view.telemetry

    def picture_at(self, level: int) -> View:
        """Averaged towards the resolution of a level, once."""
        if level not in self._pictures:
            self._pictures[level] = downsampled(self.view, self.gsd_m * 2**level)
        return self._pictures[level]

    def by_gradients(self) -> "PreparedView":
        """The same, compared without its grey levels."""
        return replace(self, templates=self.templates.weighing_grey(0.0))

    def rectified_at(self, level: int) -> RectifiedView:
        return _rectified(self.picture_at(level), self.gsd_m, self.levels, level)


def prepare(
    view: View, gsd_m: float, map_levels: int, heading_known: bool, *, finer: bool = False
) -> PreparedView | NoFix:
    """`gsd_m`: of level 0 of the map; `finer`: as of `Levels.of`."""
    camera, telemetry = view.camera, view.telemetry
    nominal_m = footprint_side_m(telemetry, camera)
    if is_oblique(view):
        near = near_part(view, gsd_m)
        if near is None:
            return NoFix("too_small", "the view shows no ground that is near enough")
        nominal_m = LIMITS.near_share * math.sqrt(near.area_m2)
    levels = Levels.of(nominal_m / gsd_m, map_levels, finer=finer)
    unit_px = 2**levels.final
    picture = downsampled(view, gsd_m * unit_px)
    rectified = _rectified(picture, gsd_m, levels, levels.final)
    refused = check_footprint(rectified, unit_px, LIMITS.min_view_px)
    if refused is not None:
        return refused
    offset = rectified.offset_en_m / gsd_m
    return PreparedView(
        view,
        gsd_m,
        levels,
        ViewTemplates(rectified.grey, rectified.valid, levels.final),
        math.sqrt(float(rectified.valid.sum())) * unit_px,
        np.array([-offset[0], offset[1]]),
        pose_prior(telemetry, heading_known, camera.focal_std),
        {levels.final: picture},
    )


def _rectified(picture: View, gsd_m: float, levels: Levels, level: int) -> RectifiedView:
    """Its sides are whole pixels of the coarse level."""
    multiple = 2 ** max(0, levels.coarse - level)
    return rectify_footprint(picture, gsd_m=gsd_m * 2**level, multiple_px=multiple)


def pose_prior(telemetry: Telemetry, heading_known: bool, focal_std: float = 0.0) -> DirectionPrior:
    yaw_std = _or_default(telemetry.yaw_std_deg, DEFAULT_YAW_STD_DEG)
    agl_std_m = telemetry.agl_std_m
    agl_std = None if agl_std_m is None else agl_std_m / telemetry.agl_m
    scale_std = math.hypot(_or_default(agl_std, DEFAULT_AGL_STD), focal_std)
    return DirectionPrior(
        math.radians(telemetry.yaw_deg) if heading_known else None,
        math.radians(min(max(yaw_std, MIN_YAW_STD_DEG), 90.0)),
        min(max(scale_std, LIMITS.min_agl_std), LIMITS.max_agl_std),
    )


def _or_default(value: float | None, default: float) -> float:
    return default if value is None or not math.isfinite(value) else value
