"""`orthonav fly`: position messages to an autopilot, from a live camera or a recording."""

import argparse
import logging
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from orthonav.cli.common import add_search
from orthonav.cli.signed import add_signature

EVERYDAY = (
    "--camera",
    "--camera-latency-ms",
    "--mount",
    "--autopilot",
    "--recorded-telemetry",
    "--ros2",
    "--send",
    "--nmea",
    "--jsonl",
    "--accept",
    "--dry-run",
    "--heading",
    "--start",
    "--state",
    "--gnss",
    "--log",
)
SEND = ("global-position", "gps-input", "odometry", "vision", "external-position")
HEIGHTS = ("distance", "terrain", "amsl", "home", "relative")


def numbers(count: int, expected: str) -> Callable[[str], tuple[float, ...]]:
    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) != count:
            raise argparse.ArgumentTypeError(f"expected {expected}, got '{text}'")
        return values

    return parse


def _number(
    group: argparse._ActionsContainer,
    name: str,
    unit: str,
    meaning: str,
    default: float | None = None,
    *,
    kind: type[float] = float,
) -> None:
    if default is not None:
        meaning += f" (default {default:g})"
    group.add_argument(name, type=kind, default=default, metavar=unit, help=meaning)


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("map", type=Path, metavar="MAP.onav", help="map of the area")
    parser.add_argument(
        "source",
        nargs="?",
        metavar="SOURCE",
        help="images: /dev/video0 or 0, an rtsp:// or http:// stream, a video, a folder of images "
        "or a flight folder; not with --ros2",
    )
    _add_camera(parser.add_argument_group("camera"))
    _add_recording(parser.add_argument_group("playback of recordings"))
    _add_autopilot(parser.add_argument_group("autopilot"))
    _add_ros2(parser.add_argument_group("ROS 2"))
    _add_outputs(parser.add_argument_group("outputs"))
    _add_messages(parser.add_argument_group("fields of messages"))
    _add_flight(parser.add_argument_group("flight"))
    _add_log(parser.add_argument_group("flight log"))


def _add_camera(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="camera file: flight.json, or of OpenCV, ROS or Kalibr (YAML, JSON); default: "
        "flight.json of the flight folder",
    )
    group.add_argument(
        "--camera-latency-ms",
        metavar="MS|FILE",
        help="live cameras: time from exposure to arrival, or the file of `orthonav calibrate "
        "--latency`; without it nothing is sent",
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
        "--mount",
        type=Path,
        metavar="mount.json",
        help="correct heading, height and tilt with a calibration by `orthonav calibrate`",
    )


def _add_recording(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--recorded-telemetry",
        action="store_true",
        help="use the telemetry of the flight folder; no autopilot is needed",
    )
    group.add_argument(
        "--pace",
        type=float,
        default=1.0,
        metavar="FACTOR",
        help="playback speed (default 1: real time)",
    )
    group.add_argument(
        "--file-clock",
        choices=("own", "autopilot"),
        default="own",
        help="own: playback starts at once (default); autopilot: recorded times are those of the "
        "autopilot's clock since boot",
    )


def _add_autopilot(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--autopilot",
        metavar="URL",
        help="MAVLink connection: udpin:[HOST:]PORT (default HOST: loopback), udpout:HOST:PORT, "
        "tcp:HOST:PORT or /dev/DEVICE:BAUD",
    )
    _number(
        group,
        "--system-id",
        "N",
        "system id of the autopilot (default: the first one heard)",
        kind=int,
    )
    group.add_argument(
        "--signing-key",
        type=Path,
        metavar="FILE",
        help="file with the key of MAVLink signing, 32 bytes or 64 hexadecimal digits; messages "
        "are then signed, and unsigned ones ignored",
    )
    group.add_argument(
        "--height",
        action="append",
        choices=HEIGHTS,
        help="source of the height above ground; can be repeated in order of preference (default: "
        "all, in this order)",
    )
    _number(
        group,
        "--telemetry-wait-ms",
        "MS",
        "longest wait of a view for the attitude at its exposure",
        150.0,
    )


def _add_ros2(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--ros2",
        action="store_true",
        help="read images and telemetry from ROS 2 topics and publish positions there, instead "
        "of SOURCE and --autopilot (docs/ros2.md)",
    )
    group.add_argument(
        "--ros-args",
        nargs=argparse.REMAINDER,
        default=[],
        metavar="ARGS",
        help="must come last: -r FROM:=TO, -r __ns:=/NAMESPACE, -r __node:=NAME, -p NAME:=VALUE, "
        "--params-file FILE, --log-level LEVEL",
    )


def _add_outputs(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--send",
        action="append",
        choices=SEND,
        help="message to send to the autopilot (default global-position); can be repeated",
    )
    group.add_argument(
        "--nmea",
        action="append",
        default=[],
        metavar="URL",
        help="send NMEA sentences to udp:HOST:PORT, tcp-listen:[HOST:]PORT or serial:DEVICE:BAUD; "
        "can be repeated",
    )
    group.add_argument(
        "--jsonl",
        action="append",
        default=[],
        metavar="FILE|-",
        help="append one line of JSON per view to a file, or write them to stdout (-); can be "
        "repeated",
    )
    _number(group, "--send-rate-hz", "HZ", "maximum rate of each message (default: one per view)")
    group.add_argument(
        "--accept",
        default="confidence:0.9",
        metavar="NAME:MIN",
        help="criterion of a confident fix and its threshold: confidence:0.9 (default), or "
        "peak_ratio:1.3 in addition; other fixes are not sent",
    )
    _number(
        group, "--max-std-m", "M", "largest standard deviation of a position that is sent", 50.0
    )
    group.add_argument(
        "--send-coasting",
        action="store_true",
        help="also send dead-reckoned positions of views that do not show the map, only as "
        "GLOBAL_POSITION_SENSOR with the flag UNHEALTHY, which PX4 ignores",
    )
    _number(
        group, "--min-std-m", "M", "lower bound of the standard deviation that messages state", 0.0
    )
    group.add_argument("--dry-run", action="store_true", help="send nothing to the autopilot")


def _add_messages(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--stamp",
        choices=("utc", "boot"),
        default="utc",
        help="clock of the timestamps: UTC of this computer (default), or the autopilot's time "
        "since boot",
    )
    group.add_argument(
        "--origin",
        type=numbers(3, "LAT,LON,ALT_M"),
        metavar="LAT,LON,ALT_M",
        help="origin of the local frame (degrees, m above mean sea level), for odometry and "
        "vision: set where the autopilot has none; with --ros2: origin of the map frame",
    )
    _number(group, "--sensor-id", "N", "id of GLOBAL_POSITION_SENSOR, as EKF2_AGP0_ID", 1, kind=int)
    _number(group, "--gps-id", "N", "gps_id of GPS_INPUT", 0, kind=int)
    _number(group, "--satellites", "N", "satellites_visible of GPS_INPUT", 0, kind=int)
    _number(
        group,
        "--hdop-m",
        "M",
        "hdop of GPS_INPUT: standard deviation divided by this many metres (default: ignored)",
    )
    group.add_argument(
        "--nmea-as-gps",
        action="store_true",
        help="NMEA quality 1 (GPS fix) instead of 6 (estimated)",
    )


def _add_flight(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--heading",
        choices=("known", "unknown"),
        default="known",
        help="known: from telemetry (default); unknown: all headings are tried",
    )
    group.add_argument(
        "--start",
        type=numbers(3, "LAT,LON,STD_M"),
        metavar="LAT,LON,STD_M",
        help="start position and its standard deviation per axis (degrees, m; default: anywhere "
        "on the map); over a map with terrain also the take-off position",
    )
    group.add_argument(
        "--state",
        type=Path,
        metavar="FILE",
        help="save the last position to this file and start from it after a restart",
    )
    _number(
        group,
        "--state-max-age-s",
        "S",
        "largest age of a saved position that a flight starts from, and of a stop after which the "
        "learning of --gnss continues",
        300.0,
    )
    group.add_argument(
        "--gnss",
        choices=("off", "watch", "correct"),
        default="off",
        help="watch: compare GNSS with the map, report faults, learn the displacement of the map, "
        "errors of the mount and the latency; correct: also correct positions by what earlier "
        "flights stored in --state (default off)",
    )
    _number(
        group,
        "--deadline-ms",
        "MS",
        "largest age of a view when its processing starts; older views are dropped",
        500.0,
    )
    _number(
        group,
        "--min-agl-m",
        "M",
        "height above ground from which views are located (default: where a view covers 60 "
        "pixels of the map)",
    )
    add_search(group)
    add_signature(group)


def _add_log(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--log", type=Path, metavar="FILE.mcap", help="write a flight log that can be replayed"
    )
    _number(
        group,
        "--log-max-mb",
        "MB",
        "maximum size of the log; its oldest files are deleted (default: no limit)",
    )
    group.add_argument(
        "--log-views",
        choices=("none", "thumbnails", "full"),
        default="full",
        help="images in the log; a replay needs full ones (default)",
    )


def run(options: argparse.Namespace) -> None:
    """Fly until SIGTERM, SIGINT or the end of a recording."""
    import gc
    import signal
    import threading

    from orthonav.core.errors import StoppedError

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
    from orthonav.core.errors import VariantError

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
