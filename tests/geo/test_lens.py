"""Lens models against OpenCV, there and back; what no lens can see is not a number."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.core.geo.camera import Camera, attitude_of, distort, enu_from_camera, undistort

PLANE = np.stack(np.meshgrid(np.linspace(-0.6, 0.6, 13), np.linspace(-0.5, 0.5, 11)), axis=-1)
BROWN = [(-0.28, 0.09, 1e-3, -5e-4), (0.12, 0.02, -2e-3, 1e-3, 0.01), (-0.1, 0, 0, 0)]
FISHEYE = [(), (0.02, -0.01, 0.003, -0.001), (-0.05, 0.01, 0, 0), (0.1, 0.05, 0.02, 0.01)]


def camera(distortion, model="brown"):
    return Camera(640, 480, 300.0, 310.0, 320.0, 240.0, distortion, model)


@pytest.mark.parametrize("numbers", BROWN)
def test_brown_is_that_of_opencv_there_and_back(numbers):
    lens = camera(numbers)
    seen = distort(lens, PLANE)
    np.testing.assert_allclose(undistort(lens, seen), PLANE, atol=1e-9)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    given = seen.reshape(-1, 1, 2), np.eye(3), np.array(numbers)
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4; in 5 the function below does both
        expected = cv2.undistortPointsIter(*given, None, None, criteria)
    else:
        expected = cv2.undistortPoints(*given, None, None, None, criteria)
    np.testing.assert_allclose(undistort(lens, seen).reshape(-1, 2), expected[:, 0], atol=1e-6)


@pytest.mark.parametrize("numbers", FISHEYE)
def test_fisheye_is_that_of_opencv_there_and_back(numbers):
    lens, four = camera(numbers, "fisheye"), np.array(numbers or (0.0,) * 4)
    wide = PLANE * 4
    seen = distort(lens, wide)
    there = cv2.fisheye.distortPoints(wide.reshape(-1, 1, 2), np.eye(3), four)
    known = np.isfinite(seen[..., 0])
    assert known.mean() > 0.9
    np.testing.assert_allclose(seen[known], there.reshape(seen.shape)[known], atol=1e-9)
    np.testing.assert_allclose(undistort(lens, seen)[known], wide[known], rtol=1e-7, atol=1e-9)
    near = distort(lens, PLANE)
    back = cv2.fisheye.undistortPoints(near.reshape(-1, 1, 2), np.eye(3), four)
    np.testing.assert_allclose(undistort(lens, near).reshape(-1, 2), back[:, 0], atol=1e-6)


@given(
    st.tuples(*[st.floats(-0.15, 0.15)] * 4),
    st.sampled_from(["brown", "fisheye"]),
    st.floats(0, 2 * math.pi),
    st.floats(0, 1.5),
)
def test_what_is_distorted_comes_back(numbers, model, direction, radius):
    small = (numbers[0], numbers[1], numbers[2] / 100, numbers[3] / 100)
    lens = camera(numbers if model == "fisheye" else small, model)
    point = radius * np.array([[math.cos(direction), math.sin(direction)]])
    seen = distort(lens, point)
    if np.isnan(seen).any():
        return
    back = undistort(lens, seen)
    # Where the model is about to fold back a point and its image hardly tell of each other.
    slope = np.abs(distort(lens, point * 1.001) - seen).max() / max(0.001 * radius, 1e-12)
    if radius < 1e-6 or slope > 0.05:
        np.testing.assert_allclose(back, point, atol=1e-5)


@pytest.mark.parametrize(
    "numbers, model, fold",
    [
        ((-0.5, 0, 0, 0), "brown", math.sqrt(1 / 1.5)),
        ((-0.5, 0.05, 0, 0), "brown", math.sqrt(3 - math.sqrt(5))),  # it grows again from 2.3 on
        ((-0.4, 0, 0, 0), "fisheye", math.tan(math.sqrt(1 / (3 * 0.4)))),
    ],
)
def test_beyond_the_fold_there_is_nothing(numbers, model, fold):
    lens = camera(numbers, model)
    points = np.array([[0.99 * fold, 0.0], [1.01 * fold, 0.0], [20 * fold, 0.0]])
    assert np.isfinite(distort(lens, points)[:, 0]).tolist() == [True, False, False]
    most = distort(lens, points)[0, 0]
    back = undistort(lens, np.array([[0.9 * most, 0.0], [1.1 * most, 0.0], [3.0, 1.0]]))
    assert np.isfinite(back[:, 0]).tolist() == [True, False, False]


def test_nothing_behind_the_camera_is_made_up():
    """Equidistant: 90 degrees off the axis is at a distance of pi / 2."""
    seen = np.array([[math.pi / 2 - 0.01, 0.0], [math.pi / 2 + 0.01, 0.0]])
    assert np.isfinite(undistort(camera((), "fisheye"), seen)[:, 0]).tolist() == [True, False]


@given(st.floats(0, 359.9), st.floats(-89, 89), st.floats(-179, 179))
def test_angles_of_a_rotation_come_back(yaw, pitch, roll):
    again = attitude_of(enu_from_camera(yaw, pitch, roll))
    there = enu_from_camera(yaw, pitch, roll)
    np.testing.assert_allclose(enu_from_camera(*again), there, atol=1e-9)
    assert again[1:] == pytest.approx((pitch, roll), abs=1e-6)
    assert (again[0] - yaw + 180) % 360 - 180 == pytest.approx(0, abs=1e-6)
