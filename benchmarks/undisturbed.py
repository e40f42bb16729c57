"""How many views of undisturbed flights become messages, over real imagery of two dates.

`python -m benchmarks.undisturbed [--seeds N] [--jobs N] [--seconds S] [--work DIR] [--out DIR]`
flies as the fault suite does, without a fault, over the scenes beside the checkout whose ground
resolution is 1 to 2 m. A view over ground that has changed shows the map no more, and must not
become a message. So every view is also compared with the map at its true pose: the map is shown
there where that place correlates better than all others nearby.
"""

import argparse
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
import rasterio

from benchmarks.fault_flights import (
    BEGIN_S,
    CAMERA,
    STATED_S,
    FaultFlight,
    Report,
    World,
    undisturbed,
)
from benchmarks.faults import Ground
from benchmarks.inputs import file_of, map_of
from benchmarks.record import Section, Table, number, provenance, save
from benchmarks.trust_views import Pair, pairs
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import NoFix, Telemetry, View
from orthonav.core.register.refine import Refiner
from orthonav.core.register.sharpness import sharpness

GSD_M = 0.9, 2.1
AGL_PX, SPEED_PX_S = 150.0, 12.0
"""Height and speed in pixels of the map: 225 m and 18 m/s at 1.5 m."""
MARGIN_PX = 180.0
"""Views stay so far inside of the imagery."""
SHOWN_RATIO = 1.25
"""The true place correlates better than all others nearby by this factor: the map is shown."""
SEED = 31


@dataclass(frozen=True)
class Outcome:
    """A flight over a pair, and which of its views show the map (N,)."""

    pair: Pair
    seed: int
    report: Report
    shown: tuple[bool, ...]


@cache
def _world(pair: Pair, work: Path) -> World:
    """The map of a pair, built once, and the ground of its other date."""
    localizer = Localizer(open_map(map_of(file_of(pair.map, work), work)))
    grid = localizer.grid
    ground = Ground(
        file_of(pair.views, work),
        localizer.sheet.frame,
        corner=(grid.west_m, grid.north_m),
        size_px=(grid.width_px, grid.height_px),
        gsd_m=grid.gsd_m,
    )
    reach_m = (min(grid.width_px, grid.height_px) / 2 - MARGIN_PX) * grid.gsd_m
    return World(
        localizer,
        localizer.sheet.frame,
        ground.picture,
        reach_m,
        AGL_PX * grid.gsd_m,
        SPEED_PX_S * grid.gsd_m,
    )


def _fly(job: tuple[Pair, int, float, Path]) -> Outcome:
    """One flight."""
    pair, seed, seconds, work = job
    cv2.setNumThreads(1)
    world = _world(pair, work)
    flight = FaultFlight(world, undisturbed(seconds), seed=seed, lead_s=0.0, recovery_s=0.0)
    report = flight.fly()
    rng = np.random.default_rng(seed)
    shown = tuple(_is_shown(flight, at_s, rng) for at_s in report.views)
    # Functions cannot be passed between processes.
    return Outcome(pair, seed, replace(report, fault=undisturbed(seconds)), shown)


def _is_shown(flight: FaultFlight, at_s: float, rng: np.random.Generator) -> bool:
    """Whether the ground of a view looks like the map, by its true pose."""
    world, path, exposed_s = flight.world, flight.path, BEGIN_S + at_s - STATED_S
    registration = world.localizer.registration
    assert registration is not None
    yaw, pitch, roll = path.attitude(exposed_s)
    place = path.place(exposed_s)
    grey = world.picture(place, (yaw, pitch, roll), path.agl_m, rng)
    view = View(grey, CAMERA, Telemetry(0, yaw, pitch, roll, path.agl_m))
    prepared = registration.prepared(view, heading_known=True)
    if isinstance(prepared, NoFix):
        return False
    pose = registration.pose_of(prepared, np.array([*place, np.radians(yaw), 0.0]))
    levels = prepared.levels
    template = prepared.templates.at(levels.final, levels.recipe(levels.final))
    placed = Refiner(template, registration.reference).place(pose, 2)
    found = sharpness(template, registration.reference, placed.pose)
    return bool(found.ratio >= SHOWN_RATIO)


def _row(outcome: Outcome) -> list[str]:
    report = outcome.report
    begin = report.sent[0].at_s if report.sent else np.inf
    shown = [s for s, at_s in zip(outcome.shown, report.views, strict=True) if at_s >= begin]
    errors = [each.error_m for each in report.sent] or [np.nan]
    sent = len(report.sent)
    return [
        f"{outcome.pair.map} seen by {outcome.pair.views}, seed {outcome.seed}",
        number(begin),
        str(len(shown)),
        f"{sum(shown) / max(len(shown), 1):.1%}",
        f"{sent / max(len(shown), 1):.1%}",
        f"{sent / max(sum(shown), 1):.1%}",
        number(float(np.median(errors))),
        number(max(errors)),
        str(len(report.wrong())),
    ]


def _is_fit(pair: Pair, work: Path) -> bool:
    if pair.map.startswith("generated:"):
        return False
    with rasterio.open(file_of(pair.map, work)) as source:
        gsd_m = abs(float(source.transform.a))
    return GSD_M[0] <= gsd_m <= GSD_M[1]


def main(arguments: Sequence[str]) -> int:
    """Fly over all scenes and print the table; returns the exit code, 1 where a message was
    wrong."""
    options = _parser().parse_args(arguments)
    started = provenance("undisturbed")
    begin = time.perf_counter()
    options.work.mkdir(parents=True, exist_ok=True)
    chosen = [each for each in pairs() if each.is_there and _is_fit(each, options.work)]
    if not chosen:
        sys.exit("the real imagery beside the checkout is not there")
    jobs = [
        (pair, SEED + number, options.seconds, options.work)
        for pair in chosen
        for number in range(options.seeds)
    ]
    rows, outcomes = [], []
    # Not forked: threads of this process would be lost in a child.
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        for outcome in pool.map(_fly, jobs):
            outcomes.append(outcome)
            rows.append(_row(outcome))
            print(" | ".join(rows[-1]), dict(outcome.report.withheld), file=sys.stderr)
    header = (
        *("flight", "first message s", "views after it", "show the map", "sent"),
        *("sent of those that show it", "median m", "worst m", "wrong"),
    )
    notes = (
        f"{options.seconds:g} s at {AGL_PX:g} px above ground and {SPEED_PX_S:g} px/s, constant "
        "errors of heading 2 deg, height 3 %, pitch 0.5 deg, turbulence, whole map, no prior",
        f"a view shows the map where its true place correlates at least {SHOWN_RATIO:g} times as "
        "well as all others nearby; a track also recognizes some others",
    )
    section = Section("Undisturbed flights over real imagery", [Table("", header, rows, notes)])
    wrong = sum(len(each.report.wrong()) for each in outcomes)
    section.facts = {"messages": sum(len(each.report.sent) for each in outcomes), "wrong": wrong}
    print(section.markdown())
    save(options.out, [section], started, wall_s=time.perf_counter() - begin, latest=False)
    return int(wrong > 0)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.undisturbed", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--seeds", type=int, default=1, help="flights per pair (default 1)")
    parser.add_argument("--seconds", type=float, default=60.0, help="of a flight (default 60)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    parser.add_argument("--work", type=Path, default=Path("bench_results/undisturbed"))
    parser.add_argument("--out", type=Path, default=Path("bench_results"))
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
