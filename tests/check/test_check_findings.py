"""How far heading and height may be off, from trials."""

import math
from pathlib import Path

import numpy as np
import pytest
from made_trials import lost, misplaced, right

from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.check.findings import (
    AGL_OFF,
    HEIGHTS,
    SIMILAR,
    TOLERATED,
    YAW_OFF_DEG,
    envelope_of,
    found_lookalikes,
    heights_of,
    heights_work,
)
from orthonav.ground.check.request import CheckRequest
from orthonav.ground.check.trials import TrialPlan

PLAN = TrialPlan(CheckRequest(Path("a.onav")), 100.0)
PLACES = np.zeros((20, 2))
MIDDLE = AGL_OFF.index(0.0)


def trials(share):
    """20 trials of which so many are right."""
    count = round(20 * share)
    return [right((0, 0))] * count + [lost((0, 0))] * (20 - count)


def envelope(shares):
    shares = np.broadcast_to(shares, (len(YAW_OFF_DEG), len(AGL_OFF)))
    return envelope_of([trials(each) for each in shares.ravel()])


def test_errors_are_fine_up_to_the_first_that_is_not():
    shares = np.full((len(YAW_OFF_DEG), len(AGL_OFF)), 0.9)
    shares[2, MIDDLE] = 0.9 * TOLERATED - 0.1
    shares[0, -1] = shares[0, 0] = 0.1
    found = envelope(shares)
    assert found.tolerated_yaw_deg == YAW_OFF_DEG[1]
    assert (found.tolerated_agl_low, found.tolerated_agl_high) == (AGL_OFF[1], AGL_OFF[-2])
    np.testing.assert_allclose(found.share, shares, atol=0.03)


def test_heights():
    work = heights_work(PLAN, PLACES)
    assert [plan.agl_m for plan, _ in work] == [100.0 * part for part in HEIGHTS]
    shares = [0.1 * (i + 1) for i in range(len(HEIGHTS))]
    found = heights_of(PLAN, trials(0.7), [trials(each) for each in shares])
    assert [each.value for each in found] == sorted([100.0, *(100.0 * part for part in HEIGHTS)])
    chosen = [each for each in found if each.chosen]
    assert [(each.value, each.probability) for each in chosen] == [(100.0, 0.7)]
    assert found[0].probability == pytest.approx(0.1)


FRAME = LocalFrame(46.0, 3.0)
HERE, THERE = (0.0, 0.0), (800.0, 300.0)


def found(trials, prior_std_m=None):
    return found_lookalikes(
        trials, FRAME, view_side_m=100.0, radius_m=20.0, prior_std_m=prior_std_m
    )


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
