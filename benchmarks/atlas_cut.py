"""A flight's map cut out of an atlas: 50 x 5 km at 1 m, its time, its memory, and the floor.

`python -m benchmarks.atlas_cut [--quick] [--km 50] [--repeats 3] [--work DIR] [--out DIR]` builds
one sheet of a generated landscape (in the work folder: a minute the first time), fills an atlas
under the corridor with copies of it, and cuts with 1 and 2 threads, each run in its own process.
Every sheet of the atlas shows the same ground in another place: cutting is as much work as from
real sheets, but the map is not one to fly.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from rasterio.warp import transform as transform_coordinates

from benchmarks.child import peak_memory_mb
from benchmarks.corridor import BAND_M, GSD_M, LAMBERT, route_of
from benchmarks.inputs import LANDSCAPE_SEED, PAST, generator_digest
from benchmarks.record import Section, Table, number, provenance, save
from lab import landscape
from orthonav import __version__
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.mapfile import MapFile, open_map, write_map
from orthonav.core.mapfile.layer import GreyLayer
from orthonav.ground.atlas.catalog import Atlas, AtlasRecipe
from orthonav.ground.atlas.cut import box_deg, cut_map
from orthonav.ground.atlas.item import Sheet
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.build.layer import CHUNK_PX, compressed_block
from orthonav.ground.planning.area import Area, Extent

SHEET_KM = 5.0
WIDER = 1.03
"""The copied sheet is larger than its box by this factor: boxes farther south are wider."""
TARGET_S = 10.0
LATLON = "EPSG:4326"


def main(arguments: Sequence[str]) -> int:
    """Build a sheet, fill the atlas, cut, print; returns the exit code."""
    options = _parser().parse_args(arguments)
    if options.child:
        return _child(Path(options.child[0]), Path(options.child[1]), int(options.child[2]))
    started, start = provenance("atlas-cut"), time.perf_counter()
    km = min(options.km, 10.0) if options.quick else options.km
    base = _base(options.work)
    folder = _filled(options.work / f"atlas-{km:g}km", base, km)
    section = _measured(folder, base, options.work / "cut.onav", km, options.repeats)
    print(section.markdown())
    wall_s = time.perf_counter() - start
    paths = save(options.out, [section], started, wall_s=wall_s, latest=False)
    print(f"written to {', '.join(map(str, paths))}", file=sys.stderr)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.atlas_cut", description=str(__doc__).splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="10 km long")
    parser.add_argument("--km", type=float, default=50.0, help="length, ends included (default 50)")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--work", type=Path, default=Path("bench_results/atlas_cut"))
    parser.add_argument("--out", type=Path, default=Path("bench_results"))
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    return parser


def _recipe() -> AtlasRecipe:
    return AtlasRecipe(gsd_m=GSD_M, sheet_km=SHEET_KM, coarse=None)


def _base(work: Path) -> Path:
    """The sheet that is copied: a generated square."""
    work.mkdir(parents=True, exist_ok=True)
    out = work / f"sheet-{generator_digest()}-{__version__}.onav"
    if out.is_file():
        return out
    side_m = 1000 * SHEET_KM * WIDER + 400
    folder = work / "ortho"
    ortho = landscape.generate_area(
        folder, size_m=(side_m, side_m), gsd_m=GSD_M, dates=[PAST], seed=LANDSCAPE_SEED
    )
    middle = np.array(landscape.ORIGIN_M) + side_m / 2
    lon, lat = transform_coordinates(LAMBERT, LATLON, [middle[0]], [middle[1]])[:2]
    bounds = _box_around(lat[0], lon[0])
    build_map(BuildRequest(ortho, out, bounds_deg=bounds, gsd_m=GSD_M, cells=True))
    shutil.rmtree(folder)
    return out


def _box_around(lat: float, lon: float) -> Extent:
    """The box of the lattice there, widened by `WIDER`."""
    sheets = _recipe().sheets
    west, south, east, north = sheets.bounds_deg(sheets.name_at(lat, lon))
    width, height = WIDER * (east - west) / 2, WIDER * (north - south) / 2
    return lon - width, lat - height, lon + width, lat + height


def _filled(folder: Path, base: Path, km: float) -> Path:
    """The folder of an atlas with the sheet in all places under the corridor."""
    if (folder / "complete").is_file():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    atlas, opened = Atlas.open_or_create(str(folder), _recipe()), open_map(base)
    area = Area.from_route(route_of(km), BAND_M)
    sheets = _recipe().sheets
    for name in sheets.over(box_deg(area, 500.0)):
        bounds = sheets.bounds_deg(name)
        if _near(area, bounds):
            moved = folder.parent / "moved.onav"
            atlas.put({"map": moved}, _moved(opened, name, bounds, moved))
            moved.unlink()
    (folder / "complete").touch()
    return folder


def _near(area: Area, bounds: Extent) -> bool:
    west, south, east, north = bounds
    middle = area.frame.en_from_latlon((south + north) / 2, (west + east) / 2)
    return bool(area.contains(middle[None], 1000 * SHEET_KM)[0])


def _moved(opened: MapFile, name: str, bounds: Extent, out: Path) -> Sheet:
    """Write the map moved to the middle of other bounds."""
    west, south, east, north = bounds
    sheet = opened.manifest.sheets[0]
    frame = LocalFrame((south + north) / 2, (west + east) / 2)
    manifest = replace(opened.manifest, sheets=(replace(sheet, frame=frame),))
    write_map(out, manifest, opened.arrays)
    imagery = manifest.imagery
    dates = tuple(str(each["date"]) for each in imagery)
    made_by = {"orthonav": __version__}
    return Sheet(
        name, bounds, GSD_M, sheet.tiles, sheet.area_km2, dates, imagery, "benchmark", made_by
    )


def _measured(folder: Path, base: Path, out: Path, km: float, repeats: int) -> Section:
    section = Section("Atlas cut")
    rows, first, data = [], None, f"{km:g} x 5 km"
    for workers in (1, 2):
        runs = [_cut(folder, out, km, workers) for _ in range(repeats)]
        first = first or out.read_bytes()
        if out.read_bytes() != first:
            raise RuntimeError("maps of 1 and 2 threads differ")
        first_run = runs[0]
        wall = section.add(f"{workers} threads: wall", "s", [r["wall_s"] for r in runs], data=data)
        cut = section.add(f"{workers} threads: cut", "s", [r["cut_s"] for r in runs], data=data)
        parts = [
            float(np.median([run[name] for run in runs]))
            for name in ("open_s", "read_s", "learn_s", "cpu_s")
        ]
        rows.append(
            [
                f"{workers}",
                *(number(first_run["km2"]), number(wall.median), number(cut.median)),
                *map(number, parts),
                *(number(first_run["peak_mb"]), number(first_run["map_mb"])),
                "yes" if cut.median < TARGET_S else "NO",
            ]
        )
    stages = ("open s", "resample s", "learn, write s", "CPU s")
    more = ("peak MB", "map MB", f"below {TARGET_S:g} s")
    header = ("threads", "km2", "wall s", "cut s", *stages, *more)
    sheets = list((folder / "sheets").glob("*.onav"))
    size_mb = sum(path.stat().st_size for path in sheets) / 1e6
    notes = (
        f"{km:g} x 5 km at {GSD_M:g} m from {len(sheets)} sheets of {SHEET_KM:g} km, "
        f"{size_mb:.0f} MB, every sheet a copy of one in its own place; median of {repeats} runs",
        "wall: the whole process, Python's start and imports included; the maps of all runs are "
        "the same byte for byte",
        _floor(base, first_run["valid_mpx"]),
    )
    section.tables = [Table("Atlas cut", header, rows, notes)]
    return section


def _floor(base: Path, mpx: float) -> str:
    """Time to decode, resample and compress `mpx` million pixels on one core."""
    cv2.setNumThreads(1)
    layer = GreyLayer.of(open_map(base), cache_bytes=0)
    assert layer is not None
    side = 4 * CHUNK_PX
    seconds = np.zeros(3)
    turn = np.array([[1, 0.003, 0.4], [-0.003, 1, 0.3]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    blocks = [(row, col) for row in range(0, 4 * side, side) for col in range(0, 4 * side, side)]
    for row, col in blocks:
        marks = [time.perf_counter()]
        grey, valid = layer.read(0, row, col, side, side)
        marks.append(time.perf_counter())
        grey = np.asarray(cv2.warpAffine(grey, turn, (side, side), flags=flags), np.uint8)
        marks.append(time.perf_counter())
        compressed_block(grey, valid)
        seconds += np.diff([*marks, time.perf_counter()])
    decode, warp, encode = seconds / (len(blocks) * side**2 / 1e6) * mpx
    return (
        f"floor for the grey picture of {mpx:.0f} million pixels on one core: {decode:.1f} s to "
        f"decode, {warp:.1f} s to resample, {encode:.1f} s to compress"
    )


def _cut(folder: Path, out: Path, km: float, workers: int) -> dict[str, Any]:
    """One cut in a new process, and its own figures."""
    out.unlink(missing_ok=True)
    start = time.perf_counter()
    command = [sys.executable, "-m", "benchmarks.atlas_cut", "--km", str(km), "--child"]
    command += [str(folder), str(out), str(workers)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    figures: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return figures | {"wall_s": time.perf_counter() - start}


def _child(folder: Path, out: Path, workers: int) -> int:
    marks: dict[str, float] = {}

    def progress(stage: str, share: float) -> None:
        marks[f"{stage} {share:g}"] = time.perf_counter()

    km = float(sys.argv[sys.argv.index("--km") + 1])
    begun, cpu = time.perf_counter(), time.process_time()
    atlas = Atlas.open(str(folder))
    done = cut_map(
        atlas, out, Area.from_route(route_of(km), BAND_M), workers=workers, progress=progress
    )
    ended = time.perf_counter()
    sheet = done.manifest.sheets[0]
    grid: TileGrid = sheet.grid
    assert sheet.grey is not None and grid.gsd_m == GSD_M
    account = {
        "km2": sheet.area_km2,
        "valid_mpx": sheet.grey.valid_px / 1e6,
        "map_mb": done.size_bytes / 1e6,
        "cut_s": ended - begun,
        "open_s": marks["sheets 1"] - begun,
        "read_s": marks["learn 0"] - marks["sheets 1"],
        "learn_s": ended - marks["learn 0"],
        "cpu_s": time.process_time() - cpu,
        "peak_mb": peak_memory_mb(),
    }
    print(json.dumps(account))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
