"""Cutting a flight's map out of an atlas: the content of its sheets, resampled into one plane.

The imagery is not needed: the grey levels are those of the registration layers of the sheets. The
confidence of registered views is the usual one, with the scores of chance of the sheet where they
are highest; tiles have none. The same atlas gives the same bytes for any number of threads.

Within a block of a kilometre two planes differ by a shift, a rotation of less than a degree and
millimetres, so each sheet is resampled by one affine per block. A place is taken from the sheet
whose box holds it; where that sheet shows nothing, from neighbours that reach over their border."""

import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav import __version__
from orthonav.core.cores import usable_cores
from orthonav.core.errors import AreaError, AtlasError, VariantError
from orthonav.core.files import Progress, no_progress
from orthonav.core.geo.frames import LocalFrame, wrapped_deg
from orthonav.core.geo.grid import TileGrid
from orthonav.core.geo.ground import relief_slope
from orthonav.core.localize.confidence import CHANCES, Chances, RegisteredConfidence
from orthonav.core.localize.ground import UNKNOWN_LEAN
from orthonav.core.mapfile.layer import GreyLayer
from orthonav.core.mapfile.manifest import Lean, Manifest, SheetInfo, TerrainInfo
from orthonav.core.mapfile.reader import open_map, write_map
from orthonav.core.mapfile.terrain import SURFACE, TERRAIN, TerrainLayer
from orthonav.core.tiles import embed, represent
from orthonav.core.tiles.whitened import CellSheet, WhitenedRecipe
from orthonav.core.variants import variant_from_recipe
from orthonav.ground.atlas.catalog import Atlas, Sheet
from orthonav.ground.build.build import MAX_WORKERS, BuildResult
from orthonav.ground.build.layer import HeightLayers, TerrainParts, terrain_parts
from orthonav.ground.build.sheet import (
    MIN_TILE_VALID_SHARE,
    Block,
    SheetReader,
    grid_of,
    tiles_of,
)
from orthonav.ground.build.whitening import learn
from orthonav.ground.imagery.mosaic import Pixels
from orthonav.ground.planning.area import Area, Extent, outline
from orthonav.ground.planning.route import along_polyline_en_m
from orthonav.ground.planning.sheets import in_box

log = logging.getLogger(__name__)

EDGE_POINTS = 33  # points along an edge of a box: edges are not straight in another plane
REBUILD = "rebuild it with this program (orthonav atlas build ATLAS .. --replace)"
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SheetSource:
    sheet: Sheet
    manifest: Manifest
    layer: GreyLayer
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
    """The grey levels of one sheet in the plane and grid of another map."""

    source: SheetSource
    frame: LocalFrame
    grid: TileGrid

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

    def owned(self, block: Block) -> NDArray[np.bool_]:
        """Which pixels of a block lie in the box of the sheet."""
        # OpenCV's coordinates 0, 0 are the middle of pixel 0, 0; 6 of their bits are fractional.
        points = np.rint((self._outline_px - [block.col + 0.5, block.row + 0.5]) * 2**6)
        mask = np.zeros((block.height, block.width), dtype=np.uint8)
        cv2.fillPoly(mask, [points.astype(np.int32)], 1, lineType=cv2.LINE_8, shift=6)
        return mask.astype(np.bool_)

    def grey(self, block: Block) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        matrix = self.affine(block)
        first = np.array([block.col, block.row]) + 0.5
        matrix[:, 2] += matrix[:, :2] @ first - 0.5  # between the middles of pixels
        size = block.width, block.height
        corners = _corners(Block(0, 0, block.height - 1, block.width - 1))
        there = corners @ matrix[:, :2].T + matrix[:, 2]
        # Cubic interpolation takes 2 pixels, and rounding one more.
        left, top = (np.floor(there.min(axis=0)).astype(int) - 3).tolist()
        right, bottom = (np.ceil(there.max(axis=0)).astype(int) + 3).tolist()
        grey, valid = self.source.layer.read(0, top, left, bottom - top + 1, right - left + 1)
        if not valid.any():
            return np.zeros(size[::-1], np.uint8), np.zeros(size[::-1], np.bool_)
        matrix[:, 2] -= [left, top]
        whole = bool(valid.all())
        if not whole:  # zeros beyond the imagery must not darken its edge
            grown = cv2.dilate(grey, np.ones((5, 5), np.uint8))
            grey = np.where(valid, grey, grown).astype(np.uint8)
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        made = cv2.warpAffine(grey, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        if whole:
            return np.asarray(made, np.uint8), np.ones(size[::-1], np.bool_)
        mask = valid.astype(np.uint8) * 255
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        shown = cv2.warpAffine(mask, matrix, size, flags=flags) >= 254
        return np.where(shown, made, 0).astype(np.uint8), np.asarray(shown, np.bool_)

    @cached_property
    def _outline_px(self) -> Array:
        lon, lat = outline(self.source.sheet.bounds_deg, EDGE_POINTS).T
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


def _corners(block: Block) -> Array:
    right, bottom = block.col + block.width, block.row + block.height
    return np.array(
        [[block.col, block.row], [right, block.row], [block.col, bottom], [right, bottom]], float
    )


class SheetMosaic:
    """Sheets read as one picture, a `GreyRaster` of `SheetReader`."""

    def __init__(self, members: Sequence[SheetSource], frame: LocalFrame, grid: TileGrid) -> None:
        self._warps = [Warp(each, frame, grid) for each in members]

    def read_grey(self, col: int, row: int, width_px: int, height_px: int) -> Pixels:
        block = Block(row, col, height_px, width_px)
        grey = np.zeros((block.height, block.width), dtype=np.uint8)
        valid = np.zeros(grey.shape, dtype=np.bool_)
        warps = [(warp, warp.owned(block)) for warp in self._warps if warp.reaches(block)]
        for own in (True, False):
            for warp, mask in warps:
                wanted = ~valid & mask if own else ~(valid | mask)
                if not wanted.any():
                    continue
                part = tuple(
                    slice(int(found[0]), int(found[-1]) + 1)
                    for found in (np.flatnonzero(wanted.any(axis=axis)) for axis in (1, 0))
                )
                size = part[0].stop - part[0].start, part[1].stop - part[1].start
                some, there = warp.grey(Block(row + part[0].start, col + part[1].start, *size))
                taken = there & wanted[part]
                np.copyto(grey[part], some, where=taken)
                valid[part] |= taken
        return Pixels(grey[..., None], valid)


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
    return wrapped_deg(west), south, wrapped_deg(east), north


def check_shown(
    area: Area, grid: TileGrid, cells: CellSheet, atlas: Atlas, allow_holes: bool
) -> None:
    """Warn where the atlas shows no imagery of an area; `AtlasError` where the route is there. With
    `allow_holes` that is a warning too."""
    for part, points in _checked_points(area, grid):
        tiles = grid.tiles_rc(points).clip(0, [grid.rows - 1, grid.cols - 1])
        bare = cells.valid_share(tiles * grid.stride_px) < MIN_TILE_VALID_SHARE
        if not bare.any():
            continue
        places = np.stack(area.frame.latlon_from_en(points[bare]), axis=1).tolist()
        under = {atlas.recipe.sheets.name_at(*place) for place in places}
        names = sorted(under - atlas.sheets().keys())
        said = f"{100 * bare.mean():.3g} % of the {part} has no imagery in the atlas"
        if names:
            said += f", which lacks sheets {', '.join(names[:8])}" + ", .." * (len(names) > 8)
        if part == "route" and not allow_holes:
            raise AtlasError(f"{said}; extend the atlas, or allow holes (--allow-holes)")
        log.warning("%s", said)


def _checked_points(area: Area, grid: TileGrid) -> Iterator[tuple[str, Array]]:
    """Of the route, and centres of the tiles of the area, or of 20,000 evenly spaced ones."""
    if area.route is not None:
        line = area.route.points_en_m(area.frame)
        along = along_polyline_en_m(line, grid.tile_m / 4)[0]
        yield "route", np.concatenate([along, line[-1:]])
    step = max(1, int(np.ceil(np.sqrt(grid.rows * grid.cols / 20_000))))
    tiles = np.mgrid[0 : grid.rows : step, 0 : grid.cols : step].reshape(2, -1).T
    centres = grid.centres_en_m(tiles)
    yield "area", centres[area.contains(centres, grid.stride_m * np.sqrt(0.5))]


def opened_sheets(atlas: Atlas, sheets: Sequence[Sheet], grid: TileGrid) -> list[SheetSource]:
    found: list[SheetSource] = []
    for sheet in sheets:
        opened = open_map(atlas.path(sheet))
        manifest = opened.manifest
        _require_alike(sheet, manifest, grid, found[0].manifest if found else manifest)
        # Decoded chunks of each sheet: those along the border of a row of blocks.
        layer = GreyLayer.of(opened, cache_bytes=24 * 2**20)
        if layer is None or manifest.registration is None:
            raise AtlasError(
                f"sheet {sheet.id} has no registration layer, from which maps are cut; {REBUILD}: "
                f"{opened.path}"
            )
        heights = (TerrainLayer.of(opened, layer=each) for each in (TERRAIN, SURFACE))
        found.append(SheetSource(sheet, manifest, layer, *heights))
    return found


def _require_alike(sheet: Sheet, manifest: Manifest, grid: TileGrid, first: Manifest) -> None:
    own, recipe = manifest.sheets[0].grid, manifest.recipe
    other = [
        name
        for name in ("gsd_m", "tile_px", "stride_px")
        if getattr(own, name) != getattr(grid, name)
    ]
    other += [
        name
        for name in ("method", "represent", "embed", "overlap")
        if recipe.get(name) != first.recipe.get(name)
    ]
    if other:
        raise AtlasError(f"sheet {sheet.id} has another {' and '.join(other)}, {REBUILD}")


def recipes(manifest: Manifest) -> tuple[WhitenedRecipe, Any]:
    recipe = variant_from_recipe(embed.TABLE, manifest.recipe.get("embed"))
    representation = variant_from_recipe(represent.TABLE, manifest.recipe.get("represent"))
    if not isinstance(recipe, WhitenedRecipe):
        raise AtlasError(f"maps are cut from sheets of the method gradient, not of {recipe}")
    return recipe, representation


def pooled_manifest(members: Sequence[SheetSource], sheet: SheetInfo) -> Manifest:
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
        registration=_registration(manifests),
    )


def _registration(manifests: Sequence[Manifest]) -> dict[str, Any]:
    layers = [each.registration or {} for each in manifests]
    known = [
        RegisteredConfidence.from_plain(each["confidence"]).chances
        for each in layers
        if each.get("confidence") is not None
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
        roughness_m=least_roughness_m(infos),
    )
    return made._replace(info=info)


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


def least_roughness_m(infos: Sequence[TerrainInfo]) -> float | None:
    """None, a terrain model, unless all are surface models."""
    return min(each.roughness_m or 0.0 for each in infos) or None


def steepest(members: Sequence[SheetSource]) -> str | None:
    """The relief of the sheets where it is steepest."""
    return max((each.manifest.sheets[0].relief for each in members), key=relief_slope)


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
    out, common = Path(out), atlas.recipe
    workers = usable_cores() if workers is None else workers
    if not 1 <= workers <= MAX_WORKERS:
        raise VariantError(f"workers must be 1 to {MAX_WORKERS}, got {workers}")
    progress("sheets", 0.0)
    grid = grid_of(area, common.gsd_m, common.gsd_m, common.tile_px, common.overlap)
    sheets = atlas.over(box_deg(area, grid.tile_m))
    if not sheets:
        bounds = ",".join(f"{each:.4f}" for each in atlas.bounds_deg or ())
        raise AreaError(
            f"the area lies outside the atlas, whose {len(atlas.sheets())} sheets lie within "
            f"'{bounds}' (west, south, east, north): {atlas.url}"
        )
    members = opened_sheets(atlas, sheets, grid)
    recipe, representation = recipes(members[0].manifest)
    reader = SheetReader(area, grid, representation, registration=True)
    with suppress(AreaError):  # no imagery at all: `check_shown` names the sheets that are missing
        reader.read(SheetMosaic(members, area.frame, grid), progress, workers)
    check_shown(area, grid, reader.cells, atlas, allow_holes)
    progress("learn", 0.0)
    written = write_map(out, *_learnt(reader, recipe, members, workers))
    return BuildResult(written, out.stat().st_size)


def _learnt(
    reader: SheetReader, recipe: WhitenedRecipe, members: Sequence[SheetSource], workers: int
) -> tuple[Manifest, dict[str, NDArray[Any]]]:
    area, grid = reader.area, reader.grid
    tiles_rc = tiles_of(area, grid, reader.cells)
    tiles_px = tiles_rc * grid.stride_px
    embedder = learn(recipe, reader.cells, tiles_px, workers)
    embeddings = embedder.tiles(reader.cells, tiles_px, workers)
    heights = cut_heights(members, area, grid)
    sheet, arrays = reader.finish(tiles_rc, embedder, embeddings, heights, steepest(members))
    return pooled_manifest(members, sheet), arrays
