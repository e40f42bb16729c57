"""A tracker whose parts raise errors or whose telemetry is unknown: it never states the position of
the view before again."""

import copy
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orthonav.core.errors import MapFileError
from orthonav.core.flight import open_flight
from orthonav.core.flight.mount import Bias, Mount
from orthonav.core.geo.ground import Ground
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix, NoFix, Prior, Telemetry, View, ViewResult
from orthonav.core.track import Model
from orthonav.core.track import tracker as tracker_module
from orthonav.core.track.tracker import Tracker
from orthonav.onboard.run import MountCorrected, locate_view

GOLDEN = Path(__file__).parents[1] / "data" / "golden_flight"
FIRST, BROKEN = 12, 3
"""Views before the first at which a part raises an error, and number of those."""


@pytest.fixture(scope="module")
def localizer():
    return Localizer(open_map(GOLDEN / "area.onav"))


@pytest.fixture(scope="module")
def seen():
    flight = open_flight(GOLDEN / "flight")
    return [View(view.grey(), flight.camera, view.telemetry) for view in flight.views[:17]]


@pytest.fixture(scope="module")
def confirmed(localizer, seen):
    """A tracker before the first broken view, and its last position; not to be changed."""
    tracker = Tracker(localizer)
    rows = results(tracker, seen[:FIRST])
    assert all(result.is_recognized for result, _ in rows[-2:])
    return tracker, rows[-1][0]


@pytest.fixture
def tracker(localizer, confirmed):
    """A copy of it."""
    tracker, _ = confirmed
    shared = (localizer, localizer.registration, tracker._before)
    return copy.deepcopy(tracker, {id(each): each for each in shared})


class Faults:
    """Parts that raise an error while `error` is set."""

    def __init__(self, monkeypatch):
        self._monkeypatch = monkeypatch
        self.error, self.raised = None, 0

    def at(self, owner, name, calls=None):
        """`calls`: the first so many of a view; None: all."""
        whole = getattr(owner, name)

        def part(*arguments, **named):
            if self.error is None or (calls is not None and self.raised >= calls):
                return whole(*arguments, **named)
            self.raised += 1
            raise self.error

        self._monkeypatch.setattr(owner, name, part)

    def set(self, error):
        self.error, self.raised = error, 0


@pytest.fixture
def faults(monkeypatch):
    return Faults(monkeypatch)


def results(locator, seen, faults=None, error=None):
    """Results of views, and how often each failed. The first three of a tracker are broken."""
    rows = []
    for number, view in enumerate(seen):
        failures = []
        if faults is not None:
            faults.set(error if number < BROKEN else None)
        outcome, _ = locate_view(locator, view, lambda failures=failures: failures.append(1))
        result = ViewResult("", view.telemetry.time_ns, outcome, 0.0, locator.state_name)
        rows.append((result, len(failures)))
    return rows


def en_m(localizer, result):
    fix = result.outcome
    return localizer.sheet.frame.en_from_latlon(fix.lat_deg, fix.lon_deg)


def expected_m(seen, number):
    """Displacement (2,) since the view before, by the reported velocity."""
    now, before = seen[number].telemetry, seen[number - 1].telemetry
    return np.array(now.vel_en_mps) * (now.time_ns - before.time_ns) / 1e9


def owner_of(tracker, part):
    """The object of a dotted name, or the module, and the name of its function."""
    if hasattr(tracker_module, part):
        return tracker_module, part
    *owners, name = part.split(".")
    for each in owners:
        tracker = getattr(tracker, each)
    return tracker, name


PARTS = [
    # of `_predict`
    "mixture.bias",
    "_odometry_view",
    "_telemetry_noise",
    "_reported_velocity",
    "_expected_displacement",
    "_displacement",
    "_learn_velocity",
    "mixture.predict",
    "mixture._predictions",
    # of `_update`
    "mixture.estimate",
    "_must_compete",
    "_search_area",
    "_prior",
    "_correction",
    "_registration.search",
    "sightings",
    "mixture.update",
    "mixture._updated",
    "mixture._merge",
    # of the outcome
    "_fix",
]


@pytest.mark.parametrize("error", [MapFileError("damaged"), ValueError("odd")], ids=["map", "bug"])
@pytest.mark.parametrize("part", PARTS)
def test_after_an_error_the_position_moves_with_the_velocity(
    localizer, confirmed, tracker, seen, faults, part, error
):
    faults.at(*owner_of(tracker, part), calls=1)
    rows = results(tracker, seen[FIRST:], faults, error)
    assert rows[0][1] == rows[BROKEN - 1][1] == 1  # a view without odometry does not need all parts
    _, before = confirmed
    for number, (result, failures) in enumerate(rows[:BROKEN], FIRST):
        assert isinstance(result.outcome, Fix)
        if failures:
            assert not result.is_recognized and result.state != "tracking"
            assert result.outcome.confidence <= 0.8
            assert result.outcome.evidence["recognized"] == 0.0
        moved_m = en_m(localizer, result) - en_m(localizer, before)
        assert moved_m == pytest.approx(expected_m(seen, number), abs=6.0)
        before = result
    assert any(result.is_recognized for result, _ in rows[BROKEN:])


@pytest.mark.parametrize("part", ["mixture.predict", "mixture._predictions", "_reported_velocity"])
def test_without_dead_reckoning_there_is_no_position_until_the_next_view(
    localizer, confirmed, tracker, seen, faults, part
):
    """The next prediction covers the time since the last one."""
    faults.at(*owner_of(tracker, part))
    rows = results(tracker, seen[FIRST:], faults, ValueError("odd"))
    for result, failures in rows[:BROKEN]:
        assert isinstance(result.outcome, NoFix) and failures == 1
        assert result.outcome.reason == "internal_error" and not result.is_recognized
    moved_m = en_m(localizer, rows[BROKEN][0]) - en_m(localizer, confirmed[1])
    expected = sum(expected_m(seen, number) for number in range(FIRST, FIRST + BROKEN + 1))
    assert moved_m == pytest.approx(expected, abs=10.0)


def test_the_confidence_of_a_track_is_no_more_than_its_place_probability(localizer, seen):
    tracker = Tracker(localizer)
    for view in seen:
        fix = tracker.locate(view)
        assert fix.confidence <= fix.place_probability <= 1.0
        estimate = tracker.mixture.estimate(fix.radius_m, between_views=True)
        assert estimate.confidence <= estimate.place_probability


def test_behind_a_mount_an_error_view_is_predicted_once(localizer, tracker, seen, faults):
    """Each correction makes new telemetry."""
    level = Bias(0.0, 0.0, 0.0)
    locator = MountCorrected(tracker, Mount(level, level, level, level, 10))
    faults.at(tracker_module, "sightings")
    rows = results(locator, seen[FIRST:], faults, ValueError("odd"))
    for number in range(1, BROKEN):
        moved_m = en_m(localizer, rows[number][0]) - en_m(localizer, rows[number - 1][0])
        assert moved_m == pytest.approx(expected_m(seen, FIRST + number), abs=6.0)


def test_a_passed_view_moves_the_track_although_the_clock_stands_still(
    localizer, confirmed, tracker, seen
):
    """It is not taken for a view whose prediction was made before an error."""
    passed = tracker.passed(seen[FIRST - 1].telemetry, NoFix("bad_image", ""))
    plane, before = localizer.sheet.frame, confirmed[1].outcome
    moved_m = plane.en_from_latlon(passed.lat_deg, passed.lon_deg) - en_m(localizer, confirmed[1])
    assert np.hypot(*moved_m) > 10.0 and passed.std_m > before.std_m


UNKNOWN = {
    **{
        name: (math.nan, math.inf)
        for name in (
            *("yaw_std_deg", "agl_std_m", "tilt_std_deg", "mount_std_deg", "vel_std_mps"),
            *("home_m", "amsl_m", "hae_m"),
        )
    },
    "vel_en_mps": ((math.nan, 2.0), (2.0, math.nan)),
    "prior": (Prior(48.0, 48.0, math.inf),),
    "below": (Ground(math.nan, 1.0, 1.0), Ground(30.0, math.nan, 1.0)),
}
VALUES = [(name, value) for name, values in UNKNOWN.items() for value in values]


@pytest.mark.parametrize(("name", "value"), VALUES)
def test_what_is_not_finite_is_unknown(name, value):
    assert getattr(Telemetry(0, 1.0, 2.0, 3.0, 100.0, **{name: value}), name) is None
    assert Telemetry(0, math.nan, 2.0, 3.0, 100.0).missing() == ["yaw_deg"]


@pytest.mark.parametrize("name", [each for each in UNKNOWN if "_std_" in each])
def test_a_negative_deviation_is_unknown_not_exact(name):
    assert getattr(Telemetry(0, 1.0, 2.0, 3.0, 100.0, **{name: -1.0}), name) is None


def test_every_optional_field_is_covered():
    optional = [name for name in Telemetry.__slots__ if name in UNKNOWN]
    assert len(optional) == len(UNKNOWN) == len(Telemetry.__slots__) - 5


@pytest.mark.parametrize("name", UNKNOWN)
def test_views_with_nan_are_tracked_like_views_without_the_value(tracker, localizer, seen, name):
    other = copy.deepcopy(
        tracker, {id(each): each for each in (localizer, tracker._registration, tracker._before)}
    )
    found = []
    for each, value in ((tracker, UNKNOWN[name][0]), (other, None)):
        views = [
            replace(view, telemetry=replace(view.telemetry, **{name: value}))
            if not number
            else view
            for number, view in enumerate(seen[FIRST : FIRST + 2])
        ]
        found.append(results(each, views))
    for (nan, failures), (none, _) in zip(*found, strict=True):
        assert failures == 0 and nan.state == none.state
        assert nan.outcome.confidence == none.outcome.confidence
        assert (en_m(localizer, nan) == en_m(localizer, none)).all()


def test_a_tilt_without_deviation_has_the_usual_one_again(tracker, seen):
    used = []
    for tilt_std_deg, view in zip((0.2, math.nan, 0.5, None), seen[FIRST:], strict=False):
        tracker.locate(replace(view, telemetry=replace(view.telemetry, tilt_std_deg=tilt_std_deg)))
        used.append(math.degrees(tracker.mixture.model.horizon_rad))
    usual = math.degrees(Model.horizon_rad)
    assert used == pytest.approx([0.2, usual, 0.5, usual])


def test_the_prior_of_the_mount_is_that_of_the_first_height_from_which_views_are_located(
    localizer, seen
):
    """On the ground, metres there say nothing about the mount."""
    tracker, view = Tracker(localizer), seen[0]
    for agl_m in (0.5, 3.0):
        tracker.locate(replace(view, telemetry=replace(view.telemetry, agl_m=agl_m)))
        assert tracker.model.tilt_rad == pytest.approx(math.radians(1.5))
    tracker.locate(replace(view, telemetry=replace(view.telemetry, agl_m=800.0)))
    fixed = tracker.model.tilt_rad
    assert fixed == pytest.approx(10.0 / 800.0)
    tracker.locate(seen[1])
    assert tracker.model.tilt_rad == fixed == tracker.mixture.model.tilt_rad
