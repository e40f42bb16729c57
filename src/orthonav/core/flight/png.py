"""Images of a flight log, written and read: grey PNG, lossless."""

import struct
import zlib

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError

_MAGIC = b"\x89PNG\r\n\x1a\n"
_HEADER_BYTES = 33  # magic and IHDR


def lossless_png(grey: NDArray[np.uint8]) -> bytes:
    """`grey` (H, W) uint8 as a PNG with row differences, not compressed.

    The log compresses its chunks, which suffices for differences: PNG's own compression would take
    ten times as long to save a few per cent. Raises `ValueError` for another array.
    """
    if grey.ndim != 2 or grey.dtype != np.uint8 or not grey.size:
        raise ValueError(f"expected grey levels (H, W) uint8, got {grey.dtype} {grey.shape}")
    height, width = grey.shape
    rows = np.empty((height, width + 1), dtype=np.uint8)
    rows[:, 0] = 2  # filter "up"
    rows[0, 1:] = grey[0]
    np.subtract(grey[1:], grey[:-1], out=rows[1:, 1:])  # modulo 256, as PNG defines it
    chunks = (
        (b"IHDR", _shape(width, height)),
        (b"IDAT", zlib.compress(rows.data, 0)),
        (b"IEND", b""),
    )
    return _MAGIC + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )


def grey_of_png(data: bytes, width_px: int, height_px: int, where: str) -> NDArray[np.uint8]:
    """Grey levels (H, W) uint8 of a PNG of this size; `where` is its location, for errors.

    The declared size is checked before anything is allocated. Raises `FlightError`.
    """
    expected = b"\0\0\0\rIHDR" + _shape(width_px, height_px)
    head = data[len(_MAGIC) : len(_MAGIC) + len(expected)]
    if not data.startswith(_MAGIC) or head != expected:
        raise FlightError(f"expected a grey PNG of {width_px} x {height_px} px: {where}")
    if data[_HEADER_BYTES + 4 : _HEADER_BYTES + 8] != b"IDAT":  # no profiles, no texts
        raise FlightError(f"image is not a PNG of a flight log: {where}")
    try:
        grey = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), int(cv2.IMREAD_GRAYSCALE))
    except cv2.error:
        grey = None
    if grey is None or grey.shape != (height_px, width_px) or grey.dtype != np.uint8:
        raise FlightError(f"image cannot be decoded: {where}")
    return np.asarray(grey, dtype=np.uint8)


def _shape(width_px: int, height_px: int) -> bytes:
    return struct.pack(">IIBBBBB", width_px, height_px, 8, 0, 0, 0, 0)
