"""Learning displacement, mount and latency from GNSS minus map: only what a flight shows."""

import math
from dataclasses import replace

import numpy as np
import pytest
from benchmarks.gnss_watch import PITCH_DEG, recovered

from orthonav.core.geo.camera import axis_on_ground_en_m
from orthonav.onboard.gnss.biases import (
    LIMITS,
    QUARANTINE_S,
    SETTLED_S,
    Biases,
    BiasLearner,
    Difference,
    at_start,
    biases_from_plain,
    design,
    unknown,
)

TRUE = np.array([20.0, -10.0, math.radians(1.0), math.radians(-0.5), 0.2])
NORTH, EAST, SOUTH, WEST = np.radians([0.0, 90.0, 180.0, 270.0])


def difference(second, heading=0.0, speed=20.0, agl_m=300.0, true=TRUE, off_m=(0.0, 0.0)):
    """A difference without noise but for `off_m`."""
    velocity = speed * np.array([math.sin(heading), math.cos(heading)])
    en_m = design(heading, agl_m, velocity) @ true + off_m
    return Difference(float(second), en_m, 2.0, 3.0, heading, velocity, agl_m)


def learnt(values, start=None):
    """The biases learnt from values, all of them past quarantine."""
    learner = BiasLearner(start or unknown())
    values = list(values)
    for each in values:
        learner.add(each)
    return learner.until(math.inf)


def legs(headings, speeds, seconds=60, **more):
    """Differences along legs."""
    pairs = [(heading, speed) for heading in headings for speed in speeds]
    for number, (heading, speed) in enumerate(pairs * 6):
        for second in range(seconds):
            yield difference(number * seconds + second, heading, speed, **more)


def test_late_images_put_the_map_behind():
    made = design(np.array([NORTH, EAST]), np.full(2, 100.0), np.array([[0.0, 20.0], [30.0, 0.0]]))
    assert made.shape == (2, 2, 5)
    late = np.array([0.0, 0.0, 0.0, 0.0, 0.1])
    assert made @ late == pytest.approx(np.array([[0, 2.0], [3.0, 0]]), abs=1e-9)


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(1.0, 0.0), (0.0, 1.0)])
@pytest.mark.parametrize("yaw_deg", [0.0, 130.0])
def test_the_sign_of_the_tilt_is_that_of_telemetry(yaw_deg, pitch_deg, roll_deg):
    tilt = np.array([0.0, 0.0, math.radians(pitch_deg), math.radians(roll_deg), 0.0])
    moved = design(math.radians(yaw_deg), 100.0, np.zeros(2)) @ tilt
    seen = axis_on_ground_en_m(yaw_deg, pitch_deg, roll_deg, 100.0)
    assert moved == pytest.approx(np.negative(seen), abs=0.01)


def test_legs_of_different_heading_and_speed_separate_all_biases():
    found = learnt(legs((NORTH, SOUTH), (12.0, 30.0)))
    assert (found.stds < [3, 3, 0.01, 0.01, 0.13]).all()
    assert found.mean == pytest.approx(TRUE, abs=0.5 * found.stds.max())
    assert (np.abs(found.mean - TRUE) < 1.5 * found.stds).all()


def test_one_heading_and_speed_show_only_the_sum():
    found = learnt(legs((NORTH,), (20.0,)))
    same, other = (difference(0, heading).design for heading in (NORTH, SOUTH))
    mean, cov = same @ found.mean, same @ found.cov @ same.T
    assert mean == pytest.approx(same @ TRUE, abs=1.0)
    assert np.sqrt(np.linalg.eigvalsh(cov)[-1]) < 3.5
    cov = other @ found.cov @ other.T  # nobody knows what it would be on another heading
    assert np.sqrt(np.linalg.eigvalsh(cov)[-1]) > 10
    assert (found.stds[2:] > 0.85 * unknown().stds[2:]).all()


def test_constant_airspeed_does_not_separate_mount_and_latency():
    """Nor do headings: the velocity turns as the aircraft does, and the wind is constant."""
    found = learnt(legs((NORTH, EAST, SOUTH, WEST), (20.0,)))
    assert found.stds[4] > 0.15 and found.stds[2] > 0.008
    ahead = np.array([0, 0, -300.0, 0, 20.0])  # their sum along the heading
    assert math.sqrt(ahead @ found.cov @ ahead) < 4
    assert found.stds[3] < 0.015  # across it there is nothing but the mount


@pytest.mark.long
def test_stated_deviations_are_those_of_the_errors():
    """Correlated errors, four flights: errors squared over their covariance are about 1."""
    nees, stds_rad = [], []
    for seed in range(4):
        ((off, found),) = recovered(seed, (12.0, 30.0), (12,))
        nees.append(off @ np.linalg.solve(found.cov, off) / 5)
        stds_rad.append(found.stds[2])
    assert 0.2 < np.mean(nees) < 2
    assert math.degrees(np.median(stds_rad)) < 0.4 * PITCH_DEG


def test_values_wait_in_quarantine_and_an_alarm_discards_them():
    learner = BiasLearner(unknown())
    for second in range(int(QUARANTINE_S)):
        learner.add(difference(second, true=2 * TRUE))
    assert learner.learnt.agreed_s == 0 and not learner.learnt.mean.any()
    assert learner.until(math.inf).en_m @ TRUE[:2] > 500  # a comparison uses them
    learner.waiting.clear()
    for second in range(200, 450):
        learner.add(difference(second, true=np.zeros(5)))
    assert 0 < learner.learnt.agreed_s < 100
    assert np.abs(learner.learnt.mean).max() < 1e-6


def test_outliers_are_left_out():
    values = list(legs((NORTH, SOUTH), (12.0, 30.0)))
    wrong = [replace(v, en_m=v.en_m + 150.0) if i % 20 == 10 else v for i, v in enumerate(values)]
    assert learnt(wrong).mean == pytest.approx(learnt(values).mean, abs=0.1)


def test_biases_are_bounded():
    found = learnt(legs((NORTH, SOUTH), (12.0, 30.0), true=np.array([90.0, 90, 0.3, 0.3, 2.0])))
    assert (np.abs(found.mean) <= LIMITS).all() and np.hypot(*found.en_m) <= LIMITS[0] + 1e-6


def test_a_slow_change_is_undone_to_the_reference():
    start = replace(unknown(), agreed_s=SETTLED_S)
    learner = BiasLearner(start)
    for second in range(400):
        learner.add(difference(second))
    assert learner.learnt.agreed_s > SETTLED_S and learner.reference is start
    learner.restore()
    assert learner.learnt is start and learner.until(math.inf) is start


def test_the_reference_of_an_unknown_map_is_what_was_learnt_first():
    learner = BiasLearner(replace(unknown(), agreed_s=SETTLED_S - 100))
    for second in range(250):
        learner.add(difference(second))
    assert learner.reference.agreed_s < SETTLED_S
    for second in range(250, 400):
        learner.add(difference(second))
    assert SETTLED_S <= learner.reference.agreed_s < SETTLED_S + 3


def test_a_clock_that_goes_back_is_no_error():
    values = [difference(second) for second in (*range(300), *range(100, 400))]
    assert np.isfinite(learnt(values).cov).all()


def test_the_mount_belongs_to_the_camera_and_the_displacement_to_the_map():
    known = Biases(TRUE, np.diag(unknown().stds ** 2 / 100), 3600.0, "camera")
    same = at_start({"map": known}, "map", "camera")
    assert np.array_equal(same.mean, TRUE) and (same.stds >= known.stds).all()
    refitted = at_start({"map": known}, "map", "another camera")
    assert refitted.mean[:2] == pytest.approx(TRUE[:2]) and not refitted.mean[2:].any()
    assert refitted.stds[2:] == pytest.approx(unknown().stds[2:], rel=0.1)
    elsewhere = at_start({"map": known}, "another map", "camera")
    assert not elsewhere.mean[:2].any() and elsewhere.agreed_s == 0
    assert elsewhere.mean[2:] == pytest.approx(TRUE[2:])
    assert np.array_equal(at_start({}, "map", "").mean, np.zeros(5))


def test_many_flights_that_show_nothing_are_no_damage():
    """The uncertainty of a bias that no flight shows stays within what the state file may hold."""
    known = unknown("camera")
    for _ in range(200):
        known = at_start({"map": biases_from_plain(known.to_plain())}, "map", "camera")
    assert known.stds == pytest.approx(unknown().stds)
