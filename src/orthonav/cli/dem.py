"""Terrain heights from a raster file, for planning."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import ImageryError, MissingFileError
from orthonav.extras import missing_extra
from orthonav.geo.route import Route, leg_lengths_m
from orthonav.geo.swapped import swapped_hint
from orthonav.geo.terrain import TerrainHeights

Array = NDArray[np.float64]
MAX_SIDE_PX = 4000
_MARGIN_PX = 2


def read_dem(path: Path, route: Route, margin_m: float) -> TerrainHeights:
    """Terrain around a route, with `margin_m` on all sides, as a function of positions.

    The first band holds heights in metres above mean sea level. Heights are NaN for no data and
    outside the raster. Raises `MissingFileError`, `MissingExtraError` or `ImageryError`.
    """
    try:
        import rasterio
        from rasterio._err import CPLE_BaseError
        from rasterio.errors import RasterioError
    except ImportError as error:
        raise missing_extra("reading terrain", "geo", "rasterio", error) from error
    if not path.is_file():
        raise MissingFileError(f"terrain file does not exist: {path}")
    try:
        with rasterio.open(path) as data:
            if data.crs is None:
                raise ImageryError(f"terrain file has no coordinate reference system: {path}")
            return _read(data, route, margin_m, path)
    except (RasterioError, CPLE_BaseError) as error:
        raise ImageryError(f"terrain file cannot be read ({error}): {path}") from error


def _read(data: Any, route: Route, margin_m: float, path: Path) -> TerrainHeights:
    from rasterio.enums import Resampling
    from rasterio.windows import Window

    crs, transform, size = data.crs, ~data.transform, (data.height, data.width)
    lat, lon = _surroundings(route, margin_m)
    col, row = _pixels(crs, transform, lat, lon)
    if not np.isfinite(col + row).any():
        raise ImageryError(f"the route lies outside the coordinate range of the terrain: {path}")
    left, right = _clipped(col, size[1])
    top, bottom = _clipped(row, size[0])
    if right <= left or bottom <= top:

        def within(lat_deg: float, lon_deg: float) -> bool:
            at = _pixels(crs, transform, np.array([lat_deg]), np.array([lon_deg]))
            return bool(0 <= at[0][0] <= size[1] and 0 <= at[1][0] <= size[0])

        hint = swapped_hint(*route.waypoints[0], within)
        raise ImageryError(f"the route lies outside the terrain{hint}: {path}")
    shape = tuple(min(side, MAX_SIDE_PX) for side in (bottom - top, right - left))
    window = Window(left, top, right - left, bottom - top)
    pixels = data.read(
        1, window=window, out_shape=shape, masked=True, resampling=Resampling.average
    )
    heights = np.ma.filled(pixels.astype(np.float64), np.nan)
    scale = np.array([shape[1] / (right - left), shape[0] / (bottom - top)])

    def heights_at(lat_deg: Array, lon_deg: Array) -> Array:
        col, row = _pixels(crs, transform, lat_deg, lon_deg)
        return _bilinear(heights, (col - left) * scale[0] - 0.5, (row - top) * scale[1] - 0.5)

    return heights_at


def _surroundings(route: Route, margin_m: float) -> tuple[Array, Array]:
    """Positions around each waypoint; farther for long legs, which other projections curve."""
    lat, lon = np.array(route.waypoints).T
    north = math.degrees((margin_m + 0.02 * float(leg_lengths_m(route).max())) / 6.37e6)
    east = north / np.maximum(np.cos(np.radians(lat)), 0.01)
    corners = [(y, x) for y in (-north, 0, north) for x in (-east, 0 * east, east)]
    return np.concatenate([lat + y for y, _ in corners]), np.concatenate(
        [lon + x for _, x in corners]
    )


def _pixels(crs: Any, transform: Any, lat: Array, lon: Array) -> tuple[Array, Array]:
    """Columns and rows of positions in degrees, from the outer corner of the first pixel."""
    from rasterio.warp import transform as transform_coordinates

    x, y = transform_coordinates("EPSG:4326", crs, lon.tolist(), lat.tolist())
    x, y = np.array(x), np.array(y)
    return (
        transform.a * x + transform.b * y + transform.c,
        transform.d * x + transform.e * y + transform.f,
    )


def _clipped(at: Array, size: int) -> tuple[int, int]:
    low = math.floor(float(np.nanmin(at))) - _MARGIN_PX
    high = math.ceil(float(np.nanmax(at))) + _MARGIN_PX
    return max(0, min(low, size)), max(0, min(high, size))


def _bilinear(heights: Array, col: Array, row: Array) -> Array:
    """Heights at fractional pixel coordinates; NaN outside the raster."""
    rows, cols = heights.shape
    beyond = ~((col >= -0.5) & (col <= cols - 0.5) & (row >= -0.5) & (row <= rows - 0.5))
    col = np.clip(np.where(beyond, 0, col), 0, cols - 1)
    row = np.clip(np.where(beyond, 0, row), 0, rows - 1)
    left, top = np.floor(col).astype(np.intp), np.floor(row).astype(np.intp)
    right, bottom = np.minimum(left + 1, cols - 1), np.minimum(top + 1, rows - 1)
    x, y = col - left, row - top
    found = (1 - y) * ((1 - x) * heights[top, left] + x * heights[top, right]) + y * (
        (1 - x) * heights[bottom, left] + x * heights[bottom, right]
    )
    return np.where(beyond, np.nan, found)
