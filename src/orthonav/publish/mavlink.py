"""MAVLink 2 messages that autopilots fuse: global positions, and how they become bytes.

Every field is filled as the definitions in pymavlink's `common.xml` say, and what is not known as
they say it is marked; docs/autopilots.md lists each one and how PX4 and ArduPilot read it. Values
beyond a field's range are cut off at its end, never wrapped round. Nothing here sends: a message
is made by a function, bytes by `Packer`, and `orthonav.publish.gate` says what may go out.

pymavlink (extra `autopilot`) is loaded when the first message is made.
"""

import math
from dataclasses import dataclass, field
from typing import Any

from orthonav.errors import MissingExtraError
from orthonav.extras import needed
from orthonav.publish.estimate import (
    Clock,
    EstimateError,
    NavigationEstimate,
    error_ellipse,
)
from orthonav.publish.gpstime import gps_time
from orthonav.records import CONFIDENT

Message = Any
"""A `MAVLink_message` of pymavlink, which brings no types."""
COMPONENT_ID = 197
"""MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY: a camera that tells where it is."""
WRAP_S = 250.0
"""Where the float of `transmission_time` begins again: 10 us of resolution, says its definition."""
UNKNOWN_DOP = 65535.0
_INT32_MAX, _UINT16_MAX = 2**31 - 1, 2**16 - 1
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
_CMD_EXTERNAL_POSITION_ESTIMATE = 43003


@dataclass(frozen=True)
class Target:
    """Which autopilot is meant; 0 stands for all."""

    system_id: int = 1
    component_id: int = 1


AUTOPILOT = Target()
"""The first component of the first system, as autopilots are set up unless told otherwise."""


@dataclass(frozen=True)
class Signing:
    """MAVLink 2 message signing: the shared key, and what makes every signature new.

    `secret_key` is 32 bytes. `timestamp_10us` counts in tens of microseconds since 2015-01-01 and
    must never go back for a link and a key (see `signing_timestamp`); every message adds one.
    Raises `EstimateError` for a key of another length or numbers out of range.
    """

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
    """Makes bytes of messages, one sequence number after the other. Mutable; one per link.

    The same messages in the same order give the same bytes. `sequence` is the number of the first
    message, 0 to 255. Raises `MissingExtraError` where pymavlink is not installed.
    """

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
                raise EstimateError(f"a {name} that sends has an id of 1 to 255, got {value}")
        self._mav = dialect().MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self._mav.seq = sequence % 256
        if signing is not None:
            self._mav.signing.secret_key = signing.secret_key
            self._mav.signing.link_id = signing.link_id
            self._mav.signing.timestamp = signing.timestamp_10us
            self._mav.signing.sign_outgoing = True

    def pack(self, message: Message) -> bytes:
        """The frame of one message, MAVLink 2, signed where that was asked for."""
        frame = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame


def global_position_sensor(
    estimate: NavigationEstimate,
    *,
    clock: Clock = Clock.UTC,
    sensor_id: int = 1,
    target: Target = AUTOPILOT,
    min_std_m: float = 0.0,
    min_confidence: float = CONFIDENT,
) -> Message:
    """GLOBAL_POSITION_SENSOR (message 296): a position from map matching, at the time it was sent.

    An estimate that is not sure is UNHEALTHY and says no position and no accuracy either, because
    there are receivers that do not read the flag. `sensor_id` is 1 to 255 (PX4 takes 0 as "off").
    """
    if not 1 <= sensor_id <= 255:
        raise EstimateError(f"sensor_id must be 1 to 255, got {sensor_id}")
    confident = estimate.is_confident(min_confidence)
    return dialect().MAVLink_global_position_sensor_message(
        target_system=target.system_id,
        target_component=target.component_id,
        id=sensor_id,
        time_usec=microseconds(estimate.sent_ns(clock)),
        processing_time=clamped(estimate.processing_s * 1e6, 0, _UINT32_MAX),
        source=_SOURCE_VISION,
        flags=0 if confident else _UNHEALTHY,
        lat=deg_e7(estimate.lat_deg) if confident else _INT32_MAX,
        lon=deg_e7(estimate.lon_deg) if confident else _INT32_MAX,
        alt_ellipsoid=math.nan,
        alt=float32(estimate.alt_amsl_m),
        eph=float32(estimate.horizontal_std_m(min_std_m)) if confident else math.nan,
        epv=float32(estimate.alt_std_m) if math.isfinite(estimate.alt_amsl_m) else math.nan,
    )


def gps_input(
    estimate: NavigationEstimate,
    *,
    clock: Clock = Clock.UTC,
    gps_id: int = 0,
    satellites: int = 0,
    hdop_m: float | None = None,
    send_yaw: bool = False,
    min_std_m: float = 0.0,
    min_confidence: float = CONFIDENT,
) -> Message:
    """GPS_INPUT (message 232): the position in the clothes of a GPS receiver, stamped at exposure.

    What is not known is marked in `ignore_flags` and sent as 0: always the vertical velocity,
    altitude and speed accuracy unless the estimate has them. `fix_type` is 3 where the estimate is
    sure, else 1 with all fields ignored. `satellites` is told as it is given: 0 is the truth, and
    some checks refuse it. With `hdop_m`, metres per unit, a dilution of precision is made up of the
    horizontal accuracy; else it is ignored. `send_yaw` tells the heading as that of the vehicle:
    right only where the top of the image is its nose.
    """
    confident = estimate.is_confident(min_confidence)
    eph_m = estimate.horizontal_std_m(min_std_m)
    speed_std_mps = _speed_std_mps(estimate)
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
        yaw=_yaw_cdeg(estimate.heading_deg) if send_yaw and confident else 0,
    )


def external_position_estimate(
    estimate: NavigationEstimate,
    *,
    clock: Clock = Clock.UTC,
    target: Target = AUTOPILOT,
    min_std_m: float = 0.0,
    min_confidence: float = CONFIDENT,
) -> Message:
    """MAV_CMD_EXTERNAL_POSITION_ESTIMATE (43003) as COMMAND_INT: a single fix while dead reckoning.

    `transmission_time` is the time of sending, begun again every `WRAP_S`. Raises `EstimateError`
    where the estimate is not sure: the command has no way to say so.
    """
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
        param3=float32(estimate.horizontal_std_m(min_std_m)),
        param4=0.0,
        x=deg_e7(estimate.lat_deg),
        y=deg_e7(estimate.lon_deg),
        z=math.nan,
    )


def require_confident(estimate: NavigationEstimate, min_confidence: float, message: str) -> None:
    """Raise `EstimateError` unless the estimate is sure: `message` cannot say "no position"."""
    if not estimate.is_confident(min_confidence):
        raise EstimateError(
            f"{message} has no way to say that a position is not sure (confidence "
            f"{estimate.confidence:.3g}, state {estimate.state}, standard deviation "
            f"{estimate.horizontal_std_m():.3g} m): do not send it"
        )


def dialect() -> Any:
    """pymavlink's `common` dialect. Raises `MissingExtraError` where it is missing or too old."""
    module = needed("pymavlink.dialects.v20.common", "autopilot", "sending to an autopilot")
    if not hasattr(module, "MAVLink_global_position_sensor_message"):
        raise MissingExtraError(
            "this pymavlink does not know GLOBAL_POSITION_SENSOR: "
            "pip install --upgrade 'orthonav[autopilot]'"
        )
    return module


def deg_e7(degrees: float) -> int:
    """An angle in 1e-7 degrees, to the nearest."""
    return round(degrees * 1e7)


def microseconds(time_ns: int) -> int:
    """Whole microseconds of a time, cut off at what 64 bits without sign hold."""
    return min(max(time_ns // 1000, 0), _UINT64_MAX)


def clamped(value: float, low: int, high: int) -> int:
    """The nearest whole number of `value`, not below `low` nor above `high`."""
    return round(min(max(value, low), high))


def float32(value: float) -> float:
    """`value` as far as a float of 32 bits reaches; NaN where it is not finite: not known."""
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


def _speed_std_mps(estimate: NavigationEstimate) -> float:
    return math.nan if estimate.vel_cov_en is None else error_ellipse(estimate.vel_cov_en)[0]


def _hdop(eph_m: float, hdop_m: float | None) -> float:
    """Of the accuracy, at most 99.99: ArduPilot keeps hundredths in 16 bits."""
    if hdop_m is None:
        return UNKNOWN_DOP
    if not hdop_m > 0:
        raise EstimateError(f"hdop_m must be metres per unit, above 0, got {hdop_m}")
    return min(eph_m / hdop_m, 99.99)


def _yaw_cdeg(heading_deg: float) -> int:
    """Hundredths of degrees with north as 36000, for 0 stands for "not available"."""
    if not math.isfinite(heading_deg):
        return 0
    return round(heading_deg * 100) % 36000 or 36000
