"""The MAVLink connection to an autopilot: telemetry, clock offset, heartbeats, messages."""

import logging
import math
import select
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from orthonav.core.extras import needed
from orthonav.core.flight.gnss import GnssSample
from orthonav.core.geo.attitude import wxyz_of_angles
from orthonav.onboard.messages.estimate import EstimateError
from orthonav.onboard.messages.mavlink import (
    DOWNWARD,
    KINDS,
    NO_AUTOPILOT,
    Autopilot,
    Message,
    Origin,
    Packer,
    Signing,
    Target,
    dialect,
    is_height,
    is_of_autopilot,
    repeats_height,
)
from orthonav.onboard.ports import Transport, retry_s
from orthonav.onboard.telemetry import (
    Aiding,
    Clocks,
    ClockSync,
    TelemetryBuffer,
    VehicleState,
)

log = logging.getLogger(__name__)
INTERVAL_NS = 10**9
"""Between heartbeats and TIMESYNC requests: 1 Hz is what these protocols expect."""
LIMITED_NS = 5 * 10**9
"""RANGEFINDER repeats a DISTANCE_SENSOR that looked down meanwhile."""


class AutopilotLink:
    """Connection to one autopilot. Mutable; thread-safe for the polling thread and the runner."""

    def __init__(
        self,
        opener: Callable[[], Transport],
        buffer: TelemetryBuffer,
        clocks: Clocks,
        *,
        system_id: int | None = None,
        signing: Signing | None = None,
        silent: bool = False,
        own_receiver: int | None = None,
    ) -> None:
        """`system_id`: by default that of the first autopilot heard. `signing`: sign outgoing
        messages and require incoming ones to be signed with the same key. `own_receiver`: number
        of the GNSS receiver that orthonav stands for. Raises `MissingExtraError` where pymavlink is
        missing or old, `EstimateError` for an invalid system id."""
        self._opener, self._clocks = opener, clocks
        self.buffer, self.sync = buffer, ClockSync()
        self.gnss: deque[GnssSample] = deque(maxlen=1000)  # for `orthonav.onboard.gnss`
        self.aiding, self._own_receiver = Aiding(), own_receiver
        self._lock = threading.RLock()
        self._wanted, self._silent = system_id, silent
        self._signing = signing
        self._incoming = _decoder(signing)
        self._transport: Transport | None = None
        self._retry_ns, self._failures = 0, 0
        self.target: Target | None = None
        self.others: list[Target] = []  # heard and not used
        self.kind: Autopilot | None = None
        self.origin: Origin | None = None
        self.armed: bool | None = None
        self.system_status = 1  # MAV_STATE_BOOT
        self.counts: Counter[str] = Counter()
        self._limited_ns = -LIMITED_NS
        self._heard_ns = self._attitude_ns = -math.inf
        self._asked: list[int] = []
        self._due = {"heartbeat": 0, "timesync": 0}
        self._packer = Packer(system_id or 1, signing=signing)

    def poll(self, timeout_s: float = 0.0) -> int:
        """Read, waiting at most `timeout_s`, and send what is due; the number of messages."""
        transport = self._opened()
        if transport is None:
            return 0
        if timeout_s > 0:
            select.select([transport.fileno()], [], [], timeout_s)
        understood = 0
        with self._lock:
            if transport is not self._transport:  # `send` lost it meanwhile
                return 0
            try:
                for _ in range(200):
                    data = transport.read()
                    if not data:
                        break
                    understood += self._take(data, self._clocks.mono_ns())
            except OSError as error:
                self._lost(error)
        self._send_due()
        return understood

    def send(self, message: Message) -> bool:
        """Whether the port took it."""
        with self._lock:
            if self._silent or self._transport is None:
                return False
            try:
                return self._transport.write(self._packer.pack(message, self._clocks.utc_ns()))
            except OSError as error:
                self._lost(error)
                return False

    @property
    def covered_ns(self) -> int | None:
        with self._lock:
            newest = self.buffer.covered_ns
            return None if newest is None else self.sync.mono_ns(newest)

    def state_at(self, exposed_ns: int) -> VehicleState:
        with self._lock:
            boot_ns = self.sync.boot_ns(exposed_ns)
            if boot_ns is None:
                return VehicleState(None)
            vel_std_mps, horizon_std_deg = self.aiding.stds(self._clocks.mono_ns())
            state = self.buffer.at(boot_ns)
            return replace(state, vel_std_mps=vel_std_mps, horizon_std_deg=horizon_std_deg)

    def mean_velocity(self, start_ns: int, end_ns: int) -> tuple[float, float] | None:
        """See `TelemetryBuffer.mean_velocity`; times of our clock."""
        with self._lock:
            start, end = self.sync.boot_ns(start_ns), self.sync.boot_ns(end_ns)
            if start is None or end is None:
                return None
            return self.buffer.mean_velocity(start, end)

    def boot_ns(self, mono_ns: int) -> int | None:
        with self._lock:
            return self.sync.boot_ns(mono_ns)

    @property
    def is_open(self) -> bool:
        return self._transport is not None

    @property
    def heard_age_s(self) -> float:
        """Time since the last message; infinite for "never"."""
        return (self._clocks.mono_ns() - self._heard_ns) / 1e9

    @property
    def attitude_age_s(self) -> float:
        return (self._clocks.mono_ns() - self._attitude_ns) / 1e9

    def signing_now(self) -> int | None:
        with self._lock:
            return None if self._signing is None else self._packer.timestamp_10us

    def close(self) -> None:
        with self._lock:
            if self._transport is not None:
                self._transport.close()
                self._transport = None

    def _opened(self) -> Transport | None:
        if self._transport is not None:
            return self._transport
        now_ns = self._clocks.mono_ns()
        if now_ns < self._retry_ns:
            return None
        try:
            opened = self._opener()
        except OSError as error:
            self._lost(error)
            return None
        with self._lock:
            self._transport, self._failures = opened, 0
        return opened

    def _lost(self, error: OSError) -> None:
        with self._lock:
            if self.counts["error"] == 0 or self._transport is not None:
                log.warning("link to the autopilot: %s", error)
            self.counts["error"] += 1
            self.close()
            pause_s = retry_s(self._failures)
            self._failures += 1
            self._retry_ns = self._clocks.mono_ns() + round(pause_s * 1e9)

    def _take(self, data: bytes, now_ns: int) -> int:
        understood = 0
        try:
            messages = self._incoming.parse_buffer(bytearray(data)) or []
        except Exception as error:  # input is untrusted
            log.debug("incoming data could not be decoded: %s", error)
            self.counts["damaged"] += 1
            signing = self._incoming.signing
            self._incoming = _decoder(self._signing)
            self._incoming.signing = signing
            return 0
        for message in messages:
            if message.get_type() == "BAD_DATA":
                self.counts["damaged"] += 1
            elif self._is_autopilot(message):
                self._heard_ns = now_ns
                if self._transport is not None:
                    self._transport.heard()
                self._dispatch(message, now_ns)
                understood += 1
        return understood

    def _is_autopilot(self, message: Message) -> bool:
        """Whether a message comes from the autopilot; its first heartbeat sets the target."""
        system_id, component_id = message.get_srcSystem(), message.get_srcComponent()
        if self.target is not None and system_id == self.target.system_id:
            return bool(component_id == self.target.component_id)
        if message.get_type() != "HEARTBEAT" or not is_of_autopilot(message) or system_id == 0:
            return False
        heard = Target(system_id, component_id or 1)
        if self.target is not None or self._wanted not in (None, system_id):
            if heard not in self.others and len(self.others) < 10:
                self.others.append(heard)
            return False
        self.target = heard
        self._packer.set_system(system_id)
        self._due = dict.fromkeys(self._due, 0)  # send a heartbeat and TIMESYNC at once
        return True

    def _dispatch(self, message: Message, now_ns: int) -> None:
        handler = _HANDLERS.get(message.get_type())
        if handler is not None:
            self.counts[message.get_type()] += 1
            handler(self, message, now_ns)

    def _timed(self, boot_ms: int, now_ns: int) -> int | None:
        """Time of a message; None far ahead of the clock, where it would hide those that follow."""
        boot_ns = int(boot_ms) * 1_000_000
        if self.sync.heard(now_ns, boot_ns):
            self._restarted()
        expected_ns = self.sync.boot_ns(now_ns)
        is_ahead = expected_ns is not None and boot_ns - expected_ns > self.sync.JUMP_NS
        return None if is_ahead else boot_ns

    def _restarted(self) -> None:
        """Discard what the autopilot reported before its clock jumped: it may have restarted."""
        self.buffer.clear()
        self.origin = None

    def _heartbeat(self, message: Message, now_ns: int) -> None:
        self.kind = KINDS.get(message.autopilot, self.kind)
        self.armed = bool(message.base_mode & 128)

    def _attitude(self, message: Message, now_ns: int) -> None:
        time_ns = self._timed(message.time_boot_ms, now_ns)
        angles = message.yaw, message.pitch, message.roll
        if time_ns is not None and all(map(math.isfinite, angles)):
            self.buffer.add_attitude(time_ns, wxyz_of_angles(angles).tolist())
            self._attitude_ns = now_ns

    def _quaternion(self, message: Message, now_ns: int) -> None:
        time_ns = self._timed(message.time_boot_ms, now_ns)
        if time_ns is not None:
            self.buffer.add_attitude(time_ns, (message.q1, message.q2, message.q3, message.q4))
            self._attitude_ns = now_ns

    def _global_position(self, message: Message, now_ns: int) -> None:
        time_ns = self._timed(message.time_boot_ms, now_ns)
        if time_ns is None:
            return
        home_m, amsl_m = message.relative_alt * 1e-3, message.alt * 1e-3
        same = repeats_height(message)
        if not same or self.kind is Autopilot.ARDUPILOT:
            self.buffer.add_height("home", time_ns, home_m)
        # 0 where the autopilot has no position
        if message.alt != 0 and (not same or self.kind is Autopilot.PX4):
            self.buffer.add_height("amsl", time_ns, amsl_m)

    def _local_position(self, message: Message, now_ns: int) -> None:
        time_ns = self._timed(message.time_boot_ms, now_ns)
        if time_ns is not None:
            self.buffer.add_local(time_ns, (message.vx, message.vy, message.vz), message.z)

    def _altitude(self, message: Message, now_ns: int) -> None:
        """Its timestamp may be UTC instead of time since boot; then the time of arrival is used."""
        arrived_ns, reported_ns = self.sync.boot_ns(now_ns), int(message.time_usec) * 1000
        if arrived_ns is None:
            return
        time_ns = reported_ns if abs(reported_ns - arrived_ns) < 60 * 10**9 else arrived_ns
        # `altitude_terrain` of PX4 is the height of the terrain above its origin, and
        # `bottom_clearance` the one above ground (src/modules/mavlink/streams/ALTITUDE.hpp).
        if message.bottom_clearance > 0:
            self.buffer.add_height("terrain", time_ns, message.bottom_clearance)
        elif message.altitude_terrain > -1000:  # lower values mean "not known" (common.xml)
            self.buffer.add_height("terrain", time_ns, message.altitude_terrain)
        self.buffer.add_height("relative", time_ns, message.altitude_relative)
        # PX4 without an altitude above the sea repeats that of the standard atmosphere.
        if message.altitude_amsl != message.altitude_monotonic:
            self.buffer.add_height("altitude", time_ns, message.altitude_amsl)

    def _distance(self, message: Message, now_ns: int) -> None:
        if message.orientation == DOWNWARD:
            self._limited_ns = now_ns
        if is_height(message):
            time_ns = self._timed(message.time_boot_ms, now_ns)
            if time_ns is not None:
                self.buffer.add_distance(time_ns, message.current_distance * 1e-2)

    def _rangefinder(self, message: Message, now_ns: int) -> None:
        arrived_ns = self.sync.boot_ns(now_ns)
        limited = now_ns - self._limited_ns < LIMITED_NS
        if arrived_ns is not None and message.distance > 0 and not limited:
            self.buffer.add_distance(arrived_ns, message.distance)

    def _system_time(self, message: Message, now_ns: int) -> None:
        self._timed(message.time_boot_ms, now_ns)

    def _origin(self, message: Message, now_ns: int) -> None:
        try:
            self.origin = Origin(
                message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3
            )
        except EstimateError:
            self.counts["damaged"] += 1

    def _filter_status(self, message: Message, now_ns: int) -> None:
        ardupilot = message.get_type() == "EKF_STATUS_REPORT"
        self.aiding.status(message.flags, now_ns, ardupilot=ardupilot)

    def _odometry(self, message: Message, now_ns: int) -> None:
        variance = max(message.velocity_covariance[0], message.velocity_covariance[6])
        self.aiding.velocity(math.sqrt(variance) if variance >= 0 else math.nan, now_ns)

    def _gnss(self, message: Message, now_ns: int) -> None:
        sample = gnss_sample(message, now_ns, self.sync.boot_ns(now_ns))
        if sample.receiver != self._own_receiver:  # which repeats positions by the map
            self.aiding.receiver(sample.fix_type, now_ns)
            self.gnss.append(sample)

    def _timesync(self, message: Message, now_ns: int) -> None:
        if message.tc1 == 0:  # a request: answer with the clock that stamps our messages
            self.send(dialect().MAVLink_timesync_message(self._clocks.utc_ns(), message.ts1))
        elif message.ts1 in self._asked:
            self._asked.remove(message.ts1)
            if self.sync.exchange(message.ts1, now_ns, message.tc1):
                self._restarted()

    def _send_due(self) -> None:
        now_ns = self._clocks.mono_ns()
        with self._lock:
            if now_ns >= self._due["heartbeat"]:
                self._due["heartbeat"] = now_ns + INTERVAL_NS
                onboard_computer = 18, NO_AUTOPILOT, 0, 0, self.system_status, 3
                self.send(dialect().MAVLink_heartbeat_message(*onboard_computer))
            if now_ns >= self._due["timesync"] and self.target is not None:
                self._due["timesync"] = now_ns + INTERVAL_NS
                self._asked = [*self._asked[-4:], now_ns]
                self.send(dialect().MAVLink_timesync_message(0, now_ns))


_HANDLERS: dict[str, Callable[[AutopilotLink, Message, int], None]] = {
    "HEARTBEAT": AutopilotLink._heartbeat,
    "ATTITUDE": AutopilotLink._attitude,
    "ATTITUDE_QUATERNION": AutopilotLink._quaternion,
    "GLOBAL_POSITION_INT": AutopilotLink._global_position,
    "LOCAL_POSITION_NED": AutopilotLink._local_position,
    "ALTITUDE": AutopilotLink._altitude,
    "DISTANCE_SENSOR": AutopilotLink._distance,
    "RANGEFINDER": AutopilotLink._rangefinder,
    "SYSTEM_TIME": AutopilotLink._system_time,
    "GPS_GLOBAL_ORIGIN": AutopilotLink._origin,
    "TIMESYNC": AutopilotLink._timesync,
    "ESTIMATOR_STATUS": AutopilotLink._filter_status,
    "EKF_STATUS_REPORT": AutopilotLink._filter_status,
    "ODOMETRY": AutopilotLink._odometry,
    "GPS_RAW_INT": AutopilotLink._gnss,
    "GPS2_RAW": AutopilotLink._gnss,
}


class LinkThread:
    def __init__(self, link: AutopilotLink) -> None:
        self._link, self._stop = link, threading.Event()
        self._thread = threading.Thread(target=self._run, name="autopilot link", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                if self._link.poll(0.02) == 0 and not self._link.is_open:
                    self._stop.wait(0.1)
            except Exception:  # one malformed message must not end a flight
                log.exception("unexpected error in the link to the autopilot")
                self._stop.wait(0.1)

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(2.0)
        self._link.close()


def _decoder(signing: Signing | None) -> Any:
    """Decoder of incoming messages, of the dialect `ardupilotmega`, which includes RANGEFINDER."""
    module = needed("pymavlink.dialects.v20.ardupilotmega", "autopilot", "a link to an autopilot")
    decoder = module.MAVLink(None)
    decoder.robust_parsing = True
    if signing is None:
        return decoder
    decoder.signing.secret_key = signing.secret_key
    decoder.signing.timestamp = signing.timestamp_10us  # refuse replayed older messages
    original = decoder.check_signature

    def check_signature(*arguments: Any) -> bool:
        # pymavlink stores the timestamp of a message before it checks the signature: one forged
        # message from the future would block the link.
        before = dict(decoder.signing.stream_timestamps)
        valid = bool(original(*arguments))
        if not valid:
            decoder.signing.stream_timestamps = before
        return valid

    decoder.check_signature = check_signature
    return decoder


def gnss_sample(message: Any, arrived_ns: int, arrived_boot_ns: int | None) -> GnssSample:
    """The solution of a GPS_RAW_INT or GPS2_RAW by our clock.

    `arrived_ns`: arrival by our clock; `arrived_boot_ns`: by the autopilot's, None where its offset
    is not known. The time of the solution is its timestamp where that is time since boot, else its
    arrival. `eph` is an HDOP; `h_acc`, an extension, is 0 where it is not known.
    """
    unknown, hdop_std_m = 65535, 3.0
    stamp_ns = int(message.time_usec) * 1000
    late_ns = math.inf if arrived_boot_ns is None else arrived_boot_ns - stamp_ns
    std_m = math.nan if message.eph == unknown else message.eph * 1e-2 * hdop_std_m
    std_m = message.h_acc * 1e-3 if message.h_acc > 0 else std_m
    velocity = None
    if unknown not in (message.vel, message.cog):
        speed, course = message.vel * 1e-2, math.radians(message.cog * 1e-2)
        velocity = speed * math.sin(course), speed * math.cos(course)
    return GnssSample(
        time_ns=arrived_ns - int(late_ns) if abs(late_ns) <= 2 * 10**9 else arrived_ns,
        arrived_ns=arrived_ns,
        lat_deg=message.lat * 1e-7,
        lon_deg=message.lon * 1e-7,
        fix_type=message.fix_type,
        std_m=std_m,
        vel_en_mps=velocity,
        satellites=-1 if message.satellites_visible == 255 else message.satellites_visible,
        stamp_ns=stamp_ns or None,
        receiver=int(message.get_type() == "GPS2_RAW"),
    )
