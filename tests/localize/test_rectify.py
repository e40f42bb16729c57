"""Rectified views equal the ground as drawn by a renderer that shares no code with them."""

import importlib
import math

import cv2
import numpy as np
import pytest
from blots import rendered as rendered_from
from scipy.spatial.transform import Rotation

from orthonav.core.geo.camera import Camera
from orthonav.core.localize.view import downsampled, rectify
from orthonav.core.records import Telemetry, View

AGL_M, GSD_M, SIZE_PX = 100.0, 0.5, 160
PLAIN = Camera(320, 240, 240.0, 240.0, 160.0, 120.0)
LENSES = {
    "pinhole": PLAIN,
    "off centre": Camera(320, 240, 235.0, 245.0, 171.3, 108.6),
    "barrel": Camera(320, 240, 240.0, 240.0, 160.0, 120.0, (-0.12, 0.03, 0.002, -0.003)),
    "all": Camera(320, 240, 235.0, 245.0, 171.3, 108.6, (0.08, -0.04, -0.003, 0.002, 0.01)),
    "fisheye": Camera(
        320, 240, 235.0, 245.0, 171.3, 108.6, (-0.03, 0.01, -0.004, 0.001), "fisheye"
    ),
}
ATTITUDES = [(0, 0, 0), (37, 8, -6), (200, -15, 12), (-90, 0, 20), (300, 25, 0)]


class Ground:
    """Grey levels of a ground that is smooth and random, known at every point."""

    def __init__(self, shortest_m=8.0, seed=0):
        rng = np.random.default_rng(seed)
        length_m = shortest_m * rng.uniform(1, 6, 12)
        direction = rng.uniform(0, 2 * np.pi, 12)
        self.waves = 2 * np.pi / length_m * np.stack([np.cos(direction), np.sin(direction)])
        self.phase = rng.uniform(0, 2 * np.pi, 12)

    def __call__(self, east_m, north_m):
        angle = east_m[..., None] * self.waves[0] + north_m[..., None] * self.waves[1] + self.phase
        return 128 + 20 * np.sin(angle).sum(axis=-1)


def rendered(ground, camera, attitude):
    return rendered_from(ground, (0.0, 0.0), attitude, AGL_M, camera)


def window_en_m(offset_en_m, size_px=SIZE_PX, gsd_m=GSD_M):
    """East and north (S, S) of the pixel centres of the rectified window."""
    along = (np.arange(size_px) + 0.5 - size_px / 2) * gsd_m
    return offset_en_m[0] + along[None] + 0 * along[:, None], offset_en_m[1] - along[:, None]


def seen_px(camera, attitude, east_m, north_m, agl_m=AGL_M):
    """Image column and row of ground points, NaN behind the camera."""
    ned = np.stack(np.broadcast_arrays(north_m, east_m, agl_m), axis=-1)
    body = Rotation.from_euler("ZYX", attitude, degrees=True).inv().apply(ned.reshape(-1, 3))
    forward, right, along = body.T
    along = np.where(along > 0, along, np.nan)
    plane = np.stack([right / along, -forward / along, np.ones_like(along)], axis=-1)[:, None]
    flat = np.nan_to_num(plane, nan=1e6)
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    distortion = np.array(camera.distortion or (0, 0, 0, 0), dtype=float)
    project = cv2.fisheye.projectPoints if camera.model == "fisheye" else cv2.projectPoints
    seen = project(flat, np.zeros(3), np.zeros(3), matrix, distortion)[0].reshape(-1, 2)
    return np.where(np.isfinite(along)[:, None], seen, np.nan).reshape(*ned.shape[:-1], 2)


def tilted_and_prepared(grey, camera, attitude, gsd_m=GSD_M, size_px=SIZE_PX, agl_m=AGL_M):
    yaw, pitch, roll = attitude
    view = View(grey, camera, Telemetry(0, yaw, pitch, roll, agl_m))
    return rectify(downsampled(view, gsd_m), gsd_m=gsd_m, size_px=size_px)


def shift_px(found, expected, where):
    """Least-squares shift (column, row) between two pictures, in pixels, over `where`."""
    row_slope, col_slope = np.gradient(expected)
    slopes = np.stack([col_slope[where], row_slope[where]], axis=1)
    return np.linalg.lstsq(slopes, (expected - found)[where], rcond=None)[0]


@pytest.mark.parametrize(
    "attitude, lens",
    [
        *((ATTITUDES[1], lens) for lens in LENSES),
        *((attitude, "all") for attitude in ATTITUDES if attitude != ATTITUDES[1]),
    ],
)
def test_the_ground_comes_out_as_it_is(attitude, lens):
    ground, camera = Ground(), LENSES[lens]
    view = tilted_and_prepared(rendered(ground, camera, attitude), camera, attitude)
    expected = ground(*window_en_m(view.offset_en_m))
    inner = cv2.erode(view.valid.astype(np.uint8), np.ones((5, 5)), borderValue=1) > 0
    assert view.grey.shape == (SIZE_PX, SIZE_PX) and view.valid.mean() > 0.5
    assert np.abs(view.grey - expected)[inner].mean() < 1.0
    assert np.abs(shift_px(view.grey, expected, inner)).max() < 0.04  # OpenCV steps by 1/32 px


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("attitude", [*ATTITUDES, (10, 44, 0)], ids=str)
def test_valid_is_what_the_camera_saw(attitude, lens):
    camera = LENSES[lens]
    grey = np.full((camera.height_px, camera.width_px), 99, np.uint8)
    view = tilted_and_prepared(grey, camera, attitude, gsd_m=2.0)
    east, north = window_en_m(view.offset_en_m, gsd_m=2.0)
    seen = seen_px(camera, attitude, east, north)
    inside = np.minimum(seen, [camera.width_px, camera.height_px] - seen).min(axis=-1)
    assert 0.05 < view.valid.mean() < 0.9
    assert view.valid[inside > 0.1].all()
    if lens in ("pinhole", "off centre"):
        assert not view.valid[~(inside >= -0.1)].any()
    else:  # far outside the image the distortion folds points back into it
        near = np.abs(inside) < 20
        assert not view.valid[near & (inside < -0.1)].any()


def test_valid_pixels_hold_no_black_from_beyond_the_border():
    for camera in LENSES.values():
        grey = np.full((camera.height_px, camera.width_px), 200, np.uint8)
        view = tilted_and_prepared(grey, camera, (37, 8, -6), gsd_m=2.0)
        assert not view.valid.all() and (view.grey[view.valid] == 200).all()
        assert not view.grey[~view.valid].any()


@pytest.mark.long
@pytest.mark.parametrize(
    "lens, size", [pytest.param("pinhole", (800, 600), marks=pytest.mark.slow), ("all", (803, 599))]
)
def test_fine_views_are_thinned_without_aliasing_or_shift(lens, size):
    """Stripes of two image pixels are gone, the ground below them stays in place."""
    camera, attitude = LENSES[lens].resized(*size), (37, 8, -6)
    ground = Ground(shortest_m=16)
    grey = rendered(ground, camera, attitude).astype(int)
    stripes = np.where(np.indices(grey.shape).sum(axis=0) % 2, 25, -25)
    grey = np.clip(grey, 30, 225)
    striped = (grey + stripes).astype(np.uint8)
    plain = tilted_and_prepared(grey.astype(np.uint8), camera, attitude)
    view = tilted_and_prepared(striped, camera, attitude)
    expected = np.clip(ground(*window_en_m(view.offset_en_m)), 30, 225)
    inner = cv2.erode(view.valid.astype(np.uint8), np.ones((5, 5)), borderValue=1) > 0
    assert np.abs(view.grey.astype(int) - plain.grey)[inner].mean() < 2.5
    assert np.abs(shift_px(view.grey, expected, inner)).max() < 0.05


@pytest.mark.parametrize("lens", ["barrel", "all", "fisheye"])
@pytest.mark.parametrize("attitude", [(30.0, 0.0, 0.0), (200.0, 8.0, -5.0), (0.0, 50.0, 10.0)])
def test_a_lens_at_some_pixels_is_as_good_as_at_all(monkeypatch, lens, attitude):
    """Not to the bit: no pixel is taken from farther than a fiftieth of one away."""
    grey = np.random.default_rng(3).integers(0, 256, (240, 320)).astype(np.float32)
    grey = cv2.GaussianBlur(grey, (0, 0), 1.5)
    grey = (40 * (grey - 100) / grey.std() / 2 + 120).clip(0, 255).astype(np.uint8)
    view = View(grey, LENSES[lens], Telemetry(0, *attitude, 100.0))
    quick = rectify(view, gsd_m=0.5, size_px=240)
    module = importlib.import_module("orthonav.core.localize.view")
    monkeypatch.setattr(module, "_is_smooth", lambda *_: False)
    exact = rectify(view, gsd_m=0.5, size_px=240)
    assert (quick.valid != exact.valid).mean() < 2e-3
    both = quick.valid & exact.valid
    off = np.abs(quick.grey.astype(int) - exact.grey)[both]
    assert both.any() and off.max() <= 3 and off.mean() < 0.2


def test_a_picture_beyond_the_horizon_is_not_valid():
    view = tilted_and_prepared(rendered(Ground(), PLAIN, (0, 44, 0)), PLAIN, (0, 44, 0), gsd_m=8.0)
    east, north = window_en_m(view.offset_en_m, gsd_m=8.0)
    assert not view.valid[np.broadcast_to(north, east.shape) < -AGL_M / math.tan(0.767)].any()
