"""Memory limits for compressed ROS recordings.

`rosbags` decompresses a whole chunk before it compares the size with the stated one, so a small
malicious file can exhaust memory. Its decompressors are replaced by ones that stop at the stated
size. Chunks of MCAP that overlap in time are held at once: their total is limited before one of
them is read. Violations raise `ValueError`, as damage does in `rosbags`; `guard.reading` adds the
name of the file.
"""

import bz2
from collections.abc import Iterable
from typing import Any

from orthonav.core.flight.logged import MAX_CHUNK_BYTES
from orthonav.core.guard import needed

MAX_HELD_BYTES = 2**30
WHAT = "ROS recordings"


def bound_inflation() -> None:
    """Limit decompression by `rosbags` to the stated size of a chunk and `MAX_CHUNK_BYTES`."""
    mcap = needed("rosbags.rosbag2.storage_mcap", WHAT)
    mcap.DECOMPRESSORS.update(lz4=_lz4, zstd=_zstd)
    bag = needed("rosbags.rosbag1.reader", WHAT)
    bag.decompressors.update(lz4=lambda data: _lz4(data, MAX_CHUNK_BYTES), bz2=_bz2)


def check_held(readers: Iterable[Any]) -> None:
    """Raises `ValueError` where chunks state too many bytes, singly or those of the same time.

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


def _most_held(chunks: Iterable[Any]) -> int:
    """Largest total of chunks that overlap at one time."""
    edges = []
    for chunk in chunks:
        start, end = chunk.message_start_time, chunk.message_end_time
        edges += [(start, 0, chunk.uncompressed_size)]
        edges += [(max(start, end), 1, -chunk.uncompressed_size)]
    held = most = 0
    for _, _, step in sorted(edges):
        held += step
        most = max(most, held)
    return most


def _require(size: int) -> None:
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk states {size} bytes, more than {MAX_CHUNK_BYTES}")


def _zstd(data: bytes, size: int) -> bytes:
    _require(size)
    decompressor = needed("zstandard", WHAT).ZstdDecompressor(max_window_size=2 * MAX_CHUNK_BYTES)
    with decompressor.stream_reader(data) as stream:
        return bytes(stream.read(size + 1))


def _lz4(data: bytes, size: int) -> bytes:
    _require(size)
    return _whole(needed("lz4.frame", WHAT).LZ4FrameDecompressor(), data, size)


def _bz2(data: bytes) -> bytes:
    return _whole(bz2.BZ2Decompressor(), data, MAX_CHUNK_BYTES)


def _whole(decompressor: Any, data: bytes, size: int) -> bytes:
    """`data` decompressed; raises `ValueError` beyond `size` bytes or where it is incomplete.

    One byte more than allowed is requested, so that the end after exactly `size` bytes is seen.
    """
    plain: bytes = decompressor.decompress(data, max_length=size + 1)
    if len(plain) > size or not decompressor.eof:
        raise ValueError(f"a chunk is cut, or takes more than the {size} bytes it may")
    return plain
