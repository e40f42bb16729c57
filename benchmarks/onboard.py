"""`orthonav fly` in real time: latency, load of its core, starts, alternatives."""

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.inputs import FLIGHT_SEED, PAST, PRESENT, Workplace
from benchmarks.instead import beside
from benchmarks.looped_flight import CAMERA, LoopedFlight, played, rendered, rest_of, views_of
from benchmarks.pair import Arrivals, Cores, FakeAutopilot, Fly, Lines, free_port, on_core
from benchmarks.record import Section, Table, number
from orthonav.core.mapfile import open_map

SIDE_M, CAMERA_HZ = 2000, 10
RATES_HZ = (5, 10)
LEAD_S = 4.0
"""The autopilot is up before the first picture: the program has started by then."""
MOST_WAIT_S = {"known": 30.0, "unknown": 90.0}
FLOWN_ON_S = 5.0
DATA = f"generated {SIDE_M} m square, 1 m; flown over another date"
PERCENTS = (50, 95, 99, 99.9, 100)
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """What is flown: the map, the pictures of a lap, and where the processes run."""

    map_path: Path
    lap: Path
    cores: Cores
    scratch: Path
    quick: bool

    def arguments(self, name: str, camera: Path, port: int) -> list[str]:
        """Command line as on an aircraft, except that pictures come from a folder."""
        files = {"--jsonl": "lines.jsonl", "--log": "log.mcap", "--state": "state.json"}
        made = [str(self.map_path), str(camera), "--file-clock", "autopilot"]
        made += ["--autopilot", f"udpin:{port}", "--log-views", "thumbnails"]
        for option, file in files.items():
            made += [option, str(self.scratch / f"{name}-{file}")]
        return made

    def lines(self, name: str) -> Path:
        """What the program wrote with `--jsonl`."""
        return self.scratch / f"{name}-lines.jsonl"


@dataclass(frozen=True, eq=False)
class Flown:
    """One flight in real time."""

    views: int
    arrivals: Arrivals
    lines: Lines
    fly: Fly


def measure(place: Workplace) -> Section:
    """Two camera rates, starts and restarts, and what one would run instead."""
    section = Section("On board")
    past, present = place.area(SIDE_M, 1.0, [PAST, PRESENT])
    map_path = place.map(past)
    frame = open_map(map_path).manifest.sheets[0].frame
    lap = rendered(place, present, frame, LoopedFlight(CAMERA, CAMERA_HZ, short=place.quick))
    scene = Scene(map_path, lap, Cores.chosen(), place.scratch, place.quick)
    with on_core(scene.cores.other):
        flown = {rate_hz: _flown(scene, rate_hz) for rate_hz in RATES_HZ}
        section.tables += [_latency(section, flown), _load(section, scene, flown)]
        section.tables.append(_starts(section, scene))
    section.tables.append(beside(section, place, past, map_path, lap, scene.cores.flying))
    return section


def _flown(scene: Scene, rate_hz: int) -> Flown:
    """A flight from a little after the start of the program to the end of the pictures."""
    name, every = f"flight-{rate_hz}", CAMERA_HZ // rate_hz
    views = 34 * rate_hz if scene.quick else 1200
    folder = played(scene.lap, scene.scratch / name, views, every=every, lead_s=LEAD_S)
    port = free_port()
    arguments = scene.arguments(name, folder, port)
    errors = scene.scratch / f"{name}-errors.txt"
    with FakeAutopilot(folder, port, scene.cores.other) as fake_autopilot:
        with Fly(arguments, scene.cores.flying, errors) as fly:
            fly.watch(fake_autopilot.mono_ns(LEAD_S + views / rate_hz + 30))
        _say(f"{rate_hz} Hz flown, {len(fake_autopilot.heard)} messages")
    return Flown(views, Arrivals.of(fake_autopilot), Lines.read(scene.lines(name)), fly)


def _latency(section: Section, flown: dict[int, Flown]) -> Table:
    rows = []
    for rate_hz, one in flown.items():
        name, latency_ms = f"{rate_hz} Hz", one.arrivals.latency_ms
        section.add(f"{name}: latency", "ms", latency_ms, data=DATA, seed=FLIGHT_SEED)
        section.add(f"{name}: age_ms", "ms", one.lines.sent_ages_ms, data=DATA, seed=FLIGHT_SEED)
        tail = {p: float(np.percentile(latency_ms, p)) for p in PERCENTS}
        for percent, value in tail.items():
            section.facts[f"onboard_{rate_hz}hz_p{percent:g}_ms"] = value
        counts = one.lines.health.get("counts", {})
        handled, sent = len(one.lines.ages_ms), len(latency_ms)
        dropped = one.views - handled
        section.facts[f"onboard_{rate_hz}hz_dropped"] = dropped
        rows.append(
            [
                *(name, str(one.views), str(sent), str(dropped)),
                *(number(value) for value in tail.values()),
                *(number(float(np.percentile(one.lines.sent_ages_ms, p))) for p in (50, 99)),
                str(counts.get("late", 0)),
            ]
        )
    section.facts["onboard_p99_ms"] = section.facts["onboard_5hz_p99_ms"]
    header: tuple[str, ...] = (
        "camera",
        "views",
        "sent",
        "dropped",
        "p50 ms",
        "p95 ms",
        "p99 ms",
        "p99.9 ms",
    )
    header += ("max ms", "age p50", "age p99", "late")
    notes = (
        f"`orthonav fly` on one core, {CAMERA.width_px} x {CAMERA.height_px} px JPEG pictures "
        "through a lens with distortion, 4 km2 map at 1 m, no prior, heading known; attitude at "
        "49 Hz; log with thumbnails, state and lines written",
        "from exposure to the arrival of GLOBAL_POSITION_SENSOR at a process on the other core, on "
        "the clock that both share; age: the same by the program's own lines (`age_ms`), to after "
        "the message; views without a message are those before the track is confident",
        "dropped: views that no line was written of, because a newer one was there or (late) it "
        "was too old",
    )
    return Table("From exposure to message", header, rows, notes)


def _load(section: Section, scene: Scene, flown: dict[int, Flown]) -> Table:
    rows = []
    for rate_hz, one in flown.items():
        name, errors_m, samples = f"{rate_hz} Hz", one.arrivals.error_m, one.fly.samples
        section.add(f"{name}: error", "m", errors_m, data=DATA, seed=FLIGHT_SEED)
        rss_mb = np.array([each.rss_mb for each in samples])
        section.add(f"{name}: resident memory", "MB", rss_mb, data=DATA, seed=FLIGHT_SEED)
        first, last = samples[len(samples) // 10], samples[-1]
        wall_s = (last.at_ns - first.at_ns) / 1e9
        busy = (last.cpu_s - first.cpu_s) / wall_s
        others = (last.core_s - first.core_s) / wall_s - busy
        waited_ms = 1e3 * (last.waited_s - first.waited_s) / wall_s / rate_hz
        section.facts[f"onboard_{rate_hz}hz_cpu"] = busy
        section.facts[f"onboard_{rate_hz}hz_peak_mb"] = last.peak_mb
        rows.append(
            [
                *(name, f"{busy:.0%}", f"{max(others, 0.0):.0%}", number(waited_ms)),
                *(number(float(v)) for v in (rss_mb[len(rss_mb) // 10], rss_mb[-1], last.peak_mb)),
                *(number(float(np.percentile(errors_m, p))) for p in (50, 95, 100)),
                number(float(np.abs(one.arrivals.clock_ms).max())),
            ]
        )
    peaks = [section.facts[f"onboard_{rate_hz}hz_peak_mb"] for rate_hz in flown]
    section.facts["onboard_peak_mb"] = max(peaks)
    header: tuple[str, ...] = (
        "camera",
        "share of the core",
        "others' share",
        "waited ms a view",
        "RSS early MB",
    )
    header += ("RSS late MB", "peak MB", "error p50 m", "p95 m", "max m", "clock ms")
    cores = scene.cores
    apart = (
        "" if cores.flying != cores.other else "; there is one core: the fake autopilot shares it"
    )
    notes = (
        "others: what else ran on that core; waited: how long the thread that places views was "
        f"ready to run and had to wait, for others or for its own process{apart}",
        "RSS: resident memory after a tenth of the flight and at its end; peak: VmHWM; sampled "
        "each second",
        "error: of the decoded messages against the truth of the view; clock: by how much the "
        "error of the exposure time in a message, at most",
    )
    return Table("Load and accuracy", header, rows, notes)


def _starts(section: Section, scene: Scene) -> Table:
    """Cold starts at several places, each killed in flight and started again."""
    count = 2 if scene.quick else 6
    waits: dict[str, list[float]] = {"known": [], "unknown": [], "restart": []}
    for heading in ("known", "unknown"):
        for number_ in range(count):
            cold_s, again_s = _start(scene, heading, number_, count)
            waits[heading].append(cold_s)
            if again_s is not None:
                waits["restart"].append(again_s)
            _say(f"start {number_ + 1}, heading {heading}: {cold_s:.1f} s, again {again_s} s")
    names = {
        "known": "cold start, heading known",
        "unknown": "cold start, heading unknown",
        "restart": "killed in flight, started again with --state",
    }
    rows = []
    for key, name in names.items():
        found = [wait_s for wait_s in waits[key] if np.isfinite(wait_s)]
        if found:
            section.add(name, "s", found, data=DATA, seed=FLIGHT_SEED)
        middle, worst = (float(np.median(found)), max(found)) if found else (np.nan, np.nan)
        section.facts[f"onboard_{key}_s"] = middle
        rows.append([name, str(len(waits[key])), str(len(found)), number(middle), number(worst)])
    header = ("start", "starts", "found", "median s", "worst s")
    notes = (
        "from starting the process to the arrival of the first message, pictures coming all the "
        f"while at {RATES_HZ[0]} Hz; each start at another place of the lap; the restart by the "
        "same heading as before it, over the same flight. Files are in the page cache: it is not "
        "dropped, so reading from a slow disk comes on top",
        f"not found: no message within {MOST_WAIT_S['known']:.0f} s, heading unknown "
        f"{MOST_WAIT_S['unknown']:.0f} s",
    )
    return Table("Until the first message", header, rows, notes)


def _start(scene: Scene, heading: str, index: int, count: int) -> tuple[float, float | None]:
    """Seconds to the first message, infinite without one; the same after a kill, None without."""
    name, rate_hz, most_s = f"start-{heading}-{index}", RATES_HZ[0], MOST_WAIT_S[heading]
    first = index * views_of(scene.lap) // count
    length_s = most_s + FLOWN_ON_S + MOST_WAIT_S["known"]
    views = round(length_s * rate_hz)
    every = CAMERA_HZ // rate_hz
    folder = played(scene.lap, scene.scratch / name, views, every=every, first=first)
    port, errors = free_port(), scene.scratch / f"{name}-errors.txt"
    more = ["--heading", heading]
    with FakeAutopilot(folder, port, scene.cores.other) as fake_autopilot:
        fake_autopilot.wait_until(1.0)
        camera = rest_of(folder, scene.scratch / f"{name}-camera", 1.0)
        arguments = [*scene.arguments(name, camera, port), *more]
        with Fly(arguments, scene.cores.flying, errors) as fly:
            at_ns = fake_autopilot.position_after(fly.started_ns, most_s)
            if at_ns is None:
                return np.inf, None
            cold_s = (at_ns - fly.started_ns) / 1e9
            time.sleep(FLOWN_ON_S)
            fly.kill()
        flight_s = (time.monotonic_ns() - fake_autopilot.begin_ns) / 1e9
        camera = rest_of(folder, scene.scratch / f"{name}-again", flight_s)
        arguments = [*scene.arguments(name, camera, port), *more]
        with Fly(arguments, scene.cores.flying, errors) as fly:
            at_ns = fake_autopilot.position_after(fly.started_ns, MOST_WAIT_S["known"])
            again_s = np.inf if at_ns is None else (at_ns - fly.started_ns) / 1e9
    return cold_s, again_s


def _say(text: str) -> None:
    print(f"        {text}", file=sys.stderr, flush=True)
