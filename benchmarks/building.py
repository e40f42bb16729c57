"""Building maps: speed, memory and size. Each build is a process of its own, with one worker.

`benchmarks.corridor` measures several.
"""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.inputs import LANDSCAPE_SEED, NAIP_ABSENT, NAIP_PAST, PAST, Workplace, naip
from benchmarks.machine import multiplying_gflops
from benchmarks.record import Section, Table, number
from orthonav.core.tiles.whitened import MAX_LEARNT_TILES

STAGES = ("start", "read", "represent", "cells", "learn", "embed", "calibrate", "register", "write")
STAGE_NOTES = (
    "start: Python, imports, opening the orthophoto; read: decoding and resampling into the "
    "sheet; represent: oriented gradients; cells: means over micro-cells and what else is done "
    "per block; learn: mean and whitening; embed: projection of all tiles; calibrate: confidence "
    "from changed crops of the map itself; register: joining the registration layer and its own "
    "calibration; write: file, checksums, end of the process.",
)


def measure(place: Workplace) -> Section:
    """Build every area some times."""
    section = Section("Build")
    rows, stages, floors = [], [], []
    gflops = multiplying_gflops()
    for name, ortho, seed in _areas(place):
        runs = [_build(ortho, place.scratch / "built.onav") for _ in range(place.repeats)]
        first = runs[0]
        wall = section.add(f"{name}: wall", "s", [r["wall_s"] for r in runs], data=name, seed=seed)
        peak = section.add(
            f"{name}: peak memory", "MB", [r["peak_mb"] for r in runs], data=name, seed=seed
        )
        km2, tiles, map_mb = first["km2"], first["tiles"], first["map_bytes"] / 1e6
        layer_mb = first["layer_bytes"] / 1e6
        section.add(f"{name}: map", "MB", [map_mb], data=name, seed=seed)
        section.add(f"{name}: registration layer", "MB", [layer_mb], data=name, seed=seed)
        rows.append(
            [
                name,
                *(number(km2), f"{tiles:,}", number(wall.median)),
                f"{number(wall.p10)}..{number(wall.p90)}",
                *(number(km2 / wall.median), number(tiles / wall.median)),
                *(number(peak.median), number(map_mb), number(layer_mb), number(map_mb / km2)),
            ]
        )
        medians = [
            section.add(f"{name}: {stage}", "s", [r[stage] for r in runs], data=name, seed=seed)
            for stage in STAGES
        ]
        stages.append([name, *(f"{one.median:.2f}" for one in medians)])
        floors.append([name, *_floor(first, ortho, gflops)])
        _facts(section, name, wall.median, (map_mb - layer_mb) / km2)
    header = ["area", "km2", "tiles", "wall s", "p10..p90", "km2/s", "tiles/s"]
    header += ["peak MB", "map MB", "layer MB", "MB/km2"]
    absent = () if naip(NAIP_PAST) else (NAIP_ABSENT,)
    note = f"256 px tiles, 87.5 % overlap, n = {place.repeats} processes each, one worker"
    section.tables = [
        Table("Build: whole", header, rows, (note, *absent)),
        Table("Build: seconds by stage", ("area", *STAGES), stages, STAGE_NOTES),
        Table(
            "Build: floor",
            ("area", "read MB", "decoded MB", "written MB", "projection GFLOP", "at peak s"),
            floors,
            (
                f"projection: learning's scatter matrix and the embeddings; at peak: at the "
                f"{gflops:.0f} GFLOP/s that one core's matrix product reaches here",
            ),
        ),
    ]
    return section


def _areas(place: Workplace) -> list[tuple[str, Path, int | None]]:
    areas: list[tuple[str, Path, int | None]] = [
        ("2 x 2 km, 1 m", place.area(2000, 1.0, [PAST])[0], LANDSCAPE_SEED)
    ]
    if not place.quick:
        areas += [
            ("4 x 4 km, 1 m", place.area(4000, 1.0, [PAST])[0], LANDSCAPE_SEED),
            ("2 x 2 km, 0.5 m", place.area(2000, 0.5, [PAST])[0], LANDSCAPE_SEED),
        ]
    real = naip(NAIP_PAST)
    return [*areas, ("NAIP 2009, 5 m", real, None)] if real else areas


def _facts(section: Section, name: str, wall_s: float, mb_per_km2: float) -> None:
    if name.startswith("NAIP"):
        section.facts["naip_build_s"] = wall_s
    elif name.endswith(" 1 m"):  # the larger area comes later: its fixed parts weigh less
        section.facts["map_mb_per_km2"] = mb_per_km2


def _floor(run: dict[str, Any], ortho: Path, gflops: float) -> list[str]:
    learnt = min(run["tiles"], MAX_LEARNT_TILES)
    work = 2 * run["features"] * (run["tiles"] * run["dims"] + learnt * run["features"]) / 1e9
    return [
        number(ortho.stat().st_size / 1e6),
        number(run["decoded_bytes"] / 1e6),
        number(run["map_bytes"] / 1e6),
        number(work),
        number(work / gflops),
    ]


def _build(ortho: Path, out: Path) -> dict[str, Any]:
    """One build in a fresh process: its own account, and the wall time seen from outside."""
    out.unlink(missing_ok=True)
    start = time.perf_counter()
    command = [sys.executable, "-m", "benchmarks.child", "build", str(ortho), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    wall_s = time.perf_counter() - start
    result: dict[str, Any] = json.loads(done.stdout)
    result["wall_s"] = wall_s
    result["start"] += wall_s - result["inside_s"]
    return result
