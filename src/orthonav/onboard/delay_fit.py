"""Fit of the seen to the reported motion of pictures: the arithmetic of `orthonav.onboard.delay`.

For a delay d, the seen turn of a pair of pictures is the reported one, `turn(d)`, and the seen
shift is

    tilt(d) + scale velocity(d) + across J velocity(d) + mount J tilt(d) + constant seconds

with J the rotation by 90 deg. These five linear parameters have Gaussian priors.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

TURN_STD_RAD, SHIFT_STD = 0.003, 0.004
"""Least standard deviations of differences: attitudes of autopilots jitter by about 0.1 deg, and
corners are found to 0.1 px where the focal length is 200 px."""
SHARE_STD = 0.08
"""Standard deviation of the shift by velocity as a share of it: relief, changes of height."""
OUTLIER = 3.0
"""Scale of the Cauchy weights, in standard deviations."""
ALIKE = 4.0
"""Differences of successive pairs are correlated: so many count as one. Chosen so that errors of
the estimate are as large as stated (tests/onboard/test_delay.py)."""
STEPS = 5
MAD_TO_STD = 1.4826
TRIMMED = 0.2
"""Share of the pairs, those that fit worst, that is left out of the explained share."""
STANDS_OUT = 2.0
"""Motion of so many least standard deviations stands out."""
SUMS = 33
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """Mean and standard deviations (5,) of the linear parameters."""

    mean: Array
    std: Array

    @property
    def precision(self) -> Array:
        """Matrix (5, 5)."""
        return np.diag(1 / np.square(self.std))


@dataclass(frozen=True, eq=False)
class Pairs:
    """N pairs of pictures and the motion reported for C candidates of the delay.

    `seconds` (N,), `ends_s` (N,): duration of a pair, and its end before that of the last (<= 0).
    `turn` (N,), `shift` (N, 2): seen. `reported` (N, C, 5): turn, tilt (2), velocity (2), NaN where
    not known. `sums` (N, C, 33): see `pair_sums`.
    """

    seconds: Array
    ends_s: Array
    turn: Array
    shift: Array
    reported: Array
    sums: Array

    def noise(self) -> Array:
        """Least standard deviations (2,) of turn and shift."""
        some = np.nan_to_num(self.reported[:, ::20, 3:])
        size = np.sqrt(np.square(some).sum(axis=-1).mean())
        return np.array([TURN_STD_RAD, np.hypot(SHIFT_STD, SHARE_STD * size)])


@dataclass(frozen=True, eq=False)
class Coarse:
    """Fit of every candidate: `cost` (C,), linear parameters `linear` (C, 5), `covariance`
    (C, 5, 5), and the share `known` (C,) of pairs whose motion is known."""

    cost: Array
    linear: Array
    covariance: Array
    known: Array


@dataclass(frozen=True, eq=False)
class Fit:
    """Fit of one delay a pair: `linear` (5,), differences `turn_off` (N,) and `shift_off` (N, 2),
    `weights` (N,), and derivatives `columns` (N, 2, 5)."""

    linear: Array
    turn_off: Array
    shift_off: Array
    weights: Array
    columns: Array

    def scatter(self, least: Array) -> Array:
        """Standard deviations (2,) of turn and shift by the differences."""
        if not self.weights.any():
            return least
        known = self.weights > 0
        turn, shift = np.abs(self.turn_off[known]), np.abs(self.shift_off[known])
        return np.asarray(
            np.maximum(least, MAD_TO_STD * np.array([np.median(turn), np.median(shift)]))
        )


def columns(seconds: Array, reported: Array) -> Array:
    """Derivatives (..., 2, 5) of the shift by the linear parameters; `reported` (..., 5)."""
    tilt, velocity = reported[..., 1:3], reported[..., 3:5]
    made = np.zeros((*reported.shape[:-1], 2, 5))
    made[..., 0], made[..., 1], made[..., 2] = velocity, rotated(velocity), rotated(tilt)
    made[..., 0, 3] = made[..., 1, 4] = seconds
    return made


def rotated(vectors: Array) -> Array:
    """Vectors (..., 2) turned by 90 deg, from right to down."""
    return np.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)


def pair_sums(seconds: float, turn: float, shift: Array, reported: Array) -> Array:
    """What a pair adds to the normal equations of each candidate (C, 33): 25 and 5 products of
    columns with columns and shift, squares of shift and of the difference in turn, and whether its
    motion is known. `reported` (C, 5)."""
    known = np.asarray(np.isfinite(reported[:, :3]).all(axis=1), np.float64)
    reported = np.nan_to_num(reported)
    lines = columns(np.asarray(seconds), reported)
    wanted = shift - reported[:, 1:3]
    parts = [
        np.einsum("cij,cik->cjk", lines, lines).reshape(-1, 25),
        np.einsum("cij,ci->cj", lines, wanted),
        np.square(wanted).sum(axis=1)[:, None],
        np.square(turn - reported[:, :1]),
        np.ones((len(reported), 1)),
    ]
    return np.asarray(np.concatenate(parts, axis=1) * known[:, None])


def coarse(sums: Array, weights: Array, noise: Array, prior: MotionPrior) -> Coarse:
    """Fit of every candidate with `weights` (N,) of the pairs."""
    total = (weights @ sums.reshape(len(weights), -1)).reshape(sums.shape[1:])
    count = np.maximum(total[:, 32], 1e-9)
    total = total * (weights.sum() / count)[:, None]
    shift2 = noise[1] ** 2
    normal = total[:, :25].reshape(-1, 5, 5) / shift2 + prior.precision
    right = total[:, 25:30] / shift2 + prior.precision @ prior.mean
    linear = np.linalg.solve(normal, right[..., None])[..., 0]
    least = total[:, 30] / shift2 + prior.mean @ prior.precision @ prior.mean
    cost = least - (linear * right).sum(axis=1) + total[:, 31] / noise[0] ** 2
    known = np.asarray(sums[..., 32].mean(axis=0))
    return Coarse(cost, linear, np.linalg.inv(normal) * ALIKE, known)


def fitted(pairs: Pairs, reported: Array, noise: Array, prior: MotionPrior) -> Fit:
    """Fit for `reported` (N, 5), with standard deviations `noise` (2,) of turn and shift."""
    known = np.asarray(np.isfinite(reported[:, :3]).all(axis=1), np.float64)
    reported = np.nan_to_num(reported)
    lines = columns(pairs.seconds, reported)
    turn_off = pairs.turn - reported[:, 0]
    wanted = pairs.shift - reported[:, 1:3]
    weights: Array = known
    for _ in range(3):
        flat = (lines * (weights / noise[1] ** 2)[:, None, None]).reshape(-1, 5)
        normal = flat.T @ lines.reshape(-1, 5) + prior.precision
        linear = np.linalg.solve(normal, flat.T @ wanted.reshape(-1) + prior.precision @ prior.mean)
        shift_off = wanted - lines @ linear
        square: Array = np.square(turn_off / noise[0])
        square = square + np.square(shift_off / noise[1]).sum(axis=1)
        weights = known / (1 + square / OUTLIER**2)
    return Fit(linear, turn_off, shift_off, weights, lines)


def at_delays(pairs: Pairs, delays: Array, first: float, step: float) -> tuple[Array, Array]:
    """Reported motion (N, 5) at one delay a pair (N,), and its derivative, by parabolas through
    the candidates `first`, `first + step` .."""
    place = (delays - first) / step
    middle = np.clip(np.round(place).astype(int), 1, pairs.reported.shape[1] - 2)
    off = (place - middle)[:, None]
    rows = np.arange(len(delays))
    before, at, after = (pairs.reported[rows, middle + i] for i in (-1, 0, 1))
    slope, bend = (after - before) / 2, (after - 2 * at + before) / 2
    return at + off * slope + off**2 * bend, (slope + 2 * off * bend) / step


def refined(
    pairs: Pairs, delay: float, noise: Array, prior: MotionPrior, grid: tuple[float, float, float]
) -> tuple[Array, Array, Fit]:
    """Delay at the end of the window and its drift (2,), their covariance (2, 2), and the fit, by
    Gauss-Newton steps from a delay. `grid`: first candidate, step, and the standard deviation of
    the drift."""
    first, step, drift_std = grid
    found: Array = np.array([delay, 0.0])
    wide = np.zeros(7)
    wide[0], wide[1], wide[2:] = 1e-6, 1 / drift_std**2, 1 / np.square(prior.std)
    for _ in range(STEPS):
        reported, slope = at_delays(pairs, found[0] + found[1] * pairs.ends_s, first, step)
        fit = fitted(pairs, reported, noise, prior)
        slope = np.nan_to_num(slope)
        by_delay = np.concatenate([slope[:, :1], _shift_slope(slope, fit.linear)], axis=1)
        design = np.zeros((len(slope), 3, 7))
        design[:, :, 0], design[:, :, 1] = by_delay, by_delay * pairs.ends_s[:, None]
        design[:, 1:, 2:] = fit.columns
        off = np.concatenate([fit.turn_off[:, None], fit.shift_off], axis=1)
        precise = fit.weights[:, None] / np.square(noise[[0, 1, 1]]) / ALIKE
        flat = (design * precise[..., None]).reshape(-1, 7)
        right = flat.T @ off.reshape(-1)
        right -= wide * np.array([0.0, found[1], *(fit.linear - prior.mean)])
        normal = flat.T @ design.reshape(-1, 7) + np.diag(wide)
        covariance = np.asarray(np.linalg.inv(normal), np.float64)
        found = np.asarray(found + np.clip((covariance @ right)[:2], -step, step))
    return found, covariance[:2, :2], fit


def _shift_slope(slope: Array, linear: Array) -> Array:
    """Derivative (N, 2) of the modelled shift by the delay."""
    tilt, velocity = slope[:, 1:3], slope[:, 3:5]
    modelled = tilt + linear[2] * rotated(tilt) + linear[0] * velocity
    return np.asarray(modelled + linear[1] * rotated(velocity))


def explained(pairs: Pairs, fit: Fit, stands_out: float = STANDS_OUT) -> float:
    """`explained_share` of a fit."""
    return explained_share(
        pairs.seconds, pairs.turn, pairs.shift, fit.turn_off, fit.shift_off, stands_out
    )


def explained_share(
    seconds: Array, turn: Array, shift: Array, turn_off: Array, shift_off: Array, stands_out: float
) -> float:
    """Least share of the motion that is explained, of turn (N,) and of the varying part of shift
    (N, 2), where it is at least `stands_out` least standard deviations; NaN where neither is.

    `seconds` (N,): durations. `turn_off` (N,), `shift_off` (N, 2): seen less reported motion.
    """
    varying = shift - np.median(shift / seconds[:, None], axis=0) * seconds[:, None]
    parts = (
        (turn[:, None], turn_off[:, None], TURN_STD_RAD),
        (varying, shift_off, SHIFT_STD),
    )
    shares = []
    for seen, off, least in parts:
        seen2, off2 = np.square(seen).sum(axis=1), np.square(off).sum(axis=1)
        modelled2 = np.square(seen - off).sum(axis=1)  # reported motion that is not seen counts too
        used = np.argsort(off2)[: round((1 - TRIMMED) * len(off2))]
        moved = max(float(seen2[used].mean()), float(modelled2[used].mean()))
        if moved > (stands_out * least) ** 2:
            shares.append(1 - float(off2[used].mean()) / moved)
    return min(shares) if shares else float("nan")
