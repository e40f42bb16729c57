"""`orthonav import`: write a recording as a flight folder."""

import argparse
import logging
from dataclasses import asdict
from pathlib import Path

from orthonav.cli.common import add_options, counted, print_result, progress
from orthonav.cli.source import add_source, open_source
from orthonav.core.errors import UsageError
from orthonav.core.geo.headings import RADIANS

log = logging.getLogger(__name__)

EXAMPLE = "photos/ --out flight"
EVERYDAY = (
    *("--camera", "--telemetry", "--time-offset-s", "--mount-deg", "--rate-hz"),
    *("--agl-m", "--json"),
)


def add(parser: argparse.ArgumentParser) -> None:
    text = "photographs (a folder, files, or a CSV of images by file name), video, ROS 1 or 2 bag, "
    text += "MCAP file, or flight folder"
    parser.add_argument("source", type=Path, nargs="+", metavar="SOURCE", help=text)
    parser.add_argument("--out", type=Path, required=True, metavar="FLIGHT_DIR", help="to write")
    add_source(parser, dem=False)
    add_options(parser, "--json")


def run(options: argparse.Namespace) -> None:
    from orthonav.ground.recordings import import_flight

    if options.mask is not None:
        raise UsageError("a flight folder keeps no mask: give --mask where it is read")
    recording = open_source(options.source, options)
    with progress(options) as shown:
        done = import_flight(recording, options.out, progress=lambda share: shown("import", share))
    if done.broken:
        log.warning("%d views left out, the first: %s", done.broken, done.first_broken)
    if done.radians:
        log.warning("%s", RADIANS)
    tilt = "not stated, 3 deg are assumed"
    if done.tilt_std_deg is not None:
        tilt = " to ".join(dict.fromkeys(f"{each:.1f}" for each in done.tilt_std_deg)) + " deg"
    plain = {"flight": str(options.out), "kind": recording.kind, "note": recording.note}
    print_result(
        options,
        plain | {"choices": recording.choices} | asdict(done),
        f"{counted(done.views, 'view')}, {done.complete} with heading, pitch, roll and height, "
        f"{done.with_truth} with a position",
        f"standard deviation of pitch and roll: {tilt}\nwritten to {options.out}",
    )
