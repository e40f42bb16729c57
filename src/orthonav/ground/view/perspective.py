"""The map as the camera of a view would see it."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera, camera_rays, enu_from_camera
from orthonav.core.localize.view import Orientation
from orthonav.core.records import Telemetry
from orthonav.ground.report.imagery import Grey, Mask, SheetImagery
from orthonav.ground.simulate.render import Raster, halved_for, met

FARTHEST = 12.0  # ground farther away than so many heights above it is left blank
COARSE_NODES, MAX_NODES = 64, 512  # of heights: to find the ground in view; and there, at most
RAY_PX = 2  # between rays that are followed first; the ground between them is interpolated
MARGIN_PX = 2  # of windows of imagery, for interpolation
Array = NDArray[np.float64]


def map_in_view(
    sheet: SheetImagery, camera: Camera, telemetry: Telemetry, place_en_m: Array
) -> tuple[Grey, Mask]:
    """Grey and valid (H, W) of a picture of `camera`, with its lens, of the map's imagery over its
    terrain, houses and trees, which hide what is behind them; level ground without a terrain.

    `place_en_m` (2,): the camera in the plane of the sheet. `telemetry`: its attitude (deg) and its
    height (m), above 0, over the ground below or, where the map has none there, the mean around.
    Not valid and 0: sky, ground without imagery or height, and ground farther away than `FARTHEST`
    heights. Raises `MapFileError` where the map is damaged or was changed."""
    reach_m = FARTHEST * telemetry.agl_m
    around = _heights(sheet, place_en_m - reach_m, place_en_m + reach_m, COARSE_NODES).values
    around = around[np.isfinite(around)]
    if not around.size:
        blank = np.zeros((camera.height_px, camera.width_px), np.uint8)
        return blank, blank > 0
    below_m = float(sheet.terrain.at_en_m(place_en_m))
    above_m = telemetry.agl_m + (below_m if np.isfinite(below_m) else float(around.mean()))
    attitude = telemetry.yaw_deg, telemetry.pitch_deg, telemetry.roll_deg
    lean = sheet.sheet.lean
    # Sheared as houses lean on the map, straight rays stay straight; a slope is taken for level.
    shear = np.zeros(2) if lean is None else np.array([lean.east, lean.north])
    place_en_m = place_en_m + shear * telemetry.agl_m
    pose = Orientation(np.array([*place_en_m, above_m]), np.array(attitude))
    lowest_m = float(around.min())
    rays = _rays_enu(camera, pose, _pixels(camera, RAY_PX), shear)
    down = rays[rays[..., 2] < -1e-6]
    ends = down[:, :2] * ((lowest_m - above_m) / down[:, 2:])
    ends = place_en_m + np.clip(np.vstack([ends, np.zeros((1, 2))]), -reach_m, reach_m)
    heights = _heights(sheet, ends.min(axis=0), ends.max(axis=0), MAX_NODES)
    known = np.isfinite(heights.values)
    # Unknown ground hides nothing.
    solid = replace(heights, values=np.where(known, heights.values, lowest_m))
    ground = _met(solid, camera, pose, rays, shear)
    ground[np.linalg.norm(ground - pose.position_m, axis=-1) > reach_m] = np.nan
    share = replace(heights, values=known.astype(np.float32))
    ground[share.at(ground[..., 0], ground[..., 1]) < 0.5] = np.nan
    return _drawn(sheet, ground, halved_for(ground, camera, pose.position_m, sheet.grid.gsd_m))


def _pixels(camera: Camera, every: int = 1) -> Array:
    """Middles (h, w, 2) of pixels, or of squares of so many across."""
    sides = camera.width_px, camera.height_px
    middles = ((np.arange(-(-side // every)) + 0.5) * side / -(-side // every) for side in sides)
    return np.asarray(np.stack(np.meshgrid(*middles), axis=-1), np.float64)


def _rays_enu(camera: Camera, pose: Orientation, px: Array, shear: Array) -> Array:
    """Directions (..., 3) of pixels (..., 2), sheared by (2,) metres per metre up; NaN beyond the
    lens."""
    rays = camera_rays(camera, px.reshape(-1, 2)) @ enu_from_camera(*pose.attitude_deg.tolist()).T
    rays[:, :2] += rays[:, 2:] * shear
    return np.asarray(rays.reshape(*px.shape[:-1], 3))


def _met(heights: Raster, camera: Camera, pose: Orientation, rays: Array, shear: Array) -> Array:
    """Ground points (H, W, 3), NaN for none, by `rays` (h, w, 3) and, at edges, those between."""
    few, size_px = met(heights, rays, pose.position_m), (camera.width_px, camera.height_px)
    ground = np.asarray(cv2.resize(few, size_px, interpolation=cv2.INTER_LINEAR))
    nearest = cv2.resize(few, size_px, interpolation=cv2.INTER_NEAREST)
    moved_m, range_m = (np.linalg.norm(ground - of, axis=-1) for of in (nearest, pose.position_m))
    drop_m = pose.position_m[2] - ground[..., 2]
    # On level ground a pixel is range^2 / (focal length * drop) long.
    edge = ~(moved_m * drop_m < RAY_PX / camera.fx_px * range_m**2)
    px = _pixels(camera)[edge][None]
    ground[edge] = met(heights, _rays_enu(camera, pose, px, shear), pose.position_m)[0]
    return np.asarray(ground, np.float64)


def _heights(sheet: SheetImagery, low_en_m: Array, high_en_m: Array, nodes: int) -> Raster:
    """Of terrain, houses and trees above sea, between two corners; at most so many across."""
    layers = (sheet.sheet.terrain, sheet.sheet.surface)
    side_m = float((high_en_m - low_en_m).max())
    finest_m = min((info.posting_m for info in layers if info is not None), default=side_m)
    posting_m = max(finest_m, side_m / nodes)
    west, north = float(low_en_m[0]), float(high_en_m[1])
    cols, rows = np.ceil((high_en_m - low_en_m) / posting_m).astype(int) + 1
    steps = np.stack(np.meshgrid(np.arange(cols) + 0.5, np.arange(rows) + 0.5), axis=-1)
    points = np.array([west, north]) + steps * [posting_m, -posting_m]
    found = sheet.terrain.at_en_m(points)
    if sheet.surface is not None:
        found = found + np.nan_to_num(sheet.surface.at_en_m(points))
    return Raster(found.astype(np.float32), west, north, posting_m)


def _drawn(sheet: SheetImagery, ground_m: Array, halved: Array) -> tuple[Grey, Mask]:
    """Imagery at ground points (H, W, 3), averaged so many times (H, W) by two; -1: none."""
    drawn = np.zeros((*halved.shape, 2))
    for times in np.unique(halved[halved >= 0]):
        here, pixel_m = halved == times, sheet.grid.gsd_m * 2.0**times
        east, north, _ = ground_m[here].T
        west, south = (float(each.min()) - MARGIN_PX * pixel_m for each in (east, north))
        cols = int(np.ptp(east) / pixel_m) + 2 * MARGIN_PX + 1
        rows = int(np.ptp(north) / pixel_m) + 2 * MARGIN_PX + 1
        top = south + rows * pixel_m
        grey, valid = sheet.crop((west, south, west + cols * pixel_m, top), (cols, rows))
        window = np.dstack([grey, valid.astype(np.uint8) * 255])
        drawn[here] = Raster(window, west, top, pixel_m).at(east, north)
    valid = drawn[..., 1] > 127
    return np.where(valid, np.rint(drawn[..., 0]), 0).astype(np.uint8), valid
