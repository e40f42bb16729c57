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
    [Flown(60, turbulence_deg=0.3, seed=2), straight(60)],
    ids=["little turbulence", "straight and calm"],
)
def test_an_undisturbed_flight_sends_everything_after_its_start(flown):
    flight = ComputedFlight(flown, 0.12, lambda at_s: 0.12)
    first = sent(flight.fly(START_S))
    images = flight.fly(28)
    assert first[0][0] < START_S
    assert len(sent(images)) == len(images)


def test_a_false_motion_of_one_picture_withholds_nothing():
    flight = ComputedFlight(straight(70), 0.12, lambda at_s: 0.12)
    flight.wrong = lambda exposed_s: 0.08 if exposed_s % 10.0 < 0.2 else 0.0
    flight.fly(START_S)
    images = flight.fly(35)
    assert len(sent(images)) == len(images)


def test_false_motions_for_some_seconds_withhold_until_they_are_over():
    """In calm air the latency cannot be measured; nothing else shows that it changed."""
    flight = ComputedFlight(straight(70), 0.12, lambda at_s: 0.12)
    flight.fly(20)
    begin = flight.exposed_s
    rng = np.random.default_rng(1)
    flight.wrong = lambda at: rng.normal(0, 0.1) if begin < at < begin + 4 else 0.0
    during = flight.fly(26)
    assert {reason for at_s, reason, _ in during if at_s > 24} == {"latency_unsteady"}
    flight.fly(36)
    after = flight.fly(45)
    assert len(sent(after)) == len(after)


def test_a_stall_is_over_seconds_after_the_images_return():
    flight = ComputedFlight(Flown(70, seed=1), 0.12, lambda at_s: 0.12)
    flight.fly(STALL_S)
    images = flight.fly(36, arrives=lambda at_s: at_s > STALL_S + 8)
    assert images[0][1] == "latency_unknown"
    assert sent(images)[0][0] < STALL_S + 8 + 6


@pytest.mark.parametrize(
    ("flown", "late_s"),
    [(Flown(70, seed=4), 8.0), (straight(70, seed=5), 2.0)],
    ids=["turns, 8 s", "calm, 2 s"],
)
def test_a_step_without_a_gap_is_noticed_by_the_position(flown, late_s):
    flight = ComputedFlight(flown, 0.12, lambda at_s: 0.12 if at_s < 25 else late_s)
    flight.fly(START_S)
    images = flight.fly(25)
    assert len(sent(images)) >= len(images) - 1
    wrong = [error_m for _, error_m in sent(flight.fly(38)) if error_m > FAR_M]
    assert wrong == []


def test_a_growing_latency_is_noticed_before_it_matters():
    flight = ComputedFlight(Flown(70, seed=3), 0.12, lambda at_s: 0.12 + 0.1 * max(0, at_s - 25))
    errors = [error_m for _, error_m in sent(flight.fly(35))]
    assert max(errors) < 12.0  # 15 m/s; without a measurement it would be 15 m


def test_states_from_before_the_first_image_count():
    """Telemetry is there before the camera: a latency that is not stated is measured at once."""
    flight = ComputedFlight(Flown(70, seed=1), None, lambda at_s: 0.4)
    images = sent(flight.fly(10))
    assert images[0][0] < 8.0 and images[0][1] < 3.0
