"""Outputs of positions: MAVLink messages to the autopilot, NMEA sentences, lines of JSON."""

import contextlib
import errno
import json
import logging
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from orthonav.core.errors import VariantError
from orthonav.core.flight.fixes import UNKNOWN, Identity, result_to_json
from orthonav.core.records import ViewResult
from orthonav.onboard.link import AutopilotLink
from orthonav.onboard.messages.estimate import (
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
from orthonav.onboard.messages.nmea import Quality, sentences
from orthonav.onboard.ports import Transport, Udp, device_baud, host_port, open_serial
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
DOWN_STD_M = 3.0
"""Sent with the autopilot's own height: assumed."""
PX4_VISION_S = 0.2
"""PX4 starts to fuse local messages only at shorter intervals (`EV_MAX_INTERVAL`)."""


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
        gps_id: int = 0,
        min_std_m: float = 0.0,
        origin: Origin | None = None,
    ) -> None:
        """`kinds`: keys of `KINDS`. `gps_id`: of GPS_INPUT. `origin`: of the local frame, set on
        the ground where the autopilot has none."""
        self._gate, self._link, self._clocks = gate, link, clocks
        self._kinds, self._gps_id, self._own_origin = kinds, gps_id, origin
        self._covariance = FilterCovariance(min_std_m)
        self.incomplete = self.too_slow = 0
        self._said: set[str] = set()
        self._origin_due_ns = self._requests = 0

    def publish(
        self, estimate: NavigationEstimate, vehicle: VehicleState, exposed_ns: int
    ) -> tuple[tuple[str, ...], str | None]:
        """Names of the messages sent, and why the first of the others was not; None without."""
        why = {kind: self._send(kind, estimate, vehicle, exposed_ns) for kind in self._kinds}
        sent = tuple(KINDS[kind] for kind, reason in why.items() if reason is None)
        return sent, next((reason for reason in why.values() if reason), None)

    def _send(
        self, kind: str, estimate: NavigationEstimate, vehicle: VehicleState, exposed_ns: int
    ) -> str | None:
        """Why a message was not sent: "" where the link did not take it; None where it was."""
        name, now_ns = KINDS[kind], self._clocks.mono_ns()
        stamped = replace(estimate, processing_s=(now_ns - exposed_ns) / 1e9)
        stated = self._covariance.prepare(kind, stamped, exposed_ns)
        try:
            made = self._make(kind, stated, vehicle)
        except EstimateError as error:
            self.incomplete += 1
            why = f"{name} cannot be made: {error}"
            if why not in self._said and len(self._said) < 20:
                self._said.add(why)
                log.warning("%s", why)
            return self._gate.withhold(f"not_made:{name}").reason
        if not self._gate.due(name, now_ns):
            return f"rate:{name}"
        if not self._link.send(made):
            return ""
        self._gate.sent[name] += 1
        interval_s = self._covariance.interval_s(kind, exposed_ns)
        self._covariance.sent(kind, exposed_ns)
        if kind in LOCAL and self._link.kind is not Autopilot.ARDUPILOT:
            self.too_slow += PX4_VISION_S <= interval_s < math.inf
        return None

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
        self._origin_due_ns = now_ns + 2 * 10**9
        if origin is not None and link.armed is False and self._requests >= 3:
            link.send(set_gps_global_origin(origin, target_system=link.target.system_id))
        self._requests += link.send(request_message(49, link.target))  # GPS_GLOBAL_ORIGIN

    def _make(self, name: str, estimate: NavigationEstimate, vehicle: VehicleState) -> Message:
        target = self._link.target or AUTOPILOT
        if name == "global-position":
            return global_position_sensor(estimate, target=target)
        if name == "gps-input":
            if math.isfinite(vehicle.amsl_m) and math.isnan(estimate.alt_amsl_m):
                estimate = replace(estimate, alt_amsl_m=vehicle.amsl_m, alt_std_m=DOWN_STD_M)
            return gps_input(estimate, gps_id=self._gps_id)
        if name == "external-position":
            return external_position_estimate(estimate, target=target)
        make = odometry if name == "odometry" else vision_position_estimate
        pose = _pose(vehicle, self._link.origin)
        return make(estimate, pose, self._link.kind or Autopilot.PX4)


def _pose(vehicle: VehicleState, origin: Origin | None) -> LocalPose:
    if origin is None:
        raise EstimateError("the autopilot has not reported the origin of its local frame")
    return LocalPose(
        origin,
        down_m=vehicle.down_m,
        down_std_m=DOWN_STD_M,
        attitude_rad=vehicle.attitude_rad(),
        attitude_std_rad=(math.radians(1.0), math.radians(1.0), math.radians(3.0)),  # assumed
        vel_down_mps=vehicle.velocity_ned_mps[2],
        vel_down_std_mps=0.5,  # assumed
    )


def sink_opener(url: str) -> Callable[[], Transport]:
    """Opener of an output at `udp:HOST:PORT` or `serial:DEVICE:BAUD`. Raises `VariantError`."""
    kind, _, rest = url.partition(":")
    if kind == "udp":
        peer = host_port(rest, url, 10110)
        return lambda: Udp(None, peer)
    if kind == "serial":
        device = device_baud(rest, url)
        return lambda: open_serial(*device)
    raise VariantError(f"expected udp:HOST:PORT or serial:DEVICE:BAUD, got '{url}'")


class NmeaOut:
    """GGA, RMC and GST of every view, including those without a position; after a failure the next
    write opens the port again."""

    def __init__(
        self, opener: Callable[[], Transport], *, quality: Quality = Quality.ESTIMATED
    ) -> None:
        """Raises `OSError` where the port cannot be opened."""
        self._opener, self._quality = opener, quality
        self._port: Transport | None = opener()

    def write(self, estimate: NavigationEstimate | None, utc_ns: int) -> None:
        if self._port is None:
            self._port = self._opener()
        try:
            self._port.write(sentences(estimate, utc_ns, self._quality))
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None


class JsonOut:
    """One line per view as in `fixes.jsonl`, with `age_ms`, `sent` and `withheld`; the health."""

    def __init__(self, path: Path | None, identity: Identity = UNKNOWN) -> None:
        """Append to a file, or write to stdout where `path` is None; the first view states
        `identity`."""
        self._path, self._identity = path, identity
        self._stream: TextIO | None = sys.stdout
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
        min_std_m: float = 0.0,
    ) -> None:
        """`min_std_m`: lower bound of the standard deviation of a fix that `graph` publishes."""
        self.gate, self.clocks, self.messenger = gate, clocks, messenger
        self._nmea, self._lines, self._graph = nmea, lines, graph
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
        sent: tuple[str, ...] = ()
        now_ns = self.clocks.mono_ns()
        ahead_ns = self.clocks.utc_ns() - now_ns
        estimate = None
        if withheld is not None:
            self.gate.withhold(withheld)
        elif judged:
            by_our_clock = replace(result, time_ns=exposed_ns)
            made = estimate_from_result(by_our_clock, utc_ahead_ns=ahead_ns)
            estimate, withheld = self.gate.admit(made, now_ns)
        if estimate is not None:
            if self.messenger is not None:
                sent, withheld = self.messenger.publish(estimate, vehicle, exposed_ns)
            sent_here, rate = self._to_graph(estimate, exposed_ns, vehicle, result.time_ns)
            sent, withheld = sent + sent_here, withheld or rate
        self._write_nmea(estimate, exposed_ns + ahead_ns)
        age_ms = (self.clocks.mono_ns() - exposed_ns) / 1e6
        why = None if sent else withheld
        self._each(self._lines, lambda out: out.view(result, age_ms, sent, why))
        return sent

    def health(self, plain: dict[str, Any]) -> None:
        graph = [] if self._graph is None else [self._graph]
        self._each([*self._lines, *graph], lambda out: out.health(plain))

    def close(self) -> None:
        self._each([*self._nmea, *self._lines], lambda out: out.close())

    def _to_graph(
        self, estimate: NavigationEstimate, exposed_ns: int, vehicle: VehicleState, stamp_ns: int
    ) -> tuple[tuple[str, ...], str | None]:
        """Names of the topics, and why nothing was published there; None without."""
        if self._graph is None:
            return (), None
        if not self.gate.due("ROS2", self.clocks.mono_ns()):
            return (), "rate:ROS2"
        if self._graph.for_filter:
            estimate = self._covariance.prepare("ROS2", estimate, exposed_ns)
        sent: list[str] = []
        self._each(
            [self._graph], lambda out: sent.extend(out.position(estimate, vehicle, stamp_ns))
        )
        self.gate.sent["ROS2"] += bool(sent)
        self._covariance.sent("ROS2", exposed_ns)
        return tuple(sent), None

    def _write_nmea(self, estimate: NavigationEstimate | None, utc_ns: int) -> None:
        # Farther behind, the clock was set back.
        goes_back = 0 < self._nmea_ns - utc_ns <= MAX_AGE_S * 1e9
        if self._nmea and not goes_back and self.gate.due("NMEA", self.clocks.mono_ns()):
            self._nmea_ns = utc_ns
            failed = self.failed
            self._each(self._nmea, lambda out: out.write(estimate, utc_ns))
            self.gate.sent["NMEA"] += self.failed == failed

    def _each(self, outs: Sequence[Any], call: Callable[[Any], None]) -> None:
        for out in outs:
            try:
                call(out)
            except Exception as error:  # one output must not end the others
                if self.failed == 0:
                    log.warning("output failed: %s", error)
                self.failed += 1
