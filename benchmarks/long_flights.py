"""Long flights followed over a map of another date: drift, biases, clouds, kidnapping.

`python -m benchmarks.long_flights [--flights 20] [--km 50] [--quick] [--only N ..]` flies over a
generated area and follows every flight with `Tracker` from no prior. Rerun to resume; with
`orthonav localize MAP FLIGHT --track --prior none --out fixes.jsonl` a flight is replayed.
"""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from lab.clouds import Clouds
from numpy.typing import NDArray

from benchmarks.looped_flight import read_rows, route_of, write_rows
from benchmarks.placing import row_of
from benchmarks.record import (
    Section,
    Table,
    number,
    percent,
    quantiles,
    resumed,
    rows_path,
    run,
    say,
)
from benchmarks.scenes import FAR_M, PAST, PRESENT, area, map_of
from benchmarks.verdicts import Verdict
from orthonav.core.files import write_text
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.geo.camera import Camera
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import ViewResult
from orthonav.core.track.tracker import Tracker
from orthonav.ground.evaluate.statistics import nees_bound, normalized_squared
from orthonav.ground.recordings.localize import localize_flight
from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight

NAME = "long_flights"
CAMERA = Camera(640, 480, 1000.0, 1000.0, 320.0, 240.0)
AGL_M, GSD_M, SPACING_M, SPEED_MPS, TURN_RADIUS_M = 2000.0, 2.5, 100.0, 25.0, 400.0
AREA_M, QUICK_AREA_M, BORDER_M = 12_000, 6_000, 1300.0
LEG_M, SHARPEST_DEG = (3000.0, 9000.0), 120.0
DRIFT, CLOUD_SHARE = 0.02, 0.15
YAW_BIAS_DEG, AGL_BIAS = 3.0, 0.05
SCATTER = Errors(
    yaw_std_deg=1.0, agl_std=0.01, tilt_std_deg=0.2, attitude_std_deg=2.0, velocity_drift=DRIFT
)
GAP_M, JUMP_M = 3000.0, 2000.0
"""A kidnapped flight leaves out at least this path length and this straight distance."""
DIVERGED_M, DIVERGED_VIEWS = 60.0, 10
SEED = 100
Array = NDArray[np.float64]
HEADER = (
    *("flight", "kidnapped", "views", "all: median m", "tracking from", "median m", "95 % m"),
    *("max m", "confident", "false", "diverged", "back after", "NEES", "below 5.99", "ms"),
)


@dataclass(frozen=True)
class Plan:
    """One flight: `kidnapped` is "" or how ("gap": the clock runs on, "jump": it does not)."""

    number: int
    km: float
    area_m: int

    @property
    def kidnapped(self) -> str:
        """Every third flight, the two ways in turn."""
        return ("gap", "jump")[self.number // 3 % 2] if self.number % 3 == 1 else ""

    def rng(self) -> np.random.Generator:
        """Random generator for values drawn once per flight."""
        return np.random.default_rng([SEED, self.number])


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--flights", type=int, default=20, help="how many (default 20)")
    parser.add_argument("--km", type=float, default=50.0, help="length of each (default 50)")
    parser.add_argument("--only", type=int, nargs="+", metavar="N", help="these flights only")


def measure(options: argparse.Namespace) -> Section:
    side_m = QUICK_AREA_M if options.quick else AREA_M
    km = min(options.km, 8.0) if options.quick else options.km
    count = min(options.flights, 3) if options.quick else options.flights
    past, present = (
        area(options.work, date, side_m=side_m, gsd_m=GSD_M) for date in (PAST, PRESENT)
    )
    map_path = map_of(past, options.work)
    tasks = {
        f"{i} {km:g} km {side_m} m": (Plan(i, km, side_m), options.work, map_path, present)
        for i in options.only or range(count)
    }
    outcomes = []
    for outcome in resumed(rows_path(options.work, "flights"), _followed, tasks):
        outcomes.append(outcome)
        say("  ".join(_row(outcome)))
    return _section(outcomes, km)


def _flown(work: Path, plan: Plan, localizer: Localizer, ortho: Path) -> tuple[Path, str]:
    """Folder of the flight, simulated if absent, and the first view after a kidnapping."""
    folder = work / f"flight-{plan.number:02d}-{plan.km:g}km-{plan.area_m}m"
    about = folder.with_suffix(".json")
    if about.is_file():
        return folder, str(json.loads(about.read_text(encoding="utf-8")))
    rng = plan.rng()
    line = random_legs(rng, plan.km * 1000, plan.area_m / 2 - BORDER_M)
    yaw_bias, agl_bias = rng.normal(0, 1, 2) * [YAW_BIAS_DEG, AGL_BIAS]
    errors = replace(SCATTER, yaw_bias_deg=float(yaw_bias), agl_bias=float(agl_bias))
    if not folder.is_dir():
        request = SimulateRequest(
            [ortho],
            folder,
            route=route_of(localizer.sheet.frame, line),
            agl_m=AGL_M,
            spacing_m=SPACING_M,
            airspeed_mps=SPEED_MPS,
            camera=CAMERA,
            errors=errors,
            seed=SEED + plan.number,
            turn_radius_m=TURN_RADIUS_M,
            clouds=partial(Clouds, CLOUD_SHARE),
        )
        simulate_flight(request)
    first_after = _kidnap(folder, plan, localizer, rng) if plan.kidnapped else ""
    write_text(about, json.dumps(first_after))
    return folder, first_after


def random_legs(
    rng: np.random.Generator, length_m: float, reach_m: float, leg_m: tuple[float, float] = LEG_M
) -> Array:
    """Corners (N, 2) of a route of random legs in a square, `length_m` long."""
    line = [rng.uniform(-reach_m, reach_m, 2)]
    course, left_m = rng.uniform(0, 2 * math.pi), length_m
    shortest = min(leg_m[0], reach_m)
    while left_m > 0:
        step = rng.uniform(-reach_m, reach_m, 2) - line[-1]
        drawn_m, new = float(np.hypot(*step)), math.atan2(step[1], step[0])
        turn_deg = abs(math.degrees(math.remainder(new - course, 2 * math.pi)))
        if not (shortest <= drawn_m <= leg_m[1] and turn_deg <= SHARPEST_DEG):
            course += 0.05  # leave the corner of the square
            continue
        line.append(line[-1] + step * min(1.0, left_m / drawn_m))
        course, left_m = new, left_m - drawn_m
    return np.array(line)


def _kidnap(folder: Path, plan: Plan, localizer: Localizer, rng: np.random.Generator) -> str:
    """Leave out views in the middle and the velocity over the gap; returns the first after it."""
    rows = read_rows(folder / "telemetry.csv")
    truth = read_truth(folder / "truth.csv")
    frame = localizer.sheet.frame
    places = np.array([frame.en_from_latlon(*truth[row["frame"]]) for row in rows])
    first = int(rng.uniform(0.4, 0.55) * len(rows))
    path_m = np.cumsum(np.hypot(*np.diff(places[first:], axis=0).T))
    apart = np.hypot(*(places[first + 1 :] - places[first]).T)
    after = first + 1 + int(np.argmax((path_m >= GAP_M) & (apart >= JUMP_M)))
    gap_s = float(rows[after]["time_s"]) - float(rows[first]["time_s"]) - SPACING_M / SPEED_MPS
    for row in rows[after:] if plan.kidnapped == "jump" else ():
        row["time_s"] = f"{float(row['time_s']) - gap_s:.6f}"
    rows[after]["vel_east_mps"] = rows[after]["vel_north_mps"] = ""
    gone = {row["frame"] for row in rows[first + 1 : after]}
    for name in ("telemetry.csv", "truth.csv"):
        table = rows if name == "telemetry.csv" else read_rows(folder / name)
        write_rows(folder / name, [row for row in table if row["frame"] not in gone])
    return rows[after]["frame"]


def _followed(task: tuple[Plan, Path, Path, Path]) -> dict[str, Any]:
    """What came out view by view."""
    plan, work, map_path, ortho = task
    cv2.setNumThreads(1)
    localizer = Localizer(open_map(map_path))
    folder, first_after = _flown(work, plan, localizer, ortho)
    truth = read_truth(folder / "truth.csv")
    placed = localize_flight(Tracker(localizer, use_prior=False), open_flight(folder))
    return {
        "flight": plan.number,
        "kidnapped": plan.kidnapped,
        "first_after": first_after,
        "views": [_record(each, localizer, truth[each.frame]) for each in placed],
    }


def _record(result: ViewResult, localizer: Localizer, truth: tuple[float, float]) -> dict[str, Any]:
    """One view: its row as `Verdict` takes it."""
    row = [*row_of(result.outcome, localizer.sheet.frame, truth), round(result.latency_ms, 2)]
    return {"frame": result.frame, "state": result.state, "row": row}


@dataclass(frozen=True, eq=False)
class Figures(Verdict):
    """Views (N) of one flight or more; `tracking`: mask (N,)."""

    tracking: NDArray[np.bool_]

    @classmethod
    def of_views(cls, views: Sequence[dict[str, Any]]) -> "Figures":
        """From the views of `_followed`."""
        verdict = Verdict.of([view["row"] for view in views])
        return cls(**vars(verdict), tracking=np.array([v["state"] == "tracking" for v in views]))

    @cached_property
    def nees(self) -> Array:
        """Normalized errors squared (N,); NaN without a fix."""
        known, nees = np.isfinite(self.errors_m), np.full(len(self.errors_m), np.nan)
        if known.any():
            nees[known] = normalized_squared(self.errors_en_m[known], self.cov_en_m2[known])
        return nees

    @property
    def wrong(self) -> int:
        """Number of views that are confident and wrong."""
        far = self.errors_m > np.fmax(FAR_M, self.radius_m)
        return int((self.accepted & far).sum())

    @property
    def divergences(self) -> int:
        """Stretches of more than `DIVERGED_VIEWS` tracking views that are `DIVERGED_M` off."""
        far = self.tracking & (self.errors_m > DIVERGED_M)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], far.astype(np.int8), [0]])))
        return int((np.diff(edges)[::2] > DIVERGED_VIEWS).sum())

    def cells(self) -> list[str]:
        """Median, 95 %, largest error while tracking; confident; wrong; divergences."""
        errors = self.errors_m[self.tracking]
        spread = np.percentile(errors, [50, 95, 100]) if errors.size else np.full(3, np.nan)
        confident = percent(float(self.accepted.mean()))
        return [*map(number, spread), confident, str(self.wrong), str(self.divergences)]

    def consistency(self) -> list[str]:
        """Mean of the normalized errors squared while tracking, and the share below 5.991."""
        nees = self.nees[self.tracking]
        if not nees.size:
            return ["-", "-"]
        return [number(float(nees.mean())), percent(float((nees < nees_bound(0.95)).mean()))]


def _back_after(followed: dict[str, Any]) -> int | None:
    """Views from the first after a kidnapping to the first that is tracking and right."""
    views = followed["views"]
    first = [view["frame"] for view in views].index(followed["first_after"])
    figures = Figures.of_views(views[first:])
    right = np.flatnonzero(figures.tracking & (figures.errors_m <= FAR_M))
    return int(right[0]) + 1 if right.size else None


def _row(followed: dict[str, Any]) -> list[str]:
    figures = Figures.of_views(followed["views"])
    first = int(np.argmax(figures.tracking)) + 1 if figures.tracking.any() else None
    back = "-"
    if followed["kidnapped"]:
        back = str(_back_after(followed) or "never")
    return [
        str(followed["flight"]),
        followed["kidnapped"] or "-",
        str(len(figures.times_ms)),
        number(figures.median_m),
        str(first or "never"),
        *figures.cells(),
        back,
        *figures.consistency(),
        *quantiles(figures.times_ms, 50),
    ]


def _section(outcomes: Sequence[dict[str, Any]], km: float) -> Section:
    figures = [Figures.of_views(each["views"]) for each in outcomes]
    every = Figures.of_views([view for each in outcomes for view in each["views"]])
    means = [float(f.nees[f.tracking].mean()) for f in figures if f.tracking.any()]
    lost = [each for each in outcomes if each["kidnapped"]]
    found = sum(_back_after(each) is not None for each in lost)
    total = ["**all**", "", str(len(every.times_ms)), number(every.median_m), "", *every.cells()]
    total[-1] = str(sum(each.divergences for each in figures))
    back = f"{found} of {len(lost)}" if lost else "-"
    total += [back, *every.consistency(), *quantiles(every.times_ms, 50)]
    half = 1.96 * float(np.std(means, ddof=1)) / math.sqrt(len(means)) if len(means) > 1 else 0.0
    notes = (
        f"{km:g} km of random legs over another date than the map's, {AGL_M:g} m high, a view "
        f"every {SPACING_M:g} m, biases drawn per flight, clouds over {CLOUD_SHARE:.0%}; "
        "no prior, whole map; kidnapped: gap: the clock runs on, jump: it does not",
        "median, 95 %, max, NEES: of tracking views; false: confident, more than "
        f"{FAR_M:g} m and the stated radius off; diverged: more than {DIVERGED_VIEWS} tracking "
        f"views in a row more than {DIVERGED_M:g} m off; NEES 2 is right, mean of the flights "
        f"{np.mean(means) if means else math.nan:.2f} +- {half:.2f}",
    )
    rows = [*map(_row, outcomes), total]
    return Section("Long flights", [Table("Long flights", HEADER, rows, notes)])


if __name__ == "__main__":
    sys.exit(run(NAME, __doc__, measure, add))
