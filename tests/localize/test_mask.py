"""Parts of the picture that never show ground."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from orthonav.core.errors import CameraError
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.camera_files import masked
from orthonav.core.localize.view import (
    Orientation,
    check_view,
    downsampled,
    node_px,
    orthorectified,
    rectify_footprint,
)
from orthonav.core.records import Telemetry, View
from orthonav.onboard.motion import PictureOdometry

LENS = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
BARREL = replace(LENS, distortion=(-0.1, 0.01, 0.0, 0.0))
GEAR = np.full((480, 640), 255, np.uint8)
GEAR[300:, 200:420] = 0  # landing gear at the lower rim
TEXTURE = np.random.default_rng(2).integers(60, 200, (480, 640), np.uint8)
DOWN = Telemetry(0, 0.0, 2.0, -1.0, 100.0)


def pictures():
    """The same view with two different pictures behind the mask."""
    return [np.where(GEAR > 0, TEXTURE, fill).astype(np.uint8) for fill in (0, 255)]


@pytest.mark.parametrize("lens", [LENS, BARREL])
@pytest.mark.parametrize("pitch_deg", [2.0, 50.0])
@pytest.mark.parametrize("gsd_m", [0.2, 0.7])
def test_what_is_behind_the_mask_does_not_matter(lens, pitch_deg, gsd_m):
    telemetry = replace(DOWN, pitch_deg=pitch_deg)

    def rectified(picture, camera):
        view = downsampled(View(picture, camera, telemetry), gsd_m)
        return rectify_footprint(view, gsd_m=gsd_m, multiple_px=1)

    one, other = (rectified(each, lens.masked(GEAR)) for each in pictures())
    np.testing.assert_allclose(one.grey.astype(int), other.grey, atol=1)
    share = 1 - one.valid.sum() / rectified(TEXTURE, lens).valid.sum()
    assert 0.02 < share < 0.6 and not one.grey[~one.valid].any()


@pytest.mark.parametrize(("ground", "airframe"), [(0, 255), (255, 0), (90, 200)])
def test_what_is_behind_the_mask_makes_no_picture_of_a_dark_bright_or_blank_one(ground, airframe):
    picture = np.where(GEAR > 0, ground, airframe).astype(np.uint8)
    reasons = {0: "too_dark", 255: "too_bright", 90: "blank"}
    assert check_view(View(picture, LENS, DOWN), 0.5, True) is None
    refused = check_view(View(picture, LENS.masked(GEAR), DOWN), 0.5, True)
    assert refused.reason == reasons[ground]


def test_over_a_terrain():
    px = node_px((96, 128)) - [64, 48]
    nodes = np.dstack([px * [1.0, -1.0], 5 * np.sin(px[..., :1] / 20)])
    camera_at = Orientation(np.array([0.0, 0.0, 100.0]), np.zeros(3))

    def rectified(picture, lens):
        return orthorectified(View(picture, lens, DOWN), camera_at, nodes, (96, 128))

    one, other = (rectified(each, LENS.masked(GEAR)) for each in pictures())
    np.testing.assert_allclose(one[0].astype(int), other[0], atol=1)
    assert 0.6 < one[1].sum() / rectified(TEXTURE, LENS)[1].sum() < 0.98


def test_a_mask_of_another_size_is_scaled_and_stays_with_the_camera(tmp_path):
    small = cv2.resize(GEAR, (320, 240), interpolation=cv2.INTER_NEAREST)
    camera = LENS.masked(small)
    assert camera.mask is not None and camera.mask.shape == (480, 640) and camera == LENS
    assert np.mean(camera.mask != GEAR) < 0.01
    assert camera.fitted(1280, 960).mask.shape == (960, 1280)
    assert "mask" not in camera.numbers()
    cv2.imwrite(str(tmp_path / "mask.png"), small)
    np.testing.assert_array_equal(masked(LENS, tmp_path / "mask.png").mask, camera.mask)


@pytest.mark.parametrize(
    "mask", [np.zeros((480, 640), np.uint8), np.ones((480, 600), np.uint8), np.ones((4, 4, 3))]
)
def test_masks_that_cannot_be(mask):
    with pytest.raises(CameraError):
        LENS.masked(mask)
    with pytest.raises(CameraError):
        replace(LENS, mask=mask[:240])


def test_a_mask_of_truths_is_one():
    np.testing.assert_array_equal(LENS.masked(GEAR > 0).mask, GEAR)


def test_specks_all_over_leave_nothing_of_a_smaller_picture():
    specks = np.where(np.arange(480)[:, None] % 4, np.ones((1, 640)), 0)
    seen = downsampled(View(TEXTURE, LENS.masked(specks), DOWN), 2.0)
    assert not rectify_footprint(seen, gsd_m=2.0, multiple_px=1).valid.any()


def test_odometry_takes_no_corner_behind_the_mask():
    for camera, found in ((LENS, True), (LENS.masked(GEAR), False)):
        odometry = PictureOdometry()
        odometry.motion(TEXTURE, camera, 10**9)
        x, y = odometry._corners.reshape(-1, 2).T * 640 / odometry._before.shape[1]
        behind = (x > 200) & (x < 420) & (y > 300)
        assert behind.any() == found and not behind.all()


@pytest.mark.parametrize("content", ["", "no picture"])
def test_a_file_that_is_no_mask(tmp_path, content):
    (tmp_path / "mask.png").write_text(content)
    with pytest.raises(CameraError, match=r"cannot be decoded: .*mask\.png"):
        masked(LENS, tmp_path / "mask.png")
