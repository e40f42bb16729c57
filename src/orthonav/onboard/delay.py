"""Delay of the camera, from exposure to arrival, by comparing pictures with the autopilot.

The motion between consecutive pictures is compared with the motion that follows from attitude,
velocity and height reported at the times of arrival less a candidate of the delay, over a sliding
window: a grid of candidates first, then refined together with a constant drift. What is known only
nearly (height, direction of the velocity, orientation of the camera) is estimated with it. A window
in which many candidates fit, as in straight and level flight, gives no number.

Nothing here reads a clock or a port: the same values give the same estimate.
"""

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from orthonav.onboard.delay_fit import (
    ALIKE,
    SUMS,
    Array,
    Coarse,
    MotionPrior,
    Pairs,
    coarse,
    explained,
    fitted,
    pair_sums,
    refined,
)
from orthonav.onboard.history import StateHistory
from orthonav.onboard.motion import ImageMotion

LEAST_S, MOST_S, STEP_S = -0.5, 12.0, 0.1
"""Candidates of the delay. Below 0: an exposure after the arrival shows clocks that disagree."""
WINDOW_S = 30.0
MOST_PAIRS, LEAST_PAIRS = 300, 12
PAIR_SHARE, KNOWN_SHARE = 0.9, 0.6
"""Share of candidates for which the motion of a pair must be known, and of pairs for one
candidate."""
SCALE_STD, ACROSS_STD, MOUNT_STD_RAD = 0.25, 0.2, 0.08
"""Prior of errors: height (share), direction of the velocity, orientation of the camera (rad)."""
ANY_STD = 1.5
"""Prior of scale and direction where the heading is not known."""
CONSTANT_STD, FREE_STD = 0.01, 0.5
"""Prior of a constant shift per second: by the tilt of the mount; by an unknown velocity."""
DRIFT_STD = 0.02
"""Prior of the drift of the delay, s/s."""
NEAR_S, NEAR_MASS = 0.35, 0.99
"""A delay is found where this probability lies this close to it."""
LARGEST_STD_S, FLOOR_S = 0.3, 0.025
"""Largest standard deviation of an answer; least one: half an interval of the stored states."""
EXPLAINED = 0.6
"""Least share of motion that stands out that the delay must explain."""
UNEXPLAINED, MANY_PAIRS, STANDS_FAR_OUT = 0.3, 40, 4.0
"""Pictures contradict the autopilot where so many pairs, with motion of so many least standard
deviations, are explained by less than this share at any delay."""
SCALES, ACROSS = (0.5, 2.0), 0.6
"""Fitted scale and direction (rad) of the velocity beyond which pictures contradict the
autopilot."""
LEAST_WEIGHT = 0.5
"""Least mean weight of the pairs: 1 without outliers."""
CLEAR_STD = 0.3
"""Standard deviation of the fitted scale below which it can contradict."""
CANDIDATES_S = np.arange(round((MOST_S - LEAST_S) / STEP_S) + 1) * STEP_S + LEAST_S
_CANDIDATES_NS = np.round(CANDIDATES_S * 1e9).astype(np.int64)


@dataclass(frozen=True)
class DelayEstimate:
    """The delay in one window.

    `delay_s`: exposure to arrival at the end of the window; NaN where it is not observable, as the
    next two. `std_s`: its standard deviation. `drift`: its change, s/s.
    `contradicted`: whether pictures do not move as the autopilot reports, at any delay.
    `pairs`: number of compared pairs of pictures.
    `last_ns`: arrival of the last picture.
    """

    delay_s: float = math.nan
    std_s: float = math.nan
    drift: float = math.nan
    contradicted: bool = False
    pairs: int = 0
    last_ns: int = 0

    @property
    def found(self) -> bool:
        """Whether the delay was observable."""
        return math.isfinite(self.delay_s)


class _Store:
    """Pairs of the window in arrays, with room for as many again. Mutable."""

    def __init__(self) -> None:
        rows, candidates = 2 * MOST_PAIRS, len(CANDIDATES_S)
        self._first = self._end = 0
        self._starts, self._ends = np.zeros(rows, np.int64), np.zeros(rows, np.int64)
        self._seen = np.zeros((rows, 3))
        self._reported = np.zeros((rows, candidates, 5))
        self._sums = np.zeros((rows, candidates, SUMS))

    def add(self, motion: ImageMotion, reported: Array) -> None:
        """Add a pair with its reported motion (C, 5)."""
        if self._end - self._first == MOST_PAIRS:
            self._first += 1
        if self._end == len(self._starts):
            self._move_to_front()
        row, self._end = self._end, self._end + 1
        self._starts[row], self._ends[row] = motion.start_ns, motion.end_ns
        self._seen[row] = motion.turn_rad, *motion.shift
        self._reported[row] = reported
        self._sums[row] = pair_sums(motion.seconds, motion.turn_rad, motion.shift, reported)

    def forget_before(self, arrived_ns: int) -> None:
        """Forget pairs of which a picture arrived before a time."""
        self._first += int((self._starts[self._first : self._end] < arrived_ns).sum())

    def window(self, recent_s: float) -> Pairs:
        """The pairs of the last seconds."""
        ends = self._ends[self._first : self._end]
        since = 0 if not len(ends) else int((ends < ends[-1] - recent_s * 1e9).sum())
        rows = slice(self._first + since, self._end)
        ends, starts = self._ends[rows], self._starts[rows]
        return Pairs(
            seconds=(ends - starts) / 1e9,
            ends_s=(ends - self.last_ns) / 1e9,
            turn=self._seen[rows, 0],
            shift=self._seen[rows, 1:],
            reported=self._reported[rows],
            sums=self._sums[rows],
        )

    @property
    def last_ns(self) -> int:
        """Arrival of the last picture; 0 where there is none."""
        return int(self._ends[self._end - 1]) if self._end > self._first else 0

    def _move_to_front(self) -> None:
        count = self._end - self._first
        for each in (self._starts, self._ends, self._seen, self._reported, self._sums):
            each[:count] = each[self._first : self._end]
        self._first, self._end = 0, count


class DelayEstimator:
    """Estimates the delay over a sliding window. Mutable."""

    def __init__(self, *, heading_known: bool = True) -> None:
        """`heading_known`: whether the reported heading gives the direction of the velocity."""
        self._heading_known = heading_known
        self._waiting: deque[ImageMotion] = deque(maxlen=MOST_PAIRS)
        self._store = _Store()

    def forget_before(self, arrived_ns: int) -> None:
        """Forget pictures that arrived before a time, as after a change of the delay."""
        self._store.forget_before(arrived_ns)
        while self._waiting and self._waiting[0].start_ns < arrived_ns:
            self._waiting.popleft()

    def add(self, motion: ImageMotion | None, history: StateHistory) -> None:
        """Add the motion of a pair. It counts once the history reaches beyond all candidates."""
        if motion is not None:
            self._waiting.append(motion)
        reach_ns = round(-LEAST_S * 1e9)
        while self._waiting and self._waiting[0].end_ns + reach_ns <= history.newest_ns:
            one = self._waiting.popleft()
            moved = history.motion(one.start_ns - _CANDIDATES_NS, one.end_ns - _CANDIDATES_NS)
            if np.isfinite(moved.turn_rad).mean() < PAIR_SHARE:
                continue
            parts = moved.turn_rad[:, None], moved.tilt_shift, moved.velocity_shift
            self._store.add(one, np.concatenate(parts, axis=1))
            self._store.forget_before(one.end_ns - round(WINDOW_S * 1e9))

    def estimate(self, recent_s: float = math.inf) -> DelayEstimate:
        """The delay in the window, or in its last `recent_s`."""
        pairs = self._store.window(min(recent_s, WINDOW_S))
        nothing = DelayEstimate(pairs=len(pairs.turn), last_ns=self._store.last_ns)
        if len(pairs.turn) < LEAST_PAIRS:
            return nothing
        prior = _prior(pairs.reported, heading_known=self._heading_known)
        return _estimate(pairs, prior, nothing)


def _prior(reported: Array, *, heading_known: bool) -> MotionPrior:
    unknown = ~np.isfinite(reported[..., 3]) & np.isfinite(reported[..., 0])
    constant = FREE_STD if unknown.any() else CONSTANT_STD
    gain = (SCALE_STD, ACROSS_STD) if heading_known else (ANY_STD, ANY_STD)
    mean = np.array([1.0 if heading_known else 0.0, 0.0, 0.0, 0.0, 0.0])
    return MotionPrior(mean, np.array([*gain, MOUNT_STD_RAD, constant, constant]))


def _estimate(pairs: Pairs, prior: MotionPrior, nothing: DelayEstimate) -> DelayEstimate:
    noise, weights = pairs.noise(), np.ones(len(pairs.turn))
    least = noise
    for _ in range(3):  # robust: pairs that the best candidate does not explain count less
        found = coarse(pairs.sums, weights, noise, prior)
        best = int(np.argmin(found.cost))
        fit = fitted(pairs, pairs.reported[:, best], noise, prior)
        noise, weights = fit.scatter(least), fit.weights
    if (found.known < KNOWN_SHARE).any():
        return nothing  # a delay that cannot be excluded
    if _contradicts(found, best, heading_known=prior.mean[0] > 0):
        return replace(nothing, contradicted=True)
    if len(pairs.turn) >= MANY_PAIRS and explained(pairs, fit, STANDS_FAR_OUT) < UNEXPLAINED:
        return replace(nothing, contradicted=True)
    if weights.mean() < LEAST_WEIGHT:
        return nothing  # too many outliers
    chance = np.exp((found.cost[best] - found.cost) / (2 * ALIKE))
    near = np.abs(CANDIDATES_S - CANDIDATES_S[best]) <= NEAR_S
    if chance[near].sum() < NEAR_MASS * chance.sum():
        return nothing
    grid = LEAST_S, STEP_S, DRIFT_STD
    if not _possible(fit.linear, heading_known=prior.mean[0] > 0):
        return nothing
    (delay, drift), covariance, fit = refined(pairs, float(CANDIDATES_S[best]), noise, prior, grid)
    std_s = math.hypot(FLOOR_S, math.sqrt(covariance[0, 0]))
    share = explained(pairs, fit)
    lost = abs(delay - CANDIDATES_S[best]) > NEAR_S + WINDOW_S * DRIFT_STD
    if lost or std_s > LARGEST_STD_S or not share >= EXPLAINED:
        return nothing
    return replace(nothing, delay_s=float(delay), std_s=std_s, drift=float(drift))


def _contradicts(found: Coarse, best: int, *, heading_known: bool) -> bool:
    """Whether the fitted scale or direction of the velocity is impossible."""
    std = 2 * np.sqrt(np.diag(found.covariance[best])[:2])
    if not std.max() < 2 * CLEAR_STD:
        return False
    scale, across = found.linear[best, :2].tolist()
    size = scale if heading_known else math.hypot(scale, across)
    if not SCALES[0] - std[0] < size < SCALES[1] + std[0]:
        return True
    return heading_known and abs(across) > math.tan(ACROSS) * max(size, SCALES[0]) + std[1]


def _possible(linear: Array, *, heading_known: bool) -> bool:
    """Whether fitted scale and direction of the velocity are those of usual errors."""
    scale, across = linear[:2].tolist()
    turned = abs(math.atan2(across, scale)) if heading_known else 0.0
    return SCALES[0] < math.hypot(scale, across) < SCALES[1] and turned < ACROSS
