"""Candidates from tiles: the pose between those that were tried, and only within the prior."""

import math

import numpy as np
import pytest

from orthonav.core.localize.tiles import peak_poses
from orthonav.core.register.search import bank

STEP_RAD, SCALE_STEP = math.radians(8.0), 0.13


def scores_around(poses, turn_rad, log_scale):
    """A smooth peak at a pose."""
    turned = np.remainder(poses[:, 0] - turn_rad + np.pi, 2 * np.pi) - np.pi
    scaled = poses[:, 1] - log_scale
    return (1 - (turned / STEP_RAD) ** 2 / 8 - (scaled / SCALE_STEP) ** 2 / 8).astype(np.float32)


@pytest.mark.parametrize("turn_std_rad", [0.3, None])
@pytest.mark.parametrize("turn_deg, log_scale", [(0.0, 0.0), (3.1, -0.05), (-2.5, 0.06)])
def test_a_pose_lies_between_those_that_were_tried(turn_std_rad, turn_deg, log_scale):
    made = bank(turn_std_rad, 0.1, turn_step_rad=STEP_RAD, scale_step=SCALE_STEP, sigmas=3.0)
    poses = np.array(made)
    scores = scores_around(poses, math.radians(turn_deg), log_scale)
    found, first = peak_poses(
        poses, np.stack([scores, scores_around(poses, 0.0, 0.0)]), np.ones(len(poses), np.float32)
    )
    np.testing.assert_allclose(first, 0.0, atol=1e-3)
    assert abs(math.remainder(found[0] - math.radians(turn_deg), 2 * math.pi)) < 1e-3
    assert found[1] == pytest.approx(log_scale, abs=1e-3)


def test_at_the_rim_of_what_was_tried_it_is_the_pose_tried():
    poses = np.array([(0.0, 0.0), (STEP_RAD, 0.0)])
    assert not peak_poses(poses, np.float32([[1.0, 0.9]]), np.ones(2, np.float32)).any()
    assert not peak_poses(poses[:1], np.float32([[0.5]]), np.ones(1, np.float32)).any()
