"""Flights without a prior in 2,500 km2: five views, heading unknown, atlas of another year.

    python -m benchmarks.atlas_lost --work DIR [--trials 100] [--negatives 50]

Generates the area at 8 m (40 minutes on one core), its atlas of 36 sheets and its index (10
minutes), each once in DIR; then flies. A second row flies over mirrored imagery, which is not in
the atlas: every fix of it is wrong.
"""

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
import rasterio
from lab.landscape import DEFAULT_DATES, generate_area
from numpy.typing import NDArray
from pyproj import Transformer

from benchmarks.record import Section, Table, number, provenance, save
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import distances_m
from orthonav.core.records import CONFIDENT, Fix, Telemetry, View
from orthonav.ground.atlas.build import AtlasRequest, build_atlas
from orthonav.ground.atlas.catalog import Atlas
from orthonav.ground.atlas.cluster import SerialRunner
from orthonav.ground.atlas.locate import AtlasLocator
from orthonav.ground.atlas.search import SheetRegistrar, TileSearch

SIDE_M, GSD_M, SEED = 50_000.0, 8.0, 21
PAST, PRESENT = DEFAULT_DATES[2], DEFAULT_DATES[0]
RECIPE = {"gsd_m": GSD_M, "tile_px": 128, "sheet_km": 10.0}
VIEWS, EVERY_S = 5, 15.0
VIEW_PX, AGL_M = (160, 120), 1500.0
"""Pixels of 8 m: a view shows 1280 x 960 m."""
SPEEDS_MPS = (20.0, 60.0)
AGL_STD, AGL_JITTER = 0.03, 0.01
TURN_STD_RAD = 0.15
EDGE_PX = 300
RIGHT_M = 80.0
"""Ten pixels: the radius of the sheets' confidence."""


@dataclass(frozen=True)
class Outcome:
    """One view of one flight: error of its fix in m (NaN: no fix), confidence, processor time, and
    whether the flight had a fix before."""

    flight: int
    view: int
    error_m: float
    confidence: float
    cpu_ms: float
    after_fix: bool


def prepared(work: Path) -> tuple[Path, Path]:
    """Orthophoto of the views and atlas of the other year, generated if missing."""
    for date in (PAST, PRESENT):
        if not (work / f"{date.name}.tif").is_file():
            _say(f"{date.name}: generating {SIDE_M / 1000:.0f} x {SIDE_M / 1000:.0f} km")
            generate_area(work, size_m=(SIDE_M, SIDE_M), gsd_m=GSD_M, dates=[date], seed=SEED)
    atlas = work / "atlas"
    request = AtlasRequest(str(atlas), [work / f"{PRESENT.name}.tif"], RECIPE)
    with SerialRunner() as runner:
        build_atlas(request, runner, report=_say)
    return work / f"{PAST.name}.tif", atlas


def flights(
    ortho: Path, count: int, seed: int, *, mirrored: bool
) -> Iterator[list[tuple[NDArray[np.uint8], Telemetry, tuple[float, float]]]]:
    """Flights over an orthophoto: views (H, W), their telemetry, and where they were taken.

    The places of mirrored imagery mean nothing.
    """
    with rasterio.open(ortho) as opened:
        colours, transform = opened.read([1, 2, 3]), opened.transform
        to_latlon = Transformer.from_crs(opened.crs, 4326, always_xy=True)
    bands = np.ascontiguousarray(colours.transpose(1, 2, 0))
    grey = np.asarray(cv2.cvtColor(bands, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    if mirrored:
        grey = np.ascontiguousarray(grey[:, ::-1])
    rng = np.random.default_rng(seed)
    for _ in range(count):
        heading, speed = rng.uniform(0, 2 * math.pi), rng.uniform(*SPEEDS_MPS)
        place = rng.uniform(EDGE_PX, np.array(grey.shape[::-1]) - EDGE_PX)
        scale = rng.normal(0, AGL_STD)
        views = []
        for view in range(VIEWS):
            reported_m = AGL_M * math.exp(scale + rng.normal(0, AGL_JITTER))
            east, north = transform * (place + 0.5)
            lon, lat = to_latlon.transform(east, north)
            telemetry = Telemetry(round(view * EVERY_S * 1e9), math.nan, 0.0, 0.0, reported_m)
            views.append((_cut(grey, place, heading), telemetry, (lat, lon)))
            step_px = speed * EVERY_S / GSD_M
            place = place + step_px * np.array([math.sin(heading), -math.cos(heading)])
            heading += rng.normal(0, TURN_STD_RAD)
        yield views


def _cut(grey: NDArray[np.uint8], place: NDArray[np.float64], heading: float) -> NDArray[np.uint8]:
    cos, sin = math.cos(heading), math.sin(heading)
    linear = np.array([[cos, -sin], [sin, cos]])
    move = place - linear @ ((np.array(VIEW_PX) - 1) / 2)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    view = cv2.warpAffine(grey, np.column_stack([linear, move]), VIEW_PX, flags=flags)
    return np.asarray(view, dtype=np.uint8)


def flown(ortho: Path, atlas: Path, count: int, seed: int, *, mirrored: bool) -> list[Outcome]:
    """Locate every view of every flight without a prior."""
    width, height = VIEW_PX
    focal_px = AGL_M / GSD_M
    camera = Camera(width, height, focal_px, focal_px, width / 2, height / 2)
    outcomes = []
    search = TileSearch(Atlas.open(atlas))
    registrar = SheetRegistrar(search.atlas)
    for number_, flight in enumerate(flights(ortho, count, seed, mirrored=mirrored)):
        locator, after_fix = AtlasLocator(registrar, search), False
        for view, (grey, telemetry, truth) in enumerate(flight):
            start = time.process_time()
            outcome = locator.locate(View(grey, camera, telemetry))
            cpu_ms = (time.process_time() - start) * 1e3
            error_m = confidence = math.nan
            if isinstance(outcome, Fix):
                place = (outcome.lat_deg, outcome.lon_deg)
                error_m = math.inf if mirrored else float(distances_m([place], [truth])[0])
                confidence = outcome.confidence
            outcomes.append(Outcome(number_, view, error_m, confidence, cpu_ms, after_fix))
            after_fix = after_fix or isinstance(outcome, Fix)
        _say(f"flight {number_ + 1} of {count}: {_shown(outcomes[-VIEWS:])}")
    return outcomes


def _shown(views: list[Outcome]) -> str:
    return " ".join(
        "-" if math.isnan(each.error_m) else f"{each.error_m:.0f}m({each.confidence:.2f})"
        for each in views
    )


def row(name: str, outcomes: list[Outcome]) -> list[str]:
    """One row of the table."""
    trials = sorted({each.flight for each in outcomes})
    first = {}
    for each in outcomes:
        if each.confidence >= CONFIDENT and each.flight not in first:
            first[each.flight] = each
    right = sum(each.error_m <= RIGHT_M for each in first.values())
    fixes = [each for each in outcomes if not math.isnan(each.error_m)]
    confident = [each for each in fixes if each.confidence >= CONFIDENT]
    wrong = sum(each.error_m > RIGHT_M for each in confident)
    errors = [each.error_m for each in confident if each.error_m <= RIGHT_M]
    views = [each.view + 1 for each in first.values() if each.error_m <= RIGHT_M]
    seconds = [
        [each.cpu_ms / 1e3 for each in outcomes if each.after_fix == after]
        for after in (False, True)
    ]
    return [
        name,
        str(len(trials)),
        f"{right} ({right / len(trials):.0%})",
        number(float(np.median(views))) if views else "-",
        f"{wrong} of {len(confident)}",
        f"{sum(each.error_m > RIGHT_M for each in fixes)} of {len(fixes)}",
        number(float(np.median(errors))) if errors else "-",
        *(
            f"{np.mean(some):.2f} ({np.quantile(some, 0.9):.2f})" if some else "-"
            for some in seconds
        ),
    ]


def main() -> int:
    """Run, and write table and JSON to the folder of the other benchmarks."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.atlas_lost", description=__doc__)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--negatives", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("bench_results"))
    options = parser.parse_args()
    cv2.setNumThreads(1)
    started, start = provenance("atlas-lost"), time.perf_counter()
    ortho, atlas = prepared(options.work)
    found = flown(ortho, atlas, options.trials, options.seed, mirrored=False)
    rows = [row("another year", found)]
    if options.negatives:
        negatives = flown(ortho, atlas, options.negatives, options.seed + 1, mirrored=True)
        rows.append(row("negatives (mirrored)", negatives))
        found += negatives
    section = Section("Without a prior in 2,500 km2")
    section.tables.append(
        Table(
            f"{VIEWS} views {EVERY_S:.0f} s apart, {VIEW_PX[0]} x {VIEW_PX[1]} px of {GSD_M:g} m, "
            "any place, heading unknown, atlas of another year",
            (
                *("views of", "flights", "right when first confident", "at view (median)"),
                *("confident and wrong", "all fixes wrong", "error m (median)"),
                *("s before first fix (p90)", "s after (p90)"),
            ),
            rows,
            (
                f"Right: within {RIGHT_M:.0f} m (10 px). Confident: {CONFIDENT:g} or more. "
                f"Generated area, seed {SEED}; flights, seed {options.seed}. Seconds: "
                "processor time of a view, mean and 90th percentile, until a flight has its first "
                "fix and after it.",
            ),
        )
    )
    print(section.markdown())
    wall_s = time.perf_counter() - start
    save(options.out, [section], started, wall_s=wall_s, latest=False)
    path = options.out / "atlas-lost-views.json"
    path.write_text(json.dumps([vars(each) for each in found]).replace("NaN", "null"))
    return 0


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
