"""MCAP files that may be incomplete, damaged or malicious, read chunk by chunk.

The readers of the mcap library trust the lengths inside records, and end at the first damaged one.
Here every length is checked against a limit and the file before anything is allocated, and damaged
chunks are skipped. The format: https://mcap.dev/spec.
"""

import contextlib
import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from orthonav.core.errors import OrthonavError
from orthonav.core.flight.logged import MAX_CHUNK_BYTES
from orthonav.core.guard import needed

MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 1, 2, 3, 4, 5, 6, 15
_RECORD_BYTES, _MESSAGE_BYTES = 9, 22
MAX_TOPIC_BYTES = 1000


@dataclass(frozen=True)
class MessageSpan:
    """A message in a chunk: its topic, its sequence number, and first and last byte of its data."""

    topic: str
    number: int
    first: int
    last: int


@dataclass
class McapFile:
    """A file, how far it was read, and its damage."""

    path: Path
    next_offset: int = len(MAGIC)
    """Offset of the first record that was not read yet; reading a growing file continues there."""
    lost_bytes: int = 0  # bytes after the last complete record
    damaged: int = 0  # damaged chunks
    ended: bool = False  # whether the file has a proper end
    channels: dict[int, str] = field(default_factory=dict)  # topics by id


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


def chunks(file: McapFile) -> Iterator[tuple[int, bytes]]:
    """Offset and content of each complete chunk that was not read yet; updates `file`."""
    with file.path.open("rb") as stream:
        for opcode, at, length in _records(stream, file):
            if opcode == _CHUNK:
                data = _content(stream, length)
                if data is None:
                    file.damaged += 1
                else:
                    yield at, data


def _records(stream: BinaryIO, file: McapFile) -> Iterator[tuple[int, int, int]]:
    """Opcode, offset and length of each complete record of data; `stream` is at its content."""
    size = stream.seek(0, io.SEEK_END)
    at = file.next_offset
    while at + _RECORD_BYTES <= size:
        stream.seek(at)
        opcode, length = struct.unpack("<BQ", stream.read(_RECORD_BYTES))
        if opcode in (_DATA_END, _FOOTER):
            file.ended = True
            return
        if opcode == 0 or length > size - at - _RECORD_BYTES:
            break
        file.next_offset = at + _RECORD_BYTES + length
        yield opcode, at, length
        at = file.next_offset
    file.lost_bytes = max(0, size - at)


def chunk_at(path: Path, offset: int) -> bytes:
    """Content of the chunk at `offset`, empty where it is damaged."""
    with path.open("rb") as stream:
        stream.seek(offset)
        head = stream.read(_RECORD_BYTES)
        if len(head) < _RECORD_BYTES or head[0] != _CHUNK:
            return b""
        return _content(stream, int.from_bytes(head[1:], "little")) or b""


def _content(stream: BinaryIO, length: int) -> bytes | None:
    """Content of the chunk record of `length` bytes that follows, None where it is damaged."""
    if length > MAX_CHUNK_BYTES + 1000:
        return None
    try:
        size, crc, kind, packed = _parts(stream.read(length))
        data = inflated(kind, packed, size + 1) if size <= MAX_CHUNK_BYTES else b""
    except OrthonavError:
        raise
    except Exception:  # of a library, about damaged data
        return None
    return data if len(data) == size and (not crc or zlib.crc32(data) == crc) else None


def _parts(body: bytes) -> tuple[int, int, bytes, bytes]:
    """Size, checksum, compression and compressed content of a chunk, which may be cut off."""
    size, crc, name_bytes = struct.unpack_from("<QII", body, 16)
    named = 32 + name_bytes
    first = named + 8
    last = first + int.from_bytes(body[named:first], "little")
    return size, crc, body[32:named], body[first:last]


def inflated(kind: bytes, data: bytes, most: int) -> bytes:
    """As much of the compressed `data` as is there, at most `most` bytes.

    Raises `ValueError` for an unknown compression, and what the libraries raise.
    """
    if kind == b"lz4":
        decompressor = needed("lz4.frame", "ROS recordings").LZ4FrameDecompressor()
        return bytes(decompressor.decompress(data, max_length=most))
    if kind == b"zstd":
        zstandard = needed("zstandard", "flight logs and ROS recordings")
        decompressor = zstandard.ZstdDecompressor(max_window_size=2 * MAX_CHUNK_BYTES)
        with decompressor.stream_reader(data) as stream:
            return bytes(stream.read(most))
    if kind:
        raise ValueError(f"compression {kind[:20]!r} is not known")
    return data[:most]


def messages(data: bytes, file: McapFile) -> Iterator[MessageSpan]:
    """The messages of a chunk; its channels are added to those of the file."""
    for opcode, first, last in _inner_records(data):
        if opcode == _CHANNEL and last - first >= 8:
            named = first + 8 + int.from_bytes(data[first + 4 : first + 8], "little")
            if named <= min(last, first + 8 + MAX_TOPIC_BYTES):
                topic = data[first + 8 : named].decode("utf-8", "replace")
                file.channels[int.from_bytes(data[first : first + 2], "little")] = topic
        elif opcode == _MESSAGE and last - first >= _MESSAGE_BYTES:
            channel, number = struct.unpack_from("<HI", data, first)
            yield MessageSpan(file.channels.get(channel, ""), number, first + _MESSAGE_BYTES, last)


def _inner_records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, first and last byte of the content of each complete record of a chunk."""
    at = 0
    while at + _RECORD_BYTES <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        first = at + _RECORD_BYTES
        at = first + length
        if at > len(data) or opcode not in (_SCHEMA, _CHANNEL, _MESSAGE):
            return
        yield opcode, first, at


def complete_bytes(path: Path) -> int:
    """Bytes of a file up to the end of its last complete record of data."""
    file = McapFile(path)
    with path.open("rb") as stream:
        for _ in _records(stream, file):
            pass
        return min(file.next_offset, stream.seek(0, io.SEEK_END))


def partial_records(path: Path, offset: int) -> bytes:
    """The complete records in a chunk at `offset` that was cut off, uncompressed; else nothing."""
    plain = b""
    with path.open("rb") as stream, contextlib.suppress(Exception):  # as in `_content`
        stream.seek(offset)
        if stream.read(_RECORD_BYTES)[:1] == bytes([_CHUNK]):
            _, _, kind, packed = _parts(stream.read(MAX_CHUNK_BYTES))
            plain = inflated(kind, packed, MAX_CHUNK_BYTES)
    return plain[: max((last for _, _, last in _inner_records(plain)), default=0)]
