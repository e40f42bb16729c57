"""The track of simulated sightings: found, followed, lost, found again, and honest all along."""

import copy
import functools
import math
from dataclasses import replace

import numpy as np
import pytest

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize.odometry import CameraDisplacement
from orthonav.core.localize.sighting import Sighting
from orthonav.core.track import (
    Mixture,
    Model,
    ReportedAttitude,
    ReportedVelocity,
    State,
)
from orthonav.core.track.filter import WHITE_SHARE
from orthonav.core.track.mixture import Hypothesis
from orthonav.core.track.smooth import History

AREA_M2 = 4e6
SIDE_M = math.sqrt(AREA_M2)
EXTENT = (-SIDE_M / 2, -SIDE_M / 2, SIDE_M / 2, SIDE_M / 2)
RADIUS_M = 35.0
MODEL = Model(horizon_rad=math.radians(1.5))
SPEED = np.array([12.0, 5.0])
BIAS = np.array([math.radians(5.0), 0.04, math.radians(-2.0), math.radians(1.5)])


class Flight:
    """True positions, and what views and odometry say of them."""

    def __init__(self, seed, model=MODEL, bias=BIAS):
        self.rng = np.random.default_rng(seed)
        self.place = self.rng.uniform(-0.3, 0.3, 2) * SIDE_M
        self.model, self.bias = model, bias

    def moved(self, seconds=1.0):
        """A second of flight: what odometry says, turned and scaled by the biases."""
        moved = SPEED * seconds + self.rng.normal(0, 1.0, 2)
        self.place = self.place + moved
        cos, sin = math.cos(-self.bias[0]), math.sin(-self.bias[0])
        reported = np.array([[cos, sin], [-sin, cos]]) @ moved * math.exp(-self.bias[1])
        noisy = reported + self.rng.normal(0, 0.5, 2)
        return CameraDisplacement(noisy, np.eye(2) * 0.25, 80.0)

    def reported(self):
        """What instruments say: level and north, where the truth is the biases and noise."""
        return ReportedAttitude(0.0, 0.0, 0.0)

    def sighting(self, log_odds=4.0, at=None):
        """The view's own place, or a false one: tilt and position err together."""
        spread = np.diag([4.0, 4.0, 1e-4, 1e-4, 4e-4, 4e-4])
        spread[0, 4] = spread[4, 0] = 0.7 * math.sqrt(4.0 * 4e-4)
        error = self.rng.multivariate_normal(np.zeros(6), spread)
        error[:2] += self.rng.normal(0, self.model.sighting_noise_m, 2)
        error[4:] += self.rng.normal(0, WHITE_SHARE * self.model.horizon_rad, 2)
        mean = np.concatenate([self.place if at is None else at, self.bias]) + error
        return Sighting(mean, spread, log_odds)


def off_m(mixture, flight):
    return float(np.hypot(*(mixture.estimate(RADIUS_M).mean[:2] - flight.place)))


def flown(*arguments, **named):
    """A flight and its mixture at the end, for this test alone, and its rows; flown once."""
    return copy.deepcopy(_flown(*arguments, **named))


@functools.cache
def _flown(seed, views=60, false_share=0.3, history=None):
    """A flight with false sightings beside the true ones, some of them instead."""
    model = MODEL
    flight, mixture = Flight(seed, model), Mixture(model, EXTENT)
    rows = []
    for view in range(views):
        if view:
            mixture.predict(1.0, camera=flight.moved())
        false = flight.sighting(-1.0, flight.rng.uniform(-0.5, 0.5, 2) * SIDE_M)
        seen = [false] if flight.rng.random() < false_share else [flight.sighting(2.0), false]
        mixture.update(flight.reported(), seen)
        estimate = mixture.estimate(RADIUS_M)
        error = estimate.mean[:2] - flight.place
        rows.append((*error, estimate.confidence, estimate))
        if history is not None:
            history.record(mixture, view)
            rows[-1] += (flight.place,)
    return flight, mixture, rows


@functools.cache
def known(seed):
    """A flight shared by tests that only read it: its mixture at the end, rows and history."""
    history = History()
    return *_flown(seed, history=history)[1:], history


@pytest.mark.parametrize("seed", range(3))
def test_a_flight_is_found_and_followed(seed):
    _, rows, _ = known(seed)
    errors = np.hypot([row[0] for row in rows], [row[1] for row in rows])
    assert errors[10:].max() < 15 and np.median(errors[10:]) < 4
    assert {row[3].state for row in rows[10:]} == {State.TRACKING, State.COASTING}
    assert np.median([row[2] for row in rows[10:]]) > 0.99


@pytest.mark.slow
def test_normalized_errors_are_those_of_its_covariance():
    """Chi-square of two: mean 2. 95 % bounds of the mean over independent flights."""
    values = []
    for seed in range(60):
        flight, mixture, _ = flown(seed, views=20, false_share=0.2)
        estimate = mixture.estimate(RADIUS_M)
        error = estimate.mean[:2] - flight.place
        values.append(error @ np.linalg.solve(estimate.covariance[:2, :2], error))
    assert 1.48 < np.mean(values) < 2.55


def test_one_lucky_view_is_no_track():
    flight, mixture = Flight(1), Mixture(MODEL, EXTENT)
    mixture.update(flight.reported(), [flight.sighting(30.0)])
    first = mixture.estimate(RADIUS_M)
    assert first.state is State.SEARCHING and first.confidence < 0.9999
    mixture.predict(1.0, camera=flight.moved())
    mixture.update(flight.reported(), [flight.sighting(3.0)])
    assert mixture.estimate(RADIUS_M).state is State.TRACKING


def test_views_of_the_same_ground_are_not_new():
    """A false place that stays with views that overlap is not believed as if they did not."""
    believed = []
    for newness in (0.1, 1.0):
        flight, mixture = Flight(2), Mixture(MODEL, EXTENT)
        for _ in range(5):
            mixture.update(flight.reported(), [flight.sighting(-1.5)], newness)
        believed.append(mixture.estimate(RADIUS_M).confidence)
    assert believed[0] < 0.9 < believed[1]


def test_overlapping_views_repeat_their_error_and_a_track_is_no_less_certain_than_one_view():
    """Views that all show the same ground, with one error."""
    values = []
    for seed in range(40):
        flight, mixture = Flight(seed), Mixture(MODEL, EXTENT)
        first = flight.sighting(4.0)
        off = first.mean - np.concatenate([flight.place, BIAS])
        for view in range(8):
            if view:
                velocity = ReportedVelocity(SPEED, SPEED if view > 1 else None, 5.0)
                flight.moved()
                mixture.predict(1.0, velocity, overlap=1.0)
            here = np.concatenate([flight.place, BIAS]) + off
            sighting = Sighting(here, first.covariance, 4.0)
            mixture.update(flight.reported(), [sighting], 1.0 if view == 0 else 0.15)
        found = mixture.estimate(RADIUS_M)
        error = found.mean[:2] - flight.place
        values.append(error @ np.linalg.solve(found.covariance[:2, :2], error))
        own_m2 = first.covariance[0, 0] + MODEL.sighting_noise_m**2
        assert 0.7 * own_m2 < found.covariance[0, 0] < 1.05 * own_m2
    assert 1.2 < np.mean(values) < 3


def test_a_view_that_shows_hardly_anything_of_its_camera_is_used_all_the_same():
    """Position and tilt err as one, by 10 km: rounding leaves that covariance indefinite."""
    flight, mixture = Flight(3), Mixture(MODEL, EXTENT)
    sighting = flight.sighting()
    lever = np.array([[7e3, 0.0], [0.0, 7e3]])
    spread = np.diag([0.0, 0.0, 1e-8, 1e-8, 0.0, 0.0])
    spread[:2, :2], spread[:2, 4:], spread[4:, :2] = (
        2.04 * lever @ lever,
        2.04 * lever,
        2.04 * lever,
    )
    spread[4:, 4:] = 2.04 * np.eye(2) * (1 - 4.05e-8)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(spread + np.diag(np.square([2.0, 2.0, 5e-3, 4e-3, 0.0, 0.0])))
    mixture.update(flight.reported(), [replace(sighting, covariance=spread)])
    assert np.isfinite(mixture.estimate(RADIUS_M).covariance).all()


def test_without_sightings_it_becomes_lost_and_its_covariance_grows():
    flight, mixture, _ = flown(3)
    spread = [np.trace(mixture.estimate(RADIUS_M).covariance[:2, :2])]
    states = []
    for _ in range(30):
        mixture.predict(10.0)
        mixture.update(flight.reported(), [])
        estimate = mixture.estimate(RADIUS_M)
        spread.append(np.trace(estimate.covariance[:2, :2]))
        states.append(estimate.state)
    assert (np.diff(spread[:5]) > 0).all() and spread[-1] > 50 * spread[0]
    assert states[-1] is State.LOST and estimate.confidence < 0.3
    assert np.isfinite(estimate.mean).all() and np.abs(estimate.mean[:2]).max() < SIDE_M


def test_a_kidnapped_aircraft_is_found_again():
    """A short track, so that a few more views are believed against it."""
    flight, mixture, _ = flown(4, views=10)
    flight.place = -flight.place
    states, confident_wrong = [], 0
    for _ in range(18):
        mixture.predict(1.0, camera=flight.moved())
        mixture.update(flight.reported(), [flight.sighting(3.0)])
        states.append(mixture.estimate(RADIUS_M).state)
        wrong = off_m(mixture, flight) > RADIUS_M
        confident_wrong += wrong and mixture.estimate(RADIUS_M).confidence > 0.9
    assert states[-1] is State.TRACKING and off_m(mixture, flight) < 10
    assert confident_wrong == 0


def test_false_places_that_come_and_go_are_not_followed():
    """Views of nowhere on the map, each with a place that it is somewhat like."""
    confident = 0
    for seed in range(2):
        flight, mixture = Flight(seed), Mixture(MODEL, EXTENT)
        for _ in range(14):
            mixture.predict(1.0, camera=flight.moved())
            places = [flight.rng.uniform(-0.5, 0.5, 2) * SIDE_M for _ in range(3)]
            seen = [flight.sighting(flight.rng.normal(-3, 1), place) for place in places]
            mixture.update(flight.reported(), seen)
            confident += mixture.estimate(RADIUS_M).confidence > 0.9
    assert confident <= 1


def test_a_bias_jump_is_followed():
    flight, mixture, _ = flown(5)
    flight.bias = flight.bias + np.array([0.0, 0.0, math.radians(9.0), 0.0])
    for _ in range(15):
        mixture.predict(1.0, camera=flight.moved())
        mixture.update(flight.reported(), [flight.sighting(3.0)])
    assert off_m(mixture, flight) < 12
    assert mixture.estimate(RADIUS_M).mean[6] > BIAS[2] + 0.05


def test_a_reported_start_holds_until_views_contradict_it():
    flight = Flight(6)
    right, wrong = Mixture(MODEL, EXTENT), Mixture(MODEL, EXTENT)
    right.start(flight.place + np.array([10.0, 0.0]), 20.0)
    wrong.start(-flight.place, 20.0)
    for _ in range(12):
        moved = flight.moved()
        sighting = flight.sighting(2.0)
        for mixture in (right, wrong):
            mixture.predict(1.0, camera=moved)
            mixture.update(flight.reported(), [sighting])
    assert off_m(right, flight) < 10 and off_m(wrong, flight) < 10


def test_smoothing_does_not_believe_what_no_view_was_believed_for():
    flight, mixture, history = Flight(5), Mixture(MODEL, EXTENT), History()
    for number, away_m in enumerate([(0.0, 0.0)] * 11 + [EAST] * 8):
        mixture.update(flight.reported(), [flight.sighting(4.0, flight.place + np.array(away_m))])
        mixture.estimate(RADIUS_M)
        history.record(mixture, number)
        mixture.predict(1.0, ReportedVelocity(SPEED, None, 1.0), flight.moved())
    beliefs = [each.belief for each in history.smoothed()]
    assert min(beliefs[:11]) > 0.99 and max(beliefs[11:]) <= 0.8


def test_smoothing_reduces_error_and_covariance():
    before, after, ratios = [], [], []
    for seed in range(3):
        _, rows, history = known(seed)
        smoothed = history.smoothed()
        assert len(smoothed) == len(rows) and None not in smoothed
        pairs = list(zip(rows, smoothed, strict=True))[5:]  # before, it may not be found yet
        for (east, north, _, estimate, place), found in pairs:
            error = found.mean[:2] - place
            before.append(math.hypot(east, north))
            after.append(float(np.hypot(*error)))
            spread = np.trace(found.covariance[:2, :2])
            ratios.append(spread / np.trace(estimate.covariance[:2, :2]))
    assert np.mean(after) < 0.85 * np.mean(before) and max(after) <= max(before)
    assert np.median(ratios) < 0.95


def test_far_hypotheses_and_gaps_stay_finite():
    flight, mixture, _ = flown(8, views=10)
    for seconds in (0.0, 1e-3, 600.0, 1e5):
        mixture.predict(seconds)
        mixture.update(flight.reported(), [flight.sighting(1.0)])
        estimate = mixture.estimate(RADIUS_M)
        assert np.isfinite(estimate.mean).all() and np.isfinite(estimate.covariance).all()
        assert np.linalg.eigvalsh(estimate.covariance).min() > 0
        total = sum(each.share for each in mixture.hypotheses) + mixture.elsewhere
        assert total == pytest.approx(1)


def test_odometry_outliers_are_rejected():
    """A cloud that moves over the ground: the reported velocity contradicts odometry."""
    flight, mixture, _ = flown(5)
    before = None
    for _ in range(12):
        flight.moved()
        wrong = CameraDisplacement(3 * SPEED, np.eye(2) * 0.25, 80.0)
        mixture.predict(1.0, ReportedVelocity(SPEED, before, 1.0), wrong)
        before = SPEED
        mixture.update(flight.reported(), [])
    estimate = mixture.estimate(RADIUS_M)
    assert off_m(mixture, flight) < 25 or estimate.confidence < 0.5


def test_a_sudden_turn_is_followed_without_reported_velocity():
    flight, mixture, _ = flown(6)
    for _ in range(4):
        moved = np.array([-14.0, 9.0])
        flight.place = flight.place + moved
        cos, sin = math.cos(-BIAS[0]), math.sin(-BIAS[0])
        reported = np.array([[cos, sin], [-sin, cos]]) @ moved * math.exp(-BIAS[1])
        mixture.predict(1.0, camera=CameraDisplacement(reported, np.eye(2) * 0.25, 80.0))
        mixture.update(flight.reported(), [])
    assert off_m(mixture, flight) < 10


@pytest.mark.parametrize(("tilt_deg", "found"), [(0.0, 0.0), (7.0, 7.0)])
def test_a_mount_is_good_unless_views_say_otherwise(tilt_deg, found):
    bias = np.array([0.0, 0.0, math.radians(tilt_deg), 0.0])
    flight, mixture = Flight(9, bias=bias), Mixture(MODEL, EXTENT)
    for view in range(15):
        if view:
            mixture.predict(1.0, camera=flight.moved())
        mixture.update(flight.reported(), [flight.sighting(5.0)])
    tilt = math.degrees(mixture.estimate(RADIUS_M).mean[6])
    assert tilt == pytest.approx(found, abs=1.0)


def test_measured_positions_calibrate_the_mount():
    """Views that show no tilt of their own: where they are put beside GNSS tells it. That it is the
    mount shows when it lasts longer than an error of the horizon."""
    bias = np.array([0.0, 0.0, math.radians(5.0), 0.0])
    flight, mixture = Flight(12, bias=bias), Mixture(MODEL, EXTENT)
    weak, height_m, step_s = math.radians(20.0), 100.0, 5.0
    for view in range(25):
        if view:
            mixture.predict(step_s, camera=flight.moved(step_s))
        mixture.measure_position(flight.place + flight.rng.normal(0, 3, 2), 3.0)
        spread = np.diag([4.0, 4.0, 1e-4, 1e-4, weak**2, weak**2])
        spread[0, 0] += (height_m * weak) ** 2
        spread[0, 4] = spread[4, 0] = -height_m * weak**2
        # Taken as level the view lies ahead of where it was taken.
        ahead = np.array([height_m * bias[2], 0, 0, 0, 0, 0])
        mean = np.concatenate([flight.place, np.zeros(4)]) + ahead
        mixture.update(flight.reported(), [Sighting(mean, spread, 5.0)])
    estimate = mixture.estimate(RADIUS_M)
    assert math.degrees(estimate.mean[6]) == pytest.approx(5.0, abs=1.0)
    assert math.degrees(math.sqrt(estimate.covariance[6, 6])) < 1.0


def test_a_hypothesis_of_no_weight_between_two_places_is_not_the_best():
    mixture = Mixture(MODEL, EXTENT)
    mean, covariance = mixture._nowhere()
    covariance[:2, :2] = 4.0 * np.eye(2)
    places = ((0.5, 0.0), (0.5 - 1e-6, 60.0), (1e-6, 30.0))
    mixture.hypotheses = [
        Hypothesis(share, np.array([east, *mean[1:]]), covariance, 0.0, number)
        for number, (share, east) in enumerate(places)
    ]
    assert mixture._best(35.0).share > 0.1


def test_a_measured_position_is_in_a_jump_of_the_biases_too():
    flight, mixture = Flight(12), Mixture(MODEL, EXTENT)
    mixture.start(flight.place, 50.0)
    mixture.predict(1.0, camera=flight.moved())
    mixture.measure_position(flight.place, 1.0)
    kept, jumped = mixture._with_bias_jump(mixture.hypotheses[0])
    assert jumped.share < kept.share
    for each in (kept, jumped):
        assert each.covariance[0, 0] < 1.01
        np.testing.assert_allclose(each.mean[:2], flight.place, atol=0.5)


def test_a_track_coasts_while_views_do_not_show_the_map():
    flight, mixture, _ = flown(3, false_share=0.0)
    assert mixture.estimate(RADIUS_M).state is State.TRACKING
    velocity = ReportedVelocity(np.array(SPEED), np.array(SPEED), 3.0, 15.0)
    rows = []
    for _ in range(30):
        flight.moved()
        mixture.predict(1.0, velocity)
        mixture.update(flight.reported(), [])
        rows.append(mixture.estimate(RADIUS_M))
    assert rows[0].state is State.COASTING and rows[-1].state is State.LOST
    assert rows[0].confidence <= 0.8
    assert np.all(np.diff([each.confidence for each in rows]) <= 0)


@pytest.mark.parametrize(("confirms", "state"), [(False, State.SEARCHING), (True, State.TRACKING)])
def test_only_places_that_competed_with_all_others_confirm_a_track(confirms, state):
    flight, mixture = Flight(5), Mixture(MODEL, EXTENT)
    for view in range(6):
        if view:
            mixture.predict(1.0, camera=flight.moved())
        # A place is born once from a view of the whole map.
        mixture.update(flight.reported(), [flight.sighting(4.0)], confirms=confirms or not view)
    estimate = mixture.estimate(RADIUS_M)
    assert estimate.belief > 0.9 and np.hypot(*(estimate.mean[:2] - flight.place)) < 10
    assert (estimate.state, estimate.shown.followed) == (state, state is State.TRACKING)


@pytest.mark.parametrize(
    ("sightings", "least", "most"), [(0, 0.0, 0.2), (6, 0.7, 1.0)], ids=["start", "track"]
)
def test_only_a_confirmed_track_survives_a_long_loss_of_sight(sightings, least, most):
    """A reported start may be wrong; a confirmed track is under clouds."""
    flight, mixture = Flight(5), Mixture(MODEL, EXTENT)
    mixture.start(flight.place, 10.0)
    for _ in range(sightings):
        mixture.update(flight.reported(), [flight.sighting(4.0)])
        mixture.estimate(RADIUS_M)
        mixture.predict(1.0, camera=flight.moved())
    for _ in range(8):
        mixture.update(flight.reported(), [])
        estimate = mixture.estimate(RADIUS_M)
    assert least < estimate.belief < most


@pytest.mark.parametrize("away_m", [(4000.0, -7000.0), (0.0, 20_000.0)], ids=["near", "far"])
def test_a_track_goes_on_in_the_plane_of_another_map(away_m):
    """Position, course over true north and uncertainty stay as they are."""
    plane = LocalFrame(62.0, 12.0)
    other = LocalFrame(*(float(each) for each in plane.latlon_from_en(away_m)))
    _, mixture, _ = flown(3, views=15)
    before = mixture.estimate(RADIUS_M)
    mixture.move(plane, other, EXTENT)
    after = mixture.estimate(RADIUS_M)
    there = other.en_from_latlon(*plane.latlon_from_en(before.mean[:2]))
    assert after.mean[:2] == pytest.approx(there, abs=0.01)
    seconds = 5.0
    ahead = [
        np.array(frame.latlon_from_en(each.mean[:2] + seconds * each.mean[2:4]))
        for frame, each in ((plane, before), (other, after))
    ]
    assert ahead[1] == pytest.approx(ahead[0], abs=1e-7)
    to_north = before.mean[:2] + np.array([0.0, 10.0])
    north = other.en_from_latlon(*plane.latlon_from_en(to_north)) - there
    turned = after.mean[4] - before.mean[4]
    assert turned == pytest.approx(math.atan2(*north), abs=1e-6)
    assert abs(turned) > 1e-4 or away_m[0] == 0
    for covariance in (before.covariance, after.covariance):
        assert np.linalg.eigvalsh(covariance[:2, :2])[0] > 0
    assert np.trace(after.covariance[:2, :2]) == pytest.approx(np.trace(before.covariance[:2, :2]))
    assert after.confidence == pytest.approx(before.confidence, abs=1e-6)


def test_the_bias_of_a_reported_velocity_is_estimated():
    """Dead reckoning through 30 s without a view: the reported wind is wrong by 1.8 m/s."""
    flight, mixture, before = Flight(7), Mixture(MODEL, EXTENT), None
    reported = SPEED + np.array([1.5, -1.0])
    for second in range(90):
        moved = flight.moved()
        seen = second < 60
        mixture.predict(1.0, ReportedVelocity(reported, before, 1.5), moved if seen else None)
        before = reported
        if seen:
            mixture.update(flight.reported(), [flight.sighting(4.0)])
    estimate = mixture.estimate(RADIUS_M)
    error = estimate.mean[:2] - flight.place
    assert np.hypot(*error) < 20 < 30 * 1.8
    assert error @ np.linalg.solve(estimate.covariance[:2, :2], error) < 14


def contradicted(displacements_m):
    """Estimates of a flight whose camera shows it `displacements_m` (2,) away; None: nothing."""
    flight, mixture, rows = Flight(5), Mixture(MODEL, EXTENT), []
    for away_m in [(0.0, 0.0)] * 11 + list(displacements_m):
        seen = []
        if away_m is not None:
            seen = [flight.sighting(4.0, flight.place + np.array(away_m))]
        mixture.update(flight.reported(), seen)
        found = mixture.estimate(RADIUS_M)
        rows.append((found, found.mean[:2] - flight.place))
        mixture.predict(1.0, ReportedVelocity(SPEED, None, 1.0), flight.moved())
    return rows[11:]


def states(displacements_m):
    return [found.state for found, _ in contradicted(displacements_m)]


EAST, WEST = (300.0, 0.0), (-420.0, 0.0)


@pytest.mark.parametrize(
    "displacements_m",
    [
        [(0.0, 0.0)] * 12,
        [EAST] * 9 + [WEST] * 12,
        [EAST] * 9 + [None] * 14 + [WEST] * 12,
        ([EAST] * 5 + [WEST] * 5) * 3,
        [(25.0 * (-1) ** view, 10.0) for view in range(24)],
        [EAST, (320.0, 20.0)] * 12,
    ],
    ids=["none", "another", "unseen", "turns", "scattered", "scattered contradiction"],
)
def test_an_error_is_small_no_more_probably_than_its_place_is_right(displacements_m):
    for found, _ in contradicted(displacements_m):
        assert found.confidence <= found.place_probability <= 1.0


@pytest.mark.parametrize("seed", range(3))
def test_the_confidence_of_a_flight_is_below_its_place_probability(seed):
    for *_, found, _ in known(seed)[1]:
        assert found.confidence <= found.place_probability


LOST, TRACKING = State.LOST, State.TRACKING


def test_a_place_that_dead_reckoning_contradicts_is_believed_after_more_ground_than_the_track():
    """Eleven views of the track; a camera that consistently shows another place."""
    rows = contradicted([EAST] * 24)
    assert [found.state for found, _ in rows] == [LOST] * 11 + [TRACKING] * 13
    assert all(found.place_probability <= 0.8 for found, _ in rows[:11])
    assert all(math.dist(off_m, EAST) < 15 for _, off_m in rows)


@pytest.mark.parametrize(
    "displacements_m",
    [[EAST, WEST] * 12, ([EAST] * 5 + [WEST] * 5) * 3, [EAST] * 9 + [WEST] * 10],
    ids=["every view", "every five", "after nine"],
)
def test_two_contradicting_places_by_turns_are_not_believed(displacements_m):
    """Neither was shown on enough new ground, although both together were."""
    assert set(states(displacements_m)) == {LOST}


def test_views_that_show_nothing_count_half_against_a_contradicting_place():
    with_nothing = states([EAST] * 9 + [None] * 4 + [EAST] * 12).index(TRACKING)
    assert 0 < with_nothing - states([EAST] * 24).index(TRACKING) - 4 <= 4


def recognized(flight, mixture, views, share, new, seed=0):
    """States of a flight whose views show the map with a probability, `new` ground in each."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(views):
        mixture.predict(1.0, ReportedVelocity(SPEED, SPEED, 1.0), flight.moved(), overlap=1 - new)
        seen = [flight.sighting(4.0)] if rng.random() < share else []
        mixture.update(flight.reported(), seen, max(new, 0.15), None, new)
        found.append(mixture.estimate(RADIUS_M).state)
    return found


@pytest.mark.parametrize(("share", "most"), [(1.0, 30), (0.8, 60), (0.6, 120)])
def test_a_wrong_start_does_not_block_the_right_place_for_long(share, most):
    """Of 0.3 new ground in each view, some of which are not recognized."""
    for seed in range(3):
        flight, mixture = Flight(seed), Mixture(MODEL, EXTENT)
        mixture.start(flight.place + np.array([300.0, 0.0]), 30.0)
        found = recognized(flight, mixture, most, share, 0.3, seed)
        assert TRACKING in found and TRACKING not in found[:20]


@pytest.mark.parametrize("off_mps", [2.0, 5.0])
def test_a_long_track_does_not_block_the_right_place_after_a_gap(off_mps):
    """Without odometry for 30 s a reported velocity was wrong by more than it states."""
    flight, mixture = Flight(3), Mixture(MODEL, EXTENT)
    assert recognized(flight, mixture, 60, 1.0, 0.3)[-1] is TRACKING
    for _ in range(30):
        flight.moved()
        velocity = SPEED + np.array([off_mps, 0.0])
        mixture.predict(1.0, ReportedVelocity(velocity, velocity, 1.0))
        mixture.estimate(RADIUS_M)
    assert TRACKING in recognized(flight, mixture, 16, 1.0, 0.3)


def test_one_view_does_not_confirm_a_place_that_dead_reckoning_reaches_only_by_chance():
    """After the camera showed another place, without odometry."""
    for seed in range(4):
        flight, mixture = Flight(seed), Mixture(MODEL, EXTENT)
        assert recognized(flight, mixture, 40, 1.0, 1.0)[-1] is TRACKING
        for off_m in [600.0] * 20 + [70.0]:
            flight.moved()
            mixture.predict(1.0, ReportedVelocity(SPEED, SPEED, 3.0, 15.0))
            shown = flight.place + np.array([0.0, off_m])
            mixture.update(flight.reported(), [flight.sighting(4.0, shown)])
            found = mixture.estimate(RADIUS_M)
        assert found.state is not TRACKING and found.confidence <= 0.8


@pytest.mark.parametrize("away", [1, 9])
def test_the_track_is_found_at_once_where_the_camera_shows_it_again(away):
    """Its dead-reckoned place stays a hypothesis while another one contradicts it."""
    rows = contradicted([EAST] * away + [(0.0, 0.0)] * 4)[away:]
    assert {found.state for found, _ in rows} == {TRACKING}
    assert all(math.hypot(*off_m) < 10 for _, off_m in rows)


@pytest.mark.parametrize(("off_m", "views"), [(20.0, 4), (600.0, 11)])
def test_a_start_counts_as_eight_views_against_other_places(off_m, views):
    flight, mixture, found = Flight(5), Mixture(MODEL, EXTENT), []
    mixture.start(flight.place + np.array([off_m, 0.0]), 30.0)
    for _ in range(14):
        mixture.update(flight.reported(), [flight.sighting(4.0)])
        found.append(mixture.estimate(RADIUS_M))
        mixture.predict(1.0, ReportedVelocity(SPEED, None, 1.0), flight.moved())
    tracked = [each.state for each in found].index(TRACKING)
    assert tracked <= 3 if off_m < 100 else 6 <= tracked < views
    assert all(each.confidence <= 0.8 for each in found[:tracked])


def test_a_heading_that_only_the_camera_tells_does_not_leave_the_reported_one():
    """A mirrored camera in a turn: what it sees of the turn is opposite to what is reported."""
    flight, mixture, _ = flown(5)
    velocity = ReportedVelocity(SPEED, SPEED, 1.0)
    for _ in range(12):
        moved = replace(flight.moved(), turned_rad=math.radians(-15.0))
        mixture.predict(1.0, velocity, moved)
        mixture.update(flight.reported(), [])
    estimate = mixture.estimate(RADIUS_M)
    assert abs(math.degrees(estimate.mean[4])) < 28 + 2
    assert math.hypot(*(estimate.mean[2:4] - SPEED)) < 12


def test_hypotheses_are_merged_and_ordered_at_views_that_cannot_be_used():
    """Odometry splits each in several: nothing else merges them there."""
    flight, mixture, _ = flown(3)
    for _ in range(9):
        mixture.predict(1.0, camera=flight.moved())
        mixture.estimate(RADIUS_M)
        shares = [each.share for each in mixture.hypotheses]
        assert shares == sorted(shares, reverse=True) and len(shares) <= 40
        assert mixture.likeliest.share == max(shares) and sum(shares) + mixture.elsewhere == (
            pytest.approx(1.0)
        )
    assert len(shares) < 20 and off_m(mixture, flight) < 30
