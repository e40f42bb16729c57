"""A flight log is complete up to its last chunk, and never blocks a flight."""

import contextlib
import errno
import json
import math
import os
import shutil
import threading
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from helpers import wait_for
from orthonav.core.errors import OutputError
from orthonav.core.geo.camera import Camera
from orthonav.core.records import Fix, NoFix, Telemetry, ViewResult
from orthonav.onboard import log as log_module
from orthonav.onboard.log import FlightLog

CAMERA = Camera(64, 48, 50.5, 50.25, 32.125, 24.0, (0.1, -0.02, 0.001, 0.002))
MAP = {"name": "area.onav", "manifest_sha256": "0" * 64}
START_NS = 1_700_000_000_123_456_789
STORE = get_typestore(Stores.ROS2_HUMBLE)


def telemetry(index):
    return Telemetry(START_NS + index * 10**9, 10.0 + index, math.nan, 0.1, 120.0)


def picture(index, shape=(48, 64)):
    return np.random.default_rng(index).integers(0, 256, shape, dtype=np.uint8)


def outcome(index, frame):
    where = Fix(46.5, 2.5 + index * 1e-5, np.array([[4.0, 1.0], [1.0, 9.0]]), 0.9, 15.0, 1.0, 120.0)
    answer = NoFix("blank", "nothing to see") if index % 5 == 4 else where
    return ViewResult(frame, START_NS + index * 10**9, answer, 12.5, "tracking")


def log_views(log, numbers):
    for index in numbers:
        frame = f"{index:06d}.png"
        log.view(index, frame, picture(index), telemetry(index))
        log.result(outcome(index, frame))


def begun(folder, **how):
    log = FlightLog(folder / "flight.mcap", CAMERA, MAP, **{"chunk_s": 0.01, **how})
    log.options({"heading": "known", "track": True, "accept": None})
    return log


def read(folder, name="flight_0001.mcap", reader=make_reader):
    """Topic to messages, by the library's own reader; `NonSeekingReader`: of a file whose ending
    may not have had space."""
    found, allowed = {}, [EndOfFile] if reader is NonSeekingReader else []
    with (folder / name).open("rb") as stream, contextlib.suppress(*allowed):
        whole = reader(stream, validate_crcs=True)
        for _, channel, message in whole.iter_messages(log_time_order=False):
            found.setdefault(channel.topic.removeprefix("/orthonav/"), []).append(message)
    return found


def summary(folder):
    with (folder / "flight_0001.mcap").open("rb") as stream:
        reader = make_reader(stream)
        return reader.get_header(), reader.get_summary()


def decoded(message, kind):
    """A message of `sensor_msgs`."""
    return STORE.deserialize_cdr(message.data, f"sensor_msgs/msg/{kind}")


def pictures(found):
    return [each["picture"] for each in plain(found["telemetry"])]


def plain(messages):
    return [json.loads(message.data) for message in messages]


def files_in(folder):
    return sorted(path.name for path in folder.iterdir())


def test_the_reader_of_mcap_reads_a_log(tmp_path):
    log = begun(tmp_path)
    log_views(log, range(6))
    log.health({"level": "ok", "share": math.nan})
    log.close()
    found, (header, whole) = read(tmp_path), summary(tmp_path)
    assert header.profile == "orthonav"
    counts = whole.statistics.channel_message_counts
    assert sum(counts.values()) == sum(map(len, found.values()))
    times = [START_NS + index * 10**9 for index in range(6)]
    assert [message.log_time for message in found["view"]] == times
    assert (len(found["result"]), len(found["navsatfix"])) == (6, 5)
    health = plain(found["health"])[-1]
    assert health == {"level": "ok", "share": "NaN", "log_lost": {"views": 0, "messages": 0}}


def test_messages_are_as_foxglove_requires(tmp_path):
    """The required fields of its published schemas, and their types."""
    log = begun(tmp_path)
    log_views(log, range(1))
    log.close()
    found, stamp = read(tmp_path), divmod(START_NS, 10**9)
    camera = plain(found["camera"])[0]
    assert (camera["width"], camera["height"]) == (64, 48)
    assert camera["distortion_model"] == "plumb_bob" and len(camera["D"]) == 5
    assert camera["K"] == [50.5, 0, 31.625, 0, 50.25, 23.5, 0, 0, 1]
    assert len(camera["R"]) == 9 and len(camera["P"]) == 12
    schemas = {each.name: each for each in summary(tmp_path)[1].schemas.values()}
    for name in ("foxglove.CameraCalibration", "orthonav.Telemetry"):
        text = json.loads(schemas[name].data)
        assert schemas[name].encoding == "jsonschema" and text["title"] == name
    for name in ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/NavSatFix"):
        assert schemas[name].encoding == "ros2msg"
        text = schemas[name].data.decode()
        for kind, (_, fields) in get_types_from_msg(text, name).items():
            assert fields == STORE.fielddefs[kind][1]
    view = decoded(found["view"][0], "CompressedImage")
    navsat = decoded(found["navsatfix"][0], "NavSatFix")
    for each in (view, navsat):
        assert (each.header.stamp.sec, each.header.stamp.nanosec) == stamp
        assert each.header.frame_id == "camera"
    assert view.format == "png"
    assert np.array_equal(cv2.imdecode(view.data, cv2.IMREAD_UNCHANGED), picture(0))
    assert (navsat.latitude, navsat.longitude) == (46.5, 2.5) and math.isnan(navsat.altitude)
    assert navsat.position_covariance.tolist() == [4, 1, 0, 1, 9, 0, 0, 0, 1e8]
    assert (navsat.position_covariance_type, navsat.status.service) == (3, 0)


@pytest.mark.parametrize(
    "confidence, state, status",
    [(0.95, "tracking", 0), (0.95, None, 0), (0.95, "searching", -1), (0.5, None, -1)],
)
def test_only_confident_fixes_have_a_fix_status_for_ros(tmp_path, confidence, state, status):
    log, result = begun(tmp_path), outcome(0, "0.png")
    placed = replace(result.outcome, confidence=confidence)
    log.result(replace(result, outcome=placed, state=state))
    log.close()
    (message,) = read(tmp_path)["navsatfix"]
    assert decoded(message, "NavSatFix").status.status == status


@pytest.mark.parametrize("shape", [(1, 1), (1, 70), (33, 1), (48, 65)])
def test_images_are_stored_without_loss(shape):
    grey = picture(3, shape)
    png = log_module.lossless_png(grey)
    assert np.array_equal(cv2.imdecode(np.frombuffer(png, np.uint8), -1), grey)


@pytest.mark.parametrize(("views", "logged"), [("none", "none"), ("thumbnails", "thumbnail")])
def test_views_may_be_small_or_left_out(tmp_path, views, logged):
    log = begun(tmp_path, views=views)
    log.view(0, "0.png", picture(0, (960, 1280)), telemetry(0))
    log.view(1, "1.png", None, telemetry(1))
    log.close()
    found = read(tmp_path)
    assert pictures(found) == [logged, "bad"] and "view" not in found
    sizes = [
        cv2.imdecode(decoded(each, "CompressedImage").data, cv2.IMREAD_UNCHANGED).shape
        for each in found.get("thumbnail", [])
    ]
    assert sizes == ([] if views == "none" else [(240, 320)])


def test_chunks_are_on_disk_before_the_end(tmp_path):
    """As after a power cut: the file is copied while it grows."""
    log = begun(tmp_path)
    log_views(log, range(3))
    wait_for(lambda: (tmp_path / "flight_0001.mcap").exists())
    wait_for(lambda: log._segment and log._segment.chunks and not log._queue)
    shutil.copy(tmp_path / "flight_0001.mcap", tmp_path / "cut.mcap")
    log.close()
    from orthonav.ground.recordings import open_source

    assert len(list(open_source(tmp_path / "cut.mcap").views)) == 3


def test_a_slow_disk_does_not_block_the_flight(tmp_path, monkeypatch):
    monkeypatch.setattr(log_module, "QUEUE_BYTES", 10 * 64 * 48)
    goes_on, in_time, sync = threading.Event(), [], os.fsync

    def stuck(handle):
        in_time.append(goes_on.wait(60))
        sync(handle)

    monkeypatch.setattr(log_module.os, "fsync", stuck)
    log = begun(tmp_path)
    log_views(log, range(1))
    wait_for(lambda: not log._queue)
    log_views(log, range(1, 40))
    goes_on.set()
    log.close()
    assert in_time and all(in_time)  # the flight went on while the disk was stuck
    found = read(tmp_path)
    assert len(found["result"]) == len(found["telemetry"]) == 40
    dropped = pictures(found).count("dropped")
    assert 0 < dropped == log.lost["views"] == 40 - len(found["view"])
    assert log.lost["messages"] == 0


def full_disk(monkeypatch, room_bytes):
    """A disk with room for so many bytes; cutting a file gives room back. Changeable."""
    disk = {"room": room_bytes}
    write, cut = os.write, os.ftruncate

    def limited(handle, data):
        part = memoryview(data)[: max(0, disk["room"])]
        if not part:
            raise OSError(errno.ENOSPC, "No space left on device")
        disk["room"] -= len(part)
        return write(handle, part)

    def shortened(handle, size):
        disk["room"] += os.fstat(handle).st_size - size
        cut(handle, size)

    monkeypatch.setattr(log_module.os, "write", limited)
    monkeypatch.setattr(log_module.os, "ftruncate", shortened)
    return disk


def test_a_full_disk_drops_images_first(tmp_path, monkeypatch):
    disk = full_disk(monkeypatch, 44_000)
    log = begun(tmp_path)
    for index in range(30):
        log_views(log, [index])
        wait_for(lambda: not log._queue)
        time.sleep(0.012)
    log.close()
    logged = [read(tmp_path, name, NonSeekingReader) for name in files_in(tmp_path)]
    views, results = (sum(len(each.get(t, [])) for each in logged) for t in ("view", "result"))
    assert log.lost["views"] == 30 - views > 10
    assert results > views >= 4
    assert disk["room"] >= 0


def test_logging_continues_when_a_full_disk_has_space_again(tmp_path, monkeypatch):
    monkeypatch.setattr(log_module, "PAUSE_S", 0.0)
    disk = full_disk(monkeypatch, 0)
    log = begun(tmp_path)
    log_views(log, range(5))
    wait_for(lambda: log.lost == {"views": 5, "messages": 15})
    assert files_in(tmp_path) == []
    disk["room"] = 10**9
    log_views(log, range(5, 8))
    log.health({})
    log.close()
    found = read(tmp_path)
    assert [message.sequence for message in found["view"]] == [5, 6, 7]
    assert plain(found["health"])[0]["log_lost"] == log.lost
    assert log.lost["views"] == 5


@pytest.mark.parametrize("code", [errno.EIO, errno.EROFS])
def test_a_disk_that_fails(tmp_path, monkeypatch, code):
    def failing(handle, data):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(log_module.os, "write", failing)
    log = begun(tmp_path)
    log_views(log, range(3))
    log.close()
    assert log.lost["views"] == 3 and log.lost["messages"] >= 6


def test_files_are_limited_and_the_oldest_are_deleted(tmp_path):
    most = 400_000
    log = begun(tmp_path, max_bytes=most, segment_bytes=100_000)
    for index in range(200):
        log_views(log, [index])
        if index % 5 == 0:
            wait_for(lambda: not log._queue)
    log.close()
    files = [tmp_path / name for name in files_in(tmp_path)]
    assert sum(path.stat().st_size for path in files) <= most
    assert len(files) >= 2 and files[0].name != "flight_0001.mcap"
    last = -1
    for path in files:
        found = read(tmp_path, path.name)
        session = plain(found["session"])[0]
        assert session["options"]["heading"] == "known" and session["map"] == MAP
        assert "camera" in found
        numbers = [message.sequence for message in found["view"]]
        assert numbers == sorted(numbers) and numbers[0] > last
        last = numbers[-1]
    assert last == 199


def test_existing_files_are_not_overwritten(tmp_path):
    for first in (0, 5):
        log = begun(tmp_path)
        log_views(log, range(first, first + 5))
        log.close()
    assert files_in(tmp_path) == ["flight_0001.mcap", "flight_0002.mcap"]
    first, second = (plain(read(tmp_path, name)["session"])[0] for name in files_in(tmp_path))
    assert first["run"] != second["run"]


def test_messages_that_cannot_be_encoded_are_counted(tmp_path):
    log = begun(tmp_path)
    log.health({"a": object()})
    log.options({"b": {1, 2}})
    log.view(0, "0.png", np.zeros((4, 4, 3), dtype=np.uint8), telemetry(0))
    log_views(log, range(1, 3))
    log.close()
    log_views(log, range(3, 5))
    found = read(tmp_path)
    assert len(found["view"]) == 2
    assert pictures(found) == ["none", "full", "full"]  # the telemetry is not lost
    assert log.lost == {"views": 3, "messages": 6}
    assert plain(found["session"])[0]["options"]["heading"] == "known"


def test_a_thumbnail_that_cannot_be_encoded_leaves_the_telemetry(tmp_path, monkeypatch):
    monkeypatch.setattr(log_module.cv2, "imencode", lambda *_: (False, None))
    log = begun(tmp_path, views="thumbnails")
    log.view(0, "0.png", picture(0), telemetry(0))
    log.close()
    found = read(tmp_path)
    assert pictures(found) == ["none"]
    assert "thumbnail" not in found and log.lost == {"views": 1, "messages": 0}


def test_the_camera_has_the_size_of_the_images(tmp_path):
    log = begun(tmp_path)
    log.view(0, "0.png", picture(0, (24, 32)), telemetry(0))
    log.close()
    session = plain(read(tmp_path)["session"])[-1]
    assert session["camera"]["width_px"] == 32 and session["camera"]["fx_px"] == 25.25


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match="file"):
        begun(tmp_path / "file")
