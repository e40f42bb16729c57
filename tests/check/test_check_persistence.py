"""Persistence from year to year, predicted from one picture."""

import cv2
import numpy as np
import pytest

from orthonav.ground.check.ageing import (
    MARGIN_PX,
    MAX_PERSISTENCE,
    MIN_PERSISTENCE,
    features,
)
from orthonav.ground.check.trials import reported_persistence

SIZE = 256


def crops(seed=1):
    """Fine persistence without direction."""
    noise = np.random.default_rng(seed).normal(size=(SIZE, SIZE)).astype(np.float32)
    blots = cv2.GaussianBlur(noise, (0, 0), 1.2)
    return np.clip(120 + 12 * blots / blots.std(), 0, 255).astype(np.uint8)


def roads_and_houses(seed=1):
    """Long borders and rectangles of strong contrast."""
    rng = np.random.default_rng(seed)
    picture = np.full((SIZE, SIZE), 105, np.uint8)
    for at in range(20, SIZE, 70):
        cv2.line(picture, (0, at), (SIZE, at + 25), 190, 6)
        cv2.line(picture, (at, 0), (at - 15, SIZE), 60, 5)
    for row, col in rng.integers(10, SIZE - 30, (25, 2)):
        picture[row : row + 14, col : col + 18] = 215
    noise = rng.normal(0, 2, picture.shape)
    return np.clip(cv2.GaussianBlur(picture, (0, 0), 0.7) + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("gsd_m", [0.5, 1.0, 2.0])
def test_roads_and_houses_last_longer_than_crops(gsd_m):
    roads, fields = (reported_persistence(each, gsd_m)[0] for each in (roads_and_houses(), crops()))
    assert roads.mean() > 1.5 * fields.mean() and roads.mean() > 0.1


def test_what_lasts_is_told_where_it_is():
    both = np.where(np.arange(SIZE) < SIZE // 2, roads_and_houses(), crops()).astype(np.uint8)
    predicted = reported_persistence(both, 1.0)[0]
    reach = MARGIN_PX
    assert predicted[:, : SIZE // 2 - reach].mean() > 1.5 * predicted[:, SIZE // 2 + reach :].mean()


def test_far_pixels_change_nothing():
    one = crops()
    other = one.copy()
    other[:, 160:] = roads_and_houses()[:, 160:]
    before, after = (features(each, 1.0) for each in (one, other))
    same = (160 - MARGIN_PX) // 8 - 1
    np.testing.assert_allclose(before[:, :same], after[:, :same], rtol=1e-3, atol=1e-3)
    assert np.abs(before[:, 22:] - after[:, 22:]).max() > 0.1


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_blank_ground_has_finite_persistence(grey):
    for predicted in reported_persistence(np.full((120, 130), grey, np.uint8), 1.0):
        assert predicted.shape == (120, 130) and predicted.dtype == np.float32
        assert (
            np.isfinite(predicted).all()
            and predicted.min() >= MIN_PERSISTENCE
            and predicted.max() <= MAX_PERSISTENCE
        )
