"""MCAP files that may be incomplete, damaged or malicious, read chunk by chunk.

The mcap library trusts the sizes that a file states, and ends at the first damaged record. Here
each size is checked against a limit and the file before the library parses a record, and damaged
chunks are skipped. The format: https://mcap.dev/spec.
"""

import io
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from orthonav.core.errors import OrthonavError
from orthonav.core.flight.logged import MAX_CHUNK_BYTES
from orthonav.core.guard import needed

MAGIC = b"\x89MCAP0\r\n"
WHAT = "flight logs"
_HEAD = struct.Struct("<BQ")  # opcode and length of a record


_FOOTER, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 2, 4, 5, 6, 15  # kinds of records


@dataclass(frozen=True)
class LoggedMessage:
    """A message in a chunk: its topic, its sequence number and its data."""

    topic: str
    number: int
    data: bytes


@dataclass
class McapFile:
    """A file, how far it can be read, and its damage."""

    path: Path
    end: int = len(MAGIC)  # of the last complete record of data
    lost_bytes: int = 0  # bytes after the last complete record
    damaged: int = 0  # damaged chunks
    ended: bool = False  # whether the file has a proper end
    channels: dict[int, str] = field(default_factory=dict)  # topics by id


def name_and_number(path: Path) -> tuple[str, int]:
    """The name of the recording that a file `NAME_NUMBER.*` belongs to, and its number in it; that
    of the file and 0 for others."""
    found = re.fullmatch(r"(.+)_(\d{1,9})", path.stem)
    return (found[1], int(found[2])) if found else (path.name, 0)


def profile_of(path: Path) -> str | None:
    """The profile in the header of an MCAP file; None for another file."""
    with path.open("rb") as stream:
        head = stream.read(64)
    if not head.startswith(MAGIC + b"\x01"):
        return None
    (length,) = struct.unpack("<I", head[17:21].ljust(4, b"\xff"))
    profile = head[21 : 21 + length]
    return profile.decode("latin-1") if len(profile) == length else None


def chunks(file: McapFile) -> Iterator[tuple[int, bytes]]:
    """Offset and content of each complete chunk; updates `file`."""
    with file.path.open("rb") as stream:
        for opcode, at, length in _records(stream, file):
            if opcode == _CHUNK:
                plain = _content(stream, length)
                if plain is None:
                    file.damaged += 1
                else:
                    yield at, plain


def chunk_at(path: Path, offset: int) -> bytes:
    """Content of the chunk at `offset`, empty where it is damaged."""
    with path.open("rb") as stream:
        stream.seek(offset)
        opcode, length = _HEAD.unpack(stream.read(_HEAD.size).ljust(_HEAD.size, b"\0"))
        return (_content(stream, length) if opcode == _CHUNK else None) or b""


def messages(chunk: bytes, channels: dict[int, str]) -> Iterator[LoggedMessage]:
    """The messages of a chunk, up to a damaged record; its channels are added to `channels`."""
    records, errors = needed("mcap.records", WHAT), needed("mcap.exceptions", WHAT)
    at = 0
    while at + _HEAD.size <= len(chunk):
        opcode, length = _HEAD.unpack_from(chunk, at)
        at += _HEAD.size + length
        if at > len(chunk):
            return
        record = _stream_of(chunk[at - length : at])
        try:
            if opcode == _CHANNEL:
                channel = records.Channel.read(record)
                channels[channel.id] = channel.topic[:1000]  # many long ones would fill the memory
            elif opcode == _MESSAGE:
                found = records.Message.read(record, length)
                topic = channels.get(found.channel_id, "")
                yield LoggedMessage(topic, found.sequence, found.data)
        except (ValueError, struct.error, errors.McapError):
            return


def complete_bytes(path: Path) -> int:
    """Bytes of a file up to the end of its last complete record of data."""
    file = McapFile(path)
    with path.open("rb") as stream:
        for _ in _records(stream, file):
            pass
        return min(file.end, stream.seek(0, io.SEEK_END))


def _records(stream: BinaryIO, file: McapFile) -> Iterator[tuple[int, int, int]]:
    """Opcode, offset and length of each complete record of data; `stream` is at its content."""
    size, at = stream.seek(0, io.SEEK_END), len(MAGIC)
    while at + _HEAD.size <= size:
        stream.seek(at)
        opcode, length = _HEAD.unpack(stream.read(_HEAD.size))
        if opcode in (_DATA_END, _FOOTER):
            file.ended = True
            return
        if opcode == 0 or length > size - at - _HEAD.size:
            break
        file.end = at + _HEAD.size + length
        yield opcode, at, length
        at = file.end
    file.lost_bytes = max(0, size - at)


def _content(stream: BinaryIO, length: int) -> bytes | None:
    """Content of the chunk record of `length` bytes that follows, None where it is damaged."""
    if length > MAX_CHUNK_BYTES + 1000:
        return None
    records = needed("mcap.records", WHAT)
    try:
        chunk = records.Chunk.read(_stream_of(stream.read(length)))
        size, crc = chunk.uncompressed_size, chunk.uncompressed_crc
        plain = (
            inflated(chunk.compression, chunk.data, size + 1) if size <= MAX_CHUNK_BYTES else b""
        )
    except OrthonavError:
        raise
    except Exception:  # of a library, about damaged data
        return None
    return plain if len(plain) == size and (not crc or zlib.crc32(plain) == crc) else None


def _stream_of(data: bytes) -> Any:
    """Of the library; it returns no more than there is, whatever length is asked for."""
    return needed("mcap.data_stream", WHAT).ReadDataStream(io.BytesIO(data))


def inflated(kind: str, data: bytes, most: int) -> bytes:
    """As much of the compressed `data` as is there, at most `most` bytes.

    Raises `ValueError` for an unknown compression, and what the libraries raise.
    """
    if kind == "lz4":
        decompressor = needed("lz4.frame", "ROS recordings").LZ4FrameDecompressor()
        return bytes(decompressor.decompress(data, max_length=most))
    if kind == "zstd":
        zstandard = needed("zstandard", "flight logs and ROS recordings")
        decompressor = zstandard.ZstdDecompressor(max_window_size=2 * MAX_CHUNK_BYTES)
        with decompressor.stream_reader(data) as stream:
            return bytes(stream.read(most))
    if kind:
        raise ValueError(f"compression {kind[:20]!r} is not known")
    return data[:most]
