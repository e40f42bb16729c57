"""What the track knows of an aircraft, how it moves, and what a view says of it.

The state of one hypothesis, 8 numbers: position and velocity (m, m/s, east and north), and what is
wrong with what is told of the view at hand: heading (rad, added to the told one), log scale (of
true over told height, focal length included), pitch and roll (rad; of these what stays the same).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STATE = 8
POSITION, VELOCITY, HEADING, SCALE, TILT = slice(0, 2), slice(2, 4), 4, 5, slice(6, 8)
HEADING_FLOOR_RAD, SCALE_FLOOR = math.radians(0.3), 0.004
MOUNT_M, MOUNT_RAD = 10.0, (math.radians(0.5), math.radians(1.5))
TILT_WALK_SHARE = 1 / 30
"""Of how far a mount may be off is how far it drifts, per root of a second."""
SEEN = [0, 1, 4, 5, 6, 7]
"""Which of the state a sighting speaks of."""


@dataclass(frozen=True)
class Model:
    """How aircraft and instruments behave.

    `speed_mps`: standard deviation of an unknown velocity per axis; `accel_mps2`: of what changes
    it; `reported_velocity_s`: for how long a told one is off by about the same. `heading_rad`,
    `log_scale`, `tilt_rad`: how wrong the told values may be all along; `heading_noise_rad`,
    `log_scale_noise`, `tilt_noise_rad`: how they scatter from view to view; the `_walk` ones how
    the former drift, per root of a second. `sighting_noise_m`: what maps of two dates disagree by
    beyond what registration knows, which counts `sighting_growth` times; `map_m`: how far a map may
    be displaced as a whole. `off_mount`: how likely the mount is not as good as `tilt_rad` but off
    by `off_tilt_rad`. `odometry_outlier`: probability that a displacement between two views is
    wrong though it looks right: moving clouds, a field that repeats. `turn`: how likely the
    velocity changes by more than `accel_mps2` says. `bias_jump`: probability that the biases of
    heading, scale and tilt jump: a gimbal that moved (by `off_tilt_rad`), a compass that was reset.
    `miss`: how likely a view of ground that is on the map shows nothing that can be found. `lost`:
    how likely the track went wrong since the last view.
    """

    speed_mps: float = 30.0
    accel_mps2: float = 4.0
    reported_velocity_s: float = 120.0
    heading_rad: float = math.radians(7.0)
    heading_noise_rad: float = math.radians(2.0)
    heading_walk: float = math.radians(0.05)
    log_scale: float = 0.08
    log_scale_noise: float = 0.02
    log_scale_walk: float = 5e-4
    tilt_rad: float = math.radians(0.5)
    off_tilt_rad: float = math.radians(6.0)
    off_mount: float = 0.03
    tilt_noise_rad: float = math.radians(0.7)
    tilt_walk: float = math.radians(0.01)
    sighting_noise_m: float = 2.0
    map_m: float = 3.0
    sighting_growth: float = 2.0
    bias_jump: float = 0.01
    odometry_outlier: float = 0.01
    turn: float = 0.03
    miss: float = 0.5
    lost: float = 3e-3

    def at_height(self, agl_m: float) -> "Model":
        """The same, with a mount as good as flying at that height asks for.

        Who flies high has mounted the camera so that fixes are of use: it is expected to be off by
        what is `MOUNT_M` on the ground, within `MOUNT_RAD`.
        """
        low, high = MOUNT_RAD
        return self.with_mount(min(max(MOUNT_M / max(agl_m, 1e-3), low), high))

    def with_mount(self, tilt_rad: float) -> "Model":
        """The same, with a mount that is off by so much, and drifts accordingly."""
        return replace(self, tilt_rad=tilt_rad, tilt_walk=TILT_WALK_SHARE * tilt_rad)

    def initial_bias(self, tilt_rad: float | None = None) -> Array:
        """Variances (4,) of heading, log scale, pitch and roll before anything is seen."""
        tilt = self.tilt_rad if tilt_rad is None else tilt_rad
        return np.square([self.heading_rad, self.log_scale, tilt, tilt])

    @property
    def telemetry_noise(self) -> Array:
        """Variances (2,) with which told heading and log scale scatter from view to view."""
        return np.square([self.heading_noise_rad, self.log_scale_noise])

    def drift(self, seconds: float) -> Array:
        """Variances (4,) that are added to those of the biases in so many seconds."""
        walk = [self.heading_walk, self.log_scale_walk, self.tilt_walk, self.tilt_walk]
        return np.square(walk) * max(seconds, 0.0)


@dataclass(frozen=True)
class Told:
    """What was told of a view: heading (rad; None where unknown), pitch and roll (rad), and how
    far these two are off from view to view (None: as usual)."""

    heading_rad: float | None
    pitch_rad: float
    roll_rad: float
    tilt_noise_rad: float | None = None


@dataclass(frozen=True, eq=False)
class Sighting:
    """One place where a view may have been taken.

    `mean` (6,): metres east and north, heading (rad), log scale, pitch and roll (rad);
    `covariance` (6, 6). `log_odds`: natural logarithm of the odds that this is the place, for
    somebody who knows only that it lies somewhere on the map. `alone`: the probability that the
    view is placed rightly, by itself.
    """

    mean: Array
    covariance: Array
    log_odds: float
    alone: float = 1.0


def reading(model: Model, told: Told, sighting: Sighting) -> tuple[Array, Array, Array]:
    """What a sighting says of the state (6,), in the order of `SEEN`, and two covariances (6, 6):
    of how map and view err, and of what is told anew at every view."""
    noise = sighting.covariance.copy()
    tilt = slice(4, 6)
    by_tilt = noise[:2, tilt] @ np.linalg.solve(noise[tilt, tilt], noise[tilt, :2])
    noise[:2, :2] += (model.sighting_growth - 1) * (noise[:2, :2] - by_tilt)
    floor = [model.sighting_noise_m] * 2 + [HEADING_FLOOR_RAD, SCALE_FLOOR]
    noise[range(4), range(4)] += np.square(floor)
    reported_tilt = model.tilt_noise_rad if told.tilt_noise_rad is None else told.tilt_noise_rad
    anew = np.diag(np.square([0.0, 0.0, 0.0, 0.0, reported_tilt, reported_tilt]))
    seen = sighting.mean.copy()
    if told.heading_rad is None:
        seen[2] = 0.0
        noise[2, :] = noise[:, 2] = 0.0
        noise[2, 2] = math.pi**2
    else:
        seen[2] = math.remainder(seen[2] - told.heading_rad, 2 * math.pi)
    seen[4:] -= [told.pitch_rad, told.roll_rad]
    return seen, noise, anew


def updated(mean: Array, covariance: Array, off: Array, spread: Array) -> tuple[Array, Array]:
    """Mean and covariance after a sighting that lies `off` (6,), with covariance `spread`."""
    gain = np.linalg.solve(spread, covariance[SEEN]).T
    after = covariance - gain @ spread @ gain.T
    return mean + gain @ off, (after + after.T) / 2


def log_density(off: Array, spread: Array) -> float:
    """Natural logarithm of a Gaussian's density at `off` (N,)."""
    _, log_det = np.linalg.slogdet(2 * math.pi * spread)
    return float(-0.5 * (off @ np.linalg.solve(spread, off) + log_det))
