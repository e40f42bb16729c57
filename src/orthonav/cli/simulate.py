"""`orthonav simulate`: fly over an orthophoto of another year."""

import argparse
from pathlib import Path

from orthonav.cli.common import ROUTE_HELP, add_orthos, print_json, progress


def add(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_orthos(parser, "orthophoto to fly over, of another year than the map's")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--route", type=Path, help=ROUTE_HELP)
    where.add_argument("--random", type=int, metavar="N", help="N random places and headings")
    parser.add_argument(
        "--agl-m",
        type=float,
        help="height above ground (default: the image's shorter side covers 256 px of the imagery)",
    )
    parser.add_argument(
        "--spacing-m", type=float, help="distance of views on a route (default: 1 s)"
    )
    parser.add_argument("--speed-mps", type=float, default=25.0, help="airspeed (default 25)")
    parser.add_argument(
        "--turn-radius-m", type=float, default=0.0, help="fly corners of the route as arcs"
    )
    parser.add_argument(
        "--wind-mps", type=float, help="wind and gusts: heading crabs, ground speed varies"
    )
    parser.add_argument(
        "--wind-from-deg", type=float, help="where it comes from (default 270, the west)"
    )
    parser.add_argument(
        "--beyond", action="store_true", help="the route may leave the imagery: it is mirrored"
    )
    parser.add_argument(
        "--camera", type=Path, metavar="flight.json", help="camera (default 1280 x 960, 65 deg)"
    )
    errors = parser.add_argument_group("errors of the telemetry (standard deviations)")
    errors.add_argument("--yaw-std-deg", type=float, default=0.0, help="heading")
    errors.add_argument("--agl-std", type=float, default=0.0, help="height, as a share: 0.05")
    errors.add_argument("--tilt-std-deg", type=float, default=0.0, help="told pitch and roll")
    errors.add_argument("--attitude-std-deg", type=float, default=0.0, help="true pitch and roll")
    errors.add_argument("--prior-std-m", type=float, help="tell a position with this error")
    errors.add_argument(
        "--velocity-drift",
        type=float,
        help="tell a velocity with this error of scale (a share) and direction (rad)",
    )
    biases = parser.add_argument_group("errors that stay the same all along")
    biases.add_argument("--yaw-bias-deg", type=float, default=0.0, help="heading told too large")
    biases.add_argument(
        "--agl-bias", type=float, default=0.0, help="height told too large, as a share: 0.05"
    )
    biases.add_argument(
        "--pitch-bias-deg", type=float, default=0.0, help="the camera tilts more than told"
    )
    biases.add_argument(
        "--roll-bias-deg", type=float, default=0.0, help="the camera tilts more than told"
    )
    effects = parser.add_argument_group("faults of the picture")
    effects.add_argument(
        "--cloud-share", type=float, default=0.0, help="share of the views with clouds: 0.2"
    )
    effects.add_argument("--exposure-std", type=float, default=0.15, help="relative exposure")
    effects.add_argument("--blur-px", type=float, default=0.6, help="blur in pixels")
    effects.add_argument("--noise-std", type=float, default=2.0, help="noise in grey levels")
    effects.add_argument("--jpeg-quality", type=int, default=90)
    parser.add_argument("--seed", type=int, default=0, help="seed of all that is drawn (default 0)")
    parser.add_argument("--out", type=Path, required=True, metavar="FLIGHT_DIR")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")


def run(options: argparse.Namespace) -> None:
    """Simulate and say what was written."""
    from orthonav.errors import FlightError
    from orthonav.flight.folder import read_camera
    from orthonav.geo.route import read_route
    from orthonav.simulate.flight import DEFAULT_CAMERA, Errors, SimulateRequest, simulate_flight
    from orthonav.simulate.motion import Wind
    from orthonav.simulate.render import ViewEffects

    if options.wind_from_deg is not None and options.wind_mps is None:
        raise FlightError("--wind-from-deg needs a speed: --wind-mps")
    from_deg = 270.0 if options.wind_from_deg is None else options.wind_from_deg
    request = SimulateRequest(
        orthos=options.ortho,
        out=options.out,
        route=read_route(options.route) if options.route else None,
        random=options.random,
        agl_m=options.agl_m,
        spacing_m=options.spacing_m,
        speed_mps=options.speed_mps,
        camera=read_camera(options.camera)[0] if options.camera else DEFAULT_CAMERA,
        errors=Errors(
            yaw_std_deg=options.yaw_std_deg,
            agl_std=options.agl_std,
            tilt_std_deg=options.tilt_std_deg,
            attitude_std_deg=options.attitude_std_deg,
            prior_std_m=options.prior_std_m,
            yaw_bias_deg=options.yaw_bias_deg,
            agl_bias=options.agl_bias,
            pitch_bias_deg=options.pitch_bias_deg,
            roll_bias_deg=options.roll_bias_deg,
            velocity_drift=options.velocity_drift,
        ),
        effects=ViewEffects(
            options.exposure_std, options.blur_px, options.noise_std, options.jpeg_quality
        ),
        seed=options.seed,
        wind=None if options.wind_mps is None else Wind(options.wind_mps, from_deg),
        turn_radius_m=options.turn_radius_m,
        cloud_share=options.cloud_share,
        beyond=options.beyond,
    )
    with progress(options) as shown:
        views = simulate_flight(request, lambda share: shown("simulate", share))
    if options.json:
        print_json({"flight": str(options.out), "views": views})
    else:
        print(f"{views} views written to {options.out}")
