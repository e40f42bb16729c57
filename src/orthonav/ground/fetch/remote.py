"""Files on servers as GDAL reads them: by byte ranges, through the client.

rasterio hands every read of GDAL to this module (its `opener`), so the rate, size limits,
repetition and keys of all other requests hold here too, and GDAL opens no connection. GDAL's own
/vsicurl would send keys along redirects, and checks neither the range of an answer nor whether the
file changes meanwhile.
"""

import io
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rasterio
from rasterio.errors import RasterioError

from orthonav.core.caches import ByteCache
from orthonav.core.errors import FetchError
from orthonav.ground.fetch.client import Client
from orthonav.ground.fetch.urls import shown

SMALL, CHUNK = 8 * 1024, 128 * 1024
"""Reads up to the first size are rounded to the second: one request holds most heads."""
MAX_RANGE = 64 * 2**20
"""Largest read. A block of a tiled file has at most a few megabytes."""
GDAL_OPTIONS = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_CACHEMAX": 64 * 2**20,
}
CACHE_BYTES = 64 * 2**20
"""Ranges held in memory for all files: cells next to each other share blocks."""
RangeCache = ByteCache[tuple[str, int, int], bytes]
"""Bytes by address and range."""


class RemoteFile:
    """The file at `url`, of `size` bytes; several threads may read it.

    Raises `FetchError` where the server does not answer ranges or the file changes meanwhile.
    """

    def __init__(self, client: Client, url: str, cache: RangeCache | None = None) -> None:
        self.url = url
        self.size = 0
        self._version = ""
        self._client = client
        self._cache = cache or RangeCache(CACHE_BYTES, len)
        self._lock = threading.Lock()
        self._fetch(0, CHUNK)

    @property
    def identity(self) -> str:
        """Changes when the file does: its size and the version that the server names."""
        return f"{self.size} {self._version}"

    def read(self, start: int, length: int) -> bytes:
        """Bytes from `start`, fewer at the end of the file; small reads by whole chunks."""
        end = min(start + length, self.size)
        if start >= end:
            return b""
        if length > SMALL:
            return self._fetch(start, end)
        first = start // CHUNK * CHUNK
        chunks = (self._fetch(at, at + CHUNK) for at in range(first, end, CHUNK))
        return b"".join(chunks)[start - first : end - first]

    @contextmanager
    def opened(self, level: int | None = None) -> Iterator[Any]:
        """The file, or its overview `level`, as an open dataset.

        Raises what went wrong on the network, else `FetchError` for what GDAL cannot read.
        """
        failures: list[Exception] = []
        options = {} if level is None else {"overview_level": level}
        try:
            with (
                rasterio.Env(**GDAL_OPTIONS),
                rasterio.open(
                    f"{id(self)}.tif",
                    driver="GTiff",
                    opener=lambda path, mode="rb": _Stream(self, failures),
                    **options,
                ) as dataset,
            ):
                yield dataset
        except RasterioError as error:
            if not failures:
                reason = " ".join(str(error.__cause__ or error).split())
                raise self.unreadable(reason[:200]) from None
        if failures:
            raise failures[0]

    def _fetch(self, start: int, end: int) -> bytes:
        if end - start > MAX_RANGE:
            raise self.unreadable("blocks too large to be read by windows")
        key = (self.url, start, end)
        data = self._cache.get(key)
        if data is None:
            data, size, version = self._client.get_range(self.url, start, end)
            with self._lock:
                if self.size and (size, version) != (self.size, self._version):
                    raise FetchError(
                        f"file changed on the server while it was read: {shown(self.url)}"
                    )
                self.size, self._version = size, version
            self._cache.put(key, data)
        return data

    def unreadable(self, reason: str) -> FetchError:
        """The error for a file that GDAL cannot read."""
        return FetchError(f"not a GeoTIFF that can be read ({reason}): {shown(self.url)}")


class _Stream(io.RawIOBase):
    """A position in a remote file. An exception must not pass through GDAL, so it is stored."""

    def __init__(self, file: RemoteFile, failures: list[Exception]) -> None:
        super().__init__()
        self._file, self._failures = file, failures
        self._at = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._file.size}[whence]
        self._at = base + offset
        return self._at

    def tell(self) -> int:
        return self._at

    def read(self, size: int = -1) -> bytes:
        try:
            data = self._file.read(self._at, self._file.size if size < 0 else size)
        except Exception as error:
            self._failures.append(error)
            return b""
        self._at += len(data)
        return data
