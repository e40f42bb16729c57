"""The registration layer of a map (`docs/map-format.md`): a grey pyramid, read by windows.

Only the chunks (JPEG and mask) that a window touches are decoded. Maps are untrusted files, so
every length, size and offset is checked before it is used."""

import zlib
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MapFileError
from orthonav.core.mapfile.manifest import GreyInfo
from orthonav.core.mapfile.reader import Blobs, MapFile

CACHE_BYTES = 64 * 2**20  # grey and mask of 33 km2 at 1 m
MAX_PREVIEW_PX = 384

Content = TypeVar("Content")
Window = tuple[slice, slice]  # rows and columns
Chunk = tuple[NDArray[np.uint8], NDArray[np.bool_] | None]
"""Grey (H, W), 0 where not valid, and valid (H, W) or None where all is; read-only."""


def part_names(sheet: int) -> dict[str, str]:
    """Of a sheet, by kind of content."""
    kinds = ("bytes", "offsets", "mask_bytes", "mask_offsets")
    return {kind: f"sheet{sheet}/grey/{kind}" for kind in kinds}


def level_shape(height_px: int, width_px: int, level: int) -> tuple[int, int]:
    return -(-height_px >> level), -(-width_px >> level)


class ChunkTable:
    """Chunks of the levels of a sheet, numbered level by level and row by row."""

    def __init__(self, height_px: int, width_px: int, levels: int, chunk_px: int) -> None:
        self.chunk_px = chunk_px
        self.shapes = [level_shape(height_px, width_px, level) for level in range(levels)]
        self._cols = [-(-cols // chunk_px) for _, cols in self.shapes]
        self._first = [0]
        for (rows, _), across in zip(self.shapes, self._cols, strict=True):
            self._first.append(self._first[-1] + -(-rows // chunk_px) * across)

    @property
    def count(self) -> int:
        return self._first[-1]

    def number(self, level: int, chunk_row: int, chunk_col: int) -> int:
        return self._first[level] + chunk_row * self._cols[level] + chunk_col

    def shape(self, level: int, chunk_row: int, chunk_col: int) -> tuple[int, int]:
        """Less than `chunk_px` at the end of the level."""
        rows, cols = self.shapes[level]
        side = self.chunk_px
        return min(side, rows - chunk_row * side), min(side, cols - chunk_col * side)

    def parts(
        self, level: int, row: int, col: int, height: int, width: int
    ) -> Iterator[tuple[tuple[int, int], Window, Window]]:
        """Row and column of each chunk that a window of a level touches, what is in the window in
        pixels of the chunk, and in those of the window. The window may reach beyond the level."""
        side, (rows, cols) = self.chunk_px, self.shapes[level]
        for (top, bottom), (left, right) in product(
            _cuts(row, row + height, rows, side), _cuts(col, col + width, cols, side)
        ):
            y, x = top % side, left % side
            inside = slice(y, y + bottom - top), slice(x, x + right - left)
            target = slice(top - row, bottom - row), slice(left - col, right - col)
            yield (top // side, left // side), inside, target


def _cuts(first: int, last: int, size: int, side: int) -> list[tuple[int, int]]:
    """[first, last) within [0, size), divided at multiples of `side`."""
    first, last = max(first, 0), min(last, size)
    edges = [first, *range((first // side + 1) * side, last, side), last]
    return list(pairwise(edges)) if first < last else []


class Chunks(Generic[Content]):
    """Chunks of a layer, decoded when they are read; the last `cached` stay decoded.

    `parts`: names of bytes and offsets of each part that a chunk has. `decode` takes the bytes of
    these and the shape, and raises `MapFileError`."""

    def __init__(
        self,
        opened: MapFile,
        table: ChunkTable,
        parts: Sequence[tuple[str, str]],
        decode: Callable[..., Content],
        layer: str,
        cached: int,
    ) -> None:
        self.table = table
        self.blobs = [Blobs(opened, *names, table.count) for names in parts]
        read = partial(_read_chunk, self.blobs, table, decode, layer, opened.path)
        self._read = lru_cache(cached)(read)

    def __call__(self, level: int, chunk_row: int, chunk_col: int) -> Content | None:
        """None where nothing is stored. Raises `MapFileError` for a damaged one."""
        number = self.table.number(level, chunk_row, chunk_col)
        if all(each.is_empty(number) for each in self.blobs):
            return None
        found: Content = self._read(level, chunk_row, chunk_col)
        return found


def _read_chunk(
    blobs: Sequence[Blobs],
    table: ChunkTable,
    decode: Callable[..., Any],
    layer: str,
    path: Path,
    *place: int,
) -> Any:
    number = table.number(*place)
    data = [each.blob(number) for each in blobs]
    try:
        return decode(*data, table.shape(*place))
    except MapFileError as error:
        where = f"level {place[0]}, chunk {place[1]}, {place[2]}"
        raise MapFileError(f"map's {layer} layer is damaged ({where}: {error}): {path}") from error


class GreyLayer:
    """Grey pyramid of one sheet; threads may share it.

    Pixel (0, 0) of level 0 lies at the north-west corner of the sheet's grid; a pixel of level L
    covers 2**L x 2**L of level 0."""

    def __init__(
        self, opened: MapFile, sheet: int, info: GreyInfo, cache_bytes: int = CACHE_BYTES
    ) -> None:
        grid = opened.manifest.sheets[sheet].grid
        self.levels = info.levels
        self._table = ChunkTable(grid.height_px, grid.width_px, info.levels, info.chunk_px)
        names = part_names(sheet)
        parts = [(names[f"{kind}bytes"], names[f"{kind}offsets"]) for kind in ("", "mask_")]
        cached = cache_bytes // (2 * info.chunk_px**2)
        self._chunk: Chunks[Chunk] = Chunks(
            opened, self._table, parts, decode_chunk, "registration", cached
        )

    @classmethod
    def of(
        cls, opened: MapFile, sheet: int = 0, *, cache_bytes: int = CACHE_BYTES
    ) -> "GreyLayer | None":
        """None if the map has none. Raises `MapFileError` if it is damaged."""
        sheets = opened.manifest.sheets
        if not 0 <= sheet < len(sheets):
            raise MapFileError(f"map has {len(sheets)} sheets, not sheet {sheet}: {opened.path}")
        info = sheets[sheet].grey
        return None if info is None else cls(opened, sheet, info, cache_bytes)

    def shape(self, level: int) -> tuple[int, int]:
        if not 0 <= level < self.levels:
            raise IndexError(f"level must be 0 to {self.levels - 1}, got {level}")
        return self._table.shapes[level]

    def read(
        self, level: int, row: int, col: int, height: int, width: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Grey and valid of a window, also beyond the sheet: 0 and not valid, as without imagery.

        Raises `MapFileError` if a chunk is damaged."""
        self.shape(level)  # raises `IndexError`
        if height < 0 or width < 0:
            raise ValueError(f"window must have 0 or more rows and columns, got {height} x {width}")
        grey = np.zeros((height, width), dtype=np.uint8)
        valid = np.zeros((height, width), dtype=bool)
        for place, inside, target in self._table.parts(level, row, col, height, width):
            chunk = self._chunk(level, *place)
            if chunk is not None:
                grey[target] = chunk[0][inside]
                valid[target] = True if chunk[1] is None else chunk[1][inside]
        return grey, valid

    def jpeg(self, level: int, chunk_row: int, chunk_col: int) -> bytes | None:
        """The JPEG of a chunk, checked; None unless all of it is valid. Raises `IndexError`."""
        rows, cols = self.shape(level)
        side = self._table.chunk_px
        if not (0 <= chunk_row * side < rows and 0 <= chunk_col * side < cols):
            raise IndexError(f"level {level} has no chunk {chunk_row}, {chunk_col}")
        chunk = self._chunk(level, chunk_row, chunk_col)
        if chunk is None or chunk[1] is not None:
            return None
        number = self._table.number(level, chunk_row, chunk_col)
        return self._chunk.blobs[0].blob(number).tobytes()


def decode_chunk(jpeg: NDArray[np.uint8], mask: NDArray[np.uint8], shape: tuple[int, int]) -> Chunk:
    """From the bytes of JPEG and mask (empty if all is valid); raises `MapFileError`."""
    grey = _decode_grey(jpeg, shape)
    valid = _decode_mask(mask, shape) if mask.size else None
    if valid is not None:
        grey[~valid] = 0
        valid.flags.writeable = False
    grey.flags.writeable = False
    return grey, valid


def _decode_grey(jpeg: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.uint8]:
    height, width = shape
    if jpeg.size > 4 * height * width + 4096:
        raise MapFileError(f"{jpeg.size} bytes for {height} x {width} px")
    found = jpeg_frame(jpeg.tobytes())
    if found != (8, height, width, 1):
        got = (
            "something else" if found is None else "{} bits, {} x {} px, {} channels".format(*found)
        )
        raise MapFileError(f"a grey JPEG of {height} x {width} px was expected, got {got}")
    try:
        grey = cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise MapFileError(f"JPEG cannot be decoded ({error.err})") from error
    if grey is None or grey.shape != shape or grey.dtype != np.uint8:
        raise MapFileError("JPEG cannot be decoded")
    return np.asarray(grey, dtype=np.uint8)


def jpeg_frame(data: bytes) -> tuple[int, int, int, int] | None:
    """Bits, rows, columns and channels of a baseline JPEG, whose decoding takes one pass; None for
    other data, and for segments other than APP0 and tables of quantization and Huffman codes."""
    if not (data.startswith(b"\xff\xd8") and data.endswith(b"\xff\xd9")):
        return None
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if marker == 0xC0 and at + 10 <= len(data):
            rows, cols = (int.from_bytes(data[at + k : at + k + 2], "big") for k in (5, 7))
            return data[at + 4], rows, cols, data[at + 9]
        if marker not in (0xE0, 0xDB, 0xC4) or length < 2:
            return None
        at += 2 + length
    return None


def preview(opened: MapFile) -> NDArray[np.uint8]:
    """The grey preview (rows, cols) of the first sheet. Raises `MapFileError`."""
    data = opened.array("sheet0/preview_jpeg", np.uint8, 1)
    found = jpeg_frame(data.tobytes())
    small = found is not None and max(found[1:3]) <= MAX_PREVIEW_PX
    grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if small else None
    if grey is None:
        raise MapFileError(f"map's preview cannot be decoded: {opened.path}")
    return np.asarray(grey, dtype=np.uint8)


def _decode_mask(mask: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.bool_]:
    size = shape[0] * shape[1]
    expected = -(-size // 8)
    stream = zlib.decompressobj()
    try:
        packed = stream.decompress(mask.tobytes(), expected + 1)
    except zlib.error as error:
        raise MapFileError(f"mask cannot be decompressed ({error})") from error
    if len(packed) != expected or not stream.eof or stream.unused_data:
        raise MapFileError(f"mask must have {expected} bytes")
    bits = np.unpackbits(np.frombuffer(packed, dtype=np.uint8), count=size)
    return bits.reshape(shape).astype(np.bool_)
