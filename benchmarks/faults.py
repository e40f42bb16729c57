"""The fault suite: what is sent while camera, telemetry, map or ground are wrong.

`python -m benchmarks.faults [--only TEXT ..] [--quick] [--seeds N] [--jobs N]` flies every fault of
`benchmarks.fault_scenarios` over a generated area, photographed at another date than its map, with
the flight loop of `orthonav fly` and simulated clocks, and prints one row per fault.
"""

import argparse
import copy
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

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
from benchmarks.record import Section, Table, number, quantiles, run, say, side_by_side
from benchmarks.scenes import PAST, PRESENT, area, map_of
from orthonav.core.geo.camera import Camera
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.simulate.render import ViewEffects, render_view

SIDE_M, MAP_M = 1600, 1200
"""Sides of the generated area, and of the map in its middle."""
REACH_M, AGL_M, SPEED_MPS = 380.0, 150.0, 18.0
EFFECTS = ViewEffects(exposure_std=0.05)
LEAD_S, RECOVERY_S, SEED = 15.0, 60.0, 5
QUICK_LEAD_S, QUICK_RECOVERY_S, QUICK_FAULT_S = 10.0, 20.0, 10.0
CALM_S, CALM_SEEDS = 60.0, (11, 12, 13)
MIRRORED, TRUNCATED = OWN_MAPS = (
    Fault("another place (mirrored ground)", "map", 30.0, from_start=True),
    Fault("map truncated in place", "map", 10.0),
)
HEADER = ("fault", "s", "views", "sent", "worst m", "false", "recovered s", "lead-in sent")


class Ground:
    """An orthophoto on the plane of a map.

    `side_m`: of a square around the origin, at 1 m; None: the raster of the map.
    """

    def __init__(self, path: Path, localizer: Localizer, side_m: int | None = None) -> None:
        grid = localizer.grid
        west_m, north_m, gsd_m = grid.west_m, grid.north_m, grid.gsd_m
        cols, rows = grid.width_px, grid.height_px
        if side_m is not None:
            west_m, north_m, gsd_m, cols, rows = -side_m / 2, side_m / 2, 1.0, side_m, side_m
        sheet = Mosaic.open([path]).sheet(
            localizer.sheet.frame,
            west_m=west_m,
            north_m=north_m,
            width_px=cols,
            height_px=rows,
            gsd_m=gsd_m,
        )
        with sheet as raster:
            rgb = np.asarray(raster.read(0, 0, rows, cols).rgb)
        self._corner, self._rgb, self._gsd_m = np.array([west_m, north_m]), rgb, gsd_m

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
        camera: Camera = CAMERA,
        effects: ViewEffects = EFFECTS,
    ) -> Grey:
        pose, corner, gsd_m = (*attitude, agl_m), self._corner - place, self._gsd_m
        seen = render_view(camera, pose, self._rgb, corner, gsd_m, effects, rng)
        return np.asarray(cv2.cvtColor(seen, cv2.COLOR_RGB2GRAY), np.uint8)


def middle_of(path: Path, side_m: int, out: Path) -> Path:
    """The middle of an orthophoto at 1 m as a file of its own."""
    if not out.is_file():
        with rasterio.open(path) as source:
            first = (source.width - side_m) // 2, (source.height - side_m) // 2
            part = Window(*first, side_m, side_m)
            rgb, tags = source.read(window=part), source.tags()
            profile = source.profile | {"width": side_m, "height": side_m}
            profile["transform"] = source.window_transform(part)
        with rasterio.open(out, "w", **profile) as target:
            target.write(rgb)
            target.update_tags(**tags)
    return out


@cache
def _world(work: Path, mirrored: bool) -> tuple[World, Path]:
    """The map and the ground, and the file of the map."""
    past, present = (area(work, date, side_m=SIDE_M) for date in (PAST, PRESENT))
    path = map_of(middle_of(past, MAP_M, work / "middle.tif"), work)
    localizer = Localizer(open_map(path))
    ground = Ground(present, localizer, SIDE_M)
    ground = ground.mirrored() if mirrored else ground
    frame = localizer.sheet.frame
    return World(localizer, frame, ground.picture, REACH_M, AGL_M, SPEED_MPS), path


def _fly(job: tuple[Path, str, int, bool]) -> tuple[int, Report]:
    """One flight: folder of work, name of the fault, seed, and whether it is a shorter one."""
    work, name, seed, quick = job
    cv2.setNumThreads(1)
    fault = next(each for each in _faults() if each.name == name)
    world, path = _world(work, name == MIRRORED.name)
    change: Callable[[], str | None] = lambda: None  # noqa: E731
    if name == TRUNCATED.name:
        broken = work / f"truncated-{os.getpid()}.onav"
        shutil.copyfile(path, broken)
        opened = open_map(broken)
        world, change = replace(world, localizer=Localizer(opened)), opened.change
        fault = replace(fault, begins=lambda _: os.truncate(broken, broken.stat().st_size // 3))
    is_undisturbed = fault.group == "none"
    if quick and not is_undisturbed and not fault.leaves_map and not fault.from_start:
        fault = replace(fault, seconds=min(fault.seconds, QUICK_FAULT_S))
    recovery_s = QUICK_RECOVERY_S if quick else RECOVERY_S
    report = FaultFlight(
        world,
        fault,
        seed=seed,
        lead_s=0.0 if is_undisturbed else QUICK_LEAD_S if quick else LEAD_S,
        recovery_s=0.0 if is_undisturbed or name == TRUNCATED.name else recovery_s,
        map_change=change,
    ).fly()
    # Functions cannot be passed between processes.
    plain = Fault(fault.name, fault.group, fault.seconds, detectable=fault.detectable)
    return seed, replace(report, fault=plain)


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


def undisturbed_cells(report: Report) -> list[str]:
    """First message, share sent after it, median and largest error, and false messages."""
    begin = report.sent[0].at_s if report.sent else np.inf
    views = sum(each >= begin for each in report.views)
    errors = [each.error_m for each in report.sent]
    share = f"{len(report.sent) / max(views, 1):.1%}"
    return [number(begin), share, *quantiles(errors, 50, 100), str(len(report.wrong()))]


def _faults() -> list[Fault]:
    faults = [*COMBINED_FAULTS, *OWN_MAPS, *GROUND_FAULTS, *CAMERA_FAULTS, *TELEMETRY_FAULTS]
    return [*faults, undisturbed(CALM_S)]


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="faults whose name has this")
    parser.add_argument("--seeds", type=int, default=1, help="flights per fault (default 1)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")


def measure(options: argparse.Namespace) -> Section:
    """Fly all faults; failed where a message was false that could be known."""
    _world(options.work, False)  # made once, before processes share it
    jobs = []
    for fault in _faults():
        if not options.only or any(text in fault.name for text in options.only):
            seeds = [SEED + i for i in range(options.seeds)]
            if fault.group == "none":
                seeds = list(CALM_SEEDS[: 1 if options.quick else None])
            jobs += [(options.work, fault.name, seed, options.quick) for seed in seeds]
    rows, undisturbed_rows, wrong = [], [], 0
    for seed, report in side_by_side(_fly, jobs, options.jobs):
        if report.fault.group == "none":
            cells = [f"seed {seed}", str(len(report.views)), *undisturbed_cells(report)]
            undisturbed_rows.append(cells)
        else:
            cells = _row(report)
            rows.append(cells)
        say(f"{' | '.join(cells)} {report.withheld}")
        wrong += len(report.wrong()) * report.fault.detectable
    notes = (
        f"{AGL_M:g} m above generated ground of another date than the map's, {SPEED_MPS:g} m/s "
        f"with turns and turbulence, {VIEWS_HZ:g} Hz; s, views, sent: during the fault; worst: "
        "from its begin to the end of the flight; false: messages of the flight more than "
        f"{FAR_M:g} m and {FAR_STD:g} standard deviations off; recovered: from the end of the "
        f"fault to a correct message within {RECOVERY_S:g} s (--quick: {QUICK_RECOVERY_S:g} s)",
    )
    tables = [Table("Faults", HEADER, rows, notes)] if rows else []
    if undisturbed_rows:
        header = ("undisturbed", "views", "first message s", "sent", "median m", "worst m", "false")
        tables.append(Table("Undisturbed flights", header, undisturbed_rows))
    return Section("Faults", tables, failed=wrong > 0)


if __name__ == "__main__":
    sys.exit(run(measure, add))
