"""A flight log is flown again bit for bit, and what is broken or crafted is one line at most."""

import json
import math
import struct
import tracemalloc
import zlib
from dataclasses import asdict, fields, replace

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from mcap_bytes import chunk, header, zeros

from orthonav.core.errors import FlightError, OrthonavError
from orthonav.core.flight import logged as png_module
from orthonav.core.flight.fixes import read_results, result_to_json
from orthonav.core.flight.logged import (
    FORMAT,
    PROFILE,
    TOPICS,
    LoggedView,
    lossless_png,
    picture_message,
    telemetry_message,
    to_json,
    view_of,
)
from orthonav.core.flight.mount import Bias, Mount, write_mount
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.ground import Ground
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.reader import map_digest
from orthonav.core.records import Prior, Telemetry, View, ViewResult
from orthonav.core.track.tracker import Tracker
from orthonav.ground.recordings import SourceOptions, open_source, source_kind
from orthonav.ground.recordings import flightlog as flightlog_module
from orthonav.ground.recordings.flightlog import open_flight_log
from orthonav.onboard.log import FlightLog, Segment
from orthonav.onboard.run import MountCorrected, locate_view, model_of

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
VIEWS = 5
MOUNT = Mount(Bias(2.0, 0.5, 0.5), Bias(0.02, 0.01, 0.01), *[Bias(0.5, 0.2, 0.2)] * 2, views=9)


def telemetry(index):
    return Telemetry(10**18 + index * 10**9 + index, 1.1 * index, math.nan, 0.1, 120.0)


def picture(index):
    return np.random.default_rng(index).integers(0, 256, (48, 64), dtype=np.uint8)


def short_log(folder, numbers=range(5), **how):
    """A log of small pictures; its first file."""
    log = FlightLog(folder / "flight.mcap", CAMERA, {}, **{"chunk_s": 0.005, **how})
    for index in numbers:
        log.view(index, f"{index:06d}.png", picture(index), telemetry(index))
        while log._queue:  # each is a chunk or two
            pass
    log.close()
    return folder / "flight_0001.mcap"


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    """The bytes of a short log, and where each chunk ends and how many views there are then."""
    ends, views, write = [], 0, Segment.write

    def watched(self, messages):
        nonlocal views
        write(self, messages)
        views += sum(message.is_view for message in messages)
        ends.append((self.size_bytes, views))

    folder = tmp_path_factory.mktemp("log")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Segment, "write", watched)
        path = short_log(folder)
    assert len(ends) >= 3 and ends[-1][1] == 5
    return path.read_bytes(), ends


def crafted(path, messages, profile=PROFILE, compression=CompressionType.ZSTD):
    """An MCAP file of these (topic, index, data), by the library's own writer."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression)
        writer.start(profile=profile, library="test")
        ids = {}
        for topic, index, data in messages:
            if topic.name not in ids:
                ids[topic.name] = writer.register_channel(topic.name, "json", 0)
            writer.add_message(ids[topic.name], log_time=0, publish_time=0, sequence=index,
                               data=data)  # fmt: skip
        writer.finish()
    return path


def session(**changes):
    plain = {"format": FORMAT, "run": "a", "views": "full", "camera": CAMERA.numbers()}
    return TOPICS.session, 0, to_json({**plain, **changes})


def reported(index=0, frame="a.png", picture="full"):
    view = LoggedView(index, index, frame, telemetry(index), picture)
    return TOPICS.telemetry, index, telemetry_message(view)


def shown(index=0, data=None):
    png = lossless_png(picture(index)) if data is None else data
    return TOPICS.view, index, picture_message(png, "png", 0)


# The flight again


def flown(localizer, flight, folder, mount=None, **how):
    """Fly as the runner does, logging; what came out."""
    locator = Tracker(localizer, model=model_of(mount) if mount else None)
    if mount:
        locator = MountCorrected(locator, mount)
    path = localizer.map_path
    info = {"name": path.name, "manifest_sha256": map_digest(path)}
    log = FlightLog(folder / "flight.mcap", flight.camera, info, chunk_s=0.05, **how)
    log.options(
        {"heading": "known", "track": True, "mount": mount and asdict(mount), "accept": None}
    )
    results = []
    for number, view in enumerate(flight.views[:VIEWS]):
        grey, known = view.grey(), view.telemetry
        if number == 3:  # the camera sees it worse than any file says
            known = replace(known, yaw_std_deg=0.1 + 0.2, prior=Prior(46.5, 1 / 3, 1e9))
        log.view(number * 2, view.frame, grey, known)  # every other picture was passed over
        outcome, latency_ms = locate_view(locator, View(grey, flight.camera, known))
        result = ViewResult(view.frame, known.time_ns, outcome, latency_ms, locator.state_name)
        log.result(result)
        results.append(result)
    log.close()
    return results


@pytest.fixture(scope="module")
def full(map_path):
    found = Localizer(open_map(map_path))
    found.map_path = map_path
    return found


def lines(results):
    return [result_to_json(replace(result, latency_ms=0.0)) for result in results]


@pytest.mark.long
def test_the_same_fixes_bit_for_bit(full, flight, map_path, tmp_path, run):
    results = flown(full, flight, tmp_path / "log", mount=MOUNT, segment_bytes=200_000)
    assert len(list((tmp_path / "log").iterdir())) > 1
    logged = list(open_source(tmp_path / "log").results())
    assert lines(logged) == lines(results)
    out = tmp_path / "fixes.jsonl"
    done = run("localize", map_path, tmp_path / "log", "--as-flown", "--out", out)
    assert (done.code, done.err) == (0, "")
    assert lines(read_results(out)) == lines(results)
    write_mount(tmp_path / "mount.json", MOUNT)
    first = tmp_path / "log" / "flight_0001.mcap"
    options = ("--track", "--mount", tmp_path / "mount.json", "--out", out)
    assert run("localize", map_path, first, *options).err == ""
    assert lines(read_results(out)) == lines(results)
    done = run("localize", map_path, first, "--out", out)
    assert "(track, mount)" in done.err and f"{VIEWS} of {VIEWS} results differ" in done.err


def test_another_map_causes_a_warning(full, flight, map_path, tmp_path, run):
    flown(full, replace(flight, views=flight.views[:1]), tmp_path)
    info = {"name": "other.onav", "manifest_sha256": "0" * 64}
    log = FlightLog(tmp_path / "b.mcap", flight.camera, info)
    log.view(0, "0.png", flight.views[0].grey(), flight.views[0].telemetry)
    log.close()
    for name, warned in (("flight_0001.mcap", False), ("b_0001.mcap", True)):
        done = run("localize", map_path, tmp_path / name, "--out", tmp_path / "out", "--track")
        assert done.code == 0 and ("flown with another map" in done.err) == warned


@pytest.mark.parametrize(
    "options",
    [{"heading": "--out"}, {"track": "yes"}, {"accept": ["a"]}, {"mount": {"views": 3}},
     {"mount": 7}, {"alert_limit_m": "far"}, {"risk": None}],
)  # fmt: skip
def test_invalid_options_are_rejected(map_path, tmp_path, run, options):
    crafted(tmp_path / "a.mcap", [session(options=options), reported(), shown()])
    done = run("localize", map_path, tmp_path / "a.mcap", "--as-flown", "--out", tmp_path / "out")
    assert done.code == 1 and done.err.count("\n") == 1 and "flight log: invalid" in done.err


numbers = st.floats(allow_nan=True, allow_infinity=True)
known = st.floats(allow_nan=False, allow_infinity=False)
NAMED = ("time_ns", "yaw_deg", "pitch_deg", "roll_deg", "agl_m", "prior", "vel_en_mps", "below")
OPTIONAL = [each.name for each in fields(Telemetry) if each.name not in NAMED]


@given(
    st.integers(-(2**62), 2**62),
    st.tuples(*[numbers] * 4),
    st.fixed_dictionaries(dict.fromkeys(OPTIONAL, st.none() | numbers)),
    st.none() | st.tuples(known, known, known),
    st.none() | st.tuples(numbers, numbers),
    st.none() | st.builds(Ground, known, known, known),
)
def test_telemetry_comes_back_exactly(time_ns, four, others, prior, velocity, below):
    """All fields that there are, also those that come later."""
    prior = prior and Prior.known(*prior)
    before = Telemetry(time_ns, *four, prior=prior, vel_en_mps=velocity, below=below, **others)
    after = view_of(telemetry_message(LoggedView(3, 5, "ä/b.png", before, "full")))
    assert (after.index, after.number, after.frame, after.picture) == (3, 5, "ä/b.png", "full")
    assert repr(after.telemetry) == repr(before)


# What is missing


def test_files_in_order_and_missing_ones_cause_a_warning(tmp_path):
    short_log(tmp_path, range(40), segment_bytes=80_000)
    files = sorted(tmp_path.iterdir())
    assert len(files) >= 3
    for named in (tmp_path, files[0]):
        opened = open_source(named)
        assert opened.kind == "log" and opened.warnings == () and opened.expected == 40
        for index, view in enumerate(opened.views):
            assert np.array_equal(view.grey(), picture(index))
            assert repr(view.telemetry) == repr(telemetry(index))
    files[0].unlink()
    warnings = open_source(tmp_path).warnings
    assert len(warnings) == 1 and "are not in the log" in warnings[0]
    files[1].rename(files[0])
    files[2].unlink()
    assert any("left out" in line or "later" in line for line in open_source(tmp_path).warnings)


def test_two_flights_in_a_folder(tmp_path):
    short_log(tmp_path)
    short_log(tmp_path, range(7))
    assert open_source(tmp_path / "flight_0001.mcap").expected == 5
    assert open_source(tmp_path / "flight_0002.mcap").expected == 7
    with pytest.raises(FlightError, match=r"2 flights.*flight_0001\.mcap, flight_0002\.mcap"):
        open_source(tmp_path)


def test_an_image_unusable_in_flight_is_unusable_again(tmp_path):
    log = FlightLog(tmp_path / "flight.mcap", CAMERA, {})
    log.view(0, "0.png", picture(0), telemetry(0))
    log.view(1, "1.png", None, telemetry(1))
    log.close()
    opened = open_source(tmp_path / "flight_0001.mcap")
    first, second = opened.views
    assert first.grey().shape == (48, 64) and opened.warnings == ()
    with pytest.raises(FlightError, match="no usable image"):
        second.grey()


def test_a_view_without_its_image_is_left_out(tmp_path):
    dropped = reported(1, "b.png", "dropped")
    messages = [session(), reported(), shown(), dropped, reported(2, "c.png"), shown(2)]
    opened = open_source(crafted(tmp_path / "a.mcap", messages))
    assert [view.frame for view in opened.views] == ["a.png", "c.png"]
    assert opened.warnings[0].startswith("1 views lack a full image")


# Cut anywhere


def test_a_log_may_end_anywhere(tmp_path, content):
    data, ends = content
    path = tmp_path / "flight_0001.mcap"
    rng = np.random.default_rng(0)
    for cut in [*range(0, 60, 2), *rng.integers(60, len(data), 120), len(data) - 1]:
        path.write_bytes(data[:cut])
        whole = max((views for end, views in ends if end <= cut), default=0)
        try:
            opened = open_source(path)
        except FlightError:
            assert whole == 0
            continue
        views = list(opened.views)
        assert whole <= len(views) <= whole + 1  # a chunk may be whole where its index is not
        assert all(np.array_equal(v.grey(), picture(i)) for i, v in enumerate(views))
        assert [repr(v.telemetry) for v in views] == [
            repr(telemetry(index)) for index in range(len(views))
        ]
        assert (len(opened.warnings) == 1) == (cut < ends[-1][0] + 9)


@given(st.data())
@settings(max_examples=100, deadline=None)
def test_whatever_is_done_to_a_log_only_our_errors_come_out(tmp_path_factory, content, data):
    whole = content[0]
    path = tmp_path_factory.getbasetemp() / "broken_0001.mcap"
    first = data.draw(st.integers(0, len(whole)))
    last = data.draw(st.integers(first, min(len(whole), first + 200)))
    middle = data.draw(st.binary(max_size=40))
    path.write_bytes(whole[:first] + middle + whole[last:])
    try:
        for view in open_flight_log(path, SourceOptions()).views:
            assert np.array_equal(view.grey(), picture(int(view.frame[:6])))
    except OrthonavError:
        pass


# Made by somebody who means harm


BOMB = zeros(2**29, zstandard.ZstdCompressor(level=1).compressobj(size=2**29))
BOMBS = {
    "stated": chunk(BOMB, 2**29),
    "stated small": chunk(BOMB, 100),
    "stated huge": chunk(zstandard.compress(b"a" * 100), 2**62),
    "another size": chunk(zstandard.compress(b"a" * 100), 99),
    "no size": chunk(zstandard.ZstdCompressor(write_content_size=False).compress(b"a" * 9), 9),
    "lz4": chunk(b"\x04\x22\x4d\x18" + bytes(40), 100, b"lz4"),
    "long record": b"\x06" + struct.pack("<Q", 2**63),
    "long data": b"\x06" + struct.pack("<Q", 60) + bytes(24) + b"\xff" * 36,
    "wrong crc": chunk(b"a" * 100, 100, b"", crc=zlib.crc32(b"b")),
}


@pytest.mark.parametrize("how", BOMBS)
def test_decompression_bombs_are_rejected(tmp_path, content, how):
    path = tmp_path / "flight_0001.mcap"
    path.write_bytes(header(PROFILE.encode()) + BOMBS[how])
    tracemalloc.start()
    with pytest.raises(FlightError, match="no chunk of the flight log is complete"):
        open_source(path)
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()
    if how != "long record" and how != "long data":  # the others are passed over
        first = 17 + int.from_bytes(content[0][9:17], "little")
        path.write_bytes(content[0][:first] + BOMBS[how] + content[0][first:])
        assert open_source(path).expected == 5


def png(width, height, data=b"", before=b""):
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))]
    chunks += [(b"zTXt", before)] if before else []
    chunks += [(b"IDAT", data or zlib.compress(bytes(100))), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(part)) + kind + part + struct.pack(">I", zlib.crc32(kind + part))
        for kind, part in chunks
    )


PICTURES = {
    "gigapixels": png(60_000, 60_000, zlib.compress(bytes(10**6))),
    "another size": png(64, 49),
    "too few rows": png(64, 48),
    "a text first": png(64, 48, before=b"a\0\0" + zlib.compress(bytes(10**7))),
    "empty": b"",
    "text": b"no picture",
    "JPEG": b"\xff\xd8\xff\xe0" + bytes(100),
}
MESSAGES = {
    "nothing": b"",
    "a head": b"\0\1\0\0",
    "no length": b"\0\1\0\0" + b"\xff" * 40,
    "another encoding": bytes(64),
    **{name: picture_message(data, "png", 0) for name, data in PICTURES.items()},
}


@pytest.mark.parametrize("how", MESSAGES)
def test_invalid_images_are_rejected(tmp_path, monkeypatch, how):
    messages = [session(), reported(), (TOPICS.view, 0, MESSAGES[how])]
    (view,) = open_source(crafted(tmp_path / "a.mcap", messages)).views
    if how != "too few rows":  # OpenCV must not even see the others
        monkeypatch.setattr(png_module.cv2, "imdecode", None)
    with pytest.raises(FlightError, match=r"a\.png"):
        view.grey()


NAMES = ["../a", "/a", "a/../../b", ".", "", "a\\b", "a\0", "a\n", "a" * 300, "a//b", "./a"]


@pytest.mark.parametrize("frame", NAMES)
def test_no_frame_leaves_its_folder(tmp_path, run, names_in, frame):
    crafted(tmp_path / "a.mcap", [session(), reported(frame=frame), shown()])
    done = run("import", tmp_path / "a.mcap", "--out", tmp_path / "in" / "flight")
    assert done.code == 1 and done.err.count("\n") == 1 and "not a valid name of a view" in done.err
    assert [name for name in names_in(tmp_path) if not name.startswith(("a.mcap", "in"))] == []


@pytest.mark.parametrize("data", [b"", b"[]", b"{}", b"{" * 10**5, b"[" * 10**5, b'{"frame":1}',
                                  b"9" * 10**5, b"\xff\xfe", b" " * (2**20 + 1)])  # fmt: skip
def test_invalid_telemetry_is_left_out(tmp_path, data):
    messages = [
        session(),
        reported(),
        shown(),
        (TOPICS.telemetry, 1, data),
        reported(2, "c.png"),
        shown(2),
    ]
    opened = open_source(crafted(tmp_path / "a.mcap", messages))
    assert opened.expected == 2 and "1 messages are damaged" in opened.warnings[0]


@pytest.mark.parametrize(
    "changes",
    [{"agl_m": "270"}, {"agl_m": "inf"}, {"agl_m": True}, {"agl_m": [1]}, {"agl_m": 10**400},
     {"yaw_std_deg": "2"}, {"vel_en_mps": [1, 2, 3]}, {"vel_en_mps": [1]}, {"vel_en_mps": "12"},
     {"camera_latency_ms": "9"}, {"prior": {"lat_deg": True, "lon_deg": 1, "std_m": 1}}],
)  # fmt: skip
def test_only_numbers_are_numbers(changes):
    plain = json.loads(reported()[2])
    assert view_of(json.dumps(plain).encode()).telemetry == telemetry(0)
    with pytest.raises(FlightError, match="telemetry of the log is damaged"):
        view_of(json.dumps(plain | changes).encode())
    beyond = json.dumps(plain | {"agl_m": 1234.5}).replace("1234.5", "1e999")
    with pytest.raises(FlightError, match="not a number"):
        view_of(beyond.encode())


@pytest.mark.parametrize(
    "changes",
    [{"width_px": 0}, {"width_px": 2**70}, {"fx_px": "NaN"}, {"fx_px": None}, {"distortion": 3},
     {"distortion": [0.1] * 10**4}, {"model": []}],
)  # fmt: skip
def test_invalid_cameras_are_rejected(tmp_path, changes):
    camera = {**CAMERA.numbers(), **changes}
    with pytest.raises(OrthonavError, match=r"a\.mcap"):
        open_source(crafted(tmp_path / "a.mcap", [session(camera=camera), reported(), shown()]))


@pytest.mark.parametrize(
    "messages, words",
    [
        ([session(format=3), reported(), shown()], r"format 3.*update orthonav"),
        ([session(format=1), reported(), shown()], r"format 1.*images are stored in another way"),
        ([session(), reported(), shown(), reported(1), shown(1)], "appears twice"),
        ([session(), *(reported(n, f"{n}.png") for n in range(5)), shown()], "more than 3 views"),
        ([session(), reported(), shown(), *[(TOPICS.health, 0, b"")] * 60], "more than 3 views"),
    ],
)
def test_logs_that_cannot_be_read_are_named(tmp_path, monkeypatch, messages, words):
    monkeypatch.setattr(flightlog_module, "MAX_VIEWS", 3)
    monkeypatch.setattr(flightlog_module, "MAX_MESSAGES", 50)
    with pytest.raises(FlightError, match=words):
        open_source(crafted(tmp_path / "a.mcap", messages))


def test_only_flight_logs_are_detected_as_logs(tmp_path, content):
    other = crafted(tmp_path / "a.mcap", [session()], profile="ros2")
    assert source_kind(other) == "ros"
    renamed = tmp_path / "flight.bin"
    renamed.write_bytes(content[0])
    assert source_kind(renamed) == "log" and open_source(renamed).expected == 5
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"")
    with pytest.raises(FlightError):
        open_source(empty)
