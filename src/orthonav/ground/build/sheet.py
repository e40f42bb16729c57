"""Reading a sheet: from blocks of imagery to cell means, crops and the registration layer.

Several threads read blocks; results are collected in the order of the blocks, so the map is the
same for any number of threads.
"""

import contextlib
import functools
import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.cores import in_order, usable_cores
from orthonav.core.errors import AreaError, VariantError
from orthonav.core.files import Progress, no_progress
from orthonav.core.geo.grid import TileGrid
from orthonav.core.mapfile.layer import MAX_PREVIEW_PX
from orthonav.core.mapfile.manifest import SheetInfo
from orthonav.core.tiles import represent
from orthonav.core.tiles.cells import MICRO, CellLayout, cell_means
from orthonav.core.tiles.embed import ViewEmbedder
from orthonav.core.tiles.represent import Gray
from orthonav.core.tiles.whitened import CellSheet
from orthonav.core.variants import variant_recipe
from orthonav.ground.build.calibrate import Crop, CropSampler
from orthonav.ground.build.layer import (
    CHUNK_PX,
    GreyLayerWriter,
    HeightLayers,
    Parts,
    rounded_gsd_m,
)
from orthonav.ground.imagery.mosaic import Mosaic, Pixels
from orthonav.ground.imagery.source import quiet
from orthonav.ground.planning.area import Area
from orthonav.research.tiles import SheetTiles


@dataclass(frozen=True)
class Block:
    row: int
    col: int
    height: int
    width: int

    @property
    def window(self) -> tuple[int, int, int, int]:
        return self.col, self.row, self.width, self.height

    def may_matter(self, area: Area, grid: TileGrid) -> bool:
        """Whether a tile of the area may need the block; False only far from a route."""
        if area.route is None:
            return True
        east_m = grid.west_m + (self.col + self.width / 2) * grid.gsd_m
        north_m = grid.north_m - (self.row + self.height / 2) * grid.gsd_m
        reach_px = np.hypot(self.height, self.width) / 2 + grid.tile_px + grid.stride_px
        return bool(area.contains(np.array([[east_m, north_m]]), reach_px * grid.gsd_m)[0])

    def within(self, other: "Block", beyond_px: int = 0) -> tuple[slice, slice]:
        """Rows and columns in the pixels of another block, with more to the south and east."""
        row, col = self.row - other.row, self.col - other.col
        return slice(row, row + self.height + beyond_px), slice(col, col + self.width + beyond_px)

    def cut(self, side_px: int) -> Iterator["Block"]:
        """Parts, divided at multiples of `side_px` of the raster."""
        bottom, right = self.row + self.height, self.col + self.width
        for row in range(self.row // side_px * side_px, bottom, side_px):
            for col in range(self.col // side_px * side_px, right, side_px):
                top, left = max(row, self.row), max(col, self.col)
                height, width = min(row + side_px, bottom) - top, min(col + side_px, right) - left
                yield Block(top, left, height, width)

    def with_margin(self, grid: TileGrid, margin_px: int) -> "Block":
        """The block with `margin_px` on each side, less at the raster border."""
        top, left = max(0, self.row - margin_px), max(0, self.col - margin_px)
        bottom = min(grid.height_px, self.row + self.height + margin_px)
        right = min(grid.width_px, self.col + self.width + margin_px)
        return Block(top, left, bottom - top, right - left)


def blocks_of(area: Area, grid: TileGrid, side_px: int) -> list[Block]:
    """Blocks of at most `side_px` that tiles of an area may need."""
    whole = Block(0, 0, grid.height_px, grid.width_px)
    return [block for block in whole.cut(side_px) if block.may_matter(area, grid)]


class Preview:
    """The picture of a sheet that the map carries, as small as its format allows."""

    def __init__(self, grid: TileGrid) -> None:
        self._scale = min(1.0, MAX_PREVIEW_PX / max(grid.width_px, grid.height_px))
        height, width = grid.height_px * self._scale, grid.width_px * self._scale
        self._grey = np.zeros((max(1, round(height)), max(1, round(width))), np.uint8)

    def put(self, block: Block, grey: NDArray[np.uint8]) -> None:
        """A block in any resolution; nothing of it is shown if it is smaller than a pixel."""
        rows, cols = self._grey.shape
        y0, y1 = (round(edge * self._scale) for edge in (block.row, block.row + block.height))
        x0, x1 = (round(edge * self._scale) for edge in (block.col, block.col + block.width))
        y1, x1 = min(y1, rows), min(x1, cols)
        if y1 > y0 and x1 > x0:
            size = x1 - x0, y1 - y0
            self._grey[y0:y1, x0:x1] = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)

    def jpeg(self) -> NDArray[np.uint8]:
        encoded = cv2.imencode(".jpg", self._grey, [int(cv2.IMWRITE_JPEG_QUALITY), 70])[1]
        return np.asarray(encoded, dtype=np.uint8).reshape(-1)


log = logging.getLogger(__name__)

MIN_TILE_VALID_SHARE = 0.5
"""No view can match most tiles with less imagery."""


def grid_of(
    area: Area, imagery_gsd_m: float, gsd_m: float | None, tile_px: int, overlap: float
) -> TileGrid:
    """The tile grid of an area; `gsd_m` None uses the resolution of the imagery."""
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


def _whole_cells(tile_px: int, overlap: float) -> float:
    """So that tiles share all their cells; else memory grows with the square of stride to cell."""
    micro_px = max(1, tile_px // MICRO)
    stride_px = tile_px * (1 - overlap)
    if not micro_px <= stride_px <= tile_px:
        return overlap
    return 1 - round(stride_px / micro_px) * micro_px / tile_px


def tiles_of(area: Area, grid: TileGrid, cells: CellSheet) -> NDArray[np.intp]:
    """Grid rows and columns (N, 2) of the tiles in the area that have imagery."""
    reach_m = grid.stride_m * np.sqrt(0.5)
    step = max(1, 2**17 // grid.cols)
    found = []
    for first in range(0, grid.rows, step):  # a few rows at a time: the box may be mostly empty
        rows, cols = np.mgrid[first : min(first + step, grid.rows), : grid.cols]
        some = np.stack([rows.ravel(), cols.ravel()], axis=1).astype(np.intp)
        found.append(some[area.contains(grid.centres_en_m(some), reach_m)])
    tiles = np.concatenate(found)
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


def is_per_tile(representation: Any) -> bool:
    return getattr(representation, "per", "sheet") == "tile"


class SheetPictures:
    """Grey levels or edges of a sheet, filled block by block; 1 to 2 bytes per pixel."""

    def __init__(self, grid: TileGrid, representation: Any) -> None:
        if representation.channels != 1:
            raise VariantError(
                "this method needs a representation of one channel; give --edges gray, canny, "
                "segments or sam"
            )
        shape = grid.height_px, grid.width_px
        self.is_grey = isinstance(representation, Gray)
        self._grid, self._representation = grid, representation
        self._scale = 255.0 if self.is_grey else 1.0
        self._pixels = np.zeros((1, *shape), np.uint8)
        self._valid = np.zeros(shape, np.bool_)
        self._grey = None if self.is_grey else np.zeros(shape, np.uint8)

    def put(
        self, block: Block, pixels: Pixels, maps: NDArray[np.float32], part: tuple[slice, slice]
    ) -> None:
        """`pixels` and their representation `maps` (1, H, W), of which the block is a part."""
        where = np.s_[block.row : block.row + block.height, block.col : block.col + block.width]
        self._pixels[0][where] = np.rint(maps[0][part] * self._scale).astype(np.uint8)
        self._valid[where] = pixels.valid[part]
        if self._grey is not None:
            self._grey[where] = pixels.grey[part]

    def tiles(self, tiles_px: NDArray[np.intp], progress: Progress = no_progress) -> SheetTiles:
        """Tiles whose first pixels (row, col) are given (N, 2)."""
        grey, tile_px = self._grey, self._grid.tile_px
        tiles = SheetTiles(self._pixels, self._valid, tiles_px, tile_px, self._scale, grey)
        if not is_per_tile(self._representation):
            return tiles
        singles = np.zeros((len(tiles), 1, tile_px, tile_px), np.uint8)
        for index in range(len(tiles)):
            made = self._representation(tiles.grey_tile(index), tiles.valid_tile(index))
            singles[index] = np.rint(made * self._scale)
            progress("edges of tiles", (index + 1) / len(tiles))
        return replace(tiles, singles=singles)


def sheet_maps(
    representation: Any, grey: NDArray[np.uint8], valid: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Representation (C, H, W); zeros if tiles are represented singly."""
    if is_per_tile(representation):
        return np.zeros((representation.channels, *grey.shape), np.float32)
    return np.asarray(representation(grey, valid), np.float32)


def read_pictures(
    mosaic: Mosaic, area: Area, grid: TileGrid, representation: Any, progress: Progress
) -> SheetPictures:
    pictures = SheetPictures(grid, representation)
    blocks = blocks_of(area, grid, BLOCK_PX)
    with mosaic.grid_sheet(area.frame, grid) as raster:
        for done, block in enumerate(blocks):
            outer = block.with_margin(grid, representation.margin_px)
            pixels = raster.read_grey(*outer.window)
            if pixels.valid.any():
                maps = sheet_maps(representation, pixels.grey, pixels.valid)
                pictures.put(block, pixels, maps, block.within(outer))
            progress("other date", (done + 1) / len(blocks))
    return pictures


BLOCK_PX = 1024
"""Least width: a few MB of memory per thread."""


class GreyRaster(Protocol):
    """Imagery in the pixels of a sheet. Threads may share it."""

    def read_grey(self, col: int, row: int, width_px: int, height_px: int) -> Pixels: ...


@dataclass(frozen=True, eq=False)
class BlockContent:
    """What a thread makes of a block: pixels and representation with its margin, cell means."""

    pixels: Pixels
    maps: NDArray[np.float32] | None  # where pictures are made of them
    means: NDArray[np.float32]
    share: NDArray[np.float32]


class SheetReader:
    """Collects the input of all later steps. `sampler`: takes crops for calibration; `pictures`:
    for methods that learn from them."""

    def __init__(
        self,
        area: Area,
        grid: TileGrid,
        representation: Any,
        sampler: CropSampler | None = None,
        *,
        registration: bool,
        pictures: SheetPictures | None = None,
    ) -> None:
        self.area, self.grid = area, grid
        self.representation, self._sampler = representation, sampler
        height, width = grid.height_px, grid.width_px
        self._layout = layout = CellLayout.for_tiles(grid.tile_px, grid.stride_px)
        self.cells = CellSheet(layout, height, width, representation.channels)
        self.preview = Preview(grid)
        self.layer = GreyLayerWriter(height, width) if registration else None
        self.pictures = pictures
        # Cells that begin in a block may end beyond it, within the margin.
        self._beyond_px = layout.micro_px - layout.spacing_px
        self._margin_px = layout.micro_px + representation.margin_px

    @property
    def crops(self) -> list[Crop]:
        return [] if self._sampler is None else self._sampler.crops

    def read(self, raster: GreyRaster, progress: Progress, workers: int | None = None) -> None:
        """Read all blocks with `workers` threads (None: one per core)."""
        workers = usable_cores() if workers is None else workers
        recipe = variant_recipe(represent.TABLE, self.representation)
        if not represent.TABLE[recipe["name"]].flies:
            workers = 1  # one network in memory, which uses threads itself
        blocks = blocks_of_area(self.area, self.grid, self._layout)
        places = self._places_of_crops(blocks)
        work = functools.partial(self._read_block, raster)
        with (
            one_opencv_thread(),
            quiet(),
            contextlib.closing(in_order(work, blocks, workers)) as made,
        ):
            for done, content in enumerate(made):
                if content is not None:
                    self._take(blocks[done], content, places[done])
                progress("imagery", (done + 1) / len(blocks))
        if not self.cells.valid.any():
            raise AreaError(
                "the area has no imagery: it lies outside the orthophotos or is all nodata"
            )

    def finish(
        self,
        tiles_rc: NDArray[np.intp],
        embedder: ViewEmbedder,
        embeddings: NDArray[np.float16],
        heights: HeightLayers,
        relief: str | None,
    ) -> tuple[SheetInfo, Parts]:
        """The record and the arrays of the sheet in a map, with these tiles."""
        grid, (terrain, surface) = self.grid, heights.infos
        arrays: Parts = {
            "sheet0/centres_en_m": grid.centres_en_m(tiles_rc).astype(np.float32),
            "sheet0/embeddings": embeddings,
            "sheet0/preview_jpeg": self.preview.jpeg(),
            **{f"embed/{name}": array for name, array in embedder.parts().items()},
        }
        grey = None
        if self.layer is not None:
            grey, parts = self.layer.finish()
            arrays |= parts
        area_km2 = round(len(tiles_rc) * grid.stride_m**2 / 1e6, 6)
        info = SheetInfo(
            *(self.area.frame, grid, len(tiles_rc), area_km2),
            *(grey, terrain, relief, surface),
            lean=heights.lean,
        )
        return info, arrays | heights.arrays

    def _outer(self, block: Block) -> Block:
        return block.with_margin(self.grid, self._margin_px)

    def _places_of_crops(self, blocks: Sequence[Block]) -> list[NDArray[np.intp]]:
        """First pixels of the crops of each block with its margin."""
        total_px = sum(block.height * block.width for block in blocks)
        found = []
        for block in blocks:
            outer, share = self._outer(block), block.height * block.width / total_px
            drawn = np.zeros((0, 2), np.intp)
            if self._sampler is not None:
                drawn = self._sampler.places(outer.height, outer.width, share)
            found.append(drawn)
        return found

    def _read_block(self, raster: GreyRaster, block: Block) -> BlockContent | None:
        """None where it has no imagery."""
        outer = self._outer(block)
        pixels = raster.read_grey(*outer.window)
        if not pixels.valid.any():
            return None
        maps = sheet_maps(self.representation, pixels.grey, pixels.valid)
        more = block.within(outer, self._beyond_px)
        means, share = cell_means(maps[:, more[0], more[1]], pixels.valid[more], self._layout)
        return BlockContent(pixels, maps if self.pictures else None, means, share)

    def _take(self, block: Block, content: BlockContent, places: NDArray[np.intp]) -> None:
        outer, pixels = self._outer(block), content.pixels
        part = block.within(outer)
        self.cells.put(block.row, block.col, content.means, content.share)
        self.preview.put(block, pixels.grey[part])
        if self._sampler is not None:
            self._sampler.take(pixels.grey, pixels.valid, places, outer.row, outer.col)
        if self.pictures is not None and content.maps is not None:
            self.pictures.put(block, pixels, content.maps, part)
        if self.layer is not None:
            grey, valid = near_route(
                self.area, self.grid, block, pixels.grey[part], pixels.valid[part]
            )
            self.layer.add(block.row, block.col, grey, valid)


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Each of our threads works on a block of its own."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def blocks_of_area(area: Area, grid: TileGrid, layout: CellLayout) -> list[Block]:
    """Their side is a multiple of the micro-cell, and of the layer chunk if possible."""
    least = max(BLOCK_PX, 2 * grid.tile_px)
    step = math.lcm(layout.micro_px, CHUNK_PX)
    if step > 1.5 * least:
        step = layout.micro_px
    return blocks_of(area, grid, -(-least // step) * step)


def near_route(
    area: Area, grid: TileGrid, block: Block, grey: NDArray[np.uint8], valid: NDArray[np.bool_]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Copies of a block (H, W) without the chunks that are too far from the route."""
    grey, valid = grey.copy(), valid.copy()
    for chunk in block.cut(CHUNK_PX):
        if not chunk.may_matter(area, grid):
            where = chunk.within(block)
            grey[where], valid[where] = 0, False
    return grey, valid
