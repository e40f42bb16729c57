"""Odometry over a plane that is not level, against its exact geometry."""

import math

import numpy as np
import pytest

from orthonav.localizer.odometry import ViewDisplacement, over_terrain
from orthonav.track import CameraDisplacement

AGL_M = 200.0


def as_measured(moved_m, slope):
    """What registration of one view on the other measures: the similarity (turn, log scale) between
    both as rectified for level ground at height `AGL_M`."""
    at = np.stack(np.meshgrid(*[np.linspace(-100, 100, 21)] * 2), -1).reshape(-1, 2)
    places = np.array([[0.0, 0.0], moved_m])
    # Depth of the ground below the camera, which flies at a constant altitude.
    points = at + np.array(moved_m) / 2
    depth = AGL_M - points @ slope
    before, now = ((points - place) * (AGL_M / depth)[:, None] for place in places)
    x, y = (now - now.mean(axis=0)).T
    rows = np.concatenate([np.stack([x, y], -1), np.stack([y, -x], -1)])  # clockwise turns
    target = (before - before.mean(axis=0)).T.reshape(-1)
    (c, s), *_ = np.linalg.lstsq(rows, target, rcond=None)
    return math.atan2(s, c), math.log(math.hypot(c, s))


@pytest.mark.parametrize("slope", [(0.2, 0.0), (0.0, 0.2), (-0.15, 0.1)])
def test_parallax_of_a_slope_is_no_turn_and_no_climb(slope):
    moved_m, slope = np.array([30.0, 20.0]), np.array(slope)
    turned, scaled = as_measured(moved_m, slope)
    seen = CameraDisplacement(moved_m, np.eye(2), 100.0, turned, scaled)
    there = AGL_M - float(moved_m @ slope)
    known = over_terrain(ViewDisplacement(seen, 0.8), (AGL_M, AGL_M), slope).displacement
    # The reported height is the same at both, so the bias takes what the ground rises.
    assert known.scaled == pytest.approx(math.log(there / AGL_M), abs=0.006)
    assert abs(known.turned_rad) < 0.15 * abs(turned) + 0.001
    # Reported heights that follow the ground leave the bias as it is.
    follows = CameraDisplacement(
        moved_m, np.eye(2), 100.0, turned, scaled - math.log(there / AGL_M)
    )
    left = over_terrain(ViewDisplacement(follows, 0.8), (AGL_M, there), slope).displacement
    assert left.scaled == pytest.approx(0.0, abs=0.006)
    unknown = over_terrain(ViewDisplacement(seen, 0.8), (AGL_M, AGL_M), None).displacement
    assert (unknown.turned_rad, unknown.scaled) == pytest.approx((turned, scaled))
    assert unknown.scaled_std > known.scaled_std > seen.scaled_std
