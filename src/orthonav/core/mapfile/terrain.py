"""The layers of heights of a map (`docs/map-format.md`): the terrain, and the surface above it.

A chunk is a grey PNG of 16 bits. Untrusted, so its size and parts are checked before it is
decoded."""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthonav.core.errors import MapFileError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.ground import bilinear, by_value
from orthonav.core.mapfile.layer import Chunks, ChunkTable
from orthonav.core.mapfile.manifest import MAX_CODE, TerrainInfo
from orthonav.core.mapfile.reader import MapFile

FEW_CHUNKS, FEW_SAMPLES = 16, 2**18  # that are read as one part, as those under a view
TERRAIN, SURFACE = "terrain", "surface"
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
        self.info = info
        self.frame: LocalFrame = opened.manifest.sheets[sheet].frame
        table = ChunkTable(info.rows, info.cols, 1, info.chunk_px)

        def decode(data: NDArray[np.uint8], shape: tuple[int, int]) -> Heights:
            return decode_terrain(data, shape, info)

        # 400 km2 of terrain every 10 m, 4 km2 of surface every 1 m.
        cached = 2**22 // info.chunk_px**2
        parts = [terrain_part_names(sheet, layer)]
        self._chunk: Chunks[Heights] = Chunks(opened, table, parts, decode, layer, cached)

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
        info = self.info
        firsts, ends = [], []
        for at, count in ((row, info.rows), (col, info.cols)):
            low, high = (min(max(float(end), 0.0), count - 1.0) for end in (at.min(), at.max()))
            if not low <= high:  # not numbers
                return None
            firsts.append(int(low))
            ends.append(min(int(high) + 2, count))
        (top, left), (bottom, right) = firsts, ends
        height, width = bottom - top, right - left
        if height * width > FEW_SAMPLES:
            return None
        chunks = list(self._chunk.table.parts(0, top, left, height, width))
        if len(chunks) > FEW_CHUNKS:
            return None
        part = np.full((height, width), np.nan)
        for place, inside, target in chunks:
            heights = self._chunk(0, *place)
            if heights is not None:
                part[target] = heights[inside]
        return part, top, left

    def _samples(self, rows: NDArray[np.intp], cols: NDArray[np.intp]) -> Array:
        side = self.info.chunk_px
        chunk_rows, chunk_cols = rows // side, cols // side
        found = np.full(rows.shape, np.nan)
        across = int(chunk_cols.max(initial=0)) + 1
        for key, here in by_value((chunk_rows * across + chunk_cols).ravel()):
            heights = self._chunk(0, *divmod(key, across))
            if heights is not None:
                row, col = (each.ravel()[here] % side for each in (rows, cols))
                found.ravel()[here] = heights[row, col]
        return found


def decode_terrain(data: NDArray[np.uint8], shape: tuple[int, int], info: TerrainInfo) -> Heights:
    """NaN where unknown. Raises `MapFileError`."""
    rows, cols = shape
    if data.size > 4 * rows * cols + 1024:
        raise MapFileError(f"{data.size} bytes for {rows} x {cols} samples")
    png = data.tobytes()
    if not png.startswith(_png_head(rows, cols)):
        raise MapFileError(f"a grey PNG of 16 bits, {rows} x {cols} px, was expected")
    if not _is_plain_png(png):
        raise MapFileError("a PNG of IHDR, IDAT and IEND only was expected")
    try:
        values = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise MapFileError(f"PNG cannot be decoded ({error.err})") from error
    if values is None or values.shape != shape or values.dtype != np.uint16:
        raise MapFileError("PNG cannot be decoded")
    heights = info.low_m + info.unit_m * (values.astype(np.float64) - 1)
    if (heights > info.high_m + info.unit_m).any():
        raise MapFileError(f"it has heights above {info.high_m:g} m")
    found = np.where(values > 0, heights, np.nan).astype(np.float32)
    found.flags.writeable = False
    return found


def encode_terrain(heights: Heights, info: TerrainInfo) -> bytes:
    """Of a chunk (H, W), NaN where unknown; empty where all are."""
    known = np.isfinite(heights)
    if not known.any():
        return b""
    steps = (np.where(known, heights, info.low_m).astype(np.float64) - info.low_m) / info.unit_m
    codes = np.rint(steps).clip(0, MAX_CODE).astype(np.uint16)
    values = np.where(known, codes + 1, 0).astype(np.uint16)
    return cv2.imencode(".png", values, [int(cv2.IMWRITE_PNG_COMPRESSION), 9])[1].tobytes()


def _png_head(rows: int, cols: int) -> bytes:
    """The first bytes of a grey PNG of 16 bits, not interlaced."""
    size = cols.to_bytes(4, "big") + rows.to_bytes(4, "big")
    return b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + size + b"\x10\0\0\0\0"


def _is_plain_png(png: bytes) -> bool:
    """True if IHDR, IDAT and IEND fill it: text and profiles could inflate to any size."""
    kinds, at = [], 8
    while at + 12 <= len(png):
        kinds.append(png[at + 4 : at + 8])
        at += 12 + int.from_bytes(png[at : at + 4], "big")
    return (
        at == len(png)
        and (kinds[0], kinds[-1]) == (b"IHDR", b"IEND")
        and set(kinds[1:-1]) == {b"IDAT"}
    )
