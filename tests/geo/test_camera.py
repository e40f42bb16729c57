"""The camera: conventions by hand, projection against OpenCV, the homography against rays."""

import json
import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from orthonav.core.errors import CameraError
from orthonav.core.geo.camera import (
    Camera,
    camera_from_en,
    distort,
    enu_from_camera,
    footprint_en_m,
    ground_en_m,
)

CAMERA = Camera(640, 480, 500.0, 510.0, 321.5, 238.0)
yaws, tilts = st.floats(-360, 360), st.floats(-25, 25)
coefficients = st.tuples(
    st.floats(-0.1, 0.1), st.floats(-0.05, 0.05), *[st.floats(-0.01, 0.01)] * 2
)


def px_from_en(camera, yaw_deg, pitch_deg, roll_deg, agl_m, points_en_m):
    """Ours: pixel-is-area coordinates of ground points, through the homography and the lens."""
    ground = np.column_stack([points_en_m, np.ones(len(points_en_m))])
    axes = ground @ camera_from_en(yaw_deg, pitch_deg, roll_deg, agl_m).T
    plane = distort(camera, axes[:, :2] / axes[:, 2:])
    return np.column_stack([plane, np.ones(len(plane))]) @ camera.matrix[:2].T


@given(
    yaws, tilts, tilts, st.floats(30, 500), st.just(()) | coefficients, st.integers(0, 2**32 - 1)
)
def test_projection_is_that_of_opencv(yaw, pitch, roll, agl_m, distortion, seed):
    camera = Camera(640, 480, 500.0, 510.0, 321.5, 238.0, distortion)
    points = np.random.default_rng(seed).uniform(-agl_m / 3, agl_m / 3, (10, 2))
    enu = np.column_stack([points, np.full(10, -agl_m)])
    rotation = Rotation.from_matrix(enu_from_camera(yaw, pitch, roll).T).as_rotvec()
    expected, _ = cv2.projectPoints(
        enu, rotation, np.zeros(3), camera.matrix, np.array(distortion or (0.0,) * 4)
    )
    ours = px_from_en(camera, yaw, pitch, roll, agl_m, points)
    np.testing.assert_allclose(ours, expected[:, 0], atol=1e-6)


@given(yaws, st.floats(-15, 15), st.floats(-15, 15), st.floats(10, 3000))
def test_footprint_projects_to_the_image_corners(yaw, pitch, roll, agl_m):
    ground = footprint_en_m(CAMERA, yaw, pitch, roll, agl_m)
    corners = [[0, 0], [640, 0], [640, 480], [0, 480]]
    seen = px_from_en(CAMERA, yaw, pitch, roll, agl_m, ground)
    np.testing.assert_allclose(seen, corners, atol=1e-6)


@pytest.mark.parametrize("pitch, roll", [(70, 0), (0, -75), (120, 0), (0, 180)])
def test_a_view_of_the_horizon_has_no_footprint(pitch, roll):
    with pytest.raises(CameraError, match="horizon"):
        footprint_en_m(CAMERA, 0, pitch, roll, 100)


GOOD = {"width_px": 640, "height_px": 480, "fx_px": 500, "fy_px": 500, "cx_px": 320, "cy_px": 240}


@pytest.mark.parametrize(
    "change, message",
    [
        ({"width_px": 0}, "width_px and height_px must be"),
        ({"height_px": 65_536}, "height_px must be"),
        ({"width_px": math.nan}, "width_px and height_px must be"),
        ({"fx_px": 0}, "focal length"),
        ({"fy_px": -500}, "focal length"),
        ({"fx_px": math.inf}, "not finite"),
        ({"cx_px": math.nan}, "not finite"),
        ({"distortion": (0.1, math.nan, 0, 0)}, "not finite"),
        ({"distortion": (0.1,)}, "k1,k2,p1,p2"),
        ({"distortion": (0.1,) * 8}, "k1,k2,p1,p2"),
        ({"distortion": (0.1,) * 5, "model": "fisheye"}, "k1,k2,k3,k4"),
        ({"model": "omni"}, "brown or fisheye"),
        ({"width_px": 640.5}, "width_px and height_px must be whole"),
        ({"fx_px": 8.8, "fy_px": 8.8}, "focal length 8.8 px is 0.014 widths"),
        ({"fx_px": 64_899, "fy_px": 64_899}, "focal length 64899 px"),
        ({"cx_px": 0.5, "cy_px": 0.5}, "principal point 0.5, 0.5 px is 50% of a side"),
        ({"fx_px": 5000, "fy_px": 5000, "cx_px": 11_448}, "principal point 11448, 240 px"),
        ({"cx_px": 480, "cy_px": 320}, "principal point"),
        ({"fy_px": 650}, "500 and 650 px differ by 23%"),
    ],
)
def test_impossible_cameras_are_refused(change, message):
    with pytest.raises(CameraError, match=message):
        Camera(**(GOOD | change)).plausible()


@pytest.mark.parametrize("change", [{"cx_px": 0.5}, {"fy_px": 650}, {"fx_px": 50, "fy_px": 50}])
def test_unusual_cameras_are_stated(change, tmp_path):
    """A crop, a shifted lens, pixels that are not square; remembered in files and other sizes."""
    with pytest.raises(CameraError, match='"unusual": true'):
        Camera(**(GOOD | change)).plausible()
    camera = Camera(**(GOOD | change), unusual=True)
    plain = {"camera": json.loads(json.dumps(camera.numbers()))}
    (tmp_path / "flight.json").write_text(json.dumps(plain))
    assert Camera.from_file(tmp_path / "flight.json") == camera
    assert camera.fitted(320, 240).unusual and "unusual" not in Camera(**GOOD).numbers()


def test_every_size_of_a_picture_has_a_camera():
    camera = Camera(4000, 3000, 0.3001 * 4000, 0.3001 * 4000, 2395, 1795)
    for width in (4000, 1333, 333, 64, 31):
        assert camera.resized(width, round(width * 0.75)).width_px == width


def test_fields_of_view():
    across = Camera.from_fov(84, 1280, 960, diagonal=True)
    assert across.fx_px == pytest.approx(math.hypot(1280, 960) / 2 / math.tan(math.radians(42)))
    square = Camera.from_fov(90.0, 1280, 960)
    assert square.fx_px == pytest.approx(640) and square.cx_px == 640 and square.focal_std > 0
    for wrong in (0.0, 180.0, math.nan, 1.13, None, "65"):
        said = r"64\.7 if these are radians" if wrong == 1.13 else "field of view"
        with pytest.raises(CameraError, match=said):
            Camera.from_fov(wrong, 1280, 960)
    with pytest.raises(CameraError, match="size must be numbers, got '1280', 960"):
        Camera.from_fov(65, "1280", 960)
    whole = Camera.from_fov(65, 1280.0, 960.0)
    assert type(whole.width_px) is int and whole == Camera.from_fov(65, 1280, 960)


def test_matrices_that_are_not_those_of_opencv():
    matrix = np.array([[500.0, 0, 319.5], [0, 500, 239.5], [0, 0, 1]])
    assert Camera.from_matrix(matrix, None, (640, 480)).cx_px == 320.0
    transposed = r"transposed \(its last row is 319.5, 239.5, 1\)"
    refused = [(np.eye(2), r"\(3, 3\)"), (matrix.T, transposed)]
    for row, col in ((0, 1), (1, 0), (2, 0)):
        other = matrix.copy()
        other[row, col] = 3.0
        refused.append((other, "without skew"))
    for other, message in refused:
        with pytest.raises(CameraError, match=message):
            Camera.from_matrix(other, None, (640, 480))
    for size in (640, (640, 480, 3)):
        with pytest.raises(CameraError, match="size_px must be width and height"):
            Camera.from_matrix(matrix, None, size)
    with pytest.raises(CameraError, match="must be numbers"):
        Camera.from_matrix(matrix, "k1", (640, 480))


@given(yaws, tilts, tilts, st.floats(30, 500), st.just(()) | coefficients)
def test_ground_points_project_back(yaw, pitch, roll, agl_m, distortion):
    camera = Camera(640, 480, 500.0, 510.0, 321.5, 238.0, distortion)
    px = np.array([[320.0, 240.0], [200.0, 100.0], [450.0, 380.0]])
    ground = ground_en_m(camera, px, yaw, pitch, roll, agl_m)
    assert px_from_en(camera, yaw, pitch, roll, agl_m, ground) == pytest.approx(px, abs=1e-3)
