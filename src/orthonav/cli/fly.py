"""`orthonav fly`: position messages to an autopilot, from a live camera or a recording."""

import argparse
import gc
import logging
import signal
import threading
from contextlib import ExitStack
from pathlib import Path

from orthonav.cli.common import add_acceptance, add_options, numbers, within
from orthonav.core.errors import StoppedError, VariantError

EXAMPLE = "area.onav 0 --camera calib.yaml --camera-latency-ms 80 --autopilot udpin:14550"
EVERYDAY = (
    *("--camera", "--camera-latency-ms", "--mount", "--autopilot", "--recorded-telemetry"),
    *("--ros2", "--send", "--nmea", "--jsonl", "--accept", "--alert-limit-m", "--dry-run"),
    *("--heading", "--start", "--state", "--gnss", "--log"),
)
SEND = ("global-position", "gps-input", "odometry", "vision", "external-position")
HEIGHTS = ("distance", "terrain", "amsl", "home", "relative")


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("map", type=Path, metavar="MAP.onav", help="map of the area")
    parser.add_argument(
        "source",
        nargs="?",
        metavar="SOURCE",
        help="images: /dev/video0 or 0, an rtsp:// or http:// stream, a video or a flight folder; "
        "not with --ros2",
    )
    _add_inputs(parser)
    _add_outputs(parser)
    _add_flight(parser)


def _add_inputs(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("camera")
    add = group.add_argument
    add_options(group, "--camera", "--mask", "--mount-deg", "--mount")
    text = "live cameras: time from exposure to arrival; without it nothing is sent"
    add("--camera-latency-ms", metavar="MS|FILE", help=f"{text} (`orthonav calibrate --latency`)")

    add = parser.add_argument_group("playback of recordings").add_argument
    text = "use the telemetry of the flight folder; else its times are those of the autopilot"
    add("--recorded-telemetry", action="store_true", help=text)
    text = "playback speed (default 1: real time; above 2 some fixes are withheld as jumps)"
    add("--pace", type=float, default=1.0, metavar="FACTOR", help=text)

    add = parser.add_argument_group("autopilot").add_argument
    text = "udpin:[HOST:]PORT (default HOST: loopback), udpout:HOST:PORT, tcp:HOST:PORT or "
    add("--autopilot", metavar="URL", help=f"MAVLink connection: {text}/dev/DEVICE:BAUD")
    text = "system id of the autopilot (default: the first one heard)"
    add("--system-id", type=within(1, 255, int), metavar="N", help=text)
    text = "key of MAVLink signing (32 bytes or 64 hexadecimal digits); unsigned ones are ignored"
    add("--signing-key", type=Path, metavar="FILE", help=text)
    text = "source of the height above ground; repeat in order of preference (default: all, so)"
    add("--height", action="append", choices=HEIGHTS, help=text)

    add = parser.add_argument_group("ROS 2").add_argument
    text = "images, telemetry and positions by ROS 2 topics, without SOURCE and --autopilot"
    add("--ros2", action="store_true", help=f"{text} (docs/ros2.md)")
    text = "must come last: -r FROM:=TO, -r __ns:=/NAMESPACE, -r __node:=NAME, -p NAME:=VALUE, "
    text += "--params-file FILE"
    add("--ros-args", nargs=argparse.REMAINDER, default=[], metavar="ARGS", help=text)


def _message(text: str) -> str:
    name, colon, gps_id = text.partition(":")
    has_id = name == "gps-input" and gps_id.isdecimal() and int(gps_id) < 256
    if name not in SEND or (colon and not has_id):
        raise argparse.ArgumentTypeError(
            f"expected {', '.join(SEND)} or gps-input:0 to gps-input:255, got '{text}'"
        )
    return text


def _add_outputs(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("outputs")
    add = group.add_argument
    text = f"message to send to the autopilot: {', '.join(SEND)} (default the first; can be "
    text += "repeated); gps-input:1 states the gps_id 1 (default 0)"
    add("--send", action="append", type=_message, metavar="MESSAGE", help=text)
    text = "NMEA to udp:HOST:PORT or serial:DEVICE:BAUD; can be repeated. RMC has status V, which "
    text += "most displays ignore: see --nmea-as-gps"
    add("--nmea", action="append", default=[], metavar="URL", help=text)
    text = "append one line of JSON per view to a file, or to stdout (-); can be repeated"
    add("--jsonl", action="append", default=[], metavar="FILE|-", help=text)
    text = "maximum rate of each message (default: one per view)"
    add("--send-rate-hz", type=float, metavar="HZ", help=text)
    add_acceptance(group)
    text = "lower bound of the standard deviation that messages state (default 0)"
    add("--min-std-m", type=within(0, 10_000), default=0.0, metavar="M", help=text)
    add("--dry-run", action="store_true", help="send nothing to the autopilot")

    add = parser.add_argument_group("fields of messages").add_argument
    text = "origin of the local frame (degrees, m above sea level): for odometry and vision set "
    text += "where the autopilot has none; with --ros2: of the map frame"
    triple = "LAT,LON,ALT_M"
    add("--origin", type=numbers(3, triple), metavar=triple, help=text)
    text = "NMEA quality 1 and RMC status A (GPS fix) instead of 6 and V (estimated)"
    add("--nmea-as-gps", action="store_true", help=text)


def _add_flight(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("flight")
    add = group.add_argument
    add_options(group, "--heading", "--budget-ms", "--threads", "--require-signed", "--not-before")
    text = "start position and its standard deviation per axis (default: anywhere on the map); "
    text += "over a map with terrain also the take-off position"
    triple = "LAT,LON,STD_M"
    add("--start", type=numbers(3, triple), metavar=triple, help=text)
    text = "save the last position to this file and start from it after a restart within 300 s"
    add("--state", type=Path, metavar="FILE", help=text)
    text = "watch: compare GNSS with the map, report faults, learn displacement, mount and "
    text += "latency, and correct positions by the displacement (default off)"
    add("--gnss", choices=("off", "watch"), default="off", help=text)

    add = parser.add_argument_group("flight log").add_argument
    text = "write a flight log that can be replayed"
    add("--log", type=Path, metavar="FILE.mcap", help=text)
    text = "maximum size of the log; its oldest files are deleted (default: no limit)"
    add("--log-max-mb", type=within(1, 1e9), metavar="MB", help=text)
    text = "images in the log; a replay needs full ones (default)"
    add("--log-views", choices=("none", "thumbnails", "full"), default="full", help=text)


def run(options: argparse.Namespace) -> None:
    """Fly until SIGTERM, SIGINT or the end of a recording."""
    _check(options)
    stopping = threading.Event()
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, signal.SIGINT):
            before[number] = signal.signal(number, lambda *_: stopping.set())
    try:
        from orthonav.cli.flying import runner  # takes a while, in which it may be stopped

        with ExitStack() as stack:
            try:
                made = runner(options, stopping, stack)
            except StoppedError as error:  # as it was asked to: no failure
                logging.getLogger(__name__).warning("%s", error)
                return
            gc.collect()
            gc.freeze()  # a full collection over the loaded modules takes as long as a view
            stack.callback(gc.unfreeze)
            made.run(stopping)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _check(options: argparse.Namespace) -> None:
    ids = {int(gps_id) for each in options.send or () if (gps_id := each.partition(":")[2])}
    if len(ids) > 1:
        stated = " and ".join(f"gps-input:{each}" for each in sorted(ids))
        raise VariantError(f"--send states several receivers: {stated}; give one of them")
    if options.ros2 and (options.source or options.autopilot):
        raise VariantError("--ros2 replaces SOURCE and --autopilot: give one or the other")
    if options.ros_args and not options.ros2:
        raise VariantError("--ros-args needs --ros2")
    if options.ros2:
        return
    if options.source is None:
        raise VariantError("give a SOURCE of images after the map, or --ros2 for a ROS 2 topic")
    if options.autopilot is None and not options.recorded_telemetry:
        raise VariantError("give --autopilot URL, or --recorded-telemetry to try without one")
