"""Persistence from year to year, predicted from one picture."""

import json
from importlib import resources

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from orthonav.ground.check.persistence import (
    MARGIN_PX,
    MAX_PERSISTENCE,
    MIN_PERSISTENCE,
    MODEL,
    default_model,
    features,
    terms,
)
from orthonav.ground.check.views import PERSISTENCE_LEVELS, reported_persistence

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


def test_levels():
    large = np.tile(crops(), (2, 2))
    assert len(reported_persistence(large, 1.0)) == PERSISTENCE_LEVELS
    tiny = reported_persistence(crops()[:90, :90], 1.0)
    assert tiny and all(each.shape == (90, 90) for each in tiny)
    later = reported_persistence(large, 0.5, first=1)
    assert len(later) == PERSISTENCE_LEVELS and later[0] is later[1]


def test_features_and_weights_fit():
    found = features(crops(), 1.0, every_px=16)
    assert found.shape[:2] == (16, 16) and found.dtype == np.float32
    model = default_model()
    assert model.mean.shape == model.spread.shape == found.shape[2:]
    assert terms(found).shape[-1] == len(model.weights)
    assert (model.spread > 0).all()


def test_terms_are_all_products():
    assert_array_equal(terms(np.array([2.0, 3.0])), [1, 2, 3, 4, 6, 9])


def test_a_model_survives_a_file():
    text = resources.files("orthonav.ground.check").joinpath(MODEL).read_text(encoding="utf-8")
    assert default_model().to_plain() == json.loads(text)["model"]
