"""Reader and publisher of `orthonav fly --ros2` at a node without ROS; see test_ros2_graph.py for
the true graph."""

import dataclasses
import logging
import math
import sys

import numpy as np
import pyproj
import pytest
from bags import Messages, record
from fake_autopilot import Time
from fake_autopilot import fix as fix_of
from memory_node import MemoryNode
from recorders import picture
from rosbags.typesys import Stores
from scipy.spatial.transform import Rotation

from orthonav.core.errors import CameraError, VariantError
from orthonav.core.geo.camera import attitude_of
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import ViewResult
from orthonav.ground.recordings.opening import open_source
from orthonav.onboard.messages.estimate import (
    EstimateError,
    NavigationEstimate,
    messages_averaged,
)
from orthonav.onboard.messages.gate import Gate
from orthonav.onboard.outputs import Publisher
from orthonav.onboard.ros2.node import Rosout, declared
from orthonav.onboard.ros2.publisher import Ros2Publisher
from orthonav.onboard.ros2.reader import Ros2Reader, loses_images
from orthonav.onboard.telemetry import TelemetryBuffer, VehicleState

S = 10**9
FRAME = LocalFrame(47.0, 8.0)
MESSAGES = Messages(store=Stores.LATEST)
IMAGE, INFO, IMU = "/cam/image_raw", "/cam/camera_info", "/imu/data"
REMAPPED = ["-r", f"imu:={IMU}", "-r", "gnss:=/gps/fix"]


class Reading:
    """A reader whose clock is that of its node."""

    def __init__(self, *words, image=IMAGE, **environment):
        words = ["-r", f"image:={image}", *REMAPPED, *words]
        self.node = MemoryNode(words, environment.get("ROS_DISTRO", ""))
        self.time, self.deadline_ns = self.node.time, 0
        stopped = lambda: self.time.now_ns > self.deadline_ns  # noqa: E731
        self.reader = Ros2Reader(self.node, TelemetryBuffer(), self.time.clocks, stopped)

    @property
    def now_ns(self):
        """ROS time, that of the system."""
        return self.time.clocks.utc_ns()

    def write(self, topic, message, messages=MESSAGES):
        cdr = messages.store.serialize_cdr(message, message.__msgtype__)
        self.node.write(topic, bytes(cdr))

    def go(self, seconds):
        self.deadline_ns = self.time.now_ns + round(seconds * S)

    def read(self, seconds=5.0):
        """The next image, None where none came in time."""
        self.go(seconds)
        return self.reader.read()

    def camera(self, seconds=5.0):
        self.go(seconds)
        return self.reader.wait_for_camera()

    def telemetry(self, *pairs):
        """That of an image after messages by their topic."""
        for topic, message in pairs:
            self.write(topic, message)
        self.write(IMAGE, image(self.now_ns))
        return self.read().telemetry

    def send_view(self, now_ns=None, angles=(90.0, 0.0, 0.0), **changes):
        """An image among telemetry before and after it; what is read of it."""
        now_ns = now_ns or self.now_ns
        for offset_ms in (-40, -20, 0):
            time_ns = now_ns + offset_ms * 10**6
            self.write(IMU, imu(time_ns, angles))
            self.write("/range", MESSAGES.range(time_ns, 80.0))
        self.write(IMAGE, image(now_ns - 10**7, **changes))
        return self.read()


def image(time_ns, **changes):
    return MESSAGES.image(time_ns, picture(3), **changes)


def imu(time_ns, angles=(90.0, 0.0, 0.0), **options):
    return MESSAGES.imu(time_ns, MESSAGES.turn(*angles), **options)


# Into the program.


def test_an_image_has_the_telemetry_of_its_exposure():
    flying = Reading()
    now_ns, then_ns = flying.now_ns, flying.time.now_ns
    seen = flying.send_view(now_ns, (60.0, 3.0, -2.0))
    assert seen.problem is None and np.array_equal(seen.grey, picture(3))
    assert (seen.time_ns, seen.exposed_ns) == (now_ns - 10**7, then_ns - 10**7)
    turn = Rotation.from_euler("ZYX", (60.0, 3.0, -2.0), degrees=True)
    down = np.diag([1.0, -1, -1]) @ np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])
    expected = attitude_of(turn.as_matrix() @ down)  # camera x right, y back, z down
    angles = (seen.telemetry.yaw_deg, seen.telemetry.pitch_deg, seen.telemetry.roll_deg)
    assert angles == pytest.approx(expected, abs=1e-6)
    assert seen.telemetry.yaw_deg == pytest.approx(30.0, abs=0.2)  # ENU 60 deg is heading 30
    assert seen.telemetry.agl_m == pytest.approx(80.0 * turn.as_matrix()[2, 2], abs=1e-3)


def test_a_live_view_equals_that_of_a_recorded_bag(tmp_path):
    """The same messages, once from a file and once from a graph: the same picture and telemetry."""
    flying, begin_ns = Reading(), 1_700_000_000 * S
    times = [begin_ns + step * 10**8 for step in range(11)]
    # Plain numbers have no stamp: they arrive shortly before the exposure.
    flying.time.utc_ahead_ns = times[5] - 10**7 - flying.time.now_ns
    turns = [MESSAGES.turn(100.0 - n, 2.0, 1.0) for n in range(11)]
    topics = {
        IMAGE: [(times[5], MESSAGES.image(times[5] + 10**7, picture(2)))],
        INFO: [(times[0], MESSAGES.camera_info())],
        IMU: [(t, MESSAGES.imu(t, turn)) for t, turn in zip(times, turns, strict=True)],
        "/rel_alt": [(t, MESSAGES.number(80.0)) for t in times],
    }
    bag = record(tmp_path / "bag", topics, MESSAGES)
    recorded = next(iter(open_source(bag).views))
    for topic in (INFO, IMU, "/rel_alt", IMAGE):
        for _, message in topics[topic]:
            flying.write(topic, message)
    camera, live = flying.camera(), flying.read()
    assert np.array_equal(live.grey, recorded.grey())
    values = [
        [getattr(each.telemetry, name) for name in ("yaw_deg", "pitch_deg", "roll_deg", "agl_m")]
        for each in (live, recorded)
    ]
    assert values[0] == pytest.approx(values[1], abs=1e-9)
    assert live.time_ns == recorded.telemetry.time_ns and camera == open_source(bag).camera


def test_compressed_images_by_parameter():
    flying = Reading("-p", "image_transport:=compressed")
    flying.write(IMU, imu(flying.now_ns))
    sent = MESSAGES.compressed(flying.now_ns - 10**7, picture(3), ".png")
    flying.write(f"{IMAGE}/compressed", sent)
    assert np.array_equal(flying.read().grey, picture(3))


@pytest.mark.parametrize("asked", ["best_effort", "reliable"])
def test_reliable_images_by_parameter(asked):
    node = Reading("-p", f"image_reliability:={asked}").node
    assert node.reliable == ({IMAGE} if asked == "reliable" else set())


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"encoding": "yuv422"}, "yuv422"),
        ({"height": 4000}, "cut short"),
        ({"step": 3}, "cut short"),
        ({"data": np.zeros(0, np.uint8)}, "cut short"),
    ],
)
def test_an_image_that_cannot_be_decoded_has_a_reason(changes, said):
    seen = Reading().send_view(**changes)
    assert seen.grey is None and seen.problem.reason == "bad_image"
    assert said in seen.problem.detail and IMAGE in seen.problem.detail


def test_an_image_without_telemetry_is_delivered():
    missing = Reading().telemetry().missing()
    assert set(missing) == {"yaw_deg", "pitch_deg", "roll_deg", "agl_m"}


def test_damaged_messages_end_nothing(caplog):
    """Each is counted by its topic, which the log names once; the next good view is read."""
    flying, rng = Reading(), np.random.default_rng(0)
    topics = [each for each in flying.node.kinds if each != "/gps/fix"]
    for topic in topics:
        for size in (0, 3, 4, 10, 200):
            flying.node.write(topic, b"\0\1\0\0"[:size] + rng.bytes(max(size - 4, 0)))
    assert flying.read(0.5) is None
    assert all(flying.node.undecodable[topic] >= 3 for topic in topics)
    assert caplog.text.count(f"message on {IMAGE} cannot be used") == 1
    assert flying.send_view().telemetry.missing() == []


@pytest.mark.parametrize(
    ("frame", "wxyz", "said"),
    [
        ("livox_frame", (1.0, 0.0, 0.0, 0.0), "it has no orientation"),
        ("imu", (0.0, 0.0, 0.0, 0.0), "it has no orientation"),
        ("imu", None, "it has no orientation"),
        ("camera_imu", (0.6, 0.0, 0.0, 0.8), "its frame is named 'camera'"),
        ("imu_ned", (0.6, 0.0, 0.0, 0.8), "its frame is named 'ned'"),
    ],
)
def test_an_imu_that_is_not_of_the_body_is_named_once(caplog, frame, wxyz, said):
    flying = Reading()
    for offset_ns in (0, 1):
        message = imu(flying.now_ns + offset_ns, known=wxyz is not None)
        message.header.frame_id, turn = frame, message.orientation
        turn.w, turn.x, turn.y, turn.z = wxyz or (0.6, 0.0, 0.0, 0.8)
        flying.write(IMU, message)
    assert math.isnan(flying.telemetry().yaw_deg)
    assert caplog.text.count(f"imu is not used: {said}") == 1


def test_a_range_ahead_is_no_height(caplog):
    flying = Reading()
    ahead = MESSAGES.range(flying.now_ns, 3.0)
    ahead.header.frame_id = "sonar_front"
    assert math.isnan(flying.telemetry((IMU, imu(flying.now_ns)), ("/range", ahead)).agl_m)
    assert "distance is not used: its frame is named 'front'" in caplog.text


@pytest.mark.parametrize("distro", ["humble", ""])
def test_a_range_of_humble_needs_its_definitions(caplog, distro):
    """It has no variance: by other definitions it is cut short, which the log says."""
    flying = Reading(ROS_DISTRO=distro)
    flying.write(IMU, imu(flying.now_ns))
    flying.write("/range", Messages().range(flying.now_ns, 80.0), Messages())
    assert flying.telemetry().agl_m == pytest.approx(80.0 if distro else math.nan, nan_ok=True)
    assert ("message on /range cannot be used" in caplog.text) is not bool(distro)


def test_rectified_images_have_the_camera_p():
    matrix = np.array([50.0, 0, 30.5, 0, 0, 50.0, 22.5, 0, 0, 0, 1, 0])
    flying = Reading(image="/cam/image_rect")
    flying.write(INFO, MESSAGES.camera_info(lens=(-0.2, 0.1, 0.0, 0.0, 0.0), p=matrix))
    camera = flying.camera()
    assert (camera.fx_px, camera.cx_px, camera.distortion) == (50, 31, ())


@pytest.mark.parametrize(
    ("std_deg", "expected"),
    [(0.0, 3.0), (0.1, 0.3), (5.0, 5.0), (57.3, 3.0), (math.nan, 3.0)],  # MAVROS: 1 rad
)
def test_the_covariance_of_an_imu_is_that_of_the_tilt(std_deg, expected):
    flying = Reading()
    message = imu(flying.now_ns, std_deg=std_deg)
    message.orientation_covariance[4] = message.orientation_covariance[0] / 4
    message.orientation_covariance[8] = 9.0
    reported = flying.telemetry((IMU, message))
    assert reported.horizon_std_deg == pytest.approx(expected)
    assert reported.tilt_std_deg == pytest.approx(math.hypot(expected, 2.5))


def test_a_fix_of_a_receiver_aids_the_horizon():
    flying = Reading()
    received = "/gps/fix", MESSAGES.fix(flying.now_ns)
    aided = flying.telemetry(received, (IMU, imu(flying.now_ns)))
    assert aided.horizon_std_deg == pytest.approx(1.0)
    flying.reader.gnss.clear()  # as with --gnss
    flying.time.go(0.1)
    aided = flying.telemetry((IMU, imu(flying.now_ns)))
    assert aided.horizon_std_deg == pytest.approx(1.0)
    flying.time.go(4.0)
    unaided = flying.telemetry((IMU, imu(flying.now_ns)))
    assert unaided.horizon_std_deg == pytest.approx(3.0)


def test_stamps_that_go_back(caplog):
    flying = Reading()
    first = flying.send_view(now_ns := flying.now_ns)
    flying.write(IMAGE, image(first.time_ns - 10**8))
    assert flying.read(0.5) is None and "go back" in caplog.text
    again = flying.send_view(now_ns - 60 * S)  # a bag that begins again
    assert again.time_ns == first.time_ns - 60 * S and again.telemetry.missing() == []
    assert "went back by" in caplog.text and "use_sim_time" in caplog.text


def test_simulated_time_is_that_of_the_clock():
    flying, begin_ns = Reading("-p", "use_sim_time:=true"), 1000 * S
    sec = MESSAGES.header(begin_ns).stamp
    flying.write("/clock", MESSAGES.new("rosgraph_msgs/msg/Clock", clock=sec))
    then_ns = flying.time.now_ns
    seen = flying.send_view(begin_ns)
    assert seen.time_ns == begin_ns - 10**7 and seen.telemetry.missing() == []
    assert seen.exposed_ns == then_ns - 10**7
    assert flying.reader.now_ns() == begin_ns + flying.time.now_ns - then_ns


def test_a_missing_clock_is_logged_and_images_are_ignored(caplog):
    flying = Reading("-p", "use_sim_time:=true")
    assert flying.send_view() is None
    assert "/clock" in caplog.text and flying.reader.now_ns() == 0


def test_a_camera_that_is_not_calibrated_is_refused():
    flying = Reading()
    flying.write(INFO, MESSAGES.new("sensor_msgs/msg/CameraInfo"))
    with pytest.raises(CameraError, match=r"calibrated.*/cam/camera_info"):
        flying.camera()


def test_the_wait_for_camera_info_is_logged_and_reported(caplog):
    flying, reported = Reading(), []
    flying.reader.report_wait = reported.append
    with pytest.raises(CameraError, match=r"stopped.*/cam/camera_info"):
        flying.camera(seconds=2.5)
    assert "no message on /cam/camera_info" in caplog.text
    assert len(reported) == 3 and "--camera" in reported[0]  # once a second


def test_a_wait_for_images_is_logged(caplog):
    assert Reading().read(2.0) is None
    assert f"waiting: no images on {IMAGE}" in caplog.text


def test_gnss_is_logged_as_it_came():
    flying, logged = Reading(), []
    flying.reader.log_gnss = lambda time_ns, cdr: logged.append((time_ns, cdr))
    message = MESSAGES.fix(7 * S, lat=46.5, status=-1)
    flying.write("/gps/fix", message)
    assert flying.read(0.2) is None
    (sample,) = flying.reader.gnss
    assert (sample.lat_deg, sample.has_fix, sample.stamp_ns) == (46.5, False, 7 * S)
    assert logged == [(7 * S, bytes(MESSAGES.store.serialize_cdr(message, message.__msgtype__)))]


@pytest.mark.parametrize(
    ("arrives", "is_lost"),
    [
        (lambda n: n % 10 != 3, False),  # a tenth
        (lambda n: n % 3 == 0, False),  # a node passes every third one on
        (lambda n: n % 10 in (0, 1, 5, 9), True),
        (lambda n: n in (0, 40, 41, 75, 90), True),
    ],
)
def test_lost_images_are_noticed(arrives, is_lost):
    order = np.random.default_rng(0).permutation(100)  # what arrives first does not matter
    infos = [int(number) * S // 10 for number in order]
    images = [int(number) * S // 10 for number in order if arrives(number)]
    assert loses_images(images, infos) is is_lost
    assert not loses_images(images, [])


def test_lost_images_are_named_once(caplog):
    flying = Reading()
    for number in range(40):
        time_ns = flying.now_ns
        flying.write(INFO, MESSAGES.camera_info(header=MESSAGES.header(time_ns)))
        if number % 10 in (0, 1, 5, 9):
            flying.write(IMAGE, image(time_ns))
        flying.read(0.1)
    assert "loses images" in flying.node.problems[IMAGE]
    assert caplog.text.count("loses images") == 1


# Out of the program.


class Publishing:
    """A publisher behind the true gate; `heard` is what others hear of it."""

    def __init__(self, *words, **options):
        self.time = Time()
        self.node = MemoryNode(words)
        self.out = Ros2Publisher(self.node, FRAME, lambda: 5 * S, **options)
        self.gate = Gate()
        self.whole = Publisher(self.gate, self.time.clocks, graph=self.out)
        self.heard = self.node.heard

    def publish(self, outcome, stamp_ns=7 * S, reported=None):
        self.time.go(0.2)
        exposed_ns = self.time.now_ns - 10**8
        result = ViewResult("a", stamp_ns, outcome, 1.0, "tracking")
        return self.whole.publish(result, exposed_ns, reported or VehicleState(None), judged=True)

    def covariances(self):
        """Those of all messages, horizontal, each (2, 2), of fixes and of poses."""
        fixes = [np.reshape(each.position_covariance, (3, 3)) for each in self.heard[FIX]]
        poses = [np.reshape(each.pose.covariance, (6, 6)) for each in self.heard[POSE]]
        return [[each[:2, :2] for each in found] for found in (fixes, poses)]


FIX, POSE, ORIGIN = "/orthonav/fix", "/orthonav/pose", "/orthonav/origin"
COV = np.array([[16.0, 1.5], [1.5, 25.0]])


def fix(cov_en_m2=COV, **values):
    return dataclasses.replace(fix_of(**values), cov_en_m2=cov_en_m2)


def stamped(message):
    return message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id


def test_a_position_is_published_as_fix_and_pose():
    flying = Publishing()
    ned = Rotation.from_euler("ZYX", (30.0, 5.0, -3.0), degrees=True).as_matrix()
    sent = flying.publish(fix(lat_deg=47.01, lon_deg=8.02), 7 * S + 5, VehicleState(ned))
    assert sent == ("NavSatFix", "PoseWithCovarianceStamped")
    (found,), (pose,) = flying.heard[FIX], flying.heard[POSE]
    assert (found.latitude, found.longitude) == (47.01, 8.02) and math.isnan(found.altitude)
    assert stamped(found) == (7, 5, "base_link") and stamped(pose) == (7, 5, "map")
    assert (found.status.status, found.status.service, found.position_covariance_type) == (0, 0, 3)
    full = np.reshape(found.position_covariance, (3, 3))  # east, north, up
    assert full[:2, :2] == pytest.approx(COV) and full[2, 2] > 1e6 and not full[2, :2].any()
    geod = pyproj.Geod(ellps="WGS84")
    azimuth, _, metres = geod.inv(8.0, 47.0, 8.02, 47.01)
    expected = metres * math.sin(math.radians(azimuth)), metres * math.cos(math.radians(azimuth))
    where = pose.pose.pose.position
    assert (where.x, where.y) == pytest.approx(expected, abs=2e-3) and where.z == 0
    full = np.reshape(pose.pose.covariance, (6, 6))  # x, y, z, rotations about X, Y, Z
    assert full[:2, :2] == pytest.approx(COV) and full[2, 2] > 1e6
    assert (np.diag(full)[3:] > 9).all() and np.count_nonzero(full) == 8
    turn = pose.pose.pose.orientation
    flu = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])
    forward_ned, left_ned = ned @ [1.0, 0, 0], ned @ [0.0, -1, 0]
    for axis, ned_axis in (([1, 0, 0], forward_ned), ([0, 1, 0], left_ned)):
        assert flu.apply(axis) == pytest.approx([ned_axis[1], ned_axis[0], -ned_axis[2]], abs=1e-12)


@pytest.mark.parametrize(
    ("words", "times"),
    [((), messages_averaged(0.2)), (("-p", "covariance:=fix"), 1.0)],  # 0.2 s apart
)
def test_covariances_are_for_filters_unless_those_of_the_fix_are_asked(words, times):
    flying = Publishing(*words)
    for time_s in (7, 8):
        flying.publish(fix(), time_s * S)
    for first, second in flying.covariances():
        assert first == pytest.approx(COV) and second == pytest.approx(COV * times)


@pytest.mark.parametrize(
    ("asked", "expected"),
    [("none", math.nan), ("terrain", 512.0), ("home", 260.0), ("-3.5", -3.5)],
)
def test_an_altitude_on_request(asked, expected):
    flying = Publishing("-p", f"altitude:={asked}", origin_alt_m=200.0)
    flying.publish(fix(), reported=VehicleState(None, amsl_m=512.0, home_m=60.0))
    (found,) = flying.heard[FIX]
    assert found.altitude == pytest.approx(expected, nan_ok=True)
    assert found.position_covariance[8] > 1e6  # not measured


def test_withheld_positions_are_not_published():
    """What the gate withholds is tested with the gate."""
    flying = Publishing()
    assert flying.publish(fix(confidence=0.5)) == ()
    assert flying.gate.withheld["low_confidence"] == 1
    assert flying.heard[FIX] == flying.heard[POSE] == []
    low = NavigationEstimate(47.0, 8.0, COV, 0.5, time_ns=1)
    with pytest.raises(EstimateError, match="NavSatFix"):
        flying.out.position(low, VehicleState(None), 1)


def test_a_dry_run_sends_health_and_no_position():
    flying = Publishing(silent=True)
    assert flying.publish(fix()) == ()
    flying.whole.health({"health": "OK", "reasons": []})
    assert len(flying.heard["/diagnostics"]) == 1
    assert flying.heard[FIX] == flying.heard[POSE] == []


def test_the_origin_is_latched_for_later_subscribers():
    flying = Publishing()
    (found,) = flying.heard[ORIGIN]
    assert (found.position.latitude, found.position.longitude) == (47.0, 8.0)
    assert math.isnan(found.position.altitude) and found.header.frame_id == "map"
    assert flying.node.latched == {ORIGIN}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("altitude:=high", "'high'"),
        ("covariance:=mine", "filter or fix"),
        ("image_transport:=theora", "raw or compressed"),
    ],
)
def test_invalid_parameters_are_named(given, said):
    with pytest.raises(VariantError, match=said):
        MemoryNode(["-p", given])


def test_a_time_that_is_neither_true_nor_false_is_named():
    with pytest.raises(VariantError, match="use_sim_time is true or false, got 'no'"):
        declared(lambda name, default: {"use_sim_time": "no"}.get(name, default), [])


def test_unknown_parameters_are_named(caplog):
    MemoryNode(["-p", "covarance:=fix", "-p", "qos_overrides./fix.publisher.depth:=1"])
    (record,) = caplog.records
    assert record.getMessage().startswith("parameter covarance is ignored; parameters are use_sim")


def test_a_node_that_cannot_begin_leaves_the_graph(monkeypatch):
    left = []
    monkeypatch.setattr(MemoryNode, "close", lambda node: left.append(node))
    with pytest.raises(VariantError):
        MemoryNode(["-p", "altitude:=high"])
    assert len(left) == 1


def test_topics_of_another_type_are_named_once_and_while_that_lasts(caplog):
    flying = Reading()
    flying.node.types[IMAGE] = {"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"}
    flying.node.types[IMU] = {"sensor_msgs/msg/Imu"}
    flying.read(2.5)
    said = "is of type sensor_msgs/msg/CompressedImage; expected sensor_msgs/msg/Image"
    assert flying.node.problems == {IMAGE: said}
    assert caplog.text.count(f"topic {IMAGE} {said}") == 1
    flying.node.types.clear()
    flying.read(1.5)
    assert not flying.node.problems


def test_health_is_a_diagnostic():
    flying = Publishing()
    for level, reasons in (("OK", []), ("DEGRADED", ["lost"]), ("FAILED", ["no_camera"])):
        flying.whole.health(
            {"health": level, "reasons": reasons, "state": None, "counts": {"late": 2}}
        )
    found = flying.heard["/diagnostics"]
    assert [each.status[0].level for each in found] == [0, 1, 2]
    assert [each.status[0].message for each in found] == ["OK", "lost", "no_camera"]
    values = {each.key: each.value for each in found[1].status[0].values}
    assert values == {"health": "DEGRADED", "reasons": "lost", "state": "", "counts.late": "2"}
    assert found[0].status[0].name == "orthonav: position" and found[0].header.stamp.sec == 5


def test_health_names_topics_that_lose_messages_while_that_lasts():
    flying = Publishing()
    for problems in ({IMAGE: "loses images"}, {}):
        flying.node.note(problems)
        flying.whole.health({"health": "OK", "reasons": []})
    first, then = (each.status[0] for each in flying.heard["/diagnostics"])
    assert IMAGE in first.message and first.level == 1
    assert (then.message, then.level) == ("OK", 0)


def test_the_log_is_published_on_rosout():
    flying = Publishing()
    handler = Rosout(flying.node)
    handler.handle(logging.makeLogRecord({"msg": "no %s", "args": "x", "levelno": 30}))
    (found,) = flying.heard["/rosout"]
    assert (found.msg, found.level, found.name) == ("no x", 30, "orthonav")
    assert "/rosout" in flying.node.latched


def test_what_the_middleware_does_not_take_is_an_error_of_output():
    node = Publishing().node

    def refuse(cdr):
        raise RuntimeError("closed")

    with pytest.raises(OSError, match=r"cannot publish on /a .closed"):
        node._writing("/a", refuse)(MESSAGES.number(1.0))


# The command.


def test_conflicting_options_end_with_one_line(map_path, run):
    for words, said in (
        (["0", "--ros2"], "--ros2 replaces"),
        (["--ros2", "--autopilot", "udpin:0"], "--ros2 replaces"),
        (["--ros-args", "-r", "a:=b"], "needs --ros2"),
        ([], "--ros2"),
    ):
        done = run("fly", map_path, *words)
        assert done.code == 2 and said in done.err and done.err.count("\n") == 1


def test_without_rclpy_the_answer_is_what_to_do(map_path, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    done = run("fly", map_path, "--ros2")
    assert done.code == 1 and done.err.count("\n") == 1
    for part in ("needs rclpy", "source a ROS 2", "pip install 'orthonav[ros2]'"):
        assert part in done.err
