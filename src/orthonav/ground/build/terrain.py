"""Making the terrain layer of a map."""

import logging
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError
from orthonav.core.geo.grid import TileGrid
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.mapfile.layer import ChunkTable
from orthonav.core.mapfile.manifest import MAX_CODE, MAX_POSTING_M, TerrainInfo
from orthonav.core.mapfile.terrain import encode_terrain, terrain_part_names
from orthonav.ground.build.sheet import rounded_gsd_m
from orthonav.ground.imagery.terrain import Dem
from orthonav.ground.planning.area import Area

POSTING_M = 10.0
"""Distance of samples; that of the terrain model where it is coarser."""
CHUNK_PX = 128
UNIT_M = 0.1
Array = NDArray[np.float64]
Sampler = Callable[[float, float, int, int], Array]
"""Heights above mean sea level of rows and columns of samples from a north-west corner, metres."""
log = logging.getLogger(__name__)


class TerrainParts(NamedTuple):
    info: TerrainInfo
    arrays: dict[str, NDArray[Any]]


def terrain_of_dem(
    dem: Dem, area: Area, grid: TileGrid, *, needed: bool = True
) -> TerrainParts | None:
    """None where the model has no height in the area; `AreaError` if it is `needed`."""
    posting_m = min(max(POSTING_M, rounded_gsd_m(dem.gsd_m)), MAX_POSTING_M)

    def sampled(west_m: float, north_m: float, rows: int, cols: int) -> Array:
        return dem.in_plane(area.frame, west_m, north_m, posting_m, rows, cols)

    made = terrain_parts(area, grid, posting_m, dem.path.name, dem.datum.name, sampled)
    if made is None and needed:
        centre = area.frame.lat_deg, area.frame.lon_deg
        hint = swapped_hint(*centre, dem.covers)
        raise AreaError(
            f"the terrain has no height in the area, at {centre[0]:.4f}, {centre[1]:.4f}{hint}: "
            f"{dem.path}"
        )
    return made


def terrain_parts(
    area: Area, grid: TileGrid, posting_m: float, name: str, datum: str, sampled: Sampler
) -> TerrainParts | None:
    """None where the source has no height; smaller holes stay holes, and a warning names them."""
    west_m, north_m = grid.west_m - posting_m, grid.north_m + posting_m
    rows = math.ceil(grid.height_px * grid.gsd_m / posting_m) + 2
    cols = math.ceil(grid.width_px * grid.gsd_m / posting_m) + 2
    table = ChunkTable(rows, cols, 1, CHUNK_PX)
    found: dict[int, NDArray[np.float32]] = {}
    inside = unknown = 0
    for chunk_row, chunk_col in np.ndindex(-(-rows // CHUNK_PX), -(-cols // CHUNK_PX)):
        shape = table.shape(0, chunk_row, chunk_col)
        west = west_m + chunk_col * CHUNK_PX * posting_m
        north = north_m - chunk_row * CHUNK_PX * posting_m
        middle = [west + shape[1] * posting_m / 2, north - shape[0] * posting_m / 2]
        reach_m = math.hypot(*shape) / 2 * posting_m + grid.tile_m + grid.stride_m
        if area.route is not None and not area.contains(np.array([middle]), reach_m)[0]:
            continue  # too far from the route for any view
        heights = sampled(west, north, *shape).astype(np.float32)
        row, col = np.mgrid[: shape[0], : shape[1]] + 0.5
        points = np.stack([west + col * posting_m, north - row * posting_m], axis=-1)
        here = area.contains(points.reshape(-1, 2)).reshape(shape)
        inside += int(here.sum())
        unknown += int((here & np.isnan(heights)).sum())
        if np.isfinite(heights).any():
            found[table.number(0, chunk_row, chunk_col)] = heights
    if not found:
        return None
    if unknown:
        log.warning(
            "terrain has no height for %.1f %% of the area: these holes stay holes in the map (%s)",
            100 * unknown / inside,
            name,
        )
    low_m = math.floor(min(float(np.nanmin(each)) for each in found.values()) * 10) / 10
    high_m = max(float(np.nanmax(each)) for each in found.values())
    unit_m = UNIT_M
    while high_m - low_m > unit_m * MAX_CODE:
        unit_m *= 2
    known = sum(int(np.isfinite(each).sum()) for each in found.values())
    high_m = round(high_m, 3)
    info = TerrainInfo(
        west_m, north_m, posting_m, rows, cols, CHUNK_PX, low_m, high_m, unit_m, known, name, datum
    )
    blobs = [
        encode_terrain(found[number], info) if number in found else b""
        for number in range(table.count)
    ]
    data, offsets = terrain_part_names(0)
    ends = np.cumsum([0, *map(len, blobs)]).astype(np.int64)
    return TerrainParts(info, {data: np.frombuffer(b"".join(blobs), np.uint8), offsets: ends})
