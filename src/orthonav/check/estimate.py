"""From trials at scattered places to a probability for every place.

What a place is worth is told by the trials around it and, where these are few, by how much of the
ground there is expected to last: a logistic regression over all trials of the map. Both are joined
as a beta distribution, the regression counting as `PRIOR_TRIALS`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.check.trials import Trial
from orthonav.confidence.logistic import fit_weights

Array = NDArray[np.float64]
PRIOR_TRIALS = 3.0
BANDWIDTH_VIEWS = 0.4
"""Standard deviation of the weights of trials around a place, in sides of a view."""
BANDWIDTH_SPACINGS = 0.9
"""The least of it, in distances between trials."""
OTHER_DATE_WEIGHT = 3.0
"""A trial with pictures of another date says as much as so many without."""
YEARS_LOGIT = 0.6
"""How much years differ from each other: standard deviation of the logit, see docs/check.md."""
INTERVAL, INTERVAL_SIGMAS = (0.1, 0.9), 1.2816
"""80 % lie within."""
JEFFREYS = 0.3
"""So many good and bad trials more keep the interval off 0 and 1."""
ENOUGH, FAR = 0.05, 4.0
"""With less than this weight around, trials so many times as far count too."""
SAME_SEEN = 0.12
"""Standard deviation of the weights over the share of a view that lies on the map."""
RIDGE = 1e-2
_PAIRS_AT_ONCE = 2**20


@dataclass(frozen=True, eq=False)
class Estimate:
    """At places (N,): see `orthonav.check.outcome.Cells`. `weight` is that of the trials around."""

    probability: Array
    low: Array
    high: Array
    error_m: Array
    wrong: Array
    lasting: Array
    weight: Array


def _all_seen(points_en_m: Array) -> Array:
    return np.ones(len(points_en_m))


class Field:
    """What trials say of places."""

    def __init__(
        self,
        trials: Sequence[Trial],
        *,
        radius_m: float,
        accept: float,
        view_side_m: float,
        spacing_m: float,
        other_date: Sequence[Trial] = (),
        least_error_m: float = 0.0,
        seen: Callable[[Array], Array] = _all_seen,
    ) -> None:
        """`trials` of the map's own ground, `other_date` of pictures of another date.

        `seen` tells of places (N, 2) which share of a view there lies on the map (N,): trials count
        for places where it is about the same.
        """
        every = [*trials, *other_date]
        self._points = np.array([each.en_m for each in every], np.float64).reshape(-1, 2)
        self._error = np.array([each.error_m for each in every], np.float64)
        sure = np.array([each.confidence >= accept for each in every], np.bool_)
        near = np.nan_to_num(self._error, nan=np.inf) <= radius_m
        self.right, self.wrong = sure & near, sure & ~near
        self._weight = np.array([1.0] * len(trials) + [OTHER_DATE_WEIGHT] * len(other_date))
        self._bandwidth_m = max(BANDWIDTH_VIEWS * view_side_m, BANDWIDTH_SPACINGS * spacing_m)
        self._least_error_m = least_error_m
        self._seen_at, self._seen = seen, seen(self._points)
        self._lasting = self._lasting_of(trials, other_date)
        self._expected = self._regression()

    def _lasting_of(self, trials: Sequence[Trial], other: Sequence[Trial]) -> Array:
        """Expected persistence at every trial: of those with other pictures that around them."""
        own = np.array([each.expected for each in trials], np.float64)
        if not other:
            return own
        at = self._points[: len(trials)]
        nearest = [int(np.argmin(((at - each.en_m) ** 2).sum(axis=1))) for each in other]
        return np.concatenate([own, own[nearest]])

    def _regression(self) -> Array:
        """The probability that is expected of every trial by how much lasts."""
        # Of n out of n nobody knows that it is always so.
        mean = (self.right @ self._weight + 0.5) / (self._weight.sum() + 1)
        if self.right.all() or not self.right.any() or len(self.right) < 20:
            return np.full(len(self.right), float(mean))
        told = np.stack([np.log(self._lasting), self._seen], axis=1)
        bias, slopes = fit_weights(told, self.right, self._weight, RIDGE)
        return np.asarray(1 / (1 + np.exp(-(bias + told @ slopes))))

    def at(self, points_en_m: Array) -> Estimate:
        """What the trials say of places (N, 2)."""
        chunk = max(1, _PAIRS_AT_ONCE // max(len(self._points), 1))
        parts = [
            self._part(points_en_m[start : start + chunk])
            for start in range(0, max(len(points_en_m), 1), chunk)
        ]
        return Estimate(*(np.concatenate([part[i] for part in parts]) for i in range(7)))

    def _part(self, points: Array) -> tuple[Array, ...]:
        from scipy.stats import beta

        square = ((points[:, None] - self._points[None]) ** 2).sum(axis=-1)
        off = (self._seen_at(points)[:, None] - self._seen[None]) * self._bandwidth_m / SAME_SEEN
        square += off**2
        near = np.exp(-square / (2 * self._bandwidth_m**2)) * self._weight
        total = near.sum(axis=1)
        # Far from all trials the nearest few still say what kind of ground it is.
        wide = np.exp(-square / (2 * (FAR * self._bandwidth_m) ** 2)) * self._weight + 1e-12
        kind = np.where((total > ENOUGH)[:, None], near, wide)
        kind /= kind.sum(axis=1, keepdims=True)
        expected = np.clip(kind @ self._expected, 0.0, 1.0)  # rounding
        good = PRIOR_TRIALS * expected + near @ self.right
        bad = PRIOR_TRIALS * (1 - expected) + near @ ~self.right
        probability = good / (good + bad)
        ends = (beta.ppf(end, good + JEFFREYS, bad + JEFFREYS) for end in INTERVAL)
        years = INTERVAL_SIGMAS * YEARS_LOGIT
        low, high = (
            _widened(probability, end, way) for end, way in zip(ends, (-years, years), strict=True)
        )
        low, high = np.minimum(low, probability), np.maximum(high, probability)
        squares = np.where(self.right, np.nan_to_num(self._error) ** 2, 0.0)
        overall = float(squares.sum() / max(self.right.sum(), 1))
        square_error = (near @ squares + overall) / (near @ self.right + 1.0)
        error = np.sqrt(square_error + self._least_error_m**2)
        everywhere = float(np.average(self.wrong, weights=self._weight))
        wrong = (near @ self.wrong + everywhere) / (total + 1.0)
        return probability, low, high, error, wrong, kind @ self._lasting, total


def _widened(middle: Array, end: Array, by_logit: float) -> Array:
    """An end of an interval moved out for what years differ, both as independent errors."""

    def logit(p: Array) -> Array:
        p = np.clip(p, 1e-4, 1 - 1e-4)
        return np.asarray(np.log(p / (1 - p)))

    off = np.hypot(logit(end) - logit(middle), by_logit)
    moved = logit(middle) + np.sign(by_logit) * off
    return np.asarray(1 / (1 + np.exp(-moved)))
