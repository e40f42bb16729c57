"""Tracks under errors of instruments that change: the horizon, a mount beside it, the velocity."""

import functools
import math

import numpy as np
import pytest

from orthonav.core.geo.camera import axis_on_ground_en_m
from orthonav.core.localize.odometry import CameraDisplacement
from orthonav.core.localize.sighting import Sighting
from orthonav.core.track import (
    Mixture,
    Model,
    ReportedAttitude,
    ReportedVelocity,
)
from orthonav.core.track.filter import OBSERVES, WHITE_SHARE, observed

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
        found = mixture.conclude(RADIUS_M)
        off_m = found.mean[:2] - flight.place
        tilt, spread = (OBSERVES @ found.mean)[4:], observed(found.covariance)[4:, 4:]
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
