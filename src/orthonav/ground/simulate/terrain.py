"""Flights over a terrain: the ground below, what a camera sees of it, and the heights that an
autopilot reports."""

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from orthonav.core.errors import AreaError
from orthonav.core.geo.camera import Camera, ground_en_m
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.ground import TerrainHeights
from orthonav.core.records import Telemetry
from orthonav.ground.simulate.imagery import GroundImagery
from orthonav.ground.simulate.perspective import Raster, coloured, met, rays_enu

MAX_NODES = 4000
"""Heights along a side of the area, at most; bounds their memory."""
READ_ROWS = 64
FARTHEST = 12.0
"""Ground farther away than so many heights above it is not rendered: it is sky."""
NEAR = 3.0
"""Ground nearer than so many heights must be covered by imagery."""
MANY_PX = 500_000
"""Of larger pictures every second ray is followed."""
BORDER = 9
Array = NDArray[np.float64]


def ground_below_m(terrain: TerrainHeights, frame: LocalFrame, places_en_m: Array) -> Array:
    """Heights of the ground (N,) above mean sea level below places (N, 2) of a plane.

    Raises `AreaError` where one is unknown.
    """
    lat, lon = frame.latlon_from_en(places_en_m)
    found = terrain(lat, lon)
    unknown = np.flatnonzero(~np.isfinite(found))
    if len(unknown):
        first = int(unknown[0])
        raise AreaError(
            f"the terrain has no height below a view, at {lat[first]:.5f}, {lon[first]:.5f}"
        )
    return found


def reported_heights(
    telemetry: Telemetry, agl_m: float, home_m: float | None, amsl_m: float
) -> Telemetry:
    """The telemetry with heights above sea and take-off in place of a measured one above ground.

    `agl_m`, `home_m`, `amsl_m`: true heights; all are reported with the error of that above ground.
    As in imports without a terrain, the height above take-off stands for that above ground.
    """
    error_m = telemetry.agl_m - agl_m
    above_home_m = None if home_m is None else round(home_m + error_m, 3)
    return replace(
        telemetry,
        agl_m=math.nan if above_home_m is None else above_home_m,
        home_m=above_home_m,
        amsl_m=round(amsl_m + error_m, 3),
    )


def surface_of(
    terrain: TerrainHeights | None,
    frame: LocalFrame,
    extent_en_m: tuple[float, float, float, float],
    posting_m: float,
) -> Raster:
    """Heights over a plane, west, south, east, north; holes have the height of their border.

    Level ground at 0 without `terrain`. Raises `AreaError` where no height is known.
    """
    west, south, east, north = extent_en_m
    across = max(east - west, north - south)
    if terrain is None:
        return Raster(np.zeros((1, 1), np.float32), west, north, across)
    posting_m = max(posting_m, across / MAX_NODES)
    x = west + (np.arange(math.ceil((east - west) / posting_m)) + 0.5) * posting_m
    y = north - (np.arange(math.ceil((north - south) / posting_m)) + 0.5) * posting_m
    rows = []
    for start in range(0, len(y), READ_ROWS):
        points = np.stack(np.meshgrid(x, y[start : start + READ_ROWS]), axis=-1)
        rows.append(terrain(*frame.latlon_from_en(points)))
    heights = np.concatenate(rows)
    unknown = ~np.isfinite(heights)
    if unknown.all():
        raise AreaError("the terrain does not reach to the imagery that is flown over")
    nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return Raster(heights[tuple(nearest)].astype(np.float32), west, north, posting_m)


def seen_over(
    surface: Raster,
    imagery: GroundImagery,
    camera: Camera,
    attitude_deg: tuple[float, float, float],
    position_m: Array,
    agl_m: float,
    margin_px: int,
) -> NDArray[np.uint8]:
    """The picture (H, W, 3) of a camera at `position_m` (3,) over a surface."""
    every = 2 if camera.width_px * camera.height_px > MANY_PX else 1
    if camera.width_px % every or camera.height_px % every:
        every = 1
    followed = camera.resized(camera.width_px // every, camera.height_px // every)
    ground = met(surface, rays_enu(followed, attitude_deg, 1), position_m)
    ground[np.linalg.norm(ground - position_m, axis=-1) > FARTHEST * agl_m] = np.nan
    if every > 1:
        size = camera.width_px, camera.height_px
        ground = np.asarray(cv2.resize(ground, size, interpolation=cv2.INTER_LINEAR))
    seen = ground[np.isfinite(ground[..., 0])]
    if not len(seen):
        raise AreaError("a camera sees no ground")
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    rgb, corner = imagery.window(np.array([low, high]), margin_px)
    raster = Raster(rgb, float(corner[0]), float(corner[1]), imagery.gsd_m)
    return coloured(raster, ground, camera, position_m)


def near_ground_en_m(
    camera: Camera, attitude_deg: tuple[float, float, float], agl_m: float
) -> Array | None:
    """Outline (N, 2), metres from the camera, of the level ground seen that is near enough to need
    imagery; None without any."""
    sides = [np.linspace(0, side, BORDER) for side in (camera.width_px, camera.height_px)]
    px = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    ground = ground_en_m(camera, px, *attitude_deg, agl_m)
    near = ground[np.hypot(*ground.T) <= NEAR * agl_m]  # not where it is NaN
    if len(near) < 3:
        return None
    return np.asarray(cv2.convexHull(near.astype(np.float32))[:, 0], np.float64)
