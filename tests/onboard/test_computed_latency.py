"""When the latency monitor withholds, and for how long, on flights with computed pictures."""

import numpy as np
import pytest
from computed_flights import FAR_M, ComputedFlight, sent, straight
from flown import Flown

pytestmark = pytest.mark.long

START_S = 6.0
STALL_S = 20.0


@pytest.mark.parametrize(
    "flown",
    [Flown(60, seed=1), Flown(60, turbulence_deg=0.3, seed=2), straight(60)],
    ids=["turbulence", "little turbulence", "straight and calm"],
)
def test_an_undisturbed_flight_sends_everything_after_its_start(flown):
    flight = ComputedFlight(flown, 0.12, lambda at_s: 0.12)
    first = sent(flight.fly(START_S))
    assert first[0][0] < START_S and flight.sends_all(28)


def test_false_motions_for_some_seconds_withhold_until_they_are_over():
    flight = ComputedFlight(straight(70), 0.12, lambda at_s: 0.12)
    flight.fly(20)
    begin = flight.exposed_s
    rng = np.random.default_rng(1)
    flight.wrong = lambda at: rng.normal(0, 0.1) if begin < at < begin + 4 else 0.0
    during = flight.fly(26)
    assert {reason for at_s, reason, _ in during if at_s > 24} == {"motion_mismatch"}
    flight.fly(37)
    assert flight.sends_all(45)


@pytest.mark.parametrize("flown", [Flown(70, seed=1), straight(70)], ids=["turns", "calm"])
def test_a_stall_is_over_seconds_after_the_images_return(flown):
    flight = ComputedFlight(flown, 0.12, lambda at_s: 0.12)
    flight.fly(STALL_S)
    flight.interruptions = 1
    images = flight.fly(36, arrives=lambda at_s: at_s > STALL_S + 8)
    assert images[0][1] == "latency_unknown"
    assert sent(images)[0][0] < STALL_S + 8 + 6


@pytest.mark.parametrize(
    ("flown", "late_s", "stall_s"),
    [
        (Flown(70, seed=4), 8.0, 0.0),
        (straight(70, seed=5), 2.0, 0.0),
        (Flown(70, seed=4), 3.0, 2.9),
        (straight(70, seed=5), 3.0, 2.9),
    ],
    ids=["turns, 8 s", "calm, 2 s", "turns, stalled", "calm, stalled"],
)
def test_a_step_of_the_latency_is_noticed_by_the_position(flown, late_s, stall_s):
    flight = ComputedFlight(flown, 0.12, lambda at_s: 0.12 if at_s < 25 else late_s)
    flight.fly(START_S)
    images = flight.fly(25)
    assert len(sent(images)) >= len(images) - 1
    flight.interruptions += stall_s > 0
    images = flight.fly(50, arrives=lambda at_s: at_s > 25 + stall_s)
    assert [error_m for _, error_m in sent(images) if error_m > FAR_M] == []


def test_a_step_that_is_over_is_forgiven_in_turns():
    flight = ComputedFlight(Flown(90, seed=4), 0.12, lambda at_s: 0.12 if at_s < 25 else 2.0)
    flight.fly(35)
    flight.delay_s = lambda at_s: 0.12
    flight.fly(65)
    assert flight.sends_all(70)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_errors_of_pitch_and_roll_do_not_accuse_the_camera(seed):
    """PX4 without GNSS: 1 deg within a second, and 2 m/s."""
    flight = ComputedFlight(straight(60, seed=seed), 0.12, lambda at_s: 0.12, seed=seed)
    flight.wrong = lambda at_s: 0.018 * np.sin(1.2 * at_s) / flight.rate_hz
    flight.velocity_off = 2.0
    flight.fly(START_S)
    assert flight.sends_all(45)


def test_a_mirrored_image_is_forgiven_seconds_after_it_ended():
    flight = ComputedFlight(Flown(70, seed=1), 0.12, lambda at_s: 0.12)
    flight.fly(20)
    flight.mirrored = True
    assert not [at_s for at_s, _ in sent(flight.fly(30)) if at_s > 26]
    flight.mirrored = False
    assert sent(flight.fly(45))[0][0] < 30 + 7.5


@pytest.mark.parametrize("seed", [4, 5])
def test_images_late_by_a_gap_of_two_seconds_are_noticed(seed):
    flown = straight(70, seed=seed)
    flight = ComputedFlight(flown, 0.12, lambda at_s: 0.12 if at_s < 25 else 2.12)
    flight.fly(25)
    images = flight.fly(40, arrives=lambda at_s: at_s > 27)
    assert sent(images) == []


def test_a_growing_latency_is_noticed_before_it_matters():
    flight = ComputedFlight(Flown(70, seed=3), 0.12, lambda at_s: 0.12 + 0.1 * max(0, at_s - 25))
    errors = [error_m for _, error_m in sent(flight.fly(40))]
    assert max(errors) < 13.0  # 15 m/s; without a comparison it would be 22 m


@pytest.mark.parametrize("late_s", [0.6, 1.0, 2.0])
def test_calm_flight_does_not_clear_a_latency_that_turns_contradicted(late_s):
    flown = Flown(80, turns_until_s=30, turbulence_deg=0.05, seed=1)
    flight = ComputedFlight(flown, 0.12, lambda at_s: late_s)
    images = flight.fly(70)
    assert not [at_s for at_s, error_m in sent(images) if at_s > 30]


def test_a_steady_orbit_does_not_clear_a_jump():
    flown = Flown(100, turns_until_s=30, then_deg_s=12.0, turbulence_deg=0.05, seed=2)
    flight = ComputedFlight(flown, 0.12, lambda at_s: 0.12 if at_s < 25 else 2.0)
    flight.fly(32)
    assert not sent(flight.fly(90))
