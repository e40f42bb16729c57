"""Flight hours without GNSS: false messages, protection levels and outages of tracked flights.

`python -m benchmarks.flight_hours --work DIR [--hours 500] [--workers 2]` flies the simulated loop
of `benchmarks.closed_loop` over the demo area, generated areas and the optional real imagery: map
of one date, pictures of another, both vehicles and filters, undisturbed and with faults of the
camera; with a 30 m terrain model that errs, and in every other round without terrain. Rows are kept
in DIR, rerun to resume; with fewer `--hours` it reports the first ones.
"""

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray

from benchmarks.closed_loop.inertial import FILTERS
from benchmarks.closed_loop.loop import Course, Located, Scenario, fly, scenario
from benchmarks.closed_loop.physics import VEHICLES
from benchmarks.closed_loop.replays import Area
from benchmarks.integrity import LIMIT_M
from benchmarks.real_ground.maps import COARSE, COARSE_STD_M, relief_file
from benchmarks.record import Section, Table, number, percent, resumed, rows_path, run, say
from benchmarks.scenes import (
    OTHER,
    PAST,
    PRESENT,
    TILT_STD_DEG,
    Pair,
    Scene,
    all_pairs,
    chosen,
    gsd_of,
    map_of,
    ortho,
    place_of,
)
from orthonav.cli.demo import IMAGERY
from orthonav.core.limits import DEFAULT_RISK
from orthonav.core.records import RADIUS_SHARE
from orthonav.ground.evaluate.statistics import runs, upper_bound

UNDISTURBED, FAULTS = ("fixes", "start"), ("shifted", "mirrored", "frozen")
"""Scenarios of `closed_loop.loop`."""
FAULTY_ROUNDS, ROUNDS = 3, 16
"""Of so many rounds the first ones fly faults too, which take twice the time of a flight hour."""
QUICK_HOURS = 0.02
GENERATED_SEEDS = range(100, 120)
AGL_PX, LEAST_AGL_M = 167.0, 250.0
"""Height in pixels of the map, and at least."""
HIGHEST_QUAD_M = 500.0
"""Above it fly airplanes only."""
MARGIN_AGL, LEAST_REACH_M = 1.8, 250.0
"""The route stays so many heights inside of the imagery; half the sides of the smallest route."""
HEADER = (
    *("flights", "hours", "sent", "false messages (events)", "events per hour", "bound"),
    *("beyond the protection level (events)", "bound, per 1,000", "available"),
    *("false of available", "longest outage s", "NEES", "not sent after s", "longest false s"),
)
Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Task:
    """One flight. `minutes`: without GNSS, where undisturbed; `view_s`: time between views;
    `has_terrain`: the map has the heights of a 30 m terrain model."""

    pair: Pair
    vehicle: str
    autopilot: str
    scenario: str
    seed: int
    minutes: float
    view_s: float
    has_terrain: bool
    work: Path

    def prepare(self) -> None:
        """Make the map and the imagery, before processes share them."""
        _ = self.map_path, ortho(self.pair.views, self.work)

    @property
    def map_path(self) -> Path:
        """The map, built once."""
        dem = relief_file(self.pair.map, self.work, 0.0, COARSE) if self.has_terrain else None
        return map_of(ortho(self.pair.map, self.work), self.work, dem=dem)

    @property
    def flown(self) -> Scenario:
        return scenario(self.scenario, self.minutes)

    @property
    def hours(self) -> float:
        """Time without GNSS."""
        return (self.flown.seconds - self.flown.gnss_s) / 3600


def course_of(pair: Pair, work: Path, view_s: float) -> Course:
    """Height and route over the imagery of a pair, by its size and ground resolution."""
    path = ortho(pair.views, work)
    agl_m = max(LEAST_AGL_M, AGL_PX * gsd_of(path))
    with rasterio.open(path) as source:
        size_m = np.array([source.width, source.height]) * source.transform.a
    east_m, north_m = (size_m / 2 - MARGIN_AGL * agl_m).tolist()
    return Course(agl_m, (east_m, north_m), view_s)


def row_of(task: Task) -> dict[str, Any]:
    """What a flight did: the time from GNSS off on, sent, tracking, error, protection level and
    NEES of each view."""
    cv2.setNumThreads(1)
    begun_s, flown = time.process_time(), task.flown
    pair, work, course = task.pair, task.work, course_of(task.pair, task.work, task.view_s)
    mount = np.random.default_rng([task.seed, 5]).normal(0.0, TILT_STD_DEG, 2).tolist()
    area = Area(task.map_path, ortho(pair.views, work), tuple(mount))
    found = fly(
        flown, area, vehicle=task.vehicle, autopilot=task.autopilot, seed=task.seed, course=course
    )
    return {
        "scene": place_of(pair),
        "pair": pair.name,
        "aircraft": f"{task.vehicle}, {task.autopilot}",
        "scenario": task.scenario,
        "map": "30 m terrain" if task.has_terrain else "no terrain",
        "seed": task.seed,
        "hours": task.hours,
        "view_s": task.view_s,
        "fault_s": [flown.fault_s - flown.gnss_s, flown.lasts_s],
        "limit_m": max(LIMIT_M, area.radius_m, RADIUS_SHARE * course.agl_m),
        "took_s": time.process_time() - begun_s,
        "views": [
            _plain(view, flown.gnss_s) for view in found.views if view.time_s >= flown.gnss_s
        ],
    }


def _plain(view: Located, from_s: float) -> list[float]:
    values = view.error_m, view.level_m, view.nees
    flags = int(view.sent), int(view.state == "tracking")
    return [round(view.time_s - from_s, 2), *flags, *(float(f"{each:.5g}") for each in values)]


@dataclass(frozen=True, eq=False)
class Judged:
    """Views (N,) of one flight.

    `false`: sent, and beyond the alert limit. `leveled`: tracked, with a finite protection level.
    `available`: tracked, with a protection level up to the alert limit.
    """

    row: dict[str, Any]
    time_s: Array
    sent: Mask
    false: Mask
    leveled: Mask
    available: Mask
    error_m: Array
    level_m: Array
    nees: Array

    @classmethod
    def of(cls, row: dict[str, Any]) -> "Judged":
        """From a row of `row_of`."""
        time_s, sent, tracking, error_m, level_m, nees = np.array(row["views"], np.float64).T
        false = (sent > 0) & (error_m > row["limit_m"])
        leveled = (tracking > 0) & (level_m < np.inf)
        available = leveled & (level_m <= row["limit_m"])
        return cls(row, time_s, sent > 0, false, leveled, available, error_m, level_m, nees)

    @property
    def beyond(self) -> Mask:
        return self.leveled & (self.error_m > self.level_m)

    @property
    def alert_s(self) -> float:
        """From the onset of the fault to the first view that was not sent."""
        begin_s, lasts_s = self.row["fault_s"]
        inside = (self.time_s >= begin_s) & (self.time_s < begin_s + lasts_s)
        return float(min(self.time_s[inside & ~self.sent], default=math.inf) - begin_s)

    def longest_s(self, flags: Mask) -> float:
        """Of a stretch of views."""
        longest = max((end - begin for begin, end in runs(flags)), default=0)
        return float(self.row["view_s"] * longest)


def _cells(name: str, flights: Sequence[Judged]) -> list[str]:
    """A row of a table from some flights."""

    def events(flags: Callable[[Judged], Mask]) -> int:
        return sum(len(runs(flags(each))) for each in flights)

    def total(flags: Callable[[Judged], Mask]) -> int:
        return sum(int(flags(each).sum()) for each in flights)

    hours, views = sum(each.row["hours"] for each in flights), total(lambda each: each.time_s > -1)
    sent, false = total(lambda each: each.sent), events(lambda each: each.false)
    leveled, beyond = total(lambda each: each.leveled), total(lambda each: each.beyond)
    available = total(lambda each: each.available)
    wrong = total(lambda each: each.available & (each.error_m > each.row["limit_m"]))
    nees = np.concatenate([each.nees[each.sent] for each in flights])
    alerts = [each.alert_s for each in flights if each.row["fault_s"][1] > 0]
    return [
        f"{name}: {len(flights)}",
        f"{hours:.2f}",
        f"{sent} of {views}",
        f"{total(lambda each: each.false)} ({false})",
        f"{false / hours:.2g}",
        f"{upper_bound(false, views) * views / hours:.2g}",
        f"{beyond} ({events(lambda each: each.beyond)}) of {leveled}",
        f"{1e3 * upper_bound(beyond, leveled):.2g}" if leveled else "-",
        percent(available / views, 1),
        f"{wrong} of {available}",
        f"{max(each.longest_s(~each.available) for each in flights):.0f}",
        number(float(nees.mean())) if nees.size else "-",
        ", ".join(_seconds(each) for each in (np.median(alerts), max(alerts))) if alerts else "-",
        f"{max(each.longest_s(each.false) for each in flights):.0f}",
    ]


def _seconds(value: float) -> str:
    return f"{value:.0f}" if math.isfinite(value) else "never"


def _table(title: str, key: str, flights: Sequence[Judged], notes: Sequence[str] = ()) -> Table:
    """Flights by a value of their rows, and all of them."""
    names = dict.fromkeys(each.row[key] for each in flights)
    rows = [_cells(name, [each for each in flights if each.row[key] == name]) for name in names]
    if len(names) > 1:
        rows.append(_cells("**all**", flights))
    return Table(title, HEADER, rows, notes)


def tasks_of(options: argparse.Namespace) -> Iterator[tuple[str, Task]]:
    """Flights in rounds, without end: each scene in each scenario, over a pair of the round. The
    first ones are of all scenes and scenarios."""
    past, present = (str(IMAGERY / f"{date}.tif") for date in (PAST, PRESENT))
    demo = Pair("demo", past, present, 1.0)
    places: dict[str, list[Pair]] = {}
    for pair in [demo, *all_pairs()]:
        places.setdefault(place_of(pair), []).append(pair)
    places["generated"] = [
        Scene(f"generated_{seed}", f"generated:{seed}", 1.0, both).pair(*both)
        for seed in GENERATED_SEEDS
        for both in permutations((OTHER, PAST, PRESENT), 2)
    ]
    large = {
        place: [pair for pair in found if place == "generated" or _is_large(pair, options.work)]
        for place, pairs in places.items()
        if (found := chosen(pairs, options.only))
    }
    if not any(large.values()):
        raise SystemExit("no such pair of dates that is large enough to fly over")
    number = 0
    while True:
        faults = () if options.quick or number % ROUNDS >= FAULTY_ROUNDS else FAULTS
        names = (*UNDISTURBED, *faults)
        chance = np.random.default_rng([number, 9])
        pairs = [each[chance.integers(len(each))] for each in large.values() if each]
        for turn in range(len(names)):
            for place, pair in enumerate(pairs):
                name = names[(turn + place) % len(names)]
                vehicle, autopilot = chance.choice(list(VEHICLES)), chance.choice(list(FILTERS))
                if course_of(pair, options.work, options.every).agl_m > HIGHEST_QUAD_M:
                    vehicle = "plane"
                minutes, has_terrain = 0.25 if options.quick else options.minutes, number % 2 == 0
                flown = str(vehicle), str(autopilot), name, 1 + number, minutes, options.every
                about = f"{number} {name}, {pair.name}, {vehicle}, {autopilot}"
                yield about, Task(pair, *flown, has_terrain, options.work)
        number += 1


def _is_large(pair: Pair, work: Path) -> bool:
    return min(course_of(pair, work, 1.0).reach_en_m) >= LEAST_REACH_M


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--hours", type=float, default=500.0, help="without GNSS (default 500)")
    parser.add_argument("--minutes", type=float, default=10.0, help="of a flight (default 10)")
    parser.add_argument("--every", type=float, default=2.0, metavar="S", help="a view (default 2)")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="flights at a time")
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="pairs whose name has this")


def measure(options: argparse.Namespace) -> Section:
    """Fly so many hours; failed where a message was false in an undisturbed flight."""
    hours, tasks = QUICK_HOURS if options.quick else options.hours, {}
    planned = 0.0
    for name, task in tasks_of(options):
        tasks[name] = task
        planned += task.hours
        if planned >= hours:
            break
    for task in tasks.values():
        task.prepare()
    stored = rows_path(options.work, f"flights-{options.minutes:g}-{options.every:g}")
    flights: list[Judged] = []
    done = took_s = 0.0
    for name, row in zip(tasks, resumed(stored, row_of, tasks, options.workers), strict=True):
        flights.append(Judged.of(row))
        done, took_s = done + row["hours"], took_s + row["took_s"]
        left_h = took_s / done * (planned - done) / options.workers / 3600
        false = int(flights[-1].false.sum())
        say(
            f"{name}: {false} false; {done:.2f} of {planned:.0f} h, {took_s / done:.0f} s of a "
            f"core per flight hour, {left_h:.1f} h left"
        )
    calm = [each for each in flights if each.row["scenario"] in UNDISTURBED]
    notes = (
        f"without GNSS, a view every {options.every:g} s; false: sent, error beyond the alert limit"
        f" of {LIMIT_M:g} m or {RADIUS_SHARE:.1%} of the height; event: views in a row",
        f"beyond the protection level: of tracked fixes, at a risk of {DEFAULT_RISK:g}; available: "
        "tracked, protection level up to the alert limit; NEES: of sent fixes",
        "bounds: one-sided, 95 % (Clopper and Pearson), for independent events and views; not sent "
        "after: from the onset of the fault to the first view that is not sent, median and largest",
        f"30 m terrain: errs by {COARSE_STD_M:g} m; the ground that views show is level",
        f"{took_s / done:.0f} s of a core per flight hour",
    )
    tables = [
        _table("By scenario", "scenario", flights),
        _table("Undisturbed, by scene", "scene", calm, notes),
        _table("Undisturbed, by aircraft", "aircraft", calm),
        _table("Undisturbed, by map", "map", calm),
    ]
    failed = any(each.false.any() for each in calm)
    return Section(f"{done:.1f} flight hours without GNSS", tables, failed)


if __name__ == "__main__":
    sys.exit(run(measure, add))
