"""Building maps: time, memory and size; each build is a process of its own, with one worker."""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.record import Section, Table, memory_mb, number, run, say
from benchmarks.scenes import PAST, SCENES, area, is_there, ortho
from orthonav.ground.build import BuildRequest, build_map


def measure(options: argparse.Namespace) -> Section:
    sizes = ((2000, 1.0), (4000, 1.0), (2000, 0.5))[: 1 if options.quick else 3]
    paths = [area(options.work, PAST, side_m=side_m, gsd_m=gsd_m) for side_m, gsd_m in sizes]
    naip = SCENES["naip"].file("20090818")
    if is_there(naip):
        paths.append(ortho(naip, options.work))
    rows = []
    for path in paths:
        start, out = time.perf_counter(), options.work / "built.onav"
        out.unlink(missing_ok=True)
        command = [sys.executable, "-m", "benchmarks.build", "--child", str(path), str(out)]
        found = json.loads(subprocess.check_output(command).splitlines()[-1])
        wall_s = time.perf_counter() - start
        figures = found["km2"], found["tiles"], wall_s, found["peak_mb"], found["map_mb"]
        name = f"{path.parent.name}, {path.stem}"
        rows.append([name, *map(number, figures), number(found["map_mb"] / found["km2"])])
        say("  ".join(rows[-1]))
    header = ("area", "km2", "tiles", "wall s", "peak MB", "map MB", "MB per km2")
    notes = ("256 px tiles, 87.5 % overlap, one worker",)
    return Section("Build", [Table("Build", header, rows, notes)])


def _child(source: Path, out: Path) -> None:
    result = build_map(BuildRequest([source], out, workers=1))
    sheet, size_mb = result.manifest.sheets[0], result.size_bytes / 1e6
    account = {"km2": sheet.area_km2, "tiles": sheet.tiles, "map_mb": size_mb}
    print(json.dumps({**account, "peak_mb": memory_mb()}))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        _child(Path(sys.argv[2]), Path(sys.argv[3]))
    else:
        sys.exit(run(measure))
