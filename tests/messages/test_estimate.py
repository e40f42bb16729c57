"""Estimates: accuracy, clocks, GPS time, and the covariance for receivers that take positions as
independent."""

import math
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.core.records import Fix, NoFix, ViewResult, error_ellipse
from orthonav.onboard.messages.estimate import (
    EstimateError,
    FilterCovariance,
    NavigationEstimate,
    estimate_from_result,
    for_filter,
    messages_averaged,
)
from orthonav.onboard.messages.mavlink import gps_time

S = 10**9
COV = np.array([[16.0, 3.0], [3.0, 9.0]])
PLAIN = NavigationEstimate(48.0, -4.0, COV, 0.95, time_ns=5)
VELOCITY = (12.0, -3.5)


def a_result(state=None, velocity=None):
    fix = Fix(48.1, -4.3, COV, 0.93, 15.0, 87.0, 121.0, vel_en_mps=velocity)
    return ViewResult("a.jpg", 5 * S, fix, 80.0, state)


def test_a_fix_becomes_an_estimate():
    made = estimate_from_result(a_result("tracking", VELOCITY), utc_ahead_ns=4 * S)
    assert (made.lat_deg, made.lon_deg, made.confidence) == (48.1, -4.3, 0.93)
    assert (made.state, made.vel_en_mps, made.vel_cov_en) == ("tracking", VELOCITY, None)
    assert (made.utc_ns, made.time_ns, made.processing_s) == (9 * S, 5 * S, 0.08)
    assert math.isnan(made.alt_amsl_m) and math.isnan(made.alt_std_m)


def test_a_track_reports_one_deviation_of_the_velocity():
    result = a_result("tracking", VELOCITY)
    moving = replace(result, outcome=replace(result.outcome, vel_std_mps=0.5))
    assert estimate_from_result(moving).vel_cov_en.tolist() == [[0.25, 0.0], [0.0, 0.25]]


def test_without_a_fix_there_is_no_estimate():
    assert estimate_from_result(ViewResult("a.jpg", 0, NoFix("blank", ""), 1.0)) is None


@pytest.mark.parametrize(
    ("state", "velocity"),
    [(None, VELOCITY), ("tracking", None), ("tracking", (math.nan, -3.5))],  # None: a single view
)
def test_an_incomplete_velocity_is_unknown(state, velocity):
    assert estimate_from_result(a_result(state, velocity)).vel_en_mps is None


def test_utc_is_stamped():
    made = estimate_from_result(a_result(), utc_ahead_ns=10**18)
    assert made.sent_ns - made.stamp_ns == 80_000_000
    with pytest.raises(EstimateError, match="UTC"):
        _ = replace(made, utc_ns=None).stamp_ns


@pytest.mark.parametrize("cov", [[[1, 0], [0, math.nan]], [[1, 2], [2, 1]], [[-1, 0], [0, -1]]])
def test_an_invalid_covariance_has_no_standard_deviation(cov):
    estimate = replace(PLAIN, cov_en_m2=np.array(cov))
    assert all(map(math.isnan, error_ellipse(estimate.cov_en_m2)))
    assert math.isnan(estimate.horizontal_std_m()) and not estimate.is_confident


def test_the_standard_deviation_is_that_of_the_worst_direction():
    assert PLAIN.horizontal_std_m() == pytest.approx(math.sqrt(np.linalg.eigvalsh(COV)[1]))


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
def test_a_confident_estimate_is_of_high_confidence_and_tracking(confidence, state, confident):
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
def test_an_invalid_value_is_named(change, said):
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
def test_gps_time_knows_leap_seconds(utc, week, second_of_week):
    unix_s = int(datetime.fromisoformat(utc).replace(tzinfo=UTC).timestamp())
    assert gps_time(unix_s * S + 999_999) == (week, second_of_week * 1000)


@pytest.mark.parametrize(
    ("interval_s", "count"),
    [
        *((0.2, 15.0), (1.0, 3.0), (3.0, 1.0), (60.0, 1.0)),
        *((each, 1.0) for each in (math.inf, 0.0, -1.0, math.nan)),  # none before
    ],
)
def test_messages_within_the_averaging_time_count(interval_s, count):
    assert messages_averaged(interval_s) == pytest.approx(count)


@given(st.floats(0.05, 20.0), st.floats(1.0, 60.0), st.floats(0.1, 60.0))
def test_the_covariance_is_scaled_as_a_whole(interval_s, long_m, short_m):
    cov = np.diag([long_m**2, short_m**2])
    made = for_filter(replace(PLAIN, cov_en_m2=cov), interval_s).cov_en_m2
    np.testing.assert_allclose(made, cov * messages_averaged(interval_s))


@given(st.lists(st.floats(0.05, 1.0), min_size=10, max_size=30))
def test_the_information_does_not_depend_on_the_rate(steps_s):
    """Sum of inverse variances over a time: that of one fix per averaging time."""
    inverse = [1 / for_filter(PLAIN, step).cov_en_m2[0, 0] for step in steps_s]
    assert sum(inverse) == pytest.approx(sum(steps_s) / messages_averaged(1.0) / COV[0, 0])


def test_a_deviation_may_have_a_floor():
    narrow = replace(PLAIN, cov_en_m2=np.eye(2) * 0.01)
    assert for_filter(narrow, math.inf).horizontal_std_m() == pytest.approx(0.1)
    assert for_filter(narrow, math.inf, min_std_m=20.0).horizontal_std_m() == pytest.approx(20.0)
    invalid = replace(PLAIN, cov_en_m2=np.full((2, 2), math.nan))
    assert for_filter(invalid, 1.0, min_std_m=20.0) is invalid


def test_every_message_has_its_own_rate():
    covariance = FilterCovariance()

    def count(message, second):
        made = covariance.prepare(message, PLAIN, round(second * S)).cov_en_m2
        return float(made[0, 0]) / COV[0, 0]

    assert count("A", 0.0) == count("A", 0.5) == pytest.approx(1.0)  # none was sent yet
    covariance.sent("A", 0)
    assert count("A", 0.5) == pytest.approx(messages_averaged(1.0) / 0.5)
    assert count("B", 0.5) == pytest.approx(1.0)
    assert count("A", 100.0) == pytest.approx(1.0)  # after a gap
    covariance.sent("A", 200 * S)
    assert count("A", 100.0) == pytest.approx(1.0)  # after a clock was set back
