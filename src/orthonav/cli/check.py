"""`orthonav check`: before take-off, where can views be placed and can a route be flown?"""

import argparse
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from orthonav.cli.common import ROUTE_HELP, print_json, progress

EVERYDAY = (
    *("--route", "--band-m", "--other-date", "--camera", "--agl-m"),
    *("--yaw-std-deg", "--heading", "--prior-std-m", "--prior", "--quick", "--json"),
)

if TYPE_CHECKING:
    from orthonav.check.outcome import CheckedInputs
    from orthonav.check.request import CheckRequest
    from orthonav.geo.camera import Camera
    from orthonav.geo.route import Route


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = "exit status: 0 go, 3 marginal, 4 no-go; 1 error, 2 wrong usage"
    parser.add_argument("map", type=Path, metavar="MAP.onav")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="REPORT/", help="folder of page, JSON and layers"
    )
    parser.add_argument("--route", type=Path, metavar="FILE", help=ROUTE_HELP)
    parser.add_argument(
        "--band-m",
        type=float,
        help="width of the search band for legs without one "
        "(default: four standard deviations of the prior, at least half a view)",
    )
    parser.add_argument(
        "--other-date",
        type=Path,
        metavar="TIF",
        help="orthophoto of a second date, not in the map: improves the prediction",
    )
    parser.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="camera file: flight.json, or of OpenCV, ROS or Kalibr (YAML, JSON)",
    )
    parser.add_argument(
        "--agl-m",
        type=float,
        help="height above ground (default: the lowest of the route; without one, the height from "
        "which the shorter side of a view covers a tile of the map)",
    )
    _add_errors(parser)
    _add_effort(parser)
    parser.add_argument(
        "--json", action="store_true", help="print the content of check.json instead of the text"
    )


def _add_errors(parser: argparse.ArgumentParser) -> None:
    """Accuracy of telemetry and prior, motion, and the confidence that is asked for."""
    heading = parser.add_mutually_exclusive_group()
    heading.add_argument(
        "--yaw-std-deg",
        type=float,
        default=5.0,
        help="standard deviation of the reported heading (default 5)",
    )
    heading.add_argument(
        "--heading",
        choices=("known", "unknown"),
        default="known",
        help="unknown: search all headings",
    )
    parser.add_argument(
        "--agl-std",
        type=float,
        metavar="SHARE",
        default=0.05,
        help="standard deviation of the reported height, a share of it (default 0.05)",
    )
    prior = parser.add_mutually_exclusive_group()
    prior.add_argument(
        "--prior-std-m",
        type=float,
        default=150.0,
        help="standard deviation of the prior position, per axis (default 150)",
    )
    prior.add_argument(
        "--prior",
        choices=("telemetry", "none"),
        default="telemetry",
        help="none: search the whole map",
    )
    parser.add_argument(
        "--relief-m",
        type=float,
        default=3.0,
        help="standard deviation of the height of houses and trees, which causes relief "
        "displacement (default 3)",
    )
    parser.add_argument("--speed-mps", type=float, default=20.0, help="ground speed (default 20)")
    parser.add_argument(
        "--drift",
        type=float,
        metavar="SHARE",
        default=0.03,
        help="error of dead reckoning per metre flown without a fix (default 0.03)",
    )
    parser.add_argument(
        "--min-confidence",
        type=float,
        metavar="P",
        default=0.9,
        help="confidence that a fix needs to be accepted (default 0.9)",
    )


def _add_effort(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--effort",
        type=float,
        default=1.0,
        metavar="FACTOR",
        help="factor on the number of trials (default 1)",
    )
    parser.add_argument(
        "--quick", action="store_true", help="skip the trials of other errors and other heights"
    )
    parser.add_argument("--workers", type=int, help="processes (default: one per core)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the trials (default 1)")


def run(options: argparse.Namespace) -> int:
    """Check, write, print the verdict; return its exit status."""
    import json

    from orthonav.check.run import check_map
    from orthonav.check.write import require_free, to_json, verdict_text, write_check

    require_free(options.out)
    request = _request(options)
    with progress(options) as shown:
        result, opened = check_map(request, shown)
    page = write_check(result, opened, options.out)
    if options.json:
        print_json(json.loads(to_json(result)))
    else:
        print(verdict_text(result))
        print(f"\nreport: {page}")
    return result.verdict.word.exit_code


def _request(options: argparse.Namespace) -> "CheckRequest":
    from orthonav.check.request import DEFAULT_CAMERA, CheckRequest
    from orthonav.errors import CheckError
    from orthonav.geo.route import read_route
    from orthonav.sources.cameras import read_camera_file

    if options.band_m is not None and options.route is None:
        raise CheckError("--band-m is the width of a band around a route; give --route too")
    route = read_route(options.route) if options.route else None
    camera: Camera = DEFAULT_CAMERA
    if options.camera is not None:
        camera = read_camera_file(options.camera)
    agl_m = options.agl_m
    if agl_m is None and route is not None:
        agl_m = _lowest_agl_m(route)
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
        accept=options.min_confidence,
        speed_mps=options.speed_mps,
        drift=options.drift,
        relief_m=options.relief_m,
        effort=options.effort,
        extras=not options.quick,
        workers=options.workers,
        seed=options.seed,
        about=_checked_inputs(options, route),
    )


def _lowest_agl_m(route: "Route") -> float | None:
    """Lowest height above ground of a route, take-off and landing excluded."""
    from orthonav.geo.terrain import LANDING_M

    found = [each for each in route.heights if each is not None and each.frame == "agl"]
    return min((each.height_m for each in found if each.height_m >= LANDING_M), default=None)


def _checked_inputs(options: argparse.Namespace, route: "Route | None") -> "CheckedInputs":
    from orthonav import __version__
    from orthonav.check.outcome import CheckedInputs
    from orthonav.cli.info import imagery_text, recipe_text
    from orthonav.mapfile import open_map

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
