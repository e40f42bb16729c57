"""From trials at scattered places to a probability of a fix for every place.

Nearby trials, weighted by distance, are joined with a logistic regression over all trials of the
map (on persistence and on the part of a view that the map covers) as a beta distribution, in which
the regression counts as some trials. Trials show the map's own imagery with simulated
ageing; real ground changes more or less than that. A recalibration, fitted to real scenes of two
dates (`python -m benchmarks.check_trust --fit`), turns rates of trials into predicted ones.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from orthonav.ground.build.calibrate import fit_weights

if TYPE_CHECKING:
    from orthonav.ground.check.trials import Trial

Array = NDArray[np.float64]
INTERVAL = (0.1, 0.9)
"""Ends of the 80 % interval."""


@dataclass(frozen=True)
class Recalibration:
    """Logit of the predicted rate: `shift` + `slope` times that of trials + corrections.

    `narrow`: for every halving of the width of a view below 256 pixels; `no_prior`: without a prior
    position; `std`: standard deviation of the logit from scene to scene, and `std_narrow`
    what every such halving adds to it, both 0 or more.
    """

    shift: float
    slope: float
    narrow: float
    no_prior: float
    std: float
    std_narrow: float = 0.0

    def __call__(self, share: Array, view_px: float, has_prior: bool) -> Array:
        """Predicted rates (N,) from those of trials, for views `view_px` pixels of the map."""
        added = self.shift + self.narrow * _octaves(view_px) + self.no_prior * (not has_prior)
        return _held(expit(self.slope * logit(share) + added))

    def std_of(self, view_px: float) -> float:
        """Standard deviation of the logit from scene to scene for views of this width."""
        return self.std + self.std_narrow * _octaves(view_px)

    def of_camera(self, kind: str) -> "Recalibration":
        """For a camera of a kind of `CAMERA_KINDS`."""
        shift, std = CAMERA_SHIFTS[kind]
        return replace(self, shift=self.shift + shift, std=math.hypot(self.std, std))


def _octaves(view_px: float) -> float:
    """Halvings of the width of a view from 256 pixels of the map to `view_px`."""
    return max(0.0, math.log2(256.0 / max(view_px, 1.0)))


def _held(share: Array) -> Array:
    """Between 0.01 and 0.99: no check is more certain of fixes, or of their absence."""
    return np.asarray(np.clip(share, 0.01, 0.99))


def logit(share: Array) -> Array:
    """Logarithm of the odds of rates, which are held off 0 and 1."""
    held = _held(share)
    return np.asarray(np.log(held / (1 - held)))


def expit(value: Array) -> Array:
    return np.asarray(1 / (1 + np.exp(-value)))


PLAIN = Recalibration(0.0, 1.0, 0.0, 0.0, 0.6)
"""Trials as they are; between dates of generated and NAIP imagery the logit differs by 0.6."""
LEARNT = Recalibration(0.92, 0.42, -0.81, 0.06, 0.8, 0.6)
"""What checks use: fitted to 76 conditions of nine scenes of two dates (docs/check.md)."""
CAMERA_SHIFTS = {
    "colour": (0.0, 0.0),
    "other": (-0.8, 0.8),
    "near-infrared": (-0.8, 0.8),
    "thermal": (-1.0, 1.6),
}
"""What cameras in other light than the map's add to the logit, and its standard deviation.
Assumptions: *other* rests on one flight, a drone over two satellite maps (-0.6, -1.0), the next on
four real and two rendered pairs, *thermal* on rendered ones only (docs/check.md)."""


@dataclass(frozen=True)
class Pooling:
    """How trials are pooled. Without a source: chosen on generated landscapes by the calibration
    error of predictions."""

    prior_trials: float = 3.0  # that the regression counts as
    bandwidth_views: float = 0.4  # standard deviation of the distance weights, in sides of a view,
    bandwidth_spacings: float = 0.9  # and at least, in distances between trials
    same_coverage: float = 0.12
    """Standard deviation of the weights over the fraction of a view that the map covers."""
    min_weight: float = 0.05  # where nearby trials weigh less,
    wider: float = 4.0  # the bandwidth is so many times as wide
    other_date: float = 3.0
    """Weight of a trial with imagery of a second date, which needs no simulated ageing."""
    jeffreys: float = 0.3  # pseudo-counts of good and bad trials: the interval is off 0 and 1
    min_regression: int = 20  # fewer trials do not support a regression
    ridge: float = 1e-2
    max_stated: float = 2.0  # an error counts as at most so many times what its covariance states
    unseen_wrong: float = 0.06
    """False fixes that are presumed in `unseen_trials` more: of 30,013 views, half of them of other
    ground, none was available and beyond the alert limit (docs/benchmarks.md, integrity)."""
    unseen_trials: float = 500.0


POOLING = Pooling()


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predictions for places, arrays of one shape: cells, or points along a route.

    `probability`: of a correct, confident fix of one view; `low`, `high`: its 80 % interval.
    `error_m`: expected error of such a fix, root mean square.
    `wrong`: fraction of trials that were false fixes.
    `persistence`: expected correlation of the ground with another year, 0 to 1.
    """

    probability: Array
    low: Array
    high: Array
    error_m: Array
    wrong: Array
    persistence: Array


class Predictor:
    def __init__(
        self,
        trials: "Sequence[Trial]",
        *,
        view_side_m: float,
        spacing_m: float,
        other_date: "Sequence[Trial]" = (),
        least_error_m: float = 0.0,
        coverage: Callable[[Array], Array],
        recalibrated: Callable[[Array], Array] = np.asarray,
        scenes_std: float = PLAIN.std,
    ) -> None:
        """`trials` of the map's own imagery, `other_date` of a second date.

        `coverage` returns the fraction (N,) of a view over places (N, 2) that the map covers;
        trials count for places of similar coverage. `recalibrated` turns rates (N,) of trials into
        those of views of another date, whose logit varies from scene to scene by `scenes_std`.
        """
        every = [*trials, *other_date]
        self._points = np.array([each.en_m for each in every], np.float64).reshape(-1, 2)
        # A fix may be better than its covariance by chance. The protection level allows for tails:
        # they do not count twice.
        errors = np.array([(each.error_m, each.stated_m) for each in every], np.float64)
        error, stated = errors.reshape(-1, 2).T
        self._error = np.fmin(np.fmax(error, stated), POOLING.max_stated * stated)
        self.right = np.array([each.right for each in every], np.bool_)
        self.wrong = np.array([each.wrong for each in every], np.bool_)
        self._weight = np.array([1.0] * len(trials) + [POOLING.other_date] * len(other_date))
        self._bandwidth_m = max(
            POOLING.bandwidth_views * view_side_m, POOLING.bandwidth_spacings * spacing_m
        )
        self._least_error_m = least_error_m
        self._coverage_at, self._coverage = coverage, coverage(self._points)
        self._persistence = self._persistence_of(trials, other_date)
        self._recalibrated, self.scenes_std = recalibrated, scenes_std
        self._expected = self._regression()

    @property
    def mean_std(self) -> float:
        """Standard error of the logit of the predicted mean chance, by the number of trials."""
        count = float(self._weight.sum() ** 2 / (self._weight**2).sum())  # Kish 1965
        mean = count * float(np.average(self.right, weights=self._weight))
        mean = min(max((mean + 0.5) / (count + 1), 0.05), 0.95)
        low, high = logit(self._recalibrated(np.array([mean - 0.01, mean + 0.01])))
        return float(high - low) / 0.02 * math.sqrt(mean * (1 - mean) / (count + 1))

    def _persistence_of(self, trials: "Sequence[Trial]", other: "Sequence[Trial]") -> Array:
        """Expected persistence at every trial; a trial of the second date takes the nearest."""
        own = np.array([each.expected for each in trials], np.float64)
        if not other:
            return own
        at = self._points[: len(trials)]
        nearest = [int(np.argmin(((at - each.en_m) ** 2).sum(axis=1))) for each in other]
        return np.concatenate([own, own[nearest]])

    def _regression(self) -> Array:
        """Probability (N,) of each trial by regression on persistence and coverage."""
        # n of n trials do not prove a probability of 1.
        mean = (self.right @ self._weight + 0.5) / (self._weight.sum() + 1)
        if self.right.all() or not self.right.any() or len(self.right) < POOLING.min_regression:
            return np.full(len(self.right), float(mean))
        regressors = np.stack([np.log(self._persistence), self._coverage], axis=1)
        bias, slopes = fit_weights(regressors, self.right, self._weight, POOLING.ridge)
        return expit(bias + regressors @ slopes)

    def at(self, points_en_m: Array) -> Prediction:
        chunk = max(1, 2**20 // max(len(self._points), 1))  # limits memory
        starts = range(0, max(len(points_en_m), 1), chunk)
        parts = [vars(self._part(points_en_m[start : start + chunk])) for start in starts]
        return Prediction(*(np.concatenate([part[name] for part in parts]) for name in parts[0]))

    def _part(self, points: Array) -> Prediction:
        from scipy.stats import beta

        prior = POOLING.prior_trials
        near = self._weights(points, self._bandwidth_m)
        total = near.sum(axis=1)
        # Far from all trials the closest few still tell the kind of ground.
        wide = self._weights(points, POOLING.wider * self._bandwidth_m) + 1e-12
        kind = np.where((total > POOLING.min_weight)[:, None], near, wide)
        kind /= kind.sum(axis=1, keepdims=True)
        expected = np.clip(kind @ self._expected, 0.0, 1.0)  # rounding
        good = prior * expected + near @ self.right
        bad = prior * (1 - expected) + near @ ~self.right
        probability = good / (good + bad)
        # A trial of the second date counts more for the rate, but is one trial.
        alone = (near @ (1 / self._weight) + prior) / (total + prior)
        counts = good * alone + POOLING.jeffreys, bad * alone + POOLING.jeffreys
        low, high = (beta.ppf(end, *counts) for end in INTERVAL)
        probability, low, high = (self._recalibrated(each) for each in (probability, low, high))
        years = 1.2816 * self.scenes_std  # 80 % of a normal distribution
        squares = np.where(self.right, np.nan_to_num(self._error) ** 2, 0.0)
        overall = float(squares.sum() / self.right.sum()) if self.right.any() else math.nan
        square_error = (near @ squares + prior * overall) / (near @ self.right + prior)
        overall_wrong = float(np.average(self.wrong, weights=self._weight))
        unseen = POOLING.unseen_wrong / (float(self._weight.sum()) + POOLING.unseen_trials)
        return Prediction(
            probability=probability,
            low=np.minimum(_widened(probability, low, -years), probability),
            high=np.maximum(_widened(probability, high, years), probability),
            error_m=np.sqrt(square_error + self._least_error_m**2),
            wrong=np.minimum((near @ self.wrong + overall_wrong) / (total + 1.0) + unseen, 1),
            persistence=kind @ self._persistence,
        )

    def _weights(self, points: Array, bandwidth_m: float) -> Array:
        """Weights (N, K) of the trials by distance and by similarity of coverage."""
        square = ((points[:, None] - self._points[None]) ** 2).sum(axis=-1)
        off = self._coverage_at(points)[:, None] - self._coverage[None]
        square += (off * self._bandwidth_m / POOLING.same_coverage) ** 2
        return np.asarray(np.exp(-square / (2 * bandwidth_m**2)) * self._weight)


def _widened(middle: Array, end: Array, by_logit: float) -> Array:
    """`end` of an interval moved outwards by the deviation between years, independent of it."""
    off = np.hypot(logit(end) - logit(middle), by_logit)
    return expit(logit(middle) + np.sign(by_logit) * off)
