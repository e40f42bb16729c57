"""Boundaries of a graph-based segmentation: the contract of representations, and known pictures."""

import dataclasses
import json
import pickle
import sys

import cv2
import numpy as np
import pytest

from orthonav.core.errors import MissingExtraError, VariantError
from orthonav.core.variants import Variant, make_variant, variant_from_recipe, variant_recipe
from orthonav.research.segments import Segments, boundaries

TABLE = {"segments": Variant("orthonav.research.segments:Segments", extra="segments")}
SHAPES = [(1, 1), (1, 40), (40, 1), (2, 3), (16, 16), (33, 47), (128, 127)]


def frozen(array):
    array.flags.writeable = False
    return array


def picture(shape=(96, 96), seed=0, blur=1.5):
    """Blurred noise over the whole range of grey levels, read-only."""
    noise = np.random.default_rng(seed).normal(size=shape).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), blur).reshape(shape)
    return frozen(cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8))


def fields(levels=(60, 110, 170, 220), size=96, noise=4.0, seed=0):
    """Four fields of `levels` that meet in the middle, with a little noise."""
    grey = np.repeat(np.repeat(np.reshape(levels, (2, 2)), size // 2, 0), size // 2, 1)
    grey = grey + np.random.default_rng(seed).normal(0, noise, grey.shape)
    return frozen(grey.clip(0, 255).astype(np.uint8))


def everywhere(grey):
    return frozen(np.ones(grey.shape, dtype=bool))


def drawn(grey, **parameters):
    return Segments(**parameters)(grey, everywhere(grey))[0]


@pytest.mark.parametrize("shape", SHAPES)
def test_shape_dtype_and_binary(shape):
    out = Segments()(picture(shape).reshape(shape), np.ones(shape, bool))
    assert out.shape == (Segments().channels, *shape) and out.dtype == np.float32
    assert set(np.unique(out)) <= {0.0, 1.0}


def test_an_image_gives_a_nonzero_result():
    assert 0.05 < drawn(picture()).mean() < 0.7


def test_deterministic_and_inputs_untouched():
    grey = picture()
    first, second = drawn(grey), drawn(grey.copy())
    assert first.tobytes() == second.tobytes()
    np.testing.assert_array_equal(grey, picture())


def test_views_into_larger_pictures_are_taken():
    window = picture((200, 200))[10:106:2, 7:103]
    np.testing.assert_array_equal(drawn(window), drawn(window.copy()))


@pytest.mark.parametrize("level", [0, 1, 128, 255])
def test_blank_has_no_boundaries(level):
    assert not drawn(np.full((40, 41), level, np.uint8)).any()


@pytest.mark.parametrize("shape", SHAPES)
def test_nothing_valid_is_zero(shape):
    assert not Segments()(picture(shape).reshape(shape), np.zeros(shape, dtype=bool)).any()


def test_masked_pixels_are_zero_and_have_no_influence():
    grey = picture((128, 128))
    valid = everywhere(grey).copy()
    valid[40:90, 50:] = False
    valid[3, 3] = False
    painted = np.where(valid, grey, 255).astype(np.uint8)
    out, other = Segments()(grey, frozen(valid)), Segments()(painted, valid)
    assert not out[:, ~valid].any() and out.any()
    np.testing.assert_array_equal(out, other)


@pytest.mark.parametrize("sigma", [0.5, 1.5, 4.0])
def test_the_border_of_the_valid_area_is_no_boundary(sigma):
    """The left half is not valid: only where the right fields meet may a boundary be drawn."""
    grey = fields()
    valid = everywhere(grey).copy()
    valid[:, :48] = False
    out = Segments(sigma=sigma)(grey, valid)[0]
    rows, _ = np.nonzero(out)
    assert len(rows) and np.abs(rows - 47.5).max() <= 1 + 3 * sigma


def test_known_fields_give_their_borders():
    """Four fields: boundaries follow the cross between them, both sides of its blurred ramp."""
    expected = np.zeros((96, 96), bool)
    expected[47:49] = expected[:, 47:49] = True
    out = drawn(fields()) > 0
    near = cv2.dilate(expected.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert not out[~near].any()
    reached = cv2.dilate(out.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert reached[expected].mean() > 0.98


def test_without_noise_or_smoothing_borders_are_exact():
    expected = np.zeros((96, 96), bool)
    expected[47:49] = expected[:, 47:49] = True
    np.testing.assert_array_equal(drawn(fields(noise=0), sigma=0.0) > 0, expected)


@pytest.mark.parametrize("shift", [-40, 25])
def test_brightness_does_not_matter(shift):
    grey = np.clip(picture((128, 128)), 60, 200)
    first, second = drawn(grey) > 0, drawn((grey + np.int16(shift)).astype(np.uint8)) > 0
    assert (first & second).sum() > 0.97 * (first | second).sum() > 100


def test_the_negative_has_the_same_boundaries():
    grey = fields()
    first, second = drawn(grey) > 0, drawn(255 - grey) > 0
    assert (first & second).sum() > 0.9 * (first | second).sum() > 100


def test_larger_scale_draws_less():
    grey = picture()
    assert drawn(grey, scale=20.0).sum() > 1.2 * drawn(grey, scale=1000.0).sum() > 0


def test_small_regions_are_joined():
    """A spot of 5 x 5 px is a region of its own only where regions so small may stay."""
    grey = np.full((64, 64), 90, np.uint8)
    grey[30:35, 30:35] = 250
    assert drawn(grey, sigma=0.0, min_size=20).any()
    assert not drawn(grey, sigma=0.0, min_size=26).any()


def test_boundaries_are_both_sides_of_a_change():
    labels = np.array([[1, 1, 1, 2], [1, 1, 1, 2], [1, 1, 1, 2], [3, 3, 3, 3]])
    expected = np.array([[0, 0, 1, 1], [0, 0, 1, 1], [1, 1, 1, 1], [1, 1, 1, 1]], bool)
    np.testing.assert_array_equal(boundaries(labels), expected)
    np.testing.assert_array_equal(boundaries(labels[::-1, ::-1]), expected[::-1, ::-1])


def test_is_a_frozen_value():
    variant = Segments(scale=50.0)
    again = pickle.loads(pickle.dumps(variant))
    assert again == variant != Segments() and hash(again) == hash(variant)
    for field in dataclasses.fields(variant):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(variant, field.name, 1)


def test_recipe_round_trip():
    variant = make_variant(TABLE, "segments:scale=80,sigma=0.8,min_size=12")
    assert variant == Segments(80.0, 0.8, 12)
    recipe = json.loads(json.dumps(variant_recipe(TABLE, variant)))
    assert variant_from_recipe(TABLE, recipe) == variant


def test_margin_grows_with_the_smoothing():
    assert 0 < Segments(sigma=0.0).margin_px < Segments(sigma=8.0).margin_px < 128


@pytest.mark.parametrize("text", ["scale=0", "scale=-1", "sigma=-0.1", "sigma=17", "min_size=0"])
def test_impossible_parameters_are_refused(text):
    with pytest.raises(VariantError, match=f"segments {text.partition('=')[0]}"):
        make_variant(TABLE, f"segments:{text}")


def test_without_the_library_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage.segmentation", None)
    with pytest.raises(MissingExtraError, match=r"orthonav\[segments\]"):
        drawn(picture())
