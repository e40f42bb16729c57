"""Ratios by hand, and a logistic confidence that is right as often as it says."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.core.errors import VariantError
from orthonav.core.localize.confidence import (
    TILE_FEATURES,
    USUAL_TILES,
    LogisticConfidence,
)
from orthonav.core.localize.tiles import MAX_RATIO, lowe_ratio, peak_ratio, rival_score
from orthonav.ground.build.fit import fit_few, fit_logistic


def scores(*values):
    return np.array(values, dtype=np.float32)


@pytest.mark.parametrize(
    "values, expected",
    [
        ((0.5, 1.0, 0.25), 2.0),
        ((1.0, 1.0), 1.0),
        ((0.75, 0.5), 1.5),
        ((1.0, 0.0), MAX_RATIO),
        ((1.0, -0.5), MAX_RATIO),
        ((1.0, 0.01), MAX_RATIO),
        ((-0.5, -0.25), 1.0),
        ((0.0, -1.0), 1.0),
        ((0.5,), MAX_RATIO),
        ((), MAX_RATIO),
    ],
)
def test_lowe_ratio_by_hand(values, expected):
    assert lowe_ratio(scores(*values)) == expected


LINE_EN_M = np.array([[0, 0], [10, 0], [20, 0], [100, 0]], dtype=np.float32)


@pytest.mark.parametrize(
    "exclusion_m, expected",
    [(0, 0.9), (9.9, 0.9), (10, 0.8), (19.9, 0.8), (20, 0.3), (100, 1.0), (1000, 1.0)],
)
def test_rival_lies_beyond_the_exclusion_radius(exclusion_m, expected):
    """Without any tile out there the best is its own rival: nothing stands out."""
    rival = rival_score(scores(1.0, 0.9, 0.8, 0.3), LINE_EN_M, 0, exclusion_m)
    assert rival == pytest.approx(expected)


def test_peak_ratio_ignores_the_neighbour_that_lowes_ratio_sees():
    values = scores(1.0, 0.95, 0.8, 0.5)
    assert lowe_ratio(values) == pytest.approx(1 / 0.95)
    assert peak_ratio(1.0, rival_score(values, LINE_EN_M, 0, 30)) == pytest.approx(2)


TRUTH = LogisticConfidence(-6.0, (5.0, 12.0))


def synthetic(count, seed):
    """Evidence on unlike scales, right or wrong as `TRUTH` says."""
    rng = np.random.default_rng(seed)
    features = np.stack([rng.normal(0.6, 0.2, count), rng.exponential(0.2, count)], axis=1)
    return features, rng.random(count) < probabilities(TRUTH, features)


def probabilities(model, features):
    rows = [dict(zip(TILE_FEATURES, row, strict=True)) for row in features]
    return np.array([model(row) for row in rows])


def test_known_weights_are_found_again():
    features, right = synthetic(40_000, seed=0)
    found = fit_logistic(features, right, np.ones(len(right)))
    assert found.weights == pytest.approx(TRUTH.weights, rel=0.1)
    assert found.bias == pytest.approx(TRUTH.bias, rel=0.1)


def test_it_is_right_as_often_as_it_says():
    features, right = synthetic(4000, seed=1)
    fresh, fresh_right = synthetic(20_000, seed=2)
    said = probabilities(fit_logistic(features, right, np.ones(4000)), fresh)
    deciles = np.digitize(said, np.linspace(0.1, 0.9, 9))
    for decile in range(10):
        inside = deciles == decile
        assert inside.sum() > 300
        assert fresh_right[inside].mean() == pytest.approx(said[inside].mean(), abs=0.06)
    assert fresh_right.mean() == pytest.approx(said.mean(), abs=0.02)


@pytest.mark.parametrize("flip", [(-1, 1), (1, -1), (-1, -1)])
def test_weights_are_never_negative(flip):
    features, right = synthetic(3000, seed=5)
    found = fit_logistic(features * flip, right, np.ones(3000))
    assert all(weight >= 0 for weight in found.weights)
    for weight, sign in zip(found.weights, flip, strict=True):
        assert (weight == 0) == (sign < 0)


@pytest.mark.parametrize("right", [True, False], ids=["all right", "all wrong"])
def test_one_sided_data_gives_a_finite_answer(right):
    features, _ = synthetic(200, seed=6)
    found = fit_logistic(features, np.full(200, right), np.ones(200))
    assert all(map(math.isfinite, (found.bias, *found.weights)))
    said = probabilities(found, features)
    assert (said > 0.9).all() if right else (said < 0.1).all()


@pytest.mark.parametrize("usual", [USUAL_TILES, None])
def test_few_trials_move_the_usual_confidence_and_without_any_nothing_is_confident(usual):
    evidence = {"score": 0.6, "margin": 0.2}
    features, weight = np.tile([0.6, 0.2], (20, 1)), np.ones(20)
    none = fit_few(np.zeros((0, 2)), np.zeros(0, np.bool_), np.zeros(0), usual)
    wrong = fit_few(features, np.zeros(20, np.bool_), weight, usual)
    few = fit_few(features, np.arange(20) < 8, weight, usual)
    assert wrong(evidence) < few(evidence)
    assert none({"score": 1.0, "margin": 1.0}) < 0.2


@given(st.floats(-50, 50), st.tuples(st.floats(0, 50), st.floats(0, 50)))
def test_plain_round_trip(bias, weights):
    model = LogisticConfidence(bias, weights)
    assert LogisticConfidence.from_plain(model.to_plain()) == model


@pytest.mark.parametrize(
    "plain",
    [
        None,
        [],
        {},
        {"bias": 1},
        {"bias": 1, "weights": [1, 2]},
        {"bias": 1, "weights": {"score": 1}},
        {"bias": "x", "weights": {"score": 1, "margin": 1}},
        {"bias": None, "weights": {"score": 1, "margin": 1}},
        {"bias": math.nan, "weights": {"score": 1, "margin": 1}},
        {"bias": 1, "weights": {"score": math.inf, "margin": 1}},
        {"bias": 1, "weights": {"score": -1, "margin": 1}},
    ],
)
def test_what_is_no_confidence_is_refused(plain):
    with pytest.raises(VariantError, match="confidence"):
        LogisticConfidence.from_plain(plain)


def test_separable_and_constant_evidence_give_finite_weights():
    features = np.stack([np.linspace(0, 1, 100), np.full(100, 0.3)], axis=1)
    found = fit_logistic(features, features[:, 0] > 0.5, np.ones(100))
    assert all(map(math.isfinite, (found.bias, *found.weights)))
    said = probabilities(found, features)
    assert said[0] < 0.1 and said[-1] > 0.9
