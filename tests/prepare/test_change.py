"""Changed pictures: other light, other fields, the same ground below."""

import numpy as np
import pytest

from helpers import textured
from orthonav.core.register.channels import channels_of
from orthonav.ground.build.calibrate import changed

SIZE = 128
GREY, OTHER = textured((SIZE, SIZE), 1), textured((SIZE, SIZE), 2)


def drawn(seed, grey=GREY, other=OTHER):
    return changed(np.random.default_rng(seed), grey, other)


def alike(one, other):
    """Correlation of the evidence of edges of two pictures."""
    valid = np.ones(one.shape, bool)
    parts = [channels_of(each, valid)[..., :2] for each in (one, other)]
    return float((parts[0] * parts[1]).sum() / np.sqrt(np.prod([(p**2).sum() for p in parts])))


def test_the_same_seed_gives_the_same_picture():
    for seed in range(4):
        np.testing.assert_array_equal(drawn(seed), drawn(seed))
    assert not np.array_equal(drawn(0), drawn(1))


def test_most_pictures_still_show_the_same_ground_in_place():
    """Some as hardly to be known, none moved."""
    likes = [alike(drawn(seed), GREY) for seed in range(40)]
    assert 0.2 < np.median(likes) < 0.85 and min(likes) < 0.1 < 0.5 < max(likes)
    best = drawn(int(np.argmax(likes)))
    moved = [alike(best, np.roll(GREY, shift, (0, 1))) for shift in ((0, 2), (2, 0), (-2, 0))]
    assert max(likes) > max(moved) + 0.1


@pytest.mark.parametrize("level", [0, 128, 255])
def test_blank_pictures_are_no_crash(level):
    blank = np.full((64, 64), level, np.uint8)
    for grey, other in ((blank, OTHER), (GREY, blank), (blank, blank)):
        out = drawn(1, grey, other)
        assert out.shape == grey.shape and out.dtype == np.uint8
