"""`orthonav fly --ros2` among real nodes of ROS 2 (`rclpy` from PyPI, Fast DDS), in environments of
their own, see tools/ros2_environment.py. All processes stay on the loopback."""

import json
import math
import os
import random
import signal
import subprocess
import sysconfig
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import ros2_environment
from bags import Messages
from blots import AGL_M, CAMERA, GROUND, known_map, rendered
from mcap.reader import make_reader

import orthonav
from helpers import wait_for

pytestmark = pytest.mark.long
PEER = Path(__file__).with_name("rclpy_peer.py")
PROGRAM = (
    "import sys; from orthonav.cli import main; from orthonav.onboard import fly;"
    "fly.MAX_AGE_S = 5.0; sys.exit(main(sys.argv[1:]))"
)
FLY = "-c", PROGRAM, "fly"
HEADING, SPEED_MPS, COUNT, EVERY_S = 60.0, 14.0, 40, 0.4
ENOUGH = 5
LONGEST_S = 120.0
INPUTS = "-r", "image:=/cam/image_raw"


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
    made = {k: v for k, v in os.environ.items() if not k.startswith(("ROS_", "AMENT_"))}
    made.pop("PYTHONPATH", None)
    domain = random.Random(os.urandom(8)).randint(1, 100)
    made |= {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return made | {"OPENBLAS_NUM_THREADS": "1"}


class Flying:
    """`orthonav fly --ros2` in a process of the environment of a distribution."""

    def __init__(self, env, folder, distribution, *words, ros=INPUTS):
        name, python = distribution
        paths = str(Path(orthonav.__file__).parents[1]), sysconfig.get_paths()["platlib"]
        env = {**env, "ROS_DISTRO": name, "PYTHONPATH": os.pathsep.join(paths)}
        words = [python, *FLY, *map(str, words), "--ros2", "--ros-args", *ros]
        self.errors = folder / "errors"
        with self.errors.open("w") as stream:
            self.process = subprocess.Popen(words, env=env, stderr=stream)

    def said(self):
        return self.errors.read_text()

    def wait_for(self, condition):
        """What the condition gives; a failure with what was said where the process has ended."""
        return wait_for(condition, self.said, self.process)

    def stop(self, number=signal.SIGINT):
        self.process.send_signal(number)
        try:
            return self.process.wait(LONGEST_S)
        finally:
            self.process.kill()


@pytest.fixture
def fly(env, distribution, tmp_path):
    """Function that starts a flight, which ends with the test."""
    started = []

    def start(*words, **options):
        started.append(Flying(env, tmp_path, distribution, *words, **options))
        return started[-1]

    yield start
    for each in started:
        each.process.kill()
        each.process.wait()


@pytest.fixture
def hear(env, distribution):
    """Function that gives what a node of ROS hears, by kind, see rclpy_peer.py."""

    def peer(*words):
        done = subprocess.run(
            [distribution[1], PEER, *map(str, words)],
            env=env,
            capture_output=True,
            text=True,
            timeout=2 * LONGEST_S,
        )
        assert done.returncode == 0, done.stderr
        heard = defaultdict(list)
        for line in map(json.loads, done.stdout.splitlines()):
            for kind in ("fix", "pose", "image", "level", "log", "nodes"):
                if kind in line:
                    heard[kind].append(line)
        return heard

    return peer


@pytest.mark.parametrize("simulated", [False, True], ids=["", "use_sim_time"])
def test_a_flight_in_a_graph(flown, fly, hear, tmp_path, simulated):
    path, frame, flight, places = flown
    lines = tmp_path / "lines.jsonl"
    ros = [*INPUTS, "-p", "covariance:=fix", "-p", "altitude:=321"]
    ros += ["-p", f"use_sim_time:={str(simulated).lower()}"]
    outputs = "--log", tmp_path / "log.mcap", "--jsonl", lines
    flying = fly(path, *outputs, ros=ros)
    reminder = "no message on /cam/camera_info"
    flying.wait_for(lambda: reminder in flying.said())

    def heard_waiting():  # each time a publisher comes and leaves
        heard = hear("-", "--seconds", 2)
        is_latched = any(reminder in each["log"] for each in heard["log"])  # said before
        return heard["level"] if is_latched else None

    status = flying.wait_for(heard_waiting)[-1]
    words = flight, "--seconds", LONGEST_S, "--enough", ENOUGH
    heard = hear(*words, *(["--simulated"] if simulated else []))
    flying.wait_for(lambda: '"sent": ["NavSatFix' in lines.read_text())
    flying.wait_for(lambda: hear("-", "--seconds", 2)["level"])  # it goes on without the camera
    assert flying.stop() == 0, flying.said()

    assert (status["level"], status["message"]) == (2, "no_camera")
    assert "/cam/camera_info" in status["values"]["waiting"]
    number = {each["stamp_ns"]: each["image"] for each in heard["image"]}
    poses = {each["stamp_ns"]: each["pose"] for each in heard["pose"]}
    assert "orthonav" in heard["nodes"][0]["nodes"]
    assert len(heard["fix"]) >= ENOUGH, flying.said()
    for each in heard["fix"]:  # stamped as its image
        lat, lon, altitude = each["fix"]
        there = frame.en_from_latlon(lat, lon)  # nowhere near what the receiver says
        assert np.hypot(*(there - places[number[each["stamp_ns"]]])) < 6
        assert altitude == 321 and 0 < each["var_m2"] < 36
        if each["stamp_ns"] in poses:
            assert poses[each["stamp_ns"]] == pytest.approx(there.tolist(), abs=1e-3)
    for text in ("QoS", "invalid", "cannot be used", "expected"):
        assert text not in flying.said()
    with next(tmp_path.glob("log_*.mcap")).open("rb") as stream:
        _, _, logged = next(make_reader(stream).iter_messages(topics=["/orthonav/gnss"]))
    sample = Messages().store.deserialize_cdr(logged.data, "sensor_msgs/msg/NavSatFix")
    assert (sample.latitude, sample.longitude) == (10.0, 20.0)


def test_types_and_qos_that_do_not_match_are_named(flown, env, fly, distribution):
    """A camera with best effort where every part is wanted, a number in place of a range, a
    subscriber that wants positions of before it came, and a parameter that there is not."""
    flying = fly(flown[0], ros=[*INPUTS, "-p", "image_reliability:=reliable", "-p", "odd:=1"])
    words = [distribution[1], PEER, "odd", "--seconds", str(LONGEST_S)]
    odd = subprocess.Popen(words, env=env, stderr=subprocess.PIPE, text=True)
    named = (
        "'/cam/image_raw', offering incompatible QoS",
        "'/orthonav/fix', requesting incompatible",
        "topic /range is of type std_msgs/msg/Float64; expected sensor_msgs/msg/Range",
        "parameter odd is ignored; parameters are use_sim_time, image_transport",
    )

    def all_named():
        assert odd.poll() is None, odd.stderr.read()
        return all(each in flying.said() for each in named)

    with odd:
        try:
            flying.wait_for(all_named)
        finally:
            odd.kill()
    assert flying.stop() == 0, flying.said()


def test_names_follow_the_namespace_and_parameters_the_file(flown, fly, tmp_path):
    params = tmp_path / "params.yaml"
    params.write_text("/**:\n  ros__parameters: {image_transport: compressed, altitude: 12.5}\n")
    words = [*INPUTS, "-r", "__ns:=/uav", "-r", "__node:=down", "--params-file", params]
    flying = fly(flown[0], ros=list(map(str, words)))
    flying.wait_for(lambda: "no message on /cam/camera_info" in flying.said())
    assert flying.stop() == 0, flying.said()


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["-r", "image"], 2, "--ros-args cannot be used: "),
        (["--unknown"], 2, "'--unknown'"),
        (["-p", "covariance:=mine"], 2, "filter or fix, got 'mine'"),
    ],
)
def test_invalid_arguments_are_one_line(flown, fly, words, code, said):
    flying = fly(flown[0], ros=words)
    assert flying.process.wait(LONGEST_S) == code, flying.said()
    assert said in flying.said().splitlines()[-1] and "Traceback" not in flying.said()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_the_wait_for_a_camera(flown, fly, number):
    flying = fly(flown[0])
    flying.wait_for(lambda: "no message on /cam/camera_info" in flying.said())
    assert flying.stop(number) == 0, flying.said()
    assert "--camera" in flying.said().splitlines()[-1]


def test_a_graph_that_cannot_be_joined_is_one_line(flown, env, fly):
    env["ROS_DOMAIN_ID"] = "here"
    flying = fly(flown[0])
    assert flying.process.wait(LONGEST_S) == 1, flying.said()
    assert "error: cannot join the ROS graph: " in flying.said().splitlines()[-1]
    assert "Traceback" not in flying.said()
