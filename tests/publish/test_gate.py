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

START_NS = 1_789_000_000_000_000_000
SECOND = 10**9
FRAME = LocalFrame(48.0, -4.0)


def estimate_at(seconds: float, east_m: float = 0.0, north_m: float = 0.0, **more: object):
    lat, lon = FRAME.latlon_from_en((east_m, north_m))
    made = NavigationEstimate(
        float(lat), float(lon), np.eye(2) * 4.0, 0.95, time_ns=START_NS + round(seconds * 1e9)
    )
    return replace(made, **more)


def now(seconds: float) -> int:
    return START_NS + round(seconds * 1e9)


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
def test_positions_in_doubt_are_withheld_and_counted(reason, change, later_s) -> None:
    gate = Gate()
    assert gate.admit(estimate_at(0.0, **change), now(later_s)) == (None, reason)
    assert gate.withheld == {reason: 1}


@pytest.mark.parametrize("level_m", [35.1, math.inf, math.nan])
def test_a_protection_level_above_the_alert_limit_is_withheld(level_m) -> None:
    gate = Gate(GateRules(alert_limit_m=35.0))
    for state in ("tracking", None):
        estimate = estimate_at(0.0, protection_level_m=level_m, state=state)
        assert gate.admit(estimate, now(0.1)) == (None, "alert_limit")
    assert gate.withheld == {"alert_limit": 2} and gate.is_unavailable
    assert gate.availability(now(3.1))["unavailable_s"] == 3.0
    assert gate.admit(estimate_at(1.0, protection_level_m=35.0), now(1.0)).reason is None
    assert not gate.is_unavailable
    assert unavailable_text(gate.availability(now(1.0))) == ""


def test_views_out_of_order_are_withheld() -> None:
    gate = Gate()
    assert gate.admit(estimate_at(0.5), now(0.6)).reason is None
    assert gate.admit(estimate_at(0.5), now(0.7)).reason == "out_of_order"
    assert gate.admit(estimate_at(0.4), now(0.7)).reason == "out_of_order"
    assert gate.withheld == {"out_of_order": 2}


def test_positions_pass_again_after_a_clock_was_set_back() -> None:
    gate = Gate()
    gate.admit(estimate_at(3600.0), now(3600.0))
    passed = [gate.admit(estimate_at(float(second)), now(second)).estimate for second in range(3)]
    assert [None if each is None else each.reset_counter for each in passed] == [None, None, 1]


def test_a_track_found_again_is_a_reset() -> None:
    gate = Gate()
    counters = []
    for second, state in enumerate(["tracking", "tracking", "lost", "searching", "tracking"]):
        passed = gate.admit(estimate_at(second, state=state), now(second)).estimate
        counters.append(None if passed is None else passed.reset_counter)
    assert counters == [0, 0, None, None, 1]
    gate.admit(None, now(5))
    again = gate.admit(estimate_at(6, state="tracking"), now(6)).estimate
    assert again is not None and again.reset_counter == 2 == gate.resets


@pytest.mark.parametrize("doubt", [{"state": "coasting"}, {"confidence": 0.5}])
def test_a_view_in_doubt_is_no_reset(doubt) -> None:
    gate = Gate()
    tracking = {"state": "tracking"}
    views = enumerate([tracking, {**tracking, **doubt}, tracking])
    passed = [
        gate.admit(estimate_at(second, **view), now(second)).estimate for second, view in views
    ]
    assert [None if each is None else each.reset_counter for each in passed] == [0, None, 0]


def jumped(gate: Gate, east_m: float, views: int, **more: object) -> list[int | None]:
    """Reset counters of so many views a second apart, after one at 0 m; None for one withheld."""
    gate.admit(estimate_at(0.0, **more), now(0))
    counters = []
    for second in range(1, views + 1):
        passed = gate.admit(estimate_at(second, east_m=east_m, **more), now(second)).estimate
        counters.append(None if passed is None else passed.reset_counter)
    return counters


@pytest.mark.parametrize(
    ("jump_m", "counters"), [(20.0, [0, 0, 0, 0]), (300.0, [None, None, 1, 1])]
)
def test_an_impossible_jump_is_withheld_until_views_agree(jump_m, counters) -> None:
    """60 m/s for a second and five times 2.8 m are 74 m, for three seconds 194 m."""
    gate = Gate()
    assert jumped(gate, jump_m, 4) == counters
    assert gate.withheld["jump"] == counters.count(None)


def test_a_single_view_elsewhere_is_withheld_for_good() -> None:
    gate = Gate()
    east_m = [0.0, 500.0, 0.0, 900.0, -700.0, 1500.0, 0.0]
    passed = [
        gate.admit(estimate_at(0.2 * step, east_m=east), now(0.2 * step)).estimate
        for step, east in enumerate(east_m)
    ]
    assert [each is not None for each in passed] == [east == 0.0 for east in east_m]
    assert gate.resets == 0


@pytest.mark.parametrize(("jump_m", "withheld"), [(0.0, 0), (15.0, 0), (30.0, 1)])
def test_a_known_velocity_makes_the_limit_smaller(jump_m: float, withheld: int) -> None:
    """30 m/s foretell 30 m; 5 m of acceleration and five times 3 m are 20 m more."""
    gate = Gate()
    moving = {"vel_en_mps": (30.0, 0.0), "state": "tracking"}
    gate.admit(estimate_at(0.0, **moving), now(0))
    gate.admit(estimate_at(1.0, east_m=30.0 + jump_m, **moving), now(1))
    assert gate.withheld["jump"] == withheld


def test_the_reset_counter_wraps_after_255() -> None:
    gate = Gate()
    for number in range(601):
        state = "lost" if number % 2 else "tracking"
        passed = gate.admit(estimate_at(number, state=state), now(number)).estimate
    assert gate.resets == 300
    assert passed is not None and passed.reset_counter == 300 - 256


@pytest.mark.parametrize("place", [(90.0, 0.0), (-90.0, 180.0), (0.0, 180.0), (89.95, -180.0)])
def test_poles_and_the_antimeridian_are_no_jump(place: tuple[float, float]) -> None:
    gate = Gate()
    lat, lon = place
    gate.admit(estimate_at(0.0, lat_deg=lat, lon_deg=lon), now(0))
    passed = gate.admit(estimate_at(1.0, lat_deg=lat, lon_deg=-lon), now(1)).estimate
    assert passed is not None and passed.reset_counter == 0


def test_views_with_a_small_jitter_all_pass() -> None:
    rng = np.random.default_rng(1)
    gate = Gate(GateRules(min_interval_s={"A": 0.2}))
    times = 0.2 * np.arange(500) + rng.uniform(-0.004, 0.004, 500)
    assert all(gate.due("A", now(float(time_s))) for time_s in times)


@given(st.lists(st.integers(0, 3 * SECOND), min_size=1, max_size=60), st.integers(1, 20))
def test_the_long_term_rate_is_kept(steps_ns: list[int], tenths: int) -> None:
    gate = Gate(GateRules(min_interval_s={"A": tenths / 10}))
    times = np.cumsum(steps_ns).tolist()
    sent = [time_ns for time_ns in times if gate.due("A", START_NS + time_ns)]
    assert sent[0] == times[0]
    span_s = (sent[-1] - sent[0]) / 1e9
    assert (len(sent) - 1) * tenths / 10 <= span_s + 0.1 * tenths / 10 + 1e-6


def test_the_rate_limit_works_after_a_clock_was_set_back() -> None:
    gate = Gate(GateRules(min_interval_s={"A": 1.0}))
    assert gate.due("A", now(1000.0))
    assert gate.due("A", now(0.0))
    assert not gate.due("A", now(0.5))


@pytest.mark.parametrize(
    "rules",
    [
        {"max_std_m": 0.0},
        {"alert_limit_m": math.nan},
        {"min_interval_s": {"A": 0.0}},
        {"min_confidence": 1.1},
    ],
)
def test_invalid_rules_are_refused(rules: dict) -> None:
    with pytest.raises(EstimateError):
        GateRules(**rules)
