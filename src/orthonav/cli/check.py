"""`orthonav check`: before the flight: where could views be placed, and would a route be flown?"""

import argparse
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from orthonav.cli.common import ROUTE_HELP, print_json, progress

if TYPE_CHECKING:
    from orthonav.check.outcome import About
    from orthonav.check.request import CheckRequest
    from orthonav.geo.camera import Camera
    from orthonav.geo.route import Route


def add(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.epilog = "exit status: 0 go, 3 marginal, 4 no-go; 1 an error, 2 wrong usage"
    parser.add_argument("map", type=Path, metavar="MAP.onav")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="REPORT/", help="folder for page and layers"
    )
    parser.add_argument("--route", type=Path, help=ROUTE_HELP)
    parser.add_argument(
        "--band-m",
        type=float,
        help="width of the band around the route, where its legs have none of their own "
        "(default: four standard deviations of the prior, half a view at least)",
    )
    parser.add_argument(
        "--ortho",
        type=Path,
        metavar="OTHER_YEAR.tif",
        help="the same ground at another date: makes the prediction better",
    )
    parser.add_argument(
        "--camera", type=Path, metavar="FILE", help="flight.json, or a file of OpenCV, ROS, Kalibr"
    )
    parser.add_argument(
        "--agl-m",
        type=float,
        help="height above ground (default: the lowest above ground that the route says, else that "
        "from which the shorter side of a view covers a tile of the map)",
    )
    _add_errors(parser)
    parser.add_argument("--speed-mps", type=float, default=20.0, help="over ground (default 20)")
    parser.add_argument(
        "--drift",
        type=float,
        default=0.03,
        help="dead reckoning: metres of error per metre flown without a fix (default 0.03)",
    )
    parser.add_argument(
        "--accept", type=float, default=0.9, help="confidence a fix needs (default 0.9)"
    )
    parser.add_argument(
        "--effort", type=float, default=1.0, help="times as many trials: finer, slower (default 1)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="leave out other errors of heading and other heights"
    )
    parser.add_argument("--workers", type=int, help="processes (default: one per core)")
    parser.add_argument("--seed", type=int, default=1, help="of the trials (default 1)")
    parser.add_argument(
        "--json",
        nargs="?",
        const="-",
        metavar="FILE",
        help="what check.json says, to stdout instead of the text, or to a file too",
    )


def _add_errors(parser: argparse.ArgumentParser) -> None:
    """What is known at each view, and how well."""
    heading = parser.add_mutually_exclusive_group()
    heading.add_argument(
        "--yaw-std-deg", type=float, default=5.0, help="error of the told heading (default 5)"
    )
    heading.add_argument(
        "--heading", choices=("known", "unknown"), default="known", help="unknown: all are tried"
    )
    parser.add_argument(
        "--agl-std", type=float, default=0.05, help="of the height, a share of it (default 0.05)"
    )
    prior = parser.add_mutually_exclusive_group()
    prior.add_argument(
        "--prior-std-m",
        type=float,
        default=150.0,
        help="error of the position that is known when a view comes (default 150)",
    )
    prior.add_argument(
        "--prior",
        choices=("known", "none"),
        default="known",
        help="none: all of the map is searched",
    )
    parser.add_argument(
        "--relief-m",
        type=float,
        default=3.0,
        help="standard deviation of the height of houses and trees, which tilt in views from low "
        "(default 3)",
    )


def run(options: argparse.Namespace) -> int:
    """Check, write, print the verdict; returns its exit status."""
    import json

    from orthonav.check.run import check_map
    from orthonav.check.write import require_free, to_json, verdict_text, write_check
    from orthonav.files import write_text

    require_free(options.out)
    request = _request(options)
    with progress(options) as shown:
        result, opened = check_map(request, shown)
    page = write_check(result, opened, options.out)
    if options.json == "-":
        print_json(json.loads(to_json(result)))
    else:
        if options.json:
            write_text(Path(options.json), to_json(result))
        print(verdict_text(result))
        print(f"\nreport: {page}")
    return result.verdict.word.exit_code


def _request(options: argparse.Namespace) -> "CheckRequest":
    from orthonav.check.request import DEFAULT_CAMERA, CheckRequest
    from orthonav.errors import CheckError
    from orthonav.geo.route import read_route
    from orthonav.sources.cameras import read_camera_file

    if options.band_m is not None and options.route is None:
        raise CheckError("--band-m is the band around a route: give --route too")
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
        other_date=options.ortho,
        camera=camera,
        agl_m=agl_m,
        yaw_std_deg=None if options.heading == "unknown" else options.yaw_std_deg,
        agl_std=options.agl_std,
        prior_std_m=None if options.prior == "none" else options.prior_std_m,
        accept=options.accept,
        speed_mps=options.speed_mps,
        drift=options.drift,
        relief_m=options.relief_m,
        effort=options.effort,
        extras=not options.quick,
        workers=options.workers,
        seed=options.seed,
        about=_about(options, route),
    )


def _lowest_agl_m(route: "Route") -> float | None:
    """Lowest height above ground that a route says, take-off and landing left out."""
    from orthonav.geo.terrain import LANDING_M

    found = [each for each in route.heights if each is not None and each.frame == "agl"]
    return min((each.height_m for each in found if each.height_m >= LANDING_M), default=None)


def _about(options: argparse.Namespace, route: "Route | None") -> "About":
    from orthonav import __version__
    from orthonav.check.outcome import About
    from orthonav.cli.info import imagery_text, recipe_text
    from orthonav.mapfile import open_map

    manifest = open_map(options.map).manifest
    terms = []
    for source in manifest.imagery:
        said = [str(source[key]) for key in ("attribution", "licence") if source.get(key)]
        if said:
            terms.append(f"{source.get('name')}: {', '.join(said)}")
    return About(
        map_name=options.map.name,
        imagery=imagery_text(manifest.imagery),
        recipe=recipe_text(manifest.recipe),
        other_date="" if options.ortho is None else options.ortho.name,
        route_name="" if route is None else route.name or Path(options.route).name,
        command=shlex.join(["orthonav", *sys.argv[1:]]),
        version=__version__,
        terms=tuple(dict.fromkeys(terms)),
    )
