"""How the time of a view and the memory of a track grow with the hours of a flight.

A lap is flown round and round without a pause, each track in a process of its own.
`python -m benchmarks.growth_hours MAP FLIGHT smooth|track` flies one and prints JSON.
"""

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.growth import Curve, plot
from benchmarks.inputs import FLIGHT_SEED, PAST, PRESENT, Workplace
from benchmarks.looped_flight import LoopedFlight, played, rendered, views_of
from benchmarks.record import Section, Table, number
from benchmarks.soak import WARM_UP, slope
from orthonav.core.geo.camera import Camera
from orthonav.core.mapfile import open_map

SIDE_M, GSD_M, RATE_HZ = 2000, 2.0, 0.25
CAMERA = Camera(160, 120, 125.0, 125.0, 80.5, 59.5)
"""One pixel of it is one of the map."""
HOURS = 0.25, 0.5, 1.0, 2.0, 4.0
QUICK_HOURS = 0.1, 0.2
LAPS = 4
"""Each row is so many laps, the last ones until then: all rows see the same places."""
KINDS = {"track": "hours of flight", "smooth": "hours of flight, recorded for smoothing"}
HEADER = ("views", "ms", "p99 ms", "resident MB", "peak MB")


def measure(place: Workplace) -> Section:
    """One flight, tracked and tracked with the history for smoothing. Writes `growth-hours.png`."""
    section, curves = Section("How a view's time grows with the flight"), list[Curve]()
    past, present = place.area(SIDE_M, GSD_M, [PAST, PRESENT])
    map_path, hours = place.map(past), QUICK_HOURS if place.quick else HOURS
    frame = open_map(map_path).manifest.sheets[0].frame
    lap = rendered(place, present, frame, LoopedFlight(CAMERA, RATE_HZ))
    views, last = round(3600 * RATE_HZ * hours[-1]), LAPS * views_of(lap)
    flight = played(lap, place.scratch / "hours", views)
    for kind, title in KINDS.items():
        command = [sys.executable, "-m", "benchmarks.growth_hours"]
        command += [str(map_path), str(flight), kind]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        found = json.loads(done.stdout)
        rows, (time_of, memory_of) = _rows(section, title, list(hours), found, last)
        print(f"        {title} done", file=sys.stderr, flush=True)
        curves += [time_of, memory_of]
        at_hours = np.arange(1, views + 1) / (3600 * RATE_HZ)
        grown_mb, spread_mb = slope(at_hours, np.array(found["rss_mb"]))
        notes = (
            *(*time_of.notes("time of a view"), *memory_of.notes("resident memory")),
            f"resident memory: {grown_mb:+.2f} +- {spread_mb:.2f} MB an hour after the first "
            f"{WARM_UP:.0%}; views by state of the track: {found['states']}",
        )
        section.tables.append(Table(f"Growth: {title}", (title, *HEADER), rows, notes))
    notes = (
        f"a view of {CAMERA.width_px} x {CAMERA.height_px} px each {1 / RATE_HZ:g} s of flight, "
        f"read, decoded and tracked, as fast as the processor does it; laps over {SIDE_M / 1e3:g} "
        f"x {SIDE_M / 1e3:g} km of generated ground of another date at {GSD_M:g} m",
        f"processor time of one core, of the last {last} views, {LAPS} laps; memory: resident "
        "at that hour, and the largest up to it; the list of these figures takes some 0.1 kB a "
        "view",
    )
    section.tables[-1] = replace(section.tables[-1], notes=[*section.tables[-1].notes, *notes])
    plot(curves, place.cache.parent / "growth-hours.png")
    return section


def _rows(
    section: Section, title: str, hours: list[float], found: dict[str, list[float]], last: int
) -> tuple[list[list[str]], tuple[Curve, Curve]]:
    """Rows by hours, each of the `last` views until then, and the curves of time and memory."""
    rows, times_ms, memory_mb = [], [], []
    for hour in hours:
        end = round(3600 * RATE_HZ * hour)
        last_ms = found["ms"][end - last : end]
        made = section.add(f"{title} {hour:g}: time", "ms", last_ms, data="lap", seed=FLIGHT_SEED)
        times_ms.append((made.median, float(np.percentile(last_ms, 99))))
        memory_mb.append((found["rss_mb"][end - 1], found["peak_mb"][end - 1]))
        resident = [memory_mb[-1][0]]
        section.add(f"{title} {hour:g}: memory", "MB", resident, data="lap", seed=FLIGHT_SEED)
        cells = (*times_ms[-1], *memory_mb[-1])
        rows.append([f"{hour:g}", f"{end:,}", *(number(value) for value in cells)])
    named = f"{title}: memory"
    return rows, (
        Curve(title, hours, times_ms),
        Curve(named, hours, memory_mb, "MB", ("resident", "largest so far")),
    )


def fly(map_path: Path, flight: Path, smooth: bool) -> dict[str, Any]:
    """By view: processor time (ms), resident memory and the largest so far (MB)."""
    import cv2

    from benchmarks.child import memory_mb
    from orthonav.core.flight import open_flight
    from orthonav.core.localize import Localizer
    from orthonav.core.track.tracker import Tracker
    from orthonav.onboard.run import localize_flight

    cv2.setNumThreads(1)
    tracker = Tracker(Localizer(open_map(map_path)), use_prior=False, smooth=smooth)
    found: dict[str, Any] = {"ms": [], "rss_mb": [], "peak_mb": [], "states": {}}
    start = time.process_time()
    for result in localize_flight(tracker, open_flight(flight)):
        found["ms"].append(1e3 * (time.process_time() - start))
        found["rss_mb"].append(memory_mb("VmRSS"))
        found["peak_mb"].append(memory_mb("VmHWM"))
        found["states"][result.state] = found["states"].get(result.state, 0) + 1
        start = time.process_time()
    return found


if __name__ == "__main__":
    print(json.dumps(fly(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3] == "smooth")))
