"""Views are found where they were cut, under any heading, or nothing is claimed."""

import math
import sys
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from scenes import Ground, apart_px, random_poses, reference_of, templates_of, turned_rad

from orthonav.core.register.search import SearchWindow, SearchWindows, bank, best_near, search
from orthonav.core.register.template import FINE, GREY_SHARE, Template
from orthonav.core.register.window import Pose

SHAPE = (384, 448)
GROUND = Ground()
ALL_TURNS = bank(None, 0.06, heading_step_rad=math.radians(8), scale_step=0.13, sigmas=2)
LEVEL = 1


@pytest.fixture(scope="module")
def reference():
    return reference_of(GROUND, SHAPE)


@pytest.fixture(scope="module")
def window(reference):
    """The whole sheet at half its resolution."""
    return SearchWindow(reference.whole(LEVEL), LEVEL, 0, 0, 55)


def masked(kind, shape):
    """Which part of a view is seen."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    if kind == "half":
        return x >= shape[1] // 2
    if kind == "trapezoid":
        return np.abs(x - shape[1] / 2) < (0.25 + 0.25 * y / shape[0]) * shape[1]
    if kind == "rotated":
        box = cv2.boxPoints(((shape[1] / 2, shape[0] / 2), (shape[1] * 0.7, shape[0] * 0.6), 25.0))
        return cv2.fillConvexPoly(np.zeros(shape, np.uint8), np.int32(box), 1) > 0
    return np.ones(shape, bool)


def near(pose, turn_off=0.0, scale_off=0.0):
    return [(pose.heading_rad + turn_off, pose.log_scale + scale_off)]


@pytest.mark.parametrize("shape", [(96, 128), (128, 128), (72, 160), (140, 60)], ids=str)
def test_a_view_is_found_where_it_was_cut(window, shape):
    for pose in random_poses(25, SHAPE, 90, seed=3, log_scale=0.12):
        template = templates_of(GROUND, pose, shape).at(LEVEL)
        best, *others = search(template, window, near(pose), 6)
        assert apart_px(best.pose, pose) / 2**LEVEL < 0.25
        assert (best.pose.heading_rad, best.pose.log_scale) == near(pose)[0]
        assert all(best.score > 2 * other.score for other in others)
        # Nearly all of what the weights and the number of pixels allow.
        allowed = sum(template.weights) * math.sqrt(template.pixels)
        assert 0.6 < best.score / allowed < 1.1


def test_heading_and_scale_are_found_all_around(window):
    """Within half a step of the bank, which covers every heading."""
    poses = [
        Pose(pose.x_px, pose.y_px, math.radians(heading), pose.log_scale)
        for heading, pose in zip(
            range(-180, 180, 45), random_poses(8, SHAPE, 90, seed=4, log_scale=0.1), strict=True
        )
    ]
    for pose in poses:
        template = templates_of(GROUND, pose).at(LEVEL)
        best, second = search(template, window, ALL_TURNS, 2)
        assert apart_px(best.pose, pose) / 2**LEVEL < 1.0
        assert abs(turned_rad(best.pose, pose)) < math.radians(4.5)
        assert abs(best.pose.log_scale - pose.log_scale) < 0.08
        assert best.score > 1.8 * second.score


@pytest.mark.parametrize("kind", ["half", "trapezoid", "rotated"])
def test_views_of_which_a_part_is_seen(window, kind):
    """The pose is that of the window's middle, wherever the part lies."""
    shape = (96, 128)
    for pose in random_poses(12, SHAPE, 90, seed=5, log_scale=0.1):
        template = templates_of(GROUND, pose, shape, masked(kind, shape)).at(LEVEL)
        best, second = search(template, window, near(pose), 2)
        assert apart_px(best.pose, pose) / 2**LEVEL < 0.3 and best.score > 1.5 * second.score
        # With a pose of the bank the middle moves by the part's lever.
        best, *_ = search(template, window, near(pose, 0.06, 0.05), 2)
        assert apart_px(best.pose, pose) / 2**LEVEL < (2.6 if kind == "half" else 1.0)


def test_the_best_place_near_by_is_that_of_a_whole_search(window):
    for pose in random_poses(12, SHAPE, 90, seed=8, log_scale=0.1):
        template = templates_of(GROUND, pose).at(LEVEL)
        guess = Pose(pose.x_px + 13.0, pose.y_px - 11.0, pose.heading_rad, pose.log_scale)
        (found,) = best_near(template, window, [guess], 18.0)
        best = search(template, window, near(pose), 1)[0]
        assert apart_px(found.pose, best.pose) < 0.05
        assert found.score == pytest.approx(best.score, rel=1e-3)
        (missed,) = best_near(template, window, [guess], 8.0)
        assert missed.score < found.score / 2
        assert apart_px(missed.pose, guess) <= math.hypot(10.0, 10.0)


def test_a_view_over_the_border_of_the_sheet(window):
    """A part of it on the map is enough, and what lies across the sheet does not move it."""
    for pose in (Pose(20.0, 190.0, 0.3, 0.0), Pose(230.0, 370.0, -2.0, 0.05)):
        best = search(templates_of(GROUND, pose).at(LEVEL), window, near(pose), 1)[0]
        assert apart_px(best.pose, pose) / 2**LEVEL < 0.6


def test_holes_of_the_map_attract_nothing():
    valid = np.ones(SHAPE, bool)
    valid[:200, 240:] = False
    reference = reference_of(GROUND, SHAPE, valid)
    window = SearchWindow(reference.whole(LEVEL), LEVEL, 0, 0, 55)
    other = templates_of(Ground(seed=9), Pose(200.0, 200.0, 0.0, 0.0)).at(LEVEL)
    assert all(
        not (each.pose.x_px > 270 and each.pose.y_px < 170)
        for each in search(other, window, ALL_TURNS[::3], 12)
    )
    for pose in (Pose(120.0, 280.0, 0.7, 0.0), Pose(250.0, 250.0, -0.7, 0.0)):
        best = search(templates_of(GROUND, pose).at(LEVEL), window, near(pose), 1)[0]
        assert apart_px(best.pose, pose) / 2**LEVEL < 0.5


SMALL = {"as large": (48, 64), "smaller": (20, 20), "a strip": (4, 90), "one pixel": (1, 1)}


@pytest.mark.parametrize("size", SMALL.values(), ids=SMALL.keys())
@pytest.mark.parametrize("view_px", [8, 55])
@pytest.mark.parametrize("margin_px", [0, 5, 40])
def test_windows_smaller_than_the_view_are_no_crash(reference, size, view_px, margin_px):
    window = SearchWindow(reference.window(LEVEL, 50, 60, *size), LEVEL, 50, 60, view_px, margin_px)
    template = templates_of(GROUND, Pose(184.0, 148.0, 0.0, 0.0)).at(LEVEL)
    found = search(template, window, [(0.0, 0.0), (0.0, 0.4)], 5)
    if 2 * margin_px >= min(size):
        assert found == []
    for each in found:
        assert math.isfinite(each.score)
        assert -1 <= each.pose.x_px / 2 - 60 <= size[1] and -1 <= each.pose.y_px / 2 - 50 <= size[0]


def test_nothing_to_compare_is_no_crash(reference):
    grey, valid = np.full((48, 64), 99, np.uint8), np.ones((48, 64), bool)
    blank = Template.of(grey, valid, LEVEL, FINE, GREY_SHARE)
    nothing = SearchWindow(np.zeros((100, 100, 4), np.float32), LEVEL, 0, 0, 55)
    pose = Pose(200.0, 200.0, 0.0, 0.0)
    for template, window in (
        (blank, SearchWindow(reference.whole(LEVEL), LEVEL, 0, 0, 55)),
        (templates_of(GROUND, pose).at(LEVEL), nothing),
    ):
        found = search(template, window, near(pose), 3)
        assert len(found) <= 3 and all(abs(each.score) < 1e-3 for each in found)


def test_threads_may_ask_for_windows_of_many_sizes():
    windows = SearchWindows(reference_of(GROUND, (64, 64)))
    template = templates_of(GROUND, Pose(32.0, 32.0, 0.0, 0.0)).at(2)
    windows.whole(template, 20.0)

    def ask(seed):
        for view_px in np.random.default_rng(seed).uniform(8, 300, 400):
            windows.whole(template, float(view_px))

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(ask, range(8)))
    finally:
        sys.setswitchinterval(interval)
