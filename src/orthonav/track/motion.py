"""How a state becomes that of the next view: by time, by what is told, by what the camera saw."""

import math
from dataclasses import dataclass, replace

import numpy as np

from orthonav.track.model import (
    HEADING,
    POSITION,
    SCALE,
    STATE,
    VELOCITY,
    Array,
    Model,
    log_density,
)

TOLD_JITTER = 0.3
"""Of the error of a told velocity, how much is new at every view."""


@dataclass(frozen=True, eq=False)
class ReportedVelocity:
    """Velocity over ground as told, m/s east and north (2,): since the last view, and the one
    `before` (None where none was told then). It is off by `std_mps` per axis, and by about the
    same for a while."""

    now_en_mps: Array
    before_en_mps: Array | None
    std_mps: float


@dataclass(frozen=True, eq=False)
class CameraDisplacement:
    """Movement since the last view as the camera saw it.

    `moved_en_m` (2,) is turned by the told heading and scaled by the told height of the view
    before, so that wrong ones bend it; `covariance` (2, 2). `turned_rad` and `scaled` are by how
    much the heading turned and the scale changed other than told (rad, natural logarithm), known
    to `turned_std_rad` and `scaled_std`. `reach_m`: how far away it was looked for.
    """

    moved_en_m: Array
    covariance: Array
    reach_m: float
    turned_rad: float = 0.0
    scaled: float = 0.0
    turned_std_rad: float = math.radians(0.4)
    scaled_std: float = 0.004


@dataclass(frozen=True, eq=False)
class Expected:
    """What a state became until the next view: mean (8,), covariance (8, 8); what is known of it
    as it was, by the way in between too: `mean_before`, `covariance_before`; and how the two hang
    together, `cross` (8, 8), rows of the state before."""

    mean: Array
    covariance: Array
    mean_before: Array
    covariance_before: Array
    cross: Array

    def without(self, part: slice, variances: Array) -> "Expected":
        """The same with a part of the state forgotten: nothing is left of it but variances."""
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
    told: ReportedVelocity | None,
    telemetry_noise: Array,
    camera: CameraDisplacement | None = None,
) -> Expected:
    """What a state is expected to be after so many seconds, by what is told of the way, else by its
    velocity.

    `telemetry_noise` (2,) are the variances with which reported heading and log scale scatter from
    view to view: what was wrong with the last ones says that much less of these, unless the camera
    saw how they changed. How far it went by the `camera` is not in this: see `by_camera`.
    """
    after, step = mean.copy(), np.eye(STATE)
    noise = np.zeros((STATE, STATE))
    noise[range(4, 8), range(4, 8)] = model.drift(seconds)
    if camera is None:
        noise[[HEADING, SCALE], [HEADING, SCALE]] += telemetry_noise
    else:
        after[[HEADING, SCALE]] += [camera.turned_rad, camera.scaled]
        noise[HEADING, HEADING] += camera.turned_std_rad**2
        noise[SCALE, SCALE] += camera.scaled_std**2
    if told is None:
        after[POSITION] += seconds * mean[VELOCITY]
        step[0, 2] = step[1, 3] = seconds
        power = model.accel_mps2**2
        _add(noise, power * seconds**4 / 4, power * seconds**3 / 2, power * seconds**2)
    else:
        like_before = 0.0
        after[VELOCITY] = told.now_en_mps
        if told.before_en_mps is not None and covariance[2, 2] < (3 * told.std_mps) ** 2:
            like_before = math.exp(-seconds / model.reported_velocity_s)
            after[VELOCITY] += like_before * (mean[VELOCITY] - told.before_en_mps)
        after[POSITION] += seconds * after[VELOCITY]
        step[VELOCITY, VELOCITY] = like_before * np.eye(2)
        step[POSITION, VELOCITY] = seconds * like_before * np.eye(2)
        anew = told.std_mps**2 * (1 - like_before**2)
        jitter = (TOLD_JITTER * told.std_mps * seconds) ** 2
        _add(noise, anew * seconds**2 + jitter, anew * seconds, anew)
    return Expected(
        after, step @ covariance @ step.T + noise, mean, covariance, covariance @ step.T
    )


def _add(noise: Array, position: float, both: float, velocity: float) -> None:
    """Variances of position and velocity, and what they have in common, the same on both axes."""
    for axis in (0, 1):
        noise[axis, axis] += position
        noise[axis, axis + 2] += both
        noise[axis + 2, axis] += both
        noise[axis + 2, axis + 2] += velocity


def by_camera(expected: Expected, way: CameraDisplacement) -> tuple[Expected, float]:
    """The same with the way that the camera saw, and the log density of that way.

    The way is a measurement of the position now less that before (stochastic cloning, Roumeliotis
    and Burdick 2002), bent by what was wrong with heading and scale before.
    """
    mean = np.concatenate([expected.mean, expected.mean_before])
    joint = np.block(
        [
            [expected.covariance, expected.cross.T],
            [expected.cross, expected.covariance_before],
        ]
    )
    east, north = way.moved_en_m
    heading, scale = expected.mean_before[HEADING], expected.mean_before[SCALE]
    cos, sin = math.cos(heading), math.sin(heading)
    turn = math.exp(scale) * np.array([[cos, sin], [-sin, cos]])
    looks = np.zeros((2, 2 * STATE))
    looks[:, POSITION] = np.eye(2)
    looks[:, STATE : STATE + 2] = -np.eye(2)
    looks[:, STATE + HEADING] = -turn @ [north, -east]
    looks[:, STATE + SCALE] = -turn @ [east, north]
    off = turn @ [east, north] - (mean[POSITION] - mean[STATE : STATE + 2])
    spread = looks @ joint @ looks.T + turn @ way.covariance @ turn.T
    gain = np.linalg.solve(spread, looks @ joint).T
    mean = mean + gain @ off
    joint = joint - gain @ spread @ gain.T
    joint = (joint + joint.T) / 2
    now, before = slice(0, STATE), slice(STATE, 2 * STATE)
    after = Expected(
        mean[now], joint[now, now], mean[before], joint[before, before], joint[before, now]
    )
    return after, log_density(off, spread)


def velocity_forgotten(model: Model, covariance: Array) -> Array:
    """A covariance (8, 8) of a state whose velocity is not known any more."""
    out = covariance.copy()
    out[VELOCITY] = out[:, VELOCITY] = 0.0
    out[VELOCITY, VELOCITY] = np.eye(2) * model.speed_mps**2
    return out


def held_to_map(model: Model, expected: Expected, area_m2: float) -> Expected:
    """The same, with a position that is known to be on the map at least.

    Where no more than that is left of it, it is forgotten, with the velocity.
    """
    if float(np.linalg.eigvalsh(expected.covariance[POSITION, POSITION])[-1]) <= area_m2:
        return expected
    return expected.without(slice(0, 4), np.repeat([area_m2, model.speed_mps**2], 2))


def after_bias_jump(model: Model, expected: Expected) -> Expected:
    """The same where heading, scale and tilt are no longer what they were."""
    return expected.without(slice(4, 8), model.initial_bias(model.off_tilt_rad))
