"""The Kalman filter of one hypothesis: state, model, prediction and measurement.

A state has 16 components: position and velocity (m, m/s; east and north), and the errors of the
telemetry: heading (rad, added to the reported one), log scale (true over reported height, focal
length included), pitch and roll of the mount (rad, constant) and of the horizon (rad, for seconds);
and the error that sightings of the same ground have in common, in standard deviations (Cholesky).
It is predicted by time, by the reported velocity and by the odometry of the camera.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.localize.odometry import CameraDisplacement
from orthonav.core.localize.sighting import Sighting
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
OBSERVES: Array = np.zeros((6, STATE))
"""What a sighting measures: position, heading, log scale, and the whole tilt."""
OBSERVES[range(6), [0, 1, 4, 5, 6, 7]] = OBSERVES[[4, 5], [8, 9]] = 1.0
OBSERVES.flags.writeable = False
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
        return replace(self, tilt_rad=min(max(MOUNT_M / max(agl_m, 1e-3), low), high))

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
        tilt_walk = TILT_WALK_SHARE * self.tilt_rad
        walk = [self.heading_walk, self.log_scale_walk, tilt_walk, tilt_walk]
        return np.square(walk) * max(seconds, 0.0)


@dataclass(frozen=True)
class ReportedAttitude:
    """`heading_rad`: None where unknown."""

    heading_rad: float | None
    pitch_rad: float
    roll_rad: float


def observed(covariance: Array) -> Array:
    """Of what a sighting measures (.., 6, 6), by that of the state (.., 16, 16)."""
    return np.asarray(OBSERVES @ covariance @ OBSERVES.T)


VELOCITY_JITTER = 0.3
"""Of the error of a reported velocity, independent at every view (docs/tracking.md)."""
VELOCITY_STD_MPS, VELOCITY_SHARE = 3.0, 0.02
"""Of a reported velocity without deviation, and fraction of the speed: of an autopilot without
GNSS, whose velocity was wrong by 1 to 3 m/s (docs/tracking.md)."""

PLAUSIBLE_SIGMAS = 4.0
"""A heading, height or velocity that differs more from the reported one is that of odometry which
is wrong for long."""


def usual_velocity_std_mps(speed_mps: float) -> float:
    return VELOCITY_STD_MPS + VELOCITY_SHARE * speed_mps


@dataclass(frozen=True, eq=False)
class ReportedVelocity:
    """Over ground, m/s east and north (2,), since the last view and the one before it, None
    without.

    `std_mps`: per axis, of an error nearly constant for `correlation_s`; None: `Model`'s."""

    now_en_mps: Array
    before_en_mps: Array | None
    std_mps: float
    correlation_s: float | None = None


@dataclass(frozen=True, eq=False)
class Expected:
    """A predicted state (16,), with the one before it by the odometry in between too.

    `cross` (16, 16): covariance of the state before (rows) and the prediction (columns)."""

    mean: Array
    covariance: Array
    mean_before: Array
    covariance_before: Array
    cross: Array

    def without(self, part: slice, variances: Array) -> "Expected":
        """With components of the state reset to zero mean and these variances."""
        mean, covariance, cross = self.mean.copy(), self.covariance.copy(), self.cross.copy()
        mean[part] = 0.0
        cross[:, part] = 0.0
        covariance[part] = covariance[:, part] = 0.0
        covariance[part, part] = np.diag(variances)
        return replace(self, mean=mean, covariance=covariance, cross=cross)


class Motion(NamedTuple):
    """What is known of the motion since the view before.

    `telemetry_noise` (3,): variances of heading (rad) and log scale from view to view, and of the
    horizon (rad). `overlap`: fraction of the view that the last one showed too."""

    seconds: float
    velocity: ReportedVelocity | None
    camera: CameraDisplacement | None
    telemetry_noise: Array
    overlap: float = 0.0


def predicted(model: Model, mean: Array, covariance: Array, motion: Motion) -> Expected:
    """The state after a motion, by the reported velocity or else its own.

    The noise of heading and log scale is added to their biases unless the camera measured the
    change. The displacement itself is added by `by_camera`."""
    seconds, velocity, camera, telemetry_noise, overlap = motion
    after, step = mean.copy(), np.eye(STATE)
    noise = np.zeros((STATE, STATE))
    noise[range(4, 8), range(4, 8)] = model.drift(seconds)
    if camera is None:
        noise[[HEADING, SCALE], [HEADING, SCALE]] += telemetry_noise[:2]
    else:
        after[[HEADING, SCALE]] += [camera.turned_rad, camera.scaled]
        noise[HEADING, HEADING] += camera.turned_std_rad**2
        noise[SCALE, SCALE] += camera.scaled_std**2
    left = np.repeat([math.exp(-seconds / model.horizon_s), overlap], [2, 6])
    after[8:] *= left
    step[8:, 8:] = np.diag(left)
    noise[8:, 8:] = np.diag(1 - left**2)
    noise[HORIZON, HORIZON] *= telemetry_noise[2]
    if velocity is None:
        after[POSITION] += seconds * mean[VELOCITY]
        step[0, 2] = step[1, 3] = seconds
        power = model.accel_mps2**2
        _add(noise, power * seconds**4 / 4, power * seconds**3 / 2, power * seconds**2)
    else:
        like_before = 0.0
        after[VELOCITY] = velocity.now_en_mps
        known_m2ps2 = (3 * velocity.std_mps) ** 2
        if velocity.before_en_mps is not None and covariance[2, 2] < known_m2ps2:
            like_before = math.exp(-seconds / (velocity.correlation_s or model.reported_velocity_s))
            after[VELOCITY] += like_before * (mean[VELOCITY] - velocity.before_en_mps)
        after[POSITION] += seconds * after[VELOCITY]
        step[VELOCITY, VELOCITY] = like_before * np.eye(2)
        step[POSITION, VELOCITY] = seconds * like_before * np.eye(2)
        added = velocity.std_mps**2 * (1 - like_before**2)
        jitter = (VELOCITY_JITTER * velocity.std_mps * seconds) ** 2
        _add(noise, added * seconds**2 + jitter, added * seconds, added)
    return Expected(
        after, step @ covariance @ step.T + noise, mean, covariance, covariance @ step.T
    )


def _add(noise: Array, position: float, both: float, velocity: float) -> None:
    """Alike on both axes; `both`: their covariance."""
    for axis in (0, 1):
        noise[axis, axis] += position
        noise[axis, axis + 2] += both
        noise[axis + 2, axis] += both
        noise[axis + 2, axis + 2] += velocity


def by_camera(expected: Expected, camera: CameraDisplacement) -> tuple[Expected, float]:
    """With a displacement by the camera, and the log density of that (stochastic cloning,
    Roumeliotis and Burdick 2002), under errors of heading, scale and both tilts."""
    mean = np.concatenate([expected.mean, expected.mean_before])
    now, before = slice(0, STATE), slice(STATE, 2 * STATE)
    joint = np.empty((2 * STATE, 2 * STATE))  # filled: np.block takes ten times as long
    joint[now, now], joint[now, before] = expected.covariance, expected.cross.T
    joint[before, now], joint[before, before] = expected.cross, expected.covariance_before
    east, north = camera.moved_en_m
    heading, scale = expected.mean_before[HEADING], expected.mean_before[SCALE]
    cos, sin = math.cos(heading), math.sin(heading)
    turn = math.exp(scale) * np.array([[cos, sin], [-sin, cos]])
    observes = np.zeros((2, 2 * STATE))
    observes[:, POSITION] = np.eye(2)
    observes[:, STATE : STATE + 2] = -np.eye(2)
    observes[:, STATE + HEADING] = -turn @ [north, -east]
    observes[:, STATE + SCALE] = -turn @ [east, north]
    innovation = turn @ [east, north] - (mean[POSITION] - mean[STATE : STATE + 2])
    for sign, lever, known, first in zip(
        (1, -1), camera.levers_m, camera.corrected_rad, (0, STATE), strict=True
    ):
        state = mean[first : first + STATE]
        innovation -= sign * lever @ (state[TILT] + state[HORIZON] - known)
        observes[:, first + TILT.start : first + HORIZON.stop] += sign * np.hstack([lever, lever])
    spread = observes @ joint @ observes.T + turn @ camera.covariance @ turn.T
    gain = np.linalg.solve(spread, observes @ joint).T
    mean = mean + gain @ innovation
    joint = joint - gain @ spread @ gain.T
    joint = (joint + joint.T) / 2
    after = Expected(
        mean[now], joint[now, now], mean[before], joint[before, before], joint[before, now]
    )
    return after, log_density(innovation, spread)


def is_plausible(model: Model, mean: Array, velocity: ReportedVelocity | None) -> bool:
    """Whether heading, height and velocity of a state (16,) are as reported.

    The camera measures how they change, and nothing else would hold them: a mirrored camera turned
    the heading by 170 deg."""
    most = PLAUSIBLE_SIGMAS * np.maximum(
        [model.heading_rad, model.log_scale], [math.radians(DEFAULT_YAW_STD_DEG), DEFAULT_AGL_STD]
    )
    if (np.abs(mean[[HEADING, SCALE]]) > most).any():
        return False
    if velocity is None:
        return True
    most_mps = PLAUSIBLE_SIGMAS * max(velocity.std_mps, VELOCITY_STD_MPS)
    return float(np.hypot(*(mean[VELOCITY] - velocity.now_en_mps))) <= most_mps


def velocity_forgotten(model: Model, covariance: Array) -> Array:
    out = covariance.copy()
    out[VELOCITY] = out[:, VELOCITY] = 0.0
    out[VELOCITY, VELOCITY] = np.eye(2) * model.speed_mps**2
    return out


def held_to_map(model: Model, expected: Expected, area_m2: float) -> Expected:
    """Position and velocity are reset where the position is less certain than the map."""
    spread = expected.covariance[POSITION, POSITION]
    # The sum of both variances is no less than the larger one of its axes.
    if spread[0, 0] + spread[1, 1] <= area_m2 or np.linalg.eigvalsh(spread)[-1] <= area_m2:
        return expected
    return expected.without(slice(0, 4), np.repeat([area_m2, model.speed_mps**2], 2))


def after_bias_jump(model: Model, expected: Expected) -> Expected:
    """Heading, scale and tilt are reset."""
    return expected.without(slice(4, 8), model.initial_bias(model.off_tilt_rad))


LEAST_NEW = 0.15
"""Of a view, however it overlaps: noise, light and tilt differ (docs/tracking.md)."""
ROUNDING = 1e-7  # of variances: where a view shows less than its camera, rounding has no root
POSE = slice(2, 4)
SEARCHED_SIGMAS = 6.0  # width of the search over heading and scale, from end to end
MAX_LOG_ODDS = 7.0  # of a single view


@dataclass(frozen=True, eq=False)
class Measurement:
    """A sighting as a measurement of what is in `OBSERVES`: `mean` (6,).

    `noise` (6, 6): tempered. `log_odds`: over the density of what only looks alike. `independent`
    (6, 6): not in common with views of the same ground. `observes` (6, 16): what it measures.
    `single_view_probability`: of the place, by the view without the track. `log_chance`: log
    density of chance in the area searched."""

    mean: Array
    noise: Array
    log_odds: float
    independent: Array
    observes: Array
    single_view_probability: float
    log_chance: float


def measurement(
    model: Model, reported: ReportedAttitude, sighting: Sighting
) -> tuple[Array, Array, Array]:
    """Mean (6,), covariances (6, 6) of map and view, and of telemetry noise, new at each view."""
    noise = sighting.covariance.copy()
    floor = [model.sighting_noise_m] * 2 + [HEADING_FLOOR_RAD, SCALE_FLOOR]
    noise[range(4), range(4)] += np.square(floor)
    white = WHITE_SHARE * model.horizon_rad
    independent = np.diag(np.square([0.0, 0.0, 0.0, 0.0, white, white]))
    mean = sighting.mean.copy()
    if reported.heading_rad is None:
        mean[2] = 0.0
        noise[2, :] = noise[:, 2] = 0.0
        noise[2, 2] = math.pi**2
    else:
        mean[2] = math.remainder(mean[2] - reported.heading_rad, 2 * math.pi)
    mean[4:] -= [reported.pitch_rad, reported.roll_rad]
    return mean, noise, independent


def updated(mean: Array, covariance: Array, measured: Measurement) -> tuple[Array, Array]:
    """Kalman update of states (.., 16), (.., 16, 16)."""
    spread = measured.observes @ covariance @ measured.observes.T + measured.independent
    gain = np.linalg.solve(spread, measured.observes @ covariance).swapaxes(-1, -2)
    after = covariance - gain @ spread @ gain.swapaxes(-1, -2)
    moved = mean + (gain @ (measured.mean - mean @ measured.observes.T)[..., None])[..., 0]
    return moved, (after + after.swapaxes(-1, -2)) / 2


def log_densities(off: Array, spread: Array) -> Array:
    """Of Gaussians (.., N, N) at `off` (.., N)."""
    _, log_det = np.linalg.slogdet(2 * math.pi * spread)
    weighted = np.linalg.solve(spread, off[..., None])[..., 0]
    return np.asarray(-0.5 * ((off * weighted).sum(axis=-1) + log_det))


def log_density(off: Array, spread: Array) -> float:
    return float(log_densities(off, spread))


def tempered(
    model: Model,
    mounts: Sequence[tuple[float, Array]],
    areas_m2: tuple[float, float],
    reported: ReportedAttitude,
    sighting: Sighting,
    newness: float,
) -> Measurement:
    """A sighting as a measurement, tempered by the fraction of it that is new.

    `mounts`: probability and covariance (16, 16) of the initial state of each kind. `areas_m2`: of
    the map, and of the part searched. A likelihood to the power `newness` has a broader peak; the
    telemetry noise, independent at every view, is excluded."""
    mean, noise, independent = measurement(model, reported, sighting)
    map_m2, searched_m2 = areas_m2
    own = np.diag(noise)[POSE] + model.initial_bias()[:2]
    poses = float(np.log(SEARCHED_SIGMAS * np.sqrt(own)).sum())
    wide = math.log(map_m2) + poses
    # Tilts are distributed as those of mounts at every place: no evidence for one.
    tilts = noise[4:, 4:] + independent[4:, 4:]
    wide -= float(
        np.logaddexp.reduce(
            [
                math.log(share) + log_density(mean[4:], tilts + observed(each)[4:, 4:])
                for share, each in mounts
            ]
        )
    )
    _, log_det = np.linalg.slogdet(2 * math.pi * (noise + independent))
    odds = newness * (min(sighting.log_odds, MAX_LOG_ODDS) + wide)
    odds += (1 - newness) * float(log_det) / 2 - len(mean) / 2 * math.log(newness)
    observes = OBSERVES.copy()
    spread = (noise + noise.T) / 2 + ROUNDING * np.diag(np.diag(noise))
    observes[:, COMMON] = np.linalg.cholesky((1 - LEAST_NEW) * spread)
    return Measurement(
        mean,
        noise / newness + independent,
        odds,
        LEAST_NEW * noise + independent,
        observes,
        sighting.single_view_probability,
        -math.log(searched_m2) - poses,
    )


def recognition(
    measured: Measurement, covariances: Array, innovations: Array, most_agreement: float
) -> Array:
    """Probabilities (K,) that a view showed the map, given its place and predictions of that.

    The odds by the view alone, times the likelihood ratio of innovations (K, 6), of predictions
    with `covariances` (K, 6, 6), between a right place and one that chance finds in the area
    searched, at most `most_agreement`. A place within the gate is never less likely for its
    distance."""
    common = measured.observes[:4, COMMON]
    spreads = covariances[:, :4, :4] + common @ common.T + measured.independent[:4, :4]
    ratios = log_densities(innovations[:, :4], spreads) - measured.log_chance
    agreement = np.exp(np.clip(ratios, 0.0, math.log(most_agreement)))
    alone = measured.single_view_probability
    odds = alone / max(1 - alone, 1e-9) * agreement
    return np.asarray(odds / (1 + odds))
