"""Confidence of registered views: higher with better evidence, and limited for one place alone."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.core.errors import VariantError
from orthonav.core.localize.confidence import (
    CHANCES,
    FEATURES,
    Chances,
    RegisteredConfidence,
    Scores,
)
from orthonav.core.records import CONFIDENT
from orthonav.ground.build.calibrate import fit_registered

CHANCE = Chances(total=25.0, mid=15.0, fine=40.0)
MODEL = RegisteredConfidence((-8.0, -3.0), (0.5, 11.0, 1.5, 2.0, 1.0, 2.0, 3.0), CHANCE)

strengths = st.floats(1.0, 300.0)
sometimes = st.one_of(st.just(math.nan), strengths)
some_scores = st.builds(
    Scores,
    **{name: strengths for name in ("strength", "rival", "mid_score", "mid_rival")},
    **{name: sometimes for name in ("fine", "fine_rival")},
    local_ratio=st.just(2.0),
    local_phase=st.floats(-5, 80),
    local_gradients=st.floats(-5, 80),
    detail_ratio=st.one_of(st.just(math.nan), st.floats(1e-3, 1e3)),
)
USUAL = Scores(60.0, 30.0, 35.0, 18.0, math.nan, math.nan, 1.5, 2.0, 8.0, 10.0)


@pytest.mark.parametrize("value", [0.0, -30.0, 1e-300, 1e300])
def test_absurd_evidence_gives_a_probability(value):
    for name in ("strength", "rival", "mid_score", "mid_rival"):
        assert 0 <= MODEL(replace(USUAL, **{name: value})) <= 1


@given(some_scores)
def test_evidence_of_a_fix_gives_the_same_scores(scores):
    assert repr(Scores.of(scores.evidence())) == repr(scores)


@given(some_scores, st.floats(1.0, 4.0))
def test_better_evidence_never_lowers_it(plain, gain):
    for name in ("strength", "mid_score", "fine", "local_phase", "local_gradients", "detail_ratio"):
        if math.isfinite(value := getattr(plain, name)):
            assert MODEL(replace(plain, **{name: gain * value})) >= MODEL(plain) - 1e-12


def test_a_search_that_was_cut_short_is_not_confident():
    model = RegisteredConfidence.usual(Chances(32.0, 15.0, 48.0))
    clear = replace(USUAL, strength=200.0, mid_score=90.0)
    assert model(clear) > CONFIDENT > model(replace(clear, cut_short=True))


def changed(value, *path):
    """`MODEL` as it is stored, with another value at a path, or without it for `...`."""
    plain = json.loads(json.dumps(MODEL.to_plain()))
    inner = plain
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    if value is ...:
        del inner[path[-1]]
    return plain


NUMBERS = [("biases",), *(("weights", name) for name in FEATURES)]
NUMBERS += [("chances", key) for key in CHANCES.values()]


@pytest.mark.parametrize("path", NUMBERS, ids=".".join)
@pytest.mark.parametrize("value", [math.nan, math.inf, "x", None, [1.0], -0.1, ...], ids=str)
def test_a_bad_or_missing_number_is_refused(path, value):
    with pytest.raises(VariantError, match=r"confidence|chance|negative"):
        RegisteredConfidence.from_plain(changed(value, *path))


@pytest.mark.parametrize("plain", [None, [], {}, "text", 3, {"weights": [1, 2, 3]}], ids=str)
def test_what_is_no_confidence_is_refused(plain):
    with pytest.raises(VariantError, match="confidence"):
        RegisteredConfidence.from_plain(plain)


def synthetic(count, seed, harder=0.0):
    """Evidence of views, right ones standing out more, and whether they are right."""
    rng = np.random.default_rng(seed)
    right = rng.random(count) < 0.5
    ratio = np.exp(np.where(right, rng.normal(0.55, 0.25, count), rng.normal(0.08, 0.08, count)))
    strength = 25 * np.exp(rng.normal(0.3, 0.2, count) + 0.3 * right + harder)
    look = 15 * np.exp(rng.normal(0.2, 0.2, count) + 0.2 * right + harder)
    local = np.exp(np.where(right, rng.normal(0.8, 0.4, count), rng.normal(0.1, 0.1, count)))
    views = [
        Scores(s, s / r, k, k / r, math.nan, math.nan, 1.5, 2.0, 3 * a, 3 * a)
        for s, r, k, a in zip(strength, ratio, look, local, strict=True)
    ]
    return views, right


def loss(model, views, right):
    said = np.clip([model(each) for each in views], 1e-9, 1 - 1e-9)
    return -np.log(np.where(right, said, 1 - said)).mean()


@pytest.mark.parametrize("harder", [-0.3, 0.0, 0.3])
def test_what_is_learnt_fits_fresh_views_better_than_the_usual(harder):
    """On ground where wrong views score higher or lower than usual."""
    fitted = fit_registered(*synthetic(300, 1, harder), CHANCE)
    fresh = synthetic(2000, 2, harder)
    usual = RegisteredConfidence.usual(CHANCE)
    assert fitted.chances == CHANCE and fitted.weights == usual.weights
    assert loss(fitted, *fresh) <= loss(usual, *fresh) + 0.005
