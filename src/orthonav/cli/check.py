"""`orthonav check`: predict before take-off where views will be localized along a route."""

import argparse
import shlex
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from orthonav import __version__
from orthonav.cli.common import add_options, camera_of, given, print_result, progress
from orthonav.cli.info import imagery_text, recipe_text, texts
from orthonav.cli.source import dem_of, is_above_sea
from orthonav.core.errors import CheckError, RouteError, UsageError
from orthonav.core.limits import CAMERA_KINDS
from orthonav.core.tilt import UNSTATED

EXAMPLE = "area.onav --route route.kml --agl-m 120 --out check"
EVERYDAY = (
    *("--route", "--band-m", "--other-date", "--camera-kind", "--camera", "--agl-m"),
    *("--dem", "--alert-limit-m", "--yaw-std-deg", "--heading", "--prior-std-m", "--prior"),
    *("--effort", "--json"),
)

if TYPE_CHECKING:
    from orthonav.ground.check.records import CheckedInputs, CheckRequest
    from orthonav.ground.planning.route import Route


def add(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "exit status: 0 go, 3 marginal, 4 no-go; 1 error, 2 wrong usage"
    parser.add_argument("map", type=Path, metavar="MAP.onav", help="map to check")
    text = "folder of page, JSON and layers"
    parser.add_argument("--out", type=Path, required=True, metavar="REPORT/", help=text)
    add_options(parser, "--json")
    group = parser.add_argument_group("route (default: the whole map)")
    add_options(group, "--route", "--band-m", "--dem", "--dem-datum")
    text = "height above ground (default: the lowest of the route; without one, the height from "
    text += "which the shorter side of a view covers a tile of the map)"
    add_options(group, "--agl-m", help=text)
    group = parser.add_argument_group("requirement")
    text = "largest horizontal error that the mission allows (default: 2.5 %% of the height, at "
    add_options(group, "--alert-limit-m", help=f"{text}least 35 m)")
    add_options(group, "--risk")
    group = parser.add_argument_group("ground")
    text = "orthophoto of another date than the map's, which improves the prediction"
    group.add_argument("--other-date", type=Path, metavar="TIF", help=text)
    _add_errors(parser.add_argument_group("camera, telemetry and motion"))
    group = parser.add_argument_group("trials")
    text = "factor on the number of trials (default 1), which end when more would not change the "
    text += "answer; 0.25: a quick check"
    group.add_argument("--effort", type=float, default=1.0, metavar="FACTOR", help=text)
    add_options(group, "--workers")


def _add_errors(group: argparse._ActionsContainer) -> None:
    number, choice = partial(group.add_argument, type=float), group.add_mutually_exclusive_group
    add_options(group, "--camera")
    add_options(group, "--speed-mps", default=20.0, help="ground speed (default 20)")
    heading, prior = choice(), choice()
    add_options(heading, "--heading")
    text = "standard deviation of the reported heading (default 5)"
    heading.add_argument("--yaw-std-deg", type=float, default=5.0, help=text)
    text = "standard deviation of the reported height, as a fraction of it (default 0.05)"
    number("--agl-std", default=0.05, metavar="FRACTION", help=text)
    add_options(prior, "--prior")
    text = "standard deviation of the prior position, per axis (default 150)"
    prior.add_argument("--prior-std-m", type=float, default=150.0, help=text)
    text = "standard deviation of the height of houses and trees, which causes relief displacement "
    number("--relief-m", default=3.0, help=f"{text}(default 3; 0: there are none)")
    text = "how far the camera looks ahead of straight down, 0 to 65 (default 0); trial views look "
    number("--camera-pitch-deg", default=0.0, help=f"{text}straight down, findings say the rest")
    text = "standard deviation of the error of the reported pitch and roll, which displaces fixes "
    text += "by 1.7 %% of the height a degree (docs/flights.md has that of each source; "
    text += f"default {UNSTATED.aided_deg:g}, as where it is not stated)"
    number("--tilt-std-deg", default=UNSTATED.aided_deg, help=text)
    text = "camera, if not of the kind that took the map's imagery: predicts fewer fixes; other: "
    text += "another sensor, such as a drone's over satellite imagery (default colour)"
    group.add_argument("--camera-kind", choices=CAMERA_KINDS, default="colour", help=text)


def run(options: argparse.Namespace) -> int:
    from orthonav.ground.check.layers import check_to_plain
    from orthonav.ground.check.run import check_map
    from orthonav.ground.check.wording import text
    from orthonav.ground.check.write import require_free, write_check

    require_free(options.out)
    request = _request(options)
    with progress(options) as shown:
        result, opened = check_map(request, shown)
    page = write_check(result, opened, options.out)
    print_result(options, check_to_plain(result), text(result), f"\nreport: {page}")
    return result.verdict.word.exit_code


def _request(options: argparse.Namespace) -> "CheckRequest":
    from orthonav.ground.check.records import CheckRequest
    from orthonav.ground.planning.route import read_route

    if options.band_m is not None and options.route is None:
        raise UsageError("--band-m is the width of a band around a route; give --route too")
    route = read_route(options.route) if options.route else None
    agl_m, origin = _agl_m(options, route)
    more = {
        "map_path": options.map,
        "route": route,
        "camera": camera_of(options),
        "agl_m": agl_m,
        "yaw_std_deg": None if options.heading == "unknown" else options.yaw_std_deg,
        "prior_std_m": None if options.prior == "none" else options.prior_std_m,
        "about": replace(_checked_inputs(options, route), height=origin),
    }
    return CheckRequest(**given(options, CheckRequest) | more)


def _agl_m(options: argparse.Namespace, route: "Route | None") -> tuple[float | None, str]:
    """Height above ground to check at, None for that of a tile, and where it comes from.

    Raises `CheckError` where the heights of the route are not above ground and no terrain is known.
    """
    from orthonav.core.mapfile import open_map
    from orthonav.core.mapfile.terrain import TerrainLayer
    from orthonav.ground.planning.spacing import flown_agl_m

    dem = dem_of(options, route)
    if options.agl_m is not None:
        return options.agl_m, "as given"
    frames = set() if route is None else {each.frame for each in route.heights if each is not None}
    if route is None or not frames:
        return None, "from which a view covers a tile of the map"
    terrain = dem or TerrainLayer.of(open_map(options.map))
    if frames != {"agl"} and terrain is None:
        raise CheckError(
            "heights of the route are not above ground: give the terrain (--dem FILE, or a map "
            "built with --dem) or the height (--agl-m)"
        )
    known = not isinstance(terrain, TerrainLayer) or terrain.info.is_above_sea
    if not known and is_above_sea(route):
        raise CheckError(
            "heights of the route are above the sea, and the vertical datum of the map's terrain "
            "is unknown: build it with --dem-datum, or give --agl-m"
        )
    try:
        flown = flown_agl_m(route, terrain)
    except RouteError as error:
        raise CheckError(f"{error} ({options.dem or options.map}); or give --agl-m") from error
    if not flown:
        raise CheckError("the route stays near the ground: check its heights, or give --agl-m")
    low_m, high_m = min(flown), max(flown)
    where = "of the route" if frames == {"agl"} else "over the terrain of the map"
    if dem is not None and frames != {"agl"}:
        where = f"over the terrain of {options.dem.name}"
    return low_m, f"the lowest {where}" + (f" ({high_m:.0f} m at most)" * (high_m > low_m + 1))


def _checked_inputs(options: argparse.Namespace, route: "Route | None") -> "CheckedInputs":
    from orthonav.core.mapfile import open_map
    from orthonav.ground.check.records import CheckedInputs

    manifest = open_map(options.map).manifest
    terms = (
        f"{source.get('name')}: {', '.join(parts)}"
        for source in manifest.imagery
        if (parts := texts(source, "attribution", "licence"))
    )
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
