"""The fault suite: what is sent while camera, telemetry, map or ground are wrong.

`python -m benchmarks.faults [--only TEXT ..] [--quick] [--seeds N] [--work DIR] [--out DIR]` flies
every fault of `benchmarks.fault_scenarios` over a generated area, photographed at another date than
its map, with the flight loop of `orthonav fly` and simulated clocks, and prints one row per fault.
A JSON and a Markdown record go to the output folder.
"""

import argparse
import copy
import os
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
import rasterio
from rasterio.windows import Window

from benchmarks.fakes import Array, Grey
from benchmarks.fault_flights import (
    CAMERA,
    FAR_M,
    FAR_STD,
    VIEWS_HZ,
    Fault,
    FaultFlight,
    Report,
    World,
    undisturbed,
)
from benchmarks.fault_scenarios import (
    CAMERA_FAULTS,
    COMBINED_FAULTS,
    GROUND_FAULTS,
    TELEMETRY_FAULTS,
)
from benchmarks.inputs import PAST, PRESENT, Workplace
from benchmarks.record import Section, Table, number, provenance, save
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.simulate.render import ViewEffects, render_view

SIDE_M, MAP_M = 1600, 1200
"""Sides of the generated area, and of the map in its middle."""
REACH_M, AGL_M, SPEED_MPS = 380.0, 150.0, 18.0
EFFECTS = ViewEffects(exposure_std=0.05)
LEAD_S, RECOVERY_S, SEED = 15.0, 60.0, 5
QUICK_LEAD_S, QUICK_RECOVERY_S, QUICK_FAULT_S = 10.0, 20.0, 10.0
CALM_S, CALM_SEEDS = 60.0, (11, 12, 13)
OWN_MAPS = (
    Fault("another place (mirrored ground)", "map", 30.0, from_start=True),
    Fault("map truncated in place", "map", 10.0),
)
HEADER = (*("fault", "s", "views", "sent", "worst m", "wrong", "recovered s", "lead-in sent"),)


class Ground:
    """An orthophoto on the plane of a map.

    `corner` (2,): its first pixel, metres east and north. `size_px`: columns and rows.
    """

    def __init__(
        self,
        path: Path,
        frame: LocalFrame,
        *,
        corner: tuple[float, float] = (-SIDE_M / 2, SIDE_M / 2),
        size_px: tuple[int, int] = (SIDE_M, SIDE_M),
        gsd_m: float = 1.0,
    ) -> None:
        (west_m, north_m), (cols, rows) = corner, size_px
        sheet = Mosaic.open([path]).sheet(
            frame, west_m=west_m, north_m=north_m, width_px=cols, height_px=rows, gsd_m=gsd_m
        )
        with sheet as raster:
            rgb = np.asarray(raster.read(0, 0, rows, cols).rgb)
        self._corner, self._rgb, self._gsd_m = np.array(corner), rgb, gsd_m

    def mirrored(self) -> "Ground":
        """The same, east and west exchanged."""
        made = copy.copy(self)
        made._rgb = np.ascontiguousarray(self._rgb[:, ::-1])
        return made

    def picture(
        self,
        place: Array,
        attitude: tuple[float, float, float],
        agl_m: float,
        rng: np.random.Generator,
    ) -> Grey:
        """What the camera sees."""
        corner = self._corner - place
        gsd_m = self._gsd_m
        seen = render_view(CAMERA, (*attitude, agl_m), self._rgb, corner, gsd_m, EFFECTS, rng)
        return np.asarray(cv2.cvtColor(seen, cv2.COLOR_RGB2GRAY), np.uint8)


def _cut(path: Path, out: Path, side_m: int) -> Path:
    """The middle of an orthophoto."""
    if out.is_file():
        return out
    with rasterio.open(path) as source:
        first = (SIDE_M - side_m) // 2
        rgb = source.read(window=Window(first, first, side_m, side_m))
        profile = source.profile
        profile.update(
            width=side_m,
            height=side_m,
            transform=source.window_transform(Window(first, first, side_m, side_m)),
        )
        tags = source.tags()
    with rasterio.open(out, "w", **profile) as target:
        target.write(rgb)
        target.update_tags(**tags)
    return out


@cache
def _world(work: Path, kind: str) -> World:
    """The map and the ground of a kind: usual, mirrored."""
    place = Workplace(work, work, quick=True)
    past, present = place.area(SIDE_M, 1.0, [PAST, PRESENT])
    name = f"{past.parent.name}-map"
    path = work / f"{name}.onav"
    if not path.is_file():
        build_map(BuildRequest([_cut(past, work / f"{name}.tif", MAP_M)], path))
    localizer = Localizer(open_map(path))
    frame = localizer.sheet.frame
    ground = Ground(present, frame)
    if kind == "mirrored":
        ground = ground.mirrored()
    return World(localizer, frame, ground.picture, REACH_M, AGL_M, SPEED_MPS)


def _fly(job: tuple[Path, Fault, int], quick: bool) -> Report:
    """One flight; `quick`: a shorter one."""
    work, fault, seed = job
    cv2.setNumThreads(1)
    change: Callable[[], str | None] | None = None
    kinds = {OWN_MAPS[0].name: "mirrored"}
    world = _world(work, kinds.get(fault.name, "usual"))
    if fault.name == OWN_MAPS[1].name:
        usual = next(work.glob("*-map.onav"))
        copy = work / f"truncated-{os.getpid()}.onav"
        shutil.copyfile(usual, copy)
        opened = open_map(copy)
        world = replace(world, localizer=Localizer(opened))
        change = opened.change
        fault = replace(fault, begins=lambda _: os.truncate(copy, copy.stat().st_size // 3))
    calm = fault.group == "none"
    recovery_s = QUICK_RECOVERY_S if quick else RECOVERY_S
    if quick and not calm and not fault.leaves_map and not fault.from_start:
        fault = replace(fault, seconds=min(fault.seconds, QUICK_FAULT_S))
    flight = FaultFlight(
        world,
        fault,
        seed=seed,
        lead_s=0.0 if calm else QUICK_LEAD_S if quick else LEAD_S,
        recovery_s=0.0 if calm or fault.name == OWN_MAPS[1].name else recovery_s,
        map_change=change or (lambda: None),
    )
    report = flight.fly()
    # Functions cannot be passed between processes.
    plain = Fault(fault.name, fault.group, fault.seconds, detectable=fault.detectable)
    return replace(report, fault=plain)


def _row(report: Report) -> list[str]:
    sent, views = report.lead_in()
    inside = sum(report.fault_s[0] <= each < report.fault_s[1] for each in report.views)
    recovered = report.recovery_s()
    return [
        report.fault.name,
        f"{report.fault.seconds:.0f}",
        str(inside),
        str(len(report.during())),
        number(report.worst_m()),
        str(len(report.wrong())),
        f"{recovered:.1f}" if np.isfinite(recovered) else "none",
        f"{sent / views:.0%}" if views else "-",
    ]


def _calm_row(report: Report, seed: int) -> list[str]:
    begin = report.sent[0].at_s if report.sent else np.inf
    views = sum(each >= begin for each in report.views)
    share = len(report.sent) / max(views, 1)
    errors = [each.error_m for each in report.sent] or [np.nan]
    return [
        f"seed {seed}",
        str(len(report.views)),
        number(begin),
        f"{share:.1%}",
        number(float(np.median(errors))),
        number(max(errors)),
        str(len(report.wrong())),
    ]


def _tables(reports: list[tuple[int, Report]]) -> list[Table]:
    rows = [_row(each) for _, each in reports if each.fault.group != "none"]
    notes = (
        f"{AGL_M:g} m above generated ground of another date than the map's ({MAP_M / 1000:g} km "
        f"square), {SPEED_MPS:g} m/s with turns and turbulence, live camera of {CAMERA.width_px} x "
        f"{CAMERA.height_px} px at {VIEWS_HZ:g} Hz, telemetry at 25 Hz; {LEAD_S:g} s (--quick: "
        f"{QUICK_LEAD_S:g} s) undisturbed before the fault, unless it is there from the start",
        "s, views, sent: length of the fault, images and messages during it; worst: largest error "
        "of a message from its begin to the end of the flight; wrong: messages of the whole flight "
        f"more than {FAR_M:g} m and {FAR_STD:g} standard deviations of their own fix off",
        "recovered: from the end of the fault to the next message within "
        f"{FAR_M:g} m, none: within {RECOVERY_S:g} s (--quick: {QUICK_RECOVERY_S:g} s) or as long "
        "as the map stays truncated; lead-in sent: share of its views, from the first message on",
    )
    made = [Table("Faults", HEADER, rows, notes)] if rows else []
    calm = [_calm_row(each, seed) for seed, each in reports if each.fault.group == "none"]
    if calm:
        header = ("undisturbed", "views", "first message s", "sent", "median m", "worst m", "wrong")
        made.append(Table("Undisturbed flights", header, calm))
    return made


def _jobs(options: argparse.Namespace) -> list[tuple[Path, Fault, int]]:
    faults = [*COMBINED_FAULTS, *OWN_MAPS, *GROUND_FAULTS, *CAMERA_FAULTS, *TELEMETRY_FAULTS]
    if options.only:
        faults = [f for f in faults if any(each in f.name for each in options.only)]
    jobs = [(f, SEED + i) for f in faults for i in range(options.seeds)]
    if not options.only or "undisturbed" in options.only:
        seeds = CALM_SEEDS[:1] if options.quick else CALM_SEEDS
        jobs += [(undisturbed(CALM_S), seed) for seed in seeds]
    return [(options.work, fault, seed) for fault, seed in jobs]


def _flown(job_number: tuple[list[str], int]) -> tuple[int, Report]:
    """One flight by the names of its fault, for processes."""
    arguments, index = job_number
    options = _parser().parse_args(arguments)
    job = _jobs(options)[index]
    return job[2], _fly(job, options.quick)


def main(arguments: Sequence[str]) -> int:
    """Fly all faults and print the tables; returns the exit code, 1 where a message was wrong."""
    options = _parser().parse_args(arguments)
    started = provenance("faults-quick" if options.quick else "faults")
    begin = time.perf_counter()
    options.work.mkdir(parents=True, exist_ok=True)
    jobs = _jobs(options)
    _world(options.work, "usual")  # made once, before processes share it
    reports: list[tuple[int, Report]] = []
    # Not forked: threads of this process would be lost in a child.
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        for seed, report in pool.map(_flown, [(list(arguments), i) for i in range(len(jobs))]):
            reports.append((seed, report))
            cells = _row(report) if report.fault.group != "none" else _calm_row(report, seed)
            wall_s = time.perf_counter() - begin
            print(f"{wall_s:5.0f} s  {' | '.join(cells)}  {report.withheld}", file=sys.stderr)
    section = Section("Faults", _tables(reports))
    wrong = sum(len(each.wrong()) for _, each in reports if each.fault.detectable)
    section.facts = {
        "views": sum(len(each.views) for _, each in reports),
        "messages": sum(len(each.sent) for _, each in reports),
        "wrong_messages": wrong,
    }
    print(section.markdown())
    print(", ".join(f"{value:g} {key.replace('_', ' ')}" for key, value in section.facts.items()))
    wall_s = time.perf_counter() - begin
    save(options.out, [section], started, wall_s=wall_s, latest=False)
    return int(wrong > 0)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.faults", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="faults whose name has this")
    parser.add_argument(
        "--quick", action="store_true", help="shorter flights, only one without a fault"
    )
    parser.add_argument("--seeds", type=int, default=1, help="flights per fault (default 1)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    parser.add_argument("--work", type=Path, default=Path("bench_results/faults"))
    parser.add_argument("--out", type=Path, default=Path("bench_results"))
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
