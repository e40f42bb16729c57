"""Outputs of positions: MAVLink messages to the autopilot, NMEA sentences, lines of JSON."""

import contextlib
import errno
import json
import logging
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TextIO

from orthonav.core.errors import VariantError
from orthonav.core.flight.fixes import UNKNOWN, Identity, result_to_json
from orthonav.core.records import CONFIDENT, ViewResult
from orthonav.onboard.link import AutopilotLink
from orthonav.onboard.messages.estimate import (
    Clock,
    EstimateError,
    FilterCovariance,
    NavigationEstimate,
    estimate_from_result,
)
from orthonav.onboard.messages.gate import MAX_AGE_S, Gate
from orthonav.onboard.messages.mavlink import (
    AUTOPILOT,
    Autopilot,
    LocalPose,
    Message,
    Origin,
    external_position_estimate,
    global_position_sensor,
    gps_input,
    odometry,
    request_message,
    set_gps_global_origin,
    vision_position_estimate,
)
from orthonav.onboard.messages.nmea import Quality, gga, gst, rmc
from orthonav.onboard.ports import Descriptor, Udp, device_baud, host_port, open_serial
from orthonav.onboard.telemetry import Clocks, VehicleState

if TYPE_CHECKING:
    from orthonav.onboard.console import Narrator
    from orthonav.onboard.ros2.publisher import Ros2Publisher

log = logging.getLogger(__name__)
KINDS = {
    "global-position": "GLOBAL_POSITION_SENSOR",
    "gps-input": "GPS_INPUT",
    "odometry": "ODOMETRY",
    "vision": "VISION_POSITION_ESTIMATE",
    "external-position": "EXTERNAL_POSITION_ESTIMATE",
}
LOCAL = ("odometry", "vision")
ATTITUDE_STD_RAD = (math.radians(1.0), math.radians(1.0), math.radians(3.0))
"""Standard deviations sent with the autopilot's own roll, pitch and yaw: assumed."""
DOWN_STD_M, VEL_DOWN_STD_MPS = 3.0, 0.5
"""Standard deviations sent with the autopilot's own height and vertical velocity: assumed."""
PX4_VISION_S = 0.2
"""PX4 starts to fuse local messages only at shorter intervals (`EV_MAX_INTERVAL`)."""
ORIGIN_NS, ORIGIN_REQUESTS = 2 * 10**9, 3
"""Interval of requests for the origin, and their number after which the autopilot has none."""
_GPS_GLOBAL_ORIGIN = 49
_MOST_REASONS = 20


class Messenger:
    """Builds and sends the messages that are due; counts those that are `incomplete`, and local
    ones that are `too_slow` for PX4. Mutable."""

    def __init__(
        self,
        gate: Gate,
        link: AutopilotLink,
        clocks: Clocks,
        *,
        kinds: Sequence[str] = ("global-position",),
        clock: Clock = Clock.UTC,
        sensor_id: int = 1,
        gps: Mapping[str, Any] = MappingProxyType({}),
        min_std_m: float = 0.0,
        min_confidence: float = CONFIDENT,
        origin: Origin | None = None,
    ) -> None:
        """`kinds`: keys of `KINDS`. `gps`: fields of GPS_INPUT (docs/autopilots.md). `origin`: of
        the local frame, set on the ground where the autopilot has none."""
        self._gate, self._link, self._clocks = gate, link, clocks
        self._kinds, self._sensor_id, self._gps, self._own_origin = kinds, sensor_id, gps, origin
        self._common: dict[str, Any] = {"clock": clock, "min_confidence": min_confidence}
        self._covariance = FilterCovariance(min_std_m)
        self.incomplete = self.too_slow = 0
        self._said: set[str] = set()
        self._origin_due_ns = self._requests = 0

    def publish(
        self, estimate: NavigationEstimate, vehicle: VehicleState, exposed_ns: int
    ) -> tuple[str, ...]:
        """Names of the messages sent."""
        sent = []
        boot_ns = self._link.boot_ns(exposed_ns)
        for name in self._kinds:
            if estimate.dead_reckoned and name != "global-position":
                continue  # only this message can mark it
            now_ns = self._clocks.mono_ns()
            stamped = replace(estimate, boot_ns=boot_ns, processing_s=(now_ns - exposed_ns) / 1e9)
            stated = self._covariance.prepare(name, stamped, exposed_ns)
            try:
                made = self._make(name, stated, vehicle)
            except EstimateError as error:
                self._not_made(name, error)
                continue
            if self._gate.due(KINDS[name], now_ns) and self._link.send(made):
                sent.append(KINDS[name])
                interval_s = self._covariance.interval_s(name, exposed_ns)
                self._covariance.sent(name, exposed_ns)
                if name in LOCAL and self._link.kind is not Autopilot.ARDUPILOT:
                    self.too_slow += PX4_VISION_S <= interval_s < math.inf
        return tuple(sent)

    def _not_made(self, name: str, error: EstimateError) -> None:
        """Count a message that could not be built, and log why, once for each reason."""
        self.incomplete += 1
        self._gate.withheld[f"not_made:{KINDS[name]}"] += 1
        why = f"{KINDS[name]} cannot be made: {error}"
        if why not in self._said and len(self._said) < _MOST_REASONS:
            self._said.add(why)
            log.warning("%s", why)

    @property
    def needs_origin(self) -> bool:
        """Whether messages are local, or the autopilot is to start at an origin of ours."""
        return self._own_origin is not None or any(kind in LOCAL for kind in self._kinds)

    def find_origin(self) -> None:
        """Ask for the origin of the local frame until it is known. Where there is none, set our own
        unless armed: an origin that moves in flight moves the aircraft."""
        now_ns, origin, link = self._clocks.mono_ns(), self._own_origin, self._link
        if link.origin is not None:
            self._requests = 0
            return
        if not self.needs_origin or link.target is None or now_ns < self._origin_due_ns:
            return
        self._origin_due_ns = now_ns + ORIGIN_NS
        if origin is not None and link.armed is False and self._requests >= ORIGIN_REQUESTS:
            link.send(set_gps_global_origin(origin, target_system=link.target.system_id))
        self._requests += link.send(request_message(_GPS_GLOBAL_ORIGIN, link.target))

    def _make(self, name: str, estimate: NavigationEstimate, vehicle: VehicleState) -> Message:
        common, target = self._common, self._link.target or AUTOPILOT
        if name == "global-position":
            return global_position_sensor(
                estimate, sensor_id=self._sensor_id, target=target, **common
            )
        if name == "gps-input":
            if math.isfinite(vehicle.amsl_m) and math.isnan(estimate.alt_amsl_m):
                estimate = replace(estimate, alt_amsl_m=vehicle.amsl_m, alt_std_m=DOWN_STD_M)
            return gps_input(estimate, **self._gps, **common)
        if name == "external-position":
            return external_position_estimate(estimate, target=target, **common)
        make = odometry if name == "odometry" else vision_position_estimate
        pose = _pose(vehicle, self._link.origin)
        return make(estimate, pose, self._link.kind or Autopilot.PX4, **common)


def _pose(vehicle: VehicleState, origin: Origin | None) -> LocalPose:
    if origin is None:
        raise EstimateError("the autopilot has not reported the origin of its local frame")
    return LocalPose(
        origin,
        down_m=vehicle.down_m,
        down_std_m=DOWN_STD_M,
        attitude_rad=vehicle.attitude_rad(),
        attitude_std_rad=ATTITUDE_STD_RAD,
        vel_down_mps=vehicle.velocity_ned_mps[2],
        vel_down_std_mps=VEL_DOWN_STD_MPS,
    )


class SerialSink:
    """A serial port; after a failure the next write opens it again."""

    def __init__(self, device: str, baud: int) -> None:
        self._device, self._baud = device, baud
        self._port: Descriptor | None = open_serial(device, baud)

    def write(self, data: bytes) -> None:
        if self._port is None:
            self._port = open_serial(self._device, self._baud)
        try:
            self._port.write(data)
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None


Sink = Udp | SerialSink


def open_sink(url: str) -> Sink:
    """Output at `udp:HOST:PORT` or `serial:DEVICE:BAUD`. Raises `VariantError`, or `OSError` where
    it cannot be opened."""
    kind, _, rest = url.partition(":")
    if kind == "udp":
        return Udp(None, host_port(rest, url, 10110))
    if kind == "serial":
        return SerialSink(*device_baud(rest, url))
    raise VariantError(f"expected udp:HOST:PORT or serial:DEVICE:BAUD, got '{url}'")


class NmeaOut:
    """GGA, RMC and GST of every view to one sink, including those without a position."""

    def __init__(self, sink: Sink, *, quality: Quality = Quality.ESTIMATED) -> None:
        self._sink, self._quality = sink, quality

    def write(
        self, estimate: NavigationEstimate | None, utc_ns: int, min_confidence: float
    ) -> None:
        options: dict[str, Any] = {"utc_ns": utc_ns, "min_confidence": min_confidence}
        sentences = [make(estimate, quality=self._quality, **options) for make in (gga, rmc)]
        self._sink.write(b"".join([*sentences, gst(estimate, **options)]))

    def close(self) -> None:
        self._sink.close()


class JsonOut:
    """One line per view as in `fixes.jsonl`, with `age_ms`, `sent` and `withheld`; the health."""

    def __init__(
        self, path: Path | None, stream: TextIO | None = None, identity: Identity = UNKNOWN
    ) -> None:
        """Append to a file, or write to `stream` (stdout) where `path` is None; the first view
        states `identity`."""
        self._path, self._identity = path, identity
        self._stream: TextIO | None = stream or sys.stdout
        if path is not None:
            self._stream = path.open("a", encoding="ascii")

    def view(
        self, result: ViewResult, age_ms: float, sent: Sequence[str], withheld: str | None
    ) -> None:
        more = {"age_ms": round(age_ms, 3), "sent": list(sent), "withheld": withheld}
        line = result_to_json(result)[:-1] + ", " + json.dumps(more)[1:]
        self._write(self._identity.added_to(line))
        self._identity = UNKNOWN

    def health(self, plain: dict[str, object]) -> None:
        self._write(json.dumps(plain, allow_nan=False))

    def close(self) -> None:
        if self._path is not None and self._stream is not None:
            self._stream.close()

    def _write(self, line: str) -> None:
        if self._stream is None and self._path is not None:  # retry after a full disk
            self._stream = self._path.open("a", encoding="ascii")
            self._stream.write("\n")
        if self._stream is None:
            raise OSError(errno.EPIPE, "the reader of stdout has closed it")
        try:
            self._stream.write(line + "\n")
            self._stream.flush()
        except OSError:
            stream, self._stream = self._stream, None
            if self._path is not None:
                with contextlib.suppress(OSError):  # a full disk: its buffered data are lost
                    stream.close()
            raise


class Publisher:
    def __init__(
        self,
        gate: Gate,
        clocks: Clocks,
        *,
        messenger: Messenger | None = None,
        nmea: Sequence[NmeaOut] = (),
        lines: "Sequence[JsonOut | Narrator]" = (),
        graph: "Ros2Publisher | None" = None,
        min_confidence: float = CONFIDENT,
        min_std_m: float = 0.0,
    ) -> None:
        """`min_std_m`: lower bound of the standard deviation of a fix that `graph` publishes."""
        self.gate, self._clocks = gate, clocks
        self.messenger = messenger
        self._nmea, self._lines, self._least = nmea, lines, min_confidence
        self._graph = [] if graph is None else [graph]
        self._covariance = FilterCovariance(min_std_m)
        self._nmea_ns = 0
        self.failed = 0

    def publish(
        self,
        result: ViewResult,
        exposed_ns: int,
        vehicle: VehicleState,
        *,
        judged: bool,
        withheld: str | None = None,
    ) -> tuple[str, ...]:
        """Send a position that the gate admits; the names of the messages. Only a view that was
        processed (`judged`) gives one: the prediction of a track is not a measurement."""
        estimate: NavigationEstimate | None = None
        sent: tuple[str, ...] = ()
        now_ns = self._clocks.mono_ns()
        ahead_ns = self._clocks.utc_ns() - now_ns
        if withheld is not None:
            self.gate.withheld[withheld] += 1
        elif judged:
            by_our_clock = replace(result, time_ns=exposed_ns)
            made = estimate_from_result(by_our_clock, clock=Clock.BOOT, utc_minus_boot_ns=ahead_ns)
            before = self.gate.withheld.copy()
            estimate = self.gate.admit(made, now_ns)
            if estimate is not None:
                if self.messenger is not None:
                    sent = self.messenger.publish(estimate, vehicle, exposed_ns)
                if not estimate.dead_reckoned:  # messages of ROS cannot mark it
                    sent += self._to_graph(estimate, exposed_ns, vehicle, result.time_ns)
            withheld = None if sent else next(iter(self.gate.withheld - before), None)
        self._write_nmea(estimate, exposed_ns + ahead_ns)
        age_ms = (self._clocks.mono_ns() - exposed_ns) / 1e6
        self._each(self._lines, lambda out: out.view(result, age_ms, sent, withheld))
        return sent

    def health(self, plain: dict[str, Any]) -> None:
        self._each([*self._lines, *self._graph], lambda out: out.health(plain))

    def close(self) -> None:
        self._each([*self._nmea, *self._lines], lambda out: out.close())

    def _to_graph(
        self, estimate: NavigationEstimate, exposed_ns: int, vehicle: VehicleState, stamp_ns: int
    ) -> tuple[str, ...]:
        sent: list[str] = []
        if self._graph and self.gate.due("ROS2", self._clocks.mono_ns()):
            stated = self._covariance.prepare("ROS2", estimate, exposed_ns)
            self._each(
                self._graph,
                lambda out: sent.extend(
                    out.position(stated if out.for_filter else estimate, vehicle, stamp_ns)
                ),
            )
            self._covariance.sent("ROS2", exposed_ns)
        return tuple(sent)

    def _write_nmea(self, estimate: NavigationEstimate | None, utc_ns: int) -> None:
        # Farther behind, the clock was set back.
        goes_back = 0 < self._nmea_ns - utc_ns <= MAX_AGE_S * 1e9
        if self._nmea and not goes_back and self.gate.due("NMEA", self._clocks.mono_ns()):
            self._nmea_ns = utc_ns
            self._each(self._nmea, lambda out: out.write(estimate, utc_ns, self._least))

    def _each(self, outs: Sequence[Any], call: Callable[[Any], None]) -> None:
        for out in outs:
            try:
                call(out)
            except Exception as error:  # one output must not end the others
                if self.failed == 0:
                    log.warning("output failed: %s", error)
                self.failed += 1
