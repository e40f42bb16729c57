"""How time and memory of a view grow with map, errors and size, and with the hours of a flight."""

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.looped_flight import LoopedFlight, played, rendered, views_of
from benchmarks.placing import BOTH, Task, child, memory_mb, placed
from benchmarks.record import Section, Table, number, percent, quantiles, run, say
from benchmarks.scenes import PAST, PRESENT, agl_of, area, flight, map_of
from benchmarks.soak import WARM_UP, slope
from benchmarks.verdicts import Verdict
from orthonav.core.geo.camera import Camera
from orthonav.core.mapfile import open_map
from orthonav.ground.simulate.flight import Errors

NAME = "growth"
SEED = 7
VIEWS_M = 1000
"""Side of the square over which all views are flown."""
HEADER = ("ms", "p99 ms", "first view ms", "open ms", "peak MB", "15 m")
NOTES = (
    "unless varied: 16 km2 of generated ground at 1 m, views of 256 px of 2021 over the same "
    "square kilometre, heading to 10 deg and height to 10 % (standard deviation), no prior",
    "processor time of one core, one process per row; first view: cold; open: map and localizer",
)
HOURS_SIDE_M, HOURS_GSD_M, RATE_HZ = 2000, 2.0, 0.25
CAMERA = Camera(160, 120, 125.0, 125.0, 80.5, 59.5)
"""One pixel of it is one of the map."""
LAPS = 4
"""Each row of hours is so many laps, the last ones until then: all rows see the same places."""
KINDS = {"track": "hours of flight", "smooth": "hours of flight, recorded for smoothing"}


@dataclass(frozen=True)
class Case:
    """One row: map, view and what is known of it.

    - `side_m`, `gsd_m`: side of the map's area and its ground resolution.
    - `ground_m`: ground that the shorter side of a view covers.
    - `yaw_std_deg`: standard deviation of the reported heading; None: heading unknown.
    - `agl_std`: that of the reported height, as a share of it.
    - `prior_std_m`: that of the prior; None: no prior.
    """

    side_m: int = 4000
    gsd_m: float = 1.0
    ground_m: float = 256.0
    yaw_std_deg: float | None = 10.0
    agl_std: float = 0.1
    prior_std_m: float | None = None


SIDES_M = 1000, 2000, 4000, 10000
AXES = {
    "area, km2": {(side / 1e3) ** 2: Case(side) for side in SIDES_M},
    "area, km2, heading unknown": {
        (side / 1e3) ** 2: Case(side, yaw_std_deg=None) for side in SIDES_M
    },
    "area, km2, prior of 50 m": {(side / 1e3) ** 2: Case(side, prior_std_m=50) for side in SIDES_M},
    "heading standard deviation, deg": {
        std: Case(yaw_std_deg=std) for std in (2.0, 5.0, 10.0, 20.0, 40.0)
    },
    "height standard deviation, %": {100 * std: Case(agl_std=std) for std in (0.02, 0.1, 0.3)},
    "view, px of the map": {px: Case(ground_m=px) for px in (96.0, 128.0, 256.0, 512.0)},
    "pixels per metre": {1 / gsd: Case(1000, gsd_m=gsd) for gsd in (2.0, 1.0, 0.5)},
}


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--views", type=int, default=40, help="views per row")
    parser.add_argument("--part", choices=("views", "hours"), help="only this part")


def measure(options: argparse.Namespace) -> Section:
    """A table for each kind of work that grows."""
    section = Section("Growth")
    if options.part in (None, "views"):
        section.tables += _views_tables(options)
    if options.part in (None, "hours"):
        section.tables += _hours_tables(options)
    return section


def _views_tables(options: argparse.Namespace) -> list[Table]:
    tables, known = [], dict[Case, list[str]]()
    views = 6 if options.quick else options.views
    for title, cases in list(AXES.items())[: 1 if options.quick else None]:
        rows = []
        for x, case in list(cases.items())[: 1 if options.quick else None]:
            if case not in known:
                known[case] = _cells(case, views, options.work)
            rows.append([f"{x:g}", *known[case]])
            say(f"        {title}: {' '.join(rows[-1])}")
        tables.append(Table(f"{title}, {views} views", (title, *HEADER), rows, NOTES))
    return tables


def _cells(case: Case, views: int, work: Path) -> list[str]:
    past = area(work, PAST, side_m=case.side_m, gsd_m=case.gsd_m)
    present = area(work, PRESENT, side_m=VIEWS_M, gsd_m=case.gsd_m)
    yaw_std_deg = 10.0 if case.yaw_std_deg is None else case.yaw_std_deg
    errors = Errors(yaw_std_deg=yaw_std_deg, agl_std=case.agl_std, prior_std_m=case.prior_std_m)
    agl_m = agl_of(case.ground_m, 1.0)
    folder = flight(present, work, views=views, errors=errors, seed=SEED, agl_m=agl_m)
    known, use_prior = case.yaw_std_deg is not None, case.prior_std_m is not None
    result = placed(Task(BOTH, str(map_of(past, work)), str(folder), known, use_prior))
    verdict = Verdict.of(result["rows"])
    return [
        *quantiles(verdict.times_ms, 50, 99),
        *(number(result[key]) for key in ("cold_ms", "opened_ms", "peak_mb")),
        percent(float(verdict.within(15.0).mean())),
    ]


def _hours_tables(options: argparse.Namespace) -> list[Table]:
    """One flight round and round, tracked, and tracked with the history for smoothing."""
    hours = (0.1, 0.2) if options.quick else (0.25, 0.5, 1.0, 2.0, 4.0)
    past, present = (
        area(options.work, date, side_m=HOURS_SIDE_M, gsd_m=HOURS_GSD_M) for date in (PAST, PRESENT)
    )
    map_path = map_of(past, options.work)
    frame = open_map(map_path).manifest.sheets[0].frame
    lap = rendered(options.work, present, frame, LoopedFlight(CAMERA, RATE_HZ))
    views, last = round(3600 * RATE_HZ * hours[-1]), LAPS * views_of(lap)
    folder = played(lap, options.work / "hours", views)
    tables = []
    for kind, title in KINDS.items():
        found = child("growth", "--child", str(map_path), str(folder), kind)
        rows = []
        for hour in hours:
            end = round(3600 * RATE_HZ * hour)
            times = quantiles(found["ms"][max(0, end - last) : end], 50, 99)
            memory = (number(found[key][end - 1]) for key in ("rss_mb", "peak_mb"))
            rows.append([f"{hour:g}", f"{end:,}", *times, *memory])
        at_hours = np.arange(1, views + 1) / (3600 * RATE_HZ)
        grown_mb, spread_mb = slope(at_hours, np.array(found["rss_mb"]))
        notes = (
            f"a view each {1 / RATE_HZ:g} s of flight over {HOURS_SIDE_M / 1e3:g} x "
            f"{HOURS_SIDE_M / 1e3:g} km at {HOURS_GSD_M:g} m; times: of the last {last} views; "
            f"resident memory {grown_mb:+.2f} +- {spread_mb:.2f} MB an hour after the first "
            f"{WARM_UP:.0%}",
        )
        header = (title, "views", "ms", "p99 ms", "resident MB", "peak MB")
        tables.append(Table(title, header, rows, notes))
        say(f"        {title} done")
    return tables


def fly(map_path: Path, folder: Path, smooth: bool) -> dict[str, Any]:
    """By view: processor time (ms), resident memory and the largest so far (MB)."""
    import cv2

    from orthonav.core.flight import open_flight
    from orthonav.core.localize import Localizer
    from orthonav.core.track.tracker import Tracker
    from orthonav.ground.recordings.localize import localize_flight

    cv2.setNumThreads(1)
    tracker = Tracker(Localizer(open_map(map_path)), use_prior=False, smooth=smooth)
    found: dict[str, Any] = {"ms": [], "rss_mb": [], "peak_mb": []}
    start = time.process_time()
    for _ in localize_flight(tracker, open_flight(folder)):
        found["ms"].append(1e3 * (time.process_time() - start))
        found["rss_mb"].append(memory_mb("VmRSS"))
        found["peak_mb"].append(memory_mb("VmHWM"))
        start = time.process_time()
    return found


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        print(json.dumps(fly(Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4] == "smooth")))
    else:
        sys.exit(run(NAME, __doc__, measure, add))
