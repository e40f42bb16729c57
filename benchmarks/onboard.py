"""`orthonav fly` in real time: latency, load of its core, starts and restarts.

A lap of a simulated flight is rendered once and played round and round. `orthonav fly` runs as a
process of its own on one core, a fake autopilot and all else on another.
"""

import argparse
import contextlib
import csv
import json
import math
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from benchmarks.record import Section, Table, number, quantiles, read_rows, run, say
from benchmarks.scenes import PAST, PRESENT, area, map_of
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.geo import camera
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.mapfile import open_map
from orthonav.ground.planning.route import Route
from orthonav.ground.simulate import render
from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight

CAMERA = Camera(
    1280, 960, 1000.0, 1000.0, 646.0, 474.0, distortion=(-0.12, 0.05, 0.0005, -0.0003, 0.0)
)
"""A wide board camera: 65 x 51 deg, and a lens that bends the rim by 17 px."""
AGL_M, SPEED_MPS = 250.0, 25.0
HALF_M, TURN_RADIUS_M = 300.0, 120.0
LINE_EN_M = ((0, 1), (1, 1), (1, -1), (-1, -1), (-1, 1), (0, 1))
"""Corners of a lap in `HALF_M` from the middle of the map; it ends where it begins."""
SEED = 7
ERRORS = Errors(
    yaw_std_deg=0.5,
    agl_std=0.01,
    tilt_std_deg=1.0,
    yaw_bias_deg=3.0,
    agl_bias=0.03,
    pitch_bias_deg=0.5,
    velocity_drift=0.02,
)
CAMERA_HZ, RATES_HZ = 10, (5, 10)
LEAD_S = 4.0
"""The autopilot is up before the first picture: the program has started by then."""
MOST_WAIT_S = {"known": 30.0, "unknown": 90.0}
FLOWN_ON_S = 5.0
POSITION = "GLOBAL_POSITION_SENSOR"
ALLOWED = sorted(os.sched_getaffinity(0))
FLYING, OTHER = ALLOWED[-1], ALLOWED[0]
"""Core of the measured process and core of all others; the same on a single-core machine."""
STARTS = {
    "known": "cold start, heading known",
    "unknown": "cold start, heading unknown",
    "restart": "killed in flight, started again with --state",
}
Array = NDArray[np.float64]
Rows = list[dict[str, str]]


@contextlib.contextmanager
def on_core(core: int) -> Iterator[None]:
    """This thread, and what it starts meanwhile, on one core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def rendered(work: Path, ortho: Path, frame: LocalFrame, short: bool) -> Path:
    """Flight folder of a lap at `CAMERA_HZ`, rendered once; short: a side and a half."""
    folder = work / f"lap-{CAMERA_HZ}-hz{'-short' * short}"
    if not folder.is_dir():
        lat, lon = frame.latlon_from_en(np.array(LINE_EN_M[-3:] if short else LINE_EN_M) * HALF_M)
        request = SimulateRequest(
            [ortho],
            folder,
            route=Route(tuple(zip(lat.tolist(), lon.tolist(), strict=True))),
            agl_m=AGL_M,
            spacing_m=SPEED_MPS / CAMERA_HZ,
            airspeed_mps=SPEED_MPS,
            camera=CAMERA,
            errors=ERRORS,
            seed=SEED,
            turn_radius_m=TURN_RADIUS_M,
        )
        with patch.object(render, "undistort", _once(camera.undistort)):
            simulate_flight(request)
    return folder


def _once(undistort: Callable[[Camera, Array], Array]) -> Callable[[Camera, Array], Array]:
    """The lens undone for all pixels takes seconds, and is the same for every view."""
    found: dict[tuple[Camera, int], Array] = {}

    def once(camera: Camera, xy: Array) -> Array:
        key = camera, len(xy)
        if key not in found:
            found[key] = undistort(camera, xy)
        return found[key]

    return once


def played(
    lap: Path, out: Path, views: int, *, every: int, first: int = 0, lead_s: float = 0.0
) -> Path:
    """A flight folder of so many views of a lap, `every` so many, round and round.

    It begins with view `first`, at `lead_s`. Its pictures are those of the lap, under a name for
    each round, so an hour takes no more room than a lap.
    """
    rows, truth = read_rows(lap / "telemetry.csv"), read_rows(lap / "truth.csv")
    places = list(read_truth(lap / "truth.csv").values())
    closing_m = math.hypot(*LocalFrame(*places[0]).en_from_latlon(*places[-1]).tolist())
    times_s = np.array([float(row["time_s"]) for row in rows])
    period_s = float(times_s[-1]) + closing_m / SPEED_MPS
    shutil.rmtree(out, ignore_errors=True)
    (out / "frames").mkdir(parents=True)
    telemetry: Rows = []
    true: Rows = []
    for at in range(first, first + views * every, every):
        turn, index = divmod(at, len(rows))
        frame = f"{turn:04d}/{rows[index]['frame']}"
        time_s = lead_s + turn * period_s + float(times_s[index] - times_s[first])
        telemetry.append({**rows[index], "frame": frame, "time_s": f"{time_s:.9f}"})
        true.append({**truth[index], "frame": frame})
        link = out / "frames" / f"{turn:04d}"
        if not link.is_symlink():
            link.symlink_to((lap / "frames").resolve(), target_is_directory=True)
    _write(out / "telemetry.csv", telemetry)
    _write(out / "truth.csv", true)
    shutil.copyfile(lap / "flight.json", out / "flight.json")
    return out


def rest_of(folder: Path, out: Path, from_s: float) -> Path:
    """The views of a played flight from a time on, as from a camera that starts then."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    rows = [row for row in read_rows(folder / "telemetry.csv") if float(row["time_s"]) >= from_s]
    _write(out / "telemetry.csv", rows)
    shutil.copyfile(folder / "flight.json", out / "flight.json")
    (out / "frames").symlink_to((folder / "frames").resolve(), target_is_directory=True)
    return out


def _write(path: Path, rows: Rows) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


class FakeAutopilot:
    """The process of the fake autopilot; what it receives is a line of a file."""

    def __init__(self, flight: Path, port: int) -> None:
        """Returns when its clock has begun."""
        self._flight, self._out = flight, flight.with_name(f"{flight.name}-heard.jsonl")
        program = Path(__file__).parents[1] / "examples" / "simulated_autopilot.py"
        # 49 attitudes a second: exposures fall anywhere between two.
        options = ("--url", f"127.0.0.1:{port}", "--rate-hz", "49", "--messages", "--tail-s", "5")
        command = [sys.executable, str(program), str(flight), *options]
        with on_core(OTHER), self._out.open("w") as out:
            self._process = subprocess.Popen(command, stdout=out)
        while not self._lines() and self._process.poll() is None:
            time.sleep(0.01)
        self.begin_ns = int(self._lines()[0]["begin_ns"])
        self._utc_ahead_ns = time.time_ns() - time.monotonic_ns()

    def _lines(self) -> list[dict[str, Any]]:
        text = self._out.read_text(encoding="utf-8")
        return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]

    @property
    def positions(self) -> list[dict[str, Any]]:
        """Messages with a position so far."""
        return [line for line in self._lines()[1:] if line["name"] == POSITION]

    def position_after(self, mono_ns: int, timeout_s: float) -> int | None:
        """When the first position came after a moment, waiting so long; None if none did."""
        until_s = time.monotonic() + timeout_s
        while True:
            found = (each["at_ns"] for each in self.positions if each["at_ns"] > mono_ns)
            at_ns: int | None = next(found, None)
            if at_ns is not None or time.monotonic() > until_s:
                return at_ns
            time.sleep(0.05)

    def mono_ns(self, flight_s: float) -> int:
        """When a time of the flight is, by the monotonic clock."""
        return self.begin_ns + round(flight_s * 1e9)

    def arrivals(self) -> tuple[Array, Array]:
        """Of all positions (N,): time from exposure to arrival, ms, and error, m."""
        views = open_flight(self._flight).views
        times_s = np.array([view.telemetry.time_ns / 1e9 for view in views])
        truth, rows = read_truth(self._flight / "truth.csv"), []
        for message in self.positions:
            # The message states its own time; the exposure is before it by its age.
            exposed_us = message["time_usec"] - message["processing_time"]
            since_ns = exposed_us * 1000 - self._utc_ahead_ns - self.begin_ns
            view = int(np.abs(times_s - since_ns / 1e9).argmin())
            frame = LocalFrame(*truth[views[view].frame])
            off = frame.en_from_latlon(message["lat"] * 1e-7, message["lon"] * 1e-7)
            late_ns = message["at_ns"] - self.mono_ns(float(times_s[view]))
            rows.append((late_ns / 1e6, float(np.hypot(*off))))
        latency_ms, error_m = np.array(rows, np.float64).reshape(-1, 2).T
        return latency_ms, error_m

    def __enter__(self) -> "FakeAutopilot":
        return self

    def __exit__(self, *_: object) -> None:
        """End it; what it heard stays."""
        self._process.terminate()
        self._process.wait(10)


@contextlib.contextmanager
def flying(arguments: Sequence[str], errors: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`orthonav fly` with these arguments on its core; killed at the end, as by a power failure."""
    program = Path(sys.executable).with_name("orthonav")
    script = [str(program)] if program.is_file() else [sys.executable, "-m", "orthonav"]
    with on_core(FLYING), errors.open("ab") as stream:
        process = subprocess.Popen(
            [*script, "fly", *arguments], stdout=subprocess.DEVNULL, stderr=stream
        )
    try:
        yield process
    finally:
        process.kill()
        process.wait(10)


def used(pid: int) -> tuple[float, float, float]:
    """Processor time (s), resident memory and its largest (MB) of a process."""
    stat = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    status = Path(f"/proc/{pid}/status").read_text()
    rss_kb, peak_kb = (
        int(status.partition(f"{name}:")[2].split()[0]) for name in ("VmRSS", "VmHWM")
    )
    cpu_s = (int(stat[11]) + int(stat[12])) / os.sysconf("SC_CLK_TCK")
    return cpu_s, rss_kb * 1024 / 1e6, peak_kb * 1024 / 1e6


@dataclass(frozen=True)
class Scene:
    """What is flown: the map, the pictures of a lap, where files go, and how long."""

    map_path: Path
    lap: Path
    scratch: Path
    quick: bool
    minutes: float

    def arguments(self, name: str, camera: Path, port: int) -> list[str]:
        """Command line as on an aircraft, except that pictures come from a folder."""
        made = [str(self.map_path), str(camera)]
        made += ["--autopilot", f"udpin:{port}", "--log-views", "thumbnails"]
        for option, file in (("--jsonl", "lines.jsonl"), ("--state", "state.json")):
            made += [option, str(self.scratch / f"{name}-{file}")]
        return [*made, "--log", str(self.scratch / f"{name}-log.mcap")]


def free_port() -> int:
    """A free UDP port of the loopback interface."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--part", choices=("flights", "starts"), help="only this part")
    parser.add_argument("--minutes", type=float, default=4.0, help="of a flight at 5 Hz")


def measure(options: argparse.Namespace) -> Section:
    """Two camera rates, starts and restarts."""
    section, work = Section("On board"), options.work
    past, present = (area(work, date) for date in (PAST, PRESENT))
    map_path = map_of(past, work)
    for end in ("state.json", "lines.jsonl", "log*.mcap"):
        for old in work.glob(f"*-{end}"):
            old.unlink()
    lap = rendered(work, present, open_map(map_path).manifest.sheets[0].frame, options.quick)
    scene = Scene(map_path, lap, work, options.quick, options.minutes)
    with on_core(OTHER):
        if options.part in (None, "flights"):
            section.tables.append(_flights(scene))
        if options.part in (None, "starts"):
            section.tables.append(_starts(scene))
    return section


def _flights(scene: Scene) -> Table:
    rows = []
    for rate_hz in RATES_HZ:
        rows.append(_flown(scene, rate_hz))
        say("  ".join(rows[-1]))
    header = (
        *("camera", "views", "sent", "dropped", "p50 ms", "p95 ms", "p99 ms", "max ms"),
        *("of the core", "peak MB", "MB per hour", "error p50 m", "p95 m", "max m"),
    )
    notes = (
        f"`orthonav fly` on one core, {CAMERA.width_px} x {CAMERA.height_px} px JPEG, 4 km2 map at "
        "1 m, no prior, heading known; log with thumbnails, state and lines written",
        "ms: from exposure to the arrival of GLOBAL_POSITION_SENSOR at a process on the other "
        "core; dropped: a newer image was there or it was too old; MB per hour: growth of the "
        "resident memory after the first fifth",
    )
    return Table("From exposure to message", header, rows, notes)


def _flown(scene: Scene, rate_hz: int) -> list[str]:
    """A flight from a little after the start of the program to the end of the pictures."""
    name, every = f"flight-{rate_hz}", CAMERA_HZ // rate_hz
    views = 34 * rate_hz if scene.quick else round(scene.minutes * 60 * RATES_HZ[0])
    folder = played(scene.lap, scene.scratch / name, views, every=every, lead_s=LEAD_S)
    port = free_port()
    arguments, errors = scene.arguments(name, folder, port), scene.scratch / f"{name}-errors.txt"
    with FakeAutopilot(folder, port) as autopilot, flying(arguments, errors) as process:
        until_ns, samples = autopilot.mono_ns(LEAD_S + views / rate_hz + 30), []
        while process.poll() is None and time.monotonic_ns() < until_ns:
            with contextlib.suppress(OSError, IndexError, subprocess.TimeoutExpired):
                samples.append((time.monotonic(), *used(process.pid)))  # not where it has ended
                process.wait(1.0)
    latency_ms, error_m = autopilot.arrivals()
    begun, ended = samples[len(samples) // 5], samples[-1]
    wall_s, cpu_s, grown_mb = (ended[index] - begun[index] for index in range(3))
    lines = scene.scratch / f"{name}-lines.jsonl"
    located = lines.read_text("ascii").count('"age_ms"') if lines.is_file() else 0
    return [
        *(f"{rate_hz} Hz", str(views), str(latency_ms.size), str(views - located)),
        *quantiles(latency_ms, 50, 95, 99, 100),
        *(f"{cpu_s / wall_s:.0%}", number(ended[3]), f"{grown_mb / wall_s * 3600:+.1f}"),
        *quantiles(error_m, 50, 95, 100),
    ]


def _starts(scene: Scene) -> Table:
    """Cold starts at several places, each killed in flight and started again."""
    count = 2 if scene.quick else 6
    waits: dict[str, list[float]] = {key: [] for key in STARTS}
    for heading in MOST_WAIT_S:
        for index in range(count):
            cold_s, again_s = _start(scene, heading, index, count)
            waits[heading].append(cold_s)
            waits["restart"] += [] if again_s is None else [again_s]
            say(f"start {index + 1}, heading {heading}: {cold_s:.1f} s, again {again_s} s")
    rows = []
    for key, name in STARTS.items():
        found = [wait_s for wait_s in waits[key] if np.isfinite(wait_s)]
        rows.append([name, str(len(waits[key])), str(len(found)), *quantiles(found, 50, 100)])
    notes = (
        f"from starting the process to the arrival of the first message, pictures at {RATES_HZ[0]} "
        "Hz, each start at another place; files are in the page cache",
        f"not found: no message within {MOST_WAIT_S['known']:.0f} s, heading unknown "
        f"{MOST_WAIT_S['unknown']:.0f} s",
    )
    header = ("start", "starts", "found", "median s", "worst s")
    return Table("Until the first message", header, rows, notes)


def _start(scene: Scene, heading: str, index: int, count: int) -> tuple[float, float | None]:
    """Seconds to the first message, infinite without one; the same after a kill, None without."""
    name, rate_hz, most_s = f"start-{heading}-{index}", RATES_HZ[0], MOST_WAIT_S[heading]
    first = index * len(read_rows(scene.lap / "telemetry.csv")) // count
    views = round((most_s + FLOWN_ON_S + MOST_WAIT_S["known"]) * rate_hz)
    every = CAMERA_HZ // rate_hz
    folder = played(scene.lap, scene.scratch / name, views, every=every, first=first)
    port, waits = free_port(), []
    with FakeAutopilot(folder, port) as autopilot:
        time.sleep(max(0.0, (autopilot.mono_ns(1.0) - time.monotonic_ns()) / 1e9))
        for longest_s in (most_s, MOST_WAIT_S["known"]):
            from_s = (time.monotonic_ns() - autopilot.begin_ns) / 1e9
            camera = rest_of(folder, scene.scratch / f"{name}-camera", from_s)
            arguments = [*scene.arguments(name, camera, port), "--heading", heading]
            started_ns = time.monotonic_ns()
            with flying(arguments, scene.scratch / f"{name}-errors.txt"):
                at_ns = autopilot.position_after(started_ns, longest_s)
                waits.append(np.inf if at_ns is None else (at_ns - started_ns) / 1e9)
                if at_ns is None:
                    break
                time.sleep(FLOWN_ON_S)
    return waits[0], waits[1] if len(waits) > 1 else None


if __name__ == "__main__":
    sys.exit(run(measure, add))
