"""Angles of other makers, by where the camera looks and where the top of its image points."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from orthonav.core.geo.attitude import (
    enu_from_body_camera,
    enu_from_gimbal_camera,
    enu_from_ros_camera,
    matrices_of_wxyz,
    ned_from_angles,
    ned_wxyz_from_ros,
    ros_xyzw_from_ned,
    rotations_of_wxyz,
    slerp,
    wxyz_of_angles,
    wxyz_of_matrices,
)
from orthonav.core.geo.camera import attitude_of, enu_from_camera

angles = st.floats(-180, 180)


def sight(enu_from_camera_):
    """Directions in ENU of the optical axis and of the top of the image."""
    return enu_from_camera_[:, 2], -enu_from_camera_[:, 1]


def level(heading_deg, up=0.0):
    """A direction at a compass heading and an angle above the horizon."""
    heading, rise = math.radians(heading_deg), math.radians(up)
    return [
        math.sin(heading) * math.cos(rise),
        math.cos(heading) * math.cos(rise),
        math.sin(rise),
    ]


quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)


def scipys(wxyz):
    return Rotation.from_quat(np.asarray(wxyz)[..., [1, 2, 3, 0]])


@given(st.lists(st.tuples(angles, angles, angles), min_size=1, max_size=3))
def test_rotations_of_angles_are_those_of_scipy(all_angles):
    expected = Rotation.from_euler("ZYX", all_angles, degrees=True).as_matrix()
    np.testing.assert_allclose(ned_from_angles(all_angles), expected, atol=1e-12)
    made = wxyz_of_angles(np.radians(all_angles))
    np.testing.assert_allclose(scipys(made).as_matrix(), expected, atol=1e-12)


@given(st.lists(quaternions, min_size=1, max_size=3))
def test_quaternions_are_those_of_scipy(wxyz):
    expected = scipys(wxyz).as_matrix()
    np.testing.assert_allclose(matrices_of_wxyz(wxyz), expected, atol=1e-12)
    found = wxyz_of_matrices(expected)
    np.testing.assert_allclose(scipys(found).as_matrix(), expected, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)


@pytest.mark.parametrize("wxyz", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
def test_half_turns_have_their_quaternion(wxyz):
    np.testing.assert_allclose(wxyz_of_matrices(matrices_of_wxyz(wxyz)), wxyz, atol=1e-12)


@given(quaternions, quaternions, st.floats(0, 1))
def test_interpolation_is_that_of_scipy(before, after, weight):
    ends = np.array([before, after]) / np.linalg.norm([before, after], axis=1, keepdims=True)
    turns = scipys(ends)
    if (turns[0].inv() * turns[1]).magnitude() > 3.1:
        return  # half a turn: both ways are shortest
    expected = Slerp([0, 1], turns)(weight).as_matrix()
    np.testing.assert_allclose(matrices_of_wxyz(slerp(*ends, weight)), expected, atol=1e-6)


@given(angles, st.floats(-80, 80), angles)
def test_attitudes_of_ros_and_back(yaw, pitch, roll):
    ned = ned_from_angles([yaw, pitch, roll])
    back = ned_wxyz_from_ros(np.roll(ros_xyzw_from_ned(ned), 1))
    np.testing.assert_allclose(matrices_of_wxyz(back), ned, atol=1e-12)


@given(angles, st.floats(-90, 30))
def test_a_gimbal_looks_where_it_says(yaw, pitch):
    """DJI: yaw is a compass heading, pitch the angle above the horizon, both of the axis."""
    axis, top = sight(enu_from_gimbal_camera([yaw, pitch, 0.0]))
    np.testing.assert_allclose(axis, level(yaw, pitch), atol=1e-12)
    np.testing.assert_allclose(top, level(yaw, pitch + 90), atol=1e-12)


@given(angles, st.floats(-89, 30), st.floats(-20, 20))
def test_a_gimbals_roll_turns_the_picture_about_its_axis(yaw, pitch, roll):
    """Right-handed about the axis: with positive roll the top of the image tilts to the right."""
    straight, rolled = (enu_from_gimbal_camera([yaw, pitch, angle]) for angle in (0.0, roll))
    np.testing.assert_allclose(rolled[:, 2], straight[:, 2], atol=1e-12)
    right, top = straight[:, 0], -straight[:, 1]
    tilt = math.radians(roll)
    expected = math.cos(tilt) * top + math.sin(tilt) * right
    np.testing.assert_allclose(-rolled[:, 1], expected, atol=1e-12)


@given(angles, st.floats(-60, 60), st.floats(-60, 60))
def test_a_camera_that_looks_down_has_the_angles_of_the_body(yaw, pitch, roll):
    camera = enu_from_body_camera(ned_from_angles([yaw, pitch, roll]), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(camera, enu_from_camera(yaw, pitch, roll), atol=1e-12)


@pytest.mark.parametrize(
    "mount, axis, top",
    [
        ((0, 0, 0), [0, 0, -1], level(70)),
        ((90, 0, 0), [0, 0, -1], level(160)),  # top of the image to the right wing
        ((180, 0, 0), [0, 0, -1], level(250)),  # top of the image to the tail
        ((0, 90, 0), level(70), [0, 0, 1]),  # looks forward, top up
        ((0, 30, 0), level(70, -60), level(70, 30)),
        ((90, 90, 0), level(160), [0, 0, 1]),  # looks out of the right side
    ],
)
def test_mounts(mount, axis, top):
    """The camera in an aircraft that flies level at a heading of 70."""
    found = sight(enu_from_body_camera(ned_from_angles([70, 0, 0]), mount))
    np.testing.assert_allclose(found, [axis, top], atol=1e-12)


@pytest.mark.parametrize("ros_yaw, heading", [(0, 90), (90, 0), (180, 270), (-90, 180), (30, 60)])
def test_ros_counts_from_east_to_the_left(ros_yaw, heading):
    turn = Rotation.from_euler("Z", ros_yaw, degrees=True).as_matrix()
    axis, top = sight(enu_from_ros_camera(turn, (0.0, 0.0, 0.0)))
    np.testing.assert_allclose([axis, top], [[0, 0, -1], level(heading)], atol=1e-12)
    # REP 103: y to the left, so a positive turn about it lowers the nose; we look back then.
    down = turn @ Rotation.from_euler("Y", 10, degrees=True).as_matrix()
    found = attitude_of(enu_from_ros_camera(down, (0.0, 0.0, 0.0)))
    assert found == pytest.approx((heading % 360, -10, 0), abs=1e-9)


def test_invalid_rotations_are_rejected():
    wxyz = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [math.nan, 0, 0, 1], [0, 0, 0, 1.0]])
    turns, sound = rotations_of_wxyz(wxyz)
    assert sound.tolist() == [False, True, False, True]
    np.testing.assert_allclose(turns, [np.eye(3), np.diag([-1, -1, 1])], atol=1e-12)
    assert rotations_of_wxyz(wxyz[:1])[0].shape == (0, 3, 3)
