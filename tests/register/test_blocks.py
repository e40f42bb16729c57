"""Blocks of a view that were displaced are found where they are."""

import math

import numpy as np
import pytest
from scenes import Ground, as_grey, pixel_centres, reference_of, templates_of

from orthonav.core.register.blocks import block_scores
from orthonav.core.register.pose import Pose
from orthonav.core.register.template import BLOCKS, ViewTemplates

GROUND = Ground(px=(5.0, 40.0))
SHAPE, REACH_PX = (120, 150), 7


@pytest.fixture(scope="module")
def reference():
    return reference_of(GROUND, (320, 384))


def field(x, y):
    """How far the ground seen at x, y from the middle of the window lies right and down of it."""
    return 4.0 * x / 75 + 2.0 * y / 60, -3.0 * y / 60 + 1.0


def displaced(pose):
    """A view whose pixels show the ground a little aside, by `field` in the axes of the window."""
    x, y = pixel_centres(SHAPE)
    x, y = np.broadcast_arrays(x - SHAPE[1] / 2, y - SHAPE[0] / 2)
    right, down = field(x, y)
    at = pose.map_px(np.stack([x + right, y + down], axis=-1))
    return ViewTemplates(as_grey(GROUND(at[..., 0], at[..., 1])), np.ones(SHAPE, bool), 0)


def peaks_px(scores):
    """Right and down (N, 2) of the best displacement of each block, to a fraction of a pixel."""
    found = []
    for surface in scores.correlations:
        row, col = np.unravel_index(surface[1:-1, 1:-1].argmax(), np.array(surface.shape) - 2)
        part = surface[row : row + 3, col : col + 3]
        off = [
            (after - before) / (4 * part[1, 1] - 2 * (after + before))
            for before, after in ((part[1, 0], part[1, 2]), (part[0, 1], part[2, 1]))
        ]
        found.append([col + 1 + off[0], row + 1 + off[1]])
    return np.array(found) - scores.correlations.shape[1] // 2


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("turn_rad", [0.0, math.pi / 2, 2.4])
def test_displacements_have_the_right_sign_and_scale(reference, level, turn_rad):
    pose = Pose(190.0, 160.0, turn_rad, 0.06)
    scores = block_scores(displaced(pose).at(level), reference, pose, REACH_PX)
    assert scores.correlations.shape == (BLOCKS**2, 15, 15)
    middles = scores.middles_px * 2.0**level
    expected = np.stack(field(*middles.T), axis=-1) / 2.0**level
    assert np.abs(expected).max() > 3.0 / 2**level
    np.testing.assert_allclose(peaks_px(scores), expected, atol=0.35)
    assert scores.correlations.max(axis=(1, 2)).min() > 0.5


def test_blocks_lie_where_their_middles_say(reference):
    """Row by row, x to the right: blocks of a view whose upper right part is invalid do not
    count."""
    valid = np.ones(SHAPE, bool)
    valid[: SHAPE[0] // 2, SHAPE[1] // 2 :] = False
    pose = Pose(190.0, 160.0, 0.4, 0.0)
    scores = block_scores(templates_of(GROUND, pose, SHAPE, valid).at(0), reference, pose, 3)
    x, y = scores.middles_px.T
    left_out = (x > 0) & (y < 0)
    assert left_out.sum() == 9
    assert (scores.pixels[left_out] == 0).all() and (scores.correlations[left_out] == 0).all()
    assert (scores.pixels[~left_out] > 0).all()
    assert scores.correlations[~left_out, 3, 3].min() > 0.85


def test_blocks_beside_the_map_do_not_count(reference):
    pose = Pose(0.0, 160.0, 0.0, 0.0)
    scores = block_scores(templates_of(GROUND, pose, SHAPE).at(0), reference, pose, 3)
    assert ((scores.pixels > 0) == (scores.middles_px[:, 0] > 0)).all()
