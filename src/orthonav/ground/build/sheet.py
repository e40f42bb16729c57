"""Reading a sheet: from blocks of imagery to cell means, crops and the registration layer.

Blocks are read, represented and compressed by several threads, each with its own datasets; results
are collected in the order of the blocks, so the map is the same for any number of threads. The
result of a block is a dictionary of arrays, which can be cached in a folder: an interrupted build
resumes from it.
"""

import logging
import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray

from orthonav import __version__
from orthonav.core.cores import usable_cores
from orthonav.core.errors import AreaError
from orthonav.core.files import Progress
from orthonav.core.geo.grid import TileGrid
from orthonav.core.tiles import represent
from orthonav.core.tiles.cells import CellLayout, cell_means
from orthonav.core.tiles.whitened import CellSheet
from orthonav.core.variants import variant_recipe
from orthonav.ground.build.block_cache import BlockCache, digest
from orthonav.ground.build.blocks import Block, Preview, blocks_of, margins, read_block
from orthonav.ground.build.calibrate import CropSampler
from orthonav.ground.build.layer import CHUNK_PX, GreyLayerWriter, Parts, compressed_block
from orthonav.ground.build.parallel import in_order
from orthonav.ground.build.pictures import SheetPictures, sheet_maps
from orthonav.ground.imagery.mosaic import Mosaic, SheetRaster
from orthonav.ground.imagery.quiet import quiet
from orthonav.ground.planning.area import Area

log = logging.getLogger(__name__)

BLOCK_PX = 1024
"""Least width of a block: a few MB of memory per thread."""
PREVIEW_PX = 384
"""Limit of the map format (docs/map-format.md)."""
MIN_CACHED_BLOCKS = 16
"""Smaller builds do not cache blocks by default: they are quickly rebuilt."""
CACHED_BYTES_PER_PX = 1.6
"""Disk space per pixel of a cached block; a corridor of the generated landscape at 1 m took 1.3."""


@dataclass(frozen=True)
class Job:
    """A block to be read, and the positions (row, col) of crops in it."""

    block: Block
    places: tuple[tuple[int, int], ...]


class SheetReader:
    """Reads a sheet and collects the input of all later steps.

    `cells`: cell means. `preview`: grey overview. `sampler`: crops for calibration. `layer`: the
    registration layer, None without `registration`. `pictures`: images of all tiles, for methods
    that learn from them, else None.
    """

    def __init__(
        self,
        mosaic: Mosaic,
        area: Area,
        grid: TileGrid,
        representation: Any,
        sampler: CropSampler,
        *,
        registration: bool,
        pictures: SheetPictures | None = None,
    ) -> None:
        self.mosaic, self.area, self.grid = mosaic, area, grid
        self.representation, self.sampler = representation, sampler
        height, width = grid.height_px, grid.width_px
        self._layout = layout = CellLayout.for_tiles(grid.tile_px, grid.stride_px)
        self.cells = CellSheet(layout, height, width, representation.channels)
        self.preview = Preview(grid, PREVIEW_PX)
        self.layer = GreyLayerWriter(height, width) if registration else None
        self.pictures = pictures
        # Cells that begin in a block may end beyond it, within the margin.
        self._beyond_px = layout.micro_px - layout.spacing_px
        self._margin_px = layout.micro_px + representation.margin_px
        self._jobs = self._drawn_jobs()

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return len(self._jobs)

    def read(
        self,
        progress: Progress,
        workers: int | None = None,
        cache: BlockCache | None = None,
    ) -> None:
        """Read all blocks that are not in `cache`, with `workers` threads (None: one per core).

        Raises `AreaError` if no pixel is valid, `ImageryError`, `OutputError`.
        """
        workers = usable_cores() if workers is None else workers
        if not represent.TABLE[self._recipe["name"]].flies:
            workers = 1  # one network in memory, which uses threads itself

        @contextmanager
        def opened() -> Iterator[Callable[[Job], Parts]]:
            with self.mosaic.grid_sheet(self.area.frame, self.grid, threads=1) as raster:
                yield lambda job: self._cached_or_read(raster, job, cache)

        with one_opencv_thread(), quiet():
            for done, parts in enumerate(in_order(self._jobs, opened, workers)):
                self._take(self._jobs[done], parts)
                progress("imagery", (done + 1) / len(self._jobs))
        if not self.cells.valid.any():
            raise AreaError(
                "the area has no imagery: it lies outside the orthophotos or is all nodata"
            )

    def block_cache(
        self, default: Path, folder: Path | None
    ) -> AbstractContextManager[BlockCache | None]:
        """Cache of finished blocks in `folder`, or, if there are many, in `default`; else None.

        Raises `OutputError` if the disk has too little free space.
        """
        pixels = sum(job.block.height * job.block.width for job in self._jobs)
        worthwhile = folder is not None or len(self._jobs) >= MIN_CACHED_BLOCKS
        needed_bytes = round(CACHED_BYTES_PER_PX * pixels) if worthwhile else 0
        cache = BlockCache(folder or default, self._request(), needed_bytes)
        if not worthwhile:
            cache.discard()  # left by an earlier request for the same map
            return nullcontext()
        found = cache.begin(self._depends_on())
        if found:
            log.warning("resuming: %d of %d blocks are cached", found, len(self._jobs))
        return cache

    @property
    def _recipe(self) -> dict[str, Any]:
        return variant_recipe(represent.TABLE, self.representation)

    def _drawn_jobs(self) -> list[Job]:
        blocks = blocks_of_area(self.area, self.grid, self._layout)
        total_px = sum(block.height * block.width for block in blocks)
        jobs = []
        for block in blocks:
            top, left, bottom, right = margins(self.grid, block, self._margin_px)
            size = top + block.height + bottom, left + block.width + right
            places = self.sampler.places(*size, block.height * block.width / total_px)
            jobs.append(Job(block, tuple((int(row), int(col)) for row, col in places)))
        return jobs

    def _cached_or_read(self, raster: SheetRaster, job: Job, cache: BlockCache | None) -> Parts:
        parts = None if cache is None else cache.load(job.block)
        if parts is None:
            parts = self._read_block(raster, job)
            if cache is not None:
                cache.store(job.block, parts)
        return parts

    def _read_block(self, raster: SheetRaster, job: Job) -> Parts:
        """The result of a block; does not change the state of the reader."""
        read = read_block(raster, self.grid, job.block, self._margin_px)
        grey, valid = read.pixels.grey, read.pixels.valid
        if not valid.any():
            return {}
        maps = sheet_maps(self.representation, grey, valid)
        part = read.part(self._beyond_px)
        means, share = cell_means(maps[:, part[0], part[1]], valid[part], self._layout)
        parts: Parts = {"means": means, "share": share, "preview": self.preview.small(read)}
        if self.pictures is not None:
            parts |= self.pictures.parts(read, maps)
        places = np.array(job.places, np.intp).reshape(-1, 2)
        parts["crops"], parts["crop_places"] = self.sampler.cut(grey, valid, places)
        if self.layer is not None:
            part = read.part()
            parts |= layer_parts(self.area, self.grid, job.block, grey[part], valid[part])
        return parts

    def _take(self, job: Job, parts: Parts) -> None:
        if not parts:
            return
        block = job.block
        self.cells.put(block.row, block.col, parts["means"], parts["share"])
        self.preview.put(block, parts["preview"])
        if self.pictures is not None:
            self.pictures.put(block, parts)
        top, left = margins(self.grid, block, self._margin_px)[:2]
        self.sampler.take(parts["crops"], parts["crop_places"], block.row - top, block.col - left)
        if self.layer is not None:
            put_layer_parts(self.layer, block, parts)

    def _request(self) -> str:
        """Digest of the inputs common to all blocks, including program versions."""
        frame = self.area.frame
        return digest(
            {
                "versions": [__version__, np.__version__, cv2.__version__, rasterio.__version__],
                "gdal": rasterio.__gdal_version__,
                "represent": self._recipe,
                "frame": [frame.lat_deg, frame.lon_deg],
                "grid": vars(self.grid),
                "layout": [vars(self._layout), self._margin_px, PREVIEW_PX, CHUNK_PX],
                "crop_px": self.sampler.size_px,
                "layer": self.layer is not None,
                "pictures": self.pictures is not None,
                "imagery": self.mosaic.common_stamp,
            }
        )

    def _depends_on(self) -> list[tuple[Block, Any]]:
        """Inputs of each block alone: its imagery, crops, and distance from the route."""
        found: list[tuple[Block, Any]] = []
        with self.mosaic.grid_sheet(self.area.frame, self.grid) as raster:
            for job in self._jobs:
                block = job.block
                far = [not chunk.may_matter(self.area, self.grid) for chunk in block.cut(CHUNK_PX)]
                top, left, bottom, right = margins(self.grid, block, self._margin_px)
                height, width = top + block.height + bottom, left + block.width + right
                stamps = raster.stamps(block.col - left, block.row - top, width, height)
                found.append((block, [block.height, block.width, job.places, far, stamps]))
        return found


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """OpenCV on one thread, where each of our threads works on a block of its own."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def blocks_of_area(area: Area, grid: TileGrid, layout: CellLayout) -> list[Block]:
    """The blocks of a grid that tiles of an area may need."""
    side_px = _block_side_px(grid.tile_px, layout.micro_px)
    return [block for block in blocks_of(grid, side_px) if block.may_matter(area, grid)]


def layer_parts(
    area: Area, grid: TileGrid, block: Block, grey: NDArray[np.uint8], valid: NDArray[np.bool_]
) -> Parts:
    """The registration layer of a block; compressed if its chunks do not extend into other blocks.

    Chunks too far from the route are omitted.
    """
    grey, valid = grey.copy(), valid.copy()
    for chunk in block.cut(CHUNK_PX):
        if not chunk.may_matter(area, grid):
            where = chunk.within(block)
            grey[where], valid[where] = 0, False
    if _whole_chunks(grid, block):
        return compressed_block(grey, valid)
    return {"grey": grey, "valid": valid}


def _whole_chunks(grid: TileGrid, block: Block) -> bool:
    bottom, right = block.row + block.height, block.col + block.width
    return (
        block.row % CHUNK_PX == 0
        and block.col % CHUNK_PX == 0
        and (bottom % CHUNK_PX == 0 or bottom == grid.height_px)
        and (right % CHUNK_PX == 0 or right == grid.width_px)
    )


def put_layer_parts(layer: GreyLayerWriter, block: Block, parts: Parts) -> None:
    """Insert the result of `layer_parts` for a block into a layer."""
    if "jpeg" in parts:
        layer.add_block(block.row, block.col, parts)
    else:
        layer.add(block.row, block.col, parts["grey"], parts["valid"])


def _block_side_px(tile_px: int, micro_px: int) -> int:
    """Width of a block: a multiple of the micro-cell, and of the layer chunk if possible."""
    least = max(BLOCK_PX, 2 * tile_px)
    step = math.lcm(micro_px, CHUNK_PX)
    if step > 1.5 * least:
        step = micro_px
    return -(-least // step) * step
