"""ROS 2 over DDS: reader and publisher against a participant with types of its own, and a bag
replayed in real time into `orthonav fly --ros2` in another process."""

import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pyproj
import pytest
import ros2_types as ros
from bags import Messages, record
from blots import AGL_M, CAMERA, GROUND, known_map, rendered
from cyclonedds.idl import make_idl_struct
from fake_autopilot import Time
from fake_autopilot import fix as fix_of
from mcap.reader import make_reader
from recorders import picture
from ros2_peer import (
    BEST_EFFORT,
    RELIABLE,
    TRANSIENT_LOCAL,
    Peer,
    environment,
)
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from helpers import LONGEST_S, wait_for
from orthonav.core.errors import CameraError
from orthonav.core.geo.camera import attitude_of
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import ViewResult
from orthonav.ground.recordings.opening import open_source
from orthonav.onboard.messages.estimate import (
    Clock,
    EstimateError,
    NavigationEstimate,
    messages_averaged,
)
from orthonav.onboard.messages.gate import Gate, GateRules
from orthonav.onboard.outputs import Publisher
from orthonav.onboard.ros2.arguments import ros_arguments
from orthonav.onboard.ros2.node import Node
from orthonav.onboard.ros2.publisher import Ros2Publisher
from orthonav.onboard.ros2.reader import Ros2Reader, loses_images
from orthonav.onboard.telemetry import Clocks, TelemetryBuffer, VehicleState

S = 10**9
FRAME = LocalFrame(47.0, 8.0)
KINDS = {
    "/cam/image_raw": ros.Image,
    "/cam/image_raw/compressed": ros.CompressedImage,
    "/cam/camera_info": ros.CameraInfo,
    "/imu/data": ros.Imu,
    "/range": ros.Range,
    "/rel_alt": ros.Float64,
    "/gps/fix": ros.NavSatFix,
    "/clock": ros.Clock,
}
SEEN = ("/cam/image_raw", "/imu/data", "/range")
REMAPPED = [
    *("-r", "image:=/cam/image_raw", "-r", "imu:=/imu/data", "-r", "gnss:=/gps/fix"),
]


@pytest.fixture
def env(monkeypatch):
    """The environment of every participant of a test."""
    made = environment()
    for name in ("ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_NAMESPACE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    for name, value in made.items():
        monkeypatch.setenv(name, value)
    return made


@pytest.fixture
def peer(env):
    made = Peer(env["ROS_DOMAIN_ID"])
    yield made
    made.close()


class Reading:
    """A reader in this process, with a clock for the wait that is bounded."""

    def __init__(self, env, *words, clocks=None):
        self.node = Node(ros_arguments([*REMAPPED, *words], env))
        self.deadline = 0.0
        stopped = lambda: time.monotonic() > self.deadline  # noqa: E731
        self.reader = Ros2Reader(self.node, TelemetryBuffer(), clocks or Clocks(), stopped)

    def problem(self, topic):
        """What is wrong with a topic, None without a problem."""
        self.node.spin(0.02)
        self.node.check_graph({})
        return self.node.problems.get(topic)

    def read(self, seconds=LONGEST_S):
        """The next picture, None where none came in time."""
        self.deadline = time.monotonic() + seconds
        return self.reader.read()


@pytest.fixture
def reading(env):
    made = []

    def start(*words, **options):
        made.append(Reading(env, *words, **options))
        return made[-1]

    yield start
    for each in made:
        each.node.close()


def stamp(time_ns):
    return ros.Time(*divmod(time_ns, S))


def image(time_ns, pixels=None, **changes):
    pixels = picture(3) if pixels is None else pixels
    rows, columns = pixels.shape[:2]
    values = {
        "header": ros.Header(stamp(time_ns), "camera"),
        "height": rows,
        "width": columns,
        "encoding": "mono8",
        "is_bigendian": 0,
        "step": pixels[0].nbytes,
        "data": pixels.ravel().tolist(),
    }
    return ros.Image(**(values | changes))


def imu(time_ns, angles=(90.0, 0.0, 0.0)):
    made = ros.zeros(ros.Imu)
    made.header = ros.Header(stamp(time_ns), "base_link")
    x, y, z, w = Rotation.from_euler("ZYX", angles, degrees=True).as_quat()
    made.orientation = ros.Quaternion(x, y, z, w)
    return made


def ranged(time_ns, metres):
    made = ros.zeros(ros.Range)
    made.header = ros.Header(stamp(time_ns), "range")
    made.min_range, made.max_range, made.range = 0.2, 200.0, metres
    return made


def advertised(peer, *topics):
    for topic in topics:
        peer.advertise(topic, KINDS[topic])
    return peer


def matched(peer, reading):
    wait_for(lambda: reading.node.spin(0.01) >= 0 and peer.matched(), "discovery")


def joined(peer, reading, *topics, words="", **options):
    """A reader of these topics of the peer, which has found them."""
    advertised(peer, *topics)
    flying = reading(*words.split(), **options)
    matched(peer, flying)
    return flying


def send_view(peer, now_ns, angles=(90.0, 0.0, 0.0), **changes):
    """An image among telemetry before and after it."""
    for offset_ms in (-40, -20, 0):
        time_ns = now_ns + offset_ms * 10**6
        peer.write("/imu/data", imu(time_ns, angles))
        peer.write("/range", ranged(time_ns, 80.0))
    peer.write("/cam/image_raw", image(now_ns - 10**7, **changes))


# Messages on the wire.


# Into the program.


def test_an_image_has_the_telemetry_of_its_exposure(peer, reading):
    flying = joined(peer, reading, *SEEN)
    now_ns = time.time_ns()
    send_view(peer, now_ns, (60.0, 3.0, -2.0))
    seen = flying.read()
    assert seen.problem is None and np.array_equal(seen.grey, picture(3))
    assert seen.time_ns == now_ns - 10**7
    assert 0 < (time.monotonic_ns() - seen.exposed_ns) / 1e9 < LONGEST_S
    turn = Rotation.from_euler("ZYX", (60.0, 3.0, -2.0), degrees=True)
    down = np.diag([1.0, -1, -1]) @ np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])
    expected = attitude_of(turn.as_matrix() @ down)  # camera x right, y back, z down
    angles = (seen.telemetry.yaw_deg, seen.telemetry.pitch_deg, seen.telemetry.roll_deg)
    assert angles == pytest.approx(expected, abs=1e-6)
    assert seen.telemetry.yaw_deg == pytest.approx(30.0, abs=0.2)  # ENU 60 deg is heading 30
    tilt = turn.apply([0.0, 0.0, 1.0])[2]
    assert seen.telemetry.agl_m == pytest.approx(80.0 * tilt, abs=1e-3)


def test_a_live_view_equals_that_of_a_recorded_bag(peer, reading, tmp_path):
    """The same messages, once from a file and once over DDS: the same picture and telemetry."""
    messages, begin_ns = Messages(), 1_700_000_000 * S
    times = [begin_ns + step * 10**8 for step in range(11)]
    # Plain numbers have no stamp: they arrive shortly before the exposure.
    clocks = Clocks(time.monotonic_ns, lambda: times[5] - 10**7, time.sleep)
    topics = ("/cam/image_raw", "/cam/camera_info", "/imu/data", "/rel_alt")
    flying = joined(peer, reading, *topics, clocks=clocks)
    peer.write("/cam/camera_info", ros.native(messages.camera_info(), ros.CameraInfo))
    flying.deadline = time.monotonic() + LONGEST_S
    camera = flying.reader.wait_for_camera()
    topics = {
        "/cam/image_raw": [(times[5], messages.image(times[5] + 10**7, picture(2)))],
        "/cam/camera_info": [(times[0], messages.camera_info())],
        "/imu/data": [
            (t, messages.imu(t, messages.turn(100.0 - n, 2.0, 1.0))) for n, t in enumerate(times)
        ],
        "/rel_alt": [(t, messages.number(80.0)) for t in times],
    }
    bag = record(tmp_path / "bag", topics, messages)
    recorded = next(iter(open_source(bag).views))
    for topic in ("/imu/data", "/rel_alt"):
        for _, message in topics[topic]:
            peer.write(topic, ros.native(message, KINDS[topic]))
    peer.write("/cam/image_raw", ros.native(topics["/cam/image_raw"][0][1], ros.Image))
    live = flying.read()
    assert np.array_equal(live.grey, recorded.grey())
    for name in ("yaw_deg", "pitch_deg", "roll_deg", "agl_m"):
        assert getattr(live.telemetry, name) == pytest.approx(
            getattr(recorded.telemetry, name), abs=1e-9
        )
    assert live.time_ns == recorded.telemetry.time_ns
    assert camera == open_source(bag).camera


def test_compressed_images_by_parameter(peer, reading):
    flying = joined(
        peer,
        reading,
        "/cam/image_raw/compressed",
        "/imu/data",
        words="-p image_transport:=compressed",
    )
    now_ns = time.time_ns()
    data = cv2.imencode(".png", picture(3))[1].ravel().tolist()
    peer.write("/imu/data", imu(now_ns))
    message = ros.CompressedImage(ros.Header(stamp(now_ns - 10**7), "camera"), "png", data)
    peer.write("/cam/image_raw/compressed", message)
    assert np.array_equal(flying.read().grey, picture(3))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"encoding": "yuv422"}, "yuv422"),
        ({"height": 4000}, "cut short"),
        ({"step": 3}, "cut short"),
        ({"data": []}, "cut short"),
    ],
)
def test_an_image_that_cannot_be_decoded_has_a_reason(peer, reading, changes, said):
    flying = joined(peer, reading, *SEEN)
    send_view(peer, time.time_ns(), **changes)
    seen = flying.read()
    assert seen.grey is None and seen.problem.reason == "bad_image"
    assert said in seen.problem.detail and "/cam/image_raw" in seen.problem.detail


def test_an_image_without_telemetry_is_delivered(peer, reading):
    flying = joined(peer, reading, "/cam/image_raw")
    peer.write("/cam/image_raw", image(time.time_ns()))
    telemetry = flying.read().telemetry
    assert set(telemetry.missing()) == {"yaw_deg", "pitch_deg", "roll_deg", "agl_m"}


def test_an_imu_without_orientation_is_no_attitude(peer, reading):
    flying = joined(peer, reading, *SEEN)
    now_ns = time.time_ns()
    raw = imu(now_ns)
    raw.orientation_covariance = [-1.0] + [0.0] * 8
    peer.write("/imu/data", raw)
    peer.write("/cam/image_raw", image(now_ns))
    assert math.isnan(flying.read().telemetry.yaw_deg)


@pytest.mark.parametrize(
    ("frame", "wxyz", "said"),
    [
        ("livox_frame", (1.0, 0.0, 0.0, 0.0), "imu is not used: it has no orientation"),
        ("imu", (0.0, 0.0, 0.0, 0.0), "imu is not used: it has no orientation"),
        ("camera_imu", (0.6, 0.0, 0.0, 0.8), "imu is not used: its frame is named 'camera'"),
        ("imu_ned", (0.6, 0.0, 0.0, 0.8), "imu is not used: its frame is named 'ned'"),
    ],
)
def test_an_imu_that_is_not_of_the_body_is_named_once(peer, reading, caplog, frame, wxyz, said):
    flying = joined(peer, reading, *SEEN)
    now_ns = time.time_ns()
    w, x, y, z = wxyz
    for offset_ns in (0, 1):
        message = imu(now_ns + offset_ns)
        message.header.frame_id, message.orientation = frame, ros.Quaternion(x, y, z, w)
        peer.write("/imu/data", message)
    peer.write("/cam/image_raw", image(now_ns))
    assert math.isnan(flying.read().telemetry.yaw_deg) and caplog.text.count(said) == 1


def test_a_range_ahead_is_no_height(peer, reading, caplog):
    flying = joined(peer, reading, *SEEN)
    now_ns = time.time_ns()
    ahead = ranged(now_ns, 3.0)
    ahead.header.frame_id = "sonar_front"
    peer.write("/imu/data", imu(now_ns))
    peer.write("/range", ahead)
    peer.write("/cam/image_raw", image(now_ns))
    assert math.isnan(flying.read().telemetry.agl_m)
    assert "distance is not used: its frame is named 'front'" in caplog.text


def test_rectified_images_have_the_camera_p(peer, reading, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "REMAPPED", ["-r", "image:=/cam/image_rect"])
    messages = Messages()
    matrix = np.array([50.0, 0, 30.5, 0, 0, 50.0, 22.5, 0, 0, 0, 1, 0])
    sent = messages.camera_info(lens=(-0.2, 0.1, 0.0, 0.0, 0.0), p=matrix)
    flying = joined(peer, reading, "/cam/camera_info")
    peer.write("/cam/camera_info", ros.native(sent, ros.CameraInfo))
    flying.deadline = time.monotonic() + 60
    camera = flying.reader.wait_for_camera()
    assert (camera.fx_px, camera.cx_px, camera.distortion) == (50, 31, ())


@pytest.mark.parametrize(
    ("std_deg", "expected"),
    [(0.0, 3.0), (0.1, 0.3), (5.0, 5.0), (57.3, 3.0), (math.nan, 3.0)],  # MAVROS: 1 rad
)
def test_the_covariance_of_an_imu_is_that_of_the_tilt(peer, reading, std_deg, expected):
    flying = joined(peer, reading, *SEEN)
    now_ns = time.time_ns()
    message = imu(now_ns)
    variance = math.radians(std_deg) ** 2
    message.orientation_covariance = [variance, 0.0, 0.0, 0.0, variance / 4, 0.0, 0.0, 0.0, 9.0]
    peer.write("/imu/data", message)
    peer.write("/cam/image_raw", image(now_ns))
    reported = flying.read().telemetry
    assert reported.horizon_std_deg == pytest.approx(expected)
    assert reported.tilt_std_deg == pytest.approx(math.hypot(expected, 2.5))


def test_a_fix_of_a_receiver_aids_the_horizon(peer, reading):
    flying = joined(peer, reading, *SEEN, "/gps/fix")
    now_ns = time.time_ns()
    message = ros.zeros(ros.NavSatFix)
    message.header.stamp = stamp(now_ns)
    peer.write("/gps/fix", message)
    wait_for(lambda: flying.node.spin(0.02) >= 0 and flying.reader.gnss)
    peer.write("/imu/data", imu(now_ns))
    peer.write("/cam/image_raw", image(now_ns))
    assert flying.read().telemetry.horizon_std_deg == pytest.approx(1.0)


def test_a_publisher_that_leaves_is_no_message(peer, reading):
    flying = reading()
    for topic in ("/cam/camera_info", "/imu/data", "/range", "/rel_alt"):
        other = Peer(os.environ["ROS_DOMAIN_ID"])
        other.advertise(topic, KINDS[topic])
        matched(other, flying)
        other.write(topic, ros.zeros(KINDS[topic]))
        wait_for(lambda: flying.node.spin(0.01))  # what comes later only says that it left
        other.close()
    assert flying.read(1.0) is None
    assert not flying.node.undecodable


def test_stamps_that_go_back(peer, reading, caplog):
    flying = joined(peer, reading, *SEEN)
    now_ns = time.time_ns()
    send_view(peer, now_ns)
    first = flying.read()
    peer.write("/cam/image_raw", image(first.time_ns - 10**8))
    wait_for(lambda: flying.read(0.1) is None and "go back" in caplog.text)
    send_view(peer, now_ns - 60 * S)  # a bag that begins again
    again = flying.read()
    assert again.time_ns == first.time_ns - 60 * S and again.telemetry.missing() == []
    assert "went back by" in caplog.text and "use_sim_time" in caplog.text


def test_simulated_time_is_that_of_the_clock(peer, reading):
    flying = joined(peer, reading, *SEEN, "/clock", words="-p use_sim_time:=true")
    then_ns = 1000 * S
    peer.write("/clock", ros.Clock(stamp(then_ns)))
    wait_for(lambda: flying.node.spin(0.02) >= 0 and flying.reader.now_ns() > 0)
    send_view(peer, then_ns)
    seen = flying.read()
    assert seen.time_ns == then_ns - 10**7 and seen.telemetry.missing() == []
    assert 0 <= (time.monotonic_ns() - seen.exposed_ns) / 1e9 < LONGEST_S
    assert then_ns <= flying.reader.now_ns() < then_ns + LONGEST_S * S


@pytest.mark.long
def test_a_missing_clock_is_logged_and_images_are_ignored(peer, reading, caplog):
    flying = joined(peer, reading, *SEEN, words="-p use_sim_time:=true")
    send_view(peer, time.time_ns())
    assert flying.read(2.0) is None
    assert "/clock" in caplog.text and flying.reader.now_ns() == 0


def test_a_camera_that_is_not_calibrated_is_refused(peer, reading):
    flying = joined(peer, reading, "/cam/camera_info")
    peer.write("/cam/camera_info", ros.zeros(ros.CameraInfo))
    flying.deadline = time.monotonic() + LONGEST_S
    with pytest.raises(CameraError, match=r"calibrated.*/cam/camera_info"):
        flying.reader.wait_for_camera()


@pytest.mark.long
def test_the_wait_for_camera_info_is_logged(reading, caplog):
    flying = reading()
    flying.deadline = time.monotonic() + 1.5
    with pytest.raises(CameraError, match=r"stopped.*/cam/camera_info"):
        flying.reader.wait_for_camera()
    assert "no message on /cam/camera_info" in caplog.text


def test_gnss_is_logged_only(peer, reading):
    flying = joined(peer, reading, "/gps/fix")
    logged = []
    flying.reader.log_gnss = lambda time_ns, cdr: logged.append((time_ns, cdr))
    message = ros.zeros(ros.NavSatFix)
    message.header.stamp, message.latitude, message.status.status = stamp(7 * S), 46.5, -1
    peer.write("/gps/fix", message)
    wait_for(lambda: flying.node.spin(0.02) >= 0 and flying.reader.gnss)
    (sample,) = flying.reader.gnss
    assert (sample.lat_deg, sample.has_fix, sample.stamp_ns) == (46.5, False, 7 * S)
    ((time_ns, cdr),) = logged
    assert time_ns == 7 * S and ros.NavSatFix.deserialize(cdr) == message


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


def test_another_type_on_a_topic_is_named(peer, reading, caplog):
    peer.advertise("/cam/image_raw", ros.CompressedImage)
    flying = reading()
    said = wait_for(lambda: flying.problem("/cam/image_raw"))
    assert "CompressedImage; expected sensor_msgs/msg/Image" in said
    assert caplog.text.count("expected sensor_msgs/msg/Image") == 1


def test_qos_that_does_not_match_is_named(peer, reading, caplog):
    """A reader of ours that wants every part of a picture, and a camera with best effort."""
    peer.advertise("/cam/image_raw", ros.Image, BEST_EFFORT)
    flying = reading("-p", "image_reliability:=reliable")
    assert "reliability" in wait_for(lambda: flying.problem("/cam/image_raw"))
    assert "QoS" in caplog.text


def test_definitions_of_another_distribution_are_named_and_can_be_chosen(
    peer, reading, monkeypatch, caplog
):
    """A range of Humble has no variance: as bytes it would be cut short."""
    humble = make_idl_struct(
        "Range",
        ros.name("sensor_msgs", "Range"),
        {f.name: f.type for f in dataclasses.fields(ros.Range) if f.name != "variance"},
    )
    peer.advertise("/range", humble)
    flying = reading()
    assert "ROS_DISTRO" in wait_for(lambda: flying.problem("/range"))
    assert "ROS_DISTRO" in caplog.text
    monkeypatch.setenv("ROS_DISTRO", "humble")
    flying = Reading(os.environ)
    matched(peer, flying)
    now_ns = time.time_ns()
    values = dataclasses.asdict(ranged(now_ns, 80.0))
    del values["variance"]
    peer.advertise("/imu/data", ros.Imu)
    matched(peer, flying)
    peer.write("/imu/data", imu(now_ns))
    wait_for(lambda: flying.node.spin(0.02))
    peer.write("/range", humble(**{**values, "header": ros.Header(stamp(now_ns), "range")}))
    peer.advertise("/cam/image_raw", ros.Image)
    matched(peer, flying)
    peer.write("/cam/image_raw", image(now_ns))
    seen = flying.read()
    flying.node.close()
    assert seen.telemetry.agl_m == pytest.approx(80.0)


# Out of the program.


class Publishing:
    """A publisher in this process behind the true gate; its subscriber is the peer."""

    def __init__(self, env, peer, *words, **options):
        self.time = Time()
        self.node = Node(ros_arguments(words, env))
        self.out = Ros2Publisher(self.node, FRAME, lambda: 5 * S, **options)
        self.gate = Gate(GateRules(), Clock.BOOT)
        self.whole = Publisher(self.gate, self.time.clocks, graph=self.out)
        self.peer = peer
        for topic, kind in {
            f"{self.node.arguments.full_name}/fix": ros.NavSatFix,
            f"{self.node.arguments.full_name}/pose": ros.PoseWithCovarianceStamped,
            "/diagnostics": ros.DiagnosticArray,
        }.items():
            peer.subscribe(topic, kind)
        wait_for(self.matched, "discovery")

    def matched(self):
        wanted = [w for w in self.node._writers if not w[0].endswith("/origin")]
        return all(w[2].get_publication_matched_status().current_count for w in wanted)

    def publish(self, outcome, stamp_ns=7 * S, reported=None):
        self.time.go(0.2)
        exposed_ns = self.time.now_ns - 10**8
        result = ViewResult("a", stamp_ns, outcome, 1.0, "tracking")
        return self.whole.publish(result, exposed_ns, reported or VehicleState(None), judged=True)


@pytest.fixture
def publishing(env, peer):
    made = []

    def start(*words, **options):
        made.append(Publishing(env, peer, *words, **options))
        return made[-1]

    yield start
    for each in made:
        each.node.close()


COV = np.array([[16.0, 1.5], [1.5, 25.0]])


def fix(cov_en_m2=COV, **values):
    return dataclasses.replace(fix_of(**values), cov_en_m2=cov_en_m2)


def test_a_position_is_published_as_fix_and_pose(peer, publishing):
    flying = publishing()
    ned = Rotation.from_euler("ZYX", (30.0, 5.0, -3.0), degrees=True).as_matrix()
    outcome = fix(lat_deg=47.01, lon_deg=8.02, cov_en_m2=COV)
    sent = flying.publish(outcome, 7 * S + 5, VehicleState(ned))
    assert sent == ("NavSatFix", "PoseWithCovarianceStamped")
    (found,) = wait_for(lambda: peer.heard("/orthonav/fix"))
    assert (found.latitude, found.longitude) == (47.01, 8.02) and math.isnan(found.altitude)
    assert found.header == ros.Header(ros.Time(7, 5), "base_link")
    assert (found.status.status, found.status.service, found.position_covariance_type) == (0, 0, 3)
    full = np.reshape(found.position_covariance, (3, 3))  # east, north, up
    assert full[:2, :2] == pytest.approx(COV) and full[2, 2] > 1e6 and not full[2, :2].any()
    (pose,) = wait_for(lambda: peer.heard("/orthonav/pose"))
    assert pose.header == ros.Header(ros.Time(7, 5), "map")
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


def test_covariances_are_for_filters(peer, publishing):
    flying = publishing()
    flying.publish(fix())
    flying.publish(fix(), 8 * S)  # 0.2 s later
    wait_for(lambda: len(peer.heard("/orthonav/fix")) > 1)
    first, again = peer.heard("/orthonav/fix")
    averaged = messages_averaged(0.2)
    found = [np.reshape(each.position_covariance, (3, 3))[:2, :2] for each in (first, again)]
    assert found[0] == pytest.approx(COV) and found[1] == pytest.approx(COV * averaged)
    wait_for(lambda: len(peer.heard("/orthonav/pose")) > 1)
    full = np.reshape(peer.heard("/orthonav/pose")[1].pose.covariance, (6, 6))
    assert full[:2, :2] == pytest.approx(COV * averaged)


def test_covariances_of_the_fix_on_request(env, peer, publishing):
    flying = publishing("-p", "covariance:=fix")
    for time_s in (7, 8, 9):
        flying.publish(fix(), time_s * S)
    wait_for(lambda: len(peer.heard("/orthonav/fix")) > 2)
    for each in peer.heard("/orthonav/fix"):
        full = np.reshape(each.position_covariance, (3, 3))
        assert full[:2, :2] == pytest.approx(COV)


@pytest.mark.parametrize(
    ("asked", "expected"),
    [("none", math.nan), ("terrain", 512.0), ("home", 260.0), ("-3.5", -3.5)],
)
def test_an_altitude_on_request(peer, publishing, asked, expected):
    flying = publishing("-p", f"altitude:={asked}", origin_alt_m=200.0)
    flying.publish(fix(), reported=VehicleState(None, amsl_m=512.0, home_m=60.0))
    (found,) = wait_for(lambda: peer.heard("/orthonav/fix"))
    assert found.altitude == pytest.approx(expected, nan_ok=True)
    assert found.position_covariance[8] > 1e6  # not measured


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"confidence": 0.5}, "low_confidence"),
        ({"confidence": math.nan}, "low_confidence"),
        ({"cov_en_m2": np.eye(2) * 1e6}, "too_uncertain"),
        ({"cov_en_m2": np.full((2, 2), math.nan)}, "no_covariance"),
    ],
)
def test_withheld_positions_are_not_published(peer, publishing, changes, reason):
    flying = publishing()
    assert flying.publish(fix(**changes)) == ()
    assert flying.gate.withheld[reason] == 1
    flying.publish(fix(lat_deg=47.0, lon_deg=8.0))  # reliable and in order: it would be second
    (found,) = wait_for(lambda: peer.heard("/orthonav/fix"))
    assert found.latitude == 47.0
    assert len(wait_for(lambda: peer.heard("/orthonav/pose"))) == 1


def test_the_publisher_itself_refuses_a_low_confidence(publishing):
    flying = publishing()
    with pytest.raises(EstimateError, match="NavSatFix"):
        flying.out.position(
            NavigationEstimate(47.0, 8.0, COV, 0.5, utc_ns=1), VehicleState(None), 1
        )


def test_a_dry_run_sends_health_and_no_position(peer, publishing):
    flying = publishing(silent=True)
    assert flying.publish(fix()) == ()
    flying.whole.health({"health": "OK", "reasons": []})
    wait_for(lambda: peer.heard("/diagnostics"))
    assert peer.heard("/orthonav/fix") == peer.heard("/orthonav/pose") == []


def test_the_origin_is_latched_for_later_subscribers(peer, publishing):
    publishing()
    peer.subscribe("/orthonav/origin", ros.GeoPointStamped, RELIABLE, TRANSIENT_LOCAL)
    (found,) = wait_for(lambda: peer.heard("/orthonav/origin"))
    assert (found.position.latitude, found.position.longitude) == (47.0, 8.0)
    assert math.isnan(found.position.altitude) and found.header.frame_id == "map"


def test_health_is_a_diagnostic(peer, publishing):
    flying = publishing("-r", "__node:=down")
    for level, reasons in (("OK", []), ("DEGRADED", ["lost"]), ("FAILED", ["no_camera"])):
        flying.whole.health(
            {"health": level, "reasons": reasons, "state": None, "counts": {"late": 2}}
        )
    found = wait_for(lambda: len(peer.heard("/diagnostics")) == 3 and peer.heard("/diagnostics"))
    assert [int.from_bytes(bytes([each.status[0].level])) for each in found] == [0, 1, 2]
    assert [each.status[0].message for each in found] == ["OK", "lost", "no_camera"]
    values = {each.key: each.value for each in found[1].status[0].values}
    assert values == {
        "health": "DEGRADED",
        "reasons": "lost",
        "state": "",
        "counts.late": "2",
    }
    assert found[0].status[0].name == "down: position" and found[0].header.stamp.sec == 5


def test_a_subscriber_whose_qos_cannot_match_is_named(env, peer, publishing):
    flying = publishing()
    peer.subscribe("/orthonav/fix", ros.NavSatFix, RELIABLE, TRANSIENT_LOCAL)

    def found():
        flying.node.check_graph({})
        return flying.node.problems.get("/orthonav/fix")

    assert "durability" in wait_for(found)
    flying.whole.health({"health": "OK", "reasons": []})
    (said,) = wait_for(lambda: peer.heard("/diagnostics"))
    assert "/orthonav/fix" in said.status[0].message and said.status[0].level == 1
    del peer._readers["/orthonav/fix"]  # it leaves
    wait_for(lambda: found() is None)
    flying.whole.health({"health": "OK", "reasons": []})
    said = wait_for(lambda: peer.heard("/diagnostics")[1:])[0]
    assert (said.status[0].message, said.status[0].level) == ("OK", 0)


# The whole command in a process of its own, over the loopback.

HEADING, SPEED_MPS, COUNT, EVERY_S = 60.0, 14.0, 30, 0.4
ENOUGH = 3


@pytest.fixture(scope="module")
def flown(made_once, make_ortho, tmp_path_factory):
    """A map, a bag over it with a GNSS receiver that lies, its frame and the true places."""
    folder = tmp_path_factory.mktemp("ros2")
    _, path, frame = known_map(made_once, make_ortho)
    messages, rng, begin_ns = Messages(), np.random.default_rng(0), 1_700_000_000 * S
    along = np.array([math.sin(math.radians(HEADING)), math.cos(math.radians(HEADING))])
    topics = {name: [] for name in ("/cam/image_raw", "/imu/data", "/range", "/gps/fix")}
    truth = {}
    for number in range(COUNT):
        place = np.array([-110.0, -70.0]) + number * EVERY_S * SPEED_MPS * along
        grey = rendered(GROUND, place, (HEADING, 0.0, 0.0), AGL_M, CAMERA)
        grey = np.clip(0.75 * grey + 30 + rng.normal(0, 6, grey.shape), 0, 255).astype(np.uint8)
        time_ns = begin_ns + S + round(number * EVERY_S * S)
        topics["/cam/image_raw"].append((time_ns, messages.image(time_ns, grey)))
        truth[time_ns - begin_ns] = place
    matrix = [CAMERA.fx_px, 0, CAMERA.cx_px - 0.5, 0, CAMERA.fy_px, CAMERA.cy_px - 0.5, 0, 0, 1]
    info = messages.camera_info(
        width=CAMERA.width_px, height=CAMERA.height_px, k=np.array(matrix, dtype=np.float64)
    )
    topics["/cam/camera_info"] = [(begin_ns, info)]
    for step in range(round((COUNT * EVERY_S + 1.5) / 0.05)):
        time_ns = begin_ns + step * 50_000_000
        turn = messages.turn(90.0 - HEADING)
        topics["/imu/data"].append((time_ns, messages.imu(time_ns, turn)))
        height = messages.range(time_ns, AGL_M)
        height.max_range = 200.0
        topics["/range"].append((time_ns, height))
        if step % 20 == 0:
            topics["/gps/fix"].append((time_ns, messages.fix(time_ns, 10.0, 20.0)))
    return path, record(folder / "bag", topics, messages), frame, truth


def process(env, errors, *arguments):
    program = "import sys; from orthonav.cli import main; sys.exit(main(sys.argv[1:]))"
    with errors.open("w") as stream:
        return subprocess.Popen(
            [sys.executable, "-c", program, *map(str, arguments)],
            env={**os.environ, **env, "OPENBLAS_NUM_THREADS": "1"},
            stderr=stream,
        )


def stopped(running):
    """Ask it to stop and see that it does."""
    running.send_signal(signal.SIGTERM)
    try:
        return running.wait(120)
    finally:
        running.kill()


def views_in(lines):
    return lines.read_text().count('"frame"') if lines.exists() else 0


def replayed(peer, bag, lines, sim_time):
    """Play a bag with stamps of now in real time, or with its own and a clock; the shift in ns.

    With a clock of its own it is played as fast as `lines` say that pictures are placed. It ends
    before its end where enough positions were sent.
    """
    given = 0
    store = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([bag], default_typestore=store) as reader:
        begin_ns = reader.start_time
        shift_ns = 0 if sim_time else time.time_ns() - begin_ns
        begun_s = time.monotonic()
        for connection, time_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/range":
                message.variance = 0.0
            made = ros.native(message, KINDS[connection.topic])
            made.header.stamp = stamp(time_ns + shift_ns)
            picture_comes = connection.topic == "/cam/image_raw"
            if picture_comes and len(peer.heard("/orthonav/fix")) >= ENOUGH:
                break
            if sim_time:
                if picture_comes:
                    wait_for(lambda given=given: views_in(lines) >= given - 1, "a line per picture")
                    given += 1
                peer.write("/clock", ros.Clock(stamp(time_ns)))
            else:
                time.sleep(max(0.0, begun_s + (time_ns - begin_ns) / 1e9 - time.monotonic()))
            peer.write(connection.topic, made)
    return begin_ns + shift_ns


@pytest.mark.long
@pytest.mark.parametrize("sim_time", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_replayed_bag_is_flown(flown, env, peer, tmp_path, sim_time):
    path, bag, frame, truth = flown
    topics = ["/cam/image_raw", "/cam/camera_info", "/imu/data", "/range", "/gps/fix"]
    advertised(peer, *topics, *(["/clock"] if sim_time else []))
    peer.subscribe("/orthonav/fix", ros.NavSatFix)
    peer.subscribe("/orthonav/pose", ros.PoseWithCovarianceStamped)
    peer.subscribe("/diagnostics", ros.DiagnosticArray)
    peer.subscribe("/orthonav/origin", ros.GeoPointStamped, RELIABLE, TRANSIENT_LOCAL)
    errors, lines, flight_log = (tmp_path / name for name in ("errors", "lines.jsonl", "log.mcap"))
    running = process(
        *(env, errors, "fly", path, "--ros2", "--deadline-ms", "60000"),
        *("--jsonl", lines, "--log", flight_log, "--ros-args", *REMAPPED),
        *("-p", f"use_sim_time:={str(sim_time).lower()}"),
    )
    try:
        wait_for(peer.matched, "fly joins the graph")
        begin_ns = replayed(peer, bag, lines, sim_time)
        wait_for(lambda: len(peer.heard("/orthonav/fix")) >= ENOUGH, errors.read_text())
    finally:
        code = stopped(running)
    assert code == 0, errors.read_text()
    written = [json.loads(line) for line in lines.read_text().splitlines()]
    sent = [line for line in written if "frame" in line and line["sent"]]
    for topic in ("/orthonav/fix", "/orthonav/pose"):
        wait_for(lambda topic=topic: len(peer.heard(topic)) >= len(sent), topic)
    fixes, poses = peer.heard("/orthonav/fix"), peer.heard("/orthonav/pose")
    (origin,) = peer.heard("/orthonav/origin")
    assert (origin.position.latitude, origin.position.longitude) == (frame.lat_deg, frame.lon_deg)
    assert len(fixes) == len(poses) >= ENOUGH
    for found, pose in zip(fixes, poses, strict=True):
        time_ns = found.header.stamp.sec * S + found.header.stamp.nanosec
        place = truth[time_ns - begin_ns]  # stamped as its picture
        assert pose.header.stamp == found.header.stamp
        there = frame.en_from_latlon(found.latitude, found.longitude)
        assert np.hypot(*(there - place)) < 6  # and nowhere near what the GNSS receiver says
        where = pose.pose.pose.position
        assert (where.x, where.y) == pytest.approx(there.tolist(), abs=1e-3)
    assert len(sent) == len(fixes) and all(line["confidence"] >= 0.9 for line in sent)
    assert {each.status[0].hardware_id for each in peer.heard("/diagnostics")} == {"orthonav"}
    with next(tmp_path.glob("log_*.mcap")).open("rb") as stream:
        gnss = make_reader(stream).iter_messages(topics=["/orthonav/gnss"])
        first = ros.NavSatFix.deserialize(next(gnss)[2].data)
    assert (first.latitude, first.longitude) == (10.0, 20.0)


@pytest.mark.long
@pytest.mark.parametrize("has_own", [False, True], ids=["", "CYCLONEDDS_URI"])
def test_sigterm_ends_the_wait_for_camera_info(flown, env, peer, tmp_path, has_own):
    """On the loopback by ROS_LOCALHOST_ONLY, as ROS users ask for it."""
    errors = tmp_path / "errors"
    peer.advertise("/cam/image_raw", ros.Image)
    peer.subscribe("/diagnostics", ros.DiagnosticArray)
    local = {**env, "ROS_LOCALHOST_ONLY": "1"} | ({} if has_own else {"CYCLONEDDS_URI": ""})
    running = process(local, errors, "fly", flown[0], "--ros2", "--ros-args", *REMAPPED)
    try:
        wait_for(peer.matched, "fly joins the graph")
        wait_for(lambda: "no message on /cam/camera_info" in errors.read_text())
    finally:
        code = stopped(running)
    assert code == 0 and "--camera" in errors.read_text().splitlines()[-1]
    heard = peer.heard("/diagnostics")
    assert heard[0].status[0].message == "no_camera"  # from the first second on
    assert {each.status[0].level for each in heard} == {2}
    assert "camera_info" in {v.key: v.value for v in heard[0].status[0].values}["waiting"]


def test_conflicting_options_end_with_one_line(flown, run, env):
    path = flown[0]
    for words, said in (
        (["0", "--ros2"], "--ros2 replaces"),
        (["--ros2", "--autopilot", "udpin:0"], "--ros2 replaces"),
        (["--ros-args", "-r", "a:=b"], "needs --ros2"),
        ([], "--ros2"),
        (["--ros2", "--ros-args", "-r", "a"], "FROM:=TO"),
    ):
        done = run("fly", path, *words)
        assert done.code == 2 and said in done.err and done.err.count("\n") == 1
