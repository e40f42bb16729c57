"""`orthonav simulate`: simulate a flight over an orthophoto of another year."""

import argparse
from dataclasses import fields
from functools import partial
from pathlib import Path

from orthonav.cli.common import ROUTE_HELP, add_dem, add_orthos, counted, print_json, progress
from orthonav.cli.heights import dem_of

EVERYDAY = (
    *("--route", "--random", "--agl-m", "--spacing-m", "--airspeed-mps", "--camera"),
    *("--yaw-std-deg", "--agl-std", "--mount-std-deg", "--horizon-std-deg", "--prior-std-m"),
    *("--seed", "--json"),
)
MOUNT_STD_DEG = HORIZON_STD_DEG = 1.0
"""Usual unreported tilt. Real mounts lean by 1 to 5 deg, and horizons of autopilots err by 0.5 to
6 deg."""


def add(parser: argparse.ArgumentParser) -> None:
    number = partial(parser.add_argument, type=float)
    add_orthos(parser, "orthophoto to fly over, of another year than the map")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--route", type=Path, metavar="FILE", help=ROUTE_HELP)
    where.add_argument(
        "--random", type=int, metavar="N", help="fly N views at random positions and headings"
    )
    number(
        "--agl-m",
        help="height above ground (default: the shorter image side covers 256 px of imagery); with "
        "--dem the height at the first view of a route, which is flown at a constant altitude",
    )
    add_dem(
        parser,
        "which the views show in perspective (a surface model also shows houses and trees "
        "standing up); telemetry then reports heights above sea level and take-off instead of "
        "heights above ground",
    )
    number(
        "--camera-pitch-deg",
        default=0.0,
        help="angle by which the camera looks ahead of straight down, 0 to 65; reported "
        "(default 0)",
    )
    number("--spacing-m", help="distance between views on a route (default: flown in one second)")
    number("--airspeed-mps", default=25.0, help="airspeed (default 25)")
    number(
        "--turn-radius-m",
        default=0.0,
        help="radius of the arcs at the corners of the route (default 0: sharp corners)",
    )
    parser.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="camera file: flight.json, or of OpenCV, ROS or Kalibr (YAML, JSON); default: "
        "1280 x 960 px, 65 deg wide",
    )
    _add_errors(parser)
    parser.add_argument(
        "--receiver",
        metavar="NAME[:KEY=VALUE,..]",
        help="write gnss.csv of a GNSS receiver along the route: good, step, drag, drift, frozen, "
        "jumping or jam (docs/reference/formats.md), such as drag:at_s=60,mps=1",
    )
    effects = parser.add_argument_group("image degradation")
    effects.add_argument(
        "--cloud-share",
        type=float,
        default=0.0,
        metavar="FRACTION",
        help="fraction of the views with clouds, 0 to 1 (default 0)",
    )
    effects.add_argument(
        "--jpeg-quality",
        type=int,
        default=90,
        choices=range(1, 101),
        metavar="1..100",
        help="quality of JPEG images (default 90)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of all random draws (default 0)")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FLIGHT_DIR", help="flight folder to write"
    )
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")


def _add_errors(parser: argparse.ArgumentParser) -> None:
    def option(
        flag: str, text: str, default: float | None = 0.0, metavar: str | None = None
    ) -> None:
        group.add_argument(flag, type=float, default=default, help=text, metavar=metavar)

    group = parser.add_argument_group("telemetry noise")
    option("--yaw-std-deg", "standard deviation of the reported heading (default 0)")
    option(
        "--agl-std",
        "standard deviation of the reported height, as a fraction of it (default 0)",
        metavar="FRACTION",
    )
    option(
        "--tilt-std-deg",
        "standard deviation of the error of the reported pitch and roll from view to view, which "
        "the telemetry states (default 0)",
    )
    option("--attitude-std-deg", "standard deviation of the true pitch and roll (default 0)")
    option(
        "--prior-std-m",
        "standard deviation of the prior position, per axis (default: no prior is reported)",
        None,
    )
    option(
        "--velocity-drift",
        "standard deviation of the scale error (a fraction) and the direction error (rad) of the "
        "reported velocity (default: no velocity is reported)",
        None,
        metavar="FRACTION",
    )
    group = parser.add_argument_group("unreported tilt")
    option(
        "--mount-std-deg",
        "standard deviation of pitch and roll of the camera mount, constant in a flight "
        f"(default {MOUNT_STD_DEG:g})",
        MOUNT_STD_DEG,
    )
    option(
        "--horizon-std-deg",
        "standard deviation of the error of the autopilot's horizon, pitch and roll; on a route it "
        f"changes within 15 s (default {HORIZON_STD_DEG:g})",
        HORIZON_STD_DEG,
    )
    group = parser.add_argument_group("constant telemetry biases")
    option("--yaw-bias-deg", "reported heading minus true heading")
    option(
        "--agl-bias",
        "reported height minus true height, as a fraction of it: 0.05 is 5 %%",
        metavar="FRACTION",
    )
    added = "to which --mount-std-deg adds"
    option("--pitch-bias-deg", f"unreported pitch of the camera mount, {added}")
    option("--roll-bias-deg", f"unreported roll of the camera mount, {added}")


def run(options: argparse.Namespace) -> None:
    from orthonav.core.geo.camera_files import read_camera_file
    from orthonav.ground.planning.route import read_route
    from orthonav.ground.simulate.flight import (
        DEFAULT_CAMERA,
        Errors,
        SimulateRequest,
        simulate_flight,
    )
    from orthonav.ground.simulate.receiver import receiver_of
    from orthonav.ground.simulate.render import ViewEffects

    dem = dem_of(options)
    request = SimulateRequest(
        orthos=options.ortho,
        out=options.out,
        route=read_route(options.route) if options.route else None,
        random=options.random,
        agl_m=options.agl_m,
        spacing_m=options.spacing_m,
        airspeed_mps=options.airspeed_mps,
        camera=read_camera_file(options.camera) if options.camera else DEFAULT_CAMERA,
        errors=Errors(**{each.name: getattr(options, each.name) for each in fields(Errors)}),
        effects=ViewEffects(jpeg_quality=options.jpeg_quality),
        seed=options.seed,
        turn_radius_m=options.turn_radius_m,
        cloud_share=options.cloud_share,
        terrain=dem,
        terrain_posting_m=1.0 if dem is None else dem.gsd_m,
        camera_pitch_deg=options.camera_pitch_deg,
        gnss=receiver_of(options.receiver) if options.receiver else None,
    )
    with progress(options) as shown:
        views = simulate_flight(request, lambda share: shown("simulate", share))
    if options.json:
        print_json({"flight": str(options.out), "views": views})
    else:
        print(f"{counted(views, 'view')} written to {options.out}")
