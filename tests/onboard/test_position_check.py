"""Jumps of the position that a change of the latency explains."""

import math

import numpy as np
import pytest
from fake_autopilot import S

from orthonav.onboard.history import StateHistory
from orthonav.onboard.position_check import PositionCheck

SPEED = 15.0
TURN = np.eye(3)


def flown(at_s, bend=0.05):
    """Place and velocity on a circle, metres east and north."""
    angle = bend * at_s
    place = SPEED / bend * np.array([math.sin(angle), 1 - math.cos(angle)])
    return place, SPEED * np.array([math.cos(angle), math.sin(angle)])


def history(until_s, known=True):
    made = StateHistory()
    for number in range(round(until_s / 0.05) + 1):
        velocity = (*flown(number * 0.05)[1], 0.0) if known else None
        made.add(round(number * 0.05 * S), TURN, velocity, 100.0)
    return made


def changes(place_at, times_s, *, std_m=3.0, known=True):
    """What positions at these times show, with all states known up to then."""
    check = PositionCheck()
    return [
        check.change_s(round(at * S), place_at(at), std_m, history(at + 0.1, known=known))
        for at in times_s
    ]


TIMES = np.arange(20.0, 26.0, 0.2)


def late(step_s, since=22.9):
    return lambda at: flown(at if at < since else at - step_s)[0]


@pytest.mark.parametrize("step_s", [2.0, 4.0, 8.0])
def test_a_step_of_the_latency_is_found_at_once(step_s):
    found = changes(late(step_s), TIMES)
    first = next(i for i, each in enumerate(found) if each is not None)
    assert TIMES[first] == pytest.approx(23.0)
    assert found[first] == pytest.approx(step_s, abs=1.2)


def test_a_filter_that_follows_slowly_shows_the_step_too():
    def followed(at):
        share = min(1.0, max(0.0, (at - 22.9) / 1.5))
        return (1 - share) * flown(at)[0] + share * flown(at - 3.0)[0]

    assert any(each is not None for each in changes(followed, TIMES))


def test_the_last_position_before_a_gap_of_the_track_counts():
    times = [21.0, 22.0, 42.0]
    assert changes(late(10.0), times)[-1] == pytest.approx(10.0, abs=4.0)
    assert set(changes(late(0.0), times)) == {None}


def test_noise_and_an_error_of_the_velocity_are_no_jump():
    rng = np.random.default_rng(0)
    drift = np.array([0.8, -0.5])
    noisy = changes(lambda at: flown(at)[0] + rng.normal(0, 3, 2) + drift * at, TIMES)
    assert set(noisy) == {None}


def test_a_jump_to_where_the_aircraft_never_was_is_not_explained():
    def aside(at):
        place, (east, north) = flown(at)
        return place + (60 / SPEED * np.array([-north, east]) if at > 23 else 0)

    assert set(changes(aside, TIMES)) == {None}


def test_nothing_is_known_without_velocity_or_after_clearing():
    assert set(changes(late(8.0), TIMES, known=False)) == {None}
    check = PositionCheck()
    check.change_s(20 * S, flown(20.0)[0], 3.0, history(21))
    check.clear()
    assert check.change_s(21 * S, flown(13.0)[0], 3.0, history(22)) is None
