"""How many views of undisturbed flights become messages, over real imagery of two dates.

`python -m benchmarks.undisturbed [--seeds N] [--jobs N] [--seconds S]` flies as the fault suite
does, without a fault, over real scenes whose ground resolution is 1 to 2 m. A view over
ground that has changed shows the map no more, and must not become a message: so every view is also
compared with the map at its true pose.
"""

import argparse
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from benchmarks.fault_flights import (
    BEGIN_S,
    CAMERA,
    STATED_S,
    FaultFlight,
    Report,
    World,
    undisturbed,
)
from benchmarks.faults import Ground, calm_cells
from benchmarks.record import Section, Table, run, say, side_by_side
from benchmarks.scenes import Pair, chosen, leave_one_out_pairs, localizer_of, ortho
from orthonav.core.records import NoFix, Telemetry, View
from orthonav.core.register.refine import Refiner
from orthonav.core.register.sharpness import sharpness

NAME = "undisturbed"
AGL_PX, SPEED_PX_S = 150.0, 12.0
"""Height and speed in pixels of the map: 225 m and 18 m/s at 1.5 m."""
MARGIN_PX = 180.0
"""Views stay so far inside of the imagery."""
SHOWN_RATIO = 1.25
"""The true place correlates better than all others nearby by this factor: the map is shown."""
SEED = 31


@cache
def _world(pair: Pair, work: Path) -> World:
    """The map of a pair, built once, and the ground of its other date."""
    localizer = localizer_of(pair.map, work)
    grid = localizer.grid
    ground = Ground(ortho(pair.views, work), localizer)
    reach_m = (min(grid.width_px, grid.height_px) / 2 - MARGIN_PX) * grid.gsd_m
    height_m, speed_mps = AGL_PX * grid.gsd_m, SPEED_PX_S * grid.gsd_m
    return World(localizer, localizer.sheet.frame, ground.picture, reach_m, height_m, speed_mps)


def _fly(job: tuple[Pair, int, float, Path]) -> tuple[str, Report, list[bool]]:
    """One flight, and which of its views show the map."""
    pair, seed, seconds, work = job
    cv2.setNumThreads(1)
    fault = undisturbed(seconds)
    flight = FaultFlight(_world(pair, work), fault, seed=seed, lead_s=0.0, recovery_s=0.0)
    report = flight.fly()
    rng = np.random.default_rng(seed)
    shown = [_is_shown(flight, at_s, rng) for at_s in report.views]
    return f"{pair.name}, seed {seed}", replace(report, fault=fault), shown


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
    return bool(sharpness(template, registration.reference, placed.pose).ratio >= SHOWN_RATIO)


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=1, help="flights per pair (default 1)")
    parser.add_argument("--seconds", type=float, default=60.0, help="of a flight (default 60)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="pairs whose name has this")


def measure(options: argparse.Namespace) -> Section:
    """Fly over all scenes; failed where a message was false."""
    pairs = [
        each
        for each in chosen(leave_one_out_pairs(), options.only)
        if 0.9 <= each.gsd_m <= 2.1 and not each.map.startswith("generated:")
    ]
    seconds = min(options.seconds, 15.0) if options.quick else options.seconds
    jobs = [(pair, SEED + i, seconds, options.work) for pair in pairs for i in range(options.seeds)]
    rows, wrong = [], 0
    for name, report, shown in side_by_side(_fly, jobs, options.jobs):
        begin = report.sent[0].at_s if report.sent else np.inf
        after = [s for s, at_s in zip(shown, report.views, strict=True) if at_s >= begin]
        of_shown = f"{len(report.sent) / max(sum(after), 1):.1%}"
        share = f"{sum(after) / max(len(after), 1):.1%}"
        rows.append([name, str(len(after)), share, of_shown, *calm_cells(report)])
        wrong += len(report.wrong())
        say(f"{' | '.join(rows[-1])} {dict(report.withheld)}")
    header = (
        *("flight", "views after the first message", "showing the map", "sent of those"),
        *("first message s", "sent", "median m", "worst m", "false"),
    )
    notes = (
        f"{seconds:g} s at {AGL_PX:g} px above ground and {SPEED_PX_S:g} px/s, constant errors of "
        "heading 2 deg, height 3 %, pitch 0.5 deg, turbulence, whole map, no prior",
        f"showing the map: the true place correlates at least {SHOWN_RATIO:g} times as well as all "
        "others nearby",
    )
    title = "Undisturbed flights over real imagery"
    return Section(title, [Table(title, header, rows, notes)], failed=wrong > 0)


if __name__ == "__main__":
    sys.exit(run(NAME, __doc__, measure, add))
