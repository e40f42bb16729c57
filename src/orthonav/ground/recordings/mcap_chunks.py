"""Chunks of an MCAP file that may be incomplete, damaged, or malicious.

The mcap library trusts the lengths that records state, and ends at the first damaged one. So the
chunks are read here: every length is checked against a limit and the file before anything is
allocated, and damaged chunks are skipped. The format: https://mcap.dev/spec.
"""

import io
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from orthonav.core.errors import FlightError
from orthonav.core.flight.logged import MAX_CHUNK_BYTES
from orthonav.core.guard import needed

MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 1, 2, 3, 4, 5, 6, 15
_RECORD_BYTES, _MESSAGE_BYTES = 9, 22
MAX_TOPIC_BYTES = 1000
WHAT = "flight logs"


@dataclass(frozen=True)
class MessageSpan:
    """A message in a chunk: its topic, its sequence number, and first and last byte of its data."""

    topic: str
    number: int
    first: int
    last: int


@dataclass(frozen=True)
class Chunk:
    """A complete chunk: its offset in the file and its content, uncompressed."""

    offset: int
    data: bytes


@dataclass
class Walk:
    """Progress through a file, and its damage."""

    next_offset: int = len(MAGIC)
    """Offset of the first record that was not read yet; reading a growing file continues there."""
    lost_bytes: int = 0
    """Bytes after the last complete record."""
    damaged: int = 0
    """Damaged chunks."""
    ended: bool = False
    """Whether the file has a proper end."""


def profile_of(path: Path) -> str | None:
    """The profile in the header of an MCAP file; None for another file."""
    with path.open("rb") as stream:
        head = stream.read(64)
    at = len(MAGIC)
    if not head.startswith(MAGIC) or head[at : at + 1] != bytes([_HEADER]):
        return None
    at += _RECORD_BYTES
    length = int.from_bytes(head[at : at + 4], "little")
    profile = head[at + 4 : at + 4 + length]
    return profile.decode("latin-1") if len(profile) == length else None


def chunks(path: Path, walk: Walk) -> Iterator[Chunk]:
    """The complete chunks of a file, from `walk.next_offset`; updates `walk`."""
    with path.open("rb") as stream:
        size = stream.seek(0, io.SEEK_END)
        at = walk.next_offset
        while at + _RECORD_BYTES <= size:
            stream.seek(at)
            head = stream.read(_RECORD_BYTES)
            opcode, length = head[0], int.from_bytes(head[1:], "little")
            if opcode in (_DATA_END, _FOOTER):
                walk.ended = True
                return
            if opcode == 0 or length > size - at - _RECORD_BYTES:
                break
            walk.next_offset = at + _RECORD_BYTES + length
            if opcode == _CHUNK:
                data = _inflated(stream, length)
                if data is None:
                    walk.damaged += 1
                else:
                    yield Chunk(at, data)
            at = walk.next_offset
        walk.lost_bytes = max(0, size - at)


def complete_bytes(path: Path) -> int:
    """Bytes of a file up to the end of its last complete record of data."""
    with path.open("rb") as stream:
        size = stream.seek(0, io.SEEK_END)
        at = len(MAGIC)
        while at + _RECORD_BYTES <= size:
            stream.seek(at)
            head = stream.read(_RECORD_BYTES)
            length = int.from_bytes(head[1:], "little")
            ended = head[0] in (0, _DATA_END, _FOOTER)
            if ended or length > size - at - _RECORD_BYTES:
                break
            at += _RECORD_BYTES + length
    return min(at, size)


def partial_records(path: Path, offset: int) -> bytes:
    """The complete records in a chunk at `offset` that was cut off, uncompressed; else nothing."""
    with path.open("rb") as stream:
        stream.seek(offset)
        head = stream.read(_RECORD_BYTES)
        if head[:1] != bytes([_CHUNK]):
            return b""
        body = stream.read(MAX_CHUNK_BYTES)
    named = 32 + int.from_bytes(body[28:32], "little")
    plain = _begun(body[32:named], body[named + 8 :])
    at = 0
    while at + _RECORD_BYTES <= len(plain) and plain[at] in (_SCHEMA, _CHANNEL, _MESSAGE):
        last = at + _RECORD_BYTES + int.from_bytes(plain[at + 1 : at + _RECORD_BYTES], "little")
        if last > len(plain):
            break
        at = last
    return plain[:at]


def _begun(kind: bytes, data: bytes) -> bytes:
    """As much of the compressed `data` as is there."""
    try:
        if kind == b"lz4":
            decompressor = needed("lz4.frame", WHAT).LZ4FrameDecompressor()
            return bytes(decompressor.decompress(data, max_length=MAX_CHUNK_BYTES))
        if kind == b"zstd":
            zstandard = needed("zstandard", WHAT)
            decompressor = zstandard.ZstdDecompressor(max_window_size=2 * MAX_CHUNK_BYTES)
            return bytes(decompressor.stream_reader(data).read(MAX_CHUNK_BYTES))
    except Exception:  # of either library, about damaged data
        return b""
    return data if kind == b"" else b""


def chunk_at(path: Path, offset: int) -> bytes | None:
    """Content of the chunk at `offset`, None where it is damaged."""
    with path.open("rb") as stream:
        stream.seek(offset)
        head = stream.read(_RECORD_BYTES)
        if len(head) < _RECORD_BYTES or head[0] != _CHUNK:
            return None
        return _inflated(stream, int.from_bytes(head[1:], "little"))


@dataclass(frozen=True)
class MessageLocation:
    """Location of a message: file, offset of its chunk, first and last byte in the chunk."""

    path: Path
    offset: int
    first: int
    last: int


class LastChunk:
    """Data of messages by location; caches the chunk of the last one. For one thread."""

    def __init__(self) -> None:
        self._held: tuple[Path, int] | None = None
        self._data = b""

    def message(self, place: MessageLocation, where: str) -> bytes:
        """The data at a location, empty where the chunk is damaged.

        Raises `FlightError` with `where` for a file that cannot be read.
        """
        if self._held != (place.path, place.offset):
            try:
                data = chunk_at(place.path, place.offset)
            except OSError as error:
                raise FlightError(
                    f"flight log cannot be read ({error.strerror}): {where}"
                ) from error
            self._held, self._data = (place.path, place.offset), data or b""
        return self._data[place.first : place.last]


def messages(chunk: Chunk, channels: dict[int, str]) -> Iterator[MessageSpan]:
    """The messages of a chunk; its channels are added to `channels`, id to topic."""
    data, at = chunk.data, 0
    while at + _RECORD_BYTES <= len(data):
        opcode = data[at]
        first = at + _RECORD_BYTES
        last = first + int.from_bytes(data[at + 1 : first], "little")
        if last > len(data) or opcode not in (_SCHEMA, _CHANNEL, _MESSAGE):
            return
        if opcode == _CHANNEL and last - first >= 8:
            named = first + 8 + int.from_bytes(data[first + 4 : first + 8], "little")
            if named <= min(last, first + 8 + MAX_TOPIC_BYTES):
                topic = data[first + 8 : named].decode("utf-8", "replace")
                channels[int.from_bytes(data[first : first + 2], "little")] = topic
        elif opcode == _MESSAGE and last - first >= _MESSAGE_BYTES:
            topic = channels.get(int.from_bytes(data[first : first + 2], "little"), "")
            number = int.from_bytes(data[first + 2 : first + 6], "little")
            yield MessageSpan(topic, number, first + _MESSAGE_BYTES, last)
        at = last


def _inflated(stream: BinaryIO, length: int) -> bytes | None:
    """Content of the chunk record of `length` bytes that follows, None where it is damaged."""
    if not 40 <= length <= MAX_CHUNK_BYTES + 1000:
        return None
    body = stream.read(length)
    size, crc = int.from_bytes(body[16:24], "little"), int.from_bytes(body[24:28], "little")
    named = 32 + int.from_bytes(body[28:32], "little")
    kind, first = body[32:named], named + 8
    last = first + int.from_bytes(body[named:first], "little")
    if named > 64 or last > len(body) or size > MAX_CHUNK_BYTES:
        return None
    data: bytes | None = body[first:last] if kind == b"" else None
    if kind == b"zstd":
        data = _zstd(body[first:last], size)
    if data is None or len(data) != size or (crc and zlib.crc32(data) != crc):
        return None
    return data


def _zstd(data: bytes, size: int) -> bytes | None:
    """`data` uncompressed, if its frame states exactly `size` bytes."""
    zstandard = needed("zstandard", WHAT)
    try:
        frame = zstandard.get_frame_parameters(data)
        if frame.content_size != size or frame.window_size > 2 * MAX_CHUNK_BYTES:
            return None
        plain = zstandard.ZstdDecompressor().decompress(data, max_output_size=max(1, size))
    except zstandard.ZstdError:
        return None
    return bytes(plain)
