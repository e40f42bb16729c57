"""A tracker whose parts raise errors or whose telemetry is unknown: it never states the position of
the view before again."""

import copy
import inspect
import math
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from benchmarks.fakes import Time

from faulty_calls import FaultyCalls
from orthonav.core.errors import ArgumentError, CameraError
from orthonav.core.flight import open_flight
from orthonav.core.flight.mount import Bias, Mount
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.ground import Ground
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix, NoFix, Prior, Telemetry, View, ViewResult
from orthonav.core.track import Mixture, Model
from orthonav.core.track import tracker as tracker_module
from orthonav.core.track.smooth import History
from orthonav.core.track.tracker import Tracker
from orthonav.onboard import fly, run
from orthonav.onboard.cameras import CameraImage
from orthonav.onboard.fly import FlyOptions, Runner
from orthonav.onboard.messages.gate import Gate
from orthonav.onboard.outputs import Publisher
from orthonav.onboard.run import MountCorrected, locate_view

GOLDEN = Path(__file__).parents[1] / "data" / "golden_flight"
FIRST, BROKEN = 10, 3
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
    tracker = Tracker(localizer, smooth=True)
    rows = results(tracker, seen[:FIRST])
    assert all(result.is_recognized for result, _ in rows[-2:])
    return tracker, rows[-1][0]


@pytest.fixture
def tracker(localizer, confirmed):
    return copied(localizer, confirmed)


def copied(localizer, confirmed):
    tracker, _ = confirmed
    shared = (localizer, localizer.registration, tracker._past)
    return copy.deepcopy(tracker, {id(each): each for each in shared})


class Faults:
    """Parts that raise an error while `error` is set."""

    def __init__(self, monkeypatch):
        self._monkeypatch = monkeypatch
        self.error = None

    def at(self, owner, name):
        whole = getattr(owner, name)

        def part(*arguments, **named):
            if self.error is None:
                return whole(*arguments, **named)
            raise self.error

        self._monkeypatch.setattr(owner, name, part)


@pytest.fixture
def faults(monkeypatch):
    return Faults(monkeypatch)


def results(locator, seen, faults=None, error=None):
    """Results of views, and how often each failed. The first three of a tracker are broken."""
    rows = []
    for number, view in enumerate(seen):
        failures = []
        if faults is not None:
            faults.error = error if number < BROKEN else None
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


PARTS_OF_A_VIEW = [
    *[(Tracker, name) for name in ("locate", "_predict", "_step", "_update", "_outcome", "_fix")],
    *[(Mixture, name) for name in ("predict", "update", "estimate", "conclude", "_merge")],
    (History, "record"),
]


def moved_with_velocity(localizer, confirmed, seen, result):
    """Whether a position is that of the last view before the errors, moved since by the velocity
    reported."""
    if isinstance(result.outcome, NoFix):
        return False
    number = [view.telemetry.time_ns for view in seen].index(result.time_ns)
    moved_m = en_m(localizer, result) - en_m(localizer, confirmed[1])
    since = sum(expected_m(seen, each) for each in range(FIRST, number + 1))
    return np.hypot(*(moved_m - since)) < 12.0


def broken(promises):
    """Names of the promises of each call that are not held."""
    names = {call: [name for name, held in each.items() if not held] for call, each in promises}
    return {call: each for call, each in names.items() if each}


@pytest.mark.parametrize(("owner", "name"), PARTS_OF_A_VIEW)
def test_after_an_error_in_any_call_the_position_moves_with_the_velocity(
    localizer, confirmed, seen, owner, name, monkeypatch
):
    """And the next view is located again."""
    moved = partial(moved_with_velocity, localizer, confirmed, seen)

    def held():
        tracker = copied(localizer, confirmed)
        (bridged, failures), (good, others) = results(tracker, seen[FIRST : FIRST + 2])
        return {
            "counted": (failures, others) == (1, 0),
            "not recognized": not bridged.is_recognized and bridged.state != "tracking",
            "not frozen": moved(bridged),
            "located again": good.is_recognized and moved(good),
            "smoothed": len(tracker.smoothed_track()) == FIRST + 2,
        }

    assert not broken(FaultyCalls(monkeypatch, owner, name).each(held))


class Flown:
    """Views of a recording for the flight loop: the camera, and what listens to positions."""

    for_filter, outages, replaced, now = False, 0, 0, None

    def __init__(self, tracker, seen):
        self.time, self.left, self.published, self.said = Time(), [*seen], [], []
        publisher = Publisher(Gate(), self.time.clocks, lines=[self], graph=self)
        options = FlyOptions(recorded=True)
        parts = self, seen[0].camera, lambda: tracker, publisher, options
        self.runner = Runner(*parts, sink=MagicMock(lost={}))

    def take(self, _):
        self.time.go(1.2)
        self.now = view = None if self.is_over else self.left.pop(0)
        return view and CameraImage(
            *(1, "", self.time.now_ns, view.telemetry.time_ns, view.grey), telemetry=view.telemetry
        )

    @property
    def is_over(self):
        return not self.left

    def position(self, estimate, vehicle, stamp_ns):
        self.published.append(stamp_ns)
        return ("fix",)

    def view(self, result, *_):
        self.said.append(result)

    def health(self, _): ...

    def close(self): ...


LOOP = [(Runner, each) for each, whole in vars(Runner).items() if inspect.isfunction(whole)]
LOOP += [(run, "finite"), (run, "_is_finite"), (fly, "locate_view"), (Publisher, "publish")]
LOOP = [each for each in LOOP if each[1] not in ("__init__", "run")]


@pytest.mark.parametrize(("owner", "name"), LOOP, ids=[name for _, name in LOOP])
def test_an_error_in_any_call_of_the_flight_loop_costs_one_view(
    localizer, confirmed, seen, owner, name, monkeypatch
):
    """At most: nothing of it is published after the error; the next view is located again."""
    moved = partial(moved_with_velocity, localizer, confirmed, seen)
    counters = "internal_error", "log_failed", "output_failed"

    def held():
        flown = Flown(copied(localizer, confirmed), seen[FIRST : FIRST + 2])
        before = []
        calls.raised = lambda: before.extend([flown.now, *flown.published])
        flown.runner.run(threading.Event())
        total, published = flown.runner.counter.total, flown.published
        withheld = [
            view.telemetry.time_ns for view in before[:1] if view and total["internal_error"]
        ]
        return {
            "counted": sum(total[each] for each in counters) == 1,
            "not published": not set(withheld) & set(published[len(before) - 1 :]),
            "not frozen": all(moved(each) for each in flown.said),
            "located again": seen[FIRST + 1].telemetry.time_ns in published,
        }

    calls = FaultyCalls(monkeypatch, owner, name)
    assert not broken(calls.each(held))


@pytest.mark.parametrize(
    ("owner", "name"),
    [(Mixture, "predict"), (Mixture, "_predictions"), (tracker_module, "_reported_velocity")],
)
def test_without_dead_reckoning_there_is_no_position_until_the_next_view(
    localizer, confirmed, tracker, seen, faults, owner, name
):
    """The next prediction covers the time since the last one."""
    faults.at(owner, name)
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
        estimate = tracker.mixture.estimate(fix.radius_m)
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


NUMBERS = [
    (record, name, kind)
    for record in (Telemetry, Camera, Prior, Ground, View.of)
    for name, kind in inspect.get_annotations(record).items()
    if kind is int or "float" in str(kind)
]


def with_number(view, record, name, value):
    """The view with a number of it, of its camera, of its prior or of the ground below."""
    reported, change = view.telemetry, {name: value}
    if record == View.of:
        usual = {
            "agl_m": reported.agl_m,
            "heading_deg": reported.yaw_deg,
            "pitch_deg": reported.pitch_deg,
            "roll_deg": reported.roll_deg,
            "time_s": reported.time_ns / 1e9,
            "vel_en_mps": reported.vel_en_mps,
        }
        return View.of(view.grey, view.camera, **usual | change)
    if record is Camera:
        return replace(view, camera=replace(view.camera, **change))
    if record is Prior:
        change = {"prior": replace(Prior(46.5, 3.0, 9.0), **change)}
    if record is Ground:
        change = {"below": replace(Ground(30.0, 1.0, 1.0), **change)}
    return replace(view, telemetry=replace(reported, **change))


@pytest.fixture(scope="module")
def usual(localizer, confirmed, seen):
    """The third view after that, without faults."""
    return results(copied(localizer, confirmed), seen[FIRST : FIRST + 3])[-1][0]


@pytest.mark.parametrize("value", [math.nan, math.inf, None])
@pytest.mark.parametrize(
    ("record", "name", "kind"),
    NUMBERS,
    ids=[f"{each[0].__qualname__}-{each[1]}" for each in NUMBERS],
)
def test_what_is_no_number_is_named_or_unknown(
    localizer, tracker, usual, seen, record, name, kind, value
):
    """Then the view has a finite position or none, and two views later the track is as usual."""
    many = {"tuple[float, float]": 2, "tuple[float, ...]": 4}
    value = next(((value,) * count for word, count in many.items() if word in str(kind)), value)
    try:
        odd = with_number(seen[FIRST], record, name, value)
    except (ArgumentError, CameraError) as error:
        assert name in str(error).partition("Camera(")[0]
        return
    if record is Telemetry:
        assert getattr(odd.telemetry, name) is None or name in odd.telemetry.missing()
    for outcome in (localizer.locate(odd, prior=odd.telemetry.prior), tracker.locate(odd)):
        if isinstance(outcome, Fix):
            assert np.isfinite([outcome.lat_deg, outcome.lon_deg, outcome.std_m]).all()
            assert 0 <= outcome.confidence <= outcome.place_probability <= 1
            reported = outcome.heading_deg, outcome.agl_m, outcome.pitch_deg, outcome.roll_deg
            assert np.isfinite(reported).sum() == 4 - len(odd.telemetry.missing())
    *_, (later, _) = results(tracker, seen[FIRST + 1 : FIRST + 3])
    assert later.is_recognized
    assert en_m(localizer, later) == pytest.approx(en_m(localizer, usual), abs=5.0)


@pytest.mark.parametrize("name", [each for each in Telemetry.__slots__ if "_std_" in each])
def test_a_negative_deviation_is_unknown_not_exact(name):
    assert getattr(Telemetry(0, 1.0, 2.0, 3.0, 100.0, **{name: -1.0}), name) is None


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
