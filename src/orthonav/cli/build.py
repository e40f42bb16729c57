"""`orthonav build`: make a map from orthophotos."""

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.cli.common import add_area, add_options, given, print_json, progress
from orthonav.cli.info import summary, summary_text
from orthonav.core.errors import UsageError

if TYPE_CHECKING:
    from orthonav.core.mapfile import Manifest

WITHOUT_TERRAIN = (
    "without terrain: --dem FILE reduces the error of the camera (orthonav fetch writes one beside "
    "the imagery)"
)
LEVEL_LAND = "; --relief level does where the land is level"
NETWORKS = ("autoencoder", "caevl", "triplet")
LEAST_SHIFT_M = 0.3
"""A pixel of the finest orthophotos of countries."""

EXAMPLE = "--ortho ortho.tif --route route.kml --band-m 600 --out area.onav"
EVERYDAY = (
    *("--other-date", "--dem", "--surface", "--relief"),
    *("--route", "--bounds", "--band-m"),
    *("--gsd-m", "--work", "--json"),
)


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", type=Path, required=True, metavar="MAP.onav", help="map file to write"
    )
    add_options(parser, "--json")
    imagery = parser.add_argument_group("imagery")
    add_options(imagery, "--ortho", "--bands", "--true-ortho")
    add_options(imagery, "--dem", "--surface", "--dem-datum", "--relief")
    text = "orthophoto of the same area at another date, from which confidence and covariance are "
    text += "calibrated; it does not become part of the map; may be repeated"
    imagery.add_argument(
        "--other-date", type=Path, action="append", default=[], metavar="TIF", help=text
    )
    text = "decimal year of the flights, such as 2026.5, to which orthophotos in NAD83, ETRS89, "
    text += "GDA94 or GDA2020 are moved with their tectonic plate (default: taken as WGS 84)"
    imagery.add_argument("--epoch", type=float, metavar="YEAR", help=text)
    add_area(parser.add_argument_group("area (default: all imagery)"))
    add_recipe(parser.add_argument_group("map"))
    group = parser.add_argument_group("work")
    text = "folder of checkpoints and images of a network's training, from which an interrupted "
    group.add_argument("--work", type=Path, metavar="DIR", help=f"{text}training resumes")
    add_options(group, "--workers")


def add_recipe(group: argparse._ActionsContainer) -> None:
    add_options(group, "--gsd-m", "--tile-px", "--overlap", "--seed")
    add = group.add_argument
    text = "embedding: gradient (default), autoencoder, caevl, triplet or bovw"
    add("--method", metavar="NAME[:FIELD=VALUE,..]", help=text)
    text = "image representation: gradient, gray, canny (canny:low=100,high=200), segments, "
    text += "sam:weights=PATH or onnx:weights=PATH (default: gradient; canny for autoencoder and "
    add("--edges", metavar="NAME[:FIELD=VALUE,..]", help=f"{text}caevl, gray for triplet and bovw)")
    text = "omit the registration layer: a smaller map, with positions at tile level only"
    add("--no-registration", dest="registration", action="store_const", const=False, help=text)


def asked(options: argparse.Namespace, request: type) -> dict[str, Any]:
    """Fields of a request for a map or an atlas."""
    from orthonav.ground.planning.route import read_route

    route = read_route(options.route) if options.route else None
    area = {"bounds_deg": options.bounds, "route": route}
    return given(options, request) | area | {"orthos": options.ortho}


def run(options: argparse.Namespace) -> None:
    from orthonav.ground.build import BuildRequest, build_map

    if options.work is not None and (options.method or "").partition(":")[0] not in NETWORKS:
        raise UsageError(
            f"--work keeps the training of a network: give --method {NETWORKS[0]}, {NETWORKS[1]} "
            f"or {NETWORKS[2]}"
        )
    start = time.perf_counter()
    request = BuildRequest(**asked(options, BuildRequest), other_dates=options.other_date)
    with progress(options) as shown:
        result = build_map(request, shown)
    plates = _plates(result.manifest) if options.epoch is None else []
    plain = summary(result.manifest, result.size_bytes, options.out)
    plain["build_s"] = round(time.perf_counter() - start, 3)
    if options.json:
        print_json(plain | {"plates": plates})
        return
    print(summary_text(plain))
    terrain = result.manifest.sheets[0].terrain
    if terrain is None:
        print(WITHOUT_TERRAIN + ("" if options.relief else LEVEL_LAND))
    elif not terrain.is_above_sea:
        print(
            "the vertical datum of the terrain is not known: heights above ground and take-off can "
            "be used; --dem-datum, and a geoid grid for heights above the ellipsoid, add heights "
            "above the sea"
        )
    accuracies = {(each["crs"], each.get("crs_accuracy_m")) for each in result.manifest.imagery}
    for crs, accuracy_m in sorted(pair for pair in accuracies if pair[1]):
        print(f"{crs:.60} is converted to WGS 84 to {accuracy_m:g} m, as PROJ states")
    for each in plates:
        print(
            f"{each['crs']:.60} is taken as WGS 84, from which its tectonic plate has moved it by "
            f"{each['shift_m']:.1f} m; --epoch {each['epoch']:.1f} corrects this"
        )


def _plates(manifest: "Manifest") -> list[dict[str, Any]]:
    """Systems that their tectonic plate has moved away from WGS 84 by now."""
    from orthonav.ground.imagery.systems import plate_shift_m

    now = time.gmtime()
    year = round(now.tm_year + now.tm_yday / 366, 1)
    frame = manifest.sheets[0].frame
    place = frame.lat_deg, frame.lon_deg
    found: list[dict[str, Any]] = [
        {"crs": crs, "shift_m": round(plate_shift_m(crs, *place, year), 2), "epoch": year}
        for crs in sorted({str(each["crs"]) for each in manifest.imagery})
    ]
    return [each for each in found if each["shift_m"] >= LEAST_SHIFT_M]
