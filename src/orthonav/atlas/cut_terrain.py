"""The terrain of a map that is cut out of an atlas, from the terrain layers of its sheets."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from orthonav.atlas.cut_sheets import CutSheet
from orthonav.geo.area import Area
from orthonav.geo.grid import TileGrid
from orthonav.mapfile.terrain import TerrainLayer
from orthonav.prepare.terrain import TerrainParts, terrain_parts

Array = NDArray[np.float64]


def cut_terrain(members: Sequence[CutSheet], area: Area, grid: TileGrid) -> TerrainParts | None:
    """The terrain layer of a map cut from sheets; None where none of them has one.

    A place has the height of the sheet whose box holds it, else of one that reaches over its
    border. Raises `MapFileError` for a damaged layer.
    """
    layers = [(each, each.terrain) for each in members if each.terrain is not None]
    if not layers:
        return None
    infos = [layer.info for _, layer in layers]
    posting_m = min(info.posting_m for info in infos)
    names, datums = sorted({info.name for info in infos}), sorted({info.datum for info in infos})

    def sampled(west_m: float, north_m: float, rows: int, cols: int) -> Array:
        row, col = np.mgrid[:rows, :cols] + 0.5
        points = np.stack([west_m + col * posting_m, north_m - row * posting_m], axis=-1)
        return _heights(layers, *area.frame.latlon_from_en(points))

    return terrain_parts(area, grid, posting_m, ", ".join(names), ", ".join(datums), sampled)


def _heights(
    layers: Sequence[tuple[CutSheet, TerrainLayer]], lat_deg: Array, lon_deg: Array
) -> Array:
    found = np.full(lat_deg.shape, np.nan)
    for own in (True, False):
        for member, layer in layers:
            west, south, east, north = member.sheet.bounds_deg
            off = (lon_deg - (west + east) / 2 + 180) % 360 - 180
            inside = (abs(off) <= (east - west) / 2) & (lat_deg >= south) & (lat_deg <= north)
            wanted = np.isnan(found) & (inside if own else True)
            if wanted.any():
                found[wanted] = layer(lat_deg[wanted], lon_deg[wanted])
    return found
