"""Builds a corridor from JPEG 2000 tiles: speed, memory, interruption and resumption.

`python -m benchmarks.corridor [--quick] [--km 50] [--work DIR] [--out DIR]` generates the landscape
under a corridor 5 km wide, as tiles of 1 km at 1 m in Lambert-93, named and compressed as IGN does
(stored in the work folder: minutes the first time), builds it with 1 and 2 workers, each in a
process of its own, kills a third build half way, and prints how long the rest takes.
"""

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.transform import Affine
from rasterio.warp import transform as transform_coordinates

from benchmarks.child import peak_memory_mb
from benchmarks.inputs import LANDSCAPE_SEED, PAST, generator_digest
from benchmarks.record import Section, Table, number, provenance, save
from lab import landscape
from orthonav.core.files import replacing
from orthonav.ground.planning.route import Route

BAND_M, TILE_M, COURSE_DEG = 5000.0, 1000, 60.0
"""The course is neither a row nor a column of blocks: the corridor fills a third of its box."""
QUALITY = 12.5
"""Per cent of the raw size: a ratio of 8, as E080 in the names of IGN's packages."""
LAMBERT = "EPSG:2154"
GSD_M = 1.0
MEMORY_LIMIT_MB = 2000.0


def main(arguments: Sequence[str]) -> int:
    """Generate, build, kill, resume, print; returns the exit code."""
    options = _parser().parse_args(arguments)
    if options.child:
        return _child(Path(options.child[0]), Path(options.child[1]), int(options.child[2]))
    started, start = provenance("corridor"), time.perf_counter()
    km = min(options.km, 10.0) if options.quick else options.km
    route = route_of(km)
    folder = generated(options.work, route)
    section = _measured(folder, options.work / "built", km)
    print(section.markdown())
    wall_s = time.perf_counter() - start
    paths = save(options.out, [section], started, wall_s=wall_s, latest=False)
    print(f"written to {', '.join(map(str, paths))}", file=sys.stderr)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.corridor", description=str(__doc__).splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="10 km long")
    parser.add_argument("--km", type=float, default=50.0, help="length, ends included (default 50)")
    parser.add_argument("--work", type=Path, default=Path("bench_results/corridor"))
    parser.add_argument("--out", type=Path, default=Path("bench_results"))
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    return parser


def route_of(km: float) -> Route:
    """The line of a corridor that is so long with the half circles at its ends."""
    east, north = landscape.ORIGIN_M
    length_m = 1000 * km - BAND_M
    course = math.radians(COURSE_DEG)
    x = [east, east + length_m * math.sin(course)]
    y = [north, north + length_m * math.cos(course)]
    lon, lat = transform_coordinates(LAMBERT, "EPSG:4326", x, y)[:2]
    return Route(tuple(zip(lat, lon, strict=True)))


def generated(work: Path, route: Route) -> Path:
    """Folder of the tiles under the corridor, as a package of IGN; missing tiles are generated."""
    name = f"BDORTHO_2-0_RVB-1M00_JP2-E080_LAMB93_D000_{PAST.name[:4]}-01-01-{generator_digest()}"
    folder = work / name / "ORTHOHR" / "1_DONNEES_LIVRAISON"
    folder.mkdir(parents=True, exist_ok=True)
    made = landscape.Landscape(LANDSCAPE_SEED)
    corners = _corners(route)
    for done, (east, north) in enumerate(corners):
        path = folder / (
            f"00-{PAST.name[:4]}-{east // 1000:04d}-{north // 1000:04d}-LA93-1M00-E080.jp2"
        )
        if not path.is_file():
            _write_tile(path, made, east, north)
            print(f"tile {done + 1} of {len(corners)}", end="\r", file=sys.stderr, flush=True)
    return work / name


def _corners(route: Route) -> list[tuple[int, int]]:
    """North-west corners in Lambert-93 of the tiles that a map of the corridor may look at."""
    lat, lon = zip(*route.waypoints, strict=True)
    x, y = transform_coordinates("EPSG:4326", LAMBERT, lon, lat)[:2]
    (x0, x1), (y0, y1) = x, y
    # A block that may matter reaches beyond the band by less than its own diagonal and a tile.
    reach_m = BAND_M / 2 + 300 + TILE_M * math.sqrt(0.5)
    found = []
    for north in range(_floor(min(y) - reach_m), _floor(max(y) + reach_m) + TILE_M, TILE_M):
        for east in range(_floor(min(x) - reach_m), _floor(max(x) + reach_m) + TILE_M, TILE_M):
            px, py = east + TILE_M / 2 - x0, north - TILE_M / 2 - y0
            leg = math.hypot(x1 - x0, y1 - y0)
            along = min(max((px * (x1 - x0) + py * (y1 - y0)) / leg, 0), leg)
            off = math.hypot(px - along * (x1 - x0) / leg, py - along * (y1 - y0) / leg)
            if off <= reach_m:
                found.append((east, north))
    return found


def _floor(value_m: float) -> int:
    return math.floor(value_m / TILE_M) * TILE_M


def _write_tile(path: Path, made: landscape.Landscape, east: int, north: int) -> None:
    side = round(TILE_M / GSD_M)
    picture = np.moveaxis(made.render(PAST, east, north, side, side, GSD_M), 2, 0)
    profile = {
        "driver": "MEM",
        "width": side,
        "height": side,
        "count": 3,
        "dtype": "uint8",
        "crs": LAMBERT,
        "transform": Affine(GSD_M, 0, east, 0, -GSD_M, north),
    }
    with replacing(path) as temporary, rasterio.MemoryFile() as memory:
        with memory.open(**profile | {"driver": "GTiff"}) as data:
            data.write(picture)
        with memory.open() as data:
            rasterio.shutil.copy(data, temporary, driver="JP2OpenJPEG", quality=QUALITY)


def _measured(folder: Path, out: Path, km: float) -> Section:
    section = Section("Corridor")
    out.mkdir(parents=True, exist_ok=True)
    rows, first = [], None
    for workers in (1, 2):
        path = out / f"{workers}.onav"
        result = _built(folder, path, km, workers)
        rows.append(_row(f"{workers} workers" if workers > 1 else "1 worker", result))
        first = first or path.read_bytes()
        same = path.read_bytes() == first
        for name in ("wall_s", "read_s", "peak_mb"):
            unit = "MB" if name.endswith("mb") else "s"
            section.add(f"{workers} workers: {name}", unit, [result[name]], data=f"{km:g} x 5 km")
        if not same:
            raise RuntimeError("maps of 1 and 2 workers differ")
    done_share, result = _killed_and_resumed(folder, out / "killed.onav", km)
    if (out / "killed.onav").read_bytes() != first:
        raise RuntimeError("the map of the interrupted build differs")
    rows.append(_row(f"interrupted at {done_share:.0%}, resumed", result))
    header = ("build", "km2", "wall s", "reading s", "km2/s", "km2/s reading", "peak MB", "map MB")
    size_mb = sum(path.stat().st_size for path in folder.rglob("*.jp2")) / 1e6
    tiles = len(list(folder.rglob("*.jp2")))
    notes = (
        f"{km:g} x 5 km at {GSD_M:g} m, {tiles} JPEG 2000 tiles of 1 km, {size_mb:.0f} MB",
        "all three maps are the same byte for byte; km2 are those of tile centres",
        f"memory limit {MEMORY_LIMIT_MB:.0f} MB",
    )
    section.tables = [Table("Corridor", header, rows, notes)]
    return section


def _row(name: str, result: dict[str, Any]) -> list[str]:
    km2 = result["km2"]
    return [
        name,
        *(number(km2), number(result["wall_s"]), number(result["read_s"])),
        *(number(km2 / result["wall_s"]), number(km2 / max(result["read_s"], 1e-3))),
        *(number(result["peak_mb"]), number(result["map_mb"])),
    ]


def _command(folder: Path, out: Path, km: float, workers: int) -> list[str]:
    child = ["--km", str(km), "--child", str(folder), str(out), str(workers)]
    return [sys.executable, "-m", "benchmarks.corridor", *child]


def _built(folder: Path, out: Path, km: float, workers: int) -> dict[str, Any]:
    """Figures of one build in a fresh process."""
    out.unlink(missing_ok=True)
    start = time.perf_counter()
    done = subprocess.run(
        _command(folder, out, km, workers), stdout=subprocess.PIPE, text=True, check=True
    )
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    result["wall_s"] = time.perf_counter() - start
    return result


def _killed_and_resumed(folder: Path, out: Path, km: float) -> tuple[float, dict[str, Any]]:
    """Share of blocks finished when a build was killed, and the figures of the resumed build."""
    out.unlink(missing_ok=True)
    work = out.with_name(f"{out.name}.work")
    process = subprocess.Popen(_command(folder, out, km, 2), stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    blocks = int(process.stdout.readline())
    while process.poll() is None and len(list(work.glob("r*.npz"))) < blocks / 2:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done_share = len(list(work.glob("r*.npz"))) / blocks
    return done_share, _built(folder, out, km, 2)


def _child(folder: Path, out: Path, workers: int) -> int:
    """Build, and print how many blocks there are, then how it went."""
    from orthonav.ground.build import BuildRequest, build_map
    from orthonav.ground.build.sheet import SheetReader

    begun = time.perf_counter()
    marks: dict[str, float] = {}

    def progress(stage: str, share: float) -> None:
        marks.setdefault(stage, time.perf_counter())

    def timed_read(reader: SheetReader, *arguments: Any, **named: Any) -> None:
        print(reader.blocks, flush=True)
        marks["begin"] = time.perf_counter()
        read(reader, *arguments, **named)

    read = SheetReader.read
    setattr(SheetReader, "read", timed_read)  # noqa: B010 - mypy knows methods as constants
    km = float(sys.argv[sys.argv.index("--km") + 1])
    request = BuildRequest(
        [folder], out, route=route_of(km), band_m=BAND_M, gsd_m=GSD_M, workers=workers
    )
    result = build_map(request, progress)
    account = {
        "km2": result.manifest.sheets[0].area_km2,
        "tiles": result.manifest.sheets[0].tiles,
        "map_mb": result.size_bytes / 1e6,
        "open_s": marks["begin"] - begun,
        "read_s": marks["learn"] - marks["begin"],
        "peak_mb": peak_memory_mb(),
    }
    print(json.dumps(account))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
