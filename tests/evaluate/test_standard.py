"""Standard figures against an example worked out by hand."""

import math

import numpy as np
import pytest

from orthonav.ground.evaluate.figures import standard_figures

TRUTH = np.array([[0.0, 0.0], [60.0, 0.0], [120.0, 0.0], [180.0, 0.0], [240.0, 0.0]])
ERRORS = np.array([[3.0, 4.0], [0.0, 0.0], [np.nan, np.nan], [0.0, 10.0], [0.0, -5.0]])
"""Errors of 5, 0, none, 10 and 5 m."""


def test_absolute_pose_error() -> None:
    found = standard_figures(TRUTH, TRUTH + ERRORS)
    ape = found.ape
    assert ape.n == 4
    assert ape.mean_m == pytest.approx(5.0)  # (5 + 0 + 10 + 5) / 4
    assert ape.median_m == pytest.approx(5.0)
    assert ape.rmse_m == pytest.approx(math.sqrt(37.5))  # (25 + 0 + 100 + 25) / 4
    assert ape.std_m == pytest.approx(math.sqrt(12.5))  # 37.5 - 25
    assert ape.max_m == pytest.approx(10.0)
    assert found.cep50_m == pytest.approx(5.0)
    assert found.cep95_m == pytest.approx(9.25)  # 5 + 0.85 * (10 - 5)


def test_relative_pose_error_per_frame() -> None:
    """From each fix to the next: differences of errors (-3, -4), (0, 10) and (0, -15)."""
    found = standard_figures(TRUTH, TRUTH + ERRORS).rpe_frames
    assert found.n == 3
    assert found.mean_m == pytest.approx(10.0)  # (5 + 10 + 15) / 3
    assert found.median_m == pytest.approx(10.0)
    assert found.rmse_m == pytest.approx(math.sqrt(350 / 3))
    assert found.std_m == pytest.approx(math.sqrt(50 / 3))
    assert found.max_m == pytest.approx(15.0)


def test_relative_pose_error_over_a_distance() -> None:
    """The fixes lie at 0, 60, 180 and 240 m: 100 m are reached at 180 m, and no second time."""
    assert standard_figures(TRUTH, TRUTH + ERRORS).rpe_distance.n == 0
    found = standard_figures(TRUTH, TRUTH + ERRORS, distance_m=60.0).rpe_distance
    assert found.n == 2  # from 60 to 180 m, from 180 to 240 m
    assert found.mean_m == pytest.approx(12.5)
    assert found.max_m == pytest.approx(15.0)


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


@pytest.mark.parametrize("distance_m", [0.0, -1.0, math.nan, math.inf])
def test_an_impossible_distance_is_refused(distance_m: float) -> None:
    with pytest.raises(ValueError, match="positive and finite"):
        standard_figures(TRUTH, TRUTH, distance_m=distance_m)
