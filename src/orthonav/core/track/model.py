"""The state of a track, the model of aircraft and instruments, and the measurement update.

The state of one hypothesis has 10 components: position and velocity (m, m/s; east and north), and
the errors of the telemetry of the present view: heading (rad, added to the reported one), log scale
(of true over reported height, focal length included), pitch and roll of the mount (rad, constant),
and of the autopilot's horizon (rad, changing within seconds).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.core.records import DEFAULT_AGL_STD, DEFAULT_YAW_STD_DEG, MAP_STD_M

Array = NDArray[np.float64]
STATE = 10
POSITION, VELOCITY, BIASES = slice(0, 2), slice(2, 4), slice(4, 8)
HEADING, SCALE, TILT, HORIZON = 4, 5, slice(6, 8), slice(8, 10)
HEADING_FLOOR_RAD, SCALE_FLOOR = math.radians(0.3), 0.004
"""Standard deviations that the heading and log scale of a registered view have at least."""
MOUNT_M, MOUNT_RAD = 10.0, (math.radians(0.5), math.radians(1.5))
"""A good mount is misaligned by what makes so many metres on the ground, within these angles
(docs/decisions/tracking.md)."""
TILT_WALK_SHARE = 1 / 30
"""Drift of a mount per root of a second, over its misalignment: in a quarter of an hour it drifts
by as much."""
SEEN: Array = np.zeros((6, STATE))
"""What a sighting measures of the state: position, heading, log scale, and the whole tilt."""
SEEN[range(6), [0, 1, 4, 5, 6, 7]] = SEEN[[4, 5], [8, 9]] = 1.0
SEEN.flags.writeable = False
WHITE_SHARE = 0.2
"""Share of the error of a reported tilt that is independent at every view."""


@dataclass(frozen=True)
class Model:
    """Standard deviations and probabilities of aircraft and instruments.

    Values without a source of their own were chosen on the flights of docs/tracking.md.
    """

    speed_mps: float = 30.0
    """Of an unknown velocity, per axis."""
    accel_mps2: float = 4.0
    """Of the acceleration while no velocity is reported, per axis."""
    reported_velocity_s: float = 120.0
    """Correlation time of the error of a reported velocity, s (docs/decisions/tracking.md)."""
    coasting_walk: float = 1.3
    """Of the drift of that error while views do not show the map, m/s per root of a second: 3 m/s
    and 9 m after 5 s, 24 m after 10 s (docs/decisions/tracking.md)."""
    heading_rad: float = math.radians(DEFAULT_YAW_STD_DEG)
    """Of the constant error of the reported heading."""
    heading_noise_rad: float = math.radians(2.0)
    """Of its error from view to view, where the telemetry has no `yaw_std_deg`."""
    heading_walk: float = math.radians(0.05)
    """Of the drift of its constant error, rad per root of a second."""
    log_scale: float = DEFAULT_AGL_STD
    """Of the constant error of the log scale: height and focal length."""
    log_scale_noise: float = 0.02
    """Of its error from view to view, where the telemetry has no `agl_std_m`."""
    log_scale_walk: float = 5e-4
    """Of the drift of its constant error, per root of a second."""
    tilt_rad: float = math.radians(0.5)
    """Of the misalignment of a good mount, in pitch and roll; see `at_height`."""
    off_tilt_rad: float = math.radians(6.0)
    """Of the misalignment of a bad mount (docs/decisions/tracking.md)."""
    off_mount: float = 0.03
    """Probability that the mount is a bad one (docs/decisions/tracking.md)."""
    horizon_rad: float = math.radians(1.5)
    """Of the error of the autopilot's horizon, in pitch and roll, where there is no
    `tilt_std_deg`."""
    horizon_s: float = 15.0
    """Its correlation time, s: those of real autopilots change within 10 to 30 s."""
    tilt_walk: float = math.radians(0.01)
    """Of the drift of the misalignment, rad per root of a second."""
    sighting_noise_m: float = 2.0
    """Of the disagreement of two dates beyond the covariance of a registration, per axis."""
    map_m: float = MAP_STD_M
    """Of a displacement of the map as a whole, per axis: added to the covariance of a fix."""
    bias_jump: float = 0.01
    """Probability, per view, of a bias jump of heading, scale and tilt: a gimbal that moved (by
    `off_tilt_rad`), a compass that was reset."""
    odometry_outlier: float = 0.01
    """Probability that a displacement by the camera is an outlier that fits well: clouds, a field
    that repeats (docs/decisions/tracking.md)."""
    turn: float = 0.03
    """Probability, per second, that the velocity changes by more than `accel_mps2` allows."""
    miss: float = 0.5
    """Probability that a view of ground on the map cannot be found on it."""
    wide_m: float = 50.0
    """Per axis: less certain positions are confirmed again after a while."""
    most_agreement: float = 25.0
    """Largest factor on the odds that a view shows the map by its agreement with the prediction: a
    view that has a probability below 1 % by itself does not show it."""
    lost: float = 3e-3
    """Belief that returns to "elsewhere" with every view, so that no error is permanent."""

    def at_height(self, agl_m: float) -> "Model":
        """The same model with a mount as good as this height requires.

        For high flights the camera is mounted well enough for fixes to be of use: its expected
        misalignment is what makes `MOUNT_M` on the ground, within `MOUNT_RAD`.
        """
        low, high = MOUNT_RAD
        return self.with_mount(min(max(MOUNT_M / max(agl_m, 1e-3), low), high))

    def with_mount(self, tilt_rad: float) -> "Model":
        """The same model with a mount misaligned by this, and drifting accordingly."""
        return replace(self, tilt_rad=tilt_rad, tilt_walk=TILT_WALK_SHARE * tilt_rad)

    def initial_bias(self, tilt_rad: float | None = None) -> Array:
        """Prior variances (4,) of the biases of heading, log scale, pitch and roll."""
        tilt = self.tilt_rad if tilt_rad is None else tilt_rad
        return np.square([self.heading_rad, self.log_scale, tilt, tilt])

    @property
    def telemetry_noise(self) -> Array:
        """Variances (3,) of reported heading (rad) and log scale from view to view, and of the
        horizon (rad)."""
        return np.square([self.heading_noise_rad, self.log_scale_noise, self.horizon_rad])

    def drift(self, seconds: float) -> Array:
        """Process noise (4,) of the biases over so many seconds."""
        walk = [self.heading_walk, self.log_scale_walk, self.tilt_walk, self.tilt_walk]
        return np.square(walk) * max(seconds, 0.0)


@dataclass(frozen=True)
class ReportedAttitude:
    """The reported attitude of a view.

    `heading_rad`: None where unknown. `pitch_rad`, `roll_rad`.
    """

    heading_rad: float | None
    pitch_rad: float
    roll_rad: float


@dataclass(frozen=True, eq=False)
class Sighting:
    """One place where a view may have been taken.

    `mean` (6,): metres east and north, heading (rad), log scale, pitch and roll (rad).
    `covariance` (6, 6): of these. `log_odds`: natural logarithm of the odds of this place, given
    only that the aircraft is somewhere on the map. `alone`: probability that this place is right,
    by the view alone.
    """

    mean: Array
    covariance: Array
    log_odds: float
    alone: float = 1.0
