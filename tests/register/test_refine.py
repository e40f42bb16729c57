"""Refinement finds the very place, says how well it fits and how exactly it is known."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scenes import (
    Ground,
    Sheet,
    apart_px,
    as_grey,
    pixel_centres,
    random_poses,
    reference_of,
    seen,
    sheet_of,
    templates_of,
    turned_rad,
)

from orthonav.core.register.channels import COARSE, FINE
from orthonav.core.register.pose import Pose
from orthonav.core.register.refine import STEPS, Refiner
from orthonav.core.register.template import ViewTemplates
from orthonav.core.register.window import Reference

SHAPE = (384, 448)
VIEW = (96, 128)
REACH_PX = 95
GROUND = Ground()


@pytest.fixture(scope="module")
def reference():
    return reference_of(GROUND, SHAPE)


def moved(pose, away_px=0.0, bearing_rad=0.0, turn_deg=0.0, scale=1.0):
    return Pose(
        pose.x_px + away_px * math.cos(bearing_rad),
        pose.y_px + away_px * math.sin(bearing_rad),
        pose.turn_rad + math.radians(turn_deg),
        pose.log_scale + math.log(scale),
    )


def errors(placed, pose):
    """Off by x, y (level-0 px), turn (rad) and log scale."""
    found = placed.pose
    return np.array(
        [
            found.x_px - pose.x_px,
            found.y_px - pose.y_px,
            turned_rad(found, pose),
            found.log_scale - pose.log_scale,
        ]
    )


def noisy(ground, pose, rng, noise=8.0, clutter=0.0, shape=VIEW):
    """A view with noise of its pixels, and with smooth clutter that is not on the map."""
    values = seen(ground, pose, shape) + rng.normal(0, noise, shape)
    if clutter:
        other = Ground(int(rng.integers(1 << 30)), waves=40, px=(9, 40), contrast=clutter)
        values += other(*pixel_centres(shape)) - 128
    return ViewTemplates(as_grey(values), np.ones(shape, bool), 0)


@pytest.mark.parametrize("level", [0, 1])
def test_a_view_is_placed_to_a_fraction_of_a_pixel(reference, level):
    for pose in random_poses(15, SHAPE, REACH_PX, seed=1, log_scale=0.1):
        placed = Refiner(templates_of(GROUND, pose).at(level), reference).place(pose)
        off = errors(placed, pose)
        assert np.hypot(*off[:2]) / 2**level < 0.05
        assert abs(off[2]) < math.radians(0.1) and abs(off[3]) < 0.0025
        assert placed.converged and placed.overlap == pytest.approx(1.0)
        assert placed.level == level and placed.weighted > 0.9


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize(
    "away_px, turn_deg, scale",
    [(2, 4, 1.06), (2, 4, 0.94), (2, -4, 1.06), (2, -4, 0.94), (3, 0, 1), (0, 5, 1), (0, 0, 1.08)],
)
def test_what_a_search_leaves_is_made_up_for(reference, level, away_px, turn_deg, scale):
    """Half a step of the bank in heading and scale, and two pixels of the level."""
    for number, pose in enumerate(random_poses(8, SHAPE, REACH_PX, seed=2, log_scale=0.05)):
        start = moved(pose, away_px * 2**level, 2.4 * number, turn_deg, scale)
        placed = Refiner(templates_of(GROUND, pose).at(level), reference).place(start, 6)
        off = errors(placed, pose)
        assert np.hypot(*off[:2]) / 2**level < 0.08
        assert abs(off[2]) < math.radians(0.2) and abs(off[3]) < 0.004


@pytest.mark.parametrize("level", [0, 1])
def test_noise_and_clutter_move_it_little(reference, level):
    rng = np.random.default_rng(3)
    for pose in random_poses(15, SHAPE, REACH_PX, seed=3, log_scale=0.1):
        start = moved(pose, 1.0, pose.x_px, 1.0, 1.01)
        view = noisy(GROUND, pose, rng, noise=12.0, clutter=10.0).at(level)
        placed = Refiner(view, reference).place(start)
        off = errors(placed, pose)
        assert np.hypot(*off[:2]) / 2**level < 0.3
        assert abs(off[2]) < math.radians(0.5) and abs(off[3]) < 0.01
        assert 0.5 < placed.weighted < 0.9


@pytest.mark.parametrize(
    "step",
    [
        (0.8, 0, 0, 0),
        (-0.8, 0, 0, 0),
        (0, 0.8, 0, 0),
        (0, -0.8, 0, 0),
        (0, 0, 0.015, 0),
        (0, 0, -0.015, 0),
        (0, 0, 0, 0.015),
        (0, 0, 0, -0.015),
    ],
)
def test_one_step_goes_most_of_the_way(reference, step):
    """In the right direction on each axis, whatever the heading."""
    step = np.array(step, dtype=float)
    for pose in random_poses(6, SHAPE, REACH_PX, seed=4, log_scale=0.1):
        start = Pose(*(np.array([pose.x_px, pose.y_px, pose.turn_rad, pose.log_scale]) + step))
        placed = Refiner(templates_of(GROUND, pose).at(0), reference).place(start, 1)
        unit = np.array([1, 1, 50, 50])  # half a view's side brings all to pixels
        left = np.linalg.norm(errors(placed, pose) * unit)
        assert left < 0.55 * np.linalg.norm(step * unit)


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("size", [(96, 128), (64, 64), (90, 122)])
def test_a_cut_of_the_map_lies_where_it_was_cut(level, size):
    """Whole pixels, no resampling: the convention of half pixels is exact."""
    sheet = sheet_of(GROUND, SHAPE)
    row, col = 120, 76
    grey = sheet.read(0, row, col, *size)[0]
    pose = Pose(col + size[1] / 2, row + size[0] / 2, 0.0, 0.0)
    template = ViewTemplates(grey, np.ones(size, bool), 0).at(level)
    refiner = Refiner(template, Reference(sheet))
    assert refiner.place(pose, 0).weighted > 0.9  # only what the view's borders reach differs
    placed = refiner.place(pose, with_covariance=True)
    assert np.abs(errors(placed, pose)[:2]).max() / 2**level < 0.05
    for x, y in ((0.5, 0), (0, 0.5)):
        beside = [
            refiner.place(Pose(pose.x_px + s * x, pose.y_px + s * y, 0.0, 0.0), 0).weighted
            for s in (-1, 1)
        ]
        assert beside[0] == pytest.approx(beside[1], abs=0.02) and beside[0] < 0.99


def test_the_best_seen_is_kept(reference):
    """However the steps go, more of them never make it worse."""
    for number, pose in enumerate(random_poses(10, SHAPE, REACH_PX, seed=5, log_scale=0.1)):
        start = moved(pose, 6.0, number, 7.0, 1.12)  # far enough for steps to go astray
        refiner = Refiner(templates_of(GROUND, pose).at(0), reference)
        scores = [refiner.place(start, steps).score for steps in range(8)]
        assert all(later >= earlier for earlier, later in pairwise(scores))
        assert scores[-1] > scores[0]


def test_without_steps_a_pose_is_judged_where_it_is(reference):
    pose = Pose(200.0, 180.0, 0.4, 0.0)
    start = moved(pose, 1.0)
    refiner = Refiner(templates_of(GROUND, pose).at(0), reference)
    placed = refiner.place(start, 0)
    assert placed.pose == start and not placed.converged
    assert math.isnan(placed.agreement) and placed.covariance is None
    there = refiner.place(pose, 0)
    assert there.score > placed.score
    # The score is the weighted sum of correlations times the root of the pixels.
    total = there.correlations[0] + FINE.grey_share * there.correlations[1]
    assert there.score == pytest.approx(total * math.sqrt(96 * 128), rel=1e-3)
    assert there.weighted == pytest.approx(total / (1 + FINE.grey_share))
    assert all(0 < each <= 1.0001 for each in there.correlations)


def test_a_reversed_contrast_is_recognized_by_grey_only(reference):
    pose = Pose(200.0, 180.0, 0.4, 0.0)
    grey = 255 - as_grey(seen(GROUND, pose, VIEW))
    view = ViewTemplates(grey, np.ones(VIEW, bool), 0)
    placed = Refiner(view.at(0), reference).place(moved(pose, 1.0), with_covariance=True)
    assert placed.correlations[0] > 0.9 and placed.correlations[1] < -0.9
    assert apart_px(placed.pose, pose) < 0.1 and np.isfinite(placed.covariance).all()


def test_the_same_again_and_inputs_untouched(reference):
    pose = Pose(200.0, 180.0, 0.4, 0.0)
    template = templates_of(GROUND, pose).at(0)
    kept = template.channels.copy(), template.mask.copy(), reference.whole(0).copy()
    start = moved(pose, 2.0, 1.0, 3.0, 1.03)
    first, second = (
        Refiner(template, reference).place(start, with_covariance=True) for _ in range(2)
    )
    assert replace(first, covariance=None).pose == second.pose and first.score == second.score
    assert first.covariance.tobytes() == second.covariance.tobytes()
    np.testing.assert_array_equal(template.channels, kept[0])
    np.testing.assert_array_equal(template.mask, kept[1])
    np.testing.assert_array_equal(reference.whole(0), kept[2])


def test_windows_made_alone_give_the_same(reference, monkeypatch):
    monkeypatch.setattr("orthonav.core.register.window.WHOLE_LEVEL_PX", 0)
    piecewise = reference_of(GROUND, SHAPE)
    for pose in random_poses(5, SHAPE, 60, seed=6):
        template = templates_of(GROUND, pose).at(0)
        one, other = (
            Refiner(template, each).place(moved(pose, 1.5)) for each in (reference, piecewise)
        )
        assert apart_px(one.pose, other.pose) < 1e-3
        assert one.score == pytest.approx(other.score, rel=1e-3)


HOLES = {
    "right of it": (np.s_[:, 230:], 0.5),
    "below it": (np.s_[205:, :], 0.7),
    "a corner": (np.s_[:180, :210], 0.75),
}


@pytest.mark.parametrize("hole, share", HOLES.values(), ids=HOLES.keys())
@pytest.mark.parametrize("turn_deg", [0.0, 35.0])
def test_a_map_of_which_a_part_is_missing(hole, share, turn_deg):
    valid = np.ones(SHAPE, bool)
    valid[hole] = False
    reference = reference_of(GROUND, SHAPE, valid)
    pose = Pose(222.0, 181.0, math.radians(turn_deg), 0.0)
    for level in (0, 1):
        template = templates_of(GROUND, pose).at(level)
        start = moved(pose, 1.5 * 2**level, 2.0, 2.0, 1.02)
        placed = Refiner(template, reference).place(start, 16)
        off = errors(placed, pose)
        assert np.hypot(*off[:2]) / 2**level < 0.12 and abs(off[2]) < math.radians(0.3)
        shown = seen(lambda x, y: _at(valid, x, y), placed.pose, VIEW).mean()
        assert placed.overlap == pytest.approx(shown, abs=0.08)
        assert abs(placed.overlap - share) < 0.15 and placed.weighted > 0.9
        whole = Refiner(template, reference_of(GROUND, SHAPE)).place(pose)
        assert placed.score / whole.score == pytest.approx(math.sqrt(shown), abs=0.1)


def _at(valid, x, y):
    return valid[np.clip(y, 0, SHAPE[0] - 1).astype(int), np.clip(x, 0, SHAPE[1] - 1).astype(int)]


def test_a_view_of_which_a_part_is_seen(reference):
    y, x = np.mgrid[: VIEW[0], : VIEW[1]]
    valid = np.abs(x - VIEW[1] / 2) < (0.2 + 0.25 * y / VIEW[0]) * VIEW[1]
    for pose in random_poses(10, SHAPE, REACH_PX, seed=7, log_scale=0.1):
        template = templates_of(GROUND, pose, valid=valid).at(0)
        placed = Refiner(template, reference).place(moved(pose, 2.0, pose.x_px, -3.0, 1.04))
        off = errors(placed, pose)
        assert np.hypot(*off[:2]) < 0.1 and abs(off[2]) < math.radians(0.2) and abs(off[3]) < 0.005
        assert placed.overlap == pytest.approx(1.0)  # of what is seen


def test_beyond_the_map_nothing_is_said(reference):
    template = templates_of(GROUND, Pose(200.0, 180.0, 0.0, 0.0)).at(0)
    for pose in (Pose(-5000.0, 180.0, 0.0, 0.0), Pose(200.0, 9000.0, 1.0, 0.2)):
        placed = Refiner(template, reference).place(pose, with_covariance=True)
        assert placed.overlap == 0 and placed.score == 0 and placed.agreement == 0
        assert np.isfinite(placed.covariance).all()


@pytest.mark.parametrize("grey", [0, 130])
def test_a_blank_view_says_nothing(reference, grey):
    view = ViewTemplates(np.full(VIEW, grey, np.uint8), np.ones(VIEW, bool), 0)
    placed = Refiner(view.at(0), reference).place(
        Pose(200.0, 180.0, 0.0, 0.0), STEPS, with_covariance=True
    )
    assert abs(placed.score) < 1e-3 and np.isfinite(placed.covariance).all()
    assert math.isfinite(placed.pose.x_px + placed.pose.turn_rad + placed.pose.log_scale)


@pytest.mark.parametrize("shape", [(2, 2), (7, 12), (16, 16)])
def test_tiny_views_are_no_crash(reference, shape):
    pose = Pose(200.0, 180.0, 0.3, 0.0)
    view = templates_of(GROUND, pose, shape)
    for recipe in (FINE, COARSE):
        placed = Refiner(view.at(0, recipe), reference).place(pose, with_covariance=True)
        assert math.isfinite(placed.score) and np.isfinite(placed.covariance).all()


def test_agreement_tells_right_from_wrong(reference):
    pose = Pose(200.0, 180.0, 0.3, 0.0)
    refiner = Refiner(templates_of(GROUND, pose).at(0), reference)
    assert refiner.place(pose, with_covariance=True).agreement == 1.0
    wrong = [
        refiner.place(each, with_covariance=True)
        for each in random_poses(12, SHAPE, REACH_PX, seed=8)
        if apart_px(each, pose) > 40
    ]
    assert len(wrong) > 6 and np.mean([each.agreement for each in wrong]) < 0.75
    assert max(each.weighted for each in wrong) < 0.35


def test_half_of_a_view_that_changed_disagrees(reference):
    pose = Pose(200.0, 180.0, 0.3, 0.0)
    values = seen(GROUND, pose, VIEW)
    values[:, 64:] = Ground(seed=5)(*pixel_centres(VIEW))[:, 64:]
    view = ViewTemplates(as_grey(values), np.ones(VIEW, bool), 0)
    placed = Refiner(view.at(0), reference).place(pose, with_covariance=True)
    assert apart_px(placed.pose, pose) < 0.3 and 0.6 < placed.agreement < 0.95


def many_placed(reference, level, count, seed, **view):
    """Errors (N, 4) and covariances (N, 4, 4) of noisy views, from poses near the truth."""
    rng = np.random.default_rng(seed)
    off, covariances = [], []
    for pose in random_poses(count, SHAPE, REACH_PX, seed=seed, log_scale=0.1):
        template = noisy(GROUND, pose, rng, **view).at(level)
        placed = Refiner(template, reference).place(pose, with_covariance=True)
        off.append(errors(placed, pose))
        covariances.append(placed.covariance)
    return np.array(off), np.array(covariances)


def normalized_squares(off, covariances, part=np.s_[:2]):
    covariances = covariances[:, part, part]
    return np.einsum("ni,nij,nj->n", off[:, part], np.linalg.inv(covariances), off[:, part])


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("view", [{"noise": 12.0}, {"noise": 8.0, "clutter": 24.0}], ids=str)
def test_errors_are_as_large_as_the_covariance_says(reference, level, view):
    """Squared errors over the covariance average 2 where it is right, on two axes."""
    off, covariances = many_placed(reference, level, 50, 10 + level, **view)
    squares = normalized_squares(off, covariances)
    assert 0.75 < squares.mean() < 3.0
    assert np.mean(squares < 9.21) > 0.95  # 99 % of a true one's
    for axis in (2, 3):
        ratio = (off[:, axis] ** 2 / covariances[:, axis, axis]).mean()
        assert 0.4 < ratio < 4.0


def test_covariances_are_symmetric_and_positive(reference):
    _, covariances = many_placed(reference, 0, 20, 20, noise=10.0, clutter=10.0)
    np.testing.assert_allclose(covariances, covariances.transpose(0, 2, 1), rtol=1e-6)
    assert np.linalg.eigvalsh(covariances).min() > 0


@pytest.mark.parametrize("level", [0, 1])
def test_worse_views_are_known_less_exactly(reference, level):
    spreads = [
        np.median(
            np.trace(many_placed(reference, level, 12, 30, **view)[1][:, :2, :2], axis1=1, axis2=2)
        )
        for view in (
            {"noise": 2.0},
            {"noise": 20.0},
            {"noise": 20.0, "clutter": 20.0},
            {"noise": 20.0, "clutter": 45.0},
        )
    ]
    assert all(later > 1.5 * earlier for earlier, later in pairwise(spreads))


@pytest.mark.parametrize("turn_deg", [0.0, 40.0, 110.0])
def test_what_runs_in_one_direction_is_known_across_it_only(turn_deg):
    """Furrows from north to south: how far north is hardly known, under any heading."""
    furrows = Ground(seed=1, spread_rad=0.12)
    reference = reference_of(furrows, SHAPE)
    rng = np.random.default_rng(2)
    pose = Pose(220.0, 190.0, math.radians(turn_deg), 0.05)
    view = noisy(furrows, pose, rng, noise=1.0)
    for level in (0, 1):
        covariance = Refiner(view.at(level), reference).place(pose, with_covariance=True).covariance
        assert covariance[1, 1] > 4 * covariance[0, 0]


def test_a_coarser_level_gives_the_covariance_in_the_same_unit(reference):
    """Twice the pixel is about twice the error in clutter: never half."""
    view = {"noise": 8.0, "clutter": 25.0}
    covariances = [many_placed(reference, level, 15, 40, **view)[1] for level in (0, 1)]
    deviations = [np.sqrt(np.median(each[:, 0, 0])) for each in covariances]
    assert 1.2 < deviations[1] / deviations[0] < 5


def test_sheets_of_one_level_will_do():
    reference = Reference(Sheet(as_grey(GROUND(*pixel_centres((200, 200)))), levels=1))
    pose = Pose(100.0, 96.0, 0.2, 0.0)
    placed = Refiner(templates_of(GROUND, pose).at(0), reference).place(moved(pose, 2.0))
    assert apart_px(placed.pose, pose) < 0.05
