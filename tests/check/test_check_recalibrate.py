"""What trials predict, corrected by what came out on other scenes."""

import numpy as np
import pytest

from orthonav.ground.check.recalibrate import LEARNT, Recalibration

SHARES = np.linspace(0.02, 0.98, 25)


@pytest.mark.parametrize("view_px", [60.0, 256.0, 500.0])
@pytest.mark.parametrize("has_prior", [True, False])
def test_more_trials_that_succeed_predict_more(view_px, has_prior):
    predicted = LEARNT(SHARES, view_px, has_prior)
    assert (np.diff(predicted) > 0).all()
    assert predicted.min() > 0 and predicted.max() < 1


def test_corrections_apply_where_they_should():
    by = Recalibration(0.0, 1.0, narrow=-0.5, no_prior=-0.3, std=0.5)
    wide, half = by(SHARES, 256.0, True), by(SHARES, 128.0, True)
    np.testing.assert_allclose(wide, SHARES)
    np.testing.assert_allclose(by(SHARES, 512.0, True), SHARES)
    odds = (half / (1 - half)) / (SHARES / (1 - SHARES))
    np.testing.assert_allclose(odds[1:-1], np.exp(-0.5), rtol=1e-6)
    assert (by(SHARES, 256.0, False) <= SHARES).all()


def test_another_sensor_is_placed_less_often_and_less_surely():
    other = LEARNT.other_sensor()
    assert (other(SHARES, 256.0, True) <= LEARNT(SHARES, 256.0, True)).all()
    assert other(np.array([0.5]), 256.0, True) < LEARNT(np.array([0.5]), 256.0, True) - 0.1
    assert other.std > LEARNT.std
