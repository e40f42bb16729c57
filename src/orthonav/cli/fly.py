"""`orthonav fly`: beside an autopilot, from camera to position messages."""

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

EVERYDAY = (
    "--camera-file",
    "--mount",
    "--autopilot",
    "--send",
    "--nmea",
    "--accept",
    "--dry-run",
    "--heading",
    "--start",
    "--state",
    "--log",
)
SEND = ("global-position", "gps-input", "odometry", "vision", "external-position")
HEIGHTS = ("distance", "terrain", "home", "relative")


def numbers(count: int, what: str) -> Callable[[str], tuple[float, ...]]:
    """An argument of so many numbers with commas between."""

    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) != count:
            raise argparse.ArgumentTypeError(f"expected {what}, got '{text}'")
        return values

    return parse


def add(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("map", type=Path, metavar="MAP.onav")
    _add_camera(parser.add_argument_group("camera"))
    _add_autopilot(parser.add_argument_group("autopilot"))
    _add_ros2(parser.add_argument_group("ROS 2"))
    _add_outputs(parser.add_argument_group("what is sent"))
    _add_flight(parser.add_argument_group("flight"))


def _add_camera(group: Any) -> None:
    group.add_argument(
        "--camera",
        metavar="SOURCE",
        help="/dev/video0 or 0, rtsp:// or http:// stream, video, folder of images, flight folder",
    )
    group.add_argument(
        "--camera-file",
        type=Path,
        metavar="FILE",
        help="flight.json, OpenCV, ROS or Kalibr (default: that of the flight folder)",
    )
    group.add_argument(
        "--camera-latency-ms",
        type=float,
        default=0.0,
        metavar="MS",
        help="of live cameras, from exposure to arrival",
    )
    group.add_argument(
        "--pace", type=float, default=1.0, metavar="FACTOR", help="of recordings: how much faster"
    )
    group.add_argument(
        "--rate-hz-images", type=float, default=2.0, metavar="HZ", help="of a folder of images"
    )
    group.add_argument(
        "--file-clock",
        choices=("own", "autopilot"),
        default="own",
        help="own: a recording begins at once (default); autopilot: its times are the autopilot's",
    )
    group.add_argument(
        "--mount-deg",
        type=float,
        nargs=3,
        default=(0.0, 0.0, 0.0),
        metavar=("YAW", "PITCH", "ROLL"),
        help="camera in the aircraft: 0 0 0 (default) looks straight down, top forward",
    )
    group.add_argument(
        "--mount", type=Path, metavar="mount.json", help="what `orthonav calibrate` found"
    )


def _add_autopilot(group: Any) -> None:
    group.add_argument(
        "--autopilot",
        metavar="URL",
        help="udpin:[HOST:]PORT (loopback unless told), udpout:HOST:PORT, tcp:HOST:PORT, "
        "/dev/DEVICE:BAUD",
    )
    group.add_argument(
        "--telemetry",
        choices=("autopilot", "recorded"),
        default="autopilot",
        help="recorded: that of the flight folder, to try without an autopilot",
    )
    group.add_argument("--system-id", type=int, metavar="N", help="of the autopilot")
    group.add_argument(
        "--component-id", type=int, default=197, metavar="N", help="ours (default 197)"
    )
    group.add_argument(
        "--signing-key",
        type=Path,
        metavar="FILE",
        help="MAVLink signing: 32 bytes, or 64 hexadecimal digits, in a file",
    )
    group.add_argument(
        "--height",
        action="append",
        choices=HEIGHTS,
        help="heights that may be used, the best first (default: all in this order)",
    )
    group.add_argument(
        "--telemetry-wait-ms",
        type=float,
        default=150.0,
        metavar="MS",
        help="how long a view waits for the attitude after its exposure (default 150)",
    )


def _add_ros2(group: Any) -> None:
    group.add_argument(
        "--ros2",
        action="store_true",
        help="camera, telemetry and positions as topics of ROS 2, instead of --camera and "
        "--autopilot (docs/ros2.md)",
    )
    group.add_argument(
        "--ros-args",
        nargs=argparse.REMAINDER,
        default=[],
        metavar="ARGS",
        help="last: -r FROM:=TO, -r __ns:=/NAMESPACE, -r __node:=NAME, -p NAME:=VALUE",
    )


def _add_outputs(group: Any) -> None:
    group.add_argument(
        "--send",
        action="append",
        choices=SEND,
        help="message on the autopilot's link (default global-position); may come several times",
    )
    group.add_argument(
        "--nmea",
        action="append",
        default=[],
        metavar="URL",
        help="udp:HOST:PORT, tcp-listen:[HOST:]PORT or serial:DEVICE:BAUD",
    )
    group.add_argument(
        "--nmea-as-gps", action="store_true", help="NMEA quality 1 instead of 6 (estimated)"
    )
    group.add_argument("--json", action="append", default=[], metavar="FILE|-", help="lines")
    group.add_argument(
        "--rate-hz", type=float, metavar="HZ", help="most messages a second (default: every view)"
    )
    group.add_argument(
        "--accept",
        default="confidence:0.9",
        metavar="NAME:MIN",
        help="what is sent: confidence:0.9 (default), or peak_ratio:1.3 beside it",
    )
    group.add_argument(
        "--max-std-m", type=float, default=50.0, metavar="M", help="less sure is not sent"
    )
    group.add_argument(
        "--min-std-m", type=float, default=0.0, metavar="M", help="what the orthophoto is worth"
    )
    group.add_argument(
        "--stamp",
        choices=("utc", "boot"),
        default="utc",
        help="clock of the messages: ours in UTC (default), or the autopilot's",
    )
    group.add_argument("--sensor-id", type=int, default=1, metavar="N", help="as EKF2_AGP0_ID")
    group.add_argument("--gps-id", type=int, default=0, metavar="N", help="of GPS_INPUT")
    group.add_argument("--satellites", type=int, default=0, metavar="N", help="of GPS_INPUT")
    group.add_argument("--hdop-m", type=float, metavar="M", help="metres per HDOP, of GPS_INPUT")
    group.add_argument(
        "--origin",
        type=numbers(3, "LAT,LON,ALT_M"),
        metavar="LAT,LON,ALT_M",
        help="sent where the autopilot has no origin, for odometry and vision; with --ros2 the "
        "origin of the map frame",
    )
    group.add_argument("--dry-run", action="store_true", help="send nothing to the autopilot")


def _add_flight(group: Any) -> None:
    group.add_argument(
        "--heading", choices=("known", "unknown"), default="known", help="is the compass believed?"
    )
    group.add_argument(
        "--start",
        type=numbers(3, "LAT,LON,STD_M"),
        metavar="LAT,LON,STD_M",
        help="where the flight begins (default: anywhere on the map)",
    )
    group.add_argument(
        "--state", type=Path, metavar="FILE", help="the last position, kept over a restart"
    )
    group.add_argument(
        "--state-max-age-s", type=float, default=300.0, metavar="S", help="older is not used"
    )
    group.add_argument(
        "--deadline-ms",
        type=float,
        default=500.0,
        metavar="MS",
        help="views older than this when their turn comes are dropped (default 500)",
    )
    group.add_argument(
        "--require-signed",
        type=Path,
        metavar="PUBLIC.pem",
        help="do not fly by a map unless it was signed with this key (`orthonav sign`)",
    )
    group.add_argument("--log", type=Path, metavar="FILE.mcap", help="what is needed for a replay")
    group.add_argument(
        "--log-max-mb", type=float, metavar="MB", help="of the log: its oldest files go"
    )
    group.add_argument(
        "--log-views", choices=("none", "thumbnails", "full"), default="full", help="in the log"
    )


def run(options: argparse.Namespace) -> None:
    """Fly until SIGTERM, SIGINT or the end of a recording."""
    import gc
    import signal
    import threading

    from orthonav.cli.flying import runner
    from orthonav.errors import VariantError

    if options.ros2 and (options.camera or options.autopilot):
        raise VariantError("--ros2 replaces --camera and --autopilot: give one or the other")
    if options.ros_args and not options.ros2:
        raise VariantError("--ros-args needs --ros2")
    if not options.ros2 and options.camera is None:
        raise VariantError("give --camera SOURCE, or --ros2 for pictures from a ROS 2 topic")
    if not options.ros2 and options.autopilot is None and options.telemetry == "autopilot":
        raise VariantError("give --autopilot URL, or --telemetry recorded to try without one")
    stopping = threading.Event()
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, signal.SIGINT):
            before[number] = signal.signal(number, lambda *_: stopping.set())
    try:
        with ExitStack() as stack:
            made = runner(options, stopping, stack)
            gc.collect()
            gc.freeze()  # what is loaded stays: looking through it takes as long as a view
            stack.callback(gc.unfreeze)
            made.run(stopping)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
