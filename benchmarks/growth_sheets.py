"""How the search of an atlas without any prior grows with its number of sheets.

The same views, of the first sheet, are searched in an atlas that gets more and more sheets, each
time in a process of its own. `python -m benchmarks.growth_sheets ATLAS FLIGHT` searches once and
prints JSON.
"""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.growth import Curve, plot
from benchmarks.inputs import FLIGHT_SEED, PAST, PRESENT, Workplace
from benchmarks.record import Section, Table, number
from benchmarks.tracking import TURNS_EN_M
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame, distances_m
from orthonav.ground.atlas.build import AtlasRequest, build_atlas
from orthonav.ground.atlas.cluster import SerialRunner
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Extent
from orthonav.ground.planning.route import Route
from orthonav.ground.planning.sheets import WorldSheets
from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight

SHEET_KM, GSD_M = 1.5, 8.0
SIDES = 1, 2, 4, 8
QUICK_SIDES = 1, 2
"""Sheets along a side of the atlas."""
MARGIN_SHEETS = 1.5
"""How much farther the imagery reaches: the lattice of sheets begins anywhere in it."""
CAMERA, AGL_M = Camera(160, 120, 187.5, 187.5, 80.0, 60.0), 1500.0
"""A pixel is one of the map; a view shows 1280 x 960 m."""
SPACING_M, ERRORS = 250.0, Errors(agl_std=0.02)
RIGHT_M = 80.0
HEADER = ("km2", "tiles", "ms", "largest ms", "first view ms", "open ms", "peak MB", "views right")


def measure(place: Workplace) -> Section:
    """Build, search, add sheets, and again. Writes `growth-sheets.png`."""
    section = Section("How a search grows with an atlas")
    sides = QUICK_SIDES if place.quick else SIDES
    imagery_m = round(1e3 * SHEET_KM * (sides[-1] + MARGIN_SHEETS))
    past, present = place.area(imagery_m, GSD_M, [PAST, PRESENT])
    first = first_sheet(past)
    flight = _flown(place, present, first)
    atlas, rows, counts, times_ms = place.scratch / "atlas", [], [], []
    for side in sides:
        _build(atlas, past, block(first, side))
        command = [sys.executable, "-m", "benchmarks.growth_sheets", str(atlas), str(flight)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        found = json.loads(done.stdout)
        print(f"        {found['sheets']} sheets done", file=sys.stderr, flush=True)
        counts.append(float(found["sheets"]))
        name = f"{found['sheets']} sheets: time"
        made = section.add(name, "ms", found["ms"], data="atlas", seed=FLIGHT_SEED)
        times_ms.append((made.median, max(found["ms"])))
        rows.append(_cells(found, times_ms[-1]))
    curve = Curve("sheets of an atlas", counts, times_ms, labels=("median", "largest"))
    notes = (
        *curve.notes("time of a view"),
        f"{found['views']} views of 1280 x 960 m of another date over the first sheet, each "
        f"searched on its own, heading unknown, no prior; sheets of at most {SHEET_KM:g} km at "
        f"{GSD_M:g} m, one atlas that grows; processor time of one core, one process per row",
        "first view: cold, it opens sheets, and is not in the others; open: atlas and index; "
        f"tiles: in the index; right: the likeliest place is within {RIGHT_M:g} m (10 px)",
    )
    section.tables.append(Table("Growth: sheets of an atlas", ("sheets", *HEADER), rows, notes))
    plot([curve], place.cache.parent / "growth-sheets.png")
    return section


def first_sheet(ortho: Path) -> Extent:
    """The most south-western sheet within an orthophoto: west, south, east, north in degrees."""
    world = WorldSheets(1e3 * SHEET_KM)
    outline = Mosaic.open([ortho]).outline_latlon_deg
    (south, west), (north, east) = outline.min(axis=0), outline.max(axis=0)
    frame = LocalFrame(float(south), float(west))
    margin_m = 0.2 * SHEET_KM * 1e3  # the imagery is rotated against the lattice
    lat, lon = frame.latlon_from_en(np.array([margin_m, margin_m]))
    boxes = map(world.bounds_deg, world.over((float(lon), float(lat), float(east), float(north))))
    return next(box for box in boxes if box[0] >= lon and box[1] >= lat)


def block(first: Extent, side: int) -> Extent:
    """Bounds of so many sheets to the east and north of the first one and with it."""
    west, south, east, north = first
    hair = 1e-6
    return (
        west + hair,
        south + hair,
        west + side * (east - west) - hair,
        south + side * (north - south) - hair,
    )


def _build(atlas: Path, ortho: Path, bounds_deg: Extent) -> None:
    recipe = {"gsd_m": GSD_M, "tile_px": 128, "sheet_km": SHEET_KM}
    request = AtlasRequest(str(atlas), [ortho], recipe, bounds_deg=bounds_deg)
    with SerialRunner() as runner:
        build_atlas(request, runner)


def _flown(place: Workplace, present: Path, sheet: Extent) -> Path:
    """A flight to and fro over the middle of a sheet."""
    west, south, east, north = sheet
    frame = LocalFrame((south + north) / 2, (west + east) / 2)
    lat, lon = frame.latlon_from_en(np.array(TURNS_EN_M, np.float64))
    folder = place.scratch / "lost"
    request = SimulateRequest(
        [present],
        folder,
        route=Route(tuple(zip(lat.tolist(), lon.tolist(), strict=True))),
        agl_m=AGL_M,
        spacing_m=SPACING_M,
        camera=CAMERA,
        errors=ERRORS,
        seed=FLIGHT_SEED,
    )
    simulate_flight(request)
    return folder


def _cells(found: dict[str, Any], times_ms: tuple[float, float]) -> list[str]:
    figures = (*times_ms, found["cold_ms"], found["opened_ms"], found["peak_mb"])
    return [
        f"{found['sheets']}",
        number(found["km2"]),
        f"{found['tiles']:,}",
        *(number(value) for value in figures),
        f"{found['right']} of {found['views']}",
    ]


def search(folder: Path, flight: Path) -> dict[str, Any]:
    """Search every view of a flight in an atlas: processor times in ms, and what was found."""
    import cv2

    from benchmarks.child import memory_mb
    from benchmarks.flights import read_views
    from orthonav.ground.atlas.catalog import Atlas
    from orthonav.ground.atlas.index import read_manifest
    from orthonav.ground.atlas.locate import PlaceFinder
    from orthonav.ground.atlas.search import SheetRegistrar, TileSearch

    cv2.setNumThreads(1)
    start = time.process_time()
    atlas = Atlas.open(folder)
    registrar, tiles = SheetRegistrar(atlas), TileSearch(atlas)
    opened_ms, manifest = 1e3 * (time.process_time() - start), read_manifest(atlas)
    assert manifest is not None
    times_ms, errors_m = list[float](), list[float]()
    for flown in read_views(flight)[1]:
        finder = PlaceFinder(registrar, tiles)
        start = time.process_time()
        finder.find(flown.view)
        times_ms.append(1e3 * (time.process_time() - start))
        likeliest = finder._agreement.best
        places = [] if likeliest is None else [likeliest.last.latlon_deg]
        errors_m += [float(distances_m([at], [flown.truth_latlon_deg])[0]) for at in places]
    return {
        "ms": times_ms[1:],
        "cold_ms": times_ms[0],
        "opened_ms": opened_ms,
        "peak_mb": memory_mb("VmHWM"),
        "sheets": len(atlas.sheets()),
        "km2": sum(sheet.area_km2 for sheet in atlas.sheets().values()),
        "tiles": sum(shard.rows for shard in manifest.shards),
        "right": sum(error_m <= RIGHT_M for error_m in errors_m),
        "views": len(times_ms),
    }


if __name__ == "__main__":
    print(json.dumps(search(Path(sys.argv[1]), Path(sys.argv[2]))))
