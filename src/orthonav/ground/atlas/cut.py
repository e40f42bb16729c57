"""Cutting a flight's map out of an atlas: the content of its sheets, resampled into one plane.

The imagery is not needed: the grey picture comes from the registration layers of the sheets, tiles
are embedded from the cell means of the sheets. The confidence of registered views is the usual one,
with the scores of chance of the sheet where they are highest; tiles have none. The same atlas gives
the same bytes for any number of threads.

Within a block of a kilometre two planes differ by a shift, a rotation of less than a degree and
millimetres, so each sheet is resampled by one affine per block. A place is taken from the sheet
whose box holds it; where that sheet shows nothing, from neighbours that reach over their border."""

import json
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
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
    VariantError,
)
from orthonav.core.files import Progress, no_progress
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.geo.ground import relief_slope
from orthonav.core.localize.confidence import (
    CHANCES,
    Chances,
    RegisteredConfidence,
)
from orthonav.core.localize.ground import UNKNOWN_LEAN
from orthonav.core.mapfile.layer import GreyLayer
from orthonav.core.mapfile.manifest import Lean, Manifest, SheetInfo, TerrainInfo
from orthonav.core.mapfile.reader import MapFile, open_map, write_map
from orthonav.core.mapfile.terrain import SURFACE, TERRAIN, TerrainLayer
from orthonav.core.tiles import embed, represent
from orthonav.core.tiles.cells import CellLayout
from orthonav.core.tiles.represent import HARMONICS, OrientedGradients
from orthonav.core.tiles.whitened import CellSheet, WhitenedRecipe, learn
from orthonav.core.variants import variant_from_recipe
from orthonav.ground.atlas.catalog import Atlas, Sheet
from orthonav.ground.build.build import MAX_WORKERS, BuildResult
from orthonav.ground.build.layer import (
    GreyLayerWriter,
    HeightLayers,
    Parts,
    StoredCells,
    TerrainParts,
    terrain_parts,
)
from orthonav.ground.build.sheet import (
    MIN_TILE_VALID_SHARE,
    Block,
    Preview,
    blocks_of_area,
    grid_of,
    in_order,
    layer_parts,
    one_opencv_thread,
    tiles_of,
)
from orthonav.ground.planning.area import Area, Extent, outline
from orthonav.ground.planning.route import along_polyline_en_m
from orthonav.ground.planning.sheets import in_box

log = logging.getLogger(__name__)

MAX_TILES = 20_000  # tiles of an area that are checked; more are checked at even spacing
EDGE_POINTS = 33  # points along an edge of a box: edges are not straight in degrees
NAMED = 8  # missing sheets named in a message, at most
Array = NDArray[np.float64]
KERNEL_PX = 3  # margin of cubic interpolation, 2 pixels, and one more for rounding
SHEET_POINTS = 16  # points along an edge of a sheet, which is not straight in another plane
FILL_PX = 5  # kernel of cubic interpolation: imagery is extended beyond its edge
OWN_BONUS = 0.01  # decides ties between sheets for the one whose box holds the cell
_SHIFT = 6  # fractional bits of polygon corners in OpenCV
Pixels = tuple[NDArray[np.uint8], NDArray[np.bool_]]
Cells = tuple[NDArray[np.float32], NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class SheetSource:
    sheet: Sheet
    manifest: Manifest
    layer: GreyLayer
    cells: StoredCells
    terrain: TerrainLayer | None
    surface: TerrainLayer | None

    @property
    def frame(self) -> LocalFrame:
        return self.manifest.sheets[0].frame

    @property
    def grid(self) -> TileGrid:
        return self.manifest.sheets[0].grid


@dataclass(frozen=True, eq=False)
class Warp:
    source: SheetSource
    frame: LocalFrame
    grid: TileGrid
    turns: bool  # whether cells are harmonics of a direction, which rotate with the plane

    def reaches(self, block: Block) -> bool:
        left, top, right, bottom = self._box_px
        return (
            block.col < right
            and block.row < bottom
            and block.col + block.width > left
            and block.row + block.height > top
        )

    def affine(self, block: Block) -> Array:
        """Affine (2, 3) from pixels of the grid to pixels of the sheet (pixel-is-area), fitted to
        the corners of a block."""
        corners = _corners(block)
        places = _latlon_from_px(self.frame, self.grid, corners)
        there = _px_from_latlon(self.source.frame, self.source.grid, *places)
        design = np.column_stack([corners - corners[0], np.ones(len(corners))])
        solved = np.linalg.lstsq(design, there, rcond=None)[0].T
        solved[:, 2] -= solved[:, :2] @ corners[0]
        return np.asarray(solved)

    def owned(self, block: Block, layout: CellLayout | None = None) -> NDArray[np.bool_]:
        spacing, middle = (1, 0.5) if layout is None else (layout.spacing_px, layout.micro_px / 2)
        shape = -(-block.height // spacing), -(-block.width // spacing)
        # OpenCV's coordinates 0, 0 are the middle of pixel or cell 0, 0.
        points = (self._outline_px - [block.col + middle, block.row + middle]) / spacing
        points = np.rint(points * 2**_SHIFT).astype(np.int32)
        mask = np.zeros(shape, dtype=np.uint8)
        cv2.fillPoly(mask, [points], 1, lineType=cv2.LINE_8, shift=_SHIFT)
        return mask.astype(np.bool_)

    def grey(self, block: Block) -> Pixels:
        affine = self.affine(block)
        matrix = _by_middles(affine, block, 1, 0.5)
        size = block.width, block.height
        top, left, height, width = _window(matrix, size)
        grey, valid = self.source.layer.read(0, top, left, height, width)
        shape = block.height, block.width
        if not valid.any():
            return np.zeros(shape, np.uint8), np.zeros(shape, np.bool_)
        matrix[:, 2] -= [left, top]
        whole = bool(valid.all())
        if not whole:  # zeros beyond the imagery must not darken its edge
            grown = cv2.dilate(grey, np.ones((FILL_PX, FILL_PX), np.uint8))
            grey = np.where(valid, grey, grown).astype(np.uint8)
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        made = cv2.warpAffine(grey, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        if whole:
            return np.asarray(made, np.uint8), np.ones(shape, np.bool_)
        mask = valid.astype(np.uint8) * 255
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        shown = cv2.warpAffine(mask, matrix, size, flags=flags) >= 254
        return np.where(shown, made, 0).astype(np.uint8), np.asarray(shown, np.bool_)

    def cells(self, block: Block, layout: CellLayout) -> Cells:
        spacing, middle = layout.spacing_px, layout.micro_px / 2
        rows, cols = -(-block.height // spacing), -(-block.width // spacing)
        matrix = _by_middles(self.affine(block), block, spacing, middle)
        top, left, height, width = _window(matrix, (cols, rows))
        means, share = self.source.cells.read(top, left, height, width)
        matrix[:, 2] -= [left, top]
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        planes = [
            cv2.warpAffine(np.ascontiguousarray(plane), matrix, (cols, rows), flags=flags)
            for plane in (*np.moveaxis(means, 2, 0), share)
        ]
        made = np.stack(planes[:-1], axis=2).astype(np.float32)
        if self.turns:
            _turn(made, math.atan2(matrix[1, 0], matrix[0, 0]))
        return made, np.asarray(planes[-1], np.float32)

    @cached_property
    def _outline_px(self) -> Array:
        lon, lat = outline(self.source.sheet.bounds_deg, SHEET_POINTS).T
        return _px_from_latlon(self.frame, self.grid, lat, lon)

    @cached_property
    def _box_px(self) -> tuple[float, float, float, float]:
        grid = self.source.grid
        corners = _corners(Block(0, 0, grid.height_px, grid.width_px))
        places = _latlon_from_px(self.source.frame, grid, corners)
        points = _px_from_latlon(self.frame, self.grid, *places)
        (left, top), (right, bottom) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
        return left - 1, top - 1, right + 1, bottom + 1


def _px_from_latlon(frame: LocalFrame, grid: TileGrid, lat_deg: Array, lon_deg: Array) -> Array:
    points = frame.en_from_latlon(lat_deg, lon_deg)
    return np.asarray((points - [grid.west_m, grid.north_m]) / [grid.gsd_m, -grid.gsd_m])


def _latlon_from_px(frame: LocalFrame, grid: TileGrid, px: Array) -> tuple[Array, Array]:
    places = [grid.west_m, grid.north_m] + px * [grid.gsd_m, -grid.gsd_m]
    return frame.latlon_from_en(places)


def joined_grey(warps: Sequence[Warp], block: Block) -> Pixels:
    grey = np.zeros((block.height, block.width), dtype=np.uint8)
    valid = np.zeros(grey.shape, dtype=np.bool_)
    owners = [(warp, warp.owned(block)) for warp in warps]
    for own in (True, False):
        for warp, mask in owners:
            wanted = ~valid & mask if own else ~(valid | mask)
            part = _around(wanted)
            if part is None:
                continue
            rows, cols = part
            size = rows.stop - rows.start, cols.stop - cols.start
            some, there = warp.grey(Block(block.row + rows.start, block.col + cols.start, *size))
            taken = there & wanted[part]
            np.copyto(grey[part], some, where=taken)
            valid[part] |= taken
    return grey, valid


def _around(wanted: NDArray[np.bool_]) -> tuple[slice, slice] | None:
    rows, cols = (np.flatnonzero(wanted.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return None
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)


def joined_cells(warps: Sequence[Warp], block: Block, layout: CellLayout) -> Cells:
    owners = [(warp, warp.owned(block, layout)) for warp in warps]
    owners.sort(key=lambda each: not each[1].any())
    means, share = owners[0][0].cells(block, layout)
    best = share + np.float32(OWN_BONUS) * owners[0][1]
    for warp, mask in owners[1:]:
        if best.min() >= 1:
            break
        some, their_share = warp.cells(block, layout)
        rank = their_share + np.float32(OWN_BONUS) * mask
        better = rank > best
        means[better], share[better] = some[better], their_share[better]
        best = np.maximum(best, rank)
    return means, share


def _turn(means: NDArray[np.float32], angle_rad: float) -> None:
    for k in range(1, HARMONICS + 1):
        cos, sin = np.float32(math.cos(2 * k * angle_rad)), np.float32(math.sin(2 * k * angle_rad))
        real, imaginary = means[..., 2 * k - 1].copy(), means[..., 2 * k].copy()
        means[..., 2 * k - 1] = real * cos + imaginary * sin
        means[..., 2 * k] = imaginary * cos - real * sin


def _corners(block: Block) -> Array:
    right, bottom = block.col + block.width, block.row + block.height
    return np.array(
        [[block.col, block.row], [right, block.row], [block.col, bottom], [right, bottom]], float
    )


def _by_middles(affine: Array, block: Block, spacing: int, middle: float) -> Array:
    """The affine between indices of pixels (or cells) whose middles lie `middle` px into them.
    Index 0, 0 is the first of the block, and the first of the raster of the sheet."""
    linear = affine[:, :2]
    first = linear @ [block.col + middle, block.row + middle] + affine[:, 2] - middle
    return np.column_stack([linear, first / spacing])


def _window(matrix: Array, size: tuple[int, int]) -> tuple[int, int, int, int]:
    cols, rows = size
    corners = np.array([[0, 0], [cols - 1, 0], [0, rows - 1], [cols - 1, rows - 1]], float)
    there = corners @ matrix[:, :2].T + matrix[:, 2]
    left, top = (int(value) for value in np.floor(there.min(axis=0)) - KERNEL_PX)
    right, bottom = (int(value) for value in np.ceil(there.max(axis=0)) + KERNEL_PX)
    return top, left, bottom - top + 1, right - left + 1


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


def check_shown(
    area: Area, grid: TileGrid, cells: CellSheet, atlas: Atlas, allow_holes: bool
) -> None:
    """Warn where the atlas shows no imagery of an area; `AtlasError` where the route is there. With
    `allow_holes` that is a warning too."""
    for part, points in _checked_points(area, grid).items():
        tiles = grid.tiles_rc(points).clip(0, [grid.rows - 1, grid.cols - 1])
        bare = cells.valid_share(tiles * grid.stride_px) < MIN_TILE_VALID_SHARE
        if not bare.any():
            continue
        places = np.stack(area.frame.latlon_from_en(points[bare]), axis=1).tolist()
        under = {atlas.recipe.sheets.name_at(*place) for place in places}
        names = sorted(under - atlas.sheets().keys())
        lacking = ", ".join(names[:NAMED]) + ", .." * (len(names) > NAMED)
        said = f"{100 * bare.mean():.3g} % of the {part} has no imagery in the atlas"
        said += f", which lacks sheets {lacking}" if names else ""
        if part == "route" and not allow_holes:
            raise AtlasError(f"{said}; extend the atlas, or allow holes (--allow-holes)")
        log.warning("%s", said)


def _checked_points(area: Area, grid: TileGrid) -> dict[str, Array]:
    points = {}
    if area.route is not None:
        line = area.route.points_en_m(area.frame)
        points["route"] = np.concatenate([along_polyline_en_m(line, grid.tile_m / 4)[0], line[-1:]])
    step = max(1, int(np.ceil(np.sqrt(grid.rows * grid.cols / MAX_TILES))))
    tiles = np.mgrid[0 : grid.rows : step, 0 : grid.cols : step].reshape(2, -1).T
    centres = grid.centres_en_m(tiles)
    points["area"] = centres[area.contains(centres, grid.stride_m * np.sqrt(0.5))]
    return points


CACHE_BYTES = 24 * 2**20  # decoded chunks of each sheet: those along the border of a row of blocks
REBUILD = "rebuild it with this program (orthonav atlas build ATLAS .. --replace)"

GRID = "gsd_m", "tile_px", "stride_px"  # what the grids of all sheets have in common
RECIPE = "method", "represent", "embed", "overlap"  # and their recipes


def opened_sheets(atlas: Atlas, sheets: Sequence[Sheet], grid: TileGrid) -> list[SheetSource]:
    found: list[SheetSource] = []
    for sheet in sheets:
        opened = open_map(atlas.path(sheet))
        first = found[0].manifest if found else opened.manifest
        _require_alike(sheet, opened.manifest, grid, first)
        found.append(_source(opened, sheet))
    return found


def _require_alike(sheet: Sheet, manifest: Manifest, grid: TileGrid, first: Manifest) -> None:
    own = manifest.sheets[0].grid
    other = [name for name in GRID if getattr(own, name) != getattr(grid, name)]
    other += [name for name in RECIPE if manifest.recipe.get(name) != first.recipe.get(name)]
    if other:
        raise AtlasError(f"sheet {sheet.id} has another {' and '.join(other)}, {REBUILD}")


def _source(opened: MapFile, sheet: Sheet) -> SheetSource:
    _, representation = recipes(opened.manifest)
    grid = opened.manifest.sheets[0].grid
    layer = GreyLayer.of(opened, cache_bytes=CACHE_BYTES)
    layout = CellLayout.for_tiles(grid.tile_px, grid.stride_px)
    cells = StoredCells.of(opened, layout, representation.channels)
    if layer is None or cells is None or opened.manifest.registration is None:
        lacking = "registration layer" if layer is None else "cells"
        raise AtlasError(
            f"sheet {sheet.id} has no {lacking}, from which maps are cut; {REBUILD}: {opened.path}"
        )
    heights = (TerrainLayer.of(opened, layer=each) for each in (TERRAIN, SURFACE))
    return SheetSource(sheet, opened.manifest, layer, cells, *heights)


def recipes(manifest: Manifest) -> tuple[WhitenedRecipe, Any]:
    recipe = variant_from_recipe(embed.TABLE, manifest.recipe.get("embed"))
    representation = variant_from_recipe(represent.TABLE, manifest.recipe.get("represent"))
    if not isinstance(recipe, WhitenedRecipe):
        raise AtlasError(f"maps are cut from sheets of the method gradient, not of {recipe}")
    return recipe, representation


def pooled_manifest(
    members: Sequence[SheetSource], shares: NDArray[np.float64], sheet: SheetInfo
) -> Manifest:
    manifests = [member.manifest for member in members]
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
        confidence=None,
        radius_m=max(each.radius_m for each in manifests),
        created_by=f"orthonav {__version__}",
        registration=_registration(manifests, shares),
    )


def _registration(manifests: Sequence[Manifest], shares: NDArray[np.float64]) -> dict[str, Any]:
    layers = [each.registration or {} for each in manifests]
    known = [
        RegisteredConfidence.from_plain(each["confidence"]).chances
        for each, share in zip(layers, shares, strict=True)
        if each.get("confidence") is not None and share > 0
    ]
    confidence = None
    if known:
        chances = {name: max(getattr(each, name) for each in known) for name in CHANCES}
        confidence = RegisteredConfidence.usual(Chances(**chances)).to_plain()
    return {
        "confidence": confidence,
        "radius_m": max(float(each["radius_m"]) for each in layers),
        "position_floor_px": max(float(each["position_floor_px"]) for each in layers),
    }


def _imagery(manifests: Sequence[Manifest]) -> tuple[dict[str, Any], ...]:
    sources = {json.dumps(each, sort_keys=True): each for one in manifests for each in one.imagery}

    dated = sorted(
        (str(s.get("date") or ""), str(s.get("name") or ""), k) for k, s in sources.items()
    )
    return tuple(sources[key] for _, _, key in dated)


def cut_heights(members: Sequence[SheetSource], area: Area, grid: TileGrid) -> HeightLayers:
    """The layers of heights of a map cut from sheets; where a sheet has none, they have holes."""
    terrains = [(each, each.terrain) for each in members if each.terrain is not None]
    surfaces = [(each, each.surface) for each in members if each.surface is not None]
    return HeightLayers(
        _cut_heights(terrains, area, grid, TERRAIN),
        _cut_heights(surfaces, area, grid, SURFACE),
        _common_lean([each.manifest.sheets[0].lean for each, _ in surfaces]),
    )


def _common_lean(leans: Sequence[Lean | None]) -> Lean | None:
    """The mean, as uncertain as the sheets differ from it; None where none is known."""
    if not any(leans):
        return None
    known = [each or UNKNOWN_LEAN for each in leans]
    vectors = np.array([[each.east, each.north] for each in known])
    east, north = vectors.mean(axis=0).tolist()
    spread = float(np.abs(vectors - [east, north]).max())
    return Lean(east, north, max(spread, *(each.std for each in known)))


def _cut_heights(
    layers: Sequence[tuple[SheetSource, TerrainLayer]], area: Area, grid: TileGrid, layer: str
) -> TerrainParts | None:
    """A place has the height of the sheet whose box holds it, else of one that reaches over its
    border."""
    if not layers:
        return None
    infos = [layer.info for _, layer in layers]
    posting_m = min(info.posting_m for info in infos)
    names, datums = sorted({info.name for info in infos}), sorted({info.datum for info in infos})

    def sampled(west_m: float, north_m: float, posting_m: float, rows: int, cols: int) -> Array:
        row, col = np.mgrid[:rows, :cols] + 0.5
        points = np.stack([west_m + col * posting_m, north_m - row * posting_m], axis=-1)
        return _heights(layers, *area.frame.latlon_from_en(points))

    named = ", ".join(names), ", ".join(datums)
    unit_m = min(info.unit_m for info in infos)
    made = terrain_parts(area, grid, posting_m, *named, sampled, layer=layer, unit_m=unit_m)
    if made is None:
        return None
    source_m = [each.source_posting_m for each in infos if each.source_posting_m is not None]
    info = replace(
        made.info,
        source_posting_m=max(source_m, default=None),
        roughness_m=_roughness_m(infos),
    )
    return made._replace(info=info)


def _roughness_m(infos: Sequence[TerrainInfo]) -> float | None:
    """The least of the sheets: a surface model only where all of it is one."""
    return min(each.roughness_m or 0.0 for each in infos) or None


def _relief(members: Sequence[SheetSource]) -> str | None:
    """The steepest of the sheets."""
    stated = [each.manifest.sheets[0].relief for each in members]
    return max(stated, key=relief_slope)


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
    cutter.read(progress, workers)
    check_shown(area, cutter.grid, cutter.cells, atlas, allow_holes)
    written = write_map(out, *_learnt(cutter, workers, progress))
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
        if not sheets:
            bounds = ",".join(f"{each:.4f}" for each in atlas.bounds_deg or ())
            raise AreaError(
                f"the area lies outside the atlas, whose {len(atlas.sheets())} sheets lie within "
                f"'{bounds}' (west, south, east, north): {atlas.url}"
            )
        self.members = members = opened_sheets(atlas, sheets, grid)
        self.recipe, representation = recipes(members[0].manifest)
        turns = isinstance(representation, OrientedGradients)
        self._warps = [Warp(each, area.frame, grid, turns) for each in members]
        self._layout = layout = CellLayout.for_tiles(grid.tile_px, grid.stride_px)
        height, width = grid.height_px, grid.width_px
        self.cells = CellSheet(layout, height, width, representation.channels)
        self.layer = GreyLayerWriter(height, width)
        self.preview = Preview(grid)

    def read(self, progress: Progress, workers: int) -> None:
        blocks = blocks_of_area(self.area, self.grid, self._layout)
        with one_opencv_thread():
            made = in_order(self._made, blocks, workers)
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
        # A whole factor, as 4, is many times faster.
        size = max(1, block.width // 4), max(1, block.height // 4)
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
    embeddings = embedder.tiles(cutter.cells, tiles_px, workers)
    centres = grid.centres_en_m(tiles_rc)
    grey, grey_parts = cutter.layer.finish()
    area_km2 = round(len(tiles_rc) * grid.stride_m**2 / 1e6, 6)
    heights = cut_heights(members, area, grid)
    terrain, surface = heights.infos
    sheet = SheetInfo(
        *(area.frame, grid, len(tiles_rc), area_km2, grey, terrain, _relief(members), surface),
        lean=heights.lean,
    )
    manifest = pooled_manifest(members, _shares(area, centres, members), sheet)
    return manifest, {
        "sheet0/centres_en_m": centres.astype(np.float32),
        "sheet0/embeddings": embeddings,
        "sheet0/preview_jpeg": cutter.preview.jpeg(),
        **{f"embed/{name}": array for name, array in embedder.parts().items()},
        **grey_parts,
        **heights.arrays,
    }


def _shares(
    area: Area, centres_en_m: NDArray[np.float64], members: Sequence[SheetSource]
) -> NDArray[np.float64]:
    lat, lon = area.frame.latlon_from_en(centres_en_m)
    boxes = [each.sheet.bounds_deg for each in members]
    found = np.array([np.count_nonzero(in_box(box, lat, lon)) for box in boxes], np.float64)
    return found / found.sum() if found.any() else np.full(len(found), 1 / len(found))
