"""The simulated loop: the IMU fits the motion, and a filter with exact instruments follows it."""

import numpy as np
import pytest
from benchmarks.closed_loop.loop import Scenario, fly
from benchmarks.closed_loop.physics import (
    STEP_S,
    VEHICLES,
    Grade,
    Wind,
    increments,
    integrated,
)

PERFECT = Grade(*(0.0,) * 4, 90.0, *(0.0,) * 8)


@pytest.mark.parametrize("kind", VEHICLES)
def test_imu_gives_the_motion_back(kind):
    rng = np.random.default_rng(1)
    wind = Wind(rng, np.array([3.0, -4.0, 0.0]))
    aircraft = VEHICLES[kind](rng, np.array([0.0, 0.0, -250.0]), 1.0)
    aircraft.step(wind.next())
    own = aircraft.motion
    felt = []
    for _ in range(400):
        aircraft.steer(aircraft.motion, np.array([0.0, 900.0]), 255.0)
        before = aircraft.motion
        aircraft.step(wind.next())
        felt.append(increments(before, aircraft.motion))
        own = integrated(own, felt[-1])
    assert np.allclose(own.position, aircraft.motion.position, atol=1e-6)
    assert np.allclose(own.rotation, aircraft.motion.rotation, atol=1e-9)
    up = np.mean([each.push for each in felt], axis=0) / STEP_S
    assert up[2] == pytest.approx(-9.81, abs=1.0)  # it hangs from its wing or its rotors
    east = aircraft.motion.position[1]
    assert east > 40


@pytest.mark.parametrize("kind", VEHICLES)
@pytest.mark.parametrize("gnss_s", [6.0, 12.0])
def test_filter_with_exact_instruments_follows(kind, gnss_s):
    scenario = Scenario("", 12.0, gnss_s=gnss_s, sends=False)
    flown = fly(scenario, None, vehicle=kind, autopilot="px4", seed=2, grade=PERFECT)
    off = [each.estimate.position - each.truth.position for each in flown.samples]
    late = slice(-10, None)
    assert np.abs(off[late]).max() < (1.0 if gnss_s == 12.0 else 8.0)
