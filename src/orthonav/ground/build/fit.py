"""Fits of confidences to views that came out right or not."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar

from orthonav.core.localize.confidence import (
    TILE_FEATURES,
    USUAL_SHIFT,
    Chances,
    LogisticConfidence,
    RegisteredConfidence,
    features_of,
    logit,
)

RIDGE = 3e-2
"""Weight of the usual bias."""
MAX_SHIFT = 5.0
LEAST = 1e-9
"""Keeps the loss finite."""
TILE_RIDGE = 1e-3
"""Only against weights without bound where right and wrong separate fully."""
FEW_RIGHT, FEW = 0.5, 5.0
"""Trials, right ones and all, added to those of a map without a usual confidence."""


def fit_registered(
    evidence: Sequence[Mapping[str, float]], right: NDArray[np.bool_], chances: Chances
) -> RegisteredConfidence:
    """The usual confidence with its first bias fitted to views (N) and drawn to the usual one."""
    usual = RegisteredConfidence.usual(chances)
    features = [features_of(each, chances) for each in evidence]

    def shifted(shift: float) -> RegisteredConfidence:
        return replace(usual, biases=(usual.biases[0] + shift, usual.biases[1]))

    def loss(shift: float) -> float:
        model = shifted(shift)
        said = np.clip([model.of(each) for each in features], LEAST, 1 - LEAST)
        return float(RIDGE * shift**2 - np.log(np.where(right, said, 1 - said)).mean())

    return shifted(float(minimize_scalar(loss, bounds=(-MAX_SHIFT, MAX_SHIFT)).x))


def fit_logistic(
    features: NDArray[np.float64], right: NDArray[np.bool_], sample_weight: NDArray[np.float64]
) -> LogisticConfidence:
    return LogisticConfidence(*fit_weights(features, right, sample_weight))


def fit_few(
    features: NDArray[np.float64],
    right: NDArray[np.bool_],
    sample_weight: NDArray[np.float64],
    usual: LogisticConfidence | None,
) -> LogisticConfidence:
    """The `usual` confidence, its bias drawn to trials of which too few came out right for a fit.

    Without one, or without any trial, the fraction of right trials, whatever the evidence.
    """
    if usual is None or len(features) == 0:
        share = (sample_weight @ right + FEW_RIGHT) / (sample_weight.sum() + FEW)
        return LogisticConfidence(logit(float(share), TILE_RIDGE), (0.0,) * len(TILE_FEATURES))
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
    ridge: float = TILE_RIDGE,
) -> tuple[float, tuple[float, ...]]:
    """Bias and weights (at least 0) of a logistic regression with a slight ridge.

    `features` (N, F) are standardized inside; the result applies to raw ones.
    """
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
