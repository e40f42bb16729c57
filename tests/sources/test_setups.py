"""Where few views are confident, the program finds which value of the configuration is wrong."""

from dataclasses import replace

import numpy as np
import pytest

from orthonav.core.localize import Localizer
from orthonav.core.localize.confidence import Acceptance
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix, NoFix, Prior, View, ViewResult
from orthonav.ground.recordings.setups import (
    SAMPLE,
    LowConfidenceViews,
    setup_text,
    try_setups,
)

ACCEPTS = Acceptance("confidence", 0.9).accepts


@pytest.fixture(scope="module")
def registering(map_path):
    return Localizer(open_map(map_path))


@pytest.fixture(scope="module")
def views(flight, registering):
    """Two views that are confident as reported."""
    seen = (View(each.grey(), flight.camera, each.telemetry) for each in flight.views)
    confident = (view for view in seen if ACCEPTS(registering.locate(view)))
    return [next(confident) for _ in range(2)]


def tried(registering, views, **how):
    return try_setups(
        registering, views, ACCEPTS, **{"use_prior": True, "heading_known": True} | how
    )


def reported(view, **values):
    return View(view.grey, view.camera, replace(view.telemetry, **values))


def test_a_wrong_heading_is_found(registering, views):
    turned = [reported(view, yaw_deg=(view.telemetry.yaw_deg + 180) % 360) for view in views]
    (found,) = tried(registering, turned)
    assert found.setup.name == "any heading" and found.explains
    assert abs(abs(found.heading_off_deg) - 180) < 12
    (said,) = setup_text([found], on_map=True)
    assert (
        f"{found.confident} of 2 views of low confidence become confident with any heading" in said
    )
    assert "check the heading column and the mounting of the camera" in said


def test_views_that_form_no_track_are_no_wrong_configuration(registering, views):
    (found,) = tried(registering, views, tracked=True)
    (said,) = setup_text([found], on_map=True)
    assert "the configuration is right, but the views do not form a track" in said


def test_a_wrong_height_is_found_with_its_ratio(registering, views):
    high = [reported(view, agl_m=view.telemetry.agl_m * 1.9) for view in views[:1]]
    *failed, found = tried(registering, high, heading_known=False)
    assert found.setup.name == "half the height" and found.explains
    assert found.height_ratio == pytest.approx(1 / 1.9, rel=0.06)
    assert [each.setup.name for each in failed] == ["twice the height"]
    said, others = setup_text([*failed, found], on_map=True)
    assert "times the reported height (or 1." in said and "check the height column" in said
    assert others == f"also tried: twice the height ({failed[0].confident} of 1)"


def test_a_map_of_another_area_is_not_explained(views):
    """Every set-up is tried, and those of an unknown heading once."""

    class Elsewhere:
        asked = 0

        def locate(self, view, prior, heading_known):
            self.asked += 1
            return NoFix("no_match", "")

    prior = Prior(46.0, 3.0, 30.0)
    many = [reported(views[0], prior=prior, yaw_deg=0.7 * number) for number in range(SAMPLE)]
    found = tried(elsewhere := Elsewhere(), many)
    assert len(found) == 6 and elsewhere.asked == 24 and not any(e.explains for e in found)
    assert len(tried(Elsewhere(), many, heading_known=False, use_prior=False)) == 4
    (said,) = setup_text(found, on_map=False)
    assert (
        "at most 0 of 8 views of low confidence" in said
        and "check first that the map shows the area" in said
    )
    assert "the recorded positions lie on the map" in setup_text(found, on_map=True)[0]


def test_a_sample_of_the_doubted_views_is_kept(views):
    class Recorded:
        def __init__(self, number):
            self.telemetry = replace(views[0].telemetry, time_ns=number)
            self.grey = lambda: views[0].grey

    doubted = LowConfidenceViews(views[0].camera, lambda telemetry: telemetry)
    place = Fix(46.0, 3.0, np.eye(2), 0.4, 35.0, 0.0, 100.0)
    for number, _ in enumerate(doubted.watching(map(Recorded, range(100)))):
        outcome = NoFix("blank", "") if number % 2 else replace(place, confidence=number / 100)
        doubted.take(ViewResult("a", number, outcome, 1.0))
    times = [view.telemetry.time_ns for view in doubted.views]
    assert SAMPLE // 2 <= len(times) <= SAMPLE and max(times) < 90  # those above are confident
    assert len(set(np.diff(times))) == 1
