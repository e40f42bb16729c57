"""The state of a track, and the model of aircraft and instruments.

A state has 16 components: position and velocity (m, m/s; east and north), and the errors of the
telemetry: heading (rad, added to the reported one), log scale (true over reported height, focal
length included), pitch and roll of the mount (rad, constant) and of the horizon (rad, for seconds);
and the error that sightings of the same ground have in common, in standard deviations (Cholesky).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.core.records import DEFAULT_AGL_STD, DEFAULT_YAW_STD_DEG, MAP_STD_M

Array = NDArray[np.float64]
STATE = 16
POSITION, VELOCITY, BIASES = slice(0, 2), slice(2, 4), slice(4, 8)
HEADING, SCALE, TILT, HORIZON, COMMON = 4, 5, slice(6, 8), slice(8, 10), slice(10, 16)
HEADING_FLOOR_RAD, SCALE_FLOOR = math.radians(0.3), 0.004
"""Least standard deviations of heading and log scale of a registered view."""
MOUNT_M, MOUNT_RAD = 10.0, (math.radians(0.5), math.radians(1.5))
"""Of a good mount: metres on the ground, within these angles (docs/tracking.md)."""
TILT_WALK_SHARE = 1 / 30
"""Drift per root of a second, over the misalignment: as much in a quarter of an hour."""
SEEN: Array = np.zeros((6, STATE))
"""What a sighting measures: position, heading, log scale, and the whole tilt."""
SEEN[range(6), [0, 1, 4, 5, 6, 7]] = SEEN[[4, 5], [8, 9]] = 1.0
SEEN.flags.writeable = False
WHITE_SHARE = 0.2  # fraction of the error of a reported tilt that is independent at every view


@dataclass(frozen=True)
class Model:
    """Standard deviations, probabilities; without a source by the flights of docs/tracking.md."""

    speed_mps: float = 30.0  # of an unknown velocity, per axis
    accel_mps2: float = 4.0  # while no velocity is reported, per axis
    reported_velocity_s: float = 120.0
    """Correlation time of the error of a reported velocity (docs/tracking.md)."""
    heading_rad: float = math.radians(DEFAULT_YAW_STD_DEG)  # of the constant error,
    heading_noise_rad: float = math.radians(2.0)  # from view to view, without `yaw_std_deg`,
    heading_walk: float = math.radians(0.05)
    """and of the drift of the constant one, rad per root of a second."""
    log_scale: float = DEFAULT_AGL_STD  # of the constant error (height and focal length),
    log_scale_noise: float = 0.02  # from view to view, without `agl_std_m`,
    log_scale_walk: float = 5e-4  # and of the drift, per root of a second
    tilt_rad: float = math.radians(0.5)  # of a good mount, in pitch and roll; see `at_height`
    off_tilt_rad: float = math.radians(6.0)  # of a bad mount (docs/tracking.md),
    off_mount: float = 0.03  # and its probability
    horizon_rad: float = math.radians(2.0)
    """Of the autopilot's horizon, in pitch and roll, without `tilt_std_deg`."""
    horizon_s: float = 15.0  # its correlation time: 10 to 30 s in real autopilots
    tilt_walk: float = math.radians(0.01)  # of the misalignment, rad per root of a second
    sighting_noise_m: float = 1.0  # of two dates beyond the covariance of a registration, per axis
    map_m: float = MAP_STD_M  # of the map as a whole, per axis: added to the covariance of a fix
    bias_jump: float = 0.01
    """Per view: a gimbal that moved (by `off_tilt_rad`), a compass that was reset."""
    odometry_outlier: float = 0.01
    """A displacement that fits well and is wrong (docs/tracking.md)."""
    turn: float = 0.03  # per second: the velocity changes by more than `accel_mps2` allows
    miss: float = 0.5  # A view of ground on the map cannot be found on it
    wide_m: float = 50.0  # per axis: less certain positions are confirmed again after a while
    most_agreement: float = 25.0
    """Largest factor on the odds by agreement: a view below 1 % by itself does not show the map."""
    lost: float = 3e-3
    """Belief that returns to "elsewhere" with every view, so that no error is permanent."""

    def at_height(self, agl_m: float) -> "Model":
        """With a mount off by `MOUNT_M` on the ground, within `MOUNT_RAD`: high flights need it."""
        low, high = MOUNT_RAD
        return self.with_mount(min(max(MOUNT_M / max(agl_m, 1e-3), low), high))

    def with_mount(self, tilt_rad: float) -> "Model":
        return replace(self, tilt_rad=tilt_rad, tilt_walk=TILT_WALK_SHARE * tilt_rad)

    def initial_bias(self, tilt_rad: float | None = None) -> Array:
        """Prior variances (4,) of heading, log scale, pitch and roll."""
        tilt = self.tilt_rad if tilt_rad is None else tilt_rad
        return np.square([self.heading_rad, self.log_scale, tilt, tilt])

    @property
    def telemetry_noise(self) -> Array:
        """Variances (3,) of heading (rad), log scale from view to view, horizon (rad)."""
        return np.square([self.heading_noise_rad, self.log_scale_noise, self.horizon_rad])

    def drift(self, seconds: float) -> Array:
        """Process noise (4,) of the biases."""
        walk = [self.heading_walk, self.log_scale_walk, self.tilt_walk, self.tilt_walk]
        return np.square(walk) * max(seconds, 0.0)


@dataclass(frozen=True)
class ReportedAttitude:
    """`heading_rad`: None where unknown."""

    heading_rad: float | None
    pitch_rad: float
    roll_rad: float
