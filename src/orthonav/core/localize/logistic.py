"""A probability from evidence, by logistic regression learnt when the map is built."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import VariantError

FEATURES = ("score", "margin")
RIDGE = 1e-3
"""Weight of the ridge: only against weights without bound where right and wrong separate fully."""
USUAL_SHIFT = 0.42
"""Standard deviation of the bias from map to map, under the weights of `USUAL`."""
FEW_RIGHT, FEW = 0.5, 5.0
"""Trials, right ones and all, that are added to those of a map without a usual confidence."""
LIMIT = 60.0
"""Largest logit: beyond, the probability is 0 or 1 to all digits of a float."""


@dataclass(frozen=True)
class LogisticConfidence:
    """P(right) = 1 / (1 + exp(-(bias + weights . evidence))).

    `weights` belong to the evidence named in `FEATURES`: the best score, and its lead over the
    best score elsewhere. Weights are never negative: more evidence never means less confidence.
    """

    bias: float
    weights: tuple[float, ...]

    def __call__(self, evidence: Mapping[str, float]) -> float:
        """Probability in 0..1 that the fix is right."""
        total = self.bias + sum(
            weight * evidence[name] for name, weight in zip(FEATURES, self.weights, strict=True)
        )
        return probability(total)

    def to_plain(self) -> dict[str, Any]:
        """Plain values for a manifest."""
        return {"bias": self.bias, "weights": dict(zip(FEATURES, self.weights, strict=True))}

    @classmethod
    def from_plain(cls, plain: Any) -> "LogisticConfidence":
        """Inverse of `to_plain`; raises `VariantError` if it does not fit."""
        try:
            numbers = [float(plain["bias"]), *(float(plain["weights"][name]) for name in FEATURES)]
        except (KeyError, TypeError, ValueError) as error:
            raise VariantError(f"confidence must have bias and weights of {FEATURES}") from error
        if not all(math.isfinite(number) for number in numbers) or min(numbers[1:]) < 0:
            raise VariantError(f"confidence has a weight that is negative or not finite: {plain}")
        return cls(numbers[0], tuple(numbers[1:]))


USUAL = LogisticConfidence(-3.42 - USUAL_SHIFT, (5.87, 12.08))
"""Of tiles of whitened gradients: fitted to the trials of 22 maps of nine scenes, and lower by one
standard deviation (docs/decisions/confidence.md)."""


def probability(logit: float) -> float:
    """The logistic function, cut off where it is 0 or 1 to all digits that matter."""
    return 1 / (1 + math.exp(-min(max(logit, -LIMIT), LIMIT)))


def logit(likely: float, least: float) -> float:
    """Logarithm of the odds of a probability that is taken as `least` to 1 - `least`."""
    inside = min(max(likely, least), 1 - least)
    return math.log(inside / (1 - inside))


def fit_logistic(
    features: NDArray[np.float64], right: NDArray[np.bool_], sample_weight: NDArray[np.float64]
) -> LogisticConfidence:
    """Confidence from `features` (N, len(FEATURES)), as `fit_weights` fits it."""
    return LogisticConfidence(*fit_weights(features, right, sample_weight))


def fit_few(
    features: NDArray[np.float64],
    right: NDArray[np.bool_],
    sample_weight: NDArray[np.float64],
    usual: LogisticConfidence | None,
) -> LogisticConfidence:
    """Confidence from trials, as in `fit_logistic`, of which too few came out right for a fit.

    It is the `usual` one, its bias drawn to the trials as far as they go. Without one, or without
    any trial, it is the share of the trials that came out right, whatever the evidence.
    """
    from scipy.optimize import minimize_scalar  # not needed to fly

    if usual is None or len(features) == 0:
        share = (sample_weight @ right + FEW_RIGHT) / (sample_weight.sum() + FEW)
        return LogisticConfidence(logit(float(share), RIDGE), (0.0,) * len(FEATURES))
    known = features @ np.array(usual.weights) + usual.bias
    sign = np.where(right, 1.0, -1.0)

    def loss(shift: float) -> float:
        off = sample_weight @ np.logaddexp(0, -sign * (known + shift))
        return float(off + (shift / USUAL_SHIFT) ** 2 / 2)

    shift = minimize_scalar(loss, bounds=(-10.0, 10.0)).x
    return LogisticConfidence(usual.bias + float(shift), usual.weights)


def fit_weights(
    features: NDArray[np.float64],
    right: NDArray[np.bool_],
    sample_weight: NDArray[np.float64],
    ridge: float = RIDGE,
) -> tuple[float, tuple[float, ...]]:
    """Bias and weights of a logistic regression: weighted maximum likelihood with a slight ridge.

    Weights are bounded at zero. `features` (N, F), `right` (N,) whether the fix was right,
    `sample_weight` (N,). Features are standardized inside, the result applies to raw ones.
    """
    from scipy.optimize import minimize  # not needed to fly

    mean, std = features.mean(axis=0), features.std(axis=0) + 1e-9
    scaled = (features - mean) / std
    sign = np.where(right, 1.0, -1.0)
    total = sample_weight.sum()

    def loss(parameters: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        logit = parameters[0] + scaled @ parameters[1:]
        value = sample_weight @ np.logaddexp(0, -sign * logit) / total
        slope = -sign * sample_weight / (1 + np.exp(np.clip(sign * logit, -60, 60))) / total
        gradient = np.concatenate([[slope.sum()], scaled.T @ slope])
        gradient[1:] += 2 * ridge * parameters[1:]
        value += ridge * (parameters[1:] ** 2).sum()
        return float(value), gradient

    bounds = [(None, None)] + [(0.0, None)] * features.shape[1]
    found = minimize(
        loss, np.zeros(features.shape[1] + 1), jac=True, bounds=bounds, method="L-BFGS-B"
    ).x
    weights = found[1:] / std
    return float(found[0] - weights @ mean), tuple(float(weight) for weight in weights)
