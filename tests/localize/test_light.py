"""Views in other light than the map's: contrast turns over, edges stay."""

from dataclasses import replace

import numpy as np
import pytest
from blots import AGL_M, CAMERA, GROUND, Ground, error_m, planned, prior_at, rendered

from orthonav.core.localize import Localizer
from orthonav.core.localize.search import Found, Search, prepared_view
from orthonav.core.records import Fix, NoFix, Telemetry, View
from orthonav.core.register.refine import block_scores
from orthonav.core.track.tracker import Tracker

OTHER = Ground(seed=5)
PLACES = [(-120.0, 95.0), (60.3, -110.7), (133.1, 140.2), (-30.0, 5.5), (10.0, -80.0)]


@pytest.fixture(scope="module")
def localizer(known_localizer):
    return known_localizer


def infrared(east_m, north_m):
    """A negative of the ground, and as much that the map does not show."""
    seen = GROUND(east_m, north_m), OTHER(east_m, north_m)
    return 128 - 0.8 * (seen[0] - 128) + 0.8 * (seen[1] - 128)


def other_ground(east_m, north_m):
    return infrared(np.asarray(east_m) + 4000.0, np.asarray(north_m) - 900.0)


def view(ground, place, yaw_deg=40.0):
    reported = Telemetry(0, yaw_deg + 4, 0.0, 0.0, AGL_M * 1.04, tilt_std_deg=0.5)
    return View(rendered(ground, place, (yaw_deg, 0.0, 0.0)), CAMERA, reported)


@pytest.mark.parametrize("place", PLACES)
def test_ground_whose_contrast_turns_over_is_found_by_its_edges(localizer, place):
    seen = view(infrared, place)
    fix = localizer.locate(seen)
    assert isinstance(fix, Fix) and fix.is_confident
    assert error_m(localizer, fix, place) < 0.5
    assert fix.evidence["grey_correlation"] == 0 < fix.evidence["gradient_correlation"]
    both = Search.of(localizer.registration, seen)
    assert both.likelihood(both.best()) < 0.5


def test_by_day_grey_levels_count(localizer):
    fix = localizer.locate(view(GROUND, PLACES[0]))
    assert fix.is_confident and fix.evidence["grey_correlation"] > 0.5


def test_other_ground_in_other_light_is_not_recognized(localizer):
    for place in PLACES:
        fix = localizer.locate(view(other_ground, place))
        assert isinstance(fix, NoFix) or not fix.is_confident


def test_the_same_candidates_are_compared_again(localizer):
    search = Search.of(localizer.registration, view(infrared, PLACES[1]))
    again = search.run().search
    assert again is not search
    assert again.tried[: len(search.tried)] == search.tried and again.budget is search.budget
    assert again.candidates > search.candidates > 0
    assert again.view.templates.grey_share == again.sought.grey_share == 0
    assert 0 < search.sought.grey_share < search.view.templates.grey_share


def test_near_a_prior_candidates_are_sought_as_they_are_compared(localizer):
    seen, prior = view(infrared, PLACES[1]), prior_at(localizer, np.array(PLACES[1]), 20.0)
    search = Search.of(localizer.registration, seen, prior)
    assert search.sought.grey_share == search.view.templates.grey_share > 0
    fix = localizer.locate(seen, prior=prior)
    assert fix.is_confident and fix.evidence["grey_correlation"] == 0


@pytest.mark.parametrize(("most_ms", "level"), [(300.0, "mid"), (0.0, "coarse")])
def test_by_gradients_the_mid_level_is_searched_where_it_takes_little(opened, most_ms, level):
    plan = planned(cheap_ms=0.0, gradients_ms=most_ms)
    search = Search.of(Localizer(opened, plan=plan).registration, view(infrared, PLACES[1]))
    stage, _ = search.run().search.tried[-1]
    assert stage.level == getattr(search.levels, level)


def test_a_search_that_was_cut_short_is_not_followed_by_another(opened):
    hasty = Localizer(opened, plan=planned(budget_ms=1e-6))
    search = Search.of(hasty.registration, view(infrared, PLACES[1]))
    found = search.run()
    assert isinstance(found, Found) and found.search is search and search.budget.cut_short


def test_a_track_follows_ground_whose_contrast_turns_over(localizer):
    tracker = Tracker(localizer)
    for number in range(12):
        place = np.array([-100.0 + 14 * number, 60.0])
        seen = view(infrared, place)
        then = replace(seen.telemetry, time_ns=number * 10**9)
        fix = tracker.locate(replace(seen, telemetry=then))
    assert isinstance(fix, Fix) and tracker.state_name == "tracking"
    assert error_m(localizer, fix, place) < 2


@pytest.mark.parametrize("share", [0.6, 0.0])
def test_blocks_of_the_same_ground_fit(localizer, share):
    registration = localizer.registration
    prepared = prepared_view(registration, view(GROUND, PLACES[3]), True)
    fit = Search.of(registration, view(GROUND, PLACES[3])).run().best.place.fit
    templates = prepared.templates.weighing_grey(share)
    scores = block_scores(templates.at(prepared.levels.final), registration.reference, fit.pose, 3)
    assert np.median(scores.correlations.max(axis=(1, 2))) > 0.85
