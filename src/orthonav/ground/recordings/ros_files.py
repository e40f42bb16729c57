"""The files of a ROS recording, opened by `rosbags`: renamed, cut off, or without their metadata.

`rosbags` reads a path object by few of its methods, so a file of MCAP that was cut off is given an
end without a copy.
"""

import bz2
import contextlib
import io
import logging
import re
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any

from orthonav.core.errors import FlightError
from orthonav.core.files import require_file
from orthonav.core.flight.logged import MAX_CHUNK_BYTES
from orthonav.core.guard import needed, reading, without_plea
from orthonav.ground.recordings.mcap_files import (
    MAGIC,
    complete_bytes,
    inflated,
    partial_records,
)

MAGICS = {b"#ROSBAG V": ".bag", MAGIC: ".mcap", b"SQLite format 3\0": ".db3"}
METADATA = "metadata.yaml"
MAX_HELD_BYTES = 2**30
WHAT = "ROS recordings"
_ROS_2 = (".mcap", ".db3")
_SPLIT = re.compile(r"(.+)_(\d{1,9})")
_END = b"\x0f" + (4).to_bytes(8, "little") + bytes(4)  # data end
_END += b"\x02" + (20).to_bytes(8, "little") + bytes(20) + MAGIC  # footer without a summary


log = logging.getLogger(__name__)


def bag_suffix(path: Path) -> str | None:
    """The suffix that fits the content of a file, None where it is not a bag."""
    with path.open("rb") as stream:
        head = stream.read(16)
    return next((suffix for magic, suffix in MAGICS.items() if head.startswith(magic)), None)


def storage_files(folder: Path) -> list[Path]:
    """The files of a ROS 2 bag in a folder, by name and number.

    Raises `FlightError` where they are of several recordings, `MissingFileError` for a pointer of
    Git LFS.
    """
    found = [path for path in folder.iterdir() if path.is_file() and path.suffix in _ROS_2]
    found = [path for path in found if bag_suffix(require_file(path, "file of the bag")) in _ROS_2]
    found.sort(key=_order)
    if len({_order(path)[0] for path in found}) > 1 or len({path.suffix for path in found}) > 1:
        names = ", ".join(path.name for path in found[:5])
        raise FlightError(
            f"folder holds {len(found)} ROS 2 recordings ({names}); give one of the files: {folder}"
        )
    return found


def _order(path: Path) -> tuple[str, int]:
    match = _SPLIT.fullmatch(path.stem)
    return (match[1], int(match[2])) if match else (path.stem, 0)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[tuple[Any, list[str]]]:
    """A reader of the recording, whatever its file is called, and warnings about its files."""
    bound_inflation()
    with contextlib.ExitStack() as stack:
        stack.enter_context(reading("ROS recording", path))
        warnings: list[str] = []
        reader = _entered(path, stack, warnings)
        try:
            yield reader, warnings
        except FlightError as error:
            raise FlightError("; ".join([*warnings, str(error)])) from error


def _entered(path: Path, stack: contextlib.ExitStack, warnings: list[str]) -> Any:
    if path.is_file():
        require_file(path, "ROS recording")
        return _reader([_whole(_named(path, stack), path, warnings)], path, stack)
    doubt = None
    try:
        files = storage_files(path)
    except FlightError:
        if not (path / METADATA).is_file():
            raise
        files = []  # only the metadata can tell which they are
    if (path / METADATA).is_file() and not any(_is_cut(file) for file in files):
        try:
            return _reader([path], path, stack)
        except Exception as error:
            if not files:
                raise
            doubt = without_plea(" ".join(str(error).split()))[:160]
    if not files:
        raise FlightError(f"folder holds no complete file of a bag (.mcap, .db3): {path}")
    if doubt:
        warnings.append(f"{METADATA} is not used ({doubt}); the files beside it are read")
    return _reader([_whole(file, file, warnings) for file in files], path, stack)


def _reader(paths: Sequence[Any], path: Path, stack: contextlib.ExitStack) -> Any:
    highlevel = needed("rosbags.highlevel", WHAT)
    typesys = needed("rosbags.typesys", WHAT)
    known = typesys.get_typestore(typesys.Stores.LATEST)  # for old bags without definitions
    reader = highlevel.AnyReader(paths, default_typestore=known)
    reader.readers = [ParsableReader(each) for each in reader.readers]
    try:
        stack.enter_context(reader)
    except highlevel.AnyReaderError as error:
        if getattr(paths[0], "suffix", "") == ".bag":
            raise FlightError(
                f"ROS 1 bag has no complete index ({error}): it was not closed, or was cut off; "
                f"run `rosbag reindex` on it: {path}"
            ) from error
        if "malformed" in str(error):
            raise FlightError(
                "ROS 2 bag was cut off or is damaged; `sqlite3 BAG.db3 .recover | sqlite3 new.db3` "
                f"may restore it: {path}"
            ) from error
        raise
    check_held(reader.readers)
    return reader


class ParsableReader:
    """A reader of `rosbags` without the connections whose messages it cannot describe.

    `rosbags` refuses a whole recording for one of them. Such are events of services and actions:
    their definitions refer to types that messages do not have.
    """

    def __init__(self, reader: Any) -> None:
        self._reader = reader

    def __enter__(self) -> "ParsableReader":
        self._reader.__enter__()
        return self

    def __exit__(self, *raised: Any) -> None:
        self._reader.__exit__(*raised)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._reader, name)

    @cached_property
    def connections(self) -> list[Any]:
        """The connections whose messages can be parsed, once the reader is open."""
        return [one for one in self._reader.connections if _is_parsable(one)]


def _is_parsable(connection: Any) -> bool:
    """Whether a topic carries messages whose definition is complete."""
    typesys = needed("rosbags.typesys", WHAT)
    parsable = "/msg/" in connection.msgtype
    if parsable and connection.msgdef.format.name == "MSG":
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        try:
            store.register(typesys.get_types_from_msg(connection.msgdef.data, connection.msgtype))
            store.hash_rihs01(connection.msgtype)
        except Exception as error:  # of the parser, or of a type that is not defined
            log.info("%s cannot be parsed: %s", connection.msgtype, error)
            parsable = False
    if not parsable:
        log.info("topic is ignored: %s carries %s", connection.topic, connection.msgtype)
    return parsable


def _named(path: Path, stack: contextlib.ExitStack) -> Path:
    """The file under a name with the suffix by which the library chooses its reader."""
    suffix = bag_suffix(path)
    if suffix in (None, path.suffix):
        return path
    folder = stack.enter_context(tempfile.TemporaryDirectory())
    named = Path(folder) / f"recording{suffix}"
    named.symlink_to(path.resolve())
    return named


def _is_cut(path: Path) -> bool:
    if path.suffix != ".mcap":
        return False
    with path.open("rb") as stream:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(max(0, size - len(MAGIC)))
        return stream.read() != MAGIC


def _whole(named: Path, path: Path, warnings: list[str]) -> "Path | _CutMcap":
    journal = named.with_name(f"{named.name}-wal")
    if journal.is_file() and journal.stat().st_size:
        warnings.append(
            f"bag was not closed, and data in {journal.name} are not read; write them into "
            f"the bag first: sqlite3 {named.name} 'pragma wal_checkpoint(truncate)': {path}"
        )
    if not _is_cut(named):
        return named
    complete = complete_bytes(named)
    warnings.append(
        "recording was cut short: it is read up to its last complete message; `mcap recover` "
        f"repairs it for other programs: {path}"
    )
    return _CutMcap(named, complete, partial_records(named, complete) + _END)


@dataclass(frozen=True)
class _CutMcap:
    """The path of a file of MCAP whose first `complete` bytes are followed by `end`."""

    path: Path
    complete: int
    end: bytes
    suffix: str = ".mcap"

    def exists(self) -> bool:
        return self.path.exists()

    def is_dir(self) -> bool:
        return False

    def open(self, mode: str = "rb") -> io.BufferedReader:
        return io.BufferedReader(_Ended(self.path.open(mode, buffering=0), self.complete, self.end))


class _Ended(io.RawIOBase):
    """The first `complete` bytes of a file, then `end`."""

    def __init__(self, stream: Any, complete: int, end: bytes) -> None:
        self._stream, self._complete, self._end, self._at = stream, complete, end, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        starts = 0, self._at, self._complete + len(self._end)
        self._at = max(0, starts[whence] + offset)
        return self._at

    def readinto(self, buffer: Any) -> int:
        if self._at < self._complete:
            self._stream.seek(self._at)
            data = self._stream.read(min(len(buffer), self._complete - self._at))
        else:
            first = self._at - self._complete
            data = self._end[first : first + len(buffer)]
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def close(self) -> None:
        self._stream.close()
        super().close()


def bound_inflation() -> None:
    """Limit decompression by `rosbags` to the stated size of a chunk and `MAX_CHUNK_BYTES`.

    It decompresses a whole chunk before it compares its size with the stated one, so a small
    malicious file could exhaust memory. Violations raise `ValueError`, as damage does there.
    """
    mcap = needed("rosbags.rosbag2.storage_mcap", WHAT)
    mcap.DECOMPRESSORS.update(lz4=_lz4, zstd=_zstd)
    bag = needed("rosbags.rosbag1.reader", WHAT)
    bag.decompressors.update(lz4=lambda data: _lz4(data, MAX_CHUNK_BYTES), bz2=_bz2)


def check_held(readers: Iterable[Any]) -> None:
    """Raises `ValueError` where chunks state too many bytes, singly or those of the same time,
    which are held at once.

    `readers` are those of an opened recording (`AnyReader.readers`).
    """
    for reader in readers:
        storage = getattr(reader, "storage", None)  # a ROS 1 bag has none: one chunk at a time
        for one in getattr(storage, "storages", [storage]):
            chunks = getattr(one, "chunks", [])
            _require(max((chunk.uncompressed_size for chunk in chunks), default=0))
            if (held := _most_held(chunks)) > MAX_HELD_BYTES:
                raise ValueError(
                    f"chunks of the same time state {held} bytes, more than {MAX_HELD_BYTES}"
                )


def _most_held(chunks: Sequence[Any]) -> int:
    edges = [(chunk.message_start_time, 0, chunk.uncompressed_size) for chunk in chunks]
    edges += [
        (max(chunk.message_start_time, chunk.message_end_time), 1, -chunk.uncompressed_size)
        for chunk in chunks
    ]
    return max(accumulate(step for _, _, step in sorted(edges)), default=0)


def _require(size: int) -> None:
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk states {size} bytes, more than {MAX_CHUNK_BYTES}")


def _zstd(data: bytes, size: int) -> bytes:
    _require(size)
    return inflated(b"zstd", data, size + 1)


def _lz4(data: bytes, size: int) -> bytes:
    _require(size)
    return _decompressed(needed("lz4.frame", WHAT).LZ4FrameDecompressor(), data, size)


def _bz2(data: bytes) -> bytes:
    return _decompressed(bz2.BZ2Decompressor(), data, MAX_CHUNK_BYTES)


def _decompressed(decompressor: Any, data: bytes, size: int) -> bytes:
    """`data` decompressed; raises `ValueError` beyond `size` bytes or where it is incomplete.

    One byte more than allowed is requested, so that the end after exactly `size` bytes is seen.
    """
    plain: bytes = decompressor.decompress(data, max_length=size + 1)
    if len(plain) > size or not decompressor.eof:
        raise ValueError(f"a chunk is cut, or takes more than the {size} bytes it may")
    return plain
