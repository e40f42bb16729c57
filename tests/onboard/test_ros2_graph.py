"""`orthonav fly --ros2` among real nodes of ROS 2 (`rclpy` from PyPI, Fast DDS), in environments of
their own, see tools/ros2_environment.py. All processes stay on the loopback."""

import json
import math
import os
import random
import signal
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

import numpy as np
import pytest
import ros2_environment
from blots import AGL_M, CAMERA, GROUND, known_map, rendered

import orthonav

pytestmark = pytest.mark.long
PEER = Path(__file__).with_name("rclpy_peer.py")
FLY = "-c", "import sys; from orthonav.cli import main; sys.exit(main(sys.argv[1:]))", "fly"
PACKAGE = Path(__file__).parents[2] / "ros2" / "orthonav_ros"
HEADING, SPEED_MPS, COUNT, EVERY_S = 60.0, 14.0, 40, 0.4
ENOUGH = 5
LONGEST_S = 120.0


@pytest.fixture(scope="module")
def flown(made_once, make_ortho, tmp_path_factory):
    """A map, its frame, a flight for the peer and its true places (east, north)."""
    _, path, frame = known_map(made_once, make_ortho)
    rng = np.random.default_rng(0)
    along = np.array([math.sin(math.radians(HEADING)), math.cos(math.radians(HEADING))])
    places = [np.array([-110.0, -70.0]) + n * EVERY_S * SPEED_MPS * along for n in range(COUNT)]
    greys = []
    for place in places:
        grey = rendered(GROUND, place, (HEADING, 0.0, 0.0), AGL_M, CAMERA)
        greys.append(np.clip(0.75 * grey + 30 + rng.normal(0, 6, grey.shape), 0, 255))
    matrix = [CAMERA.fx_px, 0, CAMERA.cx_px - 0.5, 0, CAMERA.fy_px, CAMERA.cy_px - 0.5, 0, 0, 1]
    flight = tmp_path_factory.mktemp("flight") / "flight.npz"
    told = {"every_s": EVERY_S, "yaw_enu_deg": 90 - HEADING, "agl_m": AGL_M, "k": matrix}
    np.savez(flight, greys=np.stack(greys).astype(np.uint8), **told)
    return path, frame, flight, places


@pytest.fixture(params=ros2_environment.DISTRIBUTIONS)
def distribution(request):
    """Name and interpreter of a distribution."""
    python = ros2_environment.python(request.param)
    if python is None:
        pytest.skip(f"no ROS 2 {request.param}: run python tools/ros2_environment.py")
    return request.param, python


@pytest.fixture
def env(monkeypatch):
    """A domain of its own on the loopback, without a sourced ROS."""
    made = {k: v for k, v in os.environ.items() if not k.startswith(("ROS_", "AMENT_", "CYCLONE"))}
    made.pop("PYTHONPATH", None)
    domain = random.Random(os.urandom(8)).randint(1, 100)
    made |= {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return made | {"OPENBLAS_NUM_THREADS": "1"}


class Flying:
    """The program in a process of its own, without ROS or in a sourced environment of it."""

    def __init__(self, env, folder, distribution, sourced, *words):
        name, ros_python = distribution
        source = str(Path(orthonav.__file__).parents[1])
        env = {**env, "PYTHONPATH": source}
        if sourced:
            env |= {"AMENT_PREFIX_PATH": str(ros_python.parents[1]), "ROS_DISTRO": name}
            env["PYTHONPATH"] += os.pathsep + sysconfig.get_paths()["platlib"]
        python = ros_python if sourced else sys.executable
        self.errors = folder / "errors"
        with self.errors.open("w") as stream:
            self.process = subprocess.Popen([python, *words], env=env, stderr=stream)

    def said(self):
        return self.errors.read_text()

    def interrupt(self):
        self.process.send_signal(signal.SIGINT)
        try:
            return self.process.wait(LONGEST_S)
        finally:
            self.process.kill()


def peer(env, distribution, *words):
    """What a node of ROS hears, see rclpy_peer.py."""
    done = subprocess.run(
        [distribution[1], PEER, *map(str, words)],
        env=env,
        capture_output=True,
        text=True,
        timeout=2 * LONGEST_S,
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def of_kind(heard, key):
    return [each for each in heard if key in each]


@pytest.mark.parametrize("sourced", [False, True], ids=["dds", "rclpy"])
def test_a_flight_in_a_graph(flown, env, tmp_path, distribution, sourced):
    path, frame, flight, places = flown
    words = [*FLY, path, "--ros2", "--deadline-ms", "5000", "--ros-args"]
    words += ["-r", "image:=/cam/image_raw", "-p", "covariance:=fix", "-p", "altitude:=321"]
    words += ["-p", "unknown:=1"]
    flying = Flying(env, tmp_path, distribution, sourced, *words)
    try:
        waiting = []
        deadline = time.monotonic() + LONGEST_S
        while not of_kind(waiting, "level"):  # each time a publisher comes and leaves
            assert time.monotonic() < deadline and flying.process.poll() is None, flying.said()
            waiting = peer(env, distribution, "-", "--seconds", 2)
        words = [flight, "--seconds", LONGEST_S, "--enough", ENOUGH, "--reliable"]
        heard = peer(env, distribution, *words)
        time.sleep(1.0)  # the publishers of images and telemetry leave
        assert flying.process.poll() is None, flying.said()
    finally:
        code = flying.interrupt()
    assert code == 0, flying.said()
    status = of_kind(waiting, "level")[-1]
    assert (status["level"], status["message"]) == (2, "no_camera")
    assert "/cam/camera_info" in status["values"]["waiting"]
    assert any("unknown is ignored" in each["log"] for each in of_kind(waiting + heard, "log")) or (
        "unknown is ignored" in flying.said()
    )
    number = {each["stamp_ns"]: each["image"] for each in of_kind(heard, "image")}
    poses = {each["stamp_ns"]: each["pose"] for each in of_kind(heard, "pose")}
    fixes = of_kind(heard, "fix")
    assert "orthonav" in heard[-1]["nodes"]
    assert len(fixes) >= ENOUGH, flying.said()
    for each in fixes:  # stamped as its image
        lat, lon, altitude = each["fix"]
        there = frame.en_from_latlon(lat, lon)
        assert np.hypot(*(there - places[number[each["stamp_ns"]]])) < 6
        assert altitude == 321 and 0 < each["var_m2"] < 36
        if each["stamp_ns"] in poses:
            assert poses[each["stamp_ns"]] == pytest.approx(there.tolist(), abs=1e-3)
    assert "QoS" not in flying.said() and "invalid" not in flying.said()


@pytest.mark.parametrize("sourced", [False, True], ids=["dds", "rclpy"])
def test_qos_that_does_not_match_is_named(flown, env, tmp_path, distribution, sourced):
    """The program wants every part of an image, and the camera publishes with best effort."""
    path, _, flight, _ = flown
    words = [*FLY, path, "--ros2", "--ros-args", "-r", "image:=/cam/image_raw"]
    words += ["-p", "image_reliability:=reliable"]
    flying = Flying(env, tmp_path, distribution, sourced, *words)
    camera = subprocess.Popen([distribution[1], PEER, flight], env=env)
    named = "topic /cam/image_raw a publisher has QoS that does not match ours: reliability"
    try:
        deadline = time.monotonic() + LONGEST_S
        while named not in flying.said():
            assert time.monotonic() < deadline and flying.process.poll() is None, flying.said()
            time.sleep(0.1)
    finally:
        camera.kill()
        camera.wait()
        flying.interrupt()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_the_wait_for_a_camera(flown, env, tmp_path, distribution, number):
    words = [*FLY, flown[0], "--ros2", "--ros-args", "-r", "image:=/cam/image_raw"]
    flying = Flying(env, tmp_path, distribution, True, *words)
    deadline = time.monotonic() + LONGEST_S
    while "camera_info" not in flying.said():
        assert time.monotonic() < deadline and flying.process.poll() is None, flying.said()
        time.sleep(0.1)
    flying.process.send_signal(number)
    assert flying.process.wait(LONGEST_S) == 0, flying.said()
