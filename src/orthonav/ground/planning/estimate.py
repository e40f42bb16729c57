"""Estimated tiles, file size and build time of a map, from its grid and area alone."""

import math
from dataclasses import dataclass

import numpy as np

from orthonav.core.geo.grid import TileGrid
from orthonav.ground.planning.area import Area, Extent

TILE_BYTES = 273.0
"""Embedding and centre of a tile; docs/benchmarks.md: 4.26 MB for 15,601 tiles."""
LAYER_BYTES_PER_PX = 0.15, 0.35
"""Registration layer, all levels: minimum and maximum of real imagery, docs/map-format.md."""
BUILD_FIXED_S = 40.0
BUILD_S_PER_MPX = 0.5
"""Measured with one worker on a core of an AMD EPYC, generated landscape, 1 m, default build: 179 s
for a corridor of 284 million pixels (`python -m benchmarks.corridor`), 47 s for 4 million on a
shared Xeon at 2 GHz. The fixed part is the calibration of the confidence."""
_PAIRS = 1_000_000_000
"""Limit on pairs of points and legs, which bounds the time of an estimate."""
_MOST_POINTS = 200_000
_LEAST_POINTS = 2_500
"""Points sampled at most and at least: a standard error of the share of 0.1 % to 1 %."""


@dataclass(frozen=True)
class MapEstimate:
    """Estimate for a map of one sheet.

    `area_km2`: area covered by tile centres. `imagery_km2`: area of the pixels under the tiles.
    `tiles`: number of reference tiles. `map_mb`: smallest and largest expected file size.
    `build_s`: time of the default build on one desktop core, with registration; training a network
    takes hours more.
    """

    area_km2: float
    imagery_km2: float
    tiles: int
    map_mb: tuple[float, float]
    build_s: float


def estimate_map(
    area: Area,
    *,
    gsd_m: float,
    tile_px: int,
    overlap: float,
    registration: bool = True,
    maps: int = 1,
) -> MapEstimate:
    """Estimate for the map that `orthonav build` makes of an area.

    Tiles are counted if that is cheap, else estimated from a sample (within 2 %), which is smaller
    where this is one of many `maps`. Imagery is assumed everywhere. Raises `AreaError` as
    `TileGrid.covering` does.
    """
    grid = TileGrid.covering(area.extent_en_m, gsd_m=gsd_m, tile_px=tile_px, overlap=overlap)
    half_m, centre_m = grid.tile_m / 2, (grid.tile_m - grid.stride_m) / 2
    raster = (
        grid.west_m,
        grid.north_m - grid.height_px * gsd_m,
        grid.west_m + grid.width_px * gsd_m,
        grid.north_m,
    )
    centres = tuple(np.array(raster) + np.array([1, 1, -1, -1]) * centre_m)
    reach_m = grid.stride_m * math.sqrt(0.5)
    room = max(_LEAST_POINTS, _MOST_POINTS // maps)
    cells = grid.rows, grid.cols
    tiles = round(grid.rows * grid.cols * _share(area, centres, reach_m, room, cells))
    imagery_m2 = grid.width_px * grid.height_px * gsd_m**2 * _share(area, raster, half_m, room)
    pixels = imagery_m2 / gsd_m**2
    layer = [pixels * each / 1e6 if registration else 0.0 for each in LAYER_BYTES_PER_PX]
    embeddings = tiles * TILE_BYTES / 1e6
    return MapEstimate(
        area_km2=tiles * grid.stride_m**2 / 1e6,
        imagery_km2=imagery_m2 / 1e6,
        tiles=tiles,
        map_mb=(embeddings + layer[0], embeddings + layer[1]),
        build_s=BUILD_FIXED_S + BUILD_S_PER_MPX * pixels / 1e6,
    )


def _share(
    area: Area,
    box_en_m: Extent,
    margin_m: float,
    room: int,
    cells: tuple[int, int] | None = None,
) -> float:
    """Share of a box (west, south, east, north) that lies in the area or within a margin of it.

    Computed from the centres of its `cells` (rows, columns), or of at most about `room` if those
    are more.
    """
    if area.route is None:
        return 1.0
    room = min(room, max(_LEAST_POINTS, _PAIRS // area.route.legs))
    west, south, east, north = box_en_m
    if cells is None or cells[0] * cells[1] > room:
        rows = max(1, min(room, round(math.sqrt(room * (north - south) / (east - west)))))
        cells = rows, max(1, room // rows)
    rows, cols = cells
    x = west + (np.arange(cols) + 0.5) * (east - west) / cols
    y = north - (np.arange(rows) + 0.5) * (north - south) / rows
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return float(area.contains(points, margin_m).mean())
