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
from orthonav.core.track import Mixture, Model, ReportedAttitude, ReportedVelocity, State
from orthonav.core.track.filter import WHITE_SHARE
from orthonav.core.track.mixture import Hypothesis
from orthonav.core.track.smooth import History

SIDE_M, RADIUS_M = 2000.0, 35.0
EXTENT = (-SIDE_M / 2, -SIDE_M / 2, SIDE_M / 2, SIDE_M / 2)
MODEL = Model(horizon_rad=math.radians(1.5))
SPEED = np.array([12.0, 5.0])
BIAS = np.array([math.radians(5.0), 0.04, math.radians(-2.0), math.radians(1.5)])
LEVEL = ReportedAttitude(0.0, 0.0, 0.0)  # the truth is the biases and noise
LOST, TRACKING = State.LOST, State.TRACKING


class Flight:
    """True positions, what views and odometry say of them, and the track of that."""

    def __init__(self, seed, bias=BIAS, start_off_m=None, start_std_m=30.0):
        """`start_off_m` (2,): error of a reported start; None: none is reported."""
        self.rng = np.random.default_rng(seed)
        self.place = self.rng.uniform(-0.3, 0.3, 2) * SIDE_M
        self.bias, self.mixture = bias, Mixture(MODEL, EXTENT)
        if start_off_m is not None:
            self.mixture.start(self.place + np.array(start_off_m), start_std_m)

    def moved(self, seconds=1.0):
        """What odometry says of so many seconds of flight."""
        moved = SPEED * seconds + self.rng.normal(0, 1.0, 2)
        self.place = self.place + moved
        return replace(self.seen(moved), moved_en_m=self.turned(moved) + self.rng.normal(0, 0.5, 2))

    def turned(self, moved_m):
        """As instruments with the biases say."""
        cos, sin = math.cos(-self.bias[0]), math.sin(-self.bias[0])
        return np.array([[cos, sin], [-sin, cos]]) @ moved_m * math.exp(-self.bias[1])

    def seen(self, moved_m):
        return CameraDisplacement(self.turned(moved_m), np.eye(2) * 0.25, 80.0)

    def fly(self, seconds=1.0):
        """Predict the track by odometry."""
        self.mixture.predict(seconds, camera=self.moved(seconds))

    def sighting(self, log_odds=4.0, at=None):
        """The view's own place, or a false one: tilt and position err together."""
        spread = np.diag([4.0, 4.0, 1e-4, 1e-4, 4e-4, 4e-4])
        spread[0, 4] = spread[4, 0] = 0.7 * math.sqrt(4.0 * 4e-4)
        error = self.rng.multivariate_normal(np.zeros(6), spread)
        error[:2] += self.rng.normal(0, MODEL.sighting_noise_m, 2)
        error[4:] += self.rng.normal(0, WHITE_SHARE * MODEL.horizon_rad, 2)
        mean = np.concatenate([self.place if at is None else at, self.bias]) + error
        return Sighting(mean, spread, log_odds)

    def anywhere(self, log_odds):
        return self.sighting(log_odds, self.rng.uniform(-0.5, 0.5, 2) * SIDE_M)

    def view(self, *sightings, **how):
        """The estimate after a view with these sightings; the first one without odometry."""
        self.mixture.update(LEVEL, sightings, **how)
        return self.mixture.conclude(RADIUS_M)

    def off_m(self):
        return float(np.hypot(*(self.mixture.estimate(RADIUS_M).mean[:2] - self.place)))

    def nees(self, found):
        error = found.mean[:2] - self.place
        return error @ np.linalg.solve(found.covariance[:2, :2], error)


def flown(*arguments, **named):
    """A flight for this test alone, and its estimates with their errors; flown once."""
    return copy.deepcopy(_flown(*arguments, **named))


@functools.cache
def _flown(seed, views=60, false_share=0.3, history=None):
    """A flight with false sightings beside the true ones, some of them instead."""
    flight, rows = Flight(seed), []
    for view in range(views):
        if view:
            flight.fly()
        false = flight.anywhere(-1.0)
        is_false = flight.rng.random() < false_share
        found = flight.view(*([] if is_false else [flight.sighting(2.0)]), false)
        rows.append((found, found.mean[:2] - flight.place, flight.place))
        if history is not None:
            history.record(flight.mixture, view)
    return flight, rows


@functools.cache
def known(seed):
    """Rows and history of a flight that tests share and only read."""
    history = History()
    return _flown(seed, history=history)[1], history


@pytest.mark.parametrize("seed", range(3))
def test_a_flight_is_found_and_followed(seed):
    rows, _ = known(seed)
    errors = np.hypot(*np.array([off_m for _, off_m, _ in rows]).T)
    assert errors[10:].max() < 15 and np.median(errors[10:]) < 4
    assert {found.state for found, _, _ in rows[10:]} == {State.TRACKING, State.COASTING}
    assert np.median([found.confidence for found, _, _ in rows[10:]]) > 0.99
    assert all(found.confidence <= found.place_probability for found, _, _ in rows)


@pytest.mark.slow
def test_normalized_errors_are_those_of_its_covariance():
    """Chi-square of two: mean 2. 95 % bounds of the mean over independent flights."""
    values = []
    for seed in range(60):
        flight, rows = flown(seed, views=20, false_share=0.2)
        values.append(flight.nees(rows[-1][0]))
    assert 1.48 < np.mean(values) < 2.55


def test_one_lucky_view_is_no_track():
    flight = Flight(1)
    first = flight.view(flight.sighting(30.0))
    assert first.state is State.SEARCHING and first.confidence < 0.9999
    flight.fly()
    assert flight.view(flight.sighting(3.0)).state is TRACKING


def test_views_of_the_same_ground_are_not_new():
    """A false place that stays with views that overlap is not believed as if they did not."""
    believed = []
    for newness in (0.1, 1.0):
        flight = Flight(2)
        for _ in range(5):
            flight.mixture.update(LEVEL, [flight.sighting(-1.5)], newness)
        believed.append(flight.mixture.conclude(RADIUS_M).confidence)
    assert believed[0] < 0.9 < believed[1]


def test_overlapping_views_repeat_their_error_and_a_track_is_no_less_certain_than_one_view():
    """Views that all show the same ground, with one error."""
    values = []
    for seed in range(40):
        flight = Flight(seed)
        first = flight.sighting(4.0)
        off = first.mean - np.concatenate([flight.place, BIAS])
        for view in range(8):
            if view:
                velocity = ReportedVelocity(SPEED, SPEED if view > 1 else None, 5.0)
                flight.moved()
                flight.mixture.predict(1.0, velocity, overlap=1.0)
            here = np.concatenate([flight.place, BIAS]) + off
            sighting = Sighting(here, first.covariance, 4.0)
            found = flight.view(sighting, newness=1.0 if view == 0 else 0.15)
        values.append(flight.nees(found))
        own_m2 = first.covariance[0, 0] + MODEL.sighting_noise_m**2
        assert 0.7 * own_m2 < found.covariance[0, 0] < 1.05 * own_m2
    assert 1.2 < np.mean(values) < 3


def test_a_view_that_shows_hardly_anything_of_its_camera_is_used_all_the_same():
    """Position and tilt err as one, by 10 km: rounding leaves that covariance indefinite."""
    flight, lever = Flight(3), 7e3 * np.eye(2)
    spread = np.diag([0.0, 0.0, 1e-8, 1e-8, 0.0, 0.0])
    spread[:2, :2] = 2.04 * lever @ lever
    spread[:2, 4:] = spread[4:, :2] = 2.04 * lever
    spread[4:, 4:] = 2.04 * np.eye(2) * (1 - 4.05e-8)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(spread + np.diag(np.square([2.0, 2.0, 5e-3, 4e-3, 0.0, 0.0])))
    found = flight.view(replace(flight.sighting(), covariance=spread))
    assert np.isfinite(found.covariance).all()


def test_without_sightings_it_becomes_lost_and_its_covariance_grows():
    flight, rows = flown(3)
    found = [rows[-1][0]]
    for _ in range(30):
        flight.mixture.predict(10.0)
        found.append(flight.view())
    spread = [np.trace(each.covariance[:2, :2]) for each in found]
    assert (np.diff(spread[:5]) > 0).all() and spread[-1] > 50 * spread[0]
    assert found[-1].state is LOST and found[-1].confidence < 0.3
    assert np.isfinite(found[-1].mean).all() and np.abs(found[-1].mean[:2]).max() < SIDE_M


def test_a_kidnapped_aircraft_is_found_again():
    """A short track, so that a few more views are believed against it."""
    flight, _ = flown(4, views=10)
    flight.place = -flight.place
    for _ in range(18):
        flight.fly()
        found = flight.view(flight.sighting(3.0))
        assert flight.off_m() <= RADIUS_M or found.confidence <= 0.9
    assert found.state is TRACKING and flight.off_m() < 10


def test_false_places_that_come_and_go_are_not_followed():
    """Views of nowhere on the map, each with a place that it is somewhat like."""
    confident = 0
    for seed in range(2):
        flight = Flight(seed)
        for _ in range(14):
            flight.fly()
            seen = [flight.anywhere(flight.rng.normal(-3, 1)) for _ in range(3)]
            confident += flight.view(*seen).confidence > 0.9
    assert confident <= 1


def test_a_bias_jump_is_followed():
    flight, _ = flown(5)
    flight.bias = flight.bias + np.array([0.0, 0.0, math.radians(9.0), 0.0])
    for _ in range(15):
        flight.fly()
        found = flight.view(flight.sighting(3.0))
    assert flight.off_m() < 12 and found.mean[6] > BIAS[2] + 0.05


def test_biases_that_changed_to_the_other_side_are_followed_at_once():
    """After a jump they are no more likely near where they were."""
    flight = Flight(5, np.array([math.radians(8.0), 0.05, math.radians(12.0), 0.0]))
    for view in range(13):
        if view == 12:
            flight.bias = -flight.bias
        flight.fly()
        found = flight.view(flight.sighting(3.0))
    assert found.belief > 0.99 and flight.off_m() < 10
    assert np.degrees(found.mean[[4, 6]]) == pytest.approx([-8.0, -12.0], abs=2.0)


@pytest.mark.parametrize("off_m", [(10.0, 0.0), (700.0, -600.0)], ids=["right", "wrong"])
def test_a_reported_start_holds_until_views_contradict_it(off_m):
    flight = Flight(6, start_off_m=off_m, start_std_m=20.0)
    for _ in range(12):
        flight.fly()
        flight.view(flight.sighting(2.0))
    assert flight.off_m() < 10


def test_smoothing_does_not_believe_what_no_view_was_believed_for():
    flight, history = Flight(5), History()
    for number, away_m in enumerate([(0.0, 0.0)] * 11 + [EAST] * 8):
        flight.view(flight.sighting(4.0, flight.place + np.array(away_m)))
        history.record(flight.mixture, number)
        flight.mixture.predict(1.0, ReportedVelocity(SPEED, None, 1.0), flight.moved())
    beliefs = [each.belief for each in history.smoothed()]
    assert min(beliefs[:11]) > 0.99 and max(beliefs[11:]) <= 0.8


def test_smoothing_reduces_error_and_covariance():
    before, after, ratios = [], [], []
    for seed in range(3):
        rows, history = known(seed)
        smoothed = history.smoothed()
        assert len(smoothed) == len(rows) and None not in smoothed
        # In the first views it may not be found yet.
        for (filtered, off_m, place), found in list(zip(rows, smoothed, strict=True))[5:]:
            before.append(float(np.hypot(*off_m)))
            after.append(float(np.hypot(*(found.mean[:2] - place))))
            spread = np.trace(found.covariance[:2, :2])
            ratios.append(spread / np.trace(filtered.covariance[:2, :2]))
    assert np.mean(after) < 0.85 * np.mean(before) and max(after) <= max(before)
    assert np.median(ratios) < 0.95


def test_far_hypotheses_and_gaps_stay_finite():
    flight, _ = flown(8, views=10)
    for seconds in (0.0, 1e-3, 600.0, 1e5):
        flight.mixture.predict(seconds)
        found = flight.view(flight.sighting(1.0))
        assert np.isfinite(found.mean).all() and np.isfinite(found.covariance).all()
        assert np.linalg.eigvalsh(found.covariance).min() > 0
        shares = [each.share for each in flight.mixture.hypotheses]
        assert sum(shares) + flight.mixture.elsewhere == pytest.approx(1)


def test_odometry_outliers_are_rejected():
    """A cloud that moves over the ground: the reported velocity contradicts odometry."""
    flight, _ = flown(5)
    wrong = CameraDisplacement(3 * SPEED, np.eye(2) * 0.25, 80.0)
    for second in range(12):
        flight.moved()
        velocity = ReportedVelocity(SPEED, SPEED if second else None, 1.0)
        flight.mixture.predict(1.0, velocity, wrong)
        found = flight.view()
    assert flight.off_m() < 25 or found.confidence < 0.5


def test_a_sudden_turn_is_followed_without_reported_velocity():
    flight, _ = flown(6)
    moved = np.array([-14.0, 9.0])
    for _ in range(4):
        flight.place = flight.place + moved
        flight.mixture.predict(1.0, camera=flight.seen(moved))
        flight.view()
    assert flight.off_m() < 10


@pytest.mark.parametrize("tilt_deg", [0.0, 7.0])
def test_a_mount_is_good_unless_views_say_otherwise(tilt_deg):
    flight = Flight(9, np.array([0.0, 0.0, math.radians(tilt_deg), 0.0]))
    for view in range(15):
        if view:
            flight.fly()
        found = flight.view(flight.sighting(5.0))
    assert math.degrees(found.mean[6]) == pytest.approx(tilt_deg, abs=1.0)


def test_measured_positions_calibrate_the_mount():
    """Views that show no tilt of their own: where they are put beside GNSS tells it. That it is the
    mount shows when it lasts longer than an error of the horizon."""
    flight = Flight(12, np.array([0.0, 0.0, math.radians(5.0), 0.0]))
    weak, height_m = math.radians(20.0), 100.0
    spread = np.diag([4.0, 4.0, 1e-4, 1e-4, weak**2, weak**2])
    spread[0, 0] += (height_m * weak) ** 2
    spread[0, 4] = spread[4, 0] = -height_m * weak**2
    # Taken as level the view lies ahead of where it was taken.
    ahead = np.array([height_m * flight.bias[2], 0, 0, 0, 0, 0])
    for view in range(25):
        if view:
            flight.fly(5.0)
        flight.mixture.measure_position(flight.place + flight.rng.normal(0, 3, 2), 3.0)
        mean = np.concatenate([flight.place, np.zeros(4)]) + ahead
        found = flight.view(Sighting(mean, spread, 5.0))
    assert math.degrees(found.mean[6]) == pytest.approx(5.0, abs=1.0)
    assert math.degrees(math.sqrt(found.covariance[6, 6])) < 1.0


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
    flight = Flight(12, start_off_m=(0.0, 0.0), start_std_m=50.0)
    flight.fly()
    flight.mixture.measure_position(flight.place, 1.0)
    kept, jumped = flight.mixture._with_bias_jump(flight.mixture.hypotheses[0])
    assert jumped.share < kept.share
    for each in (kept, jumped):
        assert each.covariance[0, 0] < 1.01
        np.testing.assert_allclose(each.mean[:2], flight.place, atol=0.5)


def test_a_track_coasts_while_views_do_not_show_the_map():
    flight, before = flown(3, false_share=0.0)
    assert before[-1][0].state is TRACKING
    velocity, rows = ReportedVelocity(SPEED, SPEED, 3.0, 15.0), []
    for _ in range(30):
        flight.moved()
        flight.mixture.predict(1.0, velocity)
        rows.append(flight.view())
    assert rows[0].state is State.COASTING and rows[-1].state is LOST
    assert rows[0].confidence <= 0.8
    assert np.all(np.diff([each.confidence for each in rows]) <= 0)


def test_an_estimate_changes_nothing():
    flight, rows = flown(3, views=15)
    flight.mixture.predict(1.0, camera=flight.moved())
    before, trust = list(flight.mixture.hypotheses), vars(flight.mixture.trust).copy()
    found = flight.mixture.estimate(RADIUS_M)
    assert found.state is rows[-1][0].state and not found.shown.is_now
    assert flight.mixture.hypotheses == before and vars(flight.mixture.trust) == trust
    assert flight.view().state is State.COASTING


def test_a_view_whose_outcome_failed_does_not_show_the_map():
    """An error after its places were found."""
    flight, _ = flown(3, views=15)
    flight.fly()
    flight.mixture.update(LEVEL, [flight.sighting(4.0)])
    assert flight.mixture.estimate(RADIUS_M).shown.is_now
    flight.mixture.unrecognize()
    found = flight.mixture.conclude(RADIUS_M)
    assert found.state is State.COASTING and not found.shown.is_now


@pytest.mark.parametrize(("confirms", "state"), [(False, State.SEARCHING), (True, TRACKING)])
def test_only_places_that_competed_with_all_others_confirm_a_track(confirms, state):
    flight = Flight(5)
    for view in range(6):
        if view:
            flight.fly()
        # A place is born once from a view of the whole map.
        found = flight.view(flight.sighting(4.0), confirms=confirms or not view)
    assert found.belief > 0.9 and flight.off_m() < 10
    assert (found.state, found.shown.followed) == (state, state is TRACKING)


@pytest.mark.parametrize(
    ("sightings", "least", "most"), [(0, 0.0, 0.2), (6, 0.7, 1.0)], ids=["start", "track"]
)
def test_only_a_confirmed_track_survives_a_long_loss_of_sight(sightings, least, most):
    """A reported start may be wrong; a confirmed track is under clouds."""
    flight = Flight(5, start_off_m=(0.0, 0.0), start_std_m=10.0)
    for _ in range(sightings):
        flight.view(flight.sighting(4.0))
        flight.fly()
    for _ in range(8):
        found = flight.view()
    assert least < found.belief < most


@pytest.mark.parametrize("away_m", [(4000.0, -7000.0), (0.0, 20_000.0)], ids=["near", "far"])
def test_a_track_goes_on_in_the_plane_of_another_map(away_m):
    """Position, course over true north and uncertainty stay as they are."""
    plane = LocalFrame(62.0, 12.0)
    other = LocalFrame(*(float(each) for each in plane.latlon_from_en(away_m)))
    mixture = flown(3, views=15)[0].mixture
    before = mixture.estimate(RADIUS_M)
    mixture.move(plane, other, EXTENT)
    after = mixture.estimate(RADIUS_M)
    there = other.en_from_latlon(*plane.latlon_from_en(before.mean[:2]))
    assert after.mean[:2] == pytest.approx(there, abs=0.01)
    ahead = [
        np.array(frame.latlon_from_en(each.mean[:2] + 5.0 * each.mean[2:4]))
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
    flight, before = Flight(7), None
    reported = SPEED + np.array([1.5, -1.0])
    for second in range(90):
        moved, seen = flight.moved(), second < 60
        velocity = ReportedVelocity(reported, before, 1.5)
        flight.mixture.predict(1.0, velocity, moved if seen else None)
        before = reported
        if seen:
            flight.view(flight.sighting(4.0))
    assert flight.off_m() < 20 < 30 * 1.8
    assert flight.nees(flight.mixture.estimate(RADIUS_M)) < 14


def contradicted(displacements_m):
    """Estimates of a flight whose camera shows it `displacements_m` (2,) away; None: nothing."""
    flight, rows = Flight(5), []
    for away_m in [(0.0, 0.0)] * 11 + list(displacements_m):
        at = None if away_m is None else flight.place + np.array(away_m)
        found = flight.view(*([] if at is None else [flight.sighting(4.0, at)]))
        rows.append((found, found.mean[:2] - flight.place))
        flight.mixture.predict(1.0, ReportedVelocity(SPEED, None, 1.0), flight.moved())
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


def recognized(flight, views, share, new, seed=0):
    """States of a flight whose views show the map with a probability, `new` ground in each."""
    rng, found, velocity = np.random.default_rng(seed), [], ReportedVelocity(SPEED, SPEED, 1.0)
    for _ in range(views):
        flight.mixture.predict(1.0, velocity, flight.moved(), overlap=1 - new)
        seen = [flight.sighting(4.0)] if rng.random() < share else []
        found.append(flight.view(*seen, newness=max(new, 0.15), new_ground=new).state)
    return found


@pytest.mark.parametrize(("share", "most"), [(1.0, 30), (0.8, 60), (0.6, 120)])
def test_a_wrong_start_does_not_block_the_right_place_for_long(share, most):
    """Of 0.3 new ground in each view, some of which are not recognized."""
    for seed in range(3):
        flight = Flight(seed, start_off_m=EAST)
        found = recognized(flight, most, share, 0.3, seed)
        assert TRACKING in found and TRACKING not in found[:20]


@pytest.mark.parametrize("off_mps", [2.0, 5.0])
def test_a_long_track_does_not_block_the_right_place_after_a_gap(off_mps):
    """Without odometry for 30 s a reported velocity was wrong by more than it states."""
    flight, velocity = Flight(3), SPEED + np.array([off_mps, 0.0])
    assert recognized(flight, 60, 1.0, 0.3)[-1] is TRACKING
    for _ in range(30):
        flight.moved()
        flight.mixture.predict(1.0, ReportedVelocity(velocity, velocity, 1.0))
        flight.mixture.conclude(RADIUS_M)
    assert TRACKING in recognized(flight, 16, 1.0, 0.3)


def test_one_view_does_not_confirm_a_place_that_dead_reckoning_reaches_only_by_chance():
    """After the camera showed another place, without odometry."""
    for seed in range(4):
        flight = Flight(seed)
        assert recognized(flight, 40, 1.0, 1.0)[-1] is TRACKING
        for off_m in [600.0] * 20 + [70.0]:
            flight.moved()
            flight.mixture.predict(1.0, ReportedVelocity(SPEED, SPEED, 3.0, 15.0))
            found = flight.view(flight.sighting(4.0, flight.place + np.array([0.0, off_m])))
        assert found.state is not TRACKING and found.confidence <= 0.8


@pytest.mark.parametrize("away", [1, 9])
def test_the_track_is_found_at_once_where_the_camera_shows_it_again(away):
    """Its dead-reckoned place stays a hypothesis while another one contradicts it."""
    rows = contradicted([EAST] * away + [(0.0, 0.0)] * 4)[away:]
    assert {found.state for found, _ in rows} == {TRACKING}
    assert all(math.hypot(*off_m) < 10 for _, off_m in rows)


@pytest.mark.parametrize(("off_m", "views"), [(20.0, 4), (600.0, 11)])
def test_a_start_counts_as_eight_views_against_other_places(off_m, views):
    flight, found = Flight(5, start_off_m=(off_m, 0.0)), []
    for _ in range(14):
        found.append(flight.view(flight.sighting(4.0)))
        flight.mixture.predict(1.0, ReportedVelocity(SPEED, None, 1.0), flight.moved())
    tracked = [each.state for each in found].index(TRACKING)
    assert tracked <= 3 if off_m < 100 else 6 <= tracked < views
    assert all(each.confidence <= 0.8 for each in found[:tracked])


def test_a_heading_that_only_the_camera_tells_does_not_leave_the_reported_one():
    """A mirrored camera in a turn: what it sees of the turn is opposite to what is reported."""
    flight, _ = flown(5)
    velocity = ReportedVelocity(SPEED, SPEED, 1.0)
    for _ in range(12):
        moved = replace(flight.moved(), turned_rad=math.radians(-15.0))
        flight.mixture.predict(1.0, velocity, moved)
        estimate = flight.view()
    assert abs(math.degrees(estimate.mean[4])) < 28 + 2
    assert math.hypot(*(estimate.mean[2:4] - SPEED)) < 12


def test_hypotheses_are_merged_and_ordered_at_views_that_cannot_be_used():
    """Odometry splits each in several: nothing else merges them there."""
    flight, _ = flown(3)
    for _ in range(9):
        flight.fly()
        flight.mixture.conclude(RADIUS_M)
        shares = [each.share for each in flight.mixture.hypotheses]
        assert shares == sorted(shares, reverse=True) and len(shares) <= 40
        assert sum(shares) + flight.mixture.elsewhere == pytest.approx(1.0)
    assert len(shares) < 20 and flight.off_m() < 30
