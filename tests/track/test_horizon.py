"""Tracks under errors of instruments that change: the horizon, a mount beside it, the velocity."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest

from orthonav.core.geo.camera import axis_on_ground_en_m
from orthonav.core.track import (
    CameraDisplacement,
    Mixture,
    Model,
    ReportedAttitude,
    ReportedVelocity,
    Sighting,
    State,
)
from orthonav.core.track.model import HORIZON, SEEN, STATE, TILT, WHITE_SHARE
from orthonav.core.track.motion import by_camera, predicted

SIDE_M, RADIUS_M, AGL_M, STEP_S, VIEWS = 2000.0, 35.0, 300.0, 1.0, 60
EXTENT = (-SIDE_M / 2, -SIDE_M / 2, SIDE_M / 2, SIDE_M / 2)
MODEL = Model().at_height(AGL_M)
SPEED = np.array([12.0, 5.0])
MOUNT_RAD, HORIZON_RAD, SHOWN_RAD = (math.radians(each) for each in (2.0, 1.5, 0.5))
PLACE_M = 1.5
SEEDS = range(20)


def seems_displaced_m(heading_deg):
    """Metres east and north (2, 2) by which a camera seems displaced per rad of pitch and roll that
    is not reported: by where its optical axis meets the ground."""
    step_deg = 0.01
    middles = [
        np.array(axis_on_ground_en_m(heading_deg, *tilt, AGL_M))
        for tilt in ((0.0, 0.0), (step_deg, 0.0), (0.0, step_deg))
    ]
    return np.stack([each - middles[0] for each in middles[1:]], axis=1) / math.radians(step_deg)


LEVER_M = seems_displaced_m(0.0)


class Changing:
    """A Gauss-Markov process (2,) of a standard deviation and correlation time."""

    def __init__(self, rng, std, correlation_s):
        self.rng, self.std, self.left = rng, std, math.exp(-STEP_S / correlation_s)
        self.now = rng.normal(0, std, 2)

    def step(self):
        """The next value, and the one before."""
        before = self.now
        noise = self.std * math.sqrt(1 - self.left**2)
        self.now = self.left * before + self.rng.normal(0, noise, 2)
        return self.now, before


class Flight:
    """Positions of an aircraft heading north, and what views, odometry and instruments say."""

    def __init__(self, seed, velocity_error=(0.0, 1.0), tilts=True):
        self.rng = np.random.default_rng(seed)
        self.place = self.rng.uniform(-300, 300, 2) - SPEED * VIEWS * STEP_S / 2
        direction = self.rng.uniform(0, 2 * math.pi)
        self.mount = tilts * MOUNT_RAD * np.array([math.cos(direction), math.sin(direction)])
        self.horizon = Changing(self.rng, tilts * HORIZON_RAD, MODEL.horizon_s)
        self.velocity = Changing(self.rng, *velocity_error)
        self.tilt = self.before = self.mount + self.horizon.now
        self.reported = None

    def fly(self):
        """A step: the displacement by the camera and the reported velocity."""
        moved = SPEED * STEP_S + self.rng.normal(0, 0.5, 2)
        self.place = self.place + moved
        self.before, self.tilt = self.tilt, self.mount + self.horizon.step()[0]
        # Independent of view to view, as in `Model`, and by the odometry itself.
        white = WHITE_SHARE * HORIZON_RAD * AGL_M
        seen = moved + LEVER_M @ (self.tilt - self.before) + self.rng.normal(0, 0.5, 2)
        camera = CameraDisplacement(
            seen, np.eye(2) * (0.5**2 + white**2), 80.0, levers_m=np.stack([LEVER_M, LEVER_M])
        )
        error = self.velocity.step()[0]
        reported, before = moved / STEP_S + error, self.reported
        self.reported = reported
        std = max(self.velocity.std, 1.0)
        return camera, ReportedVelocity(reported, before, std, self.correlation_s)

    @property
    def correlation_s(self):
        return -STEP_S / math.log(self.velocity.left)

    def sighting(self):
        """The place by a view alone: an error of its tilt displaces it the other way."""
        spread = np.diag([PLACE_M**2] * 2 + [1e-5, 1e-5] + [SHOWN_RAD**2] * 2)
        spread[:2, :2] += SHOWN_RAD**2 * LEVER_M @ LEVER_M.T
        spread[:2, 4:] = -(SHOWN_RAD**2) * LEVER_M
        spread[4:, :2] = spread[:2, 4:].T
        error = self.rng.multivariate_normal(np.zeros(6), spread)
        error[:2] += self.rng.normal(0, MODEL.sighting_noise_m, 2)
        error[4:] += self.rng.normal(0, WHITE_SHARE * HORIZON_RAD, 2)
        return Sighting(np.concatenate([self.place, [0.0, 0.0], self.tilt]) + error, spread, 4.0)


LEVEL = ReportedAttitude(0.0, 0.0, 0.0)


@functools.cache
def flown(seed, *, odometry=True, velocity=False, error=(0.0, 1.0)):
    """Rows (N, 4) of a flight once it is followed: errors of track and view (m), and NEES of
    position and whole tilt."""
    flight, mixture, rows = Flight(seed, error), Mixture(MODEL, EXTENT), []
    for view in range(VIEWS):
        if view:
            camera, reported = flight.fly()
            mixture.predict(STEP_S, reported if velocity else None, camera if odometry else None)
        sighting = flight.sighting()
        mixture.update(LEVEL, [sighting])
        found = mixture.estimate(RADIUS_M)
        off_m = found.mean[:2] - flight.place
        tilt, spread = (SEEN @ found.mean)[4:], (SEEN @ found.covariance @ SEEN.T)[4:, 4:]
        rows.append(
            (
                np.hypot(*off_m),
                np.hypot(*(sighting.mean[:2] - flight.place)),
                off_m @ np.linalg.solve(found.covariance[:2, :2], off_m),
                (tilt - flight.tilt) @ np.linalg.solve(spread, tilt - flight.tilt),
            )
        )
    return np.array(rows[5:])


@pytest.mark.parametrize(
    ("odometry", "velocity"), [(True, False), (False, True), (True, True)], ids=str
)
def test_a_track_is_consistent_under_errors_of_mount_and_horizon(odometry, velocity):
    """Normalized errors of two components have mean 2, less where views err together."""
    error = (1.0, MODEL.reported_velocity_s)
    rows = [flown(s, odometry=odometry, velocity=velocity, error=error) for s in SEEDS]
    track_m, view_m, of_place, of_tilt = np.concatenate(rows).T
    assert 0.5 < of_place.mean() < 3 and 0.5 < of_tilt.mean() < 3
    assert track_m.mean() < 0.85 * view_m.mean() and np.median(track_m) < 0.85 * np.median(view_m)
    # Nor in any single flight.
    assert all(each[:, 0].mean() < 1.15 * each[:, 1].mean() for each in rows)


def test_a_velocity_that_is_wrong_by_metres_does_not_displace_a_track():
    """4 m/s of error, another one after 10 s, as of an autopilot that nothing aids."""
    rows = [flown(s, velocity=True, error=(4.0, 10.0)) for s in SEEDS]
    track_m, view_m, of_place, _ = np.concatenate(rows).T
    assert 0.5 < of_place.mean() < 3
    assert (of_place < 13.8).mean() > 0.995  # 99.9 % of a chi-square of two
    assert track_m.mean() < 0.85 * view_m.mean()


@pytest.mark.parametrize("corrected_deg", [(0.0, 0.0), (1.0, 0.5)], ids=["not", "partly"])
@pytest.mark.parametrize("horizon_deg", [(2.0, -1.0), (-1.5, 0.5)])
def test_a_displacement_by_a_changing_horizon_is_explained_by_it(horizon_deg, corrected_deg):
    """An aircraft of known velocity: what the camera saw beyond it was its horizon's. So with views
    that were already corrected by a part of it."""
    seconds, horizon, corrected = 10.0, np.radians(horizon_deg), np.radians(corrected_deg)
    known = np.zeros((STATE, STATE))
    known[range(STATE), range(STATE)] = np.square([1.0] * 2 + [0.1] * 2 + [1e-3] * 6)
    mean = np.concatenate([[50.0, -20.0], SPEED, np.zeros(6)])
    velocity = ReportedVelocity(SPEED, SPEED, 0.1)
    noise = np.square([1e-3, 1e-3, HORIZON_RAD])
    displaced_m = LEVER_M @ (horizon - corrected)
    camera = CameraDisplacement(
        SPEED * seconds + displaced_m,
        np.eye(2) * 0.25,
        200.0,
        levers_m=np.stack([LEVER_M, LEVER_M]),
        corrected_rad=np.stack([corrected, np.zeros(2)]),
    )
    expected = predicted(MODEL, mean, known, seconds, velocity, noise, camera)
    after, _ = by_camera(expected, camera)
    assert np.degrees(after.mean[HORIZON]) == pytest.approx(horizon_deg, abs=0.35)
    assert np.abs(np.degrees(after.mean[TILT])).max() < 0.1
    assert after.mean[:2] == pytest.approx(mean[:2] + SPEED * seconds, abs=1.5)
    assert np.degrees(math.sqrt(after.covariance[HORIZON, HORIZON][0, 0])) < 0.3
    # Without levers it would have been taken as motion: it contradicts the velocity.
    blind = CameraDisplacement(camera.moved_en_m, camera.covariance, camera.reach_m)
    assert np.abs(by_camera(expected, blind)[0].mean[HORIZON]).max() == 0


@pytest.mark.parametrize("shown_deg", [0.01, 0.1, 0.5, 2.0])
@pytest.mark.parametrize("horizon_deg", [1.5, 3.0])
def test_views_that_overlap_confirm_a_track_however_well_they_show_their_tilt(
    shown_deg, horizon_deg
):
    """A place as expected is likelier than none, with a tilt that is known well or hardly."""
    shown = math.radians(shown_deg)
    model = replace(MODEL, horizon_rad=math.radians(horizon_deg))
    mixture = Mixture(model, EXTENT)
    spread = np.diag([1.0, 1.0, 1e-6, 1e-6, shown**2, shown**2])
    spread[:2, :2] += shown**2 * LEVER_M @ LEVER_M.T
    spread[:2, 4:] = -(shown**2) * LEVER_M
    spread[4:, :2] = spread[:2, 4:].T
    place = np.zeros(6)
    for view in range(15):
        if view:
            place = place + np.array([*SPEED, 0.0, 0.0, 0.0, 0.0])
            camera = CameraDisplacement(
                SPEED, np.eye(2), 80.0, levers_m=np.stack([LEVER_M, LEVER_M])
            )
            mixture.predict(1.0, camera=camera)
        mixture.update(LEVEL, [Sighting(place, spread, 25.0)], 0.15, new_ground=0.1)
        found = mixture.estimate(RADIUS_M)
    assert found.state is State.TRACKING and found.confidence > 0.99
    last = [each.share for each in mixture.hypotheses if each.recognized > 0.5]
    assert sum(last) > 0.9
