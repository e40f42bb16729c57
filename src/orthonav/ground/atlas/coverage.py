"""Coverage of an area by an atlas: missing sheets, and gaps under the route."""

import logging
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError, AtlasError
from orthonav.core.geo.grid import TileGrid
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.tiles.whitened import CellSheet
from orthonav.ground.atlas.catalog import Atlas
from orthonav.ground.atlas.warp import SheetSource, outline
from orthonav.ground.build.sheet import MIN_TILE_VALID_SHARE
from orthonav.ground.planning.area import Area, Extent
from orthonav.ground.planning.world import WorldSheets

log = logging.getLogger(__name__)

MAX_TILES = 20_000
"""Tiles of an area that are checked; more are checked at even spacing."""
EDGE_POINTS = 33
"""Points along an edge of a box: edges are not straight in degrees."""
NAMED = 8
"""Missing sheets named in a message, at most."""
Array = NDArray[np.float64]


def box_around(area: Area, margin_m: float) -> Extent:
    """West, south, east, north in degrees of an area and a margin around it; west and east may lie
    beyond 180 degrees."""
    west, south, east, north = area.extent_en_m
    box = west - margin_m, south - margin_m, east + margin_m, north + margin_m
    lat, lon = area.frame.latlon_from_en(outline(box, EDGE_POINTS))
    lon = lon - 360 * np.round((lon - area.frame.lon_deg) / 360)
    return float(lon.min()), float(lat.min()), float(lon.max()), float(lat.max())


def box_deg(area: Area, margin_m: float) -> Extent:
    """The same with west and east from -180 to 180; across the antimeridian west is greater."""
    west, south, east, north = box_around(area, margin_m)
    return turned(west), south, turned(east), north


def turned(lon_deg: float) -> float:
    """A longitude from -180, without 180."""
    return (lon_deg + 180) % 360 - 180


def require_sheets(atlas: Atlas, area: Area, found: Sequence[object]) -> None:
    """Raise `AreaError` with the extent of the atlas where no sheet was found in an area; names
    swapped latitude and longitude."""
    if found:
        return
    if atlas.bounds_deg is None:
        raise AreaError(f"the atlas has no sheets yet: {atlas.url}")
    west, south, east, north = atlas.bounds_deg
    hint = swapped_hint(
        *(area.frame.lat_deg, area.frame.lon_deg),
        lambda lat, lon: south <= lat <= north and 0 <= (lon - west) % 360 <= (east - west) % 360,
    )
    raise AreaError(
        f"the area lies outside the atlas, whose {len(atlas.sheets())} sheets lie within "
        f"{west:.4f},{south:.4f},{east:.4f},{north:.4f} (west, south, east, north){hint}: "
        f"{atlas.url}"
    )


def check_covered(
    area: Area,
    grid: TileGrid,
    sources: Sequence[SheetSource],
    lattice: WorldSheets,
    allow_holes: bool,
) -> None:
    """Warn where sheets under an area are missing; `AtlasError` where they lie under the route.

    With `allow_holes` that is a warning too. Raises `AreaError` where no part is covered.
    """
    tiles = _some_tiles(area, grid)
    lat, lon = area.frame.latlon_from_en(grid.centres_en_m(tiles))
    covered = np.any([source.covers(lat, lon) for source in sources], axis=0)
    if not covered.any():
        raise AreaError("no part of the area lies on a sheet of the atlas")
    route_lat, route_lon = area.frame.latlon_from_en(_route_en_m(area, grid))
    missing = ~np.any([source.covers(route_lat, route_lon) for source in sources], axis=0)
    under = _missing(lattice, route_lat[missing], route_lon[missing])
    elsewhere = _missing(lattice, lat[~covered], lon[~covered])
    lacks = "lies on sheets that the atlas lacks"
    _require_route(missing, f"{lacks} ({under})", allow_holes)
    _warn_area(~covered, f"{lacks}: {elsewhere}")


def check_shown(area: Area, grid: TileGrid, cells: CellSheet, allow_holes: bool) -> None:
    """Warn where the sheets under an area show no imagery; `AtlasError` where the route is there.

    With `allow_holes` that is a warning too.
    """
    route = grid.tiles_rc(_route_en_m(area, grid)).clip(0, [grid.rows - 1, grid.cols - 1])
    tiles, lacks = _some_tiles(area, grid), "has no imagery in the atlas"
    on_route, bare = (
        cells.valid_share(each * grid.stride_px) < MIN_TILE_VALID_SHARE for each in (route, tiles)
    )
    _require_route(on_route, lacks, allow_holes)
    _warn_area(bare, lacks)


def _require_route(lacking: NDArray[np.bool_], lacks: str, allow_holes: bool) -> None:
    """Raise `AtlasError` where points (N,) along a route lack something, unless holes may be."""
    if lacking.any() and not allow_holes:
        raise AtlasError(
            f"{lacking.mean():.0%} of the route {lacks}; extend the atlas, or allow holes "
            "(--allow-holes)"
        )


def _warn_area(lacking: NDArray[np.bool_], lacks: str) -> None:
    if lacking.any():
        log.warning("%.3g %% of the area %s", 100 * float(lacking.mean()), lacks)


def _missing(lattice: WorldSheets, lat: Array, lon: Array) -> str:
    names = sorted(
        {lattice.name_at(*place) for place in zip(lat.tolist(), lon.tolist(), strict=True)}
    )
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def _some_tiles(area: Area, grid: TileGrid) -> NDArray[np.intp]:
    """Tiles (N, 2) in an area, all or evenly spaced; at least one near its middle."""
    step = max(1, int(np.ceil(np.sqrt(grid.rows * grid.cols / MAX_TILES))))
    tiles = np.mgrid[0 : grid.rows : step, 0 : grid.cols : step].reshape(2, -1).T.astype(np.intp)
    inside = area.contains(grid.centres_en_m(tiles), grid.stride_m * np.sqrt(0.5))
    return tiles[inside] if inside.any() else tiles[len(tiles) // 2 :][:1]


def _route_en_m(area: Area, grid: TileGrid) -> Array:
    """Points (N, 2) along the route, a quarter of a tile apart; empty without a route."""
    if area.route is None:
        return np.zeros((0, 2))
    line = area.route.points_en_m(area.frame)
    parts = [line[:1]]
    for start, end in pairwise(line):
        count = max(1, int(np.ceil(np.hypot(*(end - start)) / (grid.tile_m / 4))))
        parts.append(start + (end - start) * (np.arange(count)[:, None] + 1) / count)
    return np.concatenate(parts)
