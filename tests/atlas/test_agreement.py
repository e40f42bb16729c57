"""Views agree on places that an aircraft can have flown through; one view is never enough."""

import math

import numpy as np
import pytest

from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.atlas.locate import (
    CHANCE,
    MAX_CHAIN_LOG_ODDS,
    MIN_VIEWS,
    Agreement,
    PlaceEvidence,
)

FRAME = LocalFrame(46.5, 2.0)
SIDE_M = 1000.0


def seen(east_m, north_m, log_odds, key=0, turn_deg=90.0, log_scale=0.0):
    lat, lon = FRAME.latlon_from_en([east_m, north_m])
    return PlaceEvidence(float(lat), float(lon), math.radians(turn_deg), log_scale, log_odds, key)


def flown(*views, every_s=20.0, chance=CHANCE):
    agreement = Agreement()
    for number, places in enumerate(views):
        agreement.add_view(places, round(number * every_s * 1e9), SIDE_M, chance)
    return agreement


def test_one_view_alone_is_never_a_fix():
    agreement = flown([seen(0, 0, 50.0)])
    assert not agreement.agreed
    assert agreement.best is not None and agreement.best.views == 1.0


def test_two_consistent_views_of_new_ground_agree():
    agreement = flown([seen(0, 0, 2.0)], [seen(900, 0, 2.0)])
    assert agreement.agreed
    assert agreement.confidence > 0.9
    assert agreement.best.views >= MIN_VIEWS


@pytest.mark.parametrize(
    "second, every_s",
    [
        (seen(20_000, 0, 4.0), 20.0),  # faster than anything flies
        (seen(900, 0, 4.0, log_scale=1.0), 20.0),  # another height altogether
        (seen(50, 0, 4.0, turn_deg=270.0), 1.0),  # turned too far
    ],
    ids=["too far", "other scale", "turned"],
)
def test_places_that_cannot_be_reached_do_not_agree(second, every_s):
    assert not flown([seen(0, 0, 4.0)], [second], every_s=every_s).agreed


def test_hovering_is_no_evidence():
    hovering = flown(*([seen(0, 0, 3.0)] for _ in range(100)), every_s=0.2)
    assert hovering.best.views == 1.0
    assert not hovering.agreed


def test_contradicting_views_do_not_extend_a_chain():
    rng = np.random.default_rng(3)
    agreement = flown(*([seen(100 * k, 0, 5.0)] for k in range(30)), every_s=4.0)
    assert agreement.agreed
    for k in range(30, 50):
        place = rng.uniform(-200, 200, 2) + np.array([100.0 * k, 0.0])
        agreement.add_view([seen(*place, -3.0)], round(k * 4e9), SIDE_M, 1.0)
        assert not agreement.agreed


@pytest.mark.parametrize("time_s", [-5.0, 600.0, 1e9], ids=["back", "gap", "jump"])
def test_no_gap_is_bridged_blindly(time_s):
    agreement = flown(*([seen(900 * k, 0, 5.0)] for k in range(5)))
    assert agreement.agreed
    agreement.add_view([seen(4500, 0, 5.0)], round(time_s * 1e9), SIDE_M, CHANCE)
    assert not agreement.agreed
    assert agreement.best.views == 1.0


def test_a_view_without_a_match_is_no_fix_and_keeps_the_chains():
    agreement = flown([seen(0, 0, 3.0)], [seen(900, 0, 3.0)], [])
    assert not agreement.agreed
    agreement.add_view([seen(2700, 0, 3.0)], round(60e9), SIDE_M, CHANCE)
    assert agreement.agreed


def test_a_long_chain_is_given_up_after_some_views():
    views = [[seen(800 * number, 0, 5.0)] for number in range(20)]
    other_place = [[seen(60_000 + 800 * number, 30_000, 5.0)] for number in range(8)]
    agreement = flown(*views, *other_place)
    assert agreement.agreed
    there = FRAME.en_from_latlon(agreement.best.last.lat_deg, agreement.best.last.lon_deg)
    assert np.hypot(*(there - [60_000 + 800 * 7, 30_000])) < 10
    assert max(each.log_odds for each in agreement.chains) <= MAX_CHAIN_LOG_ODDS + 1e-9
