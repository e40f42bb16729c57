"""How the time and memory of a view grow: area searched, headings and heights that may be."""

import math
import sys
from dataclasses import dataclass

import numpy as np

from benchmarks.inputs import FLIGHT_SEED, PAST, PRESENT, Workplace
from benchmarks.placing import BOTH, Task, placed
from benchmarks.record import Section, Table, number
from benchmarks.verdicts import from_placed, percent
from orthonav.simulate.flight import Errors

SIDES_M = (1000, 4000, 10000)
USUAL_YAW_DEG, USUAL_AGL = 10.0, 0.1
PRIOR_STD_M = 50.0
HEADER = (
    *("area km2", "heading", "height", "prior", "ms", "p99 ms", "first view ms", "open ms"),
    *("peak MB", "15 m"),
)


@dataclass(frozen=True)
class Case:
    """One row: side of the area in m, deviations of heading (None: unknown), height and prior."""

    side_m: int
    yaw_std_deg: float | None = USUAL_YAW_DEG
    agl_std: float = USUAL_AGL
    prior_std_m: float | None = None

    @property
    def errors(self) -> Errors:
        """What the telemetry of its flight gets wrong."""
        yaw_std_deg = USUAL_YAW_DEG if self.yaw_std_deg is None else self.yaw_std_deg
        return Errors(yaw_std_deg=yaw_std_deg, agl_std=self.agl_std, prior_std_m=self.prior_std_m)

    @property
    def cells(self) -> list[str]:
        """The first columns of its row."""
        heading = "unknown" if self.yaw_std_deg is None else f"{self.yaw_std_deg:g} deg"
        prior = "none" if self.prior_std_m is None else f"{self.prior_std_m:g} m"
        area_km2 = number((self.side_m / 1000) ** 2)
        return [area_km2, heading, f"{self.agl_std:.0%}", prior]


def measure(place: Workplace) -> Section:
    """One process per row: cold start, then every view warm."""
    section = Section("How a view's time grows")
    sides = SIDES_M[:1] if place.quick else SIDES_M
    views = 6 if place.quick else 60
    present = place.area(SIDES_M[0], 1.0, [PRESENT])[0]
    rows = []
    for case in _cases(sides):
        map_path = place.map(place.area(case.side_m, 1.0, [PAST])[0])
        flight = place.flown(present, views, case.errors)
        result = placed(
            Task(
                BOTH,
                str(map_path),
                str(flight),
                heading_known=case.yaw_std_deg is not None,
                use_prior=case.prior_std_m is not None,
            )
        )
        rows.append([*case.cells, *_cells(section, case, result)])
        print(f"        {', '.join(case.cells)} done", file=sys.stderr, flush=True)
    notes = (
        "sd of the reported heading and height, and of the prior; one core, one process per row, "
        f"{views} views of 2021 over the inner 1 x 1 km, the same places in every row",
        "first view: the cold one, right after the map was opened; open: the map and the "
        "localizer; ms and p99: warm; peak MB: resident memory of the process, Python, NumPy "
        "and OpenCV (about 45 MB) included",
    )
    section.tables = [Table("Growth", HEADER, rows, notes)]
    return section


def _cases(sides_m: tuple[int, ...]) -> list[Case]:
    cases = []
    for side_m in sides_m:
        cases += [Case(side_m), Case(side_m, None), Case(side_m, prior_std_m=PRIOR_STD_M)]
    middle = sides_m[len(sides_m) // 2]
    cases += [Case(middle, yaw_std_deg=2.0), Case(middle, agl_std=0.02), Case(middle, agl_std=0.3)]
    return cases


def _cells(section: Section, case: Case, result: dict[str, object]) -> list[str]:
    verdict = from_placed(result)
    name = ", ".join(case.cells)
    data = f"generated {case.side_m} m square, 1 m"
    time = section.add(f"{name}: time", "ms", verdict.times_ms, data=data, seed=FLIGHT_SEED)
    figures = {"first view": "cold_ms", "open": "opened_ms", "peak memory": "peak_mb"}
    cells = [number(time.median), number(float(np.percentile(verdict.times_ms, 99)))]
    for figure, key in figures.items():
        value = float(str(result.get(key, math.nan)))
        unit = "MB" if key == "peak_mb" else "ms"
        section.add(f"{name}: {figure}", unit, [value], data=data, seed=FLIGHT_SEED)
        cells.append(number(value))
    hits = verdict.within(15.0)
    section.add_share(f"{name}: within 15 m", hits, data=data, seed=FLIGHT_SEED)
    return [*cells, percent(float(hits.mean()))]
