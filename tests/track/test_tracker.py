"""Tracking a flight over synthetic ground: following, bias estimation, loss and recovery."""

import copy
import math
from dataclasses import replace

import blots
import cv2
import numpy as np
import pytest
from blots import AGL_M, GROUND, Flat, Ground, place_of, rendered

from orthonav.core.errors import MapChangedError, MapFileError
from orthonav.core.geo.camera import Camera
from orthonav.core.localize import Localizer
from orthonav.core.localize.ground import GroundModel
from orthonav.core.localize.odometry import OdometryView, displacement
from orthonav.core.mapfile import open_map
from orthonav.core.records import PRIOR_SIGMAS, Fix, NoFix, Prior, Telemetry, View
from orthonav.core.track import tracker as tracker_module
from orthonav.core.track.filter import STATE
from orthonav.core.track.hypothesis import Shown, State
from orthonav.core.track.mixture import Estimate
from orthonav.core.track.tracker import Tracker
from orthonav.ground.recordings.localize import localize_flight, smoothed_track

WIDE = Camera(320, 240, 200.0, 200.0, 160.0, 120.0)
SPEED_MPS = 14.0
OTHER = Ground(seed=1)


map_path, localizer = blots.known_path, blots.known_localizer


def changed(grey, rng):
    """Another year: other light, noise, and different content in a part of the view."""
    other = OTHER(*np.meshgrid(np.arange(320) + rng.uniform(-200, 200), np.arange(240)))
    small = cv2.GaussianBlur(rng.standard_normal((60, 80)), (0, 0), 25 / 4)
    mask = cv2.resize(small, grey.shape[::-1], interpolation=cv2.INTER_CUBIC) > 0
    mixed = np.where(mask, 0.7 * grey.astype(float) + 20, 0.5 * grey + 0.5 * other)
    return np.clip(mixed + rng.normal(0, 4, grey.shape), 0, 255).astype(np.uint8)


def lit(grey, rng):
    """The same ground in other light."""
    return np.clip(0.75 * grey + 30 + rng.normal(0, 6, grey.shape), 0, 255).astype(np.uint8)


def legs(count, start=(-160.0, -120.0), turn_at=14):
    """Places (N, 2) and headings of a flight with a turn, one view a second."""
    place, heading = np.array(start), 60.0
    for number in range(count):
        yield place.copy(), heading
        heading = 60.0 if number < turn_at else -35.0
        along = math.radians(heading)
        place = place + SPEED_MPS * np.array([math.sin(along), math.cos(along)])


def spots(count, seed=4):
    """Places (N, 2) and headings that have nothing to do with each other."""
    rng = np.random.default_rng(seed)
    return zip(rng.uniform(-150, 150, (count, 2)), rng.uniform(0, 360, count), strict=True)


def views(
    count,
    *,
    where=None,
    heading_off=0.0,
    tilt=(0.0, 0.0),
    scale=1.0,
    seed=0,
    year=changed,
    every_s=1,
    **legs_,
):
    """Grey views, their telemetry, and where they were taken."""
    rng = np.random.default_rng(seed)
    for number, (place, heading) in enumerate(where or legs(count, **legs_)):
        grey = rendered(GROUND, place, (heading, *tilt), AGL_M * scale, WIDE)
        telemetry = Telemetry(
            every_s * number * 10**9, heading - heading_off + rng.normal(0, 1.0), 0.0, 0.0, AGL_M
        )
        yield year(grey, rng), telemetry, place


def followed(tracker, localizer, seen):
    """Errors in m, confidences, states and fixes of a flight."""
    rows = []
    for grey, telemetry, place in seen:
        found = tracker.locate(View(grey, WIDE, telemetry))
        error = np.inf
        if isinstance(found, Fix):
            error = float(np.hypot(*(place_of(localizer, found) - place)))
        rows.append((error, getattr(found, "confidence", 0.0), tracker.state_name, found))
    return rows


@pytest.fixture(scope="module")
def usual(localizer):
    """A flight of 22 views, its tracker with history, and what came out; not to be changed."""
    seen, tracker = list(views(22)), Tracker(localizer, smooth=True)
    return seen, tracker, followed(tracker, localizer, seen)


def test_a_flight_is_followed(usual):
    rows = usual[2]
    errors = np.array([row[0] for row in rows])
    assert [row[2] for row in rows[10:]] == ["tracking"] * 12
    assert errors[4:].max() < 6 and all(row[1] > 0.9 for row in rows[10:])
    last = rows[-1][3]
    assert last.vel_en_mps[1] == pytest.approx(SPEED_MPS * math.cos(0.61), abs=3)


def test_the_confidence_of_a_track_is_that_of_its_covariance_and_place(usual):
    for *_, fix in usual[2]:
        if isinstance(fix, Fix):
            assert fix.confidence == pytest.approx(fix.probability_within(fix.radius_m))


@pytest.mark.long
def test_biases_of_heading_height_and_mount_are_estimated(localizer, monkeypatch):
    """Uncorrected, 5 deg of pitch are 13 m from 150 m. Over known ground single views show their
    tilt themselves."""
    ground = GroundModel(Flat(), localizer.grid, surface=Flat())
    monkeypatch.setattr(localizer.registration, "ground", ground)
    tracker = Tracker(localizer)
    seen = list(
        views(
            0, where=spots(18), year=lit, every_s=60, heading_off=6.0, tilt=(5.0, -2.0), scale=1.05
        )
    )
    rows = followed(tracker, localizer, seen)
    bias = rows[-1][3].bias
    assert bias.heading_bias_deg == pytest.approx(6.0, abs=1.5)
    assert bias.log_scale_bias == pytest.approx(math.log(1.05), abs=0.02)
    assert bias.pitch_bias_deg == pytest.approx(5.0, abs=1.5)
    assert bias.roll_bias_deg == pytest.approx(-2.0, abs=1.5)
    alone = [localizer.locate(View(grey, WIDE, telemetry)) for grey, telemetry, _ in seen[12:]]
    single = [
        np.hypot(*(place_of(localizer, a) - s[2])) for a, s in zip(alone, seen[12:], strict=True)
    ]
    tracked = [row[0] for row in rows[12:]]
    assert np.median(tracked) < 2 and np.median(single) < 2


def test_smoothing_corrects_the_beginning_of_a_flight(localizer):
    tracker = Tracker(localizer, smooth=True)
    seen = list(views(14, tilt=(5.0, 0.0)))
    rows = followed(tracker, localizer, seen)
    after = [
        np.hypot(*(place_of(localizer, fix) - place))
        for fix, (_, _, place) in zip(tracker.smoothed_track(), seen, strict=True)
    ]
    assert max(after) < 15 and len(rows) == len(after)
    assert np.mean(after[:4]) < 6  # 5 deg of pitch are 13 m from 150 m
    with pytest.raises(ValueError, match="smooth=True"):
        Tracker(localizer).smoothed_track()


def out_and_back():
    """Places and headings of a flight that leaves the map to the east for 12 s and comes back."""
    place = np.array([60.0, -40.0])
    for number in range(34):
        yield place.copy(), 90.0 if number < 17 else 270.0
        place = place + np.array([20.0 if number < 16 else -20.0, 0.0])


@pytest.mark.long
def test_a_flight_that_leaves_the_map_is_dead_reckoned_and_found_again(localizer):
    tracker = Tracker(localizer)
    rows = followed(tracker, localizer, views(0, where=out_and_back()))
    std = [math.sqrt(np.trace(row[3].cov_en_m2) / 2) for row in rows]
    errors = [row[0] for row in rows]
    assert all(error < 3.5 * one for error, one in zip(errors, std, strict=True))
    assert not any(row[1] > 0.9 and row[0] > 35 for row in rows)
    assert max(errors[10:]) < 12
    assert rows[-1][2] == "tracking" and errors[-1] < 8


@pytest.mark.long
def test_without_usable_views_the_track_is_lost_and_found_again(localizer):
    tracker = Tracker(localizer)
    followed(tracker, localizer, views(9))
    white, spread = np.full((240, 320), 255, np.uint8), []
    for number in range(9, 60, 3):
        found = tracker.locate(View(white, WIDE, Telemetry(number * 10**9, 60.0, 0, 0, AGL_M)))
        spread.append(float(np.trace(found.cov_en_m2)))
    assert tracker.state_name == "lost" and found.confidence < 0.3
    assert spread[-1] > 50 * spread[0]
    later = (
        (grey, replace(telemetry, time_ns=telemetry.time_ns + 60 * 10**9), place)
        for grey, telemetry, place in views(12, start=(60.0, 0.0), turn_at=3)
    )
    rows = followed(tracker, localizer, later)
    assert rows[-1][2] == "tracking" and rows[-1][0] < 8


@pytest.mark.long
def test_views_that_show_nothing_are_bridged(localizer):
    tracker = Tracker(localizer)
    rows = []
    for number, (grey, telemetry, place) in enumerate(views(20)):
        if number in (8, 9, 10):
            grey = np.full_like(grey, 255)
        if number == 12:
            telemetry = replace(telemetry, agl_m=math.nan)
        if number == 14:
            telemetry = replace(
                telemetry, time_ns=telemetry.time_ns - 3 * 10**9
            )  # a clock that jumps
        rows += followed(tracker, localizer, [(grey, telemetry, place)])
    errors = [row[0] for row in rows]
    assert max(errors[5:8]) < 6 and max(errors[8:11]) < 30 and max(errors[15:]) < 8
    variance = [float(np.trace(row[3].cov_en_m2)) for row in rows]
    assert variance[10] > variance[8] > variance[7]


@pytest.fixture(scope="module")
def tracking(localizer):
    """A tracker after 12 views with reported velocity, and 5 views more; not to be changed."""
    seen = []
    for number, (grey, reported, place) in enumerate(views(17)):
        along = math.radians(60.0 if number < 15 else -35.0)
        velocity = (SPEED_MPS * math.sin(along), SPEED_MPS * math.cos(along))
        seen.append((grey, replace(reported, vel_en_mps=velocity), place))
    tracker = Tracker(localizer)
    rows = followed(tracker, localizer, seen[:12])
    assert [row[2] for row in rows[8:]] == ["tracking"] * 4
    return tracker, seen[12:]


def copied(localizer, tracking):
    """That tracker for one test, and the views that follow."""
    before, ahead = tracking
    shared = (localizer, localizer.registration, before._past)
    return copy.deepcopy(before, {id(each): each for each in shared}), ahead


@pytest.mark.parametrize(
    "picture", ["mirrored", pytest.param("noise", marks=pytest.mark.slow), "cloud", "turned"]
)
def test_pictures_of_anything_else_give_dead_reckoning_only(localizer, tracking, picture):
    """The views overlap, and the reported velocity is reversed."""
    tracker, ahead = copied(localizer, tracking)
    rng = np.random.default_rng(5)
    cloud = cv2.GaussianBlur(rng.normal(0, 900, (240, 320)), (0, 0), 12) + 190
    rows = []
    for seen, reported, place in ahead:
        east, north = reported.vel_en_mps
        telemetry, grey = replace(reported, vel_en_mps=(-east, -north)), seen
        if picture == "turned":
            telemetry = replace(telemetry, yaw_deg=telemetry.yaw_deg + 86.0)
        else:
            made = {
                "mirrored": seen[:, ::-1],
                "noise": rng.normal(128, 40, seen.shape),
                "cloud": cloud + rng.normal(0, 2, seen.shape),
            }[picture]
            grey = np.ascontiguousarray(np.clip(made, 0, 255).astype(np.uint8))
        rows += followed(tracker, localizer, [(grey, telemetry, place)])
    assert {row[2] for row in rows} <= {"coasting", "lost"}
    assert max(row[1] for row in rows) <= 0.8


def test_a_followed_flight_is_searched_for_around_the_track_only(localizer, tracking, monkeypatch):
    """With its heading and height as far as they are known."""
    (tracker, ahead), asked = copied(localizer, tracking), []
    whole = tracker_module.Search.of

    def noted(registration, view, prior, heading_known):
        asked.append((prior, view.telemetry))
        return whole(registration, view, prior, heading_known)

    monkeypatch.setattr(tracker_module.Search, "of", noted)
    followed(tracker, localizer, ahead[:1])
    ((prior, known),) = asked
    middle = localizer.sheet.frame.en_from_latlon(prior.lat_deg, prior.lon_deg)
    assert math.dist(middle, ahead[0][2]) < prior.std_m * PRIOR_SIGMAS < 60
    assert known.yaw_std_deg < 3.0 and known.agl_std_m < 0.03 * AGL_M


@pytest.mark.parametrize(("ground", "confirms"), [(1.0, False), (2.0, True)])
def test_near_a_lost_track_views_confirm_only_a_confirmed_place(localizer, ground, confirms):
    """After 10 s without telemetry a place 317 m off was confirmed by views around itself."""
    exact, shown = 25.0 * np.eye(STATE), Shown(ground, followed=True)
    lost = Estimate(np.zeros(STATE), exact, 0.8, 0.8, State.LOST, 0.99, shown)
    area = Tracker(localizer)._search_area(lost, whole_map=False)
    assert area.circle is not None and area.confirms is confirms


def test_unknown_heading_is_tracked(localizer):
    seen = [(g, replace(t, yaw_deg=math.nan), p) for g, t, p in views(8)]
    rows = followed(Tracker(localizer, heading_known=False), localizer, seen)
    assert max(row[0] for row in rows[3:]) < 10


def test_a_map_without_a_layer_is_refused(map_path):
    plain = Localizer(open_map(map_path), registration=False)
    with pytest.raises(MapFileError, match="registration layer"):
        Tracker(plain)


class Recorded:
    """A flight in memory."""

    camera, note, expected = WIDE, "", 0

    def __init__(self, seen, broken=()):
        self.views = [MemoryView(n, g, t, n in broken) for n, (g, t, _) in enumerate(seen)]


class MemoryView:
    def __init__(self, number, grey, telemetry, broken):
        self.frame, self.where, self.telemetry = f"{number}.png", "memory", telemetry
        self._grey, self._broken = grey, broken

    def grey(self):
        if self._broken:
            from orthonav.core.errors import FlightError

            raise FlightError("broken")
        return self._grey


def test_every_view_has_a_result_and_a_state(localizer, monkeypatch):
    """Also where the map changed, or dead reckoning failed: the tracker has no record of these, and
    smoothed positions are those of the same views."""
    seen = list(views(14))
    tracker = Tracker(localizer, smooth=True)
    whole, passed = tracker._update, tracker.passed

    def sometimes(*arguments):
        second = tracker._past.time_ns / 1e9
        if second in (5, 6):
            raise RuntimeError("a bug")
        if second == 7:
            raise MapChangedError("rewritten")
        return whole(*arguments)

    def sometimes_passed(telemetry, reason):
        if telemetry.time_ns == 6 * 10**9:
            raise RuntimeError("another bug")
        return passed(telemetry, reason)

    monkeypatch.setattr(tracker, "_update", sometimes)
    monkeypatch.setattr(tracker, "passed", sometimes_passed)
    flight = Recorded(seen, broken=(3,))
    results = list(localize_flight(tracker, flight, skip_bad_images=True))
    assert [result.frame for result in results] == [f"{n}.png" for n in range(14)]
    assert results[-1].state == "tracking" and isinstance(results[3].outcome, Fix)
    assert isinstance(results[5].outcome, Fix)
    again = smoothed_track(tracker, results, None)
    reasons = {"internal_error", "map_file_changed"}
    assert {each.outcome.reason for each in again if isinstance(each.outcome, NoFix)} == reasons
    assert [each.frame for each in again] == [each.frame for each in results]
    for each, (_, _, place) in zip(again, seen, strict=True):
        if isinstance(each.outcome, Fix):
            assert np.hypot(*(place_of(localizer, each.outcome) - place)) < 25


@pytest.mark.parametrize("expected", [None, (0.0, 0.0), (-29.0, 27.0), (300.0, 0.0)])
@pytest.mark.parametrize("moved", [(18.0, 0.0), (-30.0, 25.0), (0.0, -70.0)])
def test_odometry_measures_the_displacement(moved, expected):
    """Whatever displacement was expected."""
    rng = np.random.default_rng(7)
    footprints = []
    for number, (place, heading) in enumerate((((0.0, 0.0), 40.0), (moved, 43.0))):
        grey = rendered(GROUND, place, (heading, 0, 0), AGL_M, WIDE)
        noisy = np.clip(grey + rng.normal(0, 5, grey.shape), 0, 255).astype(np.uint8)
        telemetry = Telemetry(number * 10**9, heading, 0.0, 0.0, AGL_M)
        pixel_m = footprints[0].pixel_m if footprints else None
        footprints.append(OdometryView.of(View(noisy, WIDE, telemetry), pixel_m))
    heading_scale_noise = np.array([1e-3, 4e-4])
    expected = None if expected is None else np.array(expected)
    seen = displacement(*footprints, 0.0, heading_scale_noise, expected)
    assert seen.displacement.moved_en_m == pytest.approx(moved, abs=0.7)
    assert 0 < seen.overlap < 1


def test_gnss_of_a_first_leg_calibrates_the_mount(localizer):
    """Against measured positions: 5 deg of pitch are 13 m from 150 m. What lasts longer than an
    error of the horizon is the mount."""
    frame = localizer.sheet.frame
    tracker = Tracker(localizer, every_prior=True)
    seen = []
    for grey, telemetry, place in views(10, tilt=(5.0, -3.0), year=lit, every_s=10):
        lat, lon = frame.latlon_from_en(place)
        known = {"prior": Prior(float(lat), float(lon), 2.0), "tilt_std_deg": 1.0}
        seen.append((grey, replace(telemetry, **known), place))
    rows = followed(tracker, localizer, seen)
    last, bias = rows[-1][3], rows[-1][3].bias
    assert (bias.pitch_bias_deg, bias.roll_bias_deg) == pytest.approx((5.0, -3.0), abs=1.5)
    assert max(bias.pitch_bias_std_deg, bias.roll_bias_std_deg) < 1.5
    assert (last.pitch_deg, last.roll_deg) == pytest.approx((5.0, -3.0), abs=1.0)
    assert (rows[2][3].pitch_deg, rows[2][3].roll_deg) == pytest.approx((5.0, -3.0), abs=2.0)


@pytest.mark.parametrize("std_m", [1e5, 1e300])
@pytest.mark.parametrize("every_prior", [False, True])
def test_a_prior_of_no_accuracy_changes_nothing(localizer, every_prior, std_m):
    seen, unknown = list(views(8)), Prior(46.5, 3.0, std_m)
    rows = [
        followed(Tracker(localizer, every_prior=every_prior), localizer, each)
        for each in (seen, [(a, replace(b, prior=unknown), c) for a, b, c in seen])
    ]
    for off_m, *_, fix in (each[-1] for each in rows):
        assert off_m < 8 and fix.std_m < 8 and fix.is_confident


def test_an_impossible_velocity_is_none(localizer):
    """As of memory that was never written."""
    seen = list(views(8))
    odd = [(a, replace(b, vel_en_mps=(1e300, 1e154)), c) for a, b, c in seen]
    off_m, *_, fix = followed(Tracker(localizer), localizer, odd)[-1]
    assert off_m < 8 and fix.is_confident


@pytest.mark.long
def test_a_place_that_contradicts_the_start_is_found_and_not_believed_at_once(localizer):
    tracker, seen = Tracker(localizer), list(views(19))
    lat, lon = localizer.sheet.frame.latlon_from_en((-160.0, 30.0))  # 150 m from the true place
    grey, telemetry, place = seen[0]
    seen[0] = grey, replace(telemetry, prior=Prior(float(lat), float(lon), 15.0)), place
    rows = followed(tracker, localizer, seen)
    assert rows[0][0] > 100
    assert all(row[0] < 10 for row in rows if row[2] == "tracking" or row[1] > 0.8)
    assert rows[-1][0] < 10 and {row[2] for row in rows} == {"searching"}  # too little new ground
