"""Reading a sheet: blocks of imagery in, what the map is made of out.

Blocks are read, represented and compressed by several threads, each with its own datasets; what
comes of them is taken in their order, so the map is the same for any number of threads. What comes
of a block is a dictionary of arrays, which can be kept in a folder: a build that was killed goes on
from there.
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

from orthonav import __version__, represent
from orthonav.cores import usable_cores
from orthonav.embed.cells import CellLayout, cell_means
from orthonav.embed.whitened import CellSheet
from orthonav.errors import AreaError
from orthonav.geo.area import Area
from orthonav.geo.grid import TileGrid
from orthonav.imagery.mosaic import Mosaic, SheetRaster
from orthonav.imagery.quiet import quiet
from orthonav.prepare.blocks import Block, Preview, blocks_of, margins, read_block
from orthonav.prepare.calibrate import CropSampler
from orthonav.prepare.kept import BlockCache, digest
from orthonav.prepare.layer import CHUNK_PX, GreyLayerWriter, Parts, compressed_block
from orthonav.prepare.parallel import in_order
from orthonav.prepare.pictures import SheetPictures
from orthonav.variants import variant_recipe

log = logging.getLogger(__name__)

BLOCK_PX = 1024
PREVIEW_PX = 384
MIN_KEPT_BLOCKS = 16
"""Finished blocks are kept beside the map where there are so many: fewer are soon made anew."""
KEPT_BYTES_PER_PX = 1.6
"""Disk for a pixel of a kept block; a corridor of the generated landscape at 1 m took 1.3."""
MAX_WORKERS = 64


@dataclass(frozen=True)
class Job:
    """A block to be read, and the places (row, col) in it where crops are to be cut."""

    block: Block
    places: tuple[tuple[int, int], ...]


class SheetReader:
    """Collects what a map needs of a sheet: `cells`, `preview`, crops, `layer`, `pictures`.

    `layer` is None without `registration`; `pictures` is given for methods that learn from them.
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
        """How many blocks there are."""
        return len(self._jobs)

    def read(
        self,
        report: Callable[[str, float], None],
        workers: int | None = None,
        kept: BlockCache | None = None,
    ) -> None:
        """Read all blocks with so many threads (None: all cores), less those that were kept.

        Raises `AreaError` where no pixel is valid, `ImageryError`, `OutputError`.
        """
        workers = usable_cores() if workers is None else workers
        if not represent.TABLE[self._recipe["name"]].flies:
            workers = 1  # one network in memory, which has threads of its own

        @contextmanager
        def opened() -> Iterator[Callable[[Job], Parts]]:
            with self.mosaic.grid_sheet(self.area.frame, self.grid, threads=1) as raster:
                yield lambda job: self._kept_or_made(raster, job, kept)

        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        try:
            with quiet():
                for done, parts in enumerate(in_order(self._jobs, opened, workers)):
                    self._take(self._jobs[done], parts)
                    report("imagery", (done + 1) / len(self._jobs))
        finally:
            cv2.setNumThreads(threads)
        if not self.cells.valid.any():
            raise AreaError(
                "the area has no imagery: it lies outside the orthophotos or is all nodata"
            )

    def kept(self, beside: Path, folder: Path | None) -> AbstractContextManager[BlockCache | None]:
        """Where finished blocks are kept: in `folder` if there is one, else, if many, `beside`.

        Raises `OutputError` where there is no room for them.
        """
        pixels = sum(job.block.height * job.block.width for job in self._jobs)
        worthwhile = folder is not None or len(self._jobs) >= MIN_KEPT_BLOCKS
        needed_bytes = round(KEPT_BYTES_PER_PX * pixels) if worthwhile else 0
        kept = BlockCache(folder or beside, self._request(), needed_bytes)
        if not worthwhile:
            kept.discard()  # what an earlier request for the same map has left
            return nullcontext()
        there = kept.begin(self._depends_on())
        if there:
            log.warning("%d of %d blocks were finished before and are used", there, len(self._jobs))
        return kept

    @property
    def _recipe(self) -> dict[str, Any]:
        return variant_recipe(represent.TABLE, self.representation)

    def _drawn_jobs(self) -> list[Job]:
        side_px = block_side_px(self.grid.tile_px, self._layout.micro_px)
        blocks = [
            block
            for block in blocks_of(self.grid, side_px)
            if block.may_matter(self.area, self.grid)
        ]
        total_px = sum(block.height * block.width for block in blocks)
        jobs = []
        for block in blocks:
            top, left, bottom, right = margins(self.grid, block, self._margin_px)
            size = top + block.height + bottom, left + block.width + right
            places = self.sampler.places(*size, block.height * block.width / total_px)
            jobs.append(Job(block, tuple((int(row), int(col)) for row, col in places)))
        return jobs

    def _kept_or_made(self, raster: SheetRaster, job: Job, kept: BlockCache | None) -> Parts:
        parts = None if kept is None else kept.load(job.block)
        if parts is None:
            parts = self._made(raster, job)
            if kept is not None:
                kept.keep(job.block, parts)
        return parts

    def _made(self, raster: SheetRaster, job: Job) -> Parts:
        """Everything that is kept of a block; nothing that was made before is touched."""
        read = read_block(raster, self.grid, job.block, self._margin_px)
        grey, valid = read.pixels.grey, read.pixels.valid
        if not valid.any():
            return {}
        maps = self.representation(grey, valid)
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
        """Digest of what every block depends on, the programs that make it included."""
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
        """What each block alone depends on: imagery under it, crops, distance from the route."""
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


def layer_parts(
    area: Area, grid: TileGrid, block: Block, grey: NDArray[np.uint8], valid: NDArray[np.bool_]
) -> Parts:
    """What the layer needs of a block: compressed where chunks do not go on in other blocks.

    Chunks that are too far from the route are left out.
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
    """Hand what `layer_parts` made of a block to a layer."""
    if "jpeg" in parts:
        layer.add_block(block.row, block.col, parts)
    else:
        layer.add(block.row, block.col, parts["grey"], parts["valid"])


def block_side_px(tile_px: int, micro_px: int) -> int:
    """Width of a block: whole micro-cells, and whole chunks of the layer where those fit."""
    least = max(BLOCK_PX, 2 * tile_px)
    step = math.lcm(micro_px, CHUNK_PX)
    if step > 1.5 * least:
        step = micro_px
    return -(-least // step) * step
