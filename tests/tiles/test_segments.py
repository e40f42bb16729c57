"""Boundaries of a graph-based segmentation: the contract of representations, and known pictures."""

import sys

import cv2
import numpy as np
import pytest
from pictures import everywhere, frozen, picture

from orthonav.core.errors import MissingExtraError
from orthonav.core.variants import Variant
from orthonav.research.segments import Segments

TABLE = {"segments": Variant("orthonav.research.segments:Segments", extra="segments")}


def fields(levels=(60, 110, 170, 220), size=96, noise=4.0, seed=0):
    """Four fields of `levels` that meet in the middle, with a little noise."""
    grey = np.repeat(np.repeat(np.reshape(levels, (2, 2)), size // 2, 0), size // 2, 1)
    grey = grey + np.random.default_rng(seed).normal(0, noise, grey.shape)
    return frozen(grey.clip(0, 255).astype(np.uint8))


def drawn(grey, **parameters):
    return Segments(**parameters)(grey, everywhere(grey))[0]


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


def test_small_regions_are_joined():
    """A spot of 5 x 5 px is a region of its own only where regions so small may stay."""
    grey = np.full((64, 64), 90, np.uint8)
    grey[30:35, 30:35] = 250
    assert drawn(grey, sigma=0.0, min_size=20).any()
    assert not drawn(grey, sigma=0.0, min_size=26).any()


def test_without_the_library_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage.segmentation", None)
    with pytest.raises(MissingExtraError, match=r"orthonav\[segments\]"):
        drawn(picture())
