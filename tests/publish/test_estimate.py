"""Estimates: accuracy, clocks, GPS time."""

import math
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import strategies as st

from orthonav.core.records import Fix, NoFix, ViewResult, error_ellipse
from orthonav.onboard.messages.estimate import (
    EstimateError,
    NavigationEstimate,
    estimate_from_result,
)
from orthonav.onboard.messages.mavlink import gps_time

COV = np.array([[16.0, 3.0], [3.0, 9.0]])
PLAIN = NavigationEstimate(48.0, -4.0, COV, 0.95, time_ns=5)
VELOCITY = {"vel_east_mps": 12.0, "vel_north_mps": -3.5}


def a_result(state: str | None = None, **evidence: float) -> ViewResult:
    fix = Fix(48.1, -4.3, COV, 0.93, 15.0, 87.0, 121.0, evidence)
    return ViewResult("a.jpg", 5_000_000_000, fix, 80.0, state)


def unix_ns(text: str) -> int:
    return int(datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp()) * 10**9


def test_a_fix_becomes_an_estimate() -> None:
    made = estimate_from_result(a_result("tracking", **VELOCITY), utc_ahead_ns=4 * 10**9)
    assert made is not None
    assert (made.lat_deg, made.lon_deg, made.confidence) == (48.1, -4.3, 0.93)
    assert made.state == "tracking"
    assert made.vel_en_mps == (12.0, -3.5) and made.vel_cov_en is None
    assert (made.utc_ns, made.time_ns) == (9 * 10**9, 5 * 10**9)
    assert made.processing_s == 0.08
    assert math.isnan(made.alt_amsl_m) and math.isnan(made.alt_std_m)


def test_without_a_fix_there_is_no_estimate() -> None:
    assert estimate_from_result(ViewResult("a.jpg", 0, NoFix("blank", ""), 1.0)) is None


@pytest.mark.parametrize(
    ("state", "evidence"),
    [
        (None, VELOCITY),  # a single view
        ("tracking", {"vel_east_mps": 1.0}),
        ("tracking", {**VELOCITY, "vel_east_mps": math.nan}),
    ],
)
def test_an_incomplete_velocity_is_unknown(state: str | None, evidence: dict[str, float]) -> None:
    made = estimate_from_result(a_result(state, **evidence))
    assert made is not None and made.vel_en_mps is None


def test_utc_is_stamped() -> None:
    made = estimate_from_result(a_result(), utc_ahead_ns=10**18)
    assert made is not None and made.sent_ns - made.stamp_ns == 80_000_000
    with pytest.raises(EstimateError, match="UTC"):
        _ = replace(made, utc_ns=None).stamp_ns


angles = st.floats(0, math.pi)
axes = st.floats(0.01, 1e4)


@pytest.mark.parametrize("cov", [[[1, 0], [0, math.nan]], [[1, 2], [2, 1]], [[-1, 0], [0, -1]]])
def test_an_invalid_covariance_has_no_standard_deviation(cov: list[list[float]]) -> None:
    estimate = replace(PLAIN, cov_en_m2=np.array(cov))
    assert all(map(math.isnan, error_ellipse(estimate.cov_en_m2)))
    assert math.isnan(estimate.horizontal_std_m())
    assert not estimate.is_confident


def test_the_standard_deviation_is_that_of_the_worst_direction() -> None:
    values = np.linalg.eigvalsh(COV)
    assert PLAIN.horizontal_std_m() == pytest.approx(math.sqrt(values[1]))
    assert PLAIN.horizontal_std_m() >= math.sqrt(COV.diagonal().max())


@pytest.mark.parametrize(
    ("confidence", "state", "confident"),
    [
        (0.9, None, True),
        (0.899, None, False),
        (math.nan, None, False),
        (0.99, "tracking", True),
        (0.99, "searching", False),
        (0.99, "lost", False),
    ],
)
def test_a_confident_estimate_is_of_high_confidence_and_tracking(
    confidence: float, state: str | None, confident: bool
) -> None:
    assert replace(PLAIN, confidence=confidence, state=state).is_confident is confident


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"lat_deg": 90.01}, "latitude"),
        ({"lat_deg": math.nan}, "latitude"),
        ({"lon_deg": -180.5}, "longitude"),
        ({"cov_en_m2": np.eye(3)}, "covariance"),
        ({"vel_cov_en": np.ones(2)}, "covariance of the velocity"),
        ({"confidence": 1.5}, "confidence"),
        ({"processing_s": math.inf}, "processing time"),
        ({"alt_std_m": -1.0}, "altitude"),
        ({"reset_counter": 256}, "reset counter"),
    ],
)
def test_an_invalid_value_is_named(change: dict[str, object], said: str) -> None:
    with pytest.raises(EstimateError, match=said):
        replace(PLAIN, **change)


@pytest.mark.parametrize(
    ("utc", "week", "second_of_week"),
    [
        ("2017-01-01T00:00:00", 1930, 18),
        ("2026-01-03T23:59:42", 2400, 0),
        ("2016-12-31T23:59:59", 0, 0),
    ],
)
def test_gps_time_knows_leap_seconds(utc: str, week: int, second_of_week: int) -> None:
    assert gps_time(unix_ns(utc) + 999_999) == (week, second_of_week * 1000)
