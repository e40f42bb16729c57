"""Building an atlas: sheets and km2 per hour with one worker and with several, memory and size.

Each build is the command line in its own process. Workers are those of Ray on this machine; the
time includes the start of Ray.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.inputs import LANDSCAPE_SEED, PAST, Workplace
from benchmarks.record import Section, Table, number
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.sheets import WorldSheets

SIDE_M, SHEET_KM = 6000, 1.9
QUICK_SIDE_M, QUICK_SHEET_KM = 4000, 1.25
"""At least two whole sheets fit in a row of the area, at any origin of the lattice."""
INNER = 0.98
"""Share of the orthophoto's width that is covered in spite of its rotation against the lattice."""
NOTES = (
    "1 m, 256 px tiles, 87.5 % overlap, coarse tiles, no index; larger sheets cost less, because "
    "learning the confidence takes as long for any size",
    "km2/h and sheets/h: of the whole command but for loading Python; CPU s and peak: of the "
    "building processes, the peak being the greatest of any of them",
)


def measure(place: Workplace) -> Section:
    """Build the same sheets with one worker in the process, and with one and more by Ray."""
    section = Section("Atlas: building")
    side_m, sheet_km = (SIDE_M, SHEET_KM)
    if place.quick:
        side_m, sheet_km = (QUICK_SIDE_M, QUICK_SHEET_KM)
    ortho = place.area(side_m, 1.0, [PAST])[0]
    area = ["--sheet-km", str(sheet_km), f"--bounds={_whole_row(ortho, sheet_km)}"]
    data = f"sheets of at most {sheet_km:g} km, 1 m"
    repeats = 1 if place.quick else 2
    rows = []
    for name, options in _runners():
        runs = [_built(ortho, place.scratch / "atlas", [*area, *options]) for _ in range(repeats)]
        row = [name, str(runs[0]["built"]), number(runs[0]["area_km2"])]
        for key, unit in (
            ("wall_s", "s"),
            ("sheets_per_hour", "1/h"),
            ("km2_per_hour", "km2/h"),
            ("cpu_s_per_km2", "s/km2"),
            ("peak_mb", "MB"),
            ("mb_per_km2", "MB/km2"),
        ):
            samples = [run[key] for run in runs]
            made = section.add(f"{name}: {key}", unit, samples, data=data, seed=LANDSCAPE_SEED)
            row.append(number(made.median))
        rows.append(row)
    section.facts["atlas_km2_per_hour"] = section.measurements[2].median
    header = ["workers", "sheets", "km2", "wall s", "sheets/h", "km2/h", "CPU s/km2", "peak MB"]
    table = Table(section.title, [*header, "MB/km2"], rows, (f"{data}, n = {repeats}", *NOTES))
    section.tables = [table]
    return section


def _whole_row(ortho: Path, sheet_km: float) -> str:
    """Bounds of the sheets of one row that the orthophoto fills."""
    world = WorldSheets(sheet_km * 1000)
    outline = Mosaic.open([ortho]).outline_latlon_deg
    frame = LocalFrame(*(outline.min(axis=0) + outline.max(axis=0)) / 2)
    points = frame.en_from_latlon(outline[:, 0], outline[:, 1])
    side_m = float(np.abs(points).max(axis=1).min())
    lat, lon = frame.latlon_from_en(np.array([[-side_m, -side_m], [side_m, side_m]]) * INNER)
    west, south, east, north = float(lon[0]), float(lat[0]), float(lon[1]), float(lat[1])
    boxes = [world.bounds_deg(name) for name in world.over((west, south, east, north))]
    whole = [b for b in boxes if b[0] > west and b[1] > south and b[2] < east and b[3] < north]
    row = [box for box in whole if box[1] == whole[0][1]]
    hair = 1e-6
    inner = row[0][0] + hair, row[0][1] + hair, row[-1][2] - hair, row[0][3] - hair
    return ",".join(map(str, inner))


def _runners() -> list[tuple[str, list[str]]]:
    cores = len(os.sched_getaffinity(0))
    runners = [("1, in the process", []), ("1, Ray", ["--cluster", "local", "--workers", "1"])]
    if cores > 1:
        runners.append((f"{cores}, Ray", ["--cluster", "local", "--workers", str(cores)]))
    return runners


def _built(ortho: Path, atlas: Path, options: list[str]) -> dict[str, Any]:
    """The summary of one build of a new atlas."""
    shutil.rmtree(atlas, ignore_errors=True)
    command = [sys.executable, "-m", "orthonav", "atlas", "build", str(atlas), "--json"]
    command += ["--ortho", str(ortho), "--no-index", *options]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary
