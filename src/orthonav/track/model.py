"""What the track knows of an aircraft, how it moves, and what a view says of it.

The state of one hypothesis, 8 numbers: position and velocity (m, m/s, east and north), and what is
wrong with what is told of the view at hand: heading (rad, added to the told one), log scale (of
true over told height, focal length included), pitch and roll (rad; of these what stays the same).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STATE = 8
POSITION, VELOCITY, HEADING, SCALE, LEAN = slice(0, 2), slice(2, 4), 4, 5, slice(6, 8)
HEADING_FLOOR_RAD, SCALE_FLOOR = math.radians(0.3), 0.004
SEEN = [0, 1, 4, 5, 6, 7]
"""Which of the state a sighting speaks of."""


@dataclass(frozen=True)
class Model:
    """How aircraft and instruments behave.

    `speed_mps`: standard deviation of an unknown velocity per axis; `accel_mps2`: of what changes
    it. `heading_rad`, `log_scale`, `lean_rad`: how wrong the told values may be all along;
    `heading_noise_rad`, `log_scale_noise`, `lean_noise_rad`: how they scatter from view to view;
    the `_walk` ones how the former drift, per root of a second. `sighting_noise_m`: what maps of
    two dates disagree by beyond what registration knows, which counts `sighting_growth` times.
    `knocked`: how likely heading, scale and lean are suddenly wrong by something else than before:
    a gimbal that moved (by `knocked_lean_rad`), a compass that was reset. `miss`: how likely a view
    of ground that is on the map shows nothing that can be found. `lost`: how likely the track went
    wrong since the last view.
    """

    speed_mps: float = 30.0
    accel_mps2: float = 5.0
    heading_rad: float = math.radians(7.0)
    heading_noise_rad: float = math.radians(2.0)
    heading_walk: float = math.radians(0.05)
    log_scale: float = 0.08
    log_scale_noise: float = 0.02
    log_scale_walk: float = 5e-4
    lean_rad: float = math.radians(3.0)
    knocked_lean_rad: float = math.radians(6.0)
    lean_noise_rad: float = math.radians(0.7)
    lean_walk: float = math.radians(0.05)
    sighting_noise_m: float = 1.0
    sighting_growth: float = 2.0
    knocked: float = 0.01
    miss: float = 0.5
    lost: float = 1e-3

    def initial_bias(self, lean_rad: float | None = None) -> Array:
        """Variances (4,) of heading, log scale, pitch and roll before anything is seen."""
        lean = self.lean_rad if lean_rad is None else lean_rad
        return np.square([self.heading_rad, self.log_scale, lean, lean])

    @property
    def told_noise(self) -> Array:
        """Variances (2,) with which told heading and log scale scatter from view to view."""
        return np.square([self.heading_noise_rad, self.log_scale_noise])

    def drift(self, seconds: float) -> Array:
        """Variances (4,) that are added to those of the biases in so many seconds."""
        walk = [self.heading_walk, self.log_scale_walk, self.lean_walk, self.lean_walk]
        return np.square(walk) * max(seconds, 0.0)


@dataclass(frozen=True)
class Told:
    """What was told of a view: heading (rad; None where unknown), pitch and roll (rad)."""

    heading_rad: float | None
    pitch_rad: float
    roll_rad: float


@dataclass(frozen=True, eq=False)
class Sighting:
    """One place where a view may have been taken.

    `mean` (6,): metres east and north, heading (rad), log scale, pitch and roll (rad);
    `covariance` (6, 6). `log_odds`: natural logarithm of the odds that this is the place, for
    somebody who knows only that it lies somewhere on the map.
    """

    mean: Array
    covariance: Array
    log_odds: float


@dataclass(frozen=True, eq=False)
class Displacement:
    """Movement since the last view, metres east and north (2,), covariance (2, 2).

    `relative`: it was measured by the camera and turned by the told heading, so that wrong heading
    and scale bend it like everything else. Then the camera also saw by how much the heading turned
    and the scale changed other than told (rad, natural logarithm), known to `turned_std_rad` and
    `scaled_std`.
    """

    moved_en_m: Array
    covariance: Array
    relative: bool
    turned_rad: float = 0.0
    scaled: float = 0.0
    turned_std_rad: float = math.radians(0.4)
    scaled_std: float = 0.004


@dataclass(frozen=True, eq=False)
class Expected:
    """What a state became until the next view: mean (8,), covariance (8, 8), and how much of each
    part of it is left in that, `step` (8, 8)."""

    mean: Array
    covariance: Array
    step: Array

    def without(self, part: slice, variances: Array) -> "Expected":
        """The same with a part of the state forgotten: nothing is left of it but variances."""
        mean, covariance, step = self.mean.copy(), self.covariance.copy(), self.step.copy()
        mean[part] = 0.0
        step[part] = 0.0
        covariance[part] = covariance[:, part] = 0.0
        covariance[part, part] = np.diag(variances)
        return Expected(mean, covariance, step)


def predicted(
    model: Model,
    mean: Array,
    covariance: Array,
    seconds: float,
    moved: Displacement | None,
    told_noise: Array,
) -> Expected:
    """What a state is expected to be after so many seconds.

    `told_noise` (2,) are the variances with which told heading and log scale scatter from view to
    view: what was wrong with the last ones says that much less of these, unless the camera saw how
    they changed.
    """
    mean, step = mean.copy(), np.eye(STATE)
    noise = np.zeros((STATE, STATE))
    noise[range(4, 8), range(4, 8)] = model.drift(seconds)
    if moved is None or not moved.relative:
        noise[HEADING, HEADING] += told_noise[0]
        noise[SCALE, SCALE] += told_noise[1]
    if moved is None:
        step[0, 2] = step[1, 3] = seconds
        power = model.accel_mps2**2
        for axis in (0, 1):
            noise[axis, axis] = power * seconds**4 / 4
            noise[axis, axis + 2] = noise[axis + 2, axis] = power * seconds**3 / 2
            noise[axis + 2, axis + 2] = power * seconds**2
        return Expected(step @ mean, step @ covariance @ step.T + noise, step)
    east, north = moved.moved_en_m
    scale = np.eye(2)
    by_bias = np.zeros((2, 2))
    if moved.relative:
        cos, sin = math.cos(mean[HEADING]), math.sin(mean[HEADING])
        scale = math.exp(mean[SCALE]) * np.array([[cos, sin], [-sin, cos]])
        by_bias = np.stack([scale @ [north, -east], scale @ [east, north]], axis=1)
    gone = scale @ [east, north]
    spread = scale @ moved.covariance @ scale.T
    per_s = 1 / max(seconds, 1e-3)
    if moved.relative:
        mean[HEADING] += moved.turned_rad
        mean[SCALE] += moved.scaled
        noise[HEADING, HEADING] += moved.turned_std_rad**2
        noise[SCALE, SCALE] += moved.scaled_std**2
    mean[POSITION] += gone
    mean[VELOCITY] = gone * per_s
    step[VELOCITY, VELOCITY] = 0
    step[POSITION, 4:6] = by_bias
    step[VELOCITY, 4:6] = by_bias * per_s
    into = np.zeros((STATE, 2))
    into[POSITION], into[VELOCITY] = np.eye(2), np.eye(2) * per_s
    noise += into @ spread @ into.T
    noise[VELOCITY, VELOCITY] += np.eye(2) * (model.accel_mps2 * seconds) ** 2
    return Expected(mean, step @ covariance @ step.T + noise, step)


def held_to_map(model: Model, expected: Expected, area_m2: float) -> Expected:
    """The same, with a position that is known to be on the map at least.

    Where no more than that is left of it, it is forgotten, with the velocity.
    """
    if float(np.linalg.eigvalsh(expected.covariance[POSITION, POSITION])[-1]) <= area_m2:
        return expected
    return expected.without(slice(0, 4), np.repeat([area_m2, model.speed_mps**2], 2))


def knocked(model: Model, expected: Expected) -> Expected:
    """The same where heading, scale and lean are no longer what they were."""
    return expected.without(slice(4, 8), model.initial_bias(model.knocked_lean_rad))


def reading(model: Model, told: Told, sighting: Sighting) -> tuple[Array, Array]:
    """What a sighting says of the state (6,), in the order of `SEEN`, and its covariance (6, 6)."""
    noise = sighting.covariance.copy()
    noise[:2, :2] *= model.sighting_growth
    floor = [model.sighting_noise_m] * 2 + [HEADING_FLOOR_RAD, SCALE_FLOOR]
    noise[range(6), range(6)] += np.square([*floor, model.lean_noise_rad, model.lean_noise_rad])
    seen = sighting.mean.copy()
    if told.heading_rad is None:
        seen[2] = 0.0
        noise[2, :] = noise[:, 2] = 0.0
        noise[2, 2] = math.pi**2
    else:
        seen[2] = math.remainder(seen[2] - told.heading_rad, 2 * math.pi)
    seen[4:] -= [told.pitch_rad, told.roll_rad]
    return seen, noise


def updated(mean: Array, covariance: Array, off: Array, spread: Array) -> tuple[Array, Array]:
    """Mean and covariance after a sighting that lies `off` (6,), with covariance `spread`."""
    gain = np.linalg.solve(spread, covariance[SEEN]).T
    after = covariance - gain @ spread @ gain.T
    return mean + gain @ off, (after + after.T) / 2


def log_density(off: Array, spread: Array) -> float:
    """Natural logarithm of a Gaussian's density at `off` (N,)."""
    _, log_det = np.linalg.slogdet(2 * math.pi * spread)
    return float(-0.5 * (off @ np.linalg.solve(spread, off) + log_det))
