"""The sheets that a map is cut from: opened, checked for the same recipe, manifests joined."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav import __version__, embed, represent
from orthonav.atlas.catalog import Atlas
from orthonav.atlas.item import Sheet
from orthonav.atlas.pooled_confidence import pooled_registered, pooled_tiles
from orthonav.atlas.warp import SheetSource
from orthonav.confidence.logistic import LogisticConfidence
from orthonav.confidence.registered import RegisteredConfidence
from orthonav.embed.cells import CellLayout
from orthonav.embed.whitened import WhitenedRecipe
from orthonav.errors import AtlasError, MapFileError, MissingFileError, VariantError
from orthonav.geo.grid import TileGrid
from orthonav.mapfile.layer import GreyLayer
from orthonav.mapfile.manifest import Manifest, SheetInfo
from orthonav.mapfile.reader import MapFile, open_map
from orthonav.mapfile.terrain import TerrainLayer
from orthonav.prepare.cellparts import StoredCells
from orthonav.variants import variant_from_recipe

CACHE_BYTES = 24 * 2**20
"""Decoded chunks cached of each sheet: those along the border of a row of blocks."""
REBUILD = "rebuild it with this program (orthonav atlas build ATLAS .. --replace)"


@dataclass(frozen=True, eq=False)
class CutSheet:
    """A sheet that a map is cut from: its item, manifest, pixels and, if it has one, terrain."""

    sheet: Sheet
    manifest: Manifest
    source: SheetSource
    terrain: TerrainLayer | None = None


def opened_sheets(atlas: Atlas, sheets: Sequence[Sheet], grid: TileGrid) -> list[CutSheet]:
    """Open and verify sheets. Raises `AtlasError` where one is damaged or differs from others."""
    found: list[CutSheet] = []
    for sheet in sheets:
        try:
            opened = open_map(atlas.path(sheet, "map"))
            _check_alike(opened, sheet, grid, found[0].manifest if found else None)
            terrain = TerrainLayer.of(opened)
            found.append(CutSheet(sheet, opened.manifest, _source(opened, sheet), terrain))
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
    members: Sequence[CutSheet], shares: NDArray[np.float64], sheet: SheetInfo
) -> Manifest:
    """Manifest of a map with that sheet, cut from sheets that make up these shares of it."""
    manifests = [member.manifest for member in members]
    tiles = float(np.average([each.sheets[0].tiles for each in manifests], weights=shares))
    known = [
        (LogisticConfidence.from_plain(each.confidence), share)
        for each, share in zip(manifests, shares, strict=True)
        if each.confidence is not None and share > 0
    ]
    confidence = pooled_tiles(*_apart(known), sheet.tiles / tiles)
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


def _apart(known: Sequence[tuple[Any, float]]) -> tuple[list[Any], list[float]]:
    return [confidence for confidence, _ in known], [share for _, share in known]


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
    return SheetSource(sheet.id, sheet.bounds_deg, info.frame, info.grid, layer, cells)
