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
from orthonav.core.tiles.cells import MICRO
from orthonav.core.tiles.whitened import WhitenedRecipe, pooled_features
from orthonav.core.variants import make_variant
from orthonav.ground.atlas.catalog import CoarseRecipe, canonical, reason
from orthonav.ground.build.calibrate import CropSampler
from orthonav.ground.build.sheet import MIN_TILE_VALID_SHARE, SheetReader
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area, Extent
from orthonav.ground.planning.sheets import in_box

FORMAT = "orthonav-coarse"
SCHEMA = 1
EDGES = "gradient"  # of coarse tiles and of views searched among them, independent of the maps'
POOLING = WhitenedRecipe()
MAX_TILES = 1_000_000  # greatest number of a sheet: 45 km with tiles 50 m apart are 800,000
MAX_FEATURES = 16_384  # greatest number per tile: 16 x 16 cells of 64 channels
FULL = 255  # a cell that is valid everywhere
_CHUNK_TILES = 512
_SLACK_DEG = 1e-9


@dataclass(frozen=True, eq=False)
class CoarseTiles:
    """Coarse tiles of a sheet, in rows from north to south; arrays are read-only. N is 0 where no
    tile shows enough imagery."""

    centres_latlon_deg: NDArray[np.float64]  # (N, 2)
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


def write_coarse(mosaic: Mosaic, bounds_deg: Extent, recipe: CoarseRecipe, path: Path) -> int:
    """Write the coarse tiles whose centres lie in a box to `path`, whole or not at all; returns
    their number. They are made from the imagery with one thread; the bytes are always the same."""
    area = Area.from_bounds(bounds_deg)
    grid = coarse_grid(area, recipe)
    representation = make_variant(represent.TABLE, EDGES)
    reader = SheetReader(
        mosaic, area, grid, representation, _NoCrops(recipe.tile_px, 0), registration=False
    )
    rows, cols = np.mgrid[: grid.rows, : grid.cols]
    tiles = np.stack([rows.ravel(), cols.ravel()], axis=1).astype(np.intp)
    latlon = np.stack(area.frame.latlon_from_en(grid.centres_en_m(tiles)), axis=1)
    inside = in_box(bounds_deg, *latlon.T)
    tiles, latlon = tiles[inside], latlon[inside]
    try:
        reader.read(no_progress, workers=1)
    except AreaError:  # no pixel of imagery
        tiles, latlon = tiles[:0], latlon[:0]
    first_px = tiles * grid.stride_px
    enough = reader.cells.valid_share(first_px) >= MIN_TILE_VALID_SHARE
    first_px, latlon = first_px[enough], latlon[enough]
    features = np.zeros((len(first_px), POOLING.cells**2 * representation.channels), np.float16)
    valid = np.zeros((len(first_px), POOLING.cells**2), np.uint8)
    for start in range(0, len(first_px), _CHUNK_TILES):
        part = slice(start, start + _CHUNK_TILES)
        values, weights = pooled_features(POOLING, reader.cells, first_px[part])
        features[part] = values
        valid[part] = np.rint(weights[:, :: representation.channels] * FULL)
    arrays: dict[str, NDArray[Any]] = {
        "centres_latlon_deg": latlon,
        "features": features,
        "valid": valid,
    }
    save_tensors(path, arrays, _metadata(recipe, bounds_deg), "coarse tiles")
    return len(valid)


def tile_count(path: Path) -> int:
    try:
        with safe_open(require_file(path, "coarse tiles"), framework="numpy") as stored:
            return int(stored.get_slice("valid").get_shape()[0])
    except (SafetensorError, OSError, IndexError) as error:
        raise AtlasError(f"coarse tiles are damaged ({error}): {path}") from error


def read_coarse(path: Path) -> CoarseTiles:
    path = require_file(path, "coarse tiles")
    try:
        with safe_open(path, framework="numpy") as stored:
            metadata = (stored.metadata() or {}).get(METADATA_KEY)
            names = set(stored.keys())
            if metadata is None or names != {"centres_latlon_deg", "features", "valid"}:
                raise AtlasError(f"not coarse tiles of an atlas: {path}")
            arrays = {name: stored.get_tensor(name) for name in sorted(names)}
        return _checked(_bounds_deg(metadata), arrays)
    except AtlasError as error:
        raise AtlasError(f"{error}: {path}") from error
    except (SafetensorError, OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise AtlasError(f"coarse tiles are damaged ({reason(error)}): {path}") from error


class _NoCrops(CropSampler):
    def places(self, height: int, width: int, share: float) -> NDArray[np.intp]:
        return np.zeros((0, 2), np.intp)


def _metadata(recipe: CoarseRecipe, bounds_deg: Extent) -> str:
    plain = {
        "format": FORMAT,
        "schema": SCHEMA,
        "recipe": asdict(recipe),
        "edges": EDGES,
        "cells": POOLING.cells,
        "bounds_deg": list(map(float, bounds_deg)),
    }
    return canonical(plain).decode()


def _bounds_deg(metadata: str) -> Extent:
    plain: Any = json.loads(metadata)
    recipe = CoarseRecipe(**plain["recipe"])
    west, south, east, north = map(float, plain["bounds_deg"])
    bounds_deg = west, south, east, north
    if _metadata(recipe, bounds_deg) != metadata or recipe.tile_px % MICRO:
        raise AtlasError("altered, or not coarse tiles of an atlas")
    return bounds_deg


def _checked(bounds_deg: Extent, arrays: dict[str, Any]) -> CoarseTiles:
    centres, features, valid = (arrays[n] for n in ("centres_latlon_deg", "features", "valid"))
    count = len(valid) if valid.ndim == 2 else -1
    right = (
        (centres.dtype, features.dtype, valid.dtype) == (np.float64, np.float16, np.uint8)
        and 0 <= count <= MAX_TILES
        and centres.shape == (count, 2)
        and valid.shape[1] == POOLING.cells**2
        and features.ndim == 2
        and len(features) == count
        and valid.shape[1] <= features.shape[1] <= MAX_FEATURES
        and features.shape[1] % valid.shape[1] == 0
    )
    if not right:
        raise AtlasError("coarse tiles are damaged (arrays do not fit together)")
    if not (np.isfinite(features).all() and np.isfinite(centres).all()):
        raise AtlasError("coarse tiles are damaged (not finite)")
    west, south, east, north = bounds_deg
    slack = west - _SLACK_DEG, south - _SLACK_DEG, east + 2 * _SLACK_DEG, north + 2 * _SLACK_DEG
    if not in_box(slack, *centres.T).all():
        raise AtlasError("coarse tiles are damaged (centres lie outside their sheet)")
    for array in (centres, features, valid):
        array.flags.writeable = False
    return CoarseTiles(centres, features, valid)
