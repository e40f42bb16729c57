"""A file on a server, read by ranges: only the bytes that are asked for are fetched.

They are put at their place in a sparse file on this machine, which GDAL then reads like any other:
so limits, pauses and keys are those of every other request, and GDAL opens no connection.
"""

import io
import os
import re
import threading
from pathlib import Path

from orthonav.fetch.client import BadReplyError, Client, Reply, told

CHUNK = 128 * 1024
GAP = 32 * 1024
"""Bytes that are fetched in vain rather than asked around."""
MAX_REQUEST = 8 * 2**20
_RANGE = re.compile(r"bytes (\d+)-(\d+)/(\d+)")
Range = tuple[int, int]


class RemoteFile:
    """The file at `url`, of `size` bytes; what was read of it lies in `copy`. For many threads.

    Raises `FetchError` where the server does not answer ranges or the file changes meanwhile.
    """

    def __init__(self, client: Client, url: str, copy: Path) -> None:
        self.url = url
        self.copy = copy
        self.size = 0
        self._version = ""
        self._client = client
        self._lock = threading.Lock()
        self._done: set[Range] = set()
        self._chunks: dict[int, bytes] = {}
        with copy.open("xb"):
            pass
        self._chunk(0)
        os.truncate(copy, self.size)

    @property
    def identity(self) -> str:
        """What changes when the file does: its size and what the server calls its version."""
        return f"{self.size} {self._version}"

    def read(self, start: int, length: int) -> bytes:
        """Bytes from `start`, fewer at the end of the file: for its head, which is kept."""
        end = min(start + length, self.size)
        if start >= end:
            return b""
        first, last = start // CHUNK, (end - 1) // CHUNK
        joined = b"".join(self._chunk(number) for number in range(first, last + 1))
        return joined[start - first * CHUNK : end - first * CHUNK]

    def require(self, ranges: list[Range]) -> None:
        """Have these bytes (first, end) in the copy; neighbours come together."""
        with self._lock:
            missing = [one for one in ranges if one not in self._done]
        for start, end in merged(missing, self.size):
            self._store(start, self._fetch(start, end))
        with self._lock:
            self._done.update(missing)

    def reader(self) -> "io.RawIOBase":
        """A file object over the head of the file."""
        return _Reader(self)

    def _chunk(self, number: int) -> bytes:
        with self._lock:
            known = self._chunks.get(number)
        if known is None:
            known = self._fetch(number * CHUNK, (number + 1) * CHUNK)
            self._store(number * CHUNK, known)
            with self._lock:
                self._chunks[number] = known
        return known

    def _store(self, start: int, data: bytes) -> None:
        with self.copy.open("r+b") as stream:
            stream.seek(start)
            stream.write(data)

    def _fetch(self, start: int, end: int) -> bytes:
        """Bytes `start` to `end` (not included), fewer at the end of the file."""

        def judged(reply: Reply) -> bytes:
            if reply.status != 206:
                raise BadReplyError(
                    f"HTTP {reply.status} ({told(reply)})", again=reply.status >= 500
                )
            found = _RANGE.fullmatch(reply.headers.get("content-range", "").strip())
            if not found:
                raise BadReplyError("range without its place")
            first, last, size = (int(number) for number in found.groups())
            version = reply.headers.get("etag") or reply.headers.get("last-modified", "")
            with self._lock:
                if self.size and (size, version) != (self.size, self._version):
                    raise BadReplyError("file changed on the server while it was read", again=False)
                self.size, self._version = size, version
            expected = min(end, size) - start
            if first != start or last + 1 - first != expected or len(reply.body) != expected:
                raise BadReplyError("another range than was asked for")
            return reply.body

        headers = {"Range": f"bytes={start}-{end - 1}", "Accept-Encoding": "identity"}
        return self._client.get(self.url, judged, headers=headers, max_bytes=end - start + 4096)


class _Reader(io.RawIOBase):
    """One place in the head of a remote file."""

    def __init__(self, file: RemoteFile) -> None:
        super().__init__()
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
        data = self._file.read(self._at, self._file.size if size < 0 else size)
        self._at += len(data)
        return data


def merged(ranges: list[Range], size: int) -> list[Range]:
    """Ranges joined where little lies between them, none longer than a request may be."""
    joined: list[Range] = []
    for start, end in sorted((max(0, start), min(end, size)) for start, end in ranges):
        if start >= end:
            continue
        if joined and start - joined[-1][1] <= GAP and end - joined[-1][0] <= MAX_REQUEST:
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((start, end))
    return joined
