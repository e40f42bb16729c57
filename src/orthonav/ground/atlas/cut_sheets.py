"""The sheets that a map is cut from: opened, checked for the same recipe, and what they say joined:
manifests, confidences, terrain.

The confidences of a cut map are pooled from those of its sheets, not learnt again. Where on the map
a view was taken is not known, so the confidence of a fix is the mean of the sheets' confidences,
weighted by their shares of the map. A logistic regression cannot represent that mean exactly. The
pooled one has the mean weights, and a bias so low that it nowhere exceeds the mean in the range of
evidence that decides.
"""

import itertools
import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav import __version__
from orthonav.core.errors import AtlasError, MapFileError, MissingFileError, VariantError
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.confidence import (
    CHANCES,
    Chances,
    LogisticConfidence,
    RegisteredConfidence,
)
from orthonav.core.mapfile.layer import GreyLayer
from orthonav.core.mapfile.manifest import Manifest, SheetInfo
from orthonav.core.mapfile.reader import MapFile, open_map
from orthonav.core.mapfile.terrain import TerrainLayer
from orthonav.core.tiles import embed, represent
from orthonav.core.tiles.cells import CellLayout
from orthonav.core.tiles.whitened import WhitenedRecipe
from orthonav.core.variants import variant_from_recipe
from orthonav.ground.atlas.catalog import Atlas
from orthonav.ground.atlas.item import Sheet
from orthonav.ground.atlas.warp import SheetSource
from orthonav.ground.build.cellparts import StoredCells
from orthonav.ground.build.terrain import TerrainParts, terrain_parts
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.world import in_box

CACHE_BYTES = 24 * 2**20
"""Decoded chunks cached of each sheet: those along the border of a row of blocks."""
REBUILD = "rebuild it with this program (orthonav atlas build ATLAS .. --replace)"

DECIDING = 0.5, 0.99
"""Thresholds of acceptance lie in this range of probabilities."""
SCORES = np.linspace(0.05, 1.0, 20)
MARGINS = np.linspace(0.0, 0.6, 13)
"""Evidence at which the pooled confidence is compared with the sheets': scores and margins of
tiles."""
Array = NDArray[np.float64]


def opened_sheets(atlas: Atlas, sheets: Sequence[Sheet], grid: TileGrid) -> list[SheetSource]:
    """Open and verify sheets. Raises `AtlasError` where one is damaged or differs from others."""
    found: list[SheetSource] = []
    for sheet in sheets:
        try:
            opened = open_map(atlas.path(sheet, "map"))
            _check_alike(opened, sheet, grid, found[0].manifest if found else None)
            found.append(_source(opened, sheet))
        except (MapFileError, MissingFileError) as error:
            raise AtlasError(f"sheet {sheet.id} is damaged, {REBUILD}: {error}") from error
    return found


def recipes(manifest: Manifest) -> tuple[WhitenedRecipe, Any]:
    """Recipe of the embedding, and representation. Raises `AtlasError` for other methods."""
    try:
        recipe = variant_from_recipe(embed.TABLE, manifest.recipe.get("embed"))
        representation = variant_from_recipe(represent.TABLE, manifest.recipe.get("represent"))
    except VariantError as error:
        raise AtlasError(f"this program cannot use the sheets ({error})") from error
    if not isinstance(recipe, WhitenedRecipe):
        raise AtlasError(
            f"maps are cut from atlases of the method gradient, not {manifest.recipe.get('method')}"
            ": every sheet of this one has its own encoder"
        )
    return recipe, representation


def pooled_manifest(
    members: Sequence[SheetSource], shares: NDArray[np.float64], sheet: SheetInfo
) -> Manifest:
    """Manifest of a map with that sheet, cut from sheets that make up these shares of it."""
    manifests = [member.manifest for member in members]
    tiles = float(np.average([each.sheets[0].tiles for each in manifests], weights=shares))
    known = [
        (LogisticConfidence.from_plain(each.confidence), share)
        for each, share in zip(manifests, shares, strict=True)
        if each.confidence is not None and share > 0
    ]
    confidence = pooled_tiles([c for c, _ in known], [s for _, s in known], sheet.tiles / tiles)
    return Manifest(
        recipe={
            **manifests[0].recipe,
            "cut_from": {each.sheet.id: each.sheet.files["map"].sha256[:12] for each in members},
        },
        sheets=(sheet,),
        imagery=_imagery(manifests),
        view={
            "heading_step_deg": min(each.view["heading_step_deg"] for each in manifests),
            "min_valid_share": max(each.view["min_valid_share"] for each in manifests),
            "position_std_m": max(each.view["position_std_m"] for each in manifests),
        },
        confidence=None if confidence is None else confidence.to_plain(),
        radius_m=max(each.radius_m for each in manifests),
        created_by=f"orthonav {__version__}",
        registration=_registration(manifests, shares),
    )


def _registration(manifests: Sequence[Manifest], shares: NDArray[np.float64]) -> dict[str, Any]:
    layers = [each.registration or {} for each in manifests]
    confidence = pooled_registered(
        [
            RegisteredConfidence.from_plain(each["confidence"])
            for each, share in zip(layers, shares, strict=True)
            if each.get("confidence") is not None and share > 0
        ]
    )
    return {
        "confidence": None if confidence is None else confidence.to_plain(),
        "radius_m": max(float(each["radius_m"]) for each in layers),
        "position_floor_px": max(float(each["position_floor_px"]) for each in layers),
    }


def pooled_tiles(
    confidences: Sequence[LogisticConfidence], shares: Sequence[float], more_tiles: float
) -> LogisticConfidence | None:
    """Confidence of tile search on a map made of sheets in these shares; None without sheets.

    `more_tiles`: tiles of the map over tiles of a sheet. As many times more tiles resemble a view
    by chance, and the odds of the best tile are lower by that factor.
    """
    if not confidences:
        return None
    bias = float(np.average([each.bias for each in confidences], weights=shares))
    weights = np.average([each.weights for each in confidences], axis=0, weights=shares)
    pooled = LogisticConfidence(bias, tuple(weights.tolist()))
    evidence = [{"score": s, "margin": m} for s, m in itertools.product(SCORES, MARGINS) if m <= s]
    own = np.array([pooled(each) for each in evidence])
    theirs = np.array([[single(each) for each in evidence] for single in confidences])
    mean = np.average(theirs, axis=0, weights=shares)
    deciding = (own > DECIDING[0]) & (mean < DECIDING[1])
    own, mean = (np.clip(each[deciding], 1e-9, 1 - 1e-9) for each in (own, mean))
    excess = (np.log(own / (1 - own)) - np.log(mean / (1 - mean))).max(initial=0.0)
    return LogisticConfidence(bias - float(excess) - math.log(max(more_tiles, 1.0)), pooled.weights)


def pooled_registered(confidences: Sequence[RegisteredConfidence]) -> RegisteredConfidence | None:
    """Confidence of registered views on a map made of sheets; None without sheets.

    It is the usual one, with the scores of chance of the sheet where they are highest.
    """
    if not confidences:
        return None
    chances = Chances(
        **{name: max(getattr(each.chances, name) for each in confidences) for name in CHANCES}
    )
    return RegisteredConfidence.usual(chances)


def _imagery(manifests: Sequence[Manifest]) -> tuple[dict[str, Any], ...]:
    """All orthophotos of all sheets, each once, by date and name."""
    sources = {json.dumps(each, sort_keys=True): each for one in manifests for each in one.imagery}

    def place(key: str) -> tuple[str, str, str]:
        return str(sources[key].get("date") or ""), str(sources[key].get("name") or ""), key

    return tuple(sources[key] for key in sorted(sources, key=place))


def _check_alike(opened: MapFile, sheet: Sheet, grid: TileGrid, first: Manifest | None) -> None:
    manifest = opened.manifest
    if len(manifest.sheets) != 1:
        raise MapFileError(f"it has {len(manifest.sheets)} sheets in one map: {opened.path}")
    theirs = manifest.sheets[0].grid
    for name in ("gsd_m", "tile_px", "stride_px"):
        if getattr(theirs, name) != getattr(grid, name):
            raise AtlasError(
                f"sheet {sheet.id} has {name} {getattr(theirs, name)}, the atlas "
                f"{getattr(grid, name)}; {REBUILD}: {opened.path}"
            )
    for name in ("method", "represent", "embed", "overlap"):
        if first is not None and manifest.recipe.get(name) != first.recipe.get(name):
            raise AtlasError(
                f"sheet {sheet.id} was made differently from the others ({name}: "
                f"{manifest.recipe.get(name)}, not {first.recipe.get(name)}); {REBUILD}: "
                f"{opened.path}"
            )


def _source(opened: MapFile, sheet: Sheet) -> SheetSource:
    _, representation = recipes(opened.manifest)
    info = opened.manifest.sheets[0]
    layer = GreyLayer.of(opened, cache_bytes=CACHE_BYTES)
    layout = CellLayout.for_tiles(info.grid.tile_px, info.grid.stride_px)
    cells = StoredCells.of(opened, layout, representation.channels)
    if layer is None or cells is None or opened.manifest.registration is None:
        lacking = "registration layer" if layer is None else "cells"
        raise AtlasError(
            f"sheet {sheet.id} has no {lacking}, from which maps are cut; {REBUILD}: {opened.path}"
        )
    return SheetSource(sheet, opened.manifest, layer, cells, TerrainLayer.of(opened))


def cut_terrain(members: Sequence[SheetSource], area: Area, grid: TileGrid) -> TerrainParts | None:
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
    layers: Sequence[tuple[SheetSource, TerrainLayer]], lat_deg: Array, lon_deg: Array
) -> Array:
    found = np.full(lat_deg.shape, np.nan)
    for own in (True, False):
        for member, layer in layers:
            inside = in_box(member.sheet.bounds_deg, lat_deg, lon_deg)
            wanted = np.isnan(found) & (inside if own else True)
            if wanted.any():
                found[wanted] = layer(lat_deg[wanted], lon_deg[wanted])
    return found
