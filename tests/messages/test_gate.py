"""The gate: confidence, age and rate of positions, counts of reasons, and jumps."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.core.geo.frames import LocalFrame
from orthonav.onboard.messages.estimate import EstimateError, NavigationEstimate
from orthonav.onboard.messages.gate import Gate, GateRules, unavailable_text

FRAME = LocalFrame(48.0, -4.0)


def now(seconds):
    return 1_789_000_000_000_000_000 + round(seconds * 1e9)


def estimate_at(seconds, east_m=0.0, **more):
    lat, lon = FRAME.latlon_from_en((east_m, 0.0))
    made = NavigationEstimate(float(lat), float(lon), np.eye(2) * 4.0, 0.95, time_ns=now(seconds))
    return replace(made, **more)


def counters(gate, *views, every_s=1.0):
    """Reset counters of views at such intervals; None where one is withheld. A view is what differs
    of its estimate; None has no fix."""
    found = []
    for number, view in enumerate(views):
        second = number * every_s
        estimate = None if view is None else estimate_at(second, **view)
        passed = gate.admit(estimate, now(second)).estimate
        found.append(None if passed is None else passed.reset_counter)
    return found


@pytest.mark.parametrize(
    ("reason", "change", "later_s"),
    [
        ("low_confidence", {"confidence": 0.89}, 0.1),
        ("low_confidence", {"confidence": math.nan}, 0.1),
        ("not_tracking", {"state": "searching"}, 0.1),
        ("not_tracking", {"state": "lost"}, 0.1),
        ("coasting", {"state": "coasting"}, 0.1),
        ("low_confidence", {"accepted": False}, 0.1),
        ("no_covariance", {"cov_en_m2": np.full((2, 2), math.nan)}, 0.1),
        ("too_uncertain", {"cov_en_m2": np.diag([1.0, 51.0**2])}, 0.1),
        ("stale", {}, 1.01),
        ("from_the_future", {}, -0.11),
    ],
)
def test_positions_in_doubt_are_withheld_and_counted(reason, change, later_s):
    gate = Gate()
    assert gate.admit(estimate_at(0.0, **change), now(later_s)) == (None, reason)
    assert gate.withheld == {reason: 1}


@pytest.mark.parametrize("level_m", [35.1, math.inf, math.nan])
def test_a_protection_level_above_the_alert_limit_is_withheld(level_m):
    gate = Gate(GateRules(alert_limit_m=35.0))
    for state in ("tracking", None):
        estimate = estimate_at(0.0, protection_level_m=level_m, state=state)
        assert gate.admit(estimate, now(0.1)) == (None, "alert_limit")
    assert gate.withheld == {"alert_limit": 2} and gate.is_unavailable
    availability = gate.availability(now(3.1))
    assert availability["unavailable_s"] == 3.0
    level = "35 m" if level_m == 35.1 else "infinite"
    said = f"protection level {level}, above the alert limit 35 m for 3 s"
    assert unavailable_text(availability) == said
    assert gate.admit(estimate_at(1.0, protection_level_m=35.0), now(1.0)).reason is None
    assert not gate.is_unavailable and unavailable_text(gate.availability(now(1.0))) == ""


def test_without_an_alert_limit_there_is_no_availability():
    assert Gate().availability(now(0)) == {}


def test_views_out_of_order_are_withheld():
    gate = Gate()
    assert gate.admit(estimate_at(0.5), now(0.6)).reason is None
    assert gate.admit(estimate_at(0.5), now(0.7)).reason == "out_of_order"
    assert gate.admit(estimate_at(0.4), now(0.7)).reason == "out_of_order"
    assert gate.withheld == {"out_of_order": 2}


def test_positions_pass_again_after_a_clock_was_set_back():
    gate = Gate()
    gate.admit(estimate_at(3600.0), now(3600.0))
    assert counters(gate, {}, {}, {}) == [None, None, 1]


def test_a_track_found_again_is_a_reset():
    gate = Gate()
    states = ("tracking", "tracking", "lost", "searching", "tracking", None, "tracking")
    views = [state and {"state": state} for state in states]  # one has no fix
    assert counters(gate, *views) == [0, 0, None, None, 1, None, 2]
    assert gate.resets == 2 and gate.withheld["no_fix"] == 1


@pytest.mark.parametrize("doubt", [{"state": "coasting"}, {"confidence": 0.5}])
def test_a_view_in_doubt_is_no_reset(doubt):
    tracking = {"state": "tracking"}
    assert counters(Gate(), tracking, {**tracking, **doubt}, tracking) == [0, None, 0]


@pytest.mark.parametrize(
    ("jump_m", "found"), [(20.0, [0, 0, 0, 0, 0]), (300.0, [0, None, None, 1, 1])]
)
def test_an_impossible_jump_is_withheld_until_views_agree(jump_m, found):
    """60 m/s for a second and five times 2.8 m are 74 m, for three seconds 194 m."""
    gate = Gate()
    assert counters(gate, {}, *[{"east_m": jump_m}] * 4) == found
    assert gate.withheld["jump"] == found.count(None)


def test_a_single_view_elsewhere_is_withheld_for_good():
    gate, east_m = Gate(), (0.0, 500.0, 0.0, 900.0, -700.0, 1500.0, 0.0)
    found = counters(gate, *[{"east_m": each} for each in east_m], every_s=0.2)
    assert found == [0 if each == 0.0 else None for each in east_m]


@pytest.mark.parametrize(
    ("jump_m", "velocity_cov", "withheld"),
    [
        (0.0, None, 0),
        (15.0, None, 0),
        (30.0, None, 1),
        (30.0, np.eye(2) * 25.0, 0),
        (15.0, np.zeros((2, 2)), 0),
        (20.0, np.zeros((2, 2)), 1),
    ],
)
def test_a_known_velocity_makes_the_limit_smaller(jump_m, velocity_cov, withheld):
    """30 m/s foretell 30 m; 5 m of acceleration and five times 3 m are 20 m more."""
    gate = Gate()
    moving = {"vel_en_mps": (30.0, 0.0), "state": "tracking", "vel_cov_en": velocity_cov}
    counters(gate, moving, {**moving, "east_m": 30.0 + jump_m})
    assert gate.withheld["jump"] == withheld


def test_the_reset_counter_wraps_after_255():
    gate = Gate()
    states = [{"state": "lost" if number % 2 else "tracking"} for number in range(601)]
    assert counters(gate, *states)[-1] == 300 - 256
    assert gate.resets == 300


@pytest.mark.parametrize("place", [(90.0, 0.0), (-90.0, 180.0), (0.0, 180.0), (89.95, -180.0)])
def test_poles_and_the_antimeridian_are_no_jump(place):
    lat, lon = place
    views = {"lat_deg": lat, "lon_deg": lon}, {"lat_deg": lat, "lon_deg": -lon}
    assert counters(Gate(), *views) == [0, 0]


def test_views_with_a_small_jitter_all_pass():
    rng = np.random.default_rng(1)
    gate = Gate(GateRules(min_interval_s={"A": 0.2}))
    times = 0.2 * np.arange(500) + rng.uniform(-0.004, 0.004, 500)
    assert all(gate.due("A", now(float(time_s))) for time_s in times)


@given(st.lists(st.integers(0, 3 * 10**9), min_size=1, max_size=60), st.integers(1, 20))
def test_the_long_term_rate_is_kept(steps_ns, tenths):
    gate = Gate(GateRules(min_interval_s={"A": tenths / 10}))
    times = np.cumsum(steps_ns).tolist()
    sent = [time_ns for time_ns in times if gate.due("A", now(0) + time_ns)]
    assert sent[0] == times[0]
    span_s = (sent[-1] - sent[0]) / 1e9
    assert (len(sent) - 1) * tenths / 10 <= span_s + 0.1 * tenths / 10 + 1e-6


def test_the_rate_limit_works_after_a_clock_was_set_back():
    gate = Gate(GateRules(min_interval_s={"A": 1.0}))
    assert gate.due("A", now(1000.0))
    assert gate.due("A", now(0.0))
    assert not gate.due("A", now(0.5)) and gate.withheld == {"rate:A": 1}
    assert gate.due("B", now(0.5))  # has no limit


@pytest.mark.parametrize(
    "rules",
    [
        {"max_std_m": 0.0},
        {"alert_limit_m": math.nan},
        {"min_interval_s": {"A": 0.0}},
        {"min_confidence": 1.1},
    ],
)
def test_invalid_rules_are_refused(rules):
    with pytest.raises(EstimateError):
        GateRules(**rules)
