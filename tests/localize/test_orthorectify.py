"""Views of relief, rendered by following rays, are orthorectified to what lies on the ground."""

from dataclasses import replace

import numpy as np
import pytest
from blots import CAMERA, GROUND, as_grey
from lab.terrain import random_relief, seen_view

from orthonav.core.localize.view import (
    Orientation,
    hidden,
    node_px,
    orthorectified,
    rectified_flat,
)
from orthonav.core.records import Telemetry, View
from orthonav.ground.simulate.render import Raster

PIXEL_M, POSTING_M, SIDE_M = 1.0, 10.0, 800.0
MIDDLE_M = SIDE_M / 2
LENS = replace(CAMERA, distortion=(-0.2, 0.05, 0.001, -0.001), cx_px=150.0)


def ground_raster():
    east, north = np.meshgrid(np.arange(0.25, SIDE_M, 0.5), SIDE_M - np.arange(0.25, SIDE_M, 0.5))
    values = GROUND(east - SIDE_M / 2, north - SIDE_M / 2)
    return Raster(as_grey(values).astype(np.float32), 0.0, SIDE_M, 0.5)


def relief(slope):
    side = int(SIDE_M / POSTING_M)
    return Raster(random_relief((side, side), POSTING_M, slope, 120.0, 5), 0.0, SIDE_M, POSTING_M)


def window(heights, middle_en_m, shape):
    """A window of ground, north up."""
    px = node_px(shape)
    east = middle_en_m[0] + (px[..., 0] - shape[1] / 2) * PIXEL_M
    north = middle_en_m[1] - (px[..., 1] - shape[0] / 2) * PIXEL_M
    return np.stack([east, north, heights.at(east, north)], -1)


def on_map(grey, middle_en_m, shape):
    x, y = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    east, north = middle_en_m[0] + x - shape[1] / 2, middle_en_m[1] - y + shape[0] / 2
    return grey.at(east, north)


def view_of(grey, camera):
    return View(grey, camera, Telemetry(0, 0.0, 0.0, 0.0, 150.0))


def view_above(grey, heights, camera, attitude):
    """A view from 150 m above the middle of a relief, and its orientation."""
    below = float(heights.at(np.array([MIDDLE_M]), np.array([MIDDLE_M]))[0])
    position = np.array([MIDDLE_M, MIDDLE_M, below + 150.0])
    picture, _ = seen_view(grey, heights, camera, attitude, position, finer=1)
    return view_of(picture, camera), Orientation(position, np.array(attitude))


@pytest.fixture(scope="module")
def grey():
    return ground_raster()


@pytest.mark.parametrize("slope", [0.0, 0.3])
@pytest.mark.parametrize(
    "camera, attitude, reach_m",
    [
        (CAMERA, (30.0, 0.0, 0.0), 0.0),
        (LENS, (200.0, 12.0, -9.0), 20.0),
        (CAMERA, (110.0, 50.0, 5.0), 180.0),
    ],
)
def test_relief_is_removed(grey, slope, camera, attitude, reach_m):
    heights, shape = relief(slope), (160, 180)
    view, orientation = view_above(grey, heights, camera, attitude)
    turn = np.radians(attitude[0])
    middle = orientation.position_m[:2] + reach_m * np.array([np.sin(turn), np.cos(turn)])
    nodes = window(heights, middle, shape)
    made, valid = orthorectified(view, orientation, nodes, shape)
    expected = on_map(grey, middle, shape)
    assert valid.mean() > (0.5 if reach_m < 100 else 0.25)
    same = np.corrcoef(made[valid], expected[valid])[0, 1]
    assert same > 0.97
    if slope > 0:  # on level ground it would be displaced by several pixels
        nodes[..., 2] = orientation.position_m[2] - 150.0
        flat, seen = orthorectified(view, orientation, nodes, shape)
        assert np.corrcoef(flat[seen], expected[seen])[0, 1] < same - 0.1


def test_ground_behind_a_ridge_is_hidden():
    """Seen from the west at a slope of 0.5, a ridge of 60 m hides 120 m of level ground."""
    shape = (40, 400)
    px = node_px(shape)
    nodes = np.stack([px[..., 0], -px[..., 1], np.zeros(px.shape[:2])], -1)
    nodes[..., 2] = np.maximum(60.0 - 6 * np.abs(nodes[..., 0] - 152.5), 0.0)
    from_west = hidden(nodes, np.array([-100_000.0, -20.0, 50_000.0]))
    along = nodes[from_west][:, 0]
    assert 152 < along.min() < 165 and 263 < along.max() < 275 and len(np.unique(along)) > 25
    from_above = hidden(nodes, np.array([150.0, -20.0, MIDDLE_M]))
    assert not from_above.any()


def test_unknown_heights_and_ground_not_seen_are_not_valid(grey):
    heights = relief(0.2)
    nodes = window(heights, (MIDDLE_M, MIDDLE_M), (320, 320))
    nodes[35:45, 30:40, 2] = np.nan
    found, valid = orthorectified(
        *view_above(grey, heights, CAMERA, (0.0, 0.0, 0.0)), nodes, (320, 320)
    )
    assert not valid[140:176, 120:156].any() and not valid[:20].any()
    assert (found[~valid] == 0).all()
    assert valid[160, 175] and valid[160, 100] and 0.2 < valid.mean() < 0.3


@pytest.mark.parametrize("attitude", [(30.0, 0.0, 0.0), (200.0, 12.0, -9.0), (-75.0, -6.0, 15.0)])
@pytest.mark.parametrize("shape", [(160, 180), (31, 18)], ids=str)
def test_level_ground_is_rectified_by_one_homography_as_by_nodes(grey, attitude, shape):
    orientation, en_from_window = over_level_ground(attitude, shape)
    view = view_of(seen_view(grey, level(), CAMERA, attitude, ABOVE_M, finer=1)[0], CAMERA)
    made, valid = rectified_flat(view, orientation, en_from_window, shape)
    nodes = window(level(), MIDDLE_EN_M, shape)
    plain, seen = orthorectified(view, orientation, nodes, shape)
    assert (valid != seen).mean() < 0.01 and seen.mean() > 0.3
    both = valid & seen
    off = made[both].astype(float) - plain[both]
    assert abs(off.mean()) < 0.1 and np.abs(off).mean() < 0.6
    assert not made[~valid].any()


@pytest.mark.parametrize("camera, tilt_deg", [(LENS, 0.0), (CAMERA, 45.0), (CAMERA, 80.0)])
def test_a_lens_and_far_ground_need_more_than_a_homography(camera, tilt_deg):
    shape = (320, 320)
    orientation, en_from_window = over_level_ground((0.0, tilt_deg, 0.0), shape)
    view = view_of(np.zeros((camera.height_px, camera.width_px), np.uint8), camera)
    assert rectified_flat(view, orientation, en_from_window, shape) is None


ABOVE_M = np.array([MIDDLE_M - 30, MIDDLE_M + 10, 150.0])
MIDDLE_EN_M = (MIDDLE_M, MIDDLE_M)


def level():
    side = int(SIDE_M / POSTING_M)
    return Raster(np.zeros((side, side), np.float32), 0.0, SIDE_M, POSTING_M)


def over_level_ground(attitude, shape):
    """A camera, and metres by pixels of a window of `shape`."""
    west, north = MIDDLE_M - shape[1] / 2 * PIXEL_M, MIDDLE_M + shape[0] / 2 * PIXEL_M
    en_from_window = np.array([[PIXEL_M, 0, west], [0, -PIXEL_M, north], [0, 0, 1]])
    return Orientation(ABOVE_M, np.array(attitude)), en_from_window
