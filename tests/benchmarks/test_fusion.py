"""Filters that take positions as independent: what they claim with the covariance that is sent."""

import math

import numpy as np
import pytest
from benchmarks.fusion import RECEIVERS, Fixes, fixes_of, fuse

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, NoFix, ViewResult
from orthonav.onboard.messages.estimate import NavigationEstimate, for_filter

FRAME = LocalFrame(48.0, 2.0)
INERTIAL = [each for each in RECEIVERS if each.inertial]
MEMORY_S, SECONDS = 15.0, 180.0


def correlated(rng: np.random.Generator, rate_hz: float, std_m: float) -> Fixes:
    """Errors of a flight, half constant, half forgotten within `MEMORY_S`, as positions."""
    count = round(SECONDS * rate_hz)
    kept = math.exp(-1 / rate_hz / MEMORY_S)
    errors = rng.normal(size=(count, 2))
    for k in range(1, count):
        errors[k] = kept * errors[k - 1] + math.sqrt(1 - kept**2) * errors[k]
    errors = (errors + rng.normal(size=2)) * std_m / math.sqrt(2)
    own = np.full(count, std_m**2)
    estimate = NavigationEstimate(48.0, 2.0, np.eye(2) * std_m**2, 0.99, utc_ns=0)
    sent = np.full(count, for_filter(estimate, 1 / rate_hz).horizontal_std_m() ** 2)
    sent[0] = own[0]
    return Fixes(np.arange(count) / rate_hz, errors, np.zeros((count, 2)), own, sent, 0.0)


@pytest.fixture(scope="module", params=[(5.0, 4.0), (1.0, 15.0)])
def flights(request) -> list[Fixes]:
    rng = np.random.default_rng(3)
    return [correlated(rng, *request.param) for _ in range(12)]


@pytest.mark.parametrize("receiver", INERTIAL, ids=lambda each: each.name)
def test_the_claim_of_a_filter_is_right_with_what_is_sent(flights, receiver) -> None:
    ratios = [fuse(receiver, each, each.sent_m2).ratio for each in flights]
    assert 0.7 <= np.mean(ratios) <= 1.5


@pytest.mark.slow
@pytest.mark.parametrize("receiver", INERTIAL, ids=lambda each: each.name)
def test_with_the_covariance_of_the_fix_it_is_too_confident(flights, receiver) -> None:
    plain = [fuse(receiver, each, each.own_m2).ratio for each in flights]
    assert np.mean(plain) > 2.0


@pytest.mark.slow
@pytest.mark.parametrize("receiver", INERTIAL, ids=lambda each: each.name)
def test_a_filter_of_independent_errors_is_consistent(receiver) -> None:
    """The filter itself is right where its assumption holds."""
    rng, times = np.random.default_rng(4), np.arange(0.0, 120.0, 0.5)
    ratios = []
    for _ in range(30):
        places = rng.normal(0.0, 4.0, (len(times), 2))
        own = np.full(len(times), 16.0)
        fixes = Fixes(times, places, np.zeros_like(places), own, own, 0.0)
        ratios.append(fuse(receiver, fixes, own).ratio)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.2)


def test_a_map_displacement_enters_by_its_expected_square() -> None:
    times, own = np.arange(0.0, 120.0, 0.5), np.full(240, 16.0)
    still = Fixes(times, np.zeros((240, 2)), np.zeros((240, 2)), own, own, 0.0)
    displaced = Fixes(times, np.zeros((240, 2)), np.zeros((240, 2)), own, own, 3.0)
    receiver = INERTIAL[0]
    without, made = (fuse(receiver, each, own) for each in (still, displaced))
    assert made.actual_m**2 == pytest.approx(without.actual_m**2 + 9.0, rel=0.02)


def test_only_confident_positions_are_fused() -> None:
    fix = Fix(48.0, 2.0, np.eye(2) * 16.0, 0.99, 15.0, 90.0, 250.0)
    results = [
        ViewResult("a", 0, NoFix("blank", ""), 1.0, "searching"),
        ViewResult("b", 10**9, fix, 1.0, "searching"),
        ViewResult("c", 2 * 10**9, fix, 1.0, "tracking"),
    ]
    made = fixes_of(results, {"b": (48.0, 2.0), "c": (48.0, 2.0)}, FRAME, 3.0)
    assert made.times_s.tolist() == [2.0]
