"""The parts of `orthonav fly`, made from its options. Loaded for a flight, not for `--help`."""

import argparse
import hashlib
import logging
import math
import os
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.cli.common import acceptance, checked_signature, search_plan
from orthonav.cli.source import FAR_M, distance_from_map, far_text, map_heights
from orthonav.core.errors import CameraError, OutputError, UsageError
from orthonav.core.extras import needed
from orthonav.core.files import require_file
from orthonav.core.flight import read_camera
from orthonav.core.flight.fixes import Identity
from orthonav.core.flight.gnss import FILE, read_gnss
from orthonav.core.flight.heights import DATUM_ADVICE
from orthonav.core.flight.mount import MOST_MS, CameraLatency, Mount, read_latency, read_mount
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.camera_files import masked, read_camera_file
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.localize import Localizer
from orthonav.core.localize.confidence import Acceptance
from orthonav.core.mapfile import MapFile, open_map
from orthonav.core.records import Prior
from orthonav.core.track.tracker import Tracker
from orthonav.onboard import cameras, outputs, state
from orthonav.onboard.cameras import NewestImage, read_in_thread
from orthonav.onboard.console import Console, Narrator
from orthonav.onboard.fly import FlyOptions, Runner
from orthonav.onboard.gnss.biases import Biases
from orthonav.onboard.gnss.watch import GnssWatch
from orthonav.onboard.latency import MIN_STD_S, LatencyMonitor
from orthonav.onboard.link import AutopilotLink, LinkThread
from orthonav.onboard.messages.gate import Gate, GateRules
from orthonav.onboard.messages.mavlink import Origin, Signing, signing_timestamp
from orthonav.onboard.messages.nmea import Quality
from orthonav.onboard.ports import transport_opener
from orthonav.onboard.run import Locator, MountCorrected, model_of
from orthonav.onboard.telemetry import HEIGHT_SOURCES, Clocks, TelemetryBuffer

if TYPE_CHECKING:
    from orthonav.onboard.log import FlightLog
    from orthonav.onboard.ros2.publisher import Ros2Publisher

log = logging.getLogger(__name__)
MIN_VIEW_PX = 60.0
"""Narrower views (pixels of the map across) are seldom confident, and slow."""
MAX_START_OFF_M, START_SIGMAS = 3000.0, 3.0
"""A start farther off the map than this distance and so many deviations ends the program."""


def runner(options: argparse.Namespace, stopping: threading.Event, stack: ExitStack) -> Runner:
    return _Setup(options, stopping, stack).runner()


class _Setup:
    """Makes the parts of one flight; `stack` closes them."""

    def __init__(
        self, options: argparse.Namespace, stopping: threading.Event, stack: ExitStack
    ) -> None:
        self.options, self.stopping, self.stack = options, stopping, stack
        self.clocks = Clocks()
        self.console = Console(sys.stderr, self.clocks, quiet=options.quiet)
        stack.callback(self.console.close)
        stack.enter_context(self.console.in_place_of_stderr())
        self.opened = _opened(options)
        self.digest = self.opened.manifest.sha256
        self.localizer = Localizer(self.opened, plan=search_plan(options))
        self.link = _link(options, self.clocks)
        self.fly = self._fly_options()

    def runner(self) -> Runner:
        options, newest = self.options, NewestImage()
        source, graph = self._source()
        for line in plan_lines(options, self.opened, self.fly.accept):
            self.console.say(line)
        camera = _camera(options) or source.wait_for_camera()
        if options.mask is not None:
            camera = masked(camera, options.mask)
        self.console.say(camera_line(options, camera))
        gnss = None if options.gnss == "off" else self._gnss(camera, source)
        publisher = self._publisher(newest, graph)
        if self.link is not None:
            self.stack.callback(LinkThread(self.link).stop)
        sink = _sink(options, camera, self.digest)
        if sink is not None and options.ros2:
            source.log_gnss = sink.gnss  # messages as received
        elif sink is not None and gnss is not None:
            gnss.log = sink.gnss
        self.stack.callback(read_in_thread(newest, source, self.stopping))
        return Runner(
            newest,
            camera,
            self._locator,
            publisher,
            replace(self.fly, min_agl_m=self._min_agl_m(camera)),
            link=self.link,
            sink=sink,
            gnss=gnss,
            latency=_latency(options, heading_known=self.fly.heading_known),
        )

    def _fly_options(self) -> FlyOptions:
        options = self.options
        take_off = tuple(options.start) if options.start else None
        heights = map_heights(self.opened, take_off=take_off)
        only_amsl = set(options.height or ()) == {"amsl"}
        if heights is not None and not heights.datum_known and only_amsl:
            raise UsageError(
                "--height amsl needs the height of the ground above the sea, and the vertical "
                f"datum of the map's terrain is unknown: {DATUM_ADVICE}"
            )
        mount = read_mount(options.mount) if options.mount else None
        return FlyOptions(
            mount_deg=tuple(options.mount_deg),
            mount=mount,
            heights=heights,
            heading_known=options.heading == "known",
            recorded=options.ros2 or options.recorded_telemetry,
            accept=acceptance(options),
            map_change=self.opened.change,
            start=start_of(options, self.clocks, self.localizer),
            state_path=options.state,
            logged_options=_logged_options(options, mount),
        )

    @property
    def _min_sent(self) -> float:
        """Confidence of positions that are sent; an alert limit replaces it."""
        return 0.0 if self.options.alert_limit_m else self.fly.min_confidence

    def _min_agl_m(self, camera: Camera) -> float:
        """On the ground a dry run shows what it would do in flight."""
        if self.options.dry_run:
            return 0.0
        return MIN_VIEW_PX * self.localizer.grid.gsd_m / math.sqrt(math.prod(camera.extent))

    def _locator(self) -> Locator:
        mount = self.fly.mount
        model = model_of(mount) if mount else None
        tracker = Tracker(self.localizer, heading_known=self.fly.heading_known, model=model)
        return MountCorrected(tracker, mount) if mount else tracker

    def _source(self) -> "tuple[Any, Ros2Publisher | None]":
        """Source of the images, and the publisher of a ROS 2 graph."""
        options = self.options
        if options.ros2:
            return self._ros2()
        if cameras.is_live(options.source):
            camera = _camera(options)
            size_px = None if camera is None else (camera.width_px, camera.height_px)
            name = cameras.live_name(options.source)
            return cameras.LiveCamera(name, self.clocks, size_px=size_px), None
        if not options.pace > 0:
            raise UsageError("--pace must be above 0")
        path = Path(options.source)
        if self.link is not None and path.is_dir() and not options.recorded_telemetry:
            due_ns = cameras.autopilot_pace(self.link.boot_ns, self.clocks, options.pace)
        else:  # a video has no times of an autopilot
            due_ns = cameras.own_pace(self.clocks, options.pace)
        images = cameras.recorded_images(path)
        return cameras.Playback(images, due_ns, self.clocks, self.stopping.is_set), None

    def _ros2(self) -> "tuple[Any, Ros2Publisher]":
        """Reader and publisher of a new node. The centre of the map is the origin of the ROS map
        frame unless `--origin` is given."""
        from orthonav.onboard.ros2.node import Node, Rosout
        from orthonav.onboard.ros2.publisher import Ros2Publisher
        from orthonav.onboard.ros2.reader import Ros2Reader

        options = self.options
        node = Node(options.ros_args, os.environ.get("ROS_DISTRO", ""))
        self.stack.callback(node.close)
        if "--disable-rosout-logs" not in options.ros_args:
            rosout, logger = Rosout(node), logging.getLogger("orthonav")
            logger.addHandler(rosout)
            self.stack.callback(logger.removeHandler, rosout)
        reader = Ros2Reader(
            node,
            TelemetryBuffer(heights=options.height or HEIGHT_SOURCES),
            self.clocks,
            self.stopping.is_set,
            mount_deg=self.fly.mount_deg,
        )
        origin = options.origin
        publisher = Ros2Publisher(
            node,
            LocalFrame(*origin[:2]) if origin else self.localizer.sheet.frame,
            reader.now_ns,
            origin_alt_m=origin[2] if origin else math.nan,
            min_std_m=options.min_std_m,
            silent=options.dry_run,
        )
        reader.report_wait = lambda why: publisher.health(
            {"health": "FAILED", "reasons": ["no_camera"], "waiting": why}
        )
        return reader, publisher

    def _publisher(self, newest: NewestImage, graph: "Ros2Publisher | None") -> outputs.Publisher:
        options, clocks, link = self.options, self.clocks, self.link
        rules = GateRules(self._min_sent, min_interval_s=_intervals_s(options))
        if options.alert_limit_m:
            rules = replace(rules, max_std_m=math.inf, alert_limit_m=options.alert_limit_m)
        gate = Gate(rules)
        messenger = None
        if link is not None:
            messenger = outputs.Messenger(
                *(gate, link, clocks),
                kinds=_kinds(options),
                gps_id=_gps_id(options),
                min_std_m=options.min_std_m,
                origin=Origin(*options.origin) if options.origin else None,
            )
        # ROS 2 names what it waits for itself.
        wanted = None if options.ros2 else f"images from {options.source}"
        narrator = Narrator(
            *(self.console, clocks, newest, wanted, link, options.autopilot),
            sends=not options.dry_run and (link is not None or graph is not None),
        )
        nmea, lines = _opened_outputs(options, self.digest)
        return outputs.Publisher(
            gate,
            clocks,
            messenger=messenger,
            nmea=nmea,
            lines=[*lines, narrator],
            graph=graph,
            min_std_m=options.min_std_m,
        )

    def _gnss(self, camera: Camera, source: Any) -> GnssWatch:
        """GNSS monitor over the solutions that are received, or over `gnss.csv` of the flight
        folder. After a change of camera, mount or latency, what that adds is learnt again."""
        options, clocks = self.options, self.clocks
        recorded = options.recorded_telemetry and not options.ros2
        if recorded:
            recording = read_gnss(Path(options.source) / FILE)
            solutions = deque(sorted(recording, key=lambda each: each.arrived_ns))
        else:
            heard: Any = source if options.ros2 else self.link  # one of them: see `fly._check`
            solutions = heard.gnss
        used = camera, options.mount_deg, self.fly.mount, _stated(options.camera_latency_ms)
        return GnssWatch(
            self.localizer.sheet.frame,
            solutions,
            digest=self.digest,
            known=state.learnt_biases(options.state) if options.state else {},
            reference=_interrupted(options, self.digest, clocks),
            setup=hashlib.sha256(repr(used).encode()).hexdigest()[:16],
            recorded=recorded,
            min_confidence=self.fly.min_confidence,
            utc_ahead_ns=lambda: 0 if recorded else clocks.utc_ns() - clocks.mono_ns(),
        )


def _opened(options: argparse.Namespace) -> MapFile:
    signature = checked_signature(options)
    opened = open_map(options.map, signature.manifest_sha256 if signature else None)
    if signature is not None and options.state is not None:
        state.require_newest(options.state, signature, options.map)
    return opened


def _sink(options: argparse.Namespace, camera: Camera, digest: str) -> "FlightLog | None":
    if options.log is None:
        return None
    needed("mcap", "autopilot", "a flight log")
    from orthonav.onboard.log import FlightLog  # only where it is asked for

    info = {"name": options.map.name, "manifest_sha256": digest}
    most = None if options.log_max_mb is None else round(options.log_max_mb * 1e6)
    return FlightLog(options.log, camera, info, views=options.log_views, max_bytes=most)


def _latency(options: argparse.Namespace, *, heading_known: bool) -> LatencyMonitor | None:
    """Monitor of the latency of a live camera; None for recordings and ROS, which have times."""
    if options.ros2 or not cameras.is_live(options.source):
        return None
    stated = _stated(options.camera_latency_ms)
    return LatencyMonitor(
        None if stated is None else stated.latency_ms / 1e3,
        MIN_STD_S if stated is None else stated.std_ms / 1e3,
        mount_deg=tuple(options.mount_deg),
        heading_known=heading_known,
    )


def _stated(text: str | None) -> CameraLatency | None:
    if text is None:
        return None
    try:
        stated = CameraLatency(float(text), MIN_STD_S * 1e3)
    except ValueError:
        return read_latency(Path(text))
    if not 0 <= stated.latency_ms <= MOST_MS:
        raise UsageError(f"--camera-latency-ms must be 0 to {MOST_MS:g}, got {text}")
    return stated


def _camera(options: argparse.Namespace) -> Camera | None:
    if options.camera is not None:
        return read_camera_file(options.camera)
    if options.ros2:
        return None
    path = Path(options.source) / "flight.json"
    if not path.is_file():
        raise CameraError(f"no camera calibration: give --camera FILE, or a flight folder: {path}")
    return read_camera(path)[0]


def _link(options: argparse.Namespace, clocks: Clocks) -> AutopilotLink | None:
    if options.autopilot is None:
        return None
    return AutopilotLink(
        transport_opener(options.autopilot),
        TelemetryBuffer(heights=options.height or HEIGHT_SOURCES),
        clocks,
        system_id=options.system_id,
        signing=_signing(options, clocks),
        silent=options.dry_run,
        own_receiver=_gps_id(options) if "gps-input" in _kinds(options) else None,
    )


def _signing(options: argparse.Namespace, clocks: Clocks) -> Signing | None:
    if options.signing_key is None:
        return None
    key = require_file(options.signing_key, "signing key").read_bytes()
    text = key.strip()
    if len(key) != 32 and len(text) == 64:
        try:
            key = bytes.fromhex(text.decode("ascii"))
        except ValueError:
            raise UsageError(
                f"signing key: expected 32 bytes or 64 hexadecimal digits: {options.signing_key}"
            ) from None
    saved = state.load(options.state) if options.state else None
    stamp = signing_timestamp(clocks.utc_ns())
    return Signing(key, max(stamp, saved.signing_timestamp_10us + 1 if saved else 0))


def _kinds(options: argparse.Namespace) -> tuple[str, ...]:
    asked = options.send or ["global-position"]
    return tuple(dict.fromkeys(each.partition(":")[0] for each in asked))


def _gps_id(options: argparse.Namespace) -> int:
    return max((int(each.partition(":")[2] or 0) for each in options.send or ()), default=0)


def _opened_outputs(
    options: argparse.Namespace, digest: str
) -> tuple[list[outputs.NmeaOut], list[outputs.JsonOut]]:
    quality = Quality.AUTONOMOUS if options.nmea_as_gps else Quality.ESTIMATED
    try:
        nmea = [outputs.NmeaOut(outputs.sink_opener(url), quality=quality) for url in options.nmea]
        lines = [
            outputs.JsonOut(None if each == "-" else Path(each), identity=Identity(digest))
            for each in options.jsonl
        ]
    except OSError as error:
        raise OutputError(f"output cannot be opened: {error}") from error
    return nmea, lines


def _intervals_s(options: argparse.Namespace) -> dict[str, float]:
    rate_hz = options.send_rate_hz
    if rate_hz is None:
        return {}
    if not rate_hz > 0:
        raise UsageError("--send-rate-hz must be above 0")
    local = [outputs.KINDS[kind] for kind in _kinds(options) if kind in outputs.LOCAL]
    if local and rate_hz * outputs.PX4_VISION_S <= 1:
        log.warning(
            f"PX4 fuses {' and '.join(local)} only at more than {1 / outputs.PX4_VISION_S:g} Hz, "
            f"got {rate_hz:g} Hz: send global-position to PX4, or raise the rate"
        )
    return dict.fromkeys([*outputs.KINDS.values(), "NMEA", "ROS2"], 1 / rate_hz)


def _logged_options(options: argparse.Namespace, mount: Mount | None) -> dict[str, Any]:
    """Options for a replay, and the command line; the contents of a key file are never logged."""
    line = {
        name: [str(each) for each in value] if isinstance(value, list | tuple) else str(value)
        for name, value in vars(options).items()
        if value is not None
    }
    return {
        "heading": options.heading,
        "prior": "telemetry",
        "accept": None,
        "alert_limit_m": options.alert_limit_m,
        "mask": None if options.mask is None else str(options.mask),
        "risk": options.risk,
        "track": True,
        "mount": None if mount is None else asdict(mount),
        "fly": line,
    }


def plan_lines(options: argparse.Namespace, opened: MapFile, accept: Acceptance) -> list[str]:
    sheet, area_km2 = opened.manifest.sheets[0], opened.manifest.area_km2
    terrain, ground = sheet.terrain, "level ground"
    if terrain is not None:
        ground = f"terrain of {terrain.low_m:.0f} to {terrain.high_m:.0f} m"
        ground += " with houses and trees" if sheet.surface is not None else ""
    recorded = f"recorded telemetry of {options.source}" if options.recorded_telemetry else None
    telemetry = ", ".join(each for each in (options.autopilot, recorded) if each)
    sent = [outputs.KINDS[kind] for kind in _kinds(options)] if options.autopilot else []
    sent += ["ROS 2 topics"] if options.ros2 else []
    if options.dry_run and sent:
        sent = ["nothing to the autopilot (--dry-run)"]
    sent += [f"NMEA to {url}" for url in options.nmea]
    sent += [f"JSON lines to {'stdout' if each == '-' else each}" for each in options.jsonl]
    confident = f"; positions of {accept.text()}"
    start = "anywhere on the map"
    if options.start:
        lat_deg, lon_deg, std_m = options.start
        start = f"{lat_deg:.6f}, {lon_deg:.6f} +- {std_m:g} m"
    if options.state is not None:
        start = f"position saved in {options.state}, if it is recent, else {start}"
    lines = [
        f"map: {options.map}, {area_km2:.2f} km2, {sheet.grid.gsd_m:g} m per pixel, {ground}",
        f"autopilot: {'telemetry from ROS 2' if options.ros2 else telemetry}",
        f"sends: {', '.join(sent) + confident if sent else 'nothing'}",
        f"start: {start}",
        f"GNSS: {'not used' if options.gnss == 'off' else options.gnss}",
    ]
    if options.log is not None:
        lines.append(f"log: {options.log}, views: {options.log_views}")
    return lines


def camera_line(options: argparse.Namespace, camera: Camera) -> str:
    """Size and field of view, without distortion, of the camera, and where its images come from."""
    fisheye = camera.model == "fisheye"
    angles = [each if fisheye else 2 * math.atan(each / 2) for each in camera.extent]
    width_deg, height_deg = map(math.degrees, angles)
    size = f"{camera.width_px}x{camera.height_px} px, {width_deg:.0f} x {height_deg:.0f} deg"
    given = options.camera or ("camera_info" if options.ros2 else "flight.json")
    source, pace = "ROS 2" if options.ros2 else str(options.source), ""
    if not options.ros2 and not cameras.is_live(source):
        pace = ", played" if options.pace == 1 else f", played at {options.pace:g} times real time"
    return f"camera: {size} ({given}); images from {source}{pace}"


def _interrupted(options: argparse.Namespace, digest: str, clocks: Clocks) -> Biases | None:
    """Reference of the flight that this one continues: its last position is recent, or of unknown
    age because a clock was set back."""
    saved = state.load(options.state) if options.state else None
    if saved is None:
        return None
    age_s = saved.age_s(clocks.utc_ns(), clocks.mono_ns(), state.boot_id())
    if age_s > state.MAX_AGE_S:
        return None
    return state.reference_biases(options.state, digest)


def start_of(
    options: argparse.Namespace, clocks: Clocks, localizer: Localizer
) -> Callable[[], Prior | None]:
    """Gives the first prior: a recent saved position, but once only, else `--start`, else None."""
    given = given_start(options, localizer)
    saved = [state.load(options.state)] if options.state else []

    def prior() -> Prior | None:
        last = saved.pop() if saved else None
        if last is None:
            return given
        age_s = last.age_s(clocks.utc_ns(), clocks.mono_ns(), state.boot_id())
        return state.prior_of(last, age_s) or given

    return prior


def given_start(options: argparse.Namespace, localizer: Localizer) -> Prior | None:
    if not options.start:
        return None
    start, place = Prior.known(*options.start), options.start[:2]
    if start is None or abs(start.lon_deg) > 180 or start.std_m == 0:
        raise UsageError(
            "--start needs a latitude of -90 to 90, a longitude of -180 to 180 and a standard "
            f"deviation above 0 m, got {','.join(f'{value:g}' for value in options.start)}"
            f"{swapped_hint(*place)}"
        )
    far_m, hint = distance_from_map(place, localizer)
    most_m = MAX_START_OFF_M + START_SIGMAS * start.std_m
    if far_m > most_m:
        raise UsageError(
            f"--start is {far_m / 1000:,.1f} km from the map, more than {MAX_START_OFF_M / 1000:g} "
            f"km and {START_SIGMAS:g} times its deviation; check the map and the position{hint}"
        )
    if far_m > FAR_M:
        log.warning("%s", far_text("--start is", far_m, hint))
    return start
