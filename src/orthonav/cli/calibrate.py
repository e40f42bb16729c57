"""`orthonav calibrate`: estimate constant errors of mount, compass and height from a flight."""

import argparse
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import orthonav
from orthonav.cli.common import add_options, beside, counted, print_result, progress, watched
from orthonav.cli.source import add_source, dem_of, flight_heights, located, open_source
from orthonav.core.errors import UsageError

if TYPE_CHECKING:
    from orthonav.core.flight import RecordedView
    from orthonav.ground.recordings import Recording
    from orthonav.ground.recordings.calibrate import MountCalibration

EXAMPLE = "area.onav flight --out mount.json"
EVERYDAY = ("--latency", "--prior-std-m", "--heading", "--camera", "--telemetry", "--json")


def add(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "recorded positions (--prior-std-m 5 for GNSS) make pitch and roll observable from "
        "positions, not from the perspective alone"
    )
    add = parser.add_argument
    add("map", type=Path, metavar="MAP.onav", help="map of the area")
    text = "flight to calibrate with, as for `localize`"
    add("flight", type=Path, metavar="SOURCE", help=text)
    add("--out", type=Path, required=True, metavar="mount.json", help="file to write")
    text = "estimate the time from exposure to arrival of the camera instead, from a flight log of "
    text += "`fly --log` with turns; --out is then a file for `fly --camera-latency-ms`"
    add("--latency", action="store_true", help=text)
    add_options(parser, "--heading", "--json")
    add_source(parser)


def run(options: argparse.Namespace) -> None:
    from orthonav.core.flight.mount import write_mount

    if options.latency:
        if options.dem is not None:
            raise UsageError("--latency uses the heights of the log: omit --dem")
        _run_latency(options)
        return
    found = _calibrated(options)
    write_mount(options.out, found.mount)
    with beside(options.out):
        lines = [f"{'':22} {'value':>8} {'std':>9} {'scatter':>8}"]
        for name, bias, unit in (
            ("heading, deg", found.mount.heading_deg, 1.0),
            ("height (or focal), %", found.mount.log_scale, 100.0),
            ("pitch, deg", found.mount.pitch_deg, 1.0),
            ("roll, deg", found.mount.roll_deg, 1.0),
        ):
            value, std, scatter = (unit * each for each in (bias.value, bias.std, bias.scatter))
            lines.append(f"{name:22} {value:+8.2f} {std:9.2f} {scatter:8.2f}")
        lines.append(f"from {counted(found.mount.views, 'view')}, {found.first} to {found.last}")
        if found.moved:
            moved = "the camera moved in its mount before these views; earlier views are not used"
            lines.append(moved)
        more = {"first": found.first, "last": found.last, "moved": found.moved}
        print_result(options, asdict(found.mount) | more, *lines, f"written to {options.out}")


def _calibrated(options: argparse.Namespace) -> "MountCalibration":
    """The mount by the smoothed track of the flight."""
    from orthonav.ground.recordings.calibrate import calibrate_mount
    from orthonav.ground.recordings.localize import smoothed_track

    dem, opened = dem_of(options), orthonav.open_map(options.map)
    over_terrain = dem is not None or opened.manifest.sheets[0].terrain is not None
    flight = open_source(options.flight, options, over_terrain=over_terrain)
    measured = options.prior_std_m is not None
    if measured:
        _check_positions(options, flight, opened)
    tracker = orthonav.Tracker(
        orthonav.Localizer(opened),
        heading_known=options.heading == "known",
        use_prior=measured,
        every_prior=measured,
        smooth=True,
    )
    views = (_with_prior(view, options.prior_std_m) for view in flight.views)
    heights = flight_heights(options, opened, flight, dem)
    with progress(options) as shown:
        results = located(options, tracker, flight, views, shown, heights=heights)
    return calibrate_mount(smoothed_track(tracker, results, None))


def _check_positions(
    options: argparse.Namespace, flight: "Recording", opened: orthonav.MapFile
) -> None:
    """By all recorded ones: a first one may be of before the first GNSS fix.

    Raises `UsageError` where there is none, `FlightError` where they seem to be swapped.
    """
    from orthonav.ground.evaluate.metrics import check_truth

    recorded = {view.frame: view.truth_latlon_deg for view in flight.views}
    places = {frame: place for frame, place in recorded.items() if place is not None}
    if not places:
        raise UsageError(
            f"--prior-std-m needs recorded positions, and no view has one: {options.flight}"
        )
    centre = opened.manifest.sheets[0].frame
    check_truth(places, (), (centre.lat_deg, centre.lon_deg), options.flight)


def _with_prior(view: "RecordedView", std_m: float | None) -> "RecordedView":
    """With the recorded position as its prior: other priors are no measurements."""
    place = None if std_m is None else view.truth_latlon_deg
    prior = None if place is None or std_m is None else orthonav.Prior(*place, std_m)
    return replace(view, telemetry=replace(view.telemetry, prior=prior))


def _run_latency(options: argparse.Namespace) -> None:
    from orthonav.core.flight.mount import write_latency
    from orthonav.ground.recordings.calibrate import arrivals_of, calibrate_latency

    flight = open_source(options.flight, options)
    with progress(options) as shown:
        views = watched(arrivals_of(flight), flight.expected, "latency", shown)
        found = calibrate_latency(flight.camera, views, heading_known=options.heading == "known")
    write_latency(options.out, found)
    with beside(options.out):
        print_result(
            options,
            asdict(found),
            f"latency of the camera {found.latency_ms:.0f} ms, std {found.std_ms:.0f} ms",
            f"from {found.pairs} pairs of images; written to {options.out}",
        )
