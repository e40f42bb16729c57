"""`orthonav build`: make a map from orthophotos."""

import argparse
import logging
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.cli.common import add_area, add_dem, add_orthos, print_json, progress

if TYPE_CHECKING:
    from orthonav.core.mapfile import Manifest

LEAST_SHIFT_M = 0.3
"""A pixel of the finest orthophotos of countries."""
log = logging.getLogger(__name__)

EVERYDAY = (
    *("--other-date", "--dem"),
    *("--route", "--bounds", "--band-m"),
    *("--gsd-m", "--work", "--json"),
)
RECIPE = (
    "gsd_m",
    "tile_px",
    "overlap",
    "method",
    "edges",
    "seed",
    "registration",
    "calibration_views",
)
"""Options that are fields of `BuildRequest` and of `AtlasRecipe`; None where not given."""


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", type=Path, required=True, metavar="MAP.onav", help="map file to write"
    )
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    imagery = parser.add_argument_group("imagery")
    add_orthos(imagery, "orthophoto (any georeferenced raster that GDAL reads)")
    imagery.add_argument(
        "--other-date",
        type=Path,
        action="append",
        default=[],
        metavar="TIF",
        help="orthophoto of the same area at another date, from which confidence and covariance "
        "are calibrated; it does not become part of the map; may be repeated",
    )
    imagery.add_argument(
        "--epoch",
        type=float,
        metavar="YEAR",
        help="decimal year of the flights, such as 2026.5, to which orthophotos in NAD83, ETRS89 "
        "or GDA94 are moved with their tectonic plate (default: they are taken as WGS 84)",
    )
    add_dem(imagery, "which gives the map a terrain layer")
    area = parser.add_argument_group("area (default: all imagery)")
    add_area(area, area.add_mutually_exclusive_group())
    add_recipe(parser.add_argument_group("map"))
    group = parser.add_argument_group("work")
    group.add_argument(
        "--work",
        type=Path,
        metavar="DIR",
        help="folder of finished blocks, and of checkpoints and images of a network's training, "
        "from which an interrupted build resumes (default: MAP.onav.work for large areas, removed "
        "when the map is written)",
    )
    group.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="number of parallel workers: threads that read imagery and make batches for a network "
        "(default: one per core; 2 make batches, up to 16 for a GPU)",
    )
    group.add_argument(
        "--device",
        default="auto",
        choices=("auto", "cpu", "cuda"),
        help="device on which a network is trained (default auto: a GPU if there is one)",
    )


def add_recipe(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--gsd-m", type=float, help="ground resolution, metres per pixel (default: of the imagery)"
    )
    parser.add_argument("--tile-px", type=int, help="width of a tile (default 256)")
    parser.add_argument(
        "--overlap",
        type=float,
        metavar="FRACTION",
        help="overlap of neighbouring tiles, as a fraction of their width (default 0.875)",
    )
    parser.add_argument(
        "--method",
        metavar="NAME[:FIELD=VALUE,..]",
        help="embedding: gradient (default), autoencoder, caevl, triplet or bovw",
    )
    parser.add_argument(
        "--edges",
        metavar="NAME[:FIELD=VALUE,..]",
        help="image representation: gradient, gray, canny (canny:low=100,high=200), segments, "
        "sam:weights=PATH or onnx:weights=PATH (default: gradient; canny for autoencoder and "
        "caevl, gray for triplet and bovw)",
    )
    parser.add_argument("--seed", type=int, help="seed of all random draws (default 0)")
    parser.add_argument(
        "--no-registration",
        dest="registration",
        action="store_const",
        const=False,
        help="omit the registration layer: a smaller map, with positions at tile level only",
    )
    parser.add_argument(
        "--calibration-views",
        type=int,
        metavar="N",
        help="mirrored views that measure the level of chance on this map (default 24)",
    )


def recipe_of(options: argparse.Namespace) -> dict[str, Any]:
    return {name: value for name in RECIPE if (value := getattr(options, name)) is not None}


def reporter(options: argparse.Namespace) -> Callable[[str], None]:
    if options.quiet or not sys.stderr.isatty():
        return log.info
    return lambda line: print(line, file=sys.stderr)


def run(options: argparse.Namespace) -> int:
    from orthonav.cli.info import summary, summary_text
    from orthonav.ground.build import BuildRequest, build_map
    from orthonav.ground.planning.route import read_route

    start = time.perf_counter()
    request = BuildRequest(
        orthos=options.ortho,
        out=options.out,
        bounds_deg=options.bounds,
        route=read_route(options.route) if options.route else None,
        band_m=options.band_m,
        other_dates=options.other_date,
        work=options.work,
        workers=options.workers,
        dem=options.dem,
        dem_datum=options.dem_datum,
        device=options.device,
        epoch=options.epoch,
        **recipe_of(options),
    )
    with progress(options) as shown:
        result = build_map(request, shown)
    plates = _plates(result.manifest) if options.epoch is None else []
    plain = summary(result.manifest, result.size_bytes, options.out)
    plain["build_s"] = round(time.perf_counter() - start, 3)
    if options.json:
        print_json(plain | {"plates": plates})
        return 0
    print(summary_text(plain))
    for each in plates:
        print(
            f"{each['crs']:.60} is taken as WGS 84, from which its tectonic plate has moved it by "
            f"{each['shift_m']:.1f} m; --epoch {each['epoch']:.1f} corrects this"
        )
    return 0


def _plates(manifest: "Manifest") -> list[dict[str, Any]]:
    """Systems that their tectonic plate has moved away from WGS 84 by now."""
    from orthonav.ground.imagery.plates import plate_shift_m

    now = time.gmtime()
    year = round(now.tm_year + now.tm_yday / 366, 1)
    sheet = manifest.sheets[0].frame
    systems = {str(each["crs"]) for each in manifest.imagery}
    shifts = {crs: plate_shift_m(crs, sheet.lat_deg, sheet.lon_deg, year) for crs in systems}
    return [
        {"crs": crs, "shift_m": round(shift_m, 2), "epoch": year}
        for crs, shift_m in sorted(shifts.items())
        if shift_m >= LEAST_SHIFT_M
    ]
