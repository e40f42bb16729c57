"""MAVLink 2 messages of global positions that autopilots fuse, and their encoding.

Fields and marks of unknown values are those of `common.xml`; docs/autopilots.md lists each field
and how PX4 and ArduPilot read it. Values out of range are clamped, never wrapped. pymavlink (extra
`autopilot`) is loaded with the first message.
"""

import math
from bisect import bisect_right
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from orthonav.core.errors import MissingExtraError
from orthonav.core.extras import needed
from orthonav.core.records import CONFIDENT, error_ellipse
from orthonav.onboard.messages.estimate import (
    Clock,
    EstimateError,
    NavigationEstimate,
)

Message = Any
"""A `MAVLink_message` of pymavlink, which has no types."""
COMPONENT_ID = 197
"""MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY (common.xml)."""
WRAP_S = 250.0
"""Period of `transmission_time`, by its definition in common.xml."""
UNKNOWN_DOP = 65535.0
_UINT16_MAX = 2**16 - 1
_UINT32_MAX, _UINT64_MAX = 2**32 - 1, 2**64 - 1
_FLOAT32_MAX = (2 - 2**-23) * 2.0**127
_SIGNING_EPOCH_UNIX_S = 1_420_070_400  # 2015-01-01
_SOURCE_VISION = 2
_UNHEALTHY = 1
_NO_FIX, _FIX_3D = 1, 3
_IGNORE_ALT, _IGNORE_HDOP, _IGNORE_VDOP = 1, 2, 4
_IGNORE_VEL_HORIZ, _IGNORE_VEL_VERT, _IGNORE_SPEED_ACC = 8, 16, 32
_IGNORE_HORIZ_ACC, _IGNORE_VERT_ACC = 64, 128
_IGNORE_ALL = 255
_FRAME_GLOBAL = 0
_CMD_EXTERNAL_POSITION_ESTIMATE, _CMD_REQUEST_MESSAGE = 43003, 512
TEXT_MAX = 50
"""Characters of one STATUSTEXT."""
_LEAPS = (
    *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01"),
    *("1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01"),
    *("1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
)
"""Days that began after a leap second, by IERS Bulletin C; a new one must be added. GPS time
equalled UTC on 1980-01-06 and has none."""


@dataclass(frozen=True)
class Target:
    """Addressed autopilot; 0 addresses all."""

    system_id: int = 1
    component_id: int = 1


AUTOPILOT = Target()
"""First component of the first system: the default of autopilots."""


@dataclass(frozen=True)
class Signing:
    """Key and state of MAVLink 2 message signing. `timestamp_10us`, since 2015-01-01, must never
    decrease for a link and a key; it grows by one with every message."""

    secret_key: bytes = field(repr=False)
    timestamp_10us: int
    link_id: int = 0

    def __post_init__(self) -> None:
        if len(self.secret_key) != 32:
            raise EstimateError(f"a signing key has 32 bytes, got {len(self.secret_key)}")
        if not (0 <= self.timestamp_10us < 2**48 and 0 <= self.link_id <= 255):
            raise EstimateError(
                f"signing needs a timestamp of 48 bits and a link of 8, "
                f"got {self.timestamp_10us} and {self.link_id}"
            )


def signing_timestamp(utc_ns: int) -> int:
    """Tens of microseconds since 2015-01-01 of a time in ns since 1970, UTC; 0 before."""
    return max(utc_ns // 10_000 - _SIGNING_EPOCH_UNIX_S * 100_000, 0)


class Packer:
    """Encodes messages, numbered from `sequence` on. Mutable; one per link."""

    def __init__(
        self,
        system_id: int = 1,
        component_id: int = COMPONENT_ID,
        *,
        sequence: int = 0,
        signing: Signing | None = None,
    ) -> None:
        for name, value in (("system", system_id), ("component", component_id)):
            if not 1 <= value <= 255:
                raise EstimateError(f"the {name} id must be 1 to 255, got {value}")
        self._mav = dialect().MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self._mav.seq = sequence % 256
        if signing is not None:
            self._mav.signing.secret_key = signing.secret_key
            self._mav.signing.link_id = signing.link_id
            self._mav.signing.timestamp = signing.timestamp_10us
            self._mav.signing.sign_outgoing = True

    def pack(self, message: Message) -> bytes:
        frame = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame


def global_position_sensor(
    estimate: NavigationEstimate,
    *,
    clock: Clock = Clock.UTC,
    sensor_id: int = 1,
    target: Target = AUTOPILOT,
    min_confidence: float = CONFIDENT,
) -> Message:
    """GLOBAL_POSITION_SENSOR (message 296): a position from map matching, stamped at sending.

    A dead-reckoned estimate is UNHEALTHY. `sensor_id` is 1 to 255 (PX4 reads 0 as "off"). Raises
    `EstimateError` for an estimate of low confidence or without accuracy: PX4 reads no flag, takes
    coordinates that mean "unknown" for a place, and an unknown accuracy for a good one.
    """
    if not 1 <= sensor_id <= 255:
        raise EstimateError(f"sensor_id must be 1 to 255, got {sensor_id}")
    if not estimate.dead_reckoned:
        require_confident(estimate, min_confidence, "GLOBAL_POSITION_SENSOR")
    eph_m = estimate.horizontal_std_m()
    if math.isnan(eph_m):
        raise EstimateError("GLOBAL_POSITION_SENSOR needs the accuracy of the position")
    return dialect().MAVLink_global_position_sensor_message(
        target_system=target.system_id,
        target_component=target.component_id,
        id=sensor_id,
        time_usec=microseconds(estimate.sent_ns(clock)),
        processing_time=clamped(estimate.processing_s * 1e6, 0, _UINT32_MAX),
        source=_SOURCE_VISION,
        flags=_UNHEALTHY if estimate.dead_reckoned else 0,
        lat=deg_e7(estimate.lat_deg),
        lon=deg_e7(estimate.lon_deg),
        alt_ellipsoid=math.nan,
        alt=float32(estimate.alt_amsl_m),
        eph=float32(eph_m),
        epv=float32(estimate.alt_std_m) if math.isfinite(estimate.alt_amsl_m) else math.nan,
    )


def gps_input(
    estimate: NavigationEstimate,
    *,
    clock: Clock = Clock.UTC,
    gps_id: int = 0,
    satellites: int = 0,
    hdop_m: float | None = None,
    min_confidence: float = CONFIDENT,
) -> Message:
    """GPS_INPUT (message 232): the position as that of a GPS receiver, stamped at exposure.

    Unknown values are marked in `ignore_flags` and sent as 0: the vertical velocity always,
    altitude and speed accuracy unless the estimate has them. `fix_type` is 3 for a confident
    estimate, else 1 with all fields ignored. `satellites`: 0 is true, but some checks refuse it.
    `hdop_m`: metres of standard deviation per unit of HDOP; None: HDOP is ignored.
    """
    confident = estimate.is_confident(min_confidence)
    eph_m = estimate.horizontal_std_m()
    vel_cov = estimate.vel_cov_en
    speed_std_mps = math.nan if vel_cov is None else error_ellipse(vel_cov)[0]
    flags = _ignored(estimate, speed_std_mps, hdop_m) if confident else _IGNORE_ALL
    week, week_ms = (0, 0) if estimate.utc_ns is None else gps_time(estimate.utc_ns)
    vel_east, vel_north = estimate.vel_en_mps or (0.0, 0.0)

    def unless(bit: int, value: float, ignored: float = 0.0) -> float:
        return ignored if flags & bit else float32(value)

    return dialect().MAVLink_gps_input_message(
        time_usec=microseconds(estimate.exposed_ns(clock)),
        gps_id=clamped(gps_id, 0, 255),
        ignore_flags=flags,
        time_week_ms=week_ms,
        time_week=clamped(week, 0, _UINT16_MAX),
        fix_type=_FIX_3D if confident else _NO_FIX,
        lat=deg_e7(estimate.lat_deg) if confident else 0,
        lon=deg_e7(estimate.lon_deg) if confident else 0,
        alt=unless(_IGNORE_ALT, estimate.alt_amsl_m),
        hdop=unless(_IGNORE_HDOP, _hdop(eph_m, hdop_m), UNKNOWN_DOP),
        vdop=UNKNOWN_DOP,
        vn=unless(_IGNORE_VEL_HORIZ, vel_north),
        ve=unless(_IGNORE_VEL_HORIZ, vel_east),
        vd=0.0,
        speed_accuracy=unless(_IGNORE_SPEED_ACC, speed_std_mps),
        horiz_accuracy=unless(_IGNORE_HORIZ_ACC, eph_m),
        vert_accuracy=unless(_IGNORE_VERT_ACC, estimate.alt_std_m),
        satellites_visible=clamped(satellites, 0, 255),
        yaw=0,  # the camera need not point forward
    )


def external_position_estimate(
    estimate: NavigationEstimate,
    *,
    clock: Clock = Clock.UTC,
    target: Target = AUTOPILOT,
    min_confidence: float = CONFIDENT,
) -> Message:
    """MAV_CMD_EXTERNAL_POSITION_ESTIMATE (43003) as COMMAND_INT: a single fix while dead reckoning.
    Raises `EstimateError` for an estimate of low confidence, which it cannot mark."""
    require_confident(estimate, min_confidence, "MAV_CMD_EXTERNAL_POSITION_ESTIMATE")
    wrapped_ns = estimate.sent_ns(clock) % round(WRAP_S * 1e9)
    return dialect().MAVLink_command_int_message(
        target_system=target.system_id,
        target_component=target.component_id,
        frame=_FRAME_GLOBAL,
        command=_CMD_EXTERNAL_POSITION_ESTIMATE,
        current=0,
        autocontinue=0,
        param1=float32(wrapped_ns / 1e9),
        param2=float32(max(estimate.processing_s, 0.0)),
        param3=float32(estimate.horizontal_std_m()),
        param4=0.0,
        x=deg_e7(estimate.lat_deg),
        y=deg_e7(estimate.lon_deg),
        z=math.nan,
    )


def request_message(number: int, target: Target = AUTOPILOT) -> Message:
    """MAV_CMD_REQUEST_MESSAGE (512) as COMMAND_LONG: send the message `number` once."""
    return dialect().MAVLink_command_long_message(
        target.system_id,
        target.component_id,
        _CMD_REQUEST_MESSAGE,
        0,
        *(float(number), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    )


def status_texts(severity: int, text: str, number: int) -> list[Message]:
    """STATUSTEXT (message 253), in several chunks where the text is longer than one.

    `severity`: MAV_SEVERITY. `number`: differs between texts that follow one another. A chunk that
    is not full ends a text, so one of 50 characters is followed by an empty chunk.
    """
    data = text.encode("ascii", "replace")
    make = dialect().MAVLink_statustext_message
    if len(data) <= TEXT_MAX:
        return [make(severity, data)]
    starts = range(0, len(data) + 1, TEXT_MAX)
    identity = number % _UINT16_MAX + 1  # 0 marks a single chunk
    return [make(severity, data[at : at + TEXT_MAX], identity, at // TEXT_MAX) for at in starts]


def require_confident(estimate: NavigationEstimate, min_confidence: float, message: str) -> None:
    """Raise `EstimateError` unless the estimate is confident, as `message` cannot mark it."""
    if not estimate.is_confident(min_confidence):
        raise EstimateError(
            f"{message} cannot mark a position of low confidence (confidence "
            f"{estimate.confidence:.3g}, state {estimate.state}, standard deviation "
            f"{estimate.horizontal_std_m():.3g} m): do not send it"
        )


def dialect() -> Any:
    """pymavlink's `common` dialect. Raises `MissingExtraError` where it is missing or too old."""
    module = needed("pymavlink.dialects.v20.common", "autopilot", "sending to an autopilot")
    if not hasattr(module, "MAVLink_global_position_sensor_message"):
        raise MissingExtraError(
            "this version of pymavlink lacks GLOBAL_POSITION_SENSOR: "
            "pip install --upgrade 'orthonav[autopilot]'"
        )
    return module


def deg_e7(degrees: float) -> int:
    return round(degrees * 1e7)


def microseconds(time_ns: int) -> int:
    """Time in whole microseconds, clamped to 64 bits without sign."""
    return min(max(time_ns // 1000, 0), _UINT64_MAX)


def clamped(value: float, low: int, high: int) -> int:
    return round(min(max(value, low), high))


def float32(value: float) -> float:
    """`value` clamped to the range of a 32-bit float; NaN ("not known") where it is not finite."""
    if not math.isfinite(value):
        return math.nan
    return min(max(value, -_FLOAT32_MAX), _FLOAT32_MAX)


def _ignored(estimate: NavigationEstimate, speed_std_mps: float, hdop_m: float | None) -> int:
    flags = _IGNORE_VDOP | _IGNORE_VEL_VERT
    flags |= 0 if math.isfinite(estimate.alt_amsl_m) else _IGNORE_ALT | _IGNORE_VERT_ACC
    flags |= 0 if math.isfinite(estimate.alt_std_m) else _IGNORE_VERT_ACC
    flags |= 0 if hdop_m is not None else _IGNORE_HDOP
    known = estimate.vel_en_mps is not None and all(map(math.isfinite, estimate.vel_en_mps))
    flags |= 0 if known else _IGNORE_VEL_HORIZ | _IGNORE_SPEED_ACC
    return flags | (0 if math.isfinite(speed_std_mps) else _IGNORE_SPEED_ACC)


def _hdop(eph_m: float, hdop_m: float | None) -> float:
    """HDOP of a standard deviation, at most 99.99: ArduPilot stores hundredths in 16 bits."""
    if hdop_m is None:
        return UNKNOWN_DOP
    if not hdop_m > 0:
        raise EstimateError(f"hdop_m must be metres per unit, above 0, got {hdop_m}")
    return min(eph_m / hdop_m, 99.99)


def _unix_s(day: str) -> int:
    return int(datetime.fromisoformat(day).replace(tzinfo=UTC).timestamp())


_LEAPS_UNIX_S = tuple(_unix_s(day) for day in _LEAPS)
_EPOCH_UNIX_S = _unix_s("1980-01-06")
_WEEK_MS = 7 * 86_400_000


def gps_time(utc_ns: int) -> tuple[int, int]:
    """GPS week (without rollover) and time of week in ms; (0, 0), not known, before 1980-01-06."""
    utc_ms = utc_ns // 1_000_000
    leaps = bisect_right(_LEAPS_UNIX_S, utc_ms // 1000)
    since_epoch_ms = utc_ms - _EPOCH_UNIX_S * 1000 + leaps * 1000
    if since_epoch_ms < 0:
        return 0, 0
    return divmod(since_epoch_ms, _WEEK_MS)
