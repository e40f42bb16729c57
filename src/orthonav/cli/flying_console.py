"""What `orthonav fly` says before it starts: map, camera, inputs, outputs."""

import argparse
import math
import sys
from contextlib import ExitStack
from pathlib import Path

from orthonav.core.geo.camera import Camera
from orthonav.core.mapfile import MapFile
from orthonav.onboard import cameras
from orthonav.onboard.console import Console
from orthonav.onboard.outputs import KINDS
from orthonav.onboard.telemetry import Clocks


def opened_console(options: argparse.Namespace, clocks: Clocks, stack: ExitStack) -> Console:
    """Console on stderr, which `stack` closes; it takes the log records of stderr."""
    console = Console(sys.stderr, clocks, quiet=options.quiet)
    stack.callback(console.close)
    stack.enter_context(console.in_place_of_stderr())
    return console


def awaited(options: argparse.Namespace) -> str | None:
    """The images that are waited for; None for those of ROS 2, whose reader says so."""
    if options.ros2:
        return None
    clock = " (times of the autopilot's clock)" if options.file_clock == "autopilot" else ""
    return f"images from {options.source}{clock}"


def plan_lines(options: argparse.Namespace, opened: MapFile, least: float) -> list[str]:
    """What the flight uses and sends, one line each. `least`: confidence from which it sends."""
    lines = [
        f"map: {_map_text(options.map, opened)}",
        f"autopilot: {_telemetry_text(options)}",
        f"sends: {_sends_text(options, least)}",
        f"start: {_start_text(options)}",
        f"GNSS: {'not used' if options.gnss == 'off' else options.gnss}",
    ]
    if options.log is not None:
        lines.append(f"log: {options.log}, views: {options.log_views}")
    return lines


def camera_line(options: argparse.Namespace, camera: Camera) -> str:
    """Size and field of view of the camera, and where its images come from."""
    width_deg, height_deg = (_view_deg(each, camera.model) for each in camera.extent)
    given = options.camera or ("camera_info" if options.ros2 else "flight.json")
    source, pace = "ROS 2" if options.ros2 else str(options.source), ""
    if not options.ros2 and not cameras.is_live(source):
        pace = f", played at {options.pace:g} times real time" if options.pace != 1 else ", played"
    return (
        f"camera: {camera.width_px}x{camera.height_px} px, {width_deg:.0f} x {height_deg:.0f} deg "
        f"({given}); images from {source}{pace}"
    )


def _view_deg(extent: float, model: str) -> float:
    """Field of view along one side, without distortion."""
    half = extent / 2
    return math.degrees(2 * (half if model == "fisheye" else math.atan(half)))


def _map_text(path: Path, opened: MapFile) -> str:
    sheet = opened.manifest.sheets[0]
    terrain = sheet.terrain
    ground = "level ground"
    if terrain is not None:
        ground = f"terrain of {terrain.low_m:.0f} to {terrain.high_m:.0f} m"
    return f"{path}, {opened.manifest.area_km2:.2f} km2, {sheet.grid.gsd_m:g} m per pixel, {ground}"


def _telemetry_text(options: argparse.Namespace) -> str:
    if options.ros2:
        return "telemetry from ROS 2"
    recorded = f"recorded telemetry of {options.source}" if options.recorded_telemetry else None
    return ", ".join(each for each in (options.autopilot, recorded) if each)


def _sends_text(options: argparse.Namespace, least: float) -> str:
    kinds = dict.fromkeys(options.send or ["global-position"])
    messages = [KINDS[kind] for kind in kinds] if options.autopilot else []
    messages += ["ROS 2 topics"] if options.ros2 else []
    if options.dry_run and messages:
        messages = ["nothing to the autopilot (--dry-run)"]
    others = [f"NMEA to {url}" for url in options.nmea]
    others += [f"JSON lines to {'stdout' if each == '-' else each}" for each in options.jsonl]
    text = ", ".join([*messages, *others])
    return f"{text}; positions of confidence {least:g} or more" if text else "nothing"


def _start_text(options: argparse.Namespace) -> str:
    given = "anywhere on the map"
    if options.start:
        lat_deg, lon_deg, std_m = options.start
        given = f"{lat_deg:.6f}, {lon_deg:.6f} +- {std_m:g} m"
    if options.state is None:
        return given
    return f"position saved in {options.state}, if it is recent, else {given}"
