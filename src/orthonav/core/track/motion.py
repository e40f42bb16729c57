"""Prediction of the state: by time, by the reported velocity, and by the camera's odometry."""

import math
from dataclasses import dataclass, replace

import numpy as np

from orthonav.core.localize.odometry import CameraDisplacement
from orthonav.core.records import DEFAULT_AGL_STD, DEFAULT_YAW_STD_DEG
from orthonav.core.track.likelihood import log_density
from orthonav.core.track.model import (
    HEADING,
    HORIZON,
    POSITION,
    SCALE,
    STATE,
    TILT,
    VELOCITY,
    Array,
    Model,
)

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


def predicted(
    model: Model,
    mean: Array,
    covariance: Array,
    seconds: float,
    velocity: ReportedVelocity | None,
    telemetry_noise: Array,
    camera: CameraDisplacement | None = None,
    *,
    overlap: float = 0.0,
) -> Expected:
    """The state after so many seconds, by the reported velocity or else its own.

    `telemetry_noise` (3,): variances of heading (rad) and log scale from view to view, added to
    their biases unless the `camera` measured the change, and of the horizon (Gauss-Markov,
    `Model.horizon_s`). The displacement itself is added by `by_camera`. `overlap`: fraction of the
    view that the last one showed too."""
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
