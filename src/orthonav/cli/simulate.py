"""`orthonav simulate`: simulate a flight over an orthophoto of another year."""

import argparse
from functools import partial
from pathlib import Path

import orthonav
from orthonav.cli.common import (
    add_options,
    camera_of,
    counted,
    given,
    print_result,
    progress,
    within,
)
from orthonav.cli.source import dem_of
from orthonav.ground import planning

EXAMPLE = "--ortho other-year.tif --route route.kml --agl-m 120 --out flight"
EVERYDAY = (
    *("--route", "--random", "--agl-m", "--spacing-m", "--speed-mps", "--camera"),
    *("--yaw-std-deg", "--agl-std", "--unreported-tilt-deg", "--prior-std-m", "--seed", "--json"),
)


def add(parser: argparse.ArgumentParser) -> None:
    where = parser.add_mutually_exclusive_group(required=True)
    add_options(where, "--route")
    text = "fly N views at random positions and headings"
    where.add_argument("--random", type=int, metavar="N", help=text)
    add_options(parser, "--ortho", "--camera", "--dem", "--surface", "--dem-datum", "--agl-m")
    add_options(parser, "--json")
    add_options(parser, "--seed", default=0)
    parser.add_argument("--out", type=Path, required=True, metavar="FLIGHT_DIR", help="to write")
    add_options(parser, "--speed-mps", default=25.0, help="airspeed; the air is still (default 25)")
    number = partial(parser.add_argument, type=float)
    text = "angle by which the camera looks ahead of straight down, 0 to 65; reported (default 0)"
    number("--camera-pitch-deg", default=0.0, help=text)
    number("--spacing-m", help="distance between views on a route (default: flown in one second)")
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
    text = "unreported pitch and roll, of the camera mount (constant in a flight) and of the "
    text += "autopilot's horizon (on a route it changes within 15 s) each (default 1)"
    number("--unreported-tilt-deg", type=within(0, 20), default=1.0, metavar="DEG", help=text)
    text = "reported pitch and roll from view to view, which the telemetry states as tilt_std_deg "
    text += "(default 0: it states nothing where there is unreported tilt)"
    number("--tilt-std-deg", default=0.0, help=text)
    number("--prior-std-m", help="prior position, per axis (default: no prior is reported)")
    text = "scale (a fraction) and direction (rad) of the reported velocity (default: not reported)"
    number("--velocity-drift", metavar="FRACTION", help=text)


def run(options: argparse.Namespace) -> None:
    from orthonav.ground.imagery.terrain import open_dem
    from orthonav.ground.simulate.flight import Errors
    from orthonav.ground.simulate.receiver import receiver_of

    dem = dem_of(options)
    surface = [open_dem(path, options.dem_datum) for path in options.surface]
    for each in (*surface, *([] if dem is None else [dem])):
        each.require_datum("heights of simulated flights are above the sea")
    tilt_deg = options.unreported_tilt_deg
    more = {
        "orthos": options.ortho,
        "route": planning.read_route(options.route) if options.route else None,
        "airspeed_mps": options.speed_mps,
        "camera": camera_of(options),
        "errors": Errors(
            **given(options, Errors), mount_std_deg=tilt_deg, horizon_std_deg=tilt_deg
        ),
        "terrain": dem,
        "surface": surface,
        "terrain_posting_m": 1.0 if dem is None else dem.gsd_m,
        "gnss": receiver_of(options.receiver) if options.receiver else None,
    }
    request = orthonav.SimulateRequest(**given(options, orthonav.SimulateRequest) | more)
    with progress(options) as shown:
        views = orthonav.simulate_flight(request, lambda share: shown("simulate", share))
    done = f"{counted(views, 'view')} written to {options.out}"
    print_result(options, {"flight": str(options.out), "views": views}, done)
