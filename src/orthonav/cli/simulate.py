"""`orthonav simulate`: simulate a flight over an orthophoto of another year."""

import argparse
from functools import partial
from pathlib import Path

from orthonav.cli.common import add_options, counted, given, print_json, progress
from orthonav.cli.source import dem_of

EXAMPLE = "--ortho other-year.tif --route route.kml --agl-m 120 --out flight"
EVERYDAY = (
    *("--route", "--random", "--agl-m", "--spacing-m", "--airspeed-mps", "--camera"),
    *("--yaw-std-deg", "--agl-std", "--mount-std-deg", "--horizon-std-deg", "--prior-std-m"),
    *("--seed", "--json"),
)


def add(parser: argparse.ArgumentParser) -> None:
    where = parser.add_mutually_exclusive_group(required=True)
    add_options(where, "--route")
    text = "fly N views at random positions and headings"
    where.add_argument("--random", type=int, metavar="N", help=text)
    add_options(
        parser, "--ortho", "--camera", "--dem", "--surface", "--dem-datum", "--agl-m", "--json"
    )
    add_options(parser, "--seed", default=0)
    parser.add_argument("--out", type=Path, required=True, metavar="FLIGHT_DIR", help="to write")
    number = partial(parser.add_argument, type=float)
    text = "angle by which the camera looks ahead of straight down, 0 to 65; reported (default 0)"
    number("--camera-pitch-deg", default=0.0, help=text)
    number("--spacing-m", help="distance between views on a route (default: flown in one second)")
    number("--airspeed-mps", default=25.0, help="airspeed (default 25)")
    text = "radius of the arcs at the corners of the route (default 0: sharp corners)"
    number("--turn-radius-m", default=0.0, help=text)
    text = "write gnss.csv of a GNSS receiver along the route: good, step, drag, drift, frozen, "
    text += "jumping or jam (docs/reference/formats.md), such as drag:at_s=60,mps=1"
    parser.add_argument("--receiver", metavar="NAME[:KEY=VALUE,..]", help=text)
    _add_errors(parser)


def _add_errors(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("standard deviations of errors of the telemetry")
    number = partial(group.add_argument, type=float)
    number("--yaw-std-deg", default=0.0, help="reported heading (default 0)")
    text = "reported height, as a fraction of it (default 0)"
    number("--agl-std", default=0.0, metavar="FRACTION", help=text)
    text = "reported pitch and roll from view to view, which the telemetry states as tilt_std_deg "
    text += "(default 0: it states nothing where the two below are not 0)"
    number("--tilt-std-deg", default=0.0, help=text)
    number("--prior-std-m", help="prior position, per axis (default: no prior is reported)")
    text = "scale (a fraction) and direction (rad) of the reported velocity (default: not reported)"
    number("--velocity-drift", metavar="FRACTION", help=text)
    text = "unreported pitch and roll of the camera mount, constant in a flight (default 1)"
    number("--mount-std-deg", default=1.0, help=text)
    text = "unreported pitch and roll of the autopilot's horizon; on a route it changes within "
    number("--horizon-std-deg", default=1.0, help=f"{text}15 s (default 1)")


def run(options: argparse.Namespace) -> None:
    from orthonav.core.geo.camera_files import read_camera_file
    from orthonav.ground.imagery.terrain import open_dem
    from orthonav.ground.planning.route import read_route
    from orthonav.ground.simulate.flight import (
        DEFAULT_CAMERA,
        Errors,
        SimulateRequest,
        simulate_flight,
    )
    from orthonav.ground.simulate.receiver import receiver_of

    dem = dem_of(options)
    surface = [open_dem(path, options.dem_datum) for path in options.surface]
    for each in (*surface, *([] if dem is None else [dem])):
        each.require_datum("heights of simulated flights are above the sea")
    more = {
        "orthos": options.ortho,
        "route": read_route(options.route) if options.route else None,
        "camera": read_camera_file(options.camera) if options.camera else DEFAULT_CAMERA,
        "errors": Errors(**given(options, Errors)),
        "terrain": dem,
        "surface": surface,
        "terrain_posting_m": 1.0 if dem is None else dem.gsd_m,
        "gnss": receiver_of(options.receiver) if options.receiver else None,
    }
    request = SimulateRequest(**given(options, SimulateRequest) | more)
    with progress(options) as shown:
        views = simulate_flight(request, lambda share: shown("simulate", share))
    if options.json:
        print_json({"flight": str(options.out), "views": views})
    else:
        print(f"{counted(views, 'view')} written to {options.out}")
