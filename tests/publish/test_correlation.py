"""The covariance for receivers that take positions as independent."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.onboard.messages.estimate import (
    FilterCovariance,
    NavigationEstimate,
    for_filter,
    messages_averaged,
)

S = 10**9
COV = np.array([[25.0, 6.0], [6.0, 16.0]])
ESTIMATE = NavigationEstimate(48.0, 2.0, COV, 0.97, time_ns=0)


@pytest.mark.parametrize("interval_s, count", [(0.2, 15.0), (1.0, 3.0), (3.0, 1.0), (60.0, 1.0)])
def test_the_count_is_that_of_the_averaging_time(interval_s: float, count: float) -> None:
    assert messages_averaged(interval_s) == pytest.approx(count)


@pytest.mark.parametrize("interval_s", [math.inf, 0.0, -1.0, math.nan])
def test_a_message_without_one_before_counts_once(interval_s: float) -> None:
    assert messages_averaged(interval_s) == 1.0


@given(st.floats(0.05, 20.0), st.floats(1.0, 60.0), st.floats(0.1, 60.0))
def test_the_covariance_is_scaled_as_a_whole(interval_s: float, long_m: float, short_m: float):
    cov = np.diag([long_m**2, short_m**2])
    made = for_filter(replace(ESTIMATE, cov_en_m2=cov), interval_s).cov_en_m2
    np.testing.assert_allclose(made, cov * messages_averaged(interval_s))


@given(st.lists(st.floats(0.05, 1.0), min_size=10, max_size=30))
def test_the_information_does_not_depend_on_the_rate(steps_s: list[float]) -> None:
    """Sum of inverse variances over a time: that of one fix per averaging time."""
    inverse = [1 / for_filter(ESTIMATE, step).cov_en_m2[0, 0] for step in steps_s]
    averaging_s = messages_averaged(1.0)
    assert sum(inverse) == pytest.approx(sum(steps_s) / averaging_s / COV[0, 0])


def test_a_deviation_may_have_a_floor() -> None:
    narrow = replace(ESTIMATE, cov_en_m2=np.eye(2) * 0.01)
    assert for_filter(narrow, math.inf).horizontal_std_m() == pytest.approx(0.1)
    assert for_filter(narrow, math.inf, min_std_m=20.0).horizontal_std_m() == pytest.approx(20.0)


def test_every_message_has_its_own_rate() -> None:
    covariance = FilterCovariance()

    def count(message: str, second: float) -> float:
        made = covariance.prepare(message, ESTIMATE, round(second * S)).cov_en_m2
        return float(made[0, 0]) / COV[0, 0]

    assert count("A", 0.0) == count("A", 0.5) == 1.0  # none was sent yet
    covariance.sent("A", 0)
    averaging_s = messages_averaged(1.0)
    assert count("A", 0.5) == pytest.approx(averaging_s / 0.5)
    assert count("B", 0.5) == 1.0
    assert count("A", 100.0) == 1.0  # after a gap
    covariance.sent("A", 200 * S)
    assert count("A", 100.0) == 1.0  # after a clock was set back
