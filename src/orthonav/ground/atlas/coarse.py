"""The coarse tiles of a sheet, from which the index of an atlas is made.

They are wide tiles at low resolution, stored as features before any learning, because whitening is
learnt for the whole atlas. A tile belongs to the sheet whose box holds its centre, and may reach
half a tile beyond the box. So every place of the atlas is within half a stride of a tile centre."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from orthonav.core.errors import AreaError, AtlasError
from orthonav.core.files import no_progress, require_file
from orthonav.core.geo.grid import TileGrid
from orthonav.core.mapfile.reader import METADATA_KEY, save_tensors
from orthonav.core.tiles import represent
from orthonav.core.tiles.whitened import WhitenedRecipe, pooled_features
from orthonav.core.variants import make_variant
from orthonav.ground.atlas.catalog import CoarseRecipe, canonical, reason
from orthonav.ground.build.sheet import MIN_TILE_VALID_SHARE, SheetReader
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area, Extent
from orthonav.ground.planning.sheets import in_box

EDGES = "gradient"  # of coarse tiles and of views searched among them, independent of the maps'
POOLING = WhitenedRecipe()
MAX_TILES = 1_000_000  # greatest number of a sheet: 45 km with tiles 50 m apart are 800,000
FULL = 255  # a cell that is valid everywhere


@dataclass(frozen=True, eq=False)
class CoarseTiles:
    """Coarse tiles of a sheet, in rows from north to south; arrays are read-only. N is 0 where no
    tile shows enough imagery."""

    features: NDArray[np.float16]  # (N, F) float16; F is cells x cells x channels
    valid: NDArray[np.uint8]  # (N, cells x cells) uint8; 255 where all of a cell shows imagery

    def features_of(self, tiles: slice) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Features (n, F) of some tiles, and weights (n, F): the valid fraction of each feature's
        cell."""
        share = self.valid[tiles].astype(np.float32) / FULL
        repeats = self.features.shape[1] // max(1, self.valid.shape[1])
        return self.features[tiles].astype(np.float32), np.repeat(share, repeats, axis=1)


def coarse_grid(area: Area, recipe: CoarseRecipe) -> TileGrid:
    return TileGrid.covering(
        area.extent_en_m, gsd_m=recipe.gsd_m, tile_px=recipe.tile_px, overlap=recipe.overlap
    )


def tiles_in(bounds_deg: Extent, area: Area, grid: TileGrid) -> NDArray[np.intp]:
    """Rows and columns (N, 2) of the tiles whose centres lie in a box."""
    rows, cols = np.mgrid[: grid.rows, : grid.cols]
    tiles = np.stack([rows.ravel(), cols.ravel()], axis=1).astype(np.intp)
    return tiles[in_box(bounds_deg, *area.frame.latlon_from_en(grid.centres_en_m(tiles)))]


def write_coarse(mosaic: Mosaic, bounds_deg: Extent, recipe: CoarseRecipe, path: Path) -> int:
    """Write the coarse tiles whose centres lie in a box to `path`, whole or not at all; returns
    their number. They are made from the imagery with one thread; the bytes are always the same."""
    area = Area.from_bounds(bounds_deg)
    grid = coarse_grid(area, recipe)
    representation = make_variant(represent.TABLE, EDGES)
    reader = SheetReader(area, grid, representation, registration=False)
    first_px = tiles_in(bounds_deg, area, grid) * grid.stride_px
    try:
        with mosaic.grid_sheet(area.frame, grid, threads=1) as raster:
            reader.read(raster, no_progress, workers=1)
    except AreaError:  # no pixel of imagery
        first_px = first_px[:0]
    first_px = first_px[reader.cells.valid_share(first_px) >= MIN_TILE_VALID_SHARE]
    features = np.zeros((len(first_px), POOLING.cells**2 * representation.channels), np.float16)
    valid = np.zeros((len(first_px), POOLING.cells**2), np.uint8)
    for start in range(0, len(first_px), 512):
        part = slice(start, start + 512)
        values, weights = pooled_features(POOLING, reader.cells, first_px[part])
        features[part] = values
        valid[part] = np.rint(weights[:, :: representation.channels] * FULL)
    save_tensors(path, {"features": features, "valid": valid}, _metadata(recipe), "coarse tiles")
    return len(valid)


def tile_count(path: Path) -> int:
    try:
        with safe_open(require_file(path, "coarse tiles"), framework="numpy") as stored:
            return int(stored.get_slice("valid").get_shape()[0])
    except (SafetensorError, OSError, IndexError) as error:
        raise AtlasError(f"coarse tiles are damaged ({error}): {path}") from error


def read_coarse(path: Path) -> CoarseTiles:
    """The tiles of a file, which may be untrusted. Raises `AtlasError`, `MissingFileError`."""
    path = require_file(path, "coarse tiles")
    try:
        with safe_open(path, framework="numpy") as stored:
            metadata = (stored.metadata() or {}).get(METADATA_KEY)
            if metadata is None or set(stored.keys()) != {"features", "valid"}:
                raise AtlasError("not coarse tiles of an atlas")
            recipe = CoarseRecipe(**json.loads(metadata)["recipe"])
            if _metadata(recipe) != metadata:
                raise AtlasError("altered, or not coarse tiles of an atlas")
            return _checked(stored.get_tensor("features"), stored.get_tensor("valid"))
    except AtlasError as error:
        raise AtlasError(f"{error}: {path}") from error
    except (SafetensorError, OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise AtlasError(f"coarse tiles are damaged ({reason(error)}): {path}") from error


def _metadata(recipe: CoarseRecipe) -> str:
    plain = {
        "format": "orthonav-coarse",
        "schema": 2,
        "recipe": asdict(recipe),
        "edges": EDGES,
        "cells": POOLING.cells,
    }
    return canonical(plain).decode()


def _checked(features: NDArray[Any], valid: NDArray[Any]) -> CoarseTiles:
    cells = POOLING.cells**2
    right = (
        features.dtype == np.float16
        and valid.dtype == np.uint8
        and features.ndim == valid.ndim == 2
        and len(features) == len(valid) <= MAX_TILES
        and valid.shape[1] == cells
        and features.shape[1] in range(cells, 64 * cells + 1, cells)  # 1 to 64 channels
    )
    if not right:
        raise AtlasError("coarse tiles are damaged (arrays do not fit together)")
    if not np.isfinite(features).all():
        raise AtlasError("coarse tiles are damaged (not finite)")
    for array in (features, valid):
        array.flags.writeable = False
    return CoarseTiles(features, valid)
