"""Evidence keeps what seasons leave alone, and says nothing of pixels that are not valid."""

import cv2
import numpy as np
import pytest

from helpers import textured
from orthonav.core.register.template import COARSE, FINE, GROUPS, channels_of

RECIPES = {"fine": FINE, "coarse": COARSE}
GRADIENT, GREY = GROUPS


@pytest.fixture(params=RECIPES.values(), ids=RECIPES.keys())
def recipe(request):
    return request.param


def frozen(array):
    array.flags.writeable = False
    return array


def everywhere(grey):
    return frozen(np.ones(grey.shape, bool))


def soft(shape=(120, 150), seed=0):
    """A picture (H, W) uint8 of middle grey levels, so that there is room above and below."""
    large = textured((300, 300), seed) // 2 + 64
    return frozen(large[: shape[0], : shape[1]].astype(np.uint8))


def with_holes(shape):
    valid = np.ones(shape, bool)
    valid[:, : shape[1] // 5] = False
    valid[shape[0] // 3 : shape[0] // 2, shape[1] // 2 : -20] = False
    valid[np.add.outer(np.arange(shape[0]), np.arange(shape[1])) > sum(shape) - 40] = False
    return frozen(valid)


@pytest.mark.parametrize("offset", [-40, 25, 60])
def test_brightness_changes_nothing(recipe, offset):
    grey = soft()
    brighter = (grey.astype(int) + offset).astype(np.uint8)
    plain, other = (channels_of(each, everywhere(grey), recipe) for each in (grey, brighter))
    np.testing.assert_allclose(other, plain, atol=2e-3)


def test_the_sign_of_contrast_is_seen_by_grey_only(recipe):
    grey = soft()
    plain = channels_of(grey, everywhere(grey), recipe)
    turned = channels_of(255 - grey, everywhere(grey), recipe)
    np.testing.assert_allclose(turned[..., GRADIENT], plain[..., GRADIENT], atol=2e-3)
    np.testing.assert_allclose(turned[..., GREY], -plain[..., GREY], atol=2e-3)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_gradients_turn_with_the_picture(recipe, quarters):
    """A quarter turn adds 180 degrees to a doubled direction."""
    grey = soft()
    picture = np.ascontiguousarray(np.rot90(grey, quarters))
    turned = channels_of(picture, everywhere(picture), recipe)
    plain = np.rot90(channels_of(grey, everywhere(grey), recipe), quarters)
    sign = np.array([-1, -1, 1, 1.0]) if quarters % 2 else np.ones(4)
    np.testing.assert_allclose(turned, plain * sign, atol=2e-3)


def test_what_is_not_valid_is_zero(recipe):
    valid = with_holes((120, 150))
    out = channels_of(soft(), valid, recipe)
    assert not out[~valid].any()
    assert set(np.unique(out[..., 3])) == {0.0, 1.0}
    assert not out[out[..., 3] == 0].any()  # the border of what is valid does not count either
    lost = valid & (out[..., 3] == 0)
    assert lost.any() and not cv2.erode(lost.astype(np.uint8), np.ones((7, 7))).any()


@pytest.mark.parametrize("paint", [0, 255, "noise"])
def test_pixels_that_are_not_valid_do_not_leak(recipe, paint):
    grey, valid = soft(), with_holes((120, 150))
    noise = np.random.default_rng(1).integers(0, 256, grey.shape)
    painted = np.where(valid, grey, noise if paint == "noise" else paint).astype(np.uint8)
    assert (
        channels_of(painted, valid, recipe).tobytes() == channels_of(grey, valid, recipe).tobytes()
    )
