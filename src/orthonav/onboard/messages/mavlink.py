"""MAVLink 2 messages of positions that autopilots fuse, and their encoding.

Fields and marks of unknown values are those of `common.xml`; docs/autopilots.md lists each field
and how PX4 and ArduPilot read it. Values out of range are clamped, never wrapped. pymavlink (extra
`autopilot`) is loaded with the first message.

Height, attitude and vertical velocity of messages in the autopilot's local frame are its own
(`LocalPose`), sent back to complete them; its filter must fuse the horizontal position only.
"""

import math
from dataclasses import dataclass, field
from enum import Enum, IntFlag
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MissingExtraError
from orthonav.core.extras import needed
from orthonav.core.geo.attitude import matrices_of_wxyz, wxyz_of_angles
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.records import error_ellipse
from orthonav.onboard.messages.estimate import EstimateError, NavigationEstimate

Message = Any
"""A `MAVLink_message` of pymavlink, which has no types."""
MAX_TEXT = 50
"""Characters of one STATUSTEXT."""
LEAP_S, LEAP_UNIX_S = 18, 1_483_228_800
"""GPS time minus UTC, and since when: a new leap second (IERS Bulletin C) changes both."""


class _Ignore(IntFlag):
    """GPS_INPUT_IGNORE_FLAGS (common.xml)."""

    ALT = 1
    HDOP = 2
    VDOP = 4
    VEL_HORIZ = 8
    VEL_VERT = 16
    SPEED_ACCURACY = 32
    HORIZ_ACCURACY = 64
    VERT_ACCURACY = 128


@dataclass(frozen=True)
class Target:
    """Addressed autopilot; 0 addresses all."""

    system_id: int = 1
    component_id: int = 1


AUTOPILOT = Target()
"""First component of the first system: the default of autopilots."""


@dataclass(frozen=True)
class Signing:
    """Key and state of MAVLink 2 message signing. `timestamp_10us`, since 2015-01-01, must
    increase with every message of a key, also after a restart."""

    secret_key: bytes = field(repr=False)
    timestamp_10us: int

    def __post_init__(self) -> None:
        if len(self.secret_key) != 32:
            raise EstimateError(f"a signing key has 32 bytes, got {len(self.secret_key)}")
        if not 0 <= self.timestamp_10us < 2**48:
            raise EstimateError(f"signing needs a timestamp of 48 bits, got {self.timestamp_10us}")


def signing_timestamp(utc_ns: int) -> int:
    """Tens of microseconds since 2015-01-01 of a time in ns since 1970, UTC; 0 before."""
    epoch_unix_s = 1_420_070_400  # 2015-01-01
    return max(utc_ns // 10_000 - epoch_unix_s * 100_000, 0)


class Packer:
    """Encodes messages, numbered from `sequence` on. Mutable; one per link."""

    def __init__(
        self,
        system_id: int = 1,
        component_id: int = 197,  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
        *,
        sequence: int = 0,
        signing: Signing | None = None,
    ) -> None:
        self._mav = dialect().MAVLink(None, srcComponent=component_id)
        self._mav.seq = sequence % 256
        if not 1 <= component_id <= 255:
            raise EstimateError(f"the component id must be 1 to 255, got {component_id}")
        self.set_system(system_id)
        if signing is not None:
            self._mav.signing.secret_key = signing.secret_key
            self._mav.signing.timestamp = signing.timestamp_10us
            self._mav.signing.sign_outgoing = True

    def set_system(self, system_id: int) -> None:
        if not 1 <= system_id <= 255:
            raise EstimateError(f"the system id must be 1 to 255, got {system_id}")
        self._mav.srcSystem = system_id

    @property
    def timestamp_10us(self) -> int:
        """That of the next signature."""
        return int(self._mav.signing.timestamp)

    def pack(self, message: Message, utc_ns: int = 0) -> bytes:
        """The frame; `utc_ns`: time that the timestamps of signatures follow."""
        signing = self._mav.signing
        signing.timestamp = max(signing.timestamp, signing_timestamp(utc_ns))
        frame = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame


def global_position_sensor(estimate: NavigationEstimate, *, target: Target = AUTOPILOT) -> Message:
    """GLOBAL_POSITION_SENSOR (message 296): a position from map matching, stamped at sending.

    Raises `EstimateError` for an estimate of low confidence or without accuracy: PX4 reads no
    flag, takes coordinates that mean "unknown" for a place, and an unknown accuracy for a good one.
    """
    estimate.require_confident("GLOBAL_POSITION_SENSOR")
    eph_m = estimate.horizontal_std_m()
    if math.isnan(eph_m):
        raise EstimateError("GLOBAL_POSITION_SENSOR needs the accuracy of the position")
    alt_m = estimate.alt_amsl_m
    return _made(
        dialect().MAVLink_global_position_sensor_message,
        target_system=target.system_id,
        target_component=target.component_id,
        id=1,  # that of EKF2_AGP0_ID
        time_usec=microseconds(estimate.sent_ns),
        processing_time=clamped(estimate.processing_s * 1e6, 0, 2**32 - 1),
        source=2,  # vision
        flags=0,
        lat=deg_e7(estimate.lat_deg),
        lon=deg_e7(estimate.lon_deg),
        alt_ellipsoid=math.nan,
        alt=alt_m,
        eph=eph_m,
        epv=estimate.alt_std_m if math.isfinite(alt_m) else math.nan,
    )


def gps_input(estimate: NavigationEstimate, *, gps_id: int = 0) -> Message:
    """GPS_INPUT (message 232): the position as that of a GPS receiver, stamped at exposure.

    Unknown values are marked in `ignore_flags` and sent as 0: the vertical velocity and dilutions
    of precision always, altitude and speed accuracy unless the estimate has them. `fix_type` is 3
    for a confident estimate, else 1 with all fields ignored. There are 0 satellites.
    """
    confident, alt_std_m = estimate.is_confident, estimate.alt_std_m
    speed_std_mps, east_north = math.nan, estimate.vel_en_mps or (math.nan, math.nan)
    if estimate.vel_cov_en is not None:
        speed_std_mps = error_ellipse(estimate.vel_cov_en)[0]
    alt_known, moves = math.isfinite(estimate.alt_amsl_m), all(map(math.isfinite, east_north))
    known = {
        _Ignore.ALT: alt_known,
        _Ignore.HDOP | _Ignore.VDOP | _Ignore.VEL_VERT: False,
        _Ignore.VEL_HORIZ: moves,
        _Ignore.SPEED_ACCURACY: moves and math.isfinite(speed_std_mps),
        _Ignore.HORIZ_ACCURACY: True,
        _Ignore.VERT_ACCURACY: alt_known and math.isfinite(alt_std_m),
    }
    flags = sum(bits for bits, is_known in known.items() if not (confident and is_known))
    week, week_ms = gps_time(estimate.stamp_ns)

    def unless(bit: _Ignore, value: float) -> float:
        return 0.0 if flags & bit else value

    return _made(
        dialect().MAVLink_gps_input_message,
        time_usec=microseconds(estimate.stamp_ns),
        gps_id=clamped(gps_id, 0, 255),
        ignore_flags=flags,
        time_week_ms=week_ms,
        time_week=clamped(week, 0, 2**16 - 1),
        fix_type=3 if confident else 1,
        lat=deg_e7(estimate.lat_deg) if confident else 0,
        lon=deg_e7(estimate.lon_deg) if confident else 0,
        alt=unless(_Ignore.ALT, estimate.alt_amsl_m),
        hdop=65535.0,
        vdop=65535.0,
        vn=unless(_Ignore.VEL_HORIZ, east_north[1]),
        ve=unless(_Ignore.VEL_HORIZ, east_north[0]),
        vd=0.0,
        speed_accuracy=unless(_Ignore.SPEED_ACCURACY, speed_std_mps),
        horiz_accuracy=unless(_Ignore.HORIZ_ACCURACY, estimate.horizontal_std_m()),
        vert_accuracy=unless(_Ignore.VERT_ACCURACY, alt_std_m),
        satellites_visible=0,
        yaw=0,  # the camera need not point forward
    )


def external_position_estimate(
    estimate: NavigationEstimate, *, target: Target = AUTOPILOT
) -> Message:
    """MAV_CMD_EXTERNAL_POSITION_ESTIMATE (43003) as COMMAND_INT: a single fix while dead reckoning.
    Raises `EstimateError` for an estimate of low confidence, which it cannot mark."""
    estimate.require_confident("MAV_CMD_EXTERNAL_POSITION_ESTIMATE")
    wrapped_ns = estimate.sent_ns % (250 * 10**9)  # by the definition of the field
    return _made(
        dialect().MAVLink_command_int_message,
        target_system=target.system_id,
        target_component=target.component_id,
        frame=0,  # global
        command=43003,
        current=0,
        autocontinue=0,
        param1=wrapped_ns / 1e9,
        param2=max(estimate.processing_s, 0.0),
        param3=estimate.horizontal_std_m(),
        param4=0.0,
        x=deg_e7(estimate.lat_deg),
        y=deg_e7(estimate.lon_deg),
        z=math.nan,
    )


def request_message(number: int, target: Target = AUTOPILOT) -> Message:
    """MAV_CMD_REQUEST_MESSAGE (512) as COMMAND_LONG: send the message `number` once."""
    address = target.system_id, target.component_id
    return dialect().MAVLink_command_long_message(*address, 512, 0, number, *[0.0] * 6)


def status_texts(severity: int, text: str, number: int) -> list[Message]:
    """STATUSTEXT (message 253), in several chunks where the text is longer than one.

    `severity`: MAV_SEVERITY. `number`: differs between texts that follow one another. A chunk that
    is not full ends a text, so one of 50 characters is followed by an empty chunk.
    """
    data = text.encode("ascii", "replace")
    make = dialect().MAVLink_statustext_message
    if len(data) <= MAX_TEXT:
        return [make(severity, data)]
    starts = range(0, len(data) + 1, MAX_TEXT)
    identity = number % (2**16 - 1) + 1  # 0 marks a single chunk
    return [make(severity, data[at : at + MAX_TEXT], identity, at // MAX_TEXT) for at in starts]


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
    return min(max(time_ns // 1000, 0), 2**64 - 1)


def clamped(value: float, low: int, high: int) -> int:
    return round(min(max(value, low), high))


def _made(kind: Any, **values: Any) -> Message:
    """A message of `kind`, its floats clamped to 32 bits; NaN ("not known") where not finite."""
    largest = (2 - 2**-23) * 2.0**127

    def float32(value: float) -> float:
        return min(max(value, -largest), largest) if math.isfinite(value) else math.nan

    for name, value in values.items():
        if isinstance(value, float):
            values[name] = float32(value)
        elif isinstance(value, list):
            values[name] = [float32(each) for each in value]
    return kind(**values)


def gps_time(utc_ns: int) -> tuple[int, int]:
    """GPS week (without rollover) and time of week in ms; (0, 0), not known, before 2017."""
    if utc_ns < LEAP_UNIX_S * 10**9:  # a computer whose clock was not set
        return 0, 0
    epoch_unix_s = 315_964_800  # 1980-01-06
    return divmod(utc_ns // 1_000_000 + 1000 * (LEAP_S - epoch_unix_s), 7 * 86_400_000)


# In the local frame of the autopilot.

_NAN3 = (math.nan, math.nan, math.nan)
Triple = tuple[float, float, float]
Array = NDArray[np.float64]


class Autopilot(Enum):
    PX4 = "px4"
    ARDUPILOT = "ardupilot"


KINDS = {3: Autopilot.ARDUPILOT, 12: Autopilot.PX4}
NO_AUTOPILOT, DOWNWARD = 8, 25
"""MAV_AUTOPILOT_INVALID, MAV_SENSOR_ROTATION_PITCH_270."""


def is_of_autopilot(heartbeat: Message) -> bool:
    """Whether an autopilot sends it; some gimbals and cameras name one as theirs."""
    return heartbeat.autopilot != NO_AUTOPILOT and heartbeat.type not in (26, 30)


def is_height(sensor: Message) -> bool:
    """Whether a DISTANCE_SENSOR measures downward, within its limits."""
    within = sensor.min_distance < sensor.current_distance < sensor.max_distance
    valid = within and getattr(sensor, "signal_quality", 0) != 1  # invalid
    return bool(valid and sensor.orientation == DOWNWARD)


def repeats_height(position: Message) -> bool:
    """Whether both heights of GLOBAL_POSITION_INT are one: PX4 without a home repeats that above
    the sea, ArduPilot without an altitude by GNSS counts that from its start."""
    return bool(abs(position.relative_alt - position.alt) <= 50)  # mm


@dataclass(frozen=True)
class Origin:
    """Origin of an autopilot's local frame (WGS84, m above mean sea level)."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float

    def __post_init__(self) -> None:
        placed = abs(self.lat_deg) <= 90 and abs(self.lon_deg) <= 180
        if not (placed and math.isfinite(self.alt_amsl_m)):
            raise EstimateError(
                f"an origin needs latitude, longitude and altitude, got {self.lat_deg}, "
                f"{self.lon_deg}, {self.alt_amsl_m}{swapped_hint(self.lat_deg, self.lon_deg)}"
            )


@dataclass(frozen=True)
class LocalPose:
    """State that the autopilot reported for the exposure, in its local frame. NaN: not known."""

    origin: Origin
    down_m: float = math.nan  # below the origin; needed where the estimate has no altitude
    down_std_m: float = math.nan
    attitude_rad: Triple = _NAN3  # roll, pitch, yaw of the body from NED (rotations ZYX)
    attitude_std_rad: Triple = _NAN3
    vel_down_mps: float = math.nan
    vel_down_std_mps: float = math.nan


def odometry(estimate: NavigationEstimate, pose: LocalPose, autopilot: Autopilot) -> Message:
    """ODOMETRY (message 331) as `autopilot` reads it, stamped at exposure.

    PX4: pose and velocity in MAV_FRAME_LOCAL_NED; attitude and velocity are NaN where not known.
    ArduPilot: MAV_FRAME_LOCAL_FRD with its x axis north and the velocity in MAV_FRAME_BODY_FRD, the
    only pair that it accepts; it always reads attitude and velocity, so they must be known.
    `quality` is the confidence in per cent. Raises `EstimateError`.
    """
    estimate.require_confident("ODOMETRY")
    position, variance = _position(estimate, pose, autopilot, "ODOMETRY")
    east, north = estimate.vel_en_mps or (math.nan, math.nan)
    velocity = np.array([north, east, pose.vel_down_mps])
    frames, velocity_cov = (1, 1), _velocity_covariance(estimate, pose)  # MAV_FRAME_LOCAL_NED
    if autopilot is Autopilot.ARDUPILOT:
        body_from_ned = matrices_of_wxyz(wxyz_of_angles(pose.attitude_rad[::-1])).T
        frames = 20, 12  # MAV_FRAME_LOCAL_FRD, MAV_FRAME_BODY_FRD
        velocity = body_from_ned @ velocity
        velocity_cov = body_from_ned @ velocity_cov @ body_from_ned.T
        if not np.isfinite(velocity).all():
            raise EstimateError(
                "ODOMETRY to ArduPilot needs attitude and velocity, and they are not all known: "
                "send VISION_POSITION_ESTIMATE"
            )
    return _made(
        dialect().MAVLink_odometry_message,
        time_usec=microseconds(estimate.stamp_ns),
        frame_id=frames[0],
        child_frame_id=frames[1],
        **dict(zip("xyz", position, strict=True)),
        q=wxyz_of_angles(pose.attitude_rad[::-1]).tolist(),
        **dict(zip(("vx", "vy", "vz"), velocity.tolist(), strict=True)),
        rollspeed=math.nan,
        pitchspeed=math.nan,
        yawspeed=math.nan,
        pose_covariance=_triangle(variance, pose.attitude_std_rad),
        velocity_covariance=_triangle(velocity_cov, _NAN3),
        reset_counter=estimate.reset_counter,
        estimator_type=2,  # vision
        quality=clamped(estimate.confidence * 100, 1, 100),
    )


def vision_position_estimate(
    estimate: NavigationEstimate, pose: LocalPose, autopilot: Autopilot
) -> Message:
    """VISION_POSITION_ESTIMATE (message 102): north, east, down and attitude, stamped at exposure.

    Raises `EstimateError` where height or attitude is not known, or for a low confidence.
    """
    estimate.require_confident("VISION_POSITION_ESTIMATE")
    position, variance = _position(estimate, pose, autopilot, "this message")
    if not all(map(math.isfinite, pose.attitude_rad)):
        raise EstimateError("VISION_POSITION_ESTIMATE needs the attitude of the autopilot")
    return _made(
        dialect().MAVLink_vision_position_estimate_message,
        usec=microseconds(estimate.stamp_ns),
        **dict(zip("xyz", position, strict=True)),
        **dict(zip(("roll", "pitch", "yaw"), pose.attitude_rad, strict=True)),
        covariance=_triangle(variance, pose.attitude_std_rad),
        reset_counter=estimate.reset_counter,
    )


def set_gps_global_origin(origin: Origin, *, target_system: int = 1) -> Message:
    """SET_GPS_GLOBAL_ORIGIN (message 48), which autopilots accept once. PX4 refuses system 0."""
    return dialect().MAVLink_set_gps_global_origin_message(
        target_system=target_system,
        latitude=deg_e7(origin.lat_deg),
        longitude=deg_e7(origin.lon_deg),
        altitude=clamped(origin.alt_amsl_m * 1000, -(2**31), 2**31 - 1),
        time_usec=0,
    )


def _position(
    estimate: NavigationEstimate, pose: LocalPose, autopilot: Autopilot, message: str
) -> tuple[Triple, Array]:
    """North, east, down in metres and their covariance (3, 3), all known.

    ArduPilot makes one standard deviation of it, the root of the sum of the three variances: each
    is a third, so that this is the horizontal one. Older versions take the cube root of the sum of
    their squares, which is not smaller (`GCS_MAVLink/GCS_Common.cpp`).
    """
    north, east = north_east_m(pose.origin, estimate.lat_deg, estimate.lon_deg, autopilot)
    down, down_std = pose.origin.alt_amsl_m - estimate.alt_amsl_m, estimate.alt_std_m
    if not math.isfinite(down):
        down, down_std = pose.down_m, pose.down_std_m
    if not (math.isfinite(down) and math.isfinite(down_std)):
        raise EstimateError(
            f"{message} needs the autopilot's height and its standard deviation; without them "
            "receivers drop the position or its accuracy"
        )
    if autopilot is Autopilot.ARDUPILOT:
        return (north, east, down), np.eye(3) * (estimate.horizontal_std_m() ** 2 / 3)
    variance = np.zeros((3, 3))
    variance[:2, :2] = estimate.cov_en_m2[::-1, ::-1]
    variance[2, 2] = down_std**2
    return (north, east, down), variance


def _velocity_covariance(estimate: NavigationEstimate, pose: LocalPose) -> Array:
    cov = np.full((3, 3), math.nan)
    if estimate.vel_cov_en is not None and math.isfinite(pose.vel_down_std_mps):
        cov[:] = 0.0
        cov[:2, :2] = estimate.vel_cov_en[::-1, ::-1]
        cov[2, 2] = pose.vel_down_std_mps**2
    return cov


def _triangle(upper: Array, lower_std: Triple) -> list[float]:
    """Upper right triangle, by rows, of a (6, 6) covariance: `upper` (3, 3), then three
    independent values; all NaN where the first is not known, as the definition requires."""
    cov = np.zeros((6, 6))
    cov[:3, :3] = upper
    cov[3:, 3:] = np.diag(np.square(lower_std))
    if not math.isfinite(cov[0, 0]):
        cov[:] = math.nan
    return list(cov[np.triu_indices(6)].tolist())


def north_east_m(
    origin: Origin, lat_deg: float, lon_deg: float, autopilot: Autopilot
) -> tuple[float, float]:
    """Metres north and east of `origin` that `autopilot` converts to this position.

    PX4 converts metres on an azimuthal-equidistant plane of a sphere of 6371 km
    (`src/lib/geo/geo.cpp`), ArduPilot by a constant per degree (`AP_Common/Location.cpp`): 10 km
    from the origin, true metres would become positions up to 67 m away.
    """
    if autopilot is Autopilot.PX4:
        return _px4(origin, lat_deg, lon_deg)
    turned_deg = (lon_deg - origin.lon_deg + 180.0) % 360.0 - 180.0
    scale = max(math.cos(math.radians((lat_deg + origin.lat_deg) / 2)), 0.01)  # near the poles
    m_per_deg = 0.011131884502145034 * 1e7
    return (lat_deg - origin.lat_deg) * m_per_deg, turned_deg * m_per_deg * scale


def _px4(origin: Origin, lat_deg: float, lon_deg: float) -> tuple[float, float]:
    """Azimuthal-equidistant projection of a sphere; atan2 is also accurate near zero."""
    lat, lat0 = math.radians(lat_deg), math.radians(origin.lat_deg)
    turned = math.radians(lon_deg - origin.lon_deg)
    north = math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(turned)
    east = math.cos(lat) * math.sin(turned)
    along = math.sin(lat0) * math.sin(lat) + math.cos(lat0) * math.cos(lat) * math.cos(turned)
    across = math.hypot(north, east)
    radius_m = 6_371_000.0 * (math.atan2(across, along) / across if across > 0 else 1.0)
    return north * radius_m, east * radius_m
