"""Options for reading a recording, shared by `import`, `localize` and `calibrate`."""

import argparse
import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING

from orthonav.cli.common import add_dem

if TYPE_CHECKING:
    from orthonav.core.localize import Localizer
    from orthonav.ground.recordings import Recording, SourceView

FAR_M = 1000.0
"""A recorded position farther from the map causes a warning: GNSS and logs err by less."""
log = logging.getLogger(__name__)


def topic(text: str) -> tuple[str, str]:
    """ROLE=NAME."""
    role, equals, name = text.partition("=")
    if not (role and equals and name):
        raise argparse.ArgumentTypeError(f"expected ROLE=/topic, got '{text}'")
    return role, name


def add_source(parser: argparse.ArgumentParser, *, dem: bool = True) -> None:
    """Add the options; see docs/flights.md."""
    group = parser.add_argument_group("reading the recording")
    group.add_argument(
        "--kind",
        choices=("flight", "photos", "video", "ros"),
        help="kind of the recording (default: detected by content)",
    )
    group.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="camera file: flight.json, or of OpenCV, ROS or Kalibr (YAML, JSON)",
    )
    group.add_argument(
        "--telemetry",
        type=Path,
        metavar="LOG",
        help="log to join by time: PX4 .ulg, ArduPilot .bin or .tlog, DJI .srt, .csv; or a .csv of "
        "images by file name",
    )
    group.add_argument(
        "--time-offset-s",
        type=float,
        default=0.0,
        metavar="S",
        help="offset that is added to the times of images to get times of the log (default 0)",
    )
    group.add_argument(
        "--mount-deg",
        type=float,
        nargs=3,
        default=(0.0, 0.0, 0.0),
        metavar=("YAW", "PITCH", "ROLL"),
        help="orientation of the camera in the aircraft; 0 0 0 (default) looks straight down with "
        "the top of the image forward",
    )
    group.add_argument(
        "--topic",
        type=topic,
        action="append",
        default=[],
        metavar="ROLE=NAME",
        help="ROS topic for image, camera_info, attitude, velocity, position or height",
    )
    group.add_argument(
        "--rate-hz",
        type=float,
        default=1.0,
        metavar="HZ",
        help="views per second taken from a recording: of a video (default 1)",
    )
    group.add_argument(
        "--sensor-width-mm",
        type=float,
        metavar="MM",
        help="longer side of the sensor of photographs, for the focal length",
    )
    group.add_argument(
        "--fov-deg",
        type=float,
        help="field of view across the width of the images, where the camera is not known",
    )
    group.add_argument(
        "--agl-m", type=float, help="height above ground of all views, instead of a recorded one"
    )
    group.add_argument(
        "--ground-alt-m",
        type=float,
        metavar="M",
        help="altitude of the ground, in the reference of the recorded altitudes, where no heights "
        "were recorded",
    )
    if dem:
        add_dem(group, "for heights above ground where others were recorded")
    group.add_argument(
        "--looks-down",
        action="store_true",
        help="assume pitch and roll 0 where they were not recorded",
    )
    group.add_argument(
        "--prior-std-m",
        type=float,
        metavar="M",
        help="standard deviation of the prior position, per axis; the recorded position is then "
        "the prior (default: no prior)",
    )


def distance_from_map(latlon_deg: tuple[float, float], localizer: "Localizer") -> tuple[float, str]:
    """Distance of a position from the map (m, 0 on the map), and a hint where swapped latitude and
    longitude explain it, else an empty text."""
    import numpy as np

    from orthonav.core.geo.swapped import swapped_hint

    grid, frame = localizer.grid, localizer.sheet.frame
    low, high = np.reshape(grid.extent_en_m, (2, 2))

    def beyond_m(lat_deg: float, lon_deg: float) -> float:
        position = frame.en_from_latlon(lat_deg, lon_deg)
        return float(np.hypot(*np.maximum(np.maximum(low - position, position - high), 0.0)))

    hint = swapped_hint(*latlon_deg, lambda lat, lon: beyond_m(lat, lon) <= FAR_M)
    return beyond_m(*latlon_deg), hint


def far_from_map(view: "SourceView", localizer: "Localizer") -> tuple[float, str] | None:
    """`distance_from_map` of the recorded position of a view or of its prior, the farther one; None
    without a position."""
    prior, recorded = view.telemetry.prior, view.truth_latlon_deg
    places = [] if recorded is None else [recorded]
    places += [] if prior is None else [(prior.lat_deg, prior.lon_deg)]
    known = [place for place in places if all(map(math.isfinite, place))]
    return max((distance_from_map(place, localizer) for place in known), default=None)


def far_text(what: str, far_m: float, hint: str) -> str:
    """A sentence about positions that are far from the map."""
    return f"{what} {far_m / 1000:,.0f} km from the map; check the map and the positions{hint}"


def warn_if_far_from_map(flight: "Recording", localizer: "Localizer") -> None:
    """Log a warning where the first view was recorded far from the map."""
    view = next(iter(flight.views), None)
    found = None if view is None else far_from_map(view, localizer)
    if found is not None and found[0] > FAR_M:
        log.warning("%s", far_text("the recorded position of the first view is", *found))


def open_source(
    path: Path | list[Path], options: argparse.Namespace, *, over_terrain: bool = False
) -> "Recording":
    """The open recording of the command line; its warnings are logged.

    `over_terrain`: whether a terrain turns its heights into heights above ground.
    """
    from orthonav.ground.recordings import SourceOptions, open_source

    source_options = SourceOptions(
        kind=options.kind,
        camera=options.camera,
        rate_hz=options.rate_hz,
        telemetry=options.telemetry,
        time_offset_s=options.time_offset_s,
        mount_deg=tuple(options.mount_deg),
        topics=dict(options.topic),
        prior_std_m=options.prior_std_m,
        sensor_width_mm=options.sensor_width_mm,
        ground_alt_m=options.ground_alt_m,
        agl_m=options.agl_m,
        fov_deg=options.fov_deg,
        looks_down=options.looks_down,
        over_terrain=over_terrain,
        skip_bad_images=getattr(options, "skip_bad_images", False),
    )
    recording = open_source(path, source_options)
    for warning in recording.warnings:
        log.warning("%s", warning)
    return recording
