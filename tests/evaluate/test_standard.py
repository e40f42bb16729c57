"""Standard figures against an example worked out by hand."""

import math

import numpy as np
import pytest

from orthonav.ground.evaluate.statistics import standard_figures

TRUTH = np.array([[0.0, 0.0], [60.0, 0.0], [120.0, 0.0], [180.0, 0.0], [240.0, 0.0]])
ERRORS = np.array([[3.0, 4.0], [0.0, 0.0], [np.nan, np.nan], [0.0, 10.0], [0.0, -5.0]])
"""Errors of 5, 0, none, 10 and 5 m."""


def test_pose_errors_of_the_example() -> None:
    """From fix to fix errors differ by (-3, -4), (0, 10), (0, -15). The fixes lie at 0, 60, 180 and
    240 m: 100 m are reached at 180 m, and no second time; at twice the scale at 120, 360, 480 m."""
    found = standard_figures(TRUTH, TRUTH + ERRORS)
    far = standard_figures(2 * TRUTH, 2 * TRUTH + ERRORS).rpe_distance
    expected = {  # n, RMSE, mean, median, std, max
        found.ape: (4, math.sqrt(37.5), 5.0, 5.0, math.sqrt(12.5), 10.0),
        found.rpe_frames: (3, math.sqrt(350 / 3), 10.0, 10.0, math.sqrt(50 / 3), 15.0),
        far: (2, math.sqrt(325 / 2), 12.5, 12.5, 2.5, 15.0),
    }
    for statistics, values in expected.items():
        assert tuple(vars(statistics).values()) == pytest.approx(values)
    assert found.rpe_distance.n == 0
    assert (found.cep50_m, found.cep95_m) == pytest.approx((5.0, 5 + 0.85 * (10 - 5)))


def test_a_constant_offset_has_no_relative_error() -> None:
    found = standard_figures(TRUTH, TRUTH + np.array([30.0, 40.0]))
    assert found.ape.rmse_m == pytest.approx(50.0) and found.ape.std_m == pytest.approx(0.0)
    assert found.rpe_frames.max_m == pytest.approx(0.0)


def test_relative_errors_do_not_cross_flights() -> None:
    two = np.concatenate([TRUTH, TRUTH]), np.concatenate([TRUTH, TRUTH + np.array([1000.0, 0.0])])
    assert standard_figures(*two).rpe_frames.max_m == pytest.approx(1000.0)
    apart = standard_figures(*two, starts=(0, 5))
    assert (apart.rpe_frames.n, apart.rpe_frames.max_m) == (8, pytest.approx(0.0))
    assert apart.rpe_distance.n == 2 and apart.ape.n == 10


def test_without_a_fix_nothing_is_defined() -> None:
    found = standard_figures(TRUTH, np.full_like(TRUTH, np.nan))
    assert found.ape.n == 0 and math.isnan(found.ape.rmse_m) and math.isnan(found.cep50_m)
