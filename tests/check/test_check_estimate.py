"""From trials to a probability for every place."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_check import lost, right

from orthonav.ground.check.estimate import LEARNT, Predictor

SIDE_M = 1000.0


def places(count, seed=1):
    return np.random.default_rng(seed).uniform(0, SIDE_M, (count, 2))


def predictor(trials, other_date=(), **changed):
    usual = {"view_side_m": 100.0, "spacing_m": 60.0} | changed
    whole = {"coverage": lambda points: np.ones(len(points))} | usual
    return Predictor(trials, other_date=other_date, **whole)


def half_good(count=300):
    """Right in the west, lost in the east."""
    return [right(en) if en[0] < SIDE_M / 2 else lost(en) for i, en in enumerate(places(count))]


WEST, EAST = np.array([[150.0, 500.0]]), np.array([[850.0, 500.0]])


def test_places_are_told_by_the_trials_around():
    found = predictor(half_good())
    west, east = found.at(WEST), found.at(EAST)
    assert west.probability[0] > 0.8 and east.probability[0] < 0.25
    assert west.low[0] > east.high[0]
    assert 0 < west.wrong[0] == east.wrong[0] < 1e-4


@settings(max_examples=10, deadline=None)
@given(
    st.integers(1, 60),
    st.lists(st.sampled_from(["right", "lost", "wrong"]), min_size=60, max_size=60),
    st.floats(0.005, 0.95),
    st.floats(10, 400),
)
def test_all_is_in_order_whatever_the_trials(count, kinds, expected, view_side_m):
    make = {
        "right": lambda en: right(en, expected=expected),
        "lost": lost,
        "wrong": lambda en: replace(lost(en), error_m=280.0, wrong=True),
    }
    trials = [make[kind](en) for kind, en in zip(kinds, places(count), strict=False)]
    # Near, between, and far from all.
    points = np.concatenate([places(8, seed=3), [[1e5, -1e5]]])
    found = predictor(trials, view_side_m=view_side_m).at(points)
    for each in vars(found).values():
        assert each.shape == (9,) and np.isfinite(each).all()
    assert (found.low >= 0).all() and (found.high <= 1).all()
    assert (found.low <= found.probability).all() and (found.probability <= found.high).all()
    assert (found.error_m >= 0).all() and (found.wrong >= 0).all() and (found.wrong <= 1).all()


def test_another_date_outweighs_the_map_itself():
    at = places(200)
    own, other = [right(en) for en in at], [lost(en, expected=np.nan) for en in at]
    alone, both = predictor(own).at(WEST), predictor(own, other).at(WEST)
    assert alone.probability[0] > 0.9
    assert both.probability[0] == pytest.approx(0.25, abs=0.05)
    assert np.isfinite(both.persistence).all()


def test_error_of_fixes():
    trials = [right(en, error_m=3.0) for en in places(300)]
    assert predictor(trials).at(WEST).error_m[0] == pytest.approx(3.0)
    assert predictor(trials, least_error_m=4.0).at(WEST).error_m[0] == pytest.approx(5.0)
    stated = [replace(each, stated_m=12.0) for each in trials]
    assert predictor(stated).at(WEST).error_m[0] == pytest.approx(12.0)


def test_a_trial_of_another_date_is_one_trial():
    """It weighs three times as much, but three trials would be more certain."""
    at = places(200)
    own, other = [right(en) for en in at], [right(en) for en in at]
    for half in (own, other):
        half[::2] = [replace(each, right=False) for each in half[::2]]
    both, three = predictor(own, other), predictor([*own, *other, *other, *other])
    one, many = both.at(WEST), three.at(WEST)
    assert one.probability[0] == pytest.approx(many.probability[0], abs=0.02)
    assert one.high[0] - one.low[0] > 1.05 * (many.high[0] - many.low[0])
    assert both.mean_std > 1.1 * predictor([*own, *other]).mean_std


def test_scenes_differ_more_for_narrow_views():
    assert LEARNT.std_of(64) > LEARNT.std_of(128) > LEARNT.std_of(256) == LEARNT.std_of(400)
