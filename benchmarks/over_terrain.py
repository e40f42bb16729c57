"""Views of a flight at a constant altitude over hills, with and without a terrain model.

`python -m benchmarks.over_terrain [--work DIR]` flies over a generated landscape at a constant
altitude above generated hills, and prints what of it is placed by level ground, by the terrain, and
by wrong ones: displaced, of another datum, with a hole. Views show flat ground at their own height.
"""

import argparse
import logging
import math
import tempfile
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.transform import Affine

from orthonav.cli.heights import map_heights
from orthonav.evaluate.metrics import compare
from orthonav.flight import open_flight, read_truth
from orthonav.geo.ground import TerrainHeights
from orthonav.geo.route import Route
from orthonav.imagery.terrain import open_dem
from orthonav.localizer import Localizer
from orthonav.mapfile import open_map
from orthonav.onboard.run import SingleViews, localize_flight
from orthonav.prepare import BuildRequest, build_map
from orthonav.records import CONFIDENT
from orthonav.simulate.flight import Errors, SimulateRequest, simulate_flight
from orthonav.simulate.landscape import DEFAULT_DATES, generate_area

SIZE_M, SEED = (2400.0, 2000.0), 3
AGL_M, SPACING_M, YAW_STD_DEG = 260.0, 60.0, 4.0
PX_M, MARGIN_M = 10.0, 200.0
HILLS_M, WAVES_M = (80.0, 50.0), (2600.0, 1900.0)
SHIFT_M, DATUM_M = 200.0, 50.0
HOLE = np.s_[60:140, 60:160]
CORNERS = ((300.0, 300.0), (2100.0, 500.0), (2100.0, 1700.0), (300.0, 1600.0))
RIGHT_M = 15.0
Array = NDArray[np.float64]


def main() -> None:
    """Fly, place, print the table."""
    logging.basicConfig(level=logging.ERROR)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, help="folder that is kept (default: a temporary one)")
    work = parser.parse_args().work
    with tempfile.TemporaryDirectory() as temporary:
        rows = measured(work or Path(temporary))
    print("| terrain | within 15 m | median error | confidence 0.9 or more | of these wrong |")
    print("|---|--:|--:|--:|--:|")
    for row in rows:
        print(row)


def measured(work: Path) -> list[str]:
    """Rows of the table."""
    past, present = generate_area(work / "area", size_m=SIZE_M, dates=DEFAULT_DATES[:2], seed=SEED)
    dems = terrains(past, work)
    build_map(BuildRequest([past], work / "map.onav"))
    flight = work / "flight"
    request = SimulateRequest(
        [present],
        flight,
        route=route_over(past),
        agl_m=AGL_M,
        spacing_m=SPACING_M,
        errors=Errors(yaw_std_deg=YAW_STD_DEG),
        terrain=open_dem(dems["right"], "msl"),
    )
    simulate_flight(request)
    rows = [row("none: level ground", work, None)]
    return rows + [row(name, work, open_dem(path, "msl")) for name, path in dems.items()]


def row(name: str, work: Path, terrain: TerrainHeights | None) -> str:
    """What is placed with this terrain."""
    opened, flight = open_map(work / "map.onav"), open_flight(work / "flight")
    truth = read_truth(work / "flight/truth.csv")
    start = (*next(iter(truth.values())), 0.0)
    heights = None if terrain is None else map_heights(opened, terrain, take_off=start)
    results = list(localize_flight(SingleViews(Localizer(opened)), flight, heights=heights))
    found = compare(truth, results, opened.manifest.sheets[0].frame)
    right = found.errors_m <= RIGHT_M
    sure = np.array([getattr(each.outcome, "confidence", math.nan) for each in results])
    sure_here = sure >= CONFIDENT
    wrong = int((sure_here & ~right).sum())
    median = float(np.median(found.errors_m))
    return f"| {name} | {right.mean():.0%} | {median:.1f} m | {sure_here.mean():.0%} | {wrong} |"


def terrains(ortho: Path, work: Path) -> dict[str, Path]:
    """Files of the hills under an orthophoto, right and wrong, by name."""
    with rasterio.open(ortho) as data:
        box, crs = data.bounds, data.crs
    west, north = box.left - MARGIN_M, box.top + MARGIN_M
    cols = round((box.right + MARGIN_M - west) / PX_M)
    rows = round((north - box.bottom + MARGIN_M) / PX_M)
    east_m = (np.arange(cols) + 0.5) * PX_M - MARGIN_M
    north_m = SIZE_M[1] + MARGIN_M - (np.arange(rows) + 0.5) * PX_M
    heights = (
        250.0
        + HILLS_M[0] * np.sin(2 * np.pi * east_m / WAVES_M[0])[None, :]
        + HILLS_M[1] * np.cos(2 * np.pi * north_m / WAVES_M[1])[:, None]
    )
    holed = heights.copy()
    holed[HOLE] = np.nan
    made = {
        "right": (heights, 0.0),
        f"displaced by {SHIFT_M:.0f} m": (heights, SHIFT_M),
        f"{DATUM_M:.0f} m too high": (heights + DATUM_M, 0.0),
        "with a hole": (holed, 0.0),
    }
    paths = {}
    for number, (name, (values, shift_m)) in enumerate(made.items()):
        paths[name] = path = work / f"dem{number}.tif"
        step = Affine(PX_M, 0, west + shift_m, 0, -PX_M, north)
        with rasterio.open(
            path, "w", driver="GTiff", width=cols, height=rows, count=1, dtype="float32", crs=crs,
            transform=step, nodata=math.nan,
        ) as data:  # fmt: skip
            data.write(values[None].astype(np.float32))
    return paths


def route_over(ortho: Path) -> Route:
    """The route over an orthophoto, from its south-west corner."""
    from rasterio.warp import transform

    with rasterio.open(ortho) as data:
        x = [data.bounds.left + east for east, _ in CORNERS]
        y = [data.bounds.bottom + north for _, north in CORNERS]
        lon, lat = transform(data.crs, "EPSG:4326", x, y)
    return Route(tuple(zip(lat, lon, strict=True)))


if __name__ == "__main__":
    main()
