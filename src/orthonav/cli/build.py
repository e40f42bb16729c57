"""`orthonav build`: make a map, or the sheets of an atlas, from orthophotos."""

import argparse
import time
from pathlib import Path

from orthonav.cli import build_atlas
from orthonav.cli.common import add_area, add_orthos, print_json, progress

EVERYDAY = ("--route", "--bounds", "--band-m", "--gsd-m", "--other-date", "--work", "--json")
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
    """Add the arguments of the command."""
    add_orthos(parser, "orthophoto (any georeferenced raster that GDAL reads)")
    add_area(parser, parser.add_mutually_exclusive_group())
    parser.add_argument(
        "--gsd-m", type=float, help="ground resolution, metres per pixel (default: of the imagery)"
    )
    parser.add_argument("--tile-px", type=int, help="width of a tile (default 256)")
    parser.add_argument(
        "--overlap",
        type=float,
        metavar="SHARE",
        help="overlap of neighbouring tiles, as a share of their width (default 0.875)",
    )
    parser.add_argument(
        "--method",
        metavar="NAME[:FIELD=VALUE,..]",
        help="embedding: gradient (default), autoencoder, triplet or bovw",
    )
    parser.add_argument(
        "--edges",
        metavar="NAME[:FIELD=VALUE,..]",
        help="image representation: gradient, gray, canny (canny:low=100,high=200), segments or "
        "sam:weights=PATH (default: gradient; canny for autoencoder, gray for triplet and bovw)",
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
        "--other-date",
        type=Path,
        action="append",
        default=[],
        metavar="TIF",
        help="orthophoto of the same area at another date, from which the confidence and the "
        "covariance are calibrated; not part of the map (may be repeated)",
    )
    parser.add_argument(
        "--calibration-views",
        type=int,
        metavar="N",
        help="views generated from the orthophoto to calibrate the confidence (default 48)",
    )
    parser.add_argument(
        "--work",
        type=Path,
        metavar="DIR",
        help="folder for finished blocks and for training checkpoints; rerun an interrupted build "
        "with it to resume (default: blocks of a large area in MAP.onav.work until the map is "
        "written)",
    )
    parser.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="threads that read imagery (default: one per core); of an atlas, sheets at a time",
    )
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument("--out", type=Path, metavar="MAP.onav", help="map file to write")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    build_atlas.add(parser, target)


def run(options: argparse.Namespace) -> int:
    """Build the map and print a summary."""
    recipe = {name: value for name in RECIPE if (value := getattr(options, name)) is not None}
    if options.atlas is not None:
        return build_atlas.run(options, recipe)
    build_atlas.refuse(options)
    from orthonav.cli.info import summary, summary_text
    from orthonav.geo.route import read_route
    from orthonav.prepare import BuildRequest, build_map

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
        **recipe,
    )
    with progress(options) as shown:
        result = build_map(request, shown, build_atlas.teller(options))
    plain = summary(result.manifest, result.size_bytes, options.out)
    plain["build_s"] = round(time.perf_counter() - start, 3)
    if options.json:
        print_json(plain)
    else:
        print(summary_text(plain))
    return 0
