"""The layers of heights of a map (`docs/map-format.md`): the terrain, and the surface above it.

Untrusted, so every length is checked."""

import zlib
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthonav.core.errors import MapFileError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.ground import bilinear
from orthonav.core.mapfile.layer import ChunkTable
from orthonav.core.mapfile.manifest import MAX_CODE, TerrainInfo
from orthonav.core.mapfile.reader import Blobs, ByteCache, MapFile

CACHE_BYTES = 16 * 2**20  # 400 km2 of terrain every 10 m, 4 km2 of surface every 1 m
FEW_CHUNKS, FEW_SAMPLES = 16, 2**18  # that are read as one part, as those under a view
TERRAIN, SURFACE = "terrain", "surface"
_MAX_BYTES_PER_SAMPLE = 4
_CHUNK_HEADER_BYTES = 1024
Array = NDArray[np.float64]
Heights = NDArray[np.float32]


def terrain_part_names(sheet: int, layer: str = TERRAIN) -> tuple[str, str]:
    return f"sheet{sheet}/{layer}/bytes", f"sheet{sheet}/{layer}/offsets"


class TerrainLayer:
    """Heights of one sheet, NaN where unknown: of its ground above mean sea level, or of its
    surface above that. Threads may share it.

    Calling it with latitudes and longitudes makes it `orthonav.core.geo.ground.TerrainHeights`."""

    def __init__(
        self, opened: MapFile, sheet: int, info: TerrainInfo, layer: str = TERRAIN
    ) -> None:
        self.info, self._layer = info, layer
        self.frame: LocalFrame = opened.manifest.sheets[sheet].frame
        self._path = opened.path
        self._table = ChunkTable(info.rows, info.cols, 1, info.chunk_px)
        self._blobs = Blobs(opened, *terrain_part_names(sheet, layer), self._table.count)
        self._cache = ByteCache[int, Heights](CACHE_BYTES, _bytes_of)

    @classmethod
    def of(cls, opened: MapFile, sheet: int = 0, layer: str = TERRAIN) -> "TerrainLayer | None":
        """`TERRAIN` or `SURFACE`; None if the map has none. Raises `MapFileError`."""
        info: TerrainInfo | None = getattr(opened.manifest.sheets[sheet], layer)
        return None if info is None else cls(opened, sheet, info, layer)

    def __call__(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> Array:
        return self.at_en_m(self.frame.en_from_latlon(lat_deg, lon_deg))

    def at_en_m(self, points_en_m: ArrayLike) -> Array:
        """Bilinear (...) at (..., 2); NaN outside and beside samples without a height.

        Raises `MapFileError` if a chunk is damaged, `MapChangedError`."""
        info, points = self.info, np.asarray(points_en_m, np.float64)
        col = (points[..., 0] - info.west_m) / info.posting_m - 0.5
        row = (info.north_m - points[..., 1]) / info.posting_m - 0.5
        part = self._part(col, row) if col.size else None
        if part is None:
            return bilinear(self._samples, (info.rows, info.cols), col, row)
        heights, top, left = part
        return bilinear(
            lambda rows, cols: heights[rows - top, cols - left], (info.rows, info.cols), col, row
        )

    def _part(self, col: Array, row: Array) -> tuple[Array, int, int] | None:
        """Samples around places, the first row and column of these; None where they are many."""
        info, side = self.info, self.info.chunk_px
        firsts, ends = [], []
        for at, count in ((row, info.rows), (col, info.cols)):
            low, high = (min(max(float(end), 0.0), count - 1.0) for end in (at.min(), at.max()))
            if not low <= high:  # not numbers
                return None
            firsts.append(int(low))
            ends.append(min(int(high) + 2, count))
        (top, left), (bottom, right) = firsts, ends
        chunk_rows, chunk_cols = (
            range(first // side, (end - 1) // side + 1)
            for first, end in zip(firsts, ends, strict=True)
        )
        samples, chunks = (bottom - top) * (right - left), len(chunk_rows) * len(chunk_cols)
        if samples > FEW_SAMPLES or chunks > FEW_CHUNKS:
            return None
        part = np.full((bottom - top, right - left), np.nan)
        for chunk_row, chunk_col in product(chunk_rows, chunk_cols):
            heights = self._chunk(chunk_row, chunk_col)
            if heights is not None:
                row_0, col_0 = chunk_row * side, chunk_col * side
                here = heights[max(top - row_0, 0) :, max(left - col_0, 0) :]
                into = part[max(row_0 - top, 0) :, max(col_0 - left, 0) :]
                rows, cols = (min(sides) for sides in zip(here.shape, into.shape, strict=True))
                into[:rows, :cols] = here[:rows, :cols]
        return part, top, left

    def _samples(self, rows: NDArray[np.intp], cols: NDArray[np.intp]) -> Array:
        side = self.info.chunk_px
        chunk_rows, chunk_cols = rows // side, cols // side
        found = np.full(rows.shape, np.nan)
        across = int(chunk_cols.max(initial=0)) + 1
        keys = (chunk_rows * across + chunk_cols).ravel()
        order = np.argsort(keys, kind="stable")
        ends = np.append(np.flatnonzero(np.diff(keys[order])) + 1, len(order))
        for here in np.split(order, ends[:-1]) if len(order) else []:
            chunk_row, chunk_col = divmod(int(keys[here[0]]), across)
            heights = self._chunk(chunk_row, chunk_col)
            if heights is not None:
                row, col = (each.ravel()[here] % side for each in (rows, cols))
                found.ravel()[here] = heights[row, col]
        return found

    def _chunk(self, chunk_row: int, chunk_col: int) -> Heights | None:
        """From the cache or decoded; None if it has no height."""
        number = self._table.number(0, chunk_row, chunk_col)
        if self._blobs.is_empty(number):
            return None
        found = self._cache.get(number)
        if found is None:
            shape = self._table.shape(0, chunk_row, chunk_col)
            try:
                found = decode_terrain(self._blobs.blob(number), shape, self.info)
            except MapFileError as error:
                raise MapFileError(
                    f"map's {self._layer} layer is damaged (chunk {chunk_row}, {chunk_col}: "
                    f"{error}): {self._path}"
                ) from error
            self._cache.put(number, found)
        return found


def decode_terrain(data: NDArray[np.uint8], shape: tuple[int, int], info: TerrainInfo) -> Heights:
    """NaN where unknown. Raises `MapFileError`."""
    size = shape[0] * shape[1]
    if data.size > _MAX_BYTES_PER_SAMPLE * size + _CHUNK_HEADER_BYTES:
        raise MapFileError(f"{data.size} bytes for {shape[0]} x {shape[1]} samples")
    whole, masked = 2 * size, 2 * size + -(-size // 8)
    stream = zlib.decompressobj()
    try:
        plain = stream.decompress(data.tobytes(), masked + 1)
    except zlib.error as error:
        raise MapFileError(f"it cannot be decompressed ({error})") from error
    if len(plain) not in (whole, masked) or not stream.eof or stream.unused_data:
        raise MapFileError(f"it must have {whole} or {masked} bytes")
    planes = np.frombuffer(plain, np.uint8)
    folded = planes[:size].astype(np.uint16) | planes[size:whole].astype(np.uint16) << 8
    steps = (folded >> 1) ^ -(folded & 1)
    codes = np.cumsum(steps.reshape(shape), axis=0, dtype=np.uint16)
    codes = np.cumsum(codes, axis=1, dtype=np.uint16)
    known = np.ones(shape, np.bool_)
    if len(plain) == masked:
        bits = np.unpackbits(planes[whole:], count=size)
        known = bits.reshape(shape).astype(np.bool_)
    heights = info.low_m + info.unit_m * codes.astype(np.float64)
    if (heights[known] > info.high_m + info.unit_m).any():
        raise MapFileError(f"it has heights above {info.high_m:g} m")
    found = np.where(known, heights, np.nan).astype(np.float32)
    found.flags.writeable = False
    return found


def encode_terrain(heights: Heights, info: TerrainInfo) -> bytes:
    """Of a chunk (H, W), NaN where unknown; empty where all are."""
    known = np.isfinite(heights)
    if not known.any():
        return b""
    filled = np.where(known, heights, heights[known].mean()).astype(np.float64)
    codes = np.rint((filled - info.low_m) / info.unit_m).clip(0, MAX_CODE).astype(np.uint16)
    down = np.diff(codes, axis=0, prepend=np.uint16(0))
    steps = np.diff(down, axis=1, prepend=np.uint16(0))
    folded = (steps << 1) ^ (0 - (steps >> 15)).astype(np.uint16)
    planes = [(folded & 255).astype(np.uint8), (folded >> 8).astype(np.uint8)]
    plain = b"".join(plane.tobytes() for plane in planes)
    if not known.all():
        plain += np.packbits(known).tobytes()
    return zlib.compress(plain, 9)


def _bytes_of(heights: Heights) -> int:
    return heights.nbytes
