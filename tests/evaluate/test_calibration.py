"""Calibration of confidence and consistency of covariance against cases worked out by hand."""

import math
from itertools import pairwise

import numpy as np
import pytest

from orthonav.ground.evaluate.statistics import (
    N_BINS,
    ConfidenceCalibration,
    calibrate,
    check_covariance,
    is_covariance,
    whitened,
)

RADIUS_M = 20.0
RIGHT_M, WRONG_M = 3.0, 300.0


def of_shares(*groups: tuple[float, int, int], radius_m: float = RADIUS_M) -> ConfidenceCalibration:
    """Groups of (confidence, fixes right, fixes wrong)."""
    stated = [c for c, right, wrong in groups for _ in range(right + wrong)]
    errors_m = [m for _, right, wrong in groups for m in [RIGHT_M] * right + [WRONG_M] * wrong]
    own_m = np.full(len(stated), radius_m)
    return calibrate(np.array(stated), np.array(errors_m), own_m, 15.0)


def test_exact_calibration_has_no_error() -> None:
    found = of_shares((0.25, 1, 3), (0.5, 5, 5), (0.75, 9, 3), (1.0, 4, 0))
    assert found.ece == pytest.approx(0.0, abs=1e-12)
    assert found.n_fixes == found.n_own_radius == 30
    assert found.mean_confidence == pytest.approx(found.share_right) == pytest.approx(19 / 30)
    # the mean of c (1 - c), as outcomes are Bernoulli with just that c
    assert found.brier == pytest.approx((4 * 0.1875 + 10 * 0.25 + 12 * 0.1875) / 30)
    wilson = found.bins[5].right_low, found.bins[5].right_high  # 5 of 10
    assert wilson == pytest.approx((0.23659, 0.76341), abs=1e-5)


def test_bins_cover_0_to_1_and_hold_their_lower_edge() -> None:
    edges = [i / N_BINS for i in range(N_BINS + 1)]
    found = of_shares(*((edge, 1, 0) for edge in edges))
    assert [b.n_fixes for b in found.bins] == [1] * 9 + [2]  # 0.9 and 1 in the last
    assert (found.bins[0].lower, found.bins[-1].upper) == (0.0, 1.0)
    assert all(a.upper == b.lower for a, b in pairwise(found.bins))
    below = of_shares(*((float(np.nextafter(edge, 0)), 1, 0) for edge in edges[1:]))
    assert [b.n_fixes for b in below.bins] == [1] * N_BINS


def test_fixes_without_a_confidence_are_left_out() -> None:
    stated = np.array([0.8, math.nan, 0.8, math.nan, 0.8])
    errors_m = np.array([RIGHT_M, RIGHT_M, WRONG_M, WRONG_M, math.nan])  # the last has no fix
    found = calibrate(stated, errors_m, np.full(5, RADIUS_M), 15.0)
    assert (found.n_fixes, found.share_right) == (2, 0.5)
    assert found.ece == pytest.approx(0.3)


def test_right_is_within_the_radius_a_fix_states_itself() -> None:
    errors_m = np.full(6, 20.0)
    own_m = np.array([19.0, 20.0, math.nan, 0.0, -5.0, math.inf])
    one = calibrate(np.ones(6), errors_m, own_m, 15.0)
    assert (one.n_own_radius, one.share_right) == (2, pytest.approx(1 / 6))
    other = calibrate(np.ones(6), errors_m, own_m, 30.0)  # where none is stated
    assert other.share_right == pytest.approx(5 / 6)


def test_nees_against_an_inverse() -> None:
    random = np.random.default_rng(2)
    roots = random.normal(0.0, 5.0, (50, 2, 2))
    cov = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(2)
    errors = random.normal(0.0, 5.0, (50, 2))
    expected = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(cov), errors)
    np.testing.assert_allclose((whitened(errors, cov) ** 2).sum(axis=1), expected, rtol=1e-9)
    found = check_covariance(errors, cov, np.full(50, 1000.0), 15.0)
    np.testing.assert_allclose(found.nees, np.sort(expected), rtol=1e-9)


def test_right_covariance_is_consistent_and_a_halved_one_is_not() -> None:
    random = np.random.default_rng(4)
    cov = np.array([[25.0, 12.0], [12.0, 16.0]])
    errors = random.multivariate_normal([0.0, 0.0], cov, 20_000)
    own_m = np.full(len(errors), 100.0)
    good = check_covariance(errors, np.tile(cov, (len(errors), 1, 1)), own_m, 15.0)
    assert good.n == good.nees.size == 20_000
    assert good.nees_mean == pytest.approx(2.0, abs=0.05)
    assert good.nees_median == pytest.approx(2 * math.log(2), abs=0.05)
    assert all(share == pytest.approx(level, abs=0.01) for level, share in good.within.items())
    small = check_covariance(errors, np.tile(cov / 2, (len(errors), 1, 1)), own_m, 15.0)
    assert small.nees_mean == pytest.approx(2 * good.nees_mean)
    assert small.within[0.9] == pytest.approx(1 - 0.1**0.5, abs=0.01)


def test_only_right_fixes_count() -> None:
    errors = np.array([[3.0, 4.0], [300.0, 0.0], [math.nan, math.nan], [0.0, 20.0]])
    own_m = np.array([10.0, 10.0, 10.0, math.nan])
    cov = np.tile(25.0 * np.eye(2), (4, 1, 1))
    found = check_covariance(errors, cov, own_m, 15.0)
    assert (found.n, found.nees.tolist()) == (1, [1.0])
    assert check_covariance(errors, cov, own_m, 25.0).nees.tolist() == [1.0, 16.0]


BROKEN = {
    "singular": [[4.0, 4.0], [4.0, 4.0]],
    "nearly singular": [[4.0, 4.0 * (1 - 1e-15)], [4.0 * (1 - 1e-15), 4.0]],
    "zero": [[0.0, 0.0], [0.0, 0.0]],
    "one axis": [[4.0, 0.0], [0.0, 0.0]],
    "negative": [[-4.0, 0.0], [0.0, -4.0]],
    "indefinite": [[4.0, 5.0], [5.0, 4.0]],
    "not symmetric": [[4.0, 1.0], [2.0, 4.0]],
    "infinite": [[math.inf, 0.0], [0.0, 4.0]],
}


@pytest.mark.parametrize("rows", BROKEN.values(), ids=BROKEN)
def test_an_invalid_covariance_is_counted_and_left_out(rows: list[list[float]]) -> None:
    cov = np.array([rows, np.eye(2)])
    assert is_covariance(cov).tolist() == [False, True]
    found = check_covariance(np.ones((2, 2)), cov, np.full(2, RADIUS_M), 15.0)
    assert (found.n, found.n_unusable, found.n_without) == (2, 1, 0)
    assert found.nees.tolist() == [2.0]
