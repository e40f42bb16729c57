"""Views are found where they were cut, under any heading, or nothing is claimed."""

import math
from itertools import pairwise

import cv2
import numpy as np
import pytest
from scenes import (
    Ground,
    apart_px,
    random_poses,
    reference_of,
    templates_of,
    turned_rad,
)

from orthonav.core.register.channels import FINE
from orthonav.core.register.pose import Pose
from orthonav.core.register.search import (
    MAX_KEPT_WINDOWS,
    SearchWindow,
    SearchWindows,
    bank,
    best_near,
    search,
)
from orthonav.core.register.template import Template

SHAPE = (384, 448)
GROUND = Ground()
ALL_TURNS = bank(None, 0.06, turn_step_rad=math.radians(8), scale_step=0.13, sigmas=2)
LEVEL = 1
VIEW_PX = math.sqrt(96 * 128)


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
    return [(pose.turn_rad + turn_off, pose.log_scale + scale_off)]


@pytest.mark.parametrize("shape", [(96, 128), (128, 128), (72, 160), (140, 60)], ids=str)
def test_a_view_is_found_where_it_was_cut(window, shape):
    for pose in random_poses(25, SHAPE, 90, seed=3, log_scale=0.12):
        template = templates_of(GROUND, pose, shape).at(LEVEL)
        best, *others = search(template, window, near(pose), 6)
        assert apart_px(best.pose, pose) / 2**LEVEL < 0.25
        assert (best.pose.turn_rad, best.pose.log_scale) == near(pose)[0]
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
        guess = Pose(pose.x_px + 13.0, pose.y_px - 11.0, pose.turn_rad, pose.log_scale)
        (found,) = best_near(template, window, [guess], 18.0)
        best = search(template, window, near(pose), 1)[0]
        assert apart_px(found.pose, best.pose) < 0.05
        assert found.score == pytest.approx(best.score, rel=1e-3)
        (missed,) = best_near(template, window, [guess], 8.0)
        assert missed.score < found.score / 2
        assert apart_px(missed.pose, guess) <= math.hypot(10.0, 10.0)


def test_no_middle_is_sought_in_the_margin(reference):
    """A view whose middle lies there is not found, one just inside is."""
    made = reference.window(LEVEL, 20, 30, 120, 120)
    window = SearchWindow(made, LEVEL, 20, 30, 55, 30)
    for inside, x_px in ((True, 2 * (30 + 32.0)), (False, 2 * (30 + 24.0))):
        pose = Pose(x_px, 2 * (20 + 60.0), 0.4, 0.0)
        best = search(templates_of(GROUND, pose).at(LEVEL), window, near(pose), 1)[0]
        assert (apart_px(best.pose, pose) / 2**LEVEL < 0.25) == inside


def test_a_view_over_the_border_of_the_sheet(window):
    """A part of it on the map is enough, and what lies across the sheet does not move it."""
    for pose in (Pose(20.0, 190.0, 0.3, 0.0), Pose(230.0, 370.0, -2.0, 0.05)):
        best = search(templates_of(GROUND, pose).at(LEVEL), window, near(pose), 1)[0]
        assert apart_px(best.pose, pose) / 2**LEVEL < 0.6


def test_candidates_are_counted_sorted_and_apart(window):
    pose = Pose(200.0, 200.0, 0.0, 0.0)
    template = templates_of(GROUND, pose).at(LEVEL)
    apart = round(math.sqrt(template.pixels) / 8)
    many = search(template, window, ALL_TURNS[::4], 60)
    assert 20 < len(many) <= 60
    assert all(one.score >= other.score for one, other in pairwise(many))
    for number, one in enumerate(many):
        for other in many[:number]:
            x = abs(one.pose.x_px - other.pose.x_px) / 2**LEVEL
            y = abs(one.pose.y_px - other.pose.y_px) / 2**LEVEL
            assert max(x, y) >= apart  # less half a pixel on either side
    few = search(template, window, ALL_TURNS[::4], 7)
    assert few == many[:7]


def test_a_view_of_elsewhere_stands_out_nowhere(window):
    elsewhere = Ground(seed=9)
    pose = Pose(200.0, 200.0, 0.5, 0.0)
    here = search(templates_of(GROUND, pose).at(LEVEL), window, ALL_TURNS[::3], 4)
    there = search(templates_of(elsewhere, pose).at(LEVEL), window, ALL_TURNS[::3], 4)
    assert there[0].score < 0.5 * here[0].score
    assert there[0].score < 1.4 * there[1].score


def test_holes_of_the_map_attract_nothing():
    valid = np.ones(SHAPE, bool)
    valid[:200, 240:] = False
    reference = reference_of(GROUND, SHAPE, valid)
    window = SearchWindow(reference.whole(LEVEL), LEVEL, 0, 0, 55)
    elsewhere = templates_of(Ground(seed=9), Pose(200.0, 200.0, 0.0, 0.0)).at(LEVEL)
    assert all(
        not (each.pose.x_px > 270 and each.pose.y_px < 170)
        for each in search(elsewhere, window, ALL_TURNS[::3], 12)
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
    blank = Template.of(np.full((48, 64), 99, np.uint8), np.ones((48, 64), bool), LEVEL, FINE)
    nothing = SearchWindow(np.zeros((100, 100, 4), np.float32), LEVEL, 0, 0, 55)
    pose = Pose(200.0, 200.0, 0.0, 0.0)
    for template, window in (
        (blank, SearchWindow(reference.whole(LEVEL), LEVEL, 0, 0, 55)),
        (templates_of(GROUND, pose).at(LEVEL), nothing),
    ):
        found = search(template, window, near(pose), 3)
        assert len(found) <= 3 and all(abs(each.score) < 1e-3 for each in found)


@pytest.mark.parametrize(
    "turn_std_deg, log_scale_std, turns, scales",
    [(None, 0.05, 45, 3), (2.0, 0.01, 2, 1), (10.0, 0.2, 8, 10), (60.0, 0.0, 45, 1)],
)
def test_the_bank_reaches_what_is_likely(turn_std_deg, log_scale_std, turns, scales):
    std = None if turn_std_deg is None else math.radians(turn_std_deg)
    made = bank(std, log_scale_std, turn_step_rad=math.radians(8), scale_step=0.13, sigmas=3)
    turns_rad, scales_tried = (np.unique(each) for each in zip(*made, strict=True))
    assert (len(turns_rad), len(scales_tried)) == (turns, scales)
    assert len(made) == turns * scales == len(set(made))
    if turns == 45:  # all around, with no gap where the circle closes
        gaps = np.diff([*turns_rad, turns_rad[0] + 2 * math.pi])
        np.testing.assert_allclose(gaps, math.radians(8))
    else:
        reach = 3 * std
        off = np.abs(np.linspace(-reach, reach, 99)[:, None] - turns_rad).min(axis=1)
        assert off.max() <= math.radians(4) + 1e-9
        assert turns_rad.sum() == pytest.approx(0, abs=1e-9)
    off = np.abs(np.linspace(-3, 3, 99)[:, None] * log_scale_std - scales_tried).min(axis=1)
    assert off.max() <= 0.065 + 1e-9


@pytest.fixture(scope="module")
def windows(reference):
    return SearchWindows(reference)


def test_no_more_windows_are_kept_than_a_few():
    windows = SearchWindows(reference_of(GROUND, (128, 128)))
    for view_px in np.geomspace(20, 400, 25):
        windows.whole(1, FINE, float(view_px))
    assert len(windows._windows) == MAX_KEPT_WINDOWS


@pytest.mark.parametrize("level", [1, 2])
def test_a_part_reaches_as_far_as_given(windows, level):
    """Middles of views within the reach are sought, those well beyond it are not."""
    centre, reach = (200.0, 170.0), 40.0
    window = windows.part(level, FINE, VIEW_PX, centre, reach)
    unit = 2**level
    assert window.width < SHAPE[1] // unit
    for x, y, inside in (
        (0, 0, True),
        (-39, 0, True),
        (39, 39, True),
        (0, -39, True),
        (-39, 39, True),
        (40 + 4 * unit, 0, False),
        (0, -40 - 4 * unit, False),
    ):
        pose = Pose(centre[0] + x, centre[1] + y, 0.2, 0.0)
        found = search(templates_of(GROUND, pose).at(level), window, [(pose.turn_rad, 0.0)], 5)
        assert (apart_px(found[0].pose, pose) < 0.6 * unit) == inside
        for each in found:
            off = abs(each.pose.x_px - centre[0]), abs(each.pose.y_px - centre[1])
            assert max(off) <= reach + 2.5 * unit


@pytest.mark.parametrize(
    "centre", [(5.0, 5.0), (440.0, 200.0), (-60.0, 190.0), (1e5, 1e5)], ids=str
)
def test_a_part_over_the_border_of_the_sheet(windows, centre):
    window = windows.part(1, FINE, VIEW_PX, centre, 60.0)
    pose = Pose(40.0, 50.0, 0.2, 0.0)
    found = search(templates_of(GROUND, pose).at(1), window, [(0.2, 0.0)], 5)
    assert all(math.isfinite(each.score) for each in found)
    if centre == (5.0, 5.0):
        assert apart_px(found[0].pose, pose) < 1.0
