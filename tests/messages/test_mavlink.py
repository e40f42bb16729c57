"""MAVLink messages: as recorded here, and as a decoder other than pymavlink reads them.

The decoder is that of `wire`.
"""

import hashlib
import math
import sys
from dataclasses import replace

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from orthonav.core.errors import MissingExtraError
from orthonav.onboard.messages.estimate import EstimateError, NavigationEstimate
from orthonav.onboard.messages.mavlink import (
    Autopilot,
    LocalPose,
    Origin,
    Packer,
    Signing,
    Target,
    dialect,
    external_position_estimate,
    global_position_sensor,
    gps_input,
    north_east_m,
    odometry,
    set_gps_global_origin,
    signing_timestamp,
    status_texts,
    vision_position_estimate,
)
from wire import SIZES, TABLES, decode, layout

UTC_NS = 1_789_000_000_123_456_789
ESTIMATE = NavigationEstimate(
    48.1234567,
    -4.3210987,
    np.array([[16.0, 3.0], [3.0, 9.0]]),
    0.95,
    utc_ns=UTC_NS,
    time_ns=61_500_000_000,
    processing_s=0.08,
    vel_en_mps=(12.0, -3.5),
    state="tracking",
    reset_counter=3,
)
WITH_ALTITUDE = replace(ESTIMATE, alt_amsl_m=134.5, alt_std_m=2.5)
EPH = math.sqrt(12.5 + math.sqrt(3.5**2 + 3.0**2))
POSE = LocalPose(
    Origin(48.1, -4.3, 90.0),
    down_m=-120.0,
    down_std_m=2.0,
    attitude_rad=(0.01, -0.02, 1.5),
    attitude_std_rad=(0.01, 0.01, 0.05),
    vel_down_mps=0.1,
    vel_down_std_mps=0.2,
)
LOW_CONFIDENCE = (
    {"confidence": 0.89},
    {"confidence": math.nan},
    {"state": "lost"},
    {"cov_en_m2": np.full((2, 2), math.nan)},
)
SIGNING = Signing(bytes(range(32)), signing_timestamp(UTC_NS))
GOLDEN = {
    "global_position_sensor": """
        fd2800000001c5280100c0ea8305165b060080380100870eaf1c15a76cfd0000c07f0000c07f5b5d84400000
        c07f01010102ee54
    """,
    "gps_input": """
        fd3e00000001c5e8000040b28205165b0600cb20b214870eaf1c15a76cfd0080064300ff7f4700ff7f470000
        60c00000404100000000000000005b5d8440000020403600830900038d2d
    """,
    "external_position_estimate": """
        fd2000000001c54b0000fa56503e0ad7a33d5b5d844000000000870eaf1c15a76cfd0000c07ffba70101fee0
    """,
    "odometry_px4": """
        fde900000001c54b010040b28205165b0600b10723451bc2c3c40000f0c2bb4a3b3ff79c2b3c451480bb7c7f
        2e3f000060c000004041cdcccc3d0000c07f0000c07f0000c07f000010410000404000000000000000000000
        00000000000000008041000000000000000000000000000000000000804000000000000000000000000017b7
        d138000000000000000017b7d138000000000ad7233b0000c07f0000c07f0000c07f0000c07f0000c07f0000
        c07f0000c07f0000c07f0000c07f0000c07f0000c07f0000c07f0000c07f0000c07f0000c07f0000c07f0000
        c07f0000c07f0000c07f0000c07f0000c07f010103025fa9a5
    """,
    "odometry_ardupilot": """
        fde900000001c54b010040b28205165b0600c43223456905c4c40000f0c2bb4a3b3ff79c2b3c451480bb7c7f
        2e3f608d3b4122d58a40fa1c36be0000c07f0000c07f0000c07f1681b6400000000000000000000000000000
        0000000000001681b640000000000000000000000000000000001681b64000000000000000000000000017b7
        d138000000000000000017b7d138000000000ad7233b0000c07f0000c07f0000c07f0000c07f0000c07f0000
        c07f0000c07f0000c07f0000c07f0000c07f0000c07f0000c07f0000c07f0000c07f0000c07f0000c07f0000
        c07f0000c07f0000c07f0000c07f0000c07f140c03025f7c46
    """,
    "vision_position_estimate": """
        fd7500000001c566000040b28205165b0600b10723451bc2c3c40000f0c20ad7233c0ad7a3bc0000c03f0000
        1041000040400000000000000000000000000000000000008041000000000000000000000000000000000000
        804000000000000000000000000017b7d138000000000000000017b7d138000000000ad7233b037319
    """,
    "set_gps_global_origin": """
        fd0d00000001c5300000407aab1c40df6ffd905f010001c42f
    """,
}


def sent(message, **packer):
    return decode(Packer(**packer).pack(message))


def has(read, **expected):
    """Whether a message has these values: integers exactly, others in single precision."""
    floats = {name: value for name, value in expected.items() if isinstance(value, float)}
    near = {name: pytest.approx(value, rel=1e-6, nan_ok=True) for name, value in floats.items()}
    return {name: read[name] for name in expected} == {**expected, **near}


MADE = {
    "global_position_sensor": lambda: global_position_sensor(ESTIMATE),
    "gps_input": lambda: gps_input(WITH_ALTITUDE),
    "external_position_estimate": lambda: external_position_estimate(ESTIMATE),
    "odometry_px4": lambda: odometry(ESTIMATE, POSE, Autopilot.PX4),
    "odometry_ardupilot": lambda: odometry(ESTIMATE, POSE, Autopilot.ARDUPILOT),
    "vision_position_estimate": lambda: vision_position_estimate(ESTIMATE, POSE, Autopilot.PX4),
    "set_gps_global_origin": lambda: set_gps_global_origin(POSE.origin),
}


@pytest.mark.parametrize("name", MADE)
def test_frames_are_as_recorded_and_as_an_independent_decoder_reads_them(name):
    message = MADE[name]()
    assert Packer().pack(message).hex() == "".join(GOLDEN[name].split())
    read = sent(message, sequence=255)
    assert (read["sequence"], read["from"], read["signed"]) == (255, (1, 197), 0)
    for field in message.get_fieldnames():
        expected, found = np.float32(getattr(message, field)), np.float32(read[field])
        np.testing.assert_array_equal(expected, found, err_msg=field)


def test_the_definitions_have_not_changed():
    for number, (name, seed, table) in TABLES.items():
        known = dialect().mavlink_map[number]
        fields, _ = layout(table)
        assert (known.msgname, known.crc_extra) == (name, seed)
        assert known.ordered_fieldnames == [field for _, field, _ in fields]
        assert known.unpacker.size == sum(SIZES[kind] * (count or 1) for kind, _, count in fields)


def test_a_global_position_has_all_known_values():
    read = sent(global_position_sensor(ESTIMATE, target=Target(9, 1)))
    assert has(read, target_system=9, target_component=1, id=1, source=2, flags=0, eph=EPH)
    assert has(read, lat=481234567, lon=-43210987, alt_ellipsoid=math.nan, alt=math.nan)
    assert (read["time_usec"], read["processing_time"]) == (UTC_NS // 1000 + 80_000, 80_000)
    assert math.isnan(read["epv"])
    assert has(sent(global_position_sensor(WITH_ALTITUDE)), alt=134.5, epv=2.5)


def test_a_gps_input_marks_what_is_not_known():
    read = sent(gps_input(ESTIMATE, gps_id=1))
    assert has(read, fix_type=3, gps_id=1, satellites_visible=0, vn=-3.5, ve=12.0, vd=0.0)
    assert has(read, lat=481234567, lon=-43210987, alt=0.0, horiz_accuracy=EPH)
    assert has(read, ignore_flags=1 | 2 | 4 | 16 | 32 | 128, hdop=65535, vdop=65535, yaw=0)
    assert read["time_usec"] == UTC_NS // 1000  # of exposure
    assert (read["time_week"], read["time_week_ms"]) == (2435, (4 * 86400 + 1600 + 18) * 1000 + 123)


def test_a_gps_input_has_all_known_values():
    estimate = replace(WITH_ALTITUDE, vel_cov_en=np.diag([0.04, 0.09]))
    read = sent(gps_input(estimate))
    assert has(read, ignore_flags=2 | 4 | 16, alt=134.5, vert_accuracy=2.5, speed_accuracy=0.3)
    assert sent(gps_input(replace(estimate, vel_en_mps=None)))["ignore_flags"] & 8


@pytest.mark.parametrize("change", LOW_CONFIDENCE)
def test_a_gps_input_of_low_confidence_is_no_fix(change):
    read = sent(gps_input(replace(ESTIMATE, **change)))
    assert has(read, fix_type=1, ignore_flags=255, horiz_accuracy=0.0, hdop=65535)
    assert has(read, lat=0, lon=0, alt=0, vn=0, ve=0, yaw=0)


def test_a_single_fix_is_a_command():
    read = sent(external_position_estimate(ESTIMATE))
    assert has(read, command=43003, frame=0, x=481234567, y=-43210987, z=math.nan)
    assert has(read, param2=0.08, param3=EPH)
    assert read["param1"] == pytest.approx((UTC_NS / 1e9 + 0.08) % 250, abs=1e-3)
    late = replace(ESTIMATE, utc_ns=250 * 10**9 - 60_000_000)
    wrapped = sent(external_position_estimate(late))
    assert wrapped["param1"] == pytest.approx(0.02, abs=1e-5)


@pytest.mark.parametrize("change", LOW_CONFIDENCE)
@pytest.mark.parametrize(
    "make",
    [
        global_position_sensor,  # PX4 reads no flag, and would take unknown coordinates for a place
        external_position_estimate,
        lambda estimate: odometry(estimate, POSE, Autopilot.PX4),
        lambda estimate: vision_position_estimate(estimate, POSE, Autopilot.PX4),
    ],
)
def test_messages_that_cannot_mark_low_confidence_are_not_made(make, change):
    with pytest.raises(EstimateError, match="cannot mark"):
        make(replace(ESTIMATE, **change))


@pytest.mark.parametrize("length", [0, 12, 50, 51, 99, 100, 130])
def test_texts_of_any_length_arrive_whole(length):
    text = ("0123456789" * 13)[:length]
    read = [sent(each) for each in status_texts(4, text, 65534)]
    assert b"".join(each["text"].rstrip(b"\0") for each in read) == text.encode()
    assert [each["chunk_seq"] for each in read] == [*range(len(read))]
    assert len({each["id"] for each in read}) == 1 and {each["severity"] for each in read} == {4}
    single = length <= 50
    assert (read[0]["id"] == 0) == single and (len(read) == 1) == single
    assert single or len(read[-1]["text"].rstrip(b"\0")) < 50  # this ends the text


def test_odometry_for_px4_is_north_east_down():
    read = sent(odometry(ESTIMATE, POSE, Autopilot.PX4))
    x, y = north_east_m(POSE.origin, ESTIMATE.lat_deg, ESTIMATE.lon_deg, Autopilot.PX4)
    assert has(read, frame_id=1, child_frame_id=1, x=x, y=y, z=-120.0, vx=-3.5, vy=12.0, vz=0.1)
    assert has(read, reset_counter=3, estimator_type=2, quality=95, yawspeed=math.nan)
    cov = read["pose_covariance"]
    assert (cov[0], cov[1], cov[6], cov[11]) == (9.0, 3.0, 16.0, 4.0)
    assert (cov[15], cov[20]) == pytest.approx((1e-4, 2.5e-3))
    assert all(map(math.isnan, read["velocity_covariance"]))
    assert read["time_usec"] == UTC_NS // 1000


def test_odometry_for_ardupilot_has_its_velocity_in_the_body():
    estimate = replace(ESTIMATE, vel_cov_en=np.diag([0.25, 1.0]))
    read = sent(odometry(estimate, POSE, Autopilot.ARDUPILOT))
    ned_from_body = Rotation.from_euler("ZYX", POSE.attitude_rad[::-1])
    w, *xyz = read["q"]
    back = Rotation.from_quat([*xyz, w]).inv() * ned_from_body
    assert back.magnitude() == pytest.approx(0.0, abs=1e-6)
    vx, vy, vz = ned_from_body.inv().apply([-3.5, 12.0, 0.1])
    assert has(read, frame_id=20, child_frame_id=12)
    assert (read["vx"], read["vy"], read["vz"]) == pytest.approx((vx, vy, vz), rel=1e-5)
    pose, cov = read["pose_covariance"], np.zeros((6, 6))
    variances = np.array([pose[0], pose[6], pose[11]])
    assert math.sqrt(variances.sum()) == pytest.approx(EPH, rel=1e-6)  # as ArduPilot reads it
    assert np.cbrt((variances**2).sum()) >= EPH  # as older versions do
    turn = ned_from_body.as_matrix()
    cov[np.triu_indices(6)] = read["velocity_covariance"]
    expected = turn.T @ np.diag([1.0, 0.25, 0.04]) @ turn
    np.testing.assert_allclose(cov[:3, :3], np.triu(expected), atol=1e-6)


BARE = LocalPose(POSE.origin, down_m=-120.0, down_std_m=2.0)


def test_unknown_values_of_odometry_are_nan_for_px4():
    read = sent(odometry(ESTIMATE, BARE, Autopilot.PX4))
    assert all(map(math.isnan, read["q"])) and math.isnan(read["vz"])
    assert not math.isnan(read["pose_covariance"][11])


@pytest.mark.parametrize(
    ("make", "estimate", "pose", "autopilot", "said"),
    [
        (odometry, ESTIMATE, BARE, Autopilot.ARDUPILOT, "needs attitude and velocity"),
        (odometry, replace(ESTIMATE, vel_en_mps=None), POSE, Autopilot.ARDUPILOT, "velocity"),
        (odometry, ESTIMATE, replace(POSE, down_std_m=math.nan), Autopilot.PX4, "height"),
        (vision_position_estimate, ESTIMATE, BARE, Autopilot.PX4, "attitude"),
    ],
)
def test_local_messages_need_what_the_autopilot_cannot_do_without(
    make, estimate, pose, autopilot, said
):
    with pytest.raises(EstimateError, match=said):
        make(estimate, pose, autopilot)


def test_the_altitude_of_the_estimate_precedes_that_of_the_pose():
    read = sent(vision_position_estimate(WITH_ALTITUDE, POSE, Autopilot.PX4))
    roll, pitch, yaw = POSE.attitude_rad
    assert has(read, z=90.0 - 134.5, roll=roll, pitch=pitch, yaw=yaw, reset_counter=3)
    assert read["covariance"][11] == 6.25


places = st.tuples(st.floats(-90, 90), st.floats(-180, 180)) | st.sampled_from(
    [(90.0, 180.0), (-90.0, -180.0), (0.0, 180.0), (-0.0, -180.0)]
)


@given(places)
def test_any_position_round_trips_within_a_centimetre(place):
    estimate = replace(ESTIMATE, lat_deg=place[0], lon_deg=place[1])
    reads = [sent(global_position_sensor(estimate)), sent(gps_input(estimate))]
    command = sent(external_position_estimate(estimate))
    for lat, lon in [*((r["lat"], r["lon"]) for r in reads), (command["x"], command["y"])]:
        assert abs(lat - place[0] * 1e7) <= 0.5 + 1e-6
        assert abs(lon - place[1] * 1e7) <= 0.5 + 1e-6


anything = st.floats() | st.sampled_from([1e39, -1e39, math.nan, math.inf])
spans = st.floats(-1e15, 1e15)


@given(anything, anything, anything, anything, spans, st.integers(-(2**80), 2**80))
def test_values_are_clamped_not_wrapped(alt, alt_std, east, north, processing_s, utc_ns):
    estimate = replace(
        ESTIMATE,
        alt_amsl_m=alt,
        alt_std_m=abs(alt_std),
        vel_en_mps=(east, north),
        processing_s=processing_s,
        utc_ns=utc_ns,
        time_ns=0,
        cov_en_m2=np.eye(2) * 1e80,
    )
    read, gps = sent(global_position_sensor(estimate)), sent(gps_input(estimate, gps_id=999))
    sent_us = (utc_ns + round(processing_s * 1e9)) // 1000
    assert read["time_usec"] == min(max(sent_us, 0), 2**64 - 1)
    assert abs(read["processing_time"] - min(max(processing_s * 1e6, 0), 2**32 - 1)) <= 1
    assert gps["time_usec"] == min(max(utc_ns // 1000, 0), 2**64 - 1)
    assert gps["gps_id"] == 255 and read["eph"] == np.finfo(np.float32).max
    if math.isfinite(alt):
        assert read["alt"] == pytest.approx(np.clip(alt, -3.4028235e38, 3.4028235e38), rel=1e-6)
        assert not gps["ignore_flags"] & 1
    else:
        assert math.isnan(read["alt"]) and math.isnan(read["epv"]) and gps["ignore_flags"] & 1
    assert bool(gps["ignore_flags"] & 8) is not (math.isfinite(east) and math.isfinite(north))
    assert all(math.isfinite(gps[field]) for field in ("alt", "vn", "ve", "vert_accuracy"))
    if utc_ns < 315_964_800 * 10**9:
        assert (gps["time_week"], gps["time_week_ms"]) == (0, 0)
    assert gps["time_week_ms"] < 7 * 86_400_000


@given(st.floats(-80, 80), st.floats(-180, 180), st.floats(-20_000, 20_000), st.floats(-2e4, 2e4))
def test_px4_converts_back_to_the_fix(lat, lon, north, east):
    """By the inverse on the sphere, as the autopilot does it."""
    sphere = pyproj.Geod(a=6_371_000, b=6_371_000)
    azimuth = math.degrees(math.atan2(east, north))
    there_lon, there_lat, _ = sphere.fwd(lon, lat, azimuth, math.hypot(north, east))
    found = north_east_m(Origin(lat, lon, 0.0), there_lat, there_lon, Autopilot.PX4)
    assert found == pytest.approx((north, east), abs=1e-3)


@given(st.floats(-80, 80), st.floats(-180, 180), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_ardupilot_converts_degrees_by_a_constant(lat, lon, up, right):
    there = (lon + right + 180) % 360 - 180
    north, east = north_east_m(Origin(lat, lon, 0), lat + up, there, Autopilot.ARDUPILOT)
    per_degree = 1e7 * 0.011131884502145034
    assert north == pytest.approx(up * per_degree, abs=1e-4)
    scale = math.cos(math.radians(lat + up / 2))
    assert east == pytest.approx(right * per_degree * scale, abs=1e-4)


def test_a_signature_is_that_of_the_protocol():
    packer = Packer(signing=SIGNING)
    stamps = []
    for _ in range(2):
        frame = packer.pack(global_position_sensor(ESTIMATE))
        assert decode(frame)["signed"] == 1
        link_and_time, signature = frame[-13:-6], frame[-6:]
        expected = hashlib.sha256(SIGNING.secret_key + frame[:-6]).digest()[:6]
        assert signature == expected and link_and_time[0] == 0
        stamps.append(int.from_bytes(link_and_time[1:], "little"))
    assert stamps == [SIGNING.timestamp_10us, SIGNING.timestamp_10us + 1]
    assert stamps[0] == (UTC_NS // 10**9 - 1_420_070_400) * 100_000 + 12_345
    assert str(SIGNING.secret_key) not in repr(SIGNING)


@pytest.mark.parametrize(
    "make",
    [
        lambda: replace(SIGNING, secret_key=b"short"),
        lambda: replace(SIGNING, timestamp_10us=2**48),
        lambda: Packer(system_id=0),
        lambda: Packer(component_id=256),
        lambda: gps_input(replace(ESTIMATE, utc_ns=None)),
        lambda: Origin(91.0, 0.0, 0.0),
        lambda: Origin(48.0, 2.0, math.nan),
    ],
)
def test_invalid_fields_are_refused(make):
    with pytest.raises(EstimateError):
        make()


def test_without_pymavlink_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20.common", None)
    with pytest.raises(MissingExtraError, match=r"orthonav\[autopilot\]"):
        gps_input(ESTIMATE)
