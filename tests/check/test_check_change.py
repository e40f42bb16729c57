"""Pictures of another year keep what lasts and lose what does not."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from helpers import textured
from orthonav.ground.check import ageing
from orthonav.ground.check.ageing import another_year, displaced

SIZE = 192


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


def changed(lasting, seed=1, grey=None, donor=None):
    grey = textured((SIZE, SIZE), 5) if grey is None else grey
    donor = textured((SIZE, SIZE), 6) if donor is None else donor
    persistence = [np.full((SIZE, SIZE), lasting, np.float32)] * 3
    return another_year(np.random.default_rng(seed), grey, donor, persistence)


def test_the_more_lasts_the_more_is_kept():
    grey = textured((SIZE, SIZE), 5)
    correlation = [
        np.mean([kept(grey, changed(each, seed)) for seed in range(3)]) for each in LASTING
    ]
    assert correlation[0] < 0.1 and correlation[-1] > 0.5
    assert all(np.diff(correlation) > 0)


LASTING = (0.01, 0.3, 0.6, 0.95)


def test_what_lasts_is_kept_where_it_does():
    grey = textured((SIZE, SIZE), 5)
    lasting = np.where(np.arange(SIZE) < SIZE // 2, 0.9, 0.02).astype(np.float32)
    persistence = [np.broadcast_to(lasting, (SIZE, SIZE))] * 3
    donor = textured((SIZE, SIZE), 6)
    made = another_year(np.random.default_rng(2), grey, donor, persistence)
    west, east = np.s_[:, : SIZE // 2], np.s_[:, SIZE // 2 :]
    assert kept(grey[west], made[west]) > 0.3 > 0.15 > kept(grey[east], made[east])


def test_what_comes_instead_stays_mirrored():
    """It is turned, never flipped again: then it would be found where it is from."""
    ground = textured((SIZE, SIZE), 7)
    made = changed(0.005, donor=ground[:, ::-1])
    turned = [np.rot90(ground, times) for times in range(4)]
    mirrored = [np.rot90(ground[:, ::-1], times) for times in range(4)]
    assert max(kept(each, made) for each in turned) < 0.1
    assert max(kept(each, made) for each in mirrored) > 0.4


def test_what_stands_tilts_away_from_the_middle():
    grey = textured((SIZE, SIZE), 5)
    upright = displaced(np.random.default_rng(1), grey, 0.0, 15.0)
    assert_array_equal(upright, grey)
    leant = displaced(np.random.default_rng(1), grey, 4.0, 15.0)
    off = np.abs(leant.astype(int) - grey)
    middle, rim = np.s_[SIZE // 2 - 8 : SIZE // 2 + 8], np.s_[:24]
    assert off[middle, middle].mean() < 0.3 * off[rim, rim].mean()
