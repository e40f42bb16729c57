"""Confidence of registered views: surer with better evidence, and never sure of one place alone."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.confidence.registered import (
    CHANCES,
    FEATURES,
    STAND_IN,
    USUAL_BIAS,
    USUAL_WEIGHTS,
    Chances,
    RegisteredConfidence,
    features_of,
    fit_registered,
)
from orthonav.errors import VariantError

CHANCE = Chances(total=25.0, look=15.0, fine=40.0)
MODEL = RegisteredConfidence(-4.0, (0.5, 11.0, 1.5), CHANCE)

strengths = st.floats(1.0, 300.0)
evidences = st.fixed_dictionaries(
    {name: strengths for name in ("strength", "rival", "look", "look_rival")},
    optional={"fine": strengths, "fine_rival": strengths},
)


def evidence(strength=60.0, rival=30.0, look=35.0, look_rival=18.0, **more):
    return {
        "strength": strength,
        "rival": rival,
        "look": look,
        "look_rival": look_rival,
        "fine": math.nan,
        "fine_rival": math.nan,
        **more,
    }


def test_features_by_hand():
    features = features_of(evidence(50.0, 40.0, 30.0, 20.0), CHANCE)
    np.testing.assert_allclose(np.exp(features), [50 / 25, 50 / 40, 30 / 20])
    assert len(features) == len(FEATURES)


def test_chance_stands_in_for_a_rival_that_is_missing():
    """So that a search of one place only does not look like certainty."""
    for rival in (0.0, 0.5 * STAND_IN * CHANCE.total):
        features = features_of(evidence(50.0, rival, 30.0, 0.0), CHANCE)
        np.testing.assert_allclose(
            np.exp(features),
            [2, 50 / (STAND_IN * CHANCE.total), 30 / (STAND_IN * CHANCE.look)],
        )
    assert MODEL(evidence(strength=14.0, rival=0.0, look=8.0, look_rival=0.0)) < 0.1


def test_the_finer_level_counts_where_it_was_looked_at():
    deep = evidence(50.0, 45.0, 30.0, 20.0, fine=120.0, fine_rival=60.0)
    # The mean of both: 50 over 45 and 120 over 60.
    assert np.exp(features_of(deep, CHANCE))[1] == pytest.approx(math.sqrt(50 / 45 * 2))
    alone = evidence(50.0, 45.0, 30.0, 20.0, fine=120.0, fine_rival=0.0)
    stood_in = 50 / 45 * 120 / (STAND_IN * CHANCE.fine)
    assert np.exp(features_of(alone, CHANCE))[1] == pytest.approx(math.sqrt(stood_in))
    for half in ({"fine": 120.0}, {"fine_rival": 60.0}, {}):
        plain = evidence(50.0, 45.0, 30.0, 20.0, **half)
        assert np.exp(features_of(plain, CHANCE))[1] == pytest.approx(50 / 45)
    without = {k: v for k, v in evidence(50.0, 45.0).items() if "fine" not in k}
    np.testing.assert_array_equal(
        features_of(without, CHANCE), features_of(evidence(50.0, 45.0), CHANCE)
    )


@given(evidences)
def test_it_is_a_probability(plain):
    assert 0 <= MODEL(plain) <= 1


@pytest.mark.parametrize("value", [0.0, -30.0, 1e-300, 1e300])
def test_absurd_evidence_gives_a_probability(value):
    for name in ("strength", "rival", "look", "look_rival"):
        assert 0 <= MODEL(evidence(**{name: value})) <= 1


@given(evidences, st.floats(1.0, 4.0))
def test_better_evidence_never_lowers_it(plain, gain):
    for name in ("strength", "look", "fine"):
        if name in plain:
            assert MODEL({**plain, name: gain * plain[name]}) >= MODEL(plain) - 1e-12


@given(evidences, st.floats(1.0, 4.0))
def test_a_better_rival_never_raises_it(plain, gain):
    for name in ("rival", "look_rival", "fine_rival"):
        if name in plain:
            assert MODEL({**plain, name: gain * plain[name]}) <= MODEL(plain) + 1e-12


def test_strength_and_ratios_each_raise_it():
    middle = MODEL(evidence(40.0, 30.0, 25.0, 20.0))
    assert 0.05 < middle < 0.95
    assert MODEL(evidence(44.0, 33.0, 25.0, 20.0)) > middle  # stronger, the same ratio
    assert MODEL(evidence(40.0, 27.0, 25.0, 20.0)) > middle
    assert MODEL(evidence(40.0, 30.0, 25.0, 18.0)) > middle
    assert MODEL(evidence(40.0, 40.0, 25.0, 25.0)) < 0.1


@given(
    st.floats(-50, 50),
    st.tuples(*[st.floats(0, 50)] * 3),
    st.tuples(*[st.floats(1e-3, 1e4)] * 3),
)
def test_plain_round_trip(bias, weights, chances):
    model = RegisteredConfidence(bias, weights, Chances(*chances))
    again = RegisteredConfidence.from_plain(json.loads(json.dumps(model.to_plain())))
    assert again == model and again(evidence()) == model(evidence())


def without(plain, *path):
    plain = json.loads(json.dumps(plain))
    inner = plain
    for key in path[:-1]:
        inner = inner[key]
    del inner[path[-1]]
    return plain


def changed(plain, value, *path):
    plain = json.loads(json.dumps(plain))
    inner = plain
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return plain


PLAIN = MODEL.to_plain()
NUMBERS = [("bias",), *(("weights", name) for name in FEATURES)]
NUMBERS += [("chances", name) for name in CHANCES]


@pytest.mark.parametrize("path", NUMBERS, ids=".".join)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, "x", None, [1.0]], ids=str)
def test_a_bad_number_is_refused(path, value):
    with pytest.raises(VariantError, match=r"confidence|chance"):
        RegisteredConfidence.from_plain(changed(PLAIN, value, *path))


@pytest.mark.parametrize("path", NUMBERS, ids=".".join)
def test_a_missing_number_is_refused(path):
    with pytest.raises(VariantError, match="confidence"):
        RegisteredConfidence.from_plain(without(PLAIN, *path))


@pytest.mark.parametrize("plain", [None, [], {}, "text", 3, {"weights": [1, 2, 3]}], ids=str)
def test_what_is_no_confidence_is_refused(plain):
    with pytest.raises(VariantError, match="confidence"):
        RegisteredConfidence.from_plain(plain)


@pytest.mark.parametrize("name", FEATURES)
def test_a_negative_weight_is_refused(name):
    with pytest.raises(VariantError, match="negative"):
        RegisteredConfidence.from_plain(changed(PLAIN, -0.1, "weights", name))


@pytest.mark.parametrize("name", CHANCES)
@pytest.mark.parametrize("value", [0.0, -3.0])
def test_a_chance_of_nothing_is_refused(name, value):
    with pytest.raises(VariantError, match="chance"):
        RegisteredConfidence.from_plain(changed(PLAIN, value, "chances", name))


def synthetic(count, seed):
    """Evidence of views, right ones standing out more, and whether they are right."""
    rng = np.random.default_rng(seed)
    right = rng.random(count) < 0.5
    ratio = np.exp(np.where(right, rng.normal(0.55, 0.25, count), rng.normal(0.08, 0.08, count)))
    strength = 25 * np.exp(rng.normal(0.3, 0.2, count) + 0.3 * right)
    look = 15 * np.exp(rng.normal(0.2, 0.2, count) + 0.2 * right)
    views = [evidence(s, s / r, k, k / r) for s, r, k in zip(strength, ratio, look, strict=True)]
    return views, right


def test_what_is_learnt_tells_right_from_wrong():
    views, right = synthetic(300, seed=1)
    fitted = fit_registered(views, right, np.ones(len(right)), CHANCE)
    fresh, fresh_right = synthetic(4000, seed=2)
    said = np.array([fitted(each) for each in fresh])
    assert fitted.chances == CHANCE and min(fitted.weights) >= 0
    assert (said[fresh_right][:, None] > said[~fresh_right][None]).mean() > 0.95
    # Right about as often as it says.
    for low, high in ((0.0, 0.2), (0.2, 0.8), (0.8, 1.0)):
        inside = (said >= low) & (said <= high)
        assert inside.sum() > 100
        assert fresh_right[inside].mean() == pytest.approx(said[inside].mean(), abs=0.1)


def test_few_views_do_not_make_it_certain():
    """Ten views separated perfectly: the prior keeps the weights finite."""
    views = [evidence(60.0, 30.0)] * 5 + [evidence(26.0, 25.0, 15.0, 15.0)] * 5
    right = np.repeat([True, False], 5)
    fitted = fit_registered(views, right, np.ones(10), CHANCE)
    assert all(math.isfinite(number) for number in (fitted.bias, *fitted.weights))
    assert max(fitted.weights) < 60
    assert fitted(views[0]) > 0.8 and fitted(views[-1]) < 0.2


@pytest.mark.parametrize("all_right", [True, False])
def test_one_sided_views_give_a_finite_answer(all_right):
    views, _ = synthetic(40, seed=3)
    fitted = fit_registered(views, np.full(40, all_right), np.ones(40), CHANCE)
    assert all(math.isfinite(number) for number in (fitted.bias, *fitted.weights))
    usual = RegisteredConfidence(USUAL_BIAS, USUAL_WEIGHTS, CHANCE)
    moved = [fitted(each) - usual(each) for each in views]
    assert min(moved) > 0 if all_right else max(moved) < 0


def test_the_same_views_give_the_same_confidence():
    views, right = synthetic(100, seed=4)
    first, second = (fit_registered(views, right, np.ones(100), CHANCE) for _ in range(2))
    assert first == second
