"""`orthonav check`: predict before take-off where views will be localized along a route."""

import argparse
import logging
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from orthonav.cli.common import ROUTE_HELP, add_dem, print_json, progress

EVERYDAY = (
    *("--route", "--band-m", "--other-date", "--other-sensor", "--changes", "--camera", "--agl-m"),
    *("--dem", "--yaw-std-deg", "--heading", "--prior-std-m", "--prior", "--json"),
)

log = logging.getLogger(__name__)
_REFERENCES = {
    None: "an unknown reference",
    "agl": "ground",
    "home": "home",
    "amsl": "sea level",
    "hae": "the ellipsoid",
}

if TYPE_CHECKING:
    from orthonav.ground.changes.record import ChangedGround
    from orthonav.ground.check.records import CheckedInputs, CheckRequest
    from orthonav.ground.planning.route import Route
    from orthonav.ground.planning.spacing import LegProfile


def add(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "exit status: 0 go, 3 marginal, 4 no-go; 1 error, 2 wrong usage"
    parser.add_argument("map", type=Path, metavar="MAP.onav", help="map to check")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="REPORT/", help="folder of page, JSON and layers"
    )
    parser.add_argument(
        "--json", action="store_true", help="print the content of check.json instead of the text"
    )
    _add_route(parser.add_argument_group("route (default: the whole map)"))
    _add_ground(parser.add_argument_group("ground"))
    _add_errors(parser.add_argument_group("camera, telemetry and motion"))
    _add_effort(parser.add_argument_group("trials"))


def _add_route(group: argparse._ActionsContainer) -> None:
    group.add_argument("--route", type=Path, metavar="FILE", help=ROUTE_HELP)
    group.add_argument(
        "--band-m",
        type=float,
        help="width of the search band for legs without a width of their own (default: four "
        "standard deviations of the prior, at least half a view)",
    )
    group.add_argument(
        "--agl-m",
        type=float,
        help="height above ground (default: the lowest of the route; without one, the height from "
        "which the shorter side of a view covers a tile of the map)",
    )
    add_dem(
        group,
        "for routes whose heights are above sea level or home (default: the terrain of the map)",
    )


def _add_ground(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--other-date",
        type=Path,
        metavar="TIF",
        help="orthophoto of another date than the map's, which improves the prediction",
    )
    group.add_argument(
        "--changes",
        type=Path,
        metavar="FILE.geojson",
        help="ground that changed since the map was made, as written by localize or evaluate "
        "--report-changes: the check warns of it and predicts fixes without it",
    )


def _add_errors(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="camera file: flight.json, or of OpenCV, ROS or Kalibr (YAML, JSON)",
    )
    heading = group.add_mutually_exclusive_group()
    _add_number(heading, "--yaw-std-deg", 5.0, "standard deviation of the reported heading")
    heading.add_argument(
        "--heading",
        choices=("known", "unknown"),
        default="known",
        help="known: with an error of --yaw-std-deg (default); unknown: all headings are tried",
    )
    said = "standard deviation of the reported height, as a fraction of it"
    _add_number(group, "--agl-std", 0.05, said, "FRACTION")
    prior = group.add_mutually_exclusive_group()
    _add_number(prior, "--prior-std-m", 150.0, "standard deviation of the prior position, per axis")
    prior.add_argument(
        "--prior",
        choices=("telemetry", "none"),
        default="telemetry",
        help="telemetry: search around a prior position (default); none: search the whole map",
    )
    said = "standard deviation of the height of houses and trees, which causes relief displacement"
    _add_number(group, "--relief-m", 3.0, said)
    said = "standard deviation of the error of the reported pitch and roll, which displaces fixes"
    _add_number(group, "--tilt-std-deg", 1.5, said)
    group.add_argument(
        "--other-sensor",
        action="store_true",
        help="camera and map imagery are of different kinds (drone against satellite, infrared): "
        "predicts fewer fixes",
    )
    _add_number(group, "--speed-mps", 20.0, "ground speed")


def _add_number(
    group: argparse._ActionsContainer,
    option: str,
    default: float,
    said: str,
    metavar: str | None = None,
) -> None:
    said = f"{said} (default {default:g})"
    group.add_argument(option, type=float, metavar=metavar, default=default, help=said)


def _add_effort(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--accept",
        metavar="NAME:MIN",
        default="confidence:0.9",
        help="criterion of a confident fix and its threshold, a confidence (default "
        "confidence:0.9)",
    )
    _add_number(group, "--effort", 1.0, "factor on the number of trials", "FACTOR")
    group.add_argument("--quick", action="store_true", help="no effect; accepted for old scripts")
    group.add_argument(
        "--workers", type=int, help="number of parallel workers: processes (default: one per core)"
    )
    group.add_argument("--seed", type=int, default=1, help="seed of the trials (default 1)")


def run(options: argparse.Namespace) -> int:
    import json

    from orthonav.ground.check.run import check_map
    from orthonav.ground.check.write import require_free, write_check
    from orthonav.ground.check.write.plain import to_json
    from orthonav.ground.check.write.wording import text

    require_free(options.out)
    request = _request(options)
    with progress(options) as shown:
        result, opened = check_map(request, shown)
    page = write_check(result, opened, options.out)
    if options.json:
        print_json(json.loads(to_json(result)))
    else:
        print(text(result))
        print(f"\nreport: {page}")
    return result.verdict.word.exit_code


def _accepted(text: str) -> float:
    from orthonav.core.errors import VariantError
    from orthonav.core.localize.confidence import Acceptance

    accept = Acceptance.parse(text)
    if accept.criterion != "confidence":
        raise VariantError(f"--accept of a check is a confidence, such as confidence:0.9: {text}")
    return accept.threshold


def _request(options: argparse.Namespace) -> "CheckRequest":
    from orthonav.core.errors import CheckError
    from orthonav.core.geo.camera_files import read_camera_file
    from orthonav.ground.check.records import CheckRequest
    from orthonav.ground.planning.route import read_route
    from orthonav.ground.planning.spacing import DEFAULT_CAMERA

    if options.band_m is not None and options.route is None:
        raise CheckError("--band-m is the width of a band around a route; give --route too")
    route = read_route(options.route) if options.route else None
    camera = DEFAULT_CAMERA
    if options.camera is not None:
        camera = read_camera_file(options.camera)
    agl_m, origin = _agl_m(options, route)
    return CheckRequest(
        map_path=options.map,
        route=route,
        band_m=options.band_m,
        other_date=options.other_date,
        camera=camera,
        agl_m=agl_m,
        yaw_std_deg=None if options.heading == "unknown" else options.yaw_std_deg,
        agl_std=options.agl_std,
        prior_std_m=None if options.prior == "none" else options.prior_std_m,
        accept=_accepted(options.accept),
        speed_mps=options.speed_mps,
        relief_m=options.relief_m,
        effort=options.effort,
        workers=options.workers,
        seed=options.seed,
        tilt_std_deg=options.tilt_std_deg,
        other_sensor=options.other_sensor,
        changes=_changes(options),
        about=replace(_checked_inputs(options, route), height=origin),
    )


def _changes(options: argparse.Namespace) -> "ChangedGround | None":
    from orthonav.core.mapfile.signature import map_digest
    from orthonav.ground.changes.record import read_changes

    if options.changes is None:
        return None
    found = read_changes(options.changes)
    if found.map_sha256 and found.map_sha256 != map_digest(options.map):
        log.warning(
            "changes were found with another map (%.80s); where the imagery of %s is newer, they "
            "may be in it already: %s",
            found.map_name,
            options.map.name,
            options.changes,
        )
    return found


def _agl_m(options: argparse.Namespace, route: "Route | None") -> tuple[float | None, str]:
    """Height above ground to check at, None for that of a tile, and where it comes from.

    Raises `CheckError` where the heights of the route are not above ground and no terrain is known.
    """
    from orthonav.core.errors import CheckError
    from orthonav.ground.planning.spacing import LANDING_M

    if options.dem_datum is not None and options.dem is None:
        raise CheckError("--dem-datum needs a terrain model: give --dem too")
    if options.agl_m is not None:
        return options.agl_m, "as given"
    heights = [] if route is None else [each for each in route.heights if each is not None]
    if route is None or not heights:
        return None, "from which a view covers a tile of the map"
    frames = {each.frame for each in heights}
    if frames == {"agl"}:
        found, where = [each.height_m for each in heights], "of the route"
    else:
        legs, name = _profile(options, route)
        if not legs:
            named = sorted(_REFERENCES[frame] for frame in frames)
            raise CheckError(
                f"heights of the route are above {', '.join(named)}, not above ground: give the "
                "terrain (--dem FILE, or a map built with --dem) or the height (--agl-m)"
            )
        found, where = [height for leg in legs for height in leg.agl_m], f"over {name}"
    flown = [height for height in found if height >= LANDING_M]
    if not flown:
        raise CheckError(
            f"the route stays below {LANDING_M:.0f} m above ground ({max(found):.0f} m at most): "
            "check its heights, or give --agl-m"
        )
    low_m, high_m = min(flown), max(flown)
    return low_m, f"the lowest {where}" + (f" ({high_m:.0f} m at most)" * (high_m > low_m + 1))


def _profile(options: argparse.Namespace, route: "Route") -> tuple[list["LegProfile"], str]:
    from orthonav.cli.heights import dem_for_route
    from orthonav.core.errors import CheckError, RouteError
    from orthonav.core.mapfile import open_map
    from orthonav.core.mapfile.terrain import TerrainLayer
    from orthonav.ground.planning.spacing import profile

    dem = dem_for_route(options, route)
    terrain = TerrainLayer.of(open_map(options.map)) if dem is None else dem
    if terrain is None:
        return [], ""
    name = "the terrain of the map" if dem is None else f"the terrain of {options.dem.name}"
    try:
        return profile(route, (0.0,) * route.legs, None, 0.0, terrain), name
    except RouteError as error:
        raise CheckError(f"{error} ({name}); or give --agl-m") from error


def _checked_inputs(options: argparse.Namespace, route: "Route | None") -> "CheckedInputs":
    from orthonav import __version__
    from orthonav.cli.info import imagery_text, recipe_text
    from orthonav.core.mapfile import open_map
    from orthonav.ground.check.records import CheckedInputs

    manifest = open_map(options.map).manifest
    terms = []
    for source in manifest.imagery:
        parts = [str(source[key]) for key in ("attribution", "licence") if source.get(key)]
        if parts:
            terms.append(f"{source.get('name')}: {', '.join(parts)}")
    return CheckedInputs(
        map_name=options.map.name,
        imagery=imagery_text(manifest.imagery),
        recipe=recipe_text(manifest.recipe),
        other_date="" if options.other_date is None else options.other_date.name,
        route_name="" if route is None else route.name or Path(options.route).name,
        command=shlex.join(["orthonav", *sys.argv[1:]]),
        version=__version__,
        terms=tuple(dict.fromkeys(terms)),
    )
