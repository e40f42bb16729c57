"""ROS recordings whose chunks inflate to more than they may, or than they say."""

import bz2
import struct
import tracemalloc
from dataclasses import dataclass

import lz4.frame
import pytest
import zstandard
from bags import Messages, flight, record

from orthonav.core.errors import FlightError
from orthonav.ground.recordings import import_flight, open_source, ros_files
from orthonav.ground.recordings.ros_files import bound_inflation, check_held

MB = 2**20


def zeros(size, compressor):
    """`size` zeros in a few kilobytes, made in pieces."""
    pieces = [compressor.compress(bytes(MB)) for _ in range(size // MB)]
    return b"".join(pieces) + compressor.flush()


def frame_of_zeros(size):
    writer = lz4.frame.LZ4FrameCompressor()
    return writer.begin() + zeros(size, writer)


BOMBS = {
    "zstd": zeros(512 * MB, zstandard.ZstdCompressor().compressobj(size=512 * MB)),
    "zstd without a stated size": zeros(512 * MB, zstandard.ZstdCompressor().compressobj()),
    "lz4": frame_of_zeros(512 * MB),
}


def text(data):
    return struct.pack("<I", len(data)) + data


def line(opcode, body):
    return bytes([opcode]) + struct.pack("<Q", len(body)) + body


def unindexed(path, data, claimed, kind):
    """An MCAP of one chunk, without an index."""
    body = struct.pack("<QQQI", 0, 1, claimed, 0) + text(kind) + struct.pack("<Q", len(data)) + data
    magic = b"\x89MCAP0\r\n"
    head = line(1, text(b"ros2") + text(b""))
    end = line(15, bytes(4)) + line(2, bytes(20))
    path.write_bytes(magic + head + line(6, body) + end + magic)
    return path


@pytest.mark.parametrize("how", BOMBS)
@pytest.mark.parametrize("claimed", [100, 512 * MB, 2**62])
def test_chunks_of_mcap(tmp_path, how, claimed):
    path = unindexed(tmp_path / "a.mcap", BOMBS[how], claimed, how.split()[0].encode())
    tracemalloc.start()
    try:
        with pytest.raises(FlightError, match=r"more than|mismatch") as caught:
            open_source(path)
        assert tracemalloc.get_traced_memory()[1] < 30e6
    finally:
        tracemalloc.stop()
    assert str(path) in str(caught.value)


def test_chunks_of_ros_1(monkeypatch):
    bound_inflation()
    from rosbags.rosbag1 import reader

    monkeypatch.setattr(ros_files, "MAX_CHUNK_BYTES", MB)
    for name, pack in (("bz2", bz2.compress), ("lz4", lz4.frame.compress)):
        inflate = reader.decompressors[name]
        for size in (0, 1, MB):
            assert inflate(pack(bytes(size))) == bytes(size)
        with pytest.raises(ValueError, match="more than the 1048576 bytes"):
            inflate(pack(bytes(MB + 1)))
        with pytest.raises(ValueError, match="cut"):
            inflate(pack(bytes(100))[:-4])


@dataclass
class Claim:
    """What the index of an MCAP says of a chunk."""

    message_start_time: int
    message_end_time: int
    uncompressed_size: int


@dataclass
class Reader:
    """A reader of rosbags, as far as chunks go."""

    storage: object
    chunks: object = ()


@pytest.mark.parametrize(
    "claims, message",
    [
        ([(0, 1, 129 * MB)], "a chunk states"),
        ([(0, 9, 100 * MB)] * 11, "chunks of the same time state"),
        ([(k, 20 - k, 100 * MB) for k in range(11)], "chunks of the same time state"),
        ([(5, 5, 100 * MB)] * 11 + [(9, 0, 100 * MB)] * 11, "chunks of the same time state"),
        ([(k, k, 100 * MB) for k in range(50)], None),
        ([(k, k + 1, 100 * MB) for k in range(50)], None),
        ([], None),
    ],
)
def test_chunks_that_are_held_at_once(claims, message):
    storage = Reader(None, [Claim(*each) for each in claims])
    folder = Reader(None)
    folder.storages = [Reader(None), storage]
    for reader in (Reader(storage), Reader(folder)):
        if message is None:
            check_held([reader, object()])
        else:
            with pytest.raises(ValueError, match=message):
                check_held([reader])


def test_a_recording_whose_chunks_are_too_large(tmp_path, monkeypatch):
    messages = Messages()
    path = record(tmp_path / "flight", flight(messages), messages, "file")
    assert import_flight(open_source(path), tmp_path / "out").views == 4
    monkeypatch.setattr(ros_files, "MAX_HELD_BYTES", 1000)
    with pytest.raises(FlightError, match=r"more than 1000\): .*mcap"):
        open_source(path)
