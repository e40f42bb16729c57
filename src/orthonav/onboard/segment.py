"""One MCAP file of a flight log, which grows by whole chunks.

Whatever the disk does, the file ends with a whole chunk: one that cannot be written is cut off
again. A file that lost power ends with a whole chunk but for the last, and lacks the index that
`finish` writes; readers go through it from the start.
"""

import contextlib
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from orthonav import __version__
from orthonav.flight.logged import PROFILE, TOPICS, VIEW, Topic

_INDEX_BYTES = 64_000, 300
"""What the end of a file takes, at most: once, and for each chunk."""


@dataclass(frozen=True)
class Message:
    """A message of the log; `time_ns` is when what it speaks of was exposed, `index` the view's."""

    topic: Topic
    time_ns: int
    data: bytes
    index: int = 0

    @property
    def is_view(self) -> bool:
        """Whether it is a full picture, the first to go where room is short."""
        return self.topic is VIEW


class _Tail:
    """What the writer writes, until it is on the disk; tells offsets in the whole file."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._count = 0

    def write(self, data: bytes) -> int:
        self._parts.append(bytes(data))
        self._count += len(data)
        return len(data)

    def tell(self) -> int:
        return self._count

    def flush(self) -> None:
        """Nothing: `Segment` writes."""

    def taken(self) -> bytes:
        parts, self._parts = self._parts, []
        return b"".join(parts)


class Segment:
    """A new file. Every method that raises `OSError` leaves it closed, ending with a chunk."""

    def __init__(self, path: Path) -> None:
        """Raises `OSError`, also where `path` exists."""
        self.path = path
        self.size_bytes = 0
        self.chunks = 0
        self._file = path.open("xb", buffering=0)
        self._tail = _Tail()
        self._writer = Writer(
            self._tail,  # type: ignore[arg-type]
            chunk_size=2**62,  # chunks end when they are told to
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
        """How large the file will be at most when it is finished now."""
        return self.size_bytes + _INDEX_BYTES[0] + _INDEX_BYTES[1] * self.chunks

    def write(self, messages: Sequence[Message]) -> None:
        """Write one chunk and wait until the disk has it. Raises `OSError`."""
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
        """Cut off what is not whole, and close; a file without a chunk is removed."""
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
    """End a file without an index, so that readers know that it ends there; or leave it be."""
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
    """The next file `NAME_0001.mcap` of a log.

    The oldest ones go until all others and `needed_bytes` fit into `max_bytes`. Raises `OSError`.
    """
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
        os.fsync(handle)  # so that the file is still there after a power cut
    finally:
        os.close(handle)
    return segment
