"""`orthonav fly` in real time: latency, load of its core, starts and restarts."""

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.looped_flight import CAMERA, played, read_rows, rendered, rest_of
from benchmarks.pair import Arrivals, Cores, FakeAutopilot, Fly, free_port, on_core, views_in
from benchmarks.record import Section, Table, number, quantiles, run, say
from benchmarks.scenes import PAST, PRESENT, area, map_of
from orthonav.core.mapfile import open_map

CAMERA_HZ, RATES_HZ = 10, (5, 10)
LEAD_S = 4.0
"""The autopilot is up before the first picture: the program has started by then."""
MOST_WAIT_S = {"known": 30.0, "unknown": 90.0}
FLOWN_ON_S = 5.0


@dataclass(frozen=True)
class Scene:
    """What is flown: the map, the pictures of a lap, where the processes run, and how long."""

    map_path: Path
    lap: Path
    cores: Cores
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
    frame = open_map(map_path).manifest.sheets[0].frame
    lap = rendered(work, present, frame, CAMERA_HZ, short=options.quick)
    scene = Scene(map_path, lap, Cores.chosen(), work, options.quick, options.minutes)
    with on_core(scene.cores.other):
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
        *("of the core", "MB", "peak MB", "MB per hour"),
        *("error p50 m", "p95 m", "max m"),
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
    arguments = scene.arguments(name, folder, port)
    errors = scene.scratch / f"{name}-errors.txt"
    with (
        FakeAutopilot(folder, port, scene.cores.other) as fake_autopilot,
        Fly(arguments, scene.cores.flying, errors) as fly,
    ):
        fly.watch(fake_autopilot.mono_ns(LEAD_S + views / rate_hz + 30))
    arrivals = Arrivals.of(fake_autopilot)
    lines = views_in(scene.scratch / f"{name}-lines.jsonl")
    first, last = fly.samples[len(fly.samples) // 5], fly.samples[-1]
    wall_s = (last.at_ns - first.at_ns) / 1e9
    busy = (last.cpu_s - first.cpu_s) / wall_s
    growth = (last.rss_mb - first.rss_mb) / wall_s * 3600
    return [
        *(f"{rate_hz} Hz", str(views), str(len(arrivals.view)), str(views - lines)),
        *quantiles(arrivals.latency_ms, 50, 95, 99, 100),
        *(f"{busy:.0%}", number(last.rss_mb), number(last.peak_mb), f"{growth:+.1f}"),
        *quantiles(arrivals.error_m, 50, 95, 100),
    ]


def _starts(scene: Scene) -> Table:
    """Cold starts at several places, each killed in flight and started again."""
    count = 2 if scene.quick else 6
    waits: dict[str, list[float]] = {"known": [], "unknown": [], "restart": []}
    for heading in ("known", "unknown"):
        for index in range(count):
            cold_s, again_s = _start(scene, heading, index, count)
            waits[heading].append(cold_s)
            if again_s is not None:
                waits["restart"].append(again_s)
            say(f"start {index + 1}, heading {heading}: {cold_s:.1f} s, again {again_s} s")
    names = {
        "known": "cold start, heading known",
        "unknown": "cold start, heading unknown",
        "restart": "killed in flight, started again with --state",
    }
    rows = []
    for key, name in names.items():
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
    port, errors = free_port(), scene.scratch / f"{name}-errors.txt"

    def started(from_s: float) -> Fly:
        camera = rest_of(folder, scene.scratch / f"{name}-camera", from_s)
        arguments = [*scene.arguments(name, camera, port), "--heading", heading]
        return Fly(arguments, scene.cores.flying, errors)

    with FakeAutopilot(folder, port, scene.cores.other) as fake_autopilot:
        fake_autopilot.wait_until(1.0)
        with started(1.0) as fly:
            at_ns = fake_autopilot.position_after(fly.started_ns, most_s)
            if at_ns is None:
                return np.inf, None
            cold_s = (at_ns - fly.started_ns) / 1e9
            time.sleep(FLOWN_ON_S)
            fly.kill()
        with started((time.monotonic_ns() - fake_autopilot.begin_ns) / 1e9) as fly:
            at_ns = fake_autopilot.position_after(fly.started_ns, MOST_WAIT_S["known"])
            again_s = np.inf if at_ns is None else (at_ns - fly.started_ns) / 1e9
    return cold_s, again_s


if __name__ == "__main__":
    sys.exit(run(measure, add))
