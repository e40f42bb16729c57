"""Autopilots' logs: PX4 ULog, ArduPilot DataFlash and telemetry logs, joined by time."""

import math
import struct

import numpy as np
import pytest
import recorders
from recorders import (
    START_S,
    camera_file,
    dataflash,
    flown,
    photo,
    px4_topics,
    quaternion_wxyz,
    record,
    sent,
    tlog,
    ulog,
    video,
)

from orthonav.core.errors import FlightError
from orthonav.core.tilt import MOUNT_STD_DEG
from orthonav.ground.recordings import SourceOptions, import_flight, open_source
from orthonav.ground.recordings.logs import read_log
from orthonav.ground.recordings.telemetry_track import angles_at

DOWN = (0.0, 0.0, 0.0)
WRITERS = {
    "ulog": lambda path: ulog(path, px4_topics()),
    "dataflash": dataflash,
    "tlog": tlog,
}


@pytest.fixture(params=WRITERS)
def kind(request):
    return request.param


@pytest.fixture
def log(kind, tmp_path):
    return WRITERS[kind](tmp_path / "flight.log")


def test_attitude_position_and_velocity(kind, log):
    """In UTC by the GPS; a hundredth of a degree is what DataFlash holds."""
    track = read_log(log, DOWN)
    for t, yaw, pitch, roll in flown():
        angles = angles_at(track.attitude, (START_S * 1000 + round(t * 1000)) * 10**6)
        assert math.remainder(angles[0] - yaw, 360) == pytest.approx(0, abs=0.02)
        assert angles[1:] == pytest.approx((pitch, roll), abs=0.02)
    at = (START_S + 3) * 10**9
    assert track.latlon_deg(at) == pytest.approx((46.5, 2.5), abs=1e-7)
    velocity = {"ulog": (-1, 3), "dataflash": (5, 0), "tlog": (3, -1)}[kind]
    assert track.telemetry(at).vel_en_mps == pytest.approx(velocity, abs=1e-6)
    assert track.telemetry(at).horizon_std_deg == pytest.approx(1.0)  # GNSS aids it
    assert track.telemetry(at).mount_std_deg == MOUNT_STD_DEG


@pytest.mark.parametrize(
    "kind, early, late, home",
    [("ulog", 93, 400 + 9 - 280, 123), ("dataflash", 95.5, 119, 113), ("tlog", 108, 114, 108)],
)
def test_heights_are_of_the_distance_sensor_where_it_is_sound(kind, early, late, home, tmp_path):
    track = read_log(WRITERS[kind](tmp_path / "log"), DOWN)
    first, last = (track.telemetry((START_S + t) * 10**9) for t in (3, 9))
    assert (first.agl_m, last.agl_m, first.home_m) == pytest.approx((early, late, home), abs=0.01)
    assert first.amsl_m == pytest.approx(400, abs=0.01) and first.hae_m is None


def test_newer_px4_names(tmp_path):
    topics = px4_topics()
    rows = [(row[0], row[1], 46.5, 2.5, 400.0, 3) for row in topics.pop("vehicle_gps_position")[1]]
    topics["sensor_gps"] = (
        "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg"
        ";double altitude_msl_m;uint8_t fix_type",
        rows,
    )
    track = read_log(ulog(tmp_path / "a.ulg", topics), DOWN)
    assert track.latlon_deg(START_S * 10**9) == (46.5, 2.5)
    assert track.origin_ns == START_S * 10**9


def test_logs_without_gps_count_from_boot(tmp_path):
    topics = px4_topics(sensor=False)
    for name in ("vehicle_gps_position", "vehicle_global_position", "home_position"):
        del topics[name]
    track = read_log(ulog(tmp_path / "a.ulg", topics), DOWN)
    assert track.origin_ns == 5 * 10**9 and track.latlon_deg(6 * 10**9) is None
    assert track.telemetry(6 * 10**9).agl_m == pytest.approx(101)  # above its origin
    assert track.telemetry(6 * 10**9).horizon_std_deg == pytest.approx(3.0)
    del (estimated := px4_topics())["vehicle_gps_position"]
    track = read_log(ulog(tmp_path / "b.ulg", estimated), DOWN)
    assert track.latlon_deg(6 * 10**9) == (46.5, 2.5)  # the estimator's own, which aids nothing
    assert track.warnings == ("positions are an estimate: the log has no receiver",)
    assert track.telemetry(6 * 10**9).horizon_std_deg == pytest.approx(3.0)
    ardupilot = read_log(dataflash(tmp_path / "a.bin", gps=False), DOWN)
    assert ardupilot.origin_ns == 3 * 10**9
    assert ardupilot.telemetry(4 * 10**9).horizon_std_deg == pytest.approx(1.0)


def test_attitude_as_a_quaternion_in_a_tlog(tmp_path):
    message = "attitude_quaternion", 0, *quaternion_wxyz(200, 5, -3), 0, 0, 0
    data = (sent((7, 0), step / 10, message, old=step % 2 == 0) for step in range(20))
    (tmp_path / "a.tlog").write_bytes(b"".join(data))
    track = read_log(tmp_path / "a.tlog", DOWN)
    assert len(track.attitude.time_ns) == 20
    assert angles_at(track.attitude, START_S * 10**9) == pytest.approx((200, 5, -3), abs=1e-4)


def test_damage_between_messages_costs_only_those(kind, log):
    data = log.read_bytes()
    cut = int(len(data) * 0.6)
    log.write_bytes(data[:cut] + bytes(range(1, 200)) + data[cut + 100 :])
    track = read_log(log, DOWN)
    assert len(track.attitude.time_ns) > 55
    assert track.span_ns()[0] == pytest.approx(START_S * 10**9, abs=10**7)


def test_a_log_that_was_cut_tells_what_came_before(kind, log):
    data = log.read_bytes()
    log.write_bytes(data[: len(data) // 2])
    assert 30 < len(read_log(log, DOWN).attitude.time_ns) < 70
    if kind == "ulog":
        log.write_bytes(data[: len(data) // 2] + bytes(len(data) // 2))
        (warning,) = read_log(log, DOWN).warnings
        assert warning.startswith("log is damaged: views from ")


def appended(path, sender, *messages, t=0.0):
    """Messages of a sender (system, component) at the end of a telemetry log."""
    with path.open("ab") as stream:
        stream.write(sent(sender, t, *messages))
    return path


GIMBAL = 1, 154


@pytest.mark.parametrize("heartbeats", [False, True])
def test_a_gimbal_in_a_tlog_is_not_the_aircraft(tmp_path, heartbeats):
    path = tlog(tmp_path / "a.tlog")
    alone = read_log(path, DOWN).attitude
    if heartbeats:
        appended(path, (1, 1), ("heartbeat", 2, 3, 0, 0, 4, 3))
        appended(path, GIMBAL, ("heartbeat", 26, 0, 0, 0, 4, 3))  # as if an autopilot
    for step in range(40):
        t = step / 10 + 0.03
        appended(path, GIMBAL, ("attitude", round(t * 1000), 0.0, -1.5, 1.0, 0, 0, 0), t=t)
    track = read_log(path, DOWN)
    assert np.array_equal(track.attitude.values, alone.values)
    assert "attitude: using ATTITUDE[1:1], not ATTITUDE[1:154]: first" in track.choices[0]
    track = read_log(path, DOWN, {"attitude": "ATTITUDE[1:154]"})
    assert len(track.attitude.time_ns) == 40 and track.choices == ()
    assert track.latlon_deg((START_S + 3) * 10**9) is not None  # of the autopilot
    with pytest.raises(FlightError, match=r"no GPS for position; available: GPS_RAW_INT: "):
        read_log(path, DOWN, {"position": "GPS"})
    only = appended(tmp_path / "b.tlog", GIMBAL, ("attitude", 0, 0.0, -1.5, 1.0, 0, 0, 0))
    with pytest.raises(FlightError, match=r"no attitude; .* none fits of ATTITUDE\[1:154\]"):
        read_log(only, DOWN)


@pytest.mark.parametrize("autopilot, home_m", [(12, None), (3, 12.0)])
def test_a_height_in_a_tlog_that_repeats_that_above_the_sea(tmp_path, autopilot, home_m):
    """PX4 without a home sends it as the height above home."""
    path = tmp_path / "a.tlog"
    for t in (0.0, 0.5):
        appended(
            path,
            (1, 1),
            ("heartbeat", 2, autopilot, 0, 0, 4, 3),
            ("attitude", 0, 0.1, 0.0, 1.0, 0, 0, 0),
            ("global_position_int", 0, 465_000_000, 25_000_000, 12_000, 12_000, 0, 0, 0, 0),
            t=t,
        )
    assert read_log(path, DOWN).telemetry(START_S * 10**9).home_m == home_m


def test_distances_in_a_tlog(tmp_path):
    """Ahead, with a bad signal, and RANGEFINDER beside them, which knows no limits."""
    path = tlog(tmp_path / "a.tlog")
    for t in range(10):
        common = 0, 20, 12_000
        appended(
            path,
            (1, 1),
            ("rangefinder", 120.0, 1.0),
            ("distance_sensor", *common, 300, 0, 1, 0, 255),
            ("distance_sensor", *common, 300, 0, 2, 25, 255, 0, 0, [0] * 4, 1),
            ("distance_sensor", *common, 9000 if t < 5 else 12_000, 0, 3, 25, 255),
            ("rangefinder", 120.0, 1.0),
            t=float(t),
        )
    track = read_log(path, DOWN)
    assert track.telemetry((START_S + 3) * 10**9).agl_m == 90
    assert track.telemetry((START_S + 9) * 10**9).agl_m == 114  # above home
    assert "height: using DISTANCE_SENSOR[3], not DISTANCE_SENSOR[1] (no valid" in track.choices[0]


def test_a_second_rangefinder_is_used_where_the_first_has_no_height(tmp_path):
    path = dataflash(tmp_path / "a.bin")  # the first is valid for 5 s
    later = (record("RFND", us, 1, 6_000, 4, 25) for us in range(9_000_000, 13_000_000, 200_000))
    path.write_bytes(path.read_bytes() + b"".join(later))
    track = read_log(path, DOWN)
    heights = [track.telemetry((START_S + s) * 10**9).agl_m for s in (3, 8)]
    assert heights == [95.5, 60] and "RFND[0], in its gaps RFND[1]" in track.choices[0]


def test_a_receiver_with_fewer_positions_a_second_is_as_good(tmp_path):
    path = dataflash(tmp_path / "a.bin", gps=False)
    slow, fast = (
        b"".join(record("GPS", *gps(us, 3, *fix)) for us in range(3_000_000, 13_000_000, step_us))
        for fix, step_us in (((465_000_000, 0), 500_000), ((475_000_000, 1), 100_000))
    )
    path.write_bytes(path.read_bytes() + fast + slow)
    assert read_log(path, DOWN).latlon_deg((START_S + 5) * 10**9) == (46.5, 2.5)


def gps(us, fix_type, lat_e7, instance=0):
    place = lat_e7, 25_000_000, 40_000
    return us, instance, fix_type, 252_818_000, 2288, 12, 80, *place, 5.0, 90.0, 0.0, 0.0, 1


def test_the_receiver_with_a_fix_in_a_dataflash_log(tmp_path):
    path = dataflash(tmp_path / "a.bin", gps=False)
    times = range(3_000_000, 13_000_000, 200_000)
    first, second = (
        b"".join(record("GPS", *gps(us, *fix)) for us in times)
        for fix in ((1, 0, 0), (3, 465_000_000, 1))
    )
    path.write_bytes(path.read_bytes() + first + second)
    track = read_log(path, DOWN)
    at = int(track.attitude.time_ns[10])
    assert track.latlon_deg(at) == (46.5, 2.5) and track.telemetry(at).vel_en_mps is not None
    assert "position: using GPS[1], not GPS[0] (no valid message): first" in track.choices[0]
    with pytest.raises(FlightError, match=r"GPS\[0\] has no valid message for position: "):
        read_log(path, DOWN, {"position": "GPS[0]"})
    with pytest.raises(FlightError, match=r"no GPS\[2\] .*available: GPS\[0\], GPS\[1\]: "):
        read_log(path, DOWN, {"position": "GPS[2]"})
    with pytest.raises(FlightError, match="logs have no sources of velocity: "):
        read_log(path, DOWN, {"velocity": "GPS[1]"})


def test_rangefinders_of_ardupilot_3_6(tmp_path, monkeypatch):
    old = 132, "QCBCB", "TimeUS,Dist1,Orient1,Dist2,Orient2"
    monkeypatch.setitem(recorders.DATAFLASH, "RFND", old)
    monkeypatch.setattr(recorders, "rangefinder", lambda us, t: (us, 300, 0, 9_550, 25))
    track = read_log(dataflash(tmp_path / "a.bin"), DOWN)
    assert track.telemetry((START_S + 3) * 10**9).agl_m == 95.5
    assert "height: using RFND[1], not RFND[0] (no valid message)" in track.choices[0]


@pytest.mark.parametrize("write", [dataflash, tlog])
def test_an_attitude_of_zeros_is_none(tmp_path, monkeypatch, write):
    monkeypatch.setattr(recorders, "flown", lambda seconds: [(t, 0, 0, 0) for t in range(9)])
    with pytest.raises(FlightError, match="has no attitude"):
        read_log(write(tmp_path / "a.log"), DOWN)


def test_instances_of_a_ulog(tmp_path):
    """A second receiver has the fix, a second sensor looks down; an identity is no attitude."""
    topics = px4_topics(sensor=False)
    fields, fixes = topics.pop("vehicle_gps_position")
    topics["sensor_gps"] = fields, [(*row[:2], 10_000_000, 10_000_000, 0, 1) for row in fixes]
    topics["sensor_gps:1"] = fields, fixes
    sensor = "uint64_t timestamp;float current_distance;uint8_t orientation;int8_t signal_quality"
    times = [row[0] for row in fixes]
    topics["distance_sensor"] = sensor, [(t, 3.0, 0, -1) for t in times]
    topics["distance_sensor:1"] = sensor, [(t, 70.0, 25, 0) for t in times]
    topics["distance_sensor:2"] = sensor, [(t, 80.0, 25, -1) for t in times]
    fields, attitudes = topics["vehicle_attitude"]
    topics["vehicle_attitude"] = fields, [(row[0], 1.0, 0.0, 0.0, 0.0) for row in attitudes]
    topics["vehicle_attitude:1"] = fields, attitudes
    path = ulog(tmp_path / "a.ulg", topics)
    track, at = read_log(path, DOWN), (START_S + 3) * 10**9
    assert track.latlon_deg(at) == (46.5, 2.5) and track.telemetry(at).agl_m == 80
    assert angles_at(track.attitude, at)[0] == pytest.approx(2, abs=0.02)
    for role, used in (
        ("attitude", "vehicle_attitude[1], not vehicle_attitude[0] (no valid message)"),
        ("position", "sensor_gps[1], not sensor_gps[0] (no valid message)"),
        ("height", "distance_sensor[2], not distance_sensor[0] (no valid message), distance_"),
    ):
        assert any(line.startswith(f"{role}: using {used}") for line in track.choices)
    with pytest.raises(FlightError, match=r"distance_sensor\[1\] has no valid message"):
        read_log(path, DOWN, {"height": "distance_sensor[1]"})


def test_a_log_behind_a_ulog_is_not_read(tmp_path):
    path = ulog(tmp_path / "a.ulg", px4_topics(seconds=5))
    first = path.read_bytes()
    later = ulog(tmp_path / "b.ulg", px4_topics(seconds=9, boot_us=10**9)).read_bytes()
    path.write_bytes(first + later)
    track = read_log(path, DOWN)
    assert len(track.attitude.time_ns) == 51
    (warning,) = track.warnings
    assert f"followed by another one from byte {len(first)} on: views from 5.0 s on" in warning


@pytest.fixture
def photographs(tmp_path):
    """Three photographs, 2 s apart, by a clock without a zone that is 1.5 s slow."""
    for second in (0, 2, 4):
        time = f"2023:11:14 22:13:2{second}"
        photo(tmp_path / f"photos/{second}.jpg", time, more={0x9291: "50"}, seed=second)
    return tmp_path / "photos"


def test_photographs_with_a_log(photographs, log, tmp_path):
    with pytest.raises(FlightError, match="give --time-offset-s"):
        open_source(photographs, SourceOptions(telemetry=log, time_offset_s=3600.0))
    options = SourceOptions(telemetry=log, time_offset_s=1.5, prior_std_m=20.0)
    done = import_flight(open_source(photographs, options), tmp_path / "flight")
    assert (done.views, done.complete, done.with_truth) == (3, 3, 3)
    for view, second in zip(open_source(photographs, options).views, (0, 2, 4), strict=True):
        telemetry = view.telemetry
        assert telemetry.time_ns == (START_S + second + 2) * 10**9
        assert telemetry.yaw_deg == pytest.approx((358 + 4 * second) % 360, abs=0.02)
        assert telemetry.prior.std_m == 20 and math.isfinite(telemetry.agl_m)


def test_a_video_counts_from_the_first_attitude(log, tmp_path):
    path = video(tmp_path / "a.mkv")
    camera = camera_file(tmp_path / "camera.json")
    options = SourceOptions(camera=camera, telemetry=log, time_offset_s=2.0)
    views = list(open_source(path, options).views)
    assert [view.telemetry.time_ns for view in views] == [
        (START_S + second) * 10**9 for second in (2, 3, 4)
    ]
    headings = [view.telemetry.yaw_deg for view in views]
    assert headings == pytest.approx([358, 2, 6], abs=0.02)


HEADER = "time_s,pitch_deg,roll_deg"
NOISE = np.random.default_rng(0).bytes(4000)
ULOG, TLOG = b"ULog\x01\x12\x35\x01", struct.pack(">QB", START_S * 10**6, 0xFD)
NO_ATTITUDE = {name: rows for name, rows in px4_topics().items() if name != "vehicle_attitude"}
BROKEN = {
    "ulog without attitude": (lambda p: ulog(p, NO_ATTITUDE), "PX4 log has no attitude"),
    "ulog header": (lambda p: p.write_bytes(ULOG + bytes(8)), "PX4 log"),
    "ulog of noise": (lambda p: p.write_bytes(ULOG + NOISE), "PX4 log"),
    "dataflash without attitude": (lambda p: dataflash(p, attitude=False), "log has no attitude"),
    "dataflash of noise": (lambda p: p.write_bytes(b"\xa3\x95\x80" + NOISE), "ArduPilot log"),
    "tlog without attitude": (lambda p: tlog(p, attitude=False), "telemetry log has no attitude"),
    "tlog of noise": (lambda p: p.write_bytes(TLOG + NOISE), "telemetry log has no attitude"),
    "empty": (lambda p: p.touch(), "telemetry log is empty"),
    "text": (lambda p: p.write_text("what happened on this flight"), "expected a PX4 log"),
    "no angles": (lambda p: p.write_text("time_s,agl_m\n1,1\n"), "missing: pitch_deg, roll_deg"),
    "a table of nothing": (lambda p: p.write_text(f"{HEADER}\n1,,\n"), "no line with pitch and"),
}


@pytest.mark.parametrize("how", BROKEN)
def test_what_is_broken_is_one_error(tmp_path, how, capfd):
    write, words = BROKEN[how]
    write(path := tmp_path / "log")
    with pytest.raises(FlightError, match=words) as caught:
        read_log(path, DOWN)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    print("heard")
    assert capfd.readouterr() == ("heard\n", "")
