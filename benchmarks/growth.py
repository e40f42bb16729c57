"""How the time and memory of a view grow: a table and a plot per kind of work, slopes named."""

import itertools
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.inputs import FLIGHT_SEED, PAST, PRESENT, Workplace
from benchmarks.looped_flight import SMALL_CAMERA, LoopedFlight, rendered
from benchmarks.placing import BOTH, Task, placed
from benchmarks.record import Section, Table, number
from benchmarks.verdicts import from_placed, percent
from orthonav.core.geo.camera import Camera
from orthonav.core.mapfile import open_map
from orthonav.ground.simulate.flight import Errors

CAMERA_SIDE_M, CAMERA_HZ, CAMERA_VIEWS = 2000, 2.0, 40
CAMERAS = SMALL_CAMERA, Camera(320, 240, 250.0, 250.0, 161.5, 118.5)
"""Both see the same ground."""
VIEWS_M = 1000
"""Side of the square over which all views are flown."""
ALIKE = (
    "unless a table varies it: 16 km2 of generated ground at 1 m, views of 256 px, heading to "
    "10 deg and height to 10 % (standard deviation), no prior",
    "processor time of one core, one process per row; first view: the cold one, right after the "
    "map was opened; open: the map and the localizer; ms (median) and p99: warm; peak MB: "
    "resident memory of the process",
)
HEADER = ("ms", "p99 ms", "first view ms", "open ms", "peak MB", "15 m")


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

    @property
    def errors(self) -> Errors:
        """What the telemetry of its flight gets wrong."""
        yaw_std_deg = 10.0 if self.yaw_std_deg is None else self.yaw_std_deg
        return Errors(yaw_std_deg=yaw_std_deg, agl_std=self.agl_std, prior_std_m=self.prior_std_m)


@dataclass(frozen=True)
class Axis:
    """One kind of work that grows: `cases` by the amount of it, all else alike."""

    title: str
    cases: dict[float, Case]


@dataclass(frozen=True)
class Curve:
    """Two figures (`labels`, in `unit`) by the amount `x` of one kind of work."""

    title: str
    x: Sequence[float]
    figures: Sequence[tuple[float, float]]
    unit: str = "ms a view"
    labels: tuple[str, str] = ("median", "99 %")

    @property
    def slope(self) -> float:
        """Exponent of the first figure."""
        return slope_of(self.x, [first for first, _ in self.figures])

    def notes(self, what: str) -> tuple[str, ...]:
        """A line that names the exponent; none of a single point."""
        return () if math.isnan(self.slope) else (f"{what} grows as x^{self.slope:.2f}",)


SIDES_M = 1000, 2000, 4000, 10000
AXES = (
    Axis("area, km2", {(side / 1e3) ** 2: Case(side) for side in SIDES_M}),
    Axis(
        "area, km2, heading unknown", {(s / 1e3) ** 2: Case(s, yaw_std_deg=None) for s in SIDES_M}
    ),
    Axis(
        "area, km2, prior of 50 m",
        {(side / 1e3) ** 2: Case(side, prior_std_m=50) for side in SIDES_M},
    ),
    Axis(
        "heading standard deviation, deg",
        {std: Case(yaw_std_deg=std) for std in (2.0, 5, 10, 20, 40)},
    ),
    Axis(
        "height standard deviation, %",
        {100 * std: Case(agl_std=std) for std in (0.02, 0.05, 0.1, 0.3)},
    ),
    Axis("width of a view, px of the map", {px: Case(ground_m=px) for px in (96.0, 128, 256, 512)}),
    Axis(
        "pixels per metre, same ground", {1 / gsd: Case(1000, gsd_m=gsd) for gsd in (2.0, 1.0, 0.5)}
    ),
)


def measure(place: Workplace) -> Section:
    """One process per row: cold start, then every view warm. Writes a plot, `growth.png`."""
    section, known = Section("How a view's time grows"), dict[Case, dict[str, object]]()
    views = 6 if place.quick else 40
    seen = f"{views} views of 2021 over the inner 1 x 1 km, the same places in every row"
    curves: list[Curve] = []
    for axis in AXES[:1] if place.quick else AXES:
        cases = {
            x: case for x, case in axis.cases.items() if not place.quick or case.side_m <= 1000
        }
        rows, times_ms = [], []
        for x, case in cases.items():
            if case not in known:
                known[case] = _placed(place, case, views)
                print(f"        {axis.title}: {x:g} done", file=sys.stderr, flush=True)
            cells, quantiles_ms = _cells(section, f"{axis.title} {x:g}", case, known[case])
            rows.append([f"{x:g}", *cells])
            times_ms.append(quantiles_ms)
        curves.append(Curve(axis.title, list(cases), times_ms))
        notes = curves[-1].notes("time of a view")
        section.tables.append(Table(f"Growth: {axis.title}", (axis.title, *HEADER), rows, notes))
    section.tables[-1] = replace(
        section.tables[-1], notes=[*section.tables[-1].notes, *ALIKE, seen]
    )
    plot(curves, place.cache.parent / "growth.png")
    return section


def cameras(place: Workplace) -> Section:
    """Small cameras over the same ground: single views and a track, one thread and two."""
    section, rows = Section("Small cameras"), []
    past, present = place.area(CAMERA_SIDE_M, 1.0, [PAST, PRESENT])
    map_path = place.map(past)
    frame = open_map(map_path).manifest.sheets[0].frame
    for camera in CAMERAS:
        lap = rendered(place, present, frame, LoopedFlight(camera, CAMERA_HZ, short=True))
        for track, threads in itertools.product((False, True), (1, 2)):
            views = 6 if place.quick else CAMERA_VIEWS
            task = Task(BOTH, str(map_path), str(lap), track=track, threads=threads, views=views)
            rows.append(_camera_cells(section, camera, task, placed(task)))
            print(f"        {rows[-1][:3]} done", file=sys.stderr, flush=True)
    header = (
        *("camera, px", "views", "threads", "processor ms", "p99 ms", "clock ms", "p99 ms"),
        *("first view ms", "peak MB", "of files MB", "15 m"),
    )
    notes = (
        f"{views} views of 320 x 240 m of 2021, {1 / CAMERA_HZ:g} s apart, on "
        f"{CAMERA_SIDE_M / 1e3:g} x {CAMERA_SIDE_M / 1e3:g} km of generated ground at 1 m, heading "
        "known, no prior; one process per row",
        "processor: median and p99 of the time of all threads together; clock: of the time that "
        "passed, with other work on the machine; both without the first view, which prepares the "
        "map, and without reading and decoding the picture",
        "of files: resident pages of files at the end, those of the libraries: the map is read "
        "into memory, not mapped",
    )
    section.tables.append(Table(section.title, header, rows, notes))
    return section


def _camera_cells(
    section: Section, camera: Camera, task: Task, result: dict[str, Any]
) -> list[str]:
    """Cells of a row of `cameras`."""
    verdict, kind = from_placed(result), "tracked" if task.track else "single"
    size = f"{camera.width_px} x {camera.height_px}"
    name, data = f"{size} px, {kind}, {task.threads} threads", "lap"
    times = {"processor": verdict.times_ms[1:], "clock": np.array(result["wall_ms"][1:])}
    cells = [size, kind, str(task.threads)]
    for clock, times_ms in times.items():
        found = section.add(f"{name}: {clock}", "ms", times_ms, data=data, seed=FLIGHT_SEED)
        cells += [number(found.median), number(float(np.percentile(times_ms, 99)))]
    cells += [number(result[key]) for key in ("cold_ms", "peak_mb", "mapped_mb")]
    section.add(f"{name}: peak memory", "MB", [result["peak_mb"]], data=data, seed=FLIGHT_SEED)
    return [*cells, percent(float(verdict.within(15.0).mean()))]


def slope_of(x: Sequence[float], y: Sequence[float]) -> float:
    """Exponent p of y = a x^p, by least squares of the logarithms; NaN of fewer than two points."""
    if len(x) < 2:
        return math.nan
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def _placed(place: Workplace, case: Case, views: int) -> dict[str, object]:
    map_path = place.map(place.area(case.side_m, case.gsd_m, [PAST])[0])
    present = place.area(VIEWS_M, case.gsd_m, [PRESENT])[0]
    flight = place.flown(present, views, case.errors, case.ground_m)
    known = case.yaw_std_deg is not None
    use_prior = case.prior_std_m is not None
    return placed(Task(BOTH, str(map_path), str(flight), heading_known=known, use_prior=use_prior))


def _cells(
    section: Section, name: str, case: Case, result: dict[str, object]
) -> tuple[list[str], tuple[float, float]]:
    """Cells of a row, and its median and p99 in ms."""
    verdict = from_placed(result)
    data = f"generated {case.side_m} m square, {case.gsd_m:g} m"
    time = section.add(f"{name}: time", "ms", verdict.times_ms, data=data, seed=FLIGHT_SEED)
    figures = {"first view": "cold_ms", "open": "opened_ms", "peak memory": "peak_mb"}
    p99_ms = float(np.percentile(verdict.times_ms, 99))
    cells = [number(time.median), number(p99_ms)]
    for figure, key in figures.items():
        value = float(str(result.get(key, math.nan)))
        unit = "MB" if key == "peak_mb" else "ms"
        section.add(f"{name}: {figure}", unit, [value], data=data, seed=FLIGHT_SEED)
        cells.append(number(value))
    hits = verdict.within(15.0)
    section.add_share(f"{name}: within 15 m", hits, data=data, seed=FLIGHT_SEED)
    return [*cells, percent(float(hits.mean()))], (time.median, p99_ms)


def plot(curves: Sequence[Curve], path: Path) -> Path:
    """The curves over the amount of work, one panel per kind of work."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import LogLocator, NullFormatter

    columns = min(len(curves), 4)
    rows = math.ceil(len(curves) / columns)
    figure, axes = pyplot.subplots(
        rows, columns, figsize=(3.6 * columns, 3 * rows), layout="constrained", squeeze=False
    )
    for axis, curve in zip(axes.flat, curves, strict=False):
        first, second = zip(*curve.figures, strict=True)
        axis.loglog(curve.x, first, "o-", label=f"{curve.labels[0]}, slope {curve.slope:.2f}")
        axis.loglog(curve.x, second, "o--", label=curve.labels[1])
        axis.set(xlabel=curve.title, ylabel=curve.unit)
        axis.set_xticks(curve.x, labels=[f"{each:g}" for each in curve.x])
        axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.yaxis.set_major_formatter("{x:,g}")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.yaxis.set_minor_formatter(NullFormatter())
        axis.grid(alpha=0.3, which="both")
        axis.legend(fontsize=8)
    for axis in axes.flat[len(curves) :]:
        axis.remove()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
    return path
