"""A logistic confidence that is right as often as it says."""

import math

import numpy as np
import pytest

from orthonav.core.errors import VariantError
from orthonav.core.localize.confidence import (
    DEFAULT_TILE_CONFIDENCE,
    TILE_FEATURES,
    LogisticConfidence,
)
from orthonav.ground.build.calibrate import fit_few, fit_weights

TRUTH = LogisticConfidence(-6.0, (5.0, 12.0))


def synthetic(count, seed):
    """Evidence on unlike scales, right or wrong as `TRUTH` says."""
    rng = np.random.default_rng(seed)
    features = np.stack([rng.normal(0.6, 0.2, count), rng.exponential(0.2, count)], axis=1)
    return features, rng.random(count) < probabilities(TRUTH, features)


def probabilities(model, features):
    rows = [dict(zip(TILE_FEATURES, row, strict=True)) for row in features]
    return np.array([model(row) for row in rows])


def test_it_is_right_as_often_as_it_says():
    features, right = synthetic(4000, seed=1)
    fresh, fresh_right = synthetic(20_000, seed=2)
    said = probabilities(LogisticConfidence(*fit_weights(features, right, np.ones(4000))), fresh)
    deciles = np.digitize(said, np.linspace(0.1, 0.9, 9))
    for decile in range(10):
        inside = deciles == decile
        assert inside.sum() > 300
        assert fresh_right[inside].mean() == pytest.approx(said[inside].mean(), abs=0.06)
    assert fresh_right.mean() == pytest.approx(said.mean(), abs=0.02)


@pytest.mark.parametrize("flip", [(-1, 1), (1, -1), (-1, -1)])
def test_weights_are_never_negative(flip):
    features, right = synthetic(3000, seed=5)
    found = LogisticConfidence(*fit_weights(features * flip, right, np.ones(3000)))
    assert all(weight >= 0 for weight in found.weights)
    for weight, sign in zip(found.weights, flip, strict=True):
        assert (weight == 0) == (sign < 0)


@pytest.mark.parametrize("usual", [DEFAULT_TILE_CONFIDENCE, None])
def test_few_trials_move_the_usual_confidence_and_without_any_nothing_is_confident(usual):
    evidence = {"score": 0.6, "margin": 0.2}
    features, weight = np.tile([0.6, 0.2], (20, 1)), np.ones(20)
    none = fit_few(np.zeros((0, 2)), np.zeros(0, np.bool_), np.zeros(0), usual)
    wrong = fit_few(features, np.zeros(20, np.bool_), weight, usual)
    few = fit_few(features, np.arange(20) < 8, weight, usual)
    assert wrong(evidence) < few(evidence)
    assert none({"score": 1.0, "margin": 1.0}) < 0.2


@pytest.mark.parametrize(
    "plain",
    [
        *(None, [], {}, {"bias": 1}, {"bias": 1, "weights": [1, 2]}),
        {"bias": 1, "weights": {"score": 1}},
        {"bias": "x", "weights": {"score": 1, "margin": 1}},
        {"bias": math.nan, "weights": {"score": 1, "margin": 1}},
        {"bias": 1, "weights": {"score": math.inf, "margin": 1}},
        {"bias": 1, "weights": {"score": -1, "margin": 1}},
    ],
)
def test_what_is_no_confidence_is_refused(plain):
    with pytest.raises(VariantError, match="confidence"):
        LogisticConfidence.from_plain(plain)
