"""Persistence from year to year, predicted from one picture."""

import cv2
import numpy as np
import pytest

from helpers import textured
from orthonav.ground.check import ageing
from orthonav.ground.check.ageing import another_year, reported_persistence

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


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_blank_ground_has_finite_persistence(grey):
    for predicted in reported_persistence(np.full((120, 130), grey, np.uint8), 1.0):
        assert predicted.shape == (120, 130) and predicted.dtype == np.float32
        assert np.isfinite(predicted).all() and predicted.min() > 0 and predicted.max() < 1


SIDE = 192


@pytest.fixture(autouse=True)
def mild(monkeypatch):
    """No deviation from the expected persistence."""
    monkeypatch.setattr(ageing, "FIELD", 0.0)
    monkeypatch.setattr(ageing, "VIEW", 0.0)


def kept(one, other):
    """Correlation of gradients whatever their sign: of squared complex numbers."""
    squares = []
    for picture in (one, other):
        south, east = np.gradient(picture.astype(float))
        squares.append(((east + 1j * south) ** 2)[8:-8, 8:-8])
    first, second = (each / np.maximum(np.abs(each), 1.0) for each in squares)
    return float((first * second.conj()).real.mean())


def test_the_more_lasts_the_more_is_kept():
    grey, donor = textured((SIDE, SIDE), 5), textured((SIDE, SIDE), 6)
    correlation = []
    for lasting in (0.01, 0.3, 0.6, 0.95):
        expected = [np.full((SIDE, SIDE), lasting, np.float32)] * 3
        rngs = map(np.random.default_rng, range(3))
        changed = [another_year(rng, grey, donor, expected) for rng in rngs]
        correlation.append(np.mean([kept(grey, each) for each in changed]))
    assert correlation[0] < 0.1 and correlation[-1] > 0.5
    assert all(np.diff(correlation) > 0)
