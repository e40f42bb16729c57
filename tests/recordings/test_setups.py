"""Where few views are confident, the program finds which value of the configuration is wrong."""

import re
from dataclasses import replace

import numpy as np
import pytest

from orthonav.core.localize import Localizer
from orthonav.core.localize.confidence import Acceptance
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix, NoFix, Prior, View, ViewResult
from orthonav.ground.recordings.setups import SAMPLE, LowConfidenceViews, setup_text, try_setups

ACCEPTS = Acceptance("confidence", 0.9).accepts


@pytest.fixture(scope="module")
def registering(map_path):
    return Localizer(open_map(map_path))


@pytest.fixture(scope="module")
def views(flight, registering):
    """A view that is confident as reported."""
    seen = (View(each.grey(), flight.camera, each.telemetry) for each in flight.views)
    return [next(view for view in seen if ACCEPTS(registering.locate(view)))]


def tried(registering, views, **how):
    return try_setups(
        registering, views, ACCEPTS, **{"use_prior": True, "heading_known": True} | how
    )


def reported(view, **values):
    return View(view.grey, view.camera, replace(view.telemetry, **values))


@pytest.mark.parametrize(
    "wrong, how, name, cause, also",
    [
        (lambda now: {"yaw_deg": (now.yaw_deg + 180) % 360}, {}, "any heading",
         r"with any heading, [+-]1[78]\d deg from .*; check the heading column and the mount", []),
        (lambda now: {"agl_m": now.agl_m * 1.9}, {"heading_known": False}, "half the height",
         r"at 0\.5\d times the reported height .or 1\..* check the height column",
         ["also tried: twice the height (0 of 1)"]),
        (lambda now: {}, {"tracked": True}, "as reported", "but the views do not form a track", []),
    ],
)  # fmt: skip
def test_the_wrong_value_is_found(registering, views, wrong, how, name, cause, also):
    changed = [reported(view, **wrong(view.telemetry)) for view in views]
    found = tried(registering, changed, **how)
    assert found[-1].setup.name == name and found[-1].explains
    said, *others = setup_text(found, on_map=True)
    assert said.startswith("1 of 1 views of low confidence become confident ")
    assert re.search(cause, said) and others == also


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
    for number in range(100):
        outcome = NoFix("blank", "") if number % 2 else replace(place, confidence=number / 100)
        doubted.take(Recorded(number), ViewResult("a", number, outcome, 1.0))
    times = [view.telemetry.time_ns for view in doubted.views]
    assert SAMPLE // 2 <= len(times) <= SAMPLE and max(times) < 90  # those above are confident
    assert len(set(np.diff(times))) == 1
