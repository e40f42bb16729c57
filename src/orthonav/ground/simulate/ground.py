"""The ground flown over: imagery and its coverage, terrain, and what a camera sees of both."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt

from orthonav.core.errors import AreaError
from orthonav.core.geo.camera import Camera, ground_en_m
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.ground import TerrainHeights
from orthonav.core.records import Telemetry
from orthonav.ground.build.layer import POSTING_M, Surface
from orthonav.ground.imagery.mosaic import Mosaic, SheetRaster
from orthonav.ground.imagery.terrain import Dem
from orthonav.ground.planning.area import Area
from orthonav.ground.simulate.render import Raster, coloured, met, rays_enu

COVERAGE_PX = 1024  # size of the coverage mask; bounds its memory for any imagery
MAX_NODES = 4000  # heights along a side of the area, at most; bounds their memory
READ_ROWS = 64
Array = NDArray[np.float64]


class Coverage:
    def __init__(self, mosaic: Mosaic, area: Area) -> None:
        self._west, south, east, self._north = area.extent_en_m
        across = max(east - self._west, self._north - south)
        self._gsd_m = max(mosaic.gsd_m, across / COVERAGE_PX)
        width = math.ceil((east - self._west) / self._gsd_m)
        height = math.ceil((self._north - south) / self._gsd_m)
        with mosaic.sheet(
            area.frame,
            west_m=self._west,
            north_m=self._north,
            width_px=width,
            height_px=height,
            gsd_m=self._gsd_m,
        ) as raster:
            self._missing = ~raster.read_grey(0, 0, width, height).valid

    def whole(self, corners_en_m: Array) -> bool:
        """Whether imagery covers all of the convex polygon (N, 2)."""
        x = (corners_en_m[:, 0] - self._west) / self._gsd_m
        y = (self._north - corners_en_m[:, 1]) / self._gsd_m
        height, width = self._missing.shape
        if min(x.min(), y.min()) < 0 or x.max() > width or y.max() > height:
            return False
        left, top = int(x.min()), int(y.min())
        part = self._missing[top : math.ceil(y.max()), left : math.ceil(x.max())]
        if not part.any():
            return True
        inside = np.zeros(part.shape, dtype=np.uint8)
        corners = np.round(np.stack([x - left, y - top], axis=1) - 0.5).astype(np.int32)
        cv2.fillConvexPoly(inside, corners, 1)
        return not (part & (inside > 0)).any()

    def box_en_m(self) -> tuple[float, float, float, float]:
        """West, south, east, north of a part without holes."""
        top, left, bottom, right = 0, 0, *self._missing.shape
        while (part := self._missing[top:bottom, left:right]).any():
            sides = [part[:, 0], part[0], part[:, -1], part[-1]]
            worst = int(np.argmax([side.mean() for side in sides]))
            left, top = left + (worst == 0), top + (worst == 1)
            right, bottom = right - (worst == 2), bottom - (worst == 3)
        # One pixel less on every side, because the mask is subsampled.
        left, top, right, bottom = left + 1, top + 1, right - 1, bottom - 1
        if left >= right or top >= bottom:
            raise AreaError("imagery has no part without holes that could be mirrored")
        return (
            self._west + left * self._gsd_m,
            self._north - bottom * self._gsd_m,
            self._west + right * self._gsd_m,
            self._north - top * self._gsd_m,
        )


@dataclass(frozen=True, eq=False)
class GroundImagery:
    raster: SheetRaster  # the resampled imagery
    west_m: float
    north_m: float
    gsd_m: float  # metres per pixel
    mirror_en_m: tuple[float, float, float, float] | None = None  # box to mirror at its sides

    def window(self, corners_en_m: Array) -> tuple[NDArray[np.uint8], Array]:
        """Pixels (H, W, 3) of the box around points (N, 2), and the position (2,) of their corner.
        Ground without imagery is mirrored, where a box for this is given."""
        margin_px = 4  # radius of the bicubic kernel, and rounding
        cols = (corners_en_m[:, 0] - self.west_m) / self.gsd_m
        rows = (self.north_m - corners_en_m[:, 1]) / self.gsd_m
        left, top = math.floor(cols.min()) - margin_px, math.floor(rows.min()) - margin_px
        width = math.ceil(cols.max()) + margin_px - left
        height = math.ceil(rows.max()) + margin_px - top
        pixels = self.raster.read(left, top, width, height)
        rgb = pixels.rgb
        if self.mirror_en_m is not None and not pixels.valid.all():
            west, south, east, north = self.mirror_en_m
            x = (np.array([west, east]) - self.west_m) / self.gsd_m
            y = (self.north_m - np.array([north, south])) / self.gsd_m
            col, row = reflected(left, width, x), reflected(top, height, y)
            first = int(col.min()), int(row.min())
            part = self.raster.read(*first, int(np.ptp(col)) + 1, int(np.ptp(row)) + 1)
            filled = part.rgb[np.ix_(row - first[1], col - first[0])]
            rgb = np.where(pixels.valid[..., None], rgb, filled)
        return rgb, np.array([self.west_m + left * self.gsd_m, self.north_m - top * self.gsd_m])


def reflected(first: int, count: int, sides: Array) -> NDArray[np.int64]:
    """Indices from `first` on, mirrored at two sides so that they lie between them."""
    low, high = math.ceil(sides[0]), math.floor(sides[1])
    folded = (np.arange(first, first + count) - low) % (2 * (high - low))
    return np.asarray(low + np.minimum(folded, 2 * (high - low) - 1 - folded))


def bare_earth(surface: Surface, terrain: TerrainHeights | None) -> TerrainHeights:
    """Heights of the ground among houses and trees: of a terrain, or else the lower envelope of the
    surface, as `build` takes them. Raises `ImageryError` where terrain and surface disagree."""
    if terrain is not None:
        if isinstance(terrain, Dem):
            surface.above_m(terrain)
        return terrain
    frame, (west, south, east, north) = surface.area.frame, surface.area.extent_en_m
    posting_m = max(POSTING_M, max(east - west, north - south) / MAX_NODES)
    rows, cols = (math.ceil(side / posting_m) for side in (north - south, east - west))
    parts = [
        surface.envelope(
            west, north - start * posting_m, posting_m, min(READ_ROWS, rows - start), cols
        )
        for start in range(0, rows, READ_ROWS)
    ]
    raster = Raster(np.concatenate(parts), west, north, posting_m)

    def at(lat_deg: ArrayLike, lon_deg: ArrayLike) -> Array:
        points = frame.en_from_latlon(lat_deg, lon_deg)
        return raster.at(points[..., 0], points[..., 1])

    return at


def ground_below_m(terrain: TerrainHeights, frame: LocalFrame, places_en_m: Array) -> Array:
    """Heights of the ground (N,) above mean sea level below places (N, 2) of a plane."""
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
    """True heights above sea and take-off, with the error of that above ground, in its place. As in
    imports without a terrain, the one above take-off stands for it."""
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
    model: Surface | None = None,
) -> Raster:
    """Heights over a plane, west, south, east, north: of a surface `model` where it has some, else
    of `terrain`; holes have the height of their border. Level ground at 0 without `terrain`."""
    west, south, east, north = extent_en_m
    across = max(east - west, north - south)
    if terrain is None:
        return Raster(np.zeros((1, 1), np.float32), west, north, across)
    posting_m = max(posting_m, across / MAX_NODES)
    x = west + (np.arange(math.ceil((east - west) / posting_m)) + 0.5) * posting_m
    y = north - (np.arange(math.ceil((north - south) / posting_m)) + 0.5) * posting_m
    rows, reached = [], False
    for start in range(0, len(y), READ_ROWS):
        points = np.stack(np.meshgrid(x, y[start : start + READ_ROWS]), axis=-1)
        found = terrain(*frame.latlon_from_en(points))
        if model is not None:
            corner = west, north - start * posting_m
            seen = model.sampled(*corner, posting_m, *found.shape)
            reached |= bool(np.isfinite(seen).any())
            found = np.where(np.isfinite(seen), seen, found)
        rows.append(found)
    heights = np.concatenate(rows)
    unknown = ~np.isfinite(heights)
    if unknown.all() or (model is not None and not reached):
        what = "terrain" if model is None else "surface"
        raise AreaError(f"the {what} does not reach to the imagery that is flown over")
    nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return Raster(heights[tuple(nearest)].astype(np.float32), west, north, posting_m)


def seen_over(
    surface: Raster,
    imagery: GroundImagery,
    camera: Camera,
    attitude_deg: tuple[float, float, float],
    position_m: Array,
    agl_m: float,
) -> NDArray[np.uint8]:
    """The picture (H, W, 3) of a camera at `position_m` (3,) over a surface. Of large pictures
    every second ray is followed; ground farther away than 12 heights is sky."""
    large = camera.width_px * camera.height_px > 500_000
    every = 2 if large and camera.width_px % 2 == camera.height_px % 2 == 0 else 1
    followed = camera.resized(camera.width_px // every, camera.height_px // every)
    ground = met(surface, rays_enu(followed, attitude_deg, 1), position_m)
    ground[np.linalg.norm(ground - position_m, axis=-1) > 12 * agl_m] = np.nan
    if every > 1:
        size = camera.width_px, camera.height_px
        ground = np.asarray(cv2.resize(ground, size, interpolation=cv2.INTER_LINEAR))
    seen = ground[np.isfinite(ground[..., 0])]
    if not len(seen):
        raise AreaError("a camera sees no ground")
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    rgb, corner = imagery.window(np.array([low, high]))
    raster = Raster(rgb, float(corner[0]), float(corner[1]), imagery.gsd_m)
    return coloured(raster, ground, camera, position_m)


def near_ground_en_m(
    camera: Camera, attitude_deg: tuple[float, float, float], agl_m: float
) -> Array | None:
    """Outline (N, 2), metres from the camera, of the level ground seen that is near enough to need
    imagery, within 3 heights; None without any."""
    sides = [np.linspace(0, side, 9) for side in (camera.width_px, camera.height_px)]
    px = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    ground = ground_en_m(camera, px, *attitude_deg, agl_m)
    near = ground[np.hypot(*ground.T) <= 3 * agl_m]  # not where it is NaN
    if len(near) < 3:
        return None
    return np.asarray(cv2.convexHull(near.astype(np.float32))[:, 0], np.float64)
