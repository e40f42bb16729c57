"""One MCAP file of a flight log, written in complete chunks.

A chunk that cannot be written completely is truncated, so the file ends with a complete one. After
a power cut the index that `finish` writes is missing: readers scan the file from the start.
"""

import contextlib
import os
import re
from collections.abc import Sequence
from pathlib import Path

# Some functions of mcap have no types: calling them needs `type: ignore[no-untyped-call]`.
from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from orthonav import __version__
from orthonav.core.flight.logged import PROFILE, TOPICS, Message

_INDEX_BYTES = 64_000, 300
"""Upper bound of the size of the index: constant part, and per chunk."""


class _Tail:
    """Buffers the writer's output until it is written to disk; offsets are those of the file."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._count = 0

    def write(self, data: bytes) -> int:
        self._parts.append(bytes(data))
        self._count += len(data)
        return len(data)

    def tell(self) -> int:
        return self._count

    def flush(self) -> None: ...

    def taken(self) -> bytes:
        parts, self._parts = self._parts, []
        return b"".join(parts)


class Segment:
    """A new file. A method that raises `OSError` leaves it closed, ending with a chunk."""

    def __init__(self, path: Path) -> None:
        """Raises `OSError`, also where `path` exists."""
        self.path = path
        self.size_bytes = 0
        self.chunks = 0
        self._file = path.open("xb", buffering=0)
        self._tail = _Tail()
        self._writer = Writer(
            self._tail,  # type: ignore[arg-type]  # has what the writer calls
            chunk_size=2**62,  # chunks end by `flush` only
            compression=CompressionType.ZSTD,
        )
        self._writer.start(profile=PROFILE, library=f"orthonav {__version__}")
        schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        for topic in TOPICS:
            if topic.schema not in schemas:
                schemas[topic.schema] = self._writer.register_schema(
                    topic.schema, topic.schema_encoding, topic.text.encode()
                )
            self._channels[topic.name] = self._writer.register_channel(
                topic.name, topic.encoding, schemas[topic.schema]
            )

    @property
    def finished_bytes(self) -> int:
        """Upper bound of the size of the file if it is finished now."""
        return self.size_bytes + _INDEX_BYTES[0] + _INDEX_BYTES[1] * self.chunks

    def write(self, messages: Sequence[Message]) -> None:
        """Write one chunk and sync it to disk. Raises `OSError`."""
        for message in messages:
            time_ns = max(0, message.time_ns)
            self._writer.add_message(
                self._channels[message.topic.name],
                log_time=time_ns,
                publish_time=time_ns,
                sequence=message.index & 0xFFFFFFFF,
                data=message.data,
            )
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._put(self._tail.taken())
        self.chunks += 1

    def finish(self) -> None:
        """Write the index and close. Raises `OSError`."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._put(self._tail.taken())
        self._file.close()

    def _put(self, data: bytes) -> None:
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[os.write(self._file.fileno(), rest) :]
            os.fsync(self._file.fileno())
        except OSError:
            self._abandon()
            raise
        self.size_bytes += len(data)

    def _abandon(self) -> None:
        """Truncate to complete chunks and close; a file without a chunk is removed."""
        with contextlib.suppress(OSError):
            os.ftruncate(self._file.fileno(), self.size_bytes)
            if self.chunks:
                os.lseek(self._file.fileno(), self.size_bytes, os.SEEK_SET)
                _write_ending(self._file.fileno(), self.size_bytes)
        with contextlib.suppress(OSError):
            self._file.close()
        if not self.chunks:
            with contextlib.suppress(OSError):
                self.path.unlink()


def _write_ending(handle: int, size_bytes: int) -> None:
    """Write the end records without an index; where that fails, restore the size."""
    records = RecordBuilder()
    DataEnd(0).write(records)
    Footer(0, 0, 0).write(records)
    ending = bytes(records.end()) + MCAP0_MAGIC  # type: ignore[no-untyped-call]
    try:
        whole = os.write(handle, ending) == len(ending)
    except OSError:
        whole = False
    if not whole:
        os.ftruncate(handle, size_bytes)
    os.fsync(handle)


def next_segment(folder: Path, name: str, needed_bytes: int, max_bytes: int | None) -> Segment:
    """Next file `NAME_0001.mcap` of a log; the oldest are deleted until the rest and `needed_bytes`
    fit into `max_bytes`. Raises `OSError`."""
    pattern = re.compile(re.escape(name) + r"_(\d{4,9})\.mcap")
    found = ((pattern.fullmatch(path.name), path) for path in folder.iterdir())
    files = {int(match[1]): path for match, path in found if match}
    if max_bytes is not None:
        sizes = {number: file.stat().st_size for number, file in files.items()}
        for number in sorted(files):
            if sum(sizes.values()) + needed_bytes <= max_bytes:
                break
            files[number].unlink()
            del sizes[number]
    segment = Segment(folder / f"{name}_{max(files, default=0) + 1:04d}.mcap")
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)  # the entry of the file must survive a power cut
    finally:
        os.close(handle)
    return segment
