"""Layout of an area in tiles: resolution, grid, and tiles with enough imagery."""

import logging

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError
from orthonav.core.geo.grid import TileGrid
from orthonav.core.tiles.cells import MICRO
from orthonav.core.tiles.whitened import CellSheet
from orthonav.ground.planning.area import Area

log = logging.getLogger(__name__)

MIN_TILE_VALID_SHARE = 0.5
"""Tiles with less imagery are omitted: no view can match most of them."""
_TILES_AT_ONCE = 2**17


def grid_of(
    area: Area, imagery_gsd_m: float, gsd_m: float | None, tile_px: int, overlap: float
) -> TileGrid:
    """The tile grid of an area; `gsd_m` None uses the resolution of the imagery.

    Raises `AreaError` if tiles are larger than an area without a route.
    """
    gsd_m = rounded_gsd_m(imagery_gsd_m) if gsd_m is None else gsd_m
    overlap = _whole_cells(tile_px, overlap)
    grid = TileGrid.covering(area.extent_en_m, gsd_m=gsd_m, tile_px=tile_px, overlap=overlap)
    west, south, east, north = area.extent_en_m
    side_m = min(east - west, north - south)
    if area.route is None and side_m < 0.999 * grid.tile_m:
        raise AreaError(
            f"a tile of {grid.tile_px} px is {grid.tile_m:.0f} m wide, larger than the area, "
            f"{east - west:.0f} x {north - south:.0f} m; use smaller tiles, a finer ground "
            "resolution or a larger area"
        )
    if gsd_m < 0.8 * imagery_gsd_m:
        log.warning(
            "ground resolution of %.3g m is finer than the imagery's %.3g m", gsd_m, imagery_gsd_m
        )
    return grid


def rounded_gsd_m(gsd_m: float) -> float:
    """Ground resolution rounded to few digits: 5.002 to 5, 0.2431 to 0.243."""
    for digits in (1, 2, 3):
        rounded = float(f"{gsd_m:.{digits}g}")
        if abs(rounded / gsd_m - 1) < 0.005:
            return rounded
    return float(f"{gsd_m:.4g}")


def _whole_cells(tile_px: int, overlap: float) -> float:
    """The overlap adjusted so that the stride is a multiple of a micro-cell, if it is at least one.

    Tiles then share all their cells; otherwise memory would grow with the square of the ratio.
    """
    micro_px = max(1, tile_px // MICRO)
    stride_px = tile_px * (1 - overlap)
    if not micro_px <= stride_px <= tile_px:
        return overlap
    return 1 - round(stride_px / micro_px) * micro_px / tile_px


def tiles_of(area: Area, grid: TileGrid, cells: CellSheet) -> NDArray[np.intp]:
    """Grid rows and columns (N, 2) of the tiles in the area that have imagery.

    Raises `AreaError` if there are none.
    """
    tiles = np.concatenate(_inside(area, grid))
    share = cells.valid_share(tiles * grid.stride_px)
    if not (share >= MIN_TILE_VALID_SHARE).any():
        best = share.max(initial=0.0)
        raise AreaError(
            f"no tile of {grid.tile_px} px ({grid.tile_m:.0f} m) has imagery under at least "
            f"{MIN_TILE_VALID_SHARE:.0%} of it (best {best:.0%}): the area lies outside the "
            "orthophotos, or tiles are larger than the imagery; use smaller tiles or a finer "
            "ground resolution"
        )
    return tiles[share >= MIN_TILE_VALID_SHARE]


def _inside(area: Area, grid: TileGrid) -> list[NDArray[np.intp]]:
    """The tiles (N, 2) in the area, a few rows at a time: the box may be mostly empty."""
    reach_m = grid.stride_m * np.sqrt(0.5)
    step = max(1, _TILES_AT_ONCE // grid.cols)
    found = []
    for first in range(0, grid.rows, step):
        rows, cols = np.mgrid[first : min(first + step, grid.rows), : grid.cols]
        tiles = np.stack([rows.ravel(), cols.ravel()], axis=1).astype(np.intp)
        found.append(tiles[area.contains(grid.centres_en_m(tiles), reach_m)])
    return found
