"""Files on servers as GDAL reads them: by byte ranges, through the client.

rasterio hands every read of GDAL to this module (its `opener`), so the rate, size limits,
repetition and keys of all other requests hold here too, and GDAL opens no connection. GDAL's own
/vsicurl would send keys along redirects, and checks neither the range of an answer nor whether the
file changes meanwhile.
"""

import io
import threading
from typing import Any

from rasterio.abc import MultiByteRangeResourceContainer

from orthonav.caches import ByteCache
from orthonav.errors import FetchError
from orthonav.fetch.client import Client
from orthonav.fetch.urls import shown

CHUNK = 128 * 1024
"""Small reads (the head of a file) are rounded to this: one request holds most heads."""
MAX_RANGE = 64 * 2**20
"""Largest read. A block of a tiled file has at most a few megabytes."""
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
        if length > CHUNK:
            return self._fetch(start, end)
        first = start // CHUNK * CHUNK
        chunks = (self._fetch(at, at + CHUNK) for at in range(first, end, CHUNK))
        return b"".join(chunks)[start - first : end - first]

    def read_exactly(self, start: int, length: int) -> bytes:
        """These bytes and no others. Raises `FetchError` where they lie beyond the end."""
        if start + length > self.size:
            raise self.unreadable("blocks beyond its end")
        return self._fetch(start, start + length)

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


class _Failure(threading.local):
    value: Exception | None = None


class RemoteFiles(MultiByteRangeResourceContainer):  # type: ignore[misc]
    """Remote files by name, as an `opener` for rasterio; no other name can be opened.

    An exception must not pass through GDAL. `failure.value` holds the first one of each thread
    since it was reset to None, and `raise_failure` raises it once GDAL has returned.
    """

    def __init__(self) -> None:
        self.files: dict[str, RemoteFile] = {}
        self.failure = _Failure()

    def open(self, path: str, mode: str = "r", **kwds: Any) -> "_Stream":
        """The file of that name, to be read."""
        return _Stream(self, self.files[path])

    def isfile(self, path: str) -> bool:
        """Whether there is such a file."""
        return path in self.files

    def isdir(self, path: str) -> bool:
        """There are no folders."""
        return False

    def ls(self, path: str) -> list[str]:
        """No names: GDAL finds no files belonging to the one that is open."""
        return []

    def mtime(self, path: str) -> int:
        """Not known."""
        return 0

    def rm(self, path: str) -> None:
        """Nothing is removed."""

    def size(self, path: str) -> int:
        """Bytes of a file."""
        return self.files[path].size

    def raise_failure(self) -> None:
        """Raise the exception stored in this thread, if any."""
        if self.failure.value is not None:
            raise self.failure.value


class _Stream(io.RawIOBase):
    """A position in a remote file."""

    def __init__(self, files: RemoteFiles, file: RemoteFile) -> None:
        super().__init__()
        self._files = files
        self._file = file
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
            self._files.failure.value = self._files.failure.value or error
            return b""
        self._at += len(data)
        return data

    def get_byte_ranges(self, offsets: list[int], sizes: list[int]) -> list[bytes]:
        """Several ranges at once, as GDAL asks for the blocks of a window."""
        try:
            return [
                self._file.read_exactly(int(offset), int(size))
                for offset, size in zip(offsets, sizes, strict=True)
            ]
        except Exception as error:
            self._files.failure.value = self._files.failure.value or error
            return [bytes(size) for size in sizes]  # rasterio copies these lengths, checked or not
