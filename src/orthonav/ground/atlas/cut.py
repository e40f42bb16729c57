"""Cutting a flight's map out of an atlas: the content of its sheets, resampled into one plane.

The imagery is not needed: the grey picture comes from the registration layers of the sheets, tiles
are embedded from the cell means of the sheets, and confidences are pooled, not learnt again. Where
on the map a view was taken is not known, so the confidence of a fix is the mean of the sheets'
confidences, weighted by their shares of the map. A logistic regression cannot represent that mean
exactly. The pooled one has the mean weights, and a bias so low that it nowhere exceeds the mean in
the range of evidence that decides. The same atlas gives the same bytes for any number of threads.
"""

import itertools
import json
import logging
import math
from collections.abc import Sequence
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav import __version__
from orthonav.core.cores import usable_cores
from orthonav.core.errors import (
    AreaError,
    AtlasError,
    MapFileError,
    MissingFileError,
    OutputError,
    VariantError,
)
from orthonav.core.files import Progress, no_progress
from orthonav.core.geo.grid import TileGrid
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.localize.confidence import (
    CHANCES,
    Chances,
    LogisticConfidence,
    RegisteredConfidence,
)
from orthonav.core.mapfile.layer import GreyLayer
from orthonav.core.mapfile.manifest import Manifest, SheetInfo
from orthonav.core.mapfile.reader import MapFile, open_map, write_map
from orthonav.core.mapfile.terrain import TerrainLayer
from orthonav.core.tiles import embed, represent
from orthonav.core.tiles.cells import CellLayout
from orthonav.core.tiles.represent import OrientedGradients
from orthonav.core.tiles.whitened import CellSheet, WhitenedRecipe, learn
from orthonav.core.variants import variant_from_recipe
from orthonav.ground.atlas.catalog import Atlas
from orthonav.ground.atlas.item import Sheet
from orthonav.ground.atlas.warp import SheetSource, Warp, joined_cells, joined_grey, outline
from orthonav.ground.build.build import MAX_WORKERS, BuildResult
from orthonav.ground.build.layer import (
    GreyLayerWriter,
    Parts,
    StoredCells,
    TerrainParts,
    terrain_parts,
)
from orthonav.ground.build.sheet import (
    MIN_TILE_VALID_SHARE,
    PREVIEW_PX,
    Block,
    Preview,
    blocks_of_area,
    grid_of,
    in_order,
    layer_parts,
    one_opencv_thread,
    tiles_of,
)
from orthonav.ground.planning.area import Area, Extent
from orthonav.ground.planning.sheets import WorldSheets, in_box

log = logging.getLogger(__name__)

MAX_TILES = 20_000  # tiles of an area that are checked; more are checked at even spacing
EDGE_POINTS = 33  # points along an edge of a box: edges are not straight in degrees
NAMED = 8  # missing sheets named in a message, at most
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
    With `allow_holes` that is a warning too."""
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
    With `allow_holes` that is a warning too."""
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


CACHE_BYTES = 24 * 2**20  # decoded chunks of each sheet: those along the border of a row of blocks
REBUILD = "rebuild it with this program (orthonav atlas build ATLAS .. --replace)"

DECIDING = 0.5, 0.99  # thresholds of acceptance lie in this range of probabilities
SCORES = np.linspace(0.05, 1.0, 20)
MARGINS = np.linspace(0.0, 0.6, 13)
"""Evidence at which the pooled confidence is compared with the sheets': scores and margins of
tiles."""


def opened_sheets(atlas: Atlas, sheets: Sequence[Sheet], grid: TileGrid) -> list[SheetSource]:
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
    by chance, and the odds of the best tile are lower by that factor."""
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
    """Confidence of registered views on a map made of sheets; None without sheets. It is the usual
    one, with the scores of chance of the sheet where they are highest."""
    if not confidences:
        return None
    chances = Chances(
        **{name: max(getattr(each.chances, name) for each in confidences) for name in CHANCES}
    )
    return RegisteredConfidence.usual(chances)


def _imagery(manifests: Sequence[Manifest]) -> tuple[dict[str, Any], ...]:
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
    """The terrain layer of a map cut from sheets; None where none of them has one. A place has the
    height of the sheet whose box holds it, else of one that reaches over its border."""
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


COARSER = 4  # factor by which blocks are reduced for the preview


def cut_map(
    atlas: Atlas,
    out: Path,
    area: Area,
    *,
    workers: int | None = None,
    allow_holes: bool = False,
    progress: Progress = no_progress,
) -> BuildResult:
    """Cut the map of an area, which may be the band of a route, and write it to `out` as a whole.
    Missing sheets under the route are an error unless `allow_holes`; other missing sheets are a
    warning. Raises `AreaError` for areas outside the atlas, `AtlasError` where sheets are damaged
    or cannot be cut from, `StorageError`, `OutputError`."""
    out = Path(out)
    workers = usable_cores() if workers is None else workers
    if not 1 <= workers <= MAX_WORKERS:
        raise VariantError(f"workers must be 1 to {MAX_WORKERS}, got {workers}")
    progress("sheets", 0.0)
    cutter = _MapCutter(atlas, area)
    if out.exists() and any(out.samefile(atlas.path(each.sheet)) for each in cutter.members):
        raise OutputError(f"the map would replace a sheet of the atlas; name another file: {out}")
    check_covered(area, cutter.grid, cutter.members, atlas.recipe.sheets, allow_holes)
    progress("sheets", 1.0)
    cutter.read(progress, workers)
    check_shown(area, cutter.grid, cutter.cells, allow_holes)
    written = write_map(out, *_learnt(cutter, workers, progress))
    progress("learn", 1.0)
    return BuildResult(written, out.stat().st_size)


def cut_in_memory(atlas: Atlas, area: Area) -> MapFile:
    """The map of an area, flown at once and never written; missing sheets are holes in it."""
    cutter = _MapCutter(atlas, area)
    cutter.read(no_progress, 1)
    manifest, arrays = _learnt(cutter, 1, no_progress)
    return MapFile(Path(atlas.url, "cut"), 0, manifest, arrays)


class _MapCutter:
    def __init__(self, atlas: Atlas, area: Area) -> None:
        common = atlas.recipe
        self.area = area
        self.grid = grid = grid_of(area, common.gsd_m, common.gsd_m, common.tile_px, common.overlap)
        sheets = atlas.over(box_deg(area, grid.tile_m))
        require_sheets(atlas, area, sheets)
        self.members = members = opened_sheets(atlas, sheets, grid)
        self.recipe, representation = recipes(members[0].manifest)
        turns = isinstance(representation, OrientedGradients)
        self._warps = [Warp(each, area.frame, grid, turns) for each in members]
        self._layout = layout = CellLayout.for_tiles(grid.tile_px, grid.stride_px)
        height, width = grid.height_px, grid.width_px
        self.cells = CellSheet(layout, height, width, representation.channels)
        self.layer = GreyLayerWriter(height, width)
        self.preview = Preview(grid, PREVIEW_PX)

    def read(self, progress: Progress, workers: int) -> None:
        blocks = blocks_of_area(self.area, self.grid, self._layout)
        with one_opencv_thread():
            made = in_order(blocks, lambda: nullcontext(self._made), workers)
            for done, parts in enumerate(made):
                self._take(blocks[done], parts)
                progress("imagery", (done + 1) / len(blocks))

    def _made(self, block: Block) -> Parts:
        """The parts of the map in a block. Called by several threads: changes nothing."""
        warps = [warp for warp in self._warps if warp.reaches(block)]
        grey, valid = joined_grey(warps, block)
        if not valid.any():
            return {}
        means, share = joined_cells(warps, block, self._layout)
        # A whole factor is many times faster.
        size = max(1, block.width // COARSER), max(1, block.height // COARSER)
        coarse = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
        parts: Parts = {"means": means, "share": share}
        parts["preview"] = self.preview.small(block, coarse)
        return parts | layer_parts(self.area, self.grid, block, grey, valid)

    def _take(self, block: Block, parts: Parts) -> None:
        if not parts:
            return
        spacing = self._layout.spacing_px
        rows, cols = self.cells.valid.shape
        part = np.s_[: rows - block.row // spacing, : cols - block.col // spacing]
        self.cells.put(block.row, block.col, parts["means"][part], parts["share"][part])
        self.preview.put(block, parts["preview"])
        self.layer.add(block.row, block.col, parts["grey"], parts["valid"])


def _learnt(
    cutter: _MapCutter, workers: int, progress: Progress
) -> tuple[Manifest, dict[str, NDArray[Any]]]:
    area, grid, members = cutter.area, cutter.grid, cutter.members
    tiles_rc = tiles_of(area, grid, cutter.cells)
    tiles_px = tiles_rc * grid.stride_px
    progress("learn", 0.0)
    embedder = learn(cutter.recipe, cutter.cells, tiles_px, workers)
    progress("learn", 0.3)
    embeddings = embedder.tiles(cutter.cells, tiles_px, workers)
    centres = grid.centres_en_m(tiles_rc)
    grey, grey_parts = cutter.layer.finish()
    area_km2 = round(len(tiles_rc) * grid.stride_m**2 / 1e6, 6)
    made = cut_terrain(members, area, grid)
    terrain, terrain_parts = (None, {}) if made is None else made
    sheet = SheetInfo(area.frame, grid, len(tiles_rc), area_km2, grey, terrain)
    manifest = pooled_manifest(members, _shares(area, centres, members), sheet)
    return manifest, {
        "sheet0/centres_en_m": centres.astype(np.float32),
        "sheet0/embeddings": embeddings,
        "sheet0/preview_jpeg": cutter.preview.jpeg(),
        **{f"embed/{name}": array for name, array in embedder.parts().items()},
        **grey_parts,
        **terrain_parts,
    }


def _shares(
    area: Area, centres_en_m: NDArray[np.float64], members: Sequence[SheetSource]
) -> NDArray[np.float64]:
    lat, lon = area.frame.latlon_from_en(centres_en_m)
    boxes = [each.sheet.bounds_deg for each in members]
    found = np.array([np.count_nonzero(in_box(box, lat, lon)) for box in boxes], np.float64)
    return found / found.sum() if found.any() else np.full(len(found), 1 / len(found))
