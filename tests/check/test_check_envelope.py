"""How far heading and height may be off, from trials."""

from pathlib import Path

import numpy as np
import pytest
from made_trials import lost, right

from orthonav.ground.check.findings import (
    AGL_OFF,
    HEIGHTS,
    TOLERATED,
    YAW_OFF_DEG,
    envelope_of,
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


def test_where_nothing_is_found_no_error_is_fine():
    found = envelope(0.0)
    assert (found.tolerated_yaw_deg, found.tolerated_agl_low, found.tolerated_agl_high) == (
        0.0,
        0.0,
        0.0,
    )


def test_heights():
    work = heights_work(PLAN, PLACES)
    assert [plan.agl_m for plan, _ in work] == [100.0 * part for part in HEIGHTS]
    shares = [0.1 * (i + 1) for i in range(len(HEIGHTS))]
    found = heights_of(PLAN, trials(0.7), [trials(each) for each in shares])
    assert [each.value for each in found] == sorted([100.0, *(100.0 * part for part in HEIGHTS)])
    chosen = [each for each in found if each.chosen]
    assert [(each.value, each.probability) for each in chosen] == [(100.0, 0.7)]
    assert found[0].probability == pytest.approx(0.1)
