"""Ambiguous places, from trials."""

import math
from dataclasses import replace

import pytest
from made_trials import CONDITIONS, lost, misplaced, right

from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.check.findings import SIMILAR, found_lookalikes

FRAME = LocalFrame(46.0, 3.0)
HERE, THERE = (0.0, 0.0), (800.0, 300.0)


def found(trials, prior_std_m=None):
    conditions = replace(
        CONDITIONS, width_m=100.0, height_m=100.0, radius_m=20.0, prior_std_m=prior_std_m
    )
    return found_lookalikes(trials, FRAME, conditions)


def near(place, east, north=0.0):
    return place[0] + east, place[1] + north


def test_good_trials_have_none():
    assert found([]) == ()
    assert (
        found([right(HERE), lost(THERE), right(THERE, rival=HERE, share=SIMILAR - 0.01)] * 3) == ()
    )


def test_both_ways_are_one_pair():
    trials = [
        misplaced(HERE, THERE),
        misplaced(near(THERE, 30), near(HERE, -30)),
        right(near(HERE, 0, 40), rival=THERE, share=0.9),
    ]
    (pair,) = found(trials)
    assert pair.trials == 3 and pair.similarity == pytest.approx((1 + 1 + 0.9) / 3)
    assert pair.apart_m == pytest.approx(math.dist(HERE, THERE))
    east, north = FRAME.en_from_latlon(*pair.other_latlon_deg)
    assert (east, north) == pytest.approx(THERE, abs=0.01)
    assert FRAME.en_from_latlon(*pair.place_latlon_deg) == pytest.approx(HERE, abs=0.01)


def test_badly_placed_is_not_elsewhere():
    """Beyond the radius but within a quarter of the view it is the same place."""
    assert found([misplaced(HERE, near(HERE, 24))] * 3) == ()
    assert len(found([misplaced(HERE, near(HERE, 26))] * 3)) == 1


def test_within_the_prior():
    apart_m = math.dist(HERE, THERE)
    trials = [misplaced(HERE, THERE)]
    assert found(trials)[0].within_prior and found(trials, apart_m / 2.9)[0].within_prior
    assert not found(trials, apart_m / 3.1)[0].within_prior
