"""The representation of a whole sheet in bytes, from which encoders of images learn."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import VariantError
from orthonav.core.files import Progress, no_progress
from orthonav.core.geo.grid import TileGrid
from orthonav.core.tiles.gray import Gray
from orthonav.ground.build.blocks import Block, BlockPixels, blocks_of, read_block
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area
from orthonav.research.tiles import SheetTiles

BLOCK_PX = 1024


def is_per_tile(representation: Any) -> bool:
    """Whether every tile is represented by itself, not cut out of the sheet's representation."""
    return getattr(representation, "per", "sheet") == "tile"


class SheetPictures:
    """Grey levels or edges of a sheet, filled block by block; 1 to 2 bytes per pixel.

    Raises `VariantError` for representations of several channels, which encoders cannot use.
    """

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

    def parts(self, read: BlockPixels, maps: NDArray[np.float32]) -> dict[str, NDArray[Any]]:
        """The pixels of a block; `maps` (1, H, W) is its representation with the margin."""
        part = read.part()
        parts: dict[str, NDArray[Any]] = {
            "pixels": np.rint(maps[0][part] * self._scale).astype(np.uint8),
            "pixels_valid": read.pixels.valid[part],
        }
        if self._grey is not None:
            parts["pixels_grey"] = read.pixels.grey[part]
        return parts

    def put(self, block: Block, parts: dict[str, NDArray[Any]]) -> None:
        """Insert the `parts` of a block."""
        where = np.s_[block.row : block.row + block.height, block.col : block.col + block.width]
        self._pixels[0][where] = parts["pixels"]
        self._valid[where] = parts["pixels_valid"]
        if self._grey is not None:
            self._grey[where] = parts["pixels_grey"]

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
    """Representation (C, H, W) of a part of a sheet; zeros if tiles are represented singly."""
    if is_per_tile(representation):
        return np.zeros((representation.channels, *grey.shape), np.float32)
    return np.asarray(representation(grey, valid), np.float32)


def read_pictures(
    mosaic: Mosaic,
    area: Area,
    grid: TileGrid,
    representation: Any,
    progress: Progress,
) -> SheetPictures:
    """Images of the tiles of a sheet at another date."""
    pictures = SheetPictures(grid, representation)
    blocks = [block for block in blocks_of(grid, BLOCK_PX) if block.may_matter(area, grid)]
    with mosaic.grid_sheet(area.frame, grid) as raster:
        for done, block in enumerate(blocks):
            read = read_block(raster, grid, block, representation.margin_px)
            if read.pixels.valid.any():
                maps = sheet_maps(representation, read.pixels.grey, read.pixels.valid)
                pictures.put(block, pictures.parts(read, maps))
            progress("other date", (done + 1) / len(blocks))
    return pictures
