"""Looped flights, the fake autopilot, and figures of flights."""

import json
import math
import os
import socket
import time

import cv2
import numpy as np
import pytest
from benchmarks.looped_flight import played, rest_of, views_of
from benchmarks.pair import Arrivals, FakeAutopilot, Fly, Lines, free_port, on_core, sample
from pymavlink.dialects.v20 import common as mavlink

from benchmarks import soak
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.geo.frames import LocalFrame

FRAME, SPEED_MPS, STEP_S, VIEWS = LocalFrame(48.0, 2.0), 25.0, 0.1, 8


@pytest.fixture(scope="module")
def lap(tmp_path_factory):
    """A lap of a few tiny pictures eastwards; its last view is 5 m short of the first."""
    folder = tmp_path_factory.mktemp("flown") / "lap"
    (folder / "frames").mkdir(parents=True)
    camera = {"width_px": 8, "height_px": 6, "fx_px": 5, "fy_px": 5, "cx_px": 4, "cy_px": 3}
    (folder / "flight.json").write_text(json.dumps({"camera": camera}))
    telemetry = ["frame,time_s,yaw_deg,pitch_deg,roll_deg,agl_m,vel_east_mps,vel_north_mps"]
    true = ["frame,lat_deg,lon_deg"]
    for index in range(VIEWS):
        name, angle = f"{index:02d}.png", math.tau * index / VIEWS
        cv2.imwrite(str(folder / "frames" / name), np.full((6, 8), index, np.uint8))
        radius_m = SPEED_MPS * STEP_S / (2 * math.sin(math.pi / VIEWS))
        lat, lon = FRAME.latlon_from_en(radius_m * np.array([math.sin(angle), math.cos(angle)]))
        telemetry.append(f"{name},{index * STEP_S:.3f},{90.0 + index},0,0,{100.0 + index},25,0")
        true.append(f"{name},{float(lat):.9f},{float(lon):.9f}")
    (folder / "telemetry.csv").write_text("\n".join(telemetry) + "\n")
    (folder / "truth.csv").write_text("\n".join(true) + "\n")
    return folder


def test_a_lap_repeats_with_continuous_time(lap, tmp_path):
    folder = played(lap, tmp_path / "played", 20, lead_s=3.0)
    flight = open_flight(folder)
    times_s = np.array([view.telemetry.time_ns / 1e9 for view in flight.views])
    assert np.diff(times_s) == pytest.approx(STEP_S, abs=1e-5)  # over the joints too
    assert times_s[0] == 3.0
    assert [int(view.grey()[0, 0]) for view in flight.views] == [n % VIEWS for n in range(20)]
    assert len(read_truth(folder / "truth.csv")) == views_of(folder) == 20


def test_every_other_view_from_anywhere(lap, tmp_path):
    flight = open_flight(played(lap, tmp_path / "played", 6, every=2, first=5))
    assert [int(view.grey()[0, 0]) for view in flight.views] == [5, 7, 1, 3, 5, 7]
    times_s = [view.telemetry.time_ns / 1e9 for view in flight.views]
    assert np.diff(times_s) == pytest.approx(2 * STEP_S, abs=1e-5)


def test_a_late_start_plays_the_remaining_views(lap, tmp_path):
    folder = played(lap, tmp_path / "played", 10)
    rest = open_flight(rest_of(folder, tmp_path / "rest", 0.35))
    assert [int(view.grey()[0, 0]) for view in rest.views] == [4, 5, 6, 7, 0, 1]
    assert rest.views[0].telemetry.time_ns == pytest.approx(0.4e9)


def test_the_fake_autopilot_sends_telemetry_and_times_arrivals(lap, tmp_path):
    """A message of the third view, sent 80 ms after its exposure, 3 m south of the truth."""
    folder, port = played(lap, tmp_path / "played", 6, lead_s=0.3), free_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours:
        ours.bind(("127.0.0.1", port))
        ours.settimeout(60)
        reader = mavlink.MAVLink(None)
        core = min(os.sched_getaffinity(0))
        with FakeAutopilot(folder, port, core) as fake_autopilot:
            kinds = set()
            while kinds < {"HEARTBEAT", "ATTITUDE", "DISTANCE_SENSOR", "LOCAL_POSITION_NED"}:
                data, address = ours.recvfrom(1000)
                kinds |= {each.get_type() for each in reader.parse_buffer(data)}
            lat, lon = list(read_truth(folder / "truth.csv").values())[2]
            fake_autopilot.wait_until(0.5 + 0.08)
            age_s = (time.monotonic_ns() - fake_autopilot.mono_ns(0.5)) / 1e9
            message = mavlink.MAVLink_global_position_sensor_message(
                0, 0, 1, round(time.time() * 1e6), round(age_s * 1e6), 1, 0,
                round((lat - 3 / 111_194.9) * 1e7), round(lon * 1e7), 0, 0, 2.0, 0,
            )  # fmt: skip
            ours.sendto(message.pack(mavlink.MAVLink(None, 1, 197)), address)
            came_ns = fake_autopilot.position_after(fake_autopilot.begin_ns, 60)
        assert came_ns is not None
        arrivals = Arrivals.of(fake_autopilot)
    assert arrivals.view.tolist() == [2]
    assert arrivals.latency_ms[0] >= age_s * 1e3
    assert arrivals.error_m[0] == pytest.approx(3.0, abs=0.1)
    assert abs(arrivals.clock_ms[0]) < 200  # the clocks are read one after the other


def test_a_process_is_sampled_until_it_ends(tmp_path, monkeypatch):
    core = max(os.sched_getaffinity(0))
    with on_core(core):
        assert os.sched_getaffinity(0) == {core}
    seen = sample(os.getpid(), core)
    assert 0 < seen.rss_mb <= seen.peak_mb
    assert 0 < seen.cpu_s < seen.core_s
    with Fly(["--help"], core, tmp_path / "errors.txt") as fly:
        fly.watch(every_s=0.02)
    assert fly.process.returncode == 0
    assert fly.samples[0].rss_mb > 1
    assert sample(fly.process.pid, core) is None


def test_lines_of_a_killed_program_are_read(tmp_path):
    path = tmp_path / "lines.jsonl"
    health = {"health": "DEGRADED", "reasons": ["searching"], "counts": {"taken": 2}}
    views = [
        {"frame": "1", "age_ms": 40.0, "sent": []},
        {"frame": "2", "age_ms": 50.0, "sent": ["A"]},
    ]
    path.write_text("\n".join([*map(json.dumps, (health, *views, health)), '{"frame": "3", "ag']))
    lines = Lines.read(path)
    assert lines.ages_ms.tolist() == [40.0, 50.0]
    assert lines.reasons == {"searching": 2}
    assert lines.health["counts"] == {"taken": 2}
    assert Lines.read(tmp_path / "none").health == {}


def test_the_slope_separates_growth_of_memory_from_steps():
    hours, rng = np.linspace(0, 1, 1200), np.random.default_rng(0)
    steps = 2 * (np.cumsum(rng.normal(size=1200)) > 0)
    filling = 50 * (1 - np.exp(-hours / 0.03))
    still, spread = soak.slope(hours, 200 + filling + steps)
    assert abs(still) < 3 * spread + 0.1
    grown, spread = soak.slope(hours, 200 + filling + 12 * hours + rng.normal(0, 0.3, 1200))
    assert grown == pytest.approx(12, abs=1)
    assert spread < 0.5
