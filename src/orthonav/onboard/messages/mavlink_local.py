"""MAVLink messages in the autopilot's local frame: ODOMETRY, VISION_POSITION_ESTIMATE, its origin.

Height, attitude and vertical velocity are the autopilot's own (`LocalPose`), sent back to complete
the message; its filter must fuse the horizontal position only (docs/autopilots.md).
"""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.attitude import matrices_of_wxyz, wxyz_of_angles
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.records import CONFIDENT
from orthonav.onboard.messages.estimate import Clock, EstimateError, NavigationEstimate
from orthonav.onboard.messages.mavlink import (
    Message,
    clamped,
    deg_e7,
    dialect,
    float32,
    microseconds,
    require_confident,
)

_LOCAL_NED, _BODY_FRD, _LOCAL_FRD = 1, 12, 20
_ESTIMATOR_VISION = 2
_INT32_MIN, _INT32_MAX = -(2**31), 2**31 - 1
_NAN3 = (math.nan, math.nan, math.nan)
Triple = tuple[float, float, float]
Array = NDArray[np.float64]
PX4_RADIUS_M = 6371000.0
ARDUPILOT_M_PER_DEG = 0.011131884502145034 * 1e7
_LEAST_SCALE = 0.01  # ArduPilot's, near the poles


class Autopilot(Enum):
    """Autopilot whose conventions a message in a local frame follows."""

    PX4 = "px4"
    ARDUPILOT = "ardupilot"


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
    """State that the autopilot reported for the exposure, in its local frame. NaN: not known.

    `down_m`, `down_std_m`: below the origin; needed where the estimate has no altitude.
    `attitude_rad`, `attitude_std_rad`: roll, pitch, yaw of the body from NED (rotations ZYX).
    """

    origin: Origin
    down_m: float = math.nan
    down_std_m: float = math.nan
    attitude_rad: Triple = _NAN3
    attitude_std_rad: Triple = _NAN3
    vel_down_mps: float = math.nan
    vel_down_std_mps: float = math.nan


def odometry(
    estimate: NavigationEstimate,
    pose: LocalPose,
    autopilot: Autopilot,
    *,
    clock: Clock = Clock.UTC,
    min_confidence: float = CONFIDENT,
) -> Message:
    """ODOMETRY (message 331) as `autopilot` reads it, stamped at exposure.

    PX4: pose and velocity in MAV_FRAME_LOCAL_NED; attitude and velocity are NaN where not known.
    ArduPilot: MAV_FRAME_LOCAL_FRD with its x axis north and the velocity in MAV_FRAME_BODY_FRD, the
    only pair that it accepts; it always reads attitude and velocity, so they must be known.
    `quality` is the confidence in per cent. Raises `EstimateError`.
    """
    require_confident(estimate, min_confidence, "ODOMETRY")
    position, variance = _position(estimate, pose, autopilot, "ODOMETRY")
    velocity_ned = _velocity_ned(estimate, pose)
    frames = (_LOCAL_NED, _LOCAL_NED)
    velocity, velocity_cov = velocity_ned, _velocity_covariance(estimate, pose)
    if autopilot is Autopilot.ARDUPILOT:
        roll, pitch, yaw = pose.attitude_rad
        body_from_ned = matrices_of_wxyz(wxyz_of_angles([yaw, pitch, roll])).T
        frames = (_LOCAL_FRD, _BODY_FRD)
        velocity = body_from_ned @ velocity_ned
        velocity_cov = body_from_ned @ velocity_cov @ body_from_ned.T
        if not np.isfinite(velocity).all():
            raise EstimateError(
                "ODOMETRY to ArduPilot needs attitude and velocity, and they are not all known: "
                "send VISION_POSITION_ESTIMATE"
            )
    return dialect().MAVLink_odometry_message(
        time_usec=microseconds(estimate.exposed_ns(clock)),
        frame_id=frames[0],
        child_frame_id=frames[1],
        x=float32(position[0]),
        y=float32(position[1]),
        z=float32(position[2]),
        q=[float32(value) for value in wxyz_of_angles(pose.attitude_rad[::-1]).tolist()],
        vx=float32(velocity[0]),
        vy=float32(velocity[1]),
        vz=float32(velocity[2]),
        rollspeed=math.nan,
        pitchspeed=math.nan,
        yawspeed=math.nan,
        pose_covariance=_triangle(variance, pose.attitude_std_rad),
        velocity_covariance=_triangle(velocity_cov, _NAN3),
        reset_counter=estimate.reset_counter,
        estimator_type=_ESTIMATOR_VISION,
        quality=clamped(estimate.confidence * 100, 1, 100),
    )


def vision_position_estimate(
    estimate: NavigationEstimate,
    pose: LocalPose,
    autopilot: Autopilot,
    *,
    clock: Clock = Clock.UTC,
    min_confidence: float = CONFIDENT,
) -> Message:
    """VISION_POSITION_ESTIMATE (message 102): north, east, down and attitude, stamped at exposure.

    Raises `EstimateError` where height or attitude is not known, or for a low confidence.
    """
    require_confident(estimate, min_confidence, "VISION_POSITION_ESTIMATE")
    (x, y, z), variance = _position(estimate, pose, autopilot, "this message")
    if not all(map(math.isfinite, pose.attitude_rad)):
        raise EstimateError("VISION_POSITION_ESTIMATE needs the attitude of the autopilot")
    roll, pitch, yaw = pose.attitude_rad
    return dialect().MAVLink_vision_position_estimate_message(
        usec=microseconds(estimate.exposed_ns(clock)),
        x=float32(x),
        y=float32(y),
        z=float32(z),
        roll=roll,
        pitch=pitch,
        yaw=yaw,
        covariance=_triangle(variance, pose.attitude_std_rad),
        reset_counter=estimate.reset_counter,
    )


def set_gps_global_origin(origin: Origin, *, target_system: int = 1) -> Message:
    """SET_GPS_GLOBAL_ORIGIN (message 48), which autopilots accept once. PX4 refuses system 0."""
    return dialect().MAVLink_set_gps_global_origin_message(
        target_system=target_system,
        latitude=deg_e7(origin.lat_deg),
        longitude=deg_e7(origin.lon_deg),
        altitude=clamped(origin.alt_amsl_m * 1000, _INT32_MIN, _INT32_MAX),
        time_usec=0,
    )


def _position(
    estimate: NavigationEstimate, pose: LocalPose, autopilot: Autopilot, message: str
) -> tuple[Triple, Array]:
    """North, east, down in metres and their covariance (3, 3), all known. ArduPilot makes one
    standard deviation of it: it gets the one that comes out as the horizontal one."""
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
        std_m = estimate.horizontal_std_m()
        return (north, east, down), np.eye(3) * ardupilot_variance(std_m)
    variance = np.zeros((3, 3))
    variance[:2, :2] = estimate.cov_en_m2[::-1, ::-1]
    variance[2, 2] = down_std**2
    return (north, east, down), variance


def _velocity_ned(estimate: NavigationEstimate, pose: LocalPose) -> Array:
    east, north = estimate.vel_en_mps or (math.nan, math.nan)
    return np.array([north, east, pose.vel_down_mps])


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
    return [float32(value) for value in cov[np.triu_indices(6)].tolist()]


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
    scale = max(math.cos(math.radians((lat_deg + origin.lat_deg) / 2)), _LEAST_SCALE)
    north_m = (lat_deg - origin.lat_deg) * ARDUPILOT_M_PER_DEG
    return north_m, turned_deg * ARDUPILOT_M_PER_DEG * scale


def ardupilot_variance(std_m: float) -> float:
    """Variance of each of three axes that ArduPilot reads as the standard deviation `std_m`.

    It takes the root of the sum of the variances of all three axes; older versions the cube root of
    the sum of their squares, which is not smaller (`GCS_MAVLink/GCS_Common.cpp`).
    """
    return std_m**2 / 3


def _px4(origin: Origin, lat_deg: float, lon_deg: float) -> tuple[float, float]:
    """Azimuthal-equidistant projection of a sphere; atan2 is also accurate near zero."""
    lat, lat0 = math.radians(lat_deg), math.radians(origin.lat_deg)
    turned = math.radians(lon_deg - origin.lon_deg)
    north = math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(turned)
    east = math.cos(lat) * math.sin(turned)
    along = math.sin(lat0) * math.sin(lat) + math.cos(lat0) * math.cos(lat) * math.cos(turned)
    across = math.hypot(north, east)
    scale = math.atan2(across, along) / across if across > 0 else 1.0
    return north * scale * PX4_RADIUS_M, east * scale * PX4_RADIUS_M
