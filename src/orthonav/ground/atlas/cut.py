"""Cutting a flight's map out of an atlas: the content of its sheets, resampled into one plane.

The imagery is not needed: the grey picture comes from the registration layers of the sheets, tiles
are embedded from the cell means of the sheets, and confidences are pooled. The same atlas gives
the same bytes for any number of threads.
"""

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.cores import usable_cores
from orthonav.core.errors import OutputError, VariantError
from orthonav.core.files import Progress, no_progress
from orthonav.core.mapfile.manifest import Manifest, SheetInfo
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.mapfile.writer import write_map
from orthonav.core.tiles.cells import CellLayout
from orthonav.core.tiles.gradients import OrientedGradients
from orthonav.core.tiles.whitened import CellSheet, learn
from orthonav.ground.atlas.catalog import Atlas
from orthonav.ground.atlas.coverage import box_deg, check_covered, check_shown, require_sheets
from orthonav.ground.atlas.cut_sheets import cut_terrain, opened_sheets, pooled_manifest, recipes
from orthonav.ground.atlas.warp import SheetSource, Warp, joined_cells, joined_grey
from orthonav.ground.build.build import MAX_WORKERS, BuildResult
from orthonav.ground.build.layer import GreyLayerWriter, Parts
from orthonav.ground.build.sheet import (
    PREVIEW_PX,
    Block,
    Preview,
    blocks_of_area,
    grid_of,
    in_order,
    layer_parts,
    one_opencv_thread,
    put_layer_parts,
    tiles_of,
)
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.world import in_box

COARSER = 4
"""Factor by which blocks are reduced for the preview."""


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
    or cannot be cut from, `StorageError`, `OutputError`.
    """
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
    """The map of an area, flown at once and never written; missing sheets are holes in it.

    Raises `AreaError` for areas outside the atlas, `AtlasError` where sheets are damaged or cannot
    be cut from, `StorageError`.
    """
    cutter = _MapCutter(atlas, area)
    cutter.read(no_progress, 1)
    manifest, arrays = _learnt(cutter, 1, no_progress)
    return MapFile(Path(atlas.url, "cut"), 0, manifest, arrays)


class _MapCutter:
    """Collects cells, grey layer and preview of the map from the sheets under it."""

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
        """Resample all blocks with `workers` threads. Raises `AtlasError` for a damaged sheet."""
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
        put_layer_parts(self.layer, block, parts)


def _learnt(
    cutter: _MapCutter, workers: int, progress: Progress
) -> tuple[Manifest, dict[str, NDArray[Any]]]:
    """Manifest and arrays of the map."""
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
    """Share of the tiles in the box of each sheet; equal shares where there are none."""
    lat, lon = area.frame.latlon_from_en(centres_en_m)
    boxes = [each.sheet.bounds_deg for each in members]
    found = np.array([np.count_nonzero(in_box(box, lat, lon)) for box in boxes], np.float64)
    return found / found.sum() if found.any() else np.full(len(found), 1 / len(found))
