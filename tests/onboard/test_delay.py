"""The estimator of the delay of a camera, on generated flights with rendered images."""

import math

import numpy as np
import pytest
from fake_autopilot import S
from flown import SMALL, Flown

from orthonav.core.geo.attitude import enu_from_body_camera
from orthonav.onboard.delay import DelayEstimator
from orthonav.onboard.history import StateHistory
from orthonav.onboard.motion import PictureOdometry

RATE_HZ = 5.0
EVERY_S = 2
STATE_S = 0.1
"""Between two reports of the autopilot."""


class Measured:
    """Estimates every `EVERY_S` of a flight, the truth beside them."""

    def __init__(self, flown, delay_s, *, seconds=40, change=lambda grey, rng: grey, known=True):
        self.history, self.estimator = StateHistory(), DelayEstimator()
        self.whole, self.recent, self.true_s = [], [], []
        odometry, rng = PictureOdometry(), np.random.default_rng(0)
        states = 0
        for number in range(int(seconds * RATE_HZ)):
            arrived_s = number / RATE_HZ
            while states * STATE_S <= arrived_s:
                self._report(flown, states * STATE_S, rng, known)
                states += 1
            exposed_s = arrived_s - delay_s(arrived_s)
            if exposed_s < 0:
                continue
            seen = flown.picture(exposed_s, SMALL)
            grey = change(seen, rng)
            motion = odometry.motion(grey, SMALL, round(arrived_s * S))
            self.estimator.add(motion, self.history)
            if number % int(EVERY_S * RATE_HZ) == 0:
                self.whole.append(self.estimator.estimate())
                self.recent.append(self.estimator.estimate(8.0))
                self.true_s.append(delay_s(arrived_s))

    def _report(self, flown, at_s, rng, known):
        _, (north, east), _ = flown.at(at_s)
        # An attitude off by 5 deg in heading, and a height by 10 %.
        turn = enu_from_body_camera(flown.ned_from_body(at_s, yaw_off_deg=5.0))
        velocity = (east, north, 0.0) if known else None
        self.history.add(round(at_s * S), turn, velocity, 1.1 * flown.agl_m)

    def errors(self, estimates):
        pairs = zip(estimates, self.true_s, strict=True)
        return np.array([each.delay_s - true for each, true in pairs if each.found])


@pytest.mark.long
@pytest.mark.parametrize(
    "delay_s",
    [pytest.param(0.0, marks=pytest.mark.slow), 0.12, pytest.param(8.0, marks=pytest.mark.slow)],
)
def test_a_constant_delay_is_found(delay_s):
    seen = Measured(Flown(45, seed=1), lambda _: delay_s)
    for estimates in (seen.whole, seen.recent):
        errors = seen.errors(estimates)
        assert len(errors) > 7
        assert np.median(np.abs(errors)) < 0.04 and np.abs(errors).max() < 0.15
    stds = [each.std_s for each in seen.whole if each.found]
    assert np.mean(np.square(seen.errors(seen.whole) / stds)) < 3.0
    assert not any(each.contradicted for each in seen.whole)


def test_no_velocity_is_needed():
    seen = Measured(Flown(40, seed=2), lambda _: 0.5, known=False, seconds=30)
    errors = seen.errors(seen.whole)
    assert len(errors) > 5 and np.abs(errors).max() < 0.15


@pytest.mark.long
def test_a_drift_is_followed():
    seen = Measured(Flown(50, seed=3), lambda at: 0.2 + 0.02 * at, seconds=45)
    errors = seen.errors(seen.recent)
    assert len(errors) > 5 and np.abs(errors).max() < 0.25
    assert np.median([each.drift for each in seen.whole if each.found]) == pytest.approx(
        0.02, abs=0.01
    )


@pytest.mark.long
def test_a_step_is_found_within_the_recent_pictures():
    seen = Measured(Flown(70, seed=4), lambda at: 0.1 if at < 40 else 2.1, seconds=56)
    after = [each for each in seen.recent if each.last_ns > 49 * S and each.found]
    assert len(after) >= 2 and all(abs(each.delay_s - 2.1) < 0.15 for each in after)


def test_straight_flight_gives_no_number():
    straight = Flown(45, turns=False, turbulence_deg=0.05, seed=5)
    seen = Measured(straight, lambda _: 0.12, seconds=26)
    assert not any(each.found or each.contradicted for each in seen.whole)


FROZEN = {}


def frozen(grey, rng):
    still = FROZEN.setdefault(grey.shape, grey)
    return np.clip(still + rng.normal(0, 3, still.shape), 0, 255).astype(np.uint8)


def rotated(grey, rng):
    return grey[::-1, ::-1].copy()


def clouded(grey, rng):
    rows = np.arange(grey.shape[0])[:, None] + np.zeros_like(grey, dtype=int)
    return np.where(rows < 0.3 * len(grey), np.uint8(240), grey)


@pytest.mark.parametrize(
    "change",
    [
        lambda grey, rng: grey[:, ::-1].copy(),
        lambda grey, rng: rng.integers(0, 256, grey.shape, dtype=np.uint8),
        lambda grey, rng: np.full_like(grey, 128),
        frozen,
    ],
    ids=["mirrored", "noise", "blank", "frozen"],
)
def test_wrong_images_give_no_delay(change):
    seen = Measured(Flown(40, seed=6), lambda _: 0.12, seconds=16, change=change)
    assert not any(each.found for each in seen.whole + seen.recent)


@pytest.mark.long
def test_a_rotated_camera_contradicts_the_autopilot():
    seen = Measured(Flown(40, seed=6), lambda _: 0.12, seconds=32, change=rotated)
    assert sum(each.contradicted for each in seen.whole) >= 3
    assert not any(each.found for each in seen.whole + seen.recent)


@pytest.mark.long
def test_clouds_over_a_part_do_no_harm():
    seen = Measured(Flown(40, seed=7), lambda _: 0.12, change=clouded, seconds=30)
    errors = seen.errors(seen.whole)
    assert len(errors) > 5 and np.abs(errors).max() < 0.15


@pytest.mark.slow
def test_the_same_values_give_the_same_estimates():
    flown = Flown(20, seed=8)
    first, second = (Measured(flown, lambda _: 0.12, seconds=18) for _ in range(2))
    assert [repr(each) for each in first.whole] == [repr(each) for each in second.whole]
    assert any(math.isfinite(each.delay_s) for each in first.whole)
