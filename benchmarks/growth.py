"""How time and memory of a view grow with map, errors and size."""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

from benchmarks.placing import BOTH, Task, placed
from benchmarks.record import Section, Table, number, percent, quantiles, run, say
from benchmarks.scenes import PAST, PRESENT, agl_of, area, flight, map_of
from benchmarks.verdicts import Verdict
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


@dataclass(frozen=True)
class Case:
    """One row: map, view and what is known of it.

    - `side_m`: side of the map's area.
    - `ground_m`: ground that the shorter side of a view covers.
    - `yaw_std_deg`: standard deviation of the reported heading; None: heading unknown.
    - `agl_std`: that of the reported height, as a fraction of it.
    - `prior_std_m`: that of the prior; None: no prior.
    """

    side_m: int = 4000
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
}


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--views", type=int, default=40, help="views per row")


def measure(options: argparse.Namespace) -> Section:
    """A table for each value that is varied."""
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
    return Section("Growth", tables)


def _cells(case: Case, views: int, work: Path) -> list[str]:
    past = area(work, PAST, side_m=case.side_m)
    present = area(work, PRESENT, side_m=VIEWS_M)
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


if __name__ == "__main__":
    sys.exit(run(NAME, __doc__, measure, add))
