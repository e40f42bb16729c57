"""Probabilities of errors and protection levels against samples of the distribution."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.core.records import ERROR_DEGREES, Fix, probability_beyond, protection_level_m

COV = np.array([[9.0, 3.0], [3.0, 4.0]])
FIX = Fix(48.0, 2.0, COV, 0.99, 35.0, 0.0, 200.0, place_probability=0.9999)


def test_errors_follow_a_student_distribution_of_the_covariance():
    rng = np.random.default_rng(1)
    normal = rng.multivariate_normal([0, 0], COV * (ERROR_DEGREES - 2) / ERROR_DEGREES, 400_000)
    errors = normal * np.sqrt(ERROR_DEGREES / rng.chisquare(ERROR_DEGREES, 400_000))[:, None]
    assert np.cov(errors.T) == pytest.approx(COV, rel=0.1)
    lengths = np.hypot(*errors.T)
    for limit in (1.0, 5.0, 15.0):
        assert probability_beyond(COV, limit) == pytest.approx((lengths > limit).mean(), rel=0.1)


@given(st.floats(1e-6, 0.3), st.floats(0.0, 1.0), st.floats(0.1, 1e4), st.floats(0.1, 1e4))
def test_the_protection_level_is_exceeded_with_the_risk(risk, place, one, other):
    level_m = protection_level_m(place, np.diag([one, other]), risk)
    if 1 - place >= risk:
        assert math.isinf(level_m)
    else:
        beyond = 1 - place + place * probability_beyond(np.diag([one, other]), level_m)
        assert beyond == pytest.approx(risk, rel=1e-6)


def test_a_fix_states_both():
    level_m = FIX.protection_level_m(1e-3)
    assert FIX.probability_within(level_m) == pytest.approx(0.999, abs=1e-9)
    assert FIX.protection_level_m(1e-2) < level_m < FIX.protection_level_m(2e-4)
    assert math.isinf(FIX.protection_level_m(1e-5))  # a wrong place is likelier


def test_without_a_place_probability_the_confidence_counts():
    assert math.isinf(replace(FIX, place_probability=math.nan).protection_level_m())
    assert replace(FIX, place_probability=math.nan).protection_level_m(0.02) > 10


@pytest.mark.parametrize("unknown", [{"confidence": math.nan}, {"cov_en_m2": COV * math.nan}])
def test_what_is_unknown_protects_nothing(unknown):
    fix = replace(FIX, place_probability=math.nan, **unknown)
    assert math.isinf(fix.protection_level_m(0.5)) and math.isnan(fix.probability_within(10))


@pytest.mark.parametrize("risk", [-0.1, 1.1, math.nan])
def test_a_risk_that_is_no_probability_is_refused(risk):
    with pytest.raises(ValueError, match="0 to 1"):
        FIX.protection_level_m(risk)


def test_no_error_is_within_a_negative_limit():
    assert FIX.probability_within(-1.0) == FIX.probability_within(0.0) == 0.0
