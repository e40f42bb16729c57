"""When a track begins, ends and is replaced, shown with a finder and tracks made for it."""

from types import SimpleNamespace

import pytest

from orthonav.core.errors import AtlasError
from orthonav.core.records import NoFix
from orthonav.core.track import State
from orthonav.ground.atlas import locate
from orthonav.ground.atlas.catalog import AtlasRecipe
from orthonav.ground.atlas.locate import AtlasLocator, FoundPlace

SEARCHING = NoFix("searching", "nothing agrees")
FOUND = FoundPlace((), 1.0, 0.95)


class Finder:
    def __init__(self, *_, **__):
        self.outcomes, self.asked, self.restarts = [], 0, 0

    def find(self, view):
        self.asked += 1
        return self.outcomes.pop(0) if self.outcomes else SEARCHING

    def restart(self):
        self.restarts += 1


class Track:
    agrees = True

    def __init__(self, *_, **__):
        self.fix, self.state = "begun", State.TRACKING

    def locate(self, view):
        if view == "no map":
            raise AtlasError("a sheet is damaged")
        self.fix = view
        self.state = State.TRACKING if view else State.COASTING
        return view != "end"

    def passed(self, telemetry, reason):
        self.fix, self.state = None, State.COASTING
        return True


@pytest.fixture
def locator(monkeypatch):
    monkeypatch.setattr(locate, "PlaceFinder", Finder)
    monkeypatch.setattr(locate, "LocalTrack", Track)
    atlas = SimpleNamespace(recipe=AtlasRecipe(gsd_m=1.0), url="atlas")
    return AtlasLocator(SimpleNamespace(atlas=atlas), None)


@pytest.fixture
def tracking(locator):
    locator._finder.outcomes = [FOUND]
    assert (locator.locate("view"), locator.state_name) == ("begun", "tracking")
    return locator


def test_a_view_without_a_fix_is_searched_and_the_track_goes_on(tracking):
    assert tracking.locate(None) is SEARCHING
    assert tracking.state_name == "coasting"
    assert tracking.locate("fix") == "fix"
    assert tracking.state_name == "tracking"


@pytest.mark.parametrize("view", ["end", "no map"])
def test_after_the_end_of_a_track_the_aircraft_is_lost_until_a_place_is_found(tracking, view):
    assert tracking.locate(view) is SEARCHING
    assert tracking.state_name == "lost"
    tracking._finder.outcomes = [FOUND]
    assert (tracking.locate("view"), tracking.state_name) == ("begun", "tracking")


def test_a_place_that_its_views_do_not_confirm_begins_no_track(locator, monkeypatch):
    monkeypatch.setattr(Track, "agrees", False)
    locator._finder.outcomes = [FOUND]
    assert locator.locate("view").reason == "searching"
    assert locator.state_name == "searching"


def test_a_view_that_cannot_be_used_has_its_reason(tracking):
    reason = NoFix("bad_image", "damaged")
    assert tracking.passed(None, reason) is reason
    assert tracking.state_name == "coasting"
