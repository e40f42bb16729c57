"""Where the blocks of a TIFF lie in the file, read from its head with tifffile."""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import FetchError
from orthonav.extras import needed
from orthonav.fetch.remote import Range, RemoteFile
from orthonav.fetch.urls import shown

MAX_PAGES = 64
MAX_BLOCKS = 20_000_000
MAX_BLOCK_BYTES = 64 * 2**20
_BESIDE = 4
"""GDAL writes the size of a block before it and its last bytes after it."""
_MASK = 4


@dataclass(frozen=True, eq=False)
class Page:
    """One picture of a file: the full one, an overview, or the mask of either.

    `offsets` and `sizes` (planes, block rows, block columns) are bytes in the file.
    """

    width_px: int
    height_px: int
    block_w_px: int
    block_h_px: int
    mask: bool
    offsets: NDArray[np.int64]
    sizes: NDArray[np.int64]

    def ranges(self, row0: int, col0: int, row1: int, col1: int) -> list[Range]:
        """Bytes of the blocks that hold pixels of these rows and columns (ends not included)."""
        rows = slice(row0 // self.block_h_px, -(-row1 // self.block_h_px))
        cols = slice(col0 // self.block_w_px, -(-col1 // self.block_w_px))
        starts = self.offsets[:, rows, cols].ravel()
        sizes = self.sizes[:, rows, cols].ravel()
        return [
            (int(start) - _BESIDE, int(start + size) + _BESIDE)
            for start, size in zip(starts, sizes, strict=True)
            if size > 0
        ]


def read_layout(remote: RemoteFile) -> list[Page]:
    """All pages of a file. Raises `FetchError` where it is no TIFF that can be read by blocks."""
    tifffile = needed("tifffile", "fetch", "reading files on servers")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reader: Any = remote.reader()
            with tifffile.TiffFile(reader, name="remote") as found:
                pages: list[Page] = []
                for page in found.pages:
                    if len(pages) >= MAX_PAGES:
                        raise FetchError(f"file has too many pages: {shown(remote.url)}")
                    _touch(page)
                    pages.append(_page(page, remote))
                return pages
    except FetchError:
        raise
    except Exception as error:  # tifffile lets struct.error, IndexError and more through
        raise FetchError(
            f"not a GeoTIFF that can be read ({type(error).__name__}): {shown(remote.url)}"
        ) from None


def _touch(page: Any) -> None:
    """Read every tag, so that all that GDAL will look for is in the copy."""
    for tag in page.tags:
        _ = tag.value


def _page(page: Any, remote: RemoteFile) -> Page:
    width, height = int(page.imagewidth), int(page.imagelength)
    tiled = bool(page.is_tiled)
    block_w = int(page.tilewidth) if tiled else width
    block_h = int(page.tilelength) if tiled else min(int(page.rowsperstrip), height)
    if min(width, height, block_w, block_h) <= 0:
        raise FetchError(f"file has a page without pixels: {shown(remote.url)}")
    rows, cols = -(-height // block_h), -(-width // block_w)
    planes = int(page.samplesperpixel) if int(page.planarconfig) == 2 else 1
    shape = (planes, rows, cols)
    count = planes * rows * cols
    if count > MAX_BLOCKS or len(page.dataoffsets) != count != len(page.databytecounts):
        raise FetchError(f"file's list of blocks is broken or too long: {shown(remote.url)}")
    offsets = np.array(page.dataoffsets, dtype=np.int64).reshape(shape)
    sizes = np.array(page.databytecounts, dtype=np.int64).reshape(shape)
    beyond = sizes.max() > MAX_BLOCK_BYTES or (offsets + sizes).max() > remote.size
    if offsets.min() < 0 or sizes.min() < 0 or beyond:
        raise FetchError(
            f"not a GeoTIFF that can be read (blocks beyond its end, or too large to be read by "
            f"windows): {shown(remote.url)}"
        )
    return Page(width, height, block_w, block_h, bool(page.subfiletype & _MASK), offsets, sizes)
