"""Block-wise reading of a sheet, so that memory does not depend on the orthophotos."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.grid import TileGrid
from orthonav.ground.imagery.mosaic import GreyPixels, SheetRaster
from orthonav.ground.planning.area import Area


@dataclass(frozen=True)
class Block:
    """A rectangle of a sheet's raster, in pixels."""

    row: int
    col: int
    height: int
    width: int

    def may_matter(self, area: Area, grid: TileGrid) -> bool:
        """Whether a tile of the area may need the block; False only far from a route."""
        if area.route is None:
            return True
        east_m = grid.west_m + (self.col + self.width / 2) * grid.gsd_m
        north_m = grid.north_m - (self.row + self.height / 2) * grid.gsd_m
        reach_px = np.hypot(self.height, self.width) / 2 + grid.tile_px + grid.stride_px
        return bool(area.contains(np.array([[east_m, north_m]]), reach_px * grid.gsd_m)[0])

    def within(self, other: "Block") -> tuple[slice, slice]:
        """Rows and columns of the block in the pixels of another block that contains it."""
        row, col = self.row - other.row, self.col - other.col
        return slice(row, row + self.height), slice(col, col + self.width)

    def cut(self, side_px: int) -> Iterator["Block"]:
        """Parts of the block, divided at multiples of `side_px` of the raster."""
        bottom, right = self.row + self.height, self.col + self.width
        for row in range(self.row // side_px * side_px, bottom, side_px):
            for col in range(self.col // side_px * side_px, right, side_px):
                top, left = max(row, self.row), max(col, self.col)
                height, width = min(row + side_px, bottom) - top, min(col + side_px, right) - left
                yield Block(top, left, height, width)


@dataclass(frozen=True, eq=False)
class BlockPixels:
    """Pixels of a block with a margin; the block begins at row `top`, column `left`."""

    block: Block
    pixels: GreyPixels
    top: int
    left: int

    def part(self, beyond_px: int = 0) -> tuple[slice, slice]:
        """Rows and columns of the block in the pixels, with `beyond_px` more to south and east."""
        return (
            slice(self.top, self.top + self.block.height + beyond_px),
            slice(self.left, self.left + self.block.width + beyond_px),
        )


def blocks_of(grid: TileGrid, side_px: int) -> Iterator[Block]:
    """Blocks of at most `side_px` that fill the raster of a grid."""
    for row in range(0, grid.height_px, side_px):
        for col in range(0, grid.width_px, side_px):
            height, width = min(side_px, grid.height_px - row), min(side_px, grid.width_px - col)
            yield Block(row, col, height, width)


def margins(grid: TileGrid, block: Block, margin_px: int) -> tuple[int, int, int, int]:
    """Top, left, bottom, right margin of a block: `margin_px`, less at the raster border."""
    return (
        min(margin_px, block.row),
        min(margin_px, block.col),
        min(margin_px, grid.height_px - block.row - block.height),
        min(margin_px, grid.width_px - block.col - block.width),
    )


def read_block(raster: SheetRaster, grid: TileGrid, block: Block, margin_px: int) -> BlockPixels:
    """Read a block with `margins` around it."""
    top, left, bottom, right = margins(grid, block, margin_px)
    width, height = left + block.width + right, top + block.height + bottom
    pixels = raster.read_grey(block.col - left, block.row - top, width, height)
    return BlockPixels(block, pixels, top, left)


class Preview:
    """A grey overview of a sheet, at most `across_px` wide or high, filled block by block."""

    def __init__(self, grid: TileGrid, across_px: int) -> None:
        self._scale = min(1.0, across_px / max(grid.width_px, grid.height_px))
        height, width = grid.height_px * self._scale, grid.width_px * self._scale
        self._grey = np.zeros((max(1, round(height)), max(1, round(width))), np.uint8)

    def small(self, read: BlockPixels) -> NDArray[np.uint8]:
        """The overview of a block: (h, w), empty if it is smaller than a pixel."""
        return self.small_of(read.block, read.pixels.grey[read.part()])

    def small_of(self, block: Block, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The same from an image of the block at its resolution or a coarser one."""
        y0, y1, x0, x1 = self._edges(block)
        if y1 <= y0 or x1 <= x0:
            return np.zeros((0, 0), np.uint8)
        small = cv2.resize(grey, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)
        return np.asarray(small, dtype=np.uint8)

    def put(self, block: Block, small: NDArray[np.uint8]) -> None:
        """Insert the result of `small` for a block."""
        if small.size:
            y0, y1, x0, x1 = self._edges(block)
            self._grey[y0:y1, x0:x1] = small

    def _edges(self, block: Block) -> tuple[int, int, int, int]:
        """Top, bottom, left, right of a block in the overview."""
        rows, cols = self._grey.shape
        y0, y1 = (round(edge * self._scale) for edge in (block.row, block.row + block.height))
        x0, x1 = (round(edge * self._scale) for edge in (block.col, block.col + block.width))
        return y0, min(y1, rows), x0, min(x1, cols)

    def jpeg(self) -> NDArray[np.uint8]:
        """The overview as bytes of a JPEG."""
        encoded = cv2.imencode(".jpg", self._grey, [int(cv2.IMWRITE_JPEG_QUALITY), 70])[1]
        return np.asarray(encoded, dtype=np.uint8).reshape(-1)
