"""How far a place stands out: alone on ground of its own, not among rows."""

import cv2
import numpy as np
import pytest

from orthonav.core.register.channels import FINE
from orthonav.core.register.pose import Pose
from orthonav.core.register.sharpness import sharpness
from orthonav.core.register.template import Template
from orthonav.core.register.window import Reference

SIDE, VIEW = 240, 96


class Flat:
    """One level of grey (H, W), all valid."""

    levels = 1

    def __init__(self, grey):
        self.grey = grey

    def shape(self, level):
        return self.grey.shape

    def read(self, level, row, col, height, width):
        part = self.grey[row : row + height, col : col + width]
        return part, np.ones(part.shape, np.bool_)


def seen(grey, rng, off_px=0.0):
    """The middle of a picture (H, W) with noise, placed `off_px` beside where it is."""
    first = (SIDE - VIEW) // 2
    view = grey[first : first + VIEW, first : first + VIEW] + rng.normal(0, 12, (VIEW, VIEW))
    view = np.clip(view, 0, 255).astype(np.uint8)
    template = Template.of(view, np.ones(view.shape, np.bool_), 0, FINE)
    reference = Reference(Flat(grey.astype(np.uint8)))
    return sharpness(template, reference, Pose(SIDE / 2 + off_px, SIDE / 2, 0.0, 0.0))


@pytest.fixture
def ground(rng):
    smooth = cv2.GaussianBlur(rng.normal(0, 1, (SIDE, SIDE)), (0, 0), 2.5)
    return np.clip(128 + 40 * smooth / smooth.std(), 0, 255)


@pytest.fixture
def rng():
    return np.random.default_rng(4)


def test_a_place_of_its_own_stands_out(ground, rng):
    found = seen(ground, rng)
    assert found.ratio > 2 and found.gradients > 6 and found.phase > 10


def test_a_wrong_place_does_not(ground, rng):
    found = seen(ground, rng, off_px=25.0)
    assert found.ratio < 1.2 and found.gradients < 5 and found.phase < 5


def test_rows_do_not(rng):
    """Rows 7 px apart along both axes: as good a little aside."""
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    lattice = 128 + 50 * np.sin(2 * np.pi * x / 7) + 50 * np.sin(2 * np.pi * y / 7)
    found = seen(lattice, rng)
    assert found.ratio < 1.2 and found.gradients < 4
