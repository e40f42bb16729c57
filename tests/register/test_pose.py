"""The similarity between a view and the map: its conventions and its small steps."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.core.register.window import Pose

poses = st.builds(
    Pose,
    st.floats(-500, 500),
    st.floats(-500, 500),
    st.floats(-math.pi, math.pi),
    st.floats(-0.4, 0.4),
)
steps = st.tuples(*(st.floats(-0.2, 0.2) for _ in range(4))).map(np.array)


@pytest.mark.parametrize(
    "heading_deg, top_xy, right_xy",
    [
        (0, (0, -1), (1, 0)),  # north up: the top to the north, where y falls
        (90, (1, 0), (0, 1)),
        (180, (0, 1), (-1, 0)),
        (-90, (-1, 0), (0, -1)),
    ],
)
def test_the_top_of_the_window_points_to_the_heading(heading_deg, top_xy, right_xy):
    pose = Pose(100.0, 200.0, math.radians(heading_deg), math.log(2.0))
    seen = pose.map_px(np.array([[0.0, -10.0], [10.0, 0.0], [0.0, 0.0]]))
    expected = np.array([top_xy, right_xy, (0, 0)]) * 20.0 + [100, 200]
    np.testing.assert_allclose(seen, expected, atol=1e-9)


@given(poses, steps)
def test_a_step_is_undone_by_the_inverse_of_its_similarity(pose, step):
    """To first order: what the window would show after a step is where it was before."""
    small = step * 1e-3
    point = np.array([3.0, -7.0])
    turn, grow = float(small[2]), float(small[3])
    stepped = point + small[:2] + turn * np.array([-point[1], point[0]]) + grow * point
    back = pose.stepped(small).map_px(stepped)
    np.testing.assert_allclose(back, pose.map_px(point), atol=1e-4)
