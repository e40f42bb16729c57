"""Refinement finds the very place, says how well it fits and how exactly it is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scenes import (
    Ground,
    as_grey,
    pixel_centres,
    random_poses,
    reference_of,
    seen,
    templates_of,
    turned_rad,
)

from orthonav.core.register import refine, template
from orthonav.core.register.refine import DESCENT, Refiner
from orthonav.core.register.template import COARSE, FINE, ViewTemplates
from orthonav.core.register.window import Pose, Reference

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
        pose.heading_rad + math.radians(turn_deg),
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


def test_without_a_compiler_views_are_placed_too(reference, monkeypatch):
    monkeypatch.setattr(refine, "KERNEL", None)
    monkeypatch.setattr(template, "KERNEL", None)
    pose = Pose(220.0, 150.0, 0.7, 0.05)
    near = Pose(222.0, 149.0, 0.73, 0.03)
    placed = Refiner(templates_of(GROUND, pose).at(0), reference).place(near)
    assert placed.converged and math.hypot(placed.pose.x_px - 220, placed.pose.y_px - 150) < 0.05


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
        Pose(200.0, 180.0, 0.0, 0.0), DESCENT.steps, with_covariance=True
    )
    assert abs(placed.score) < 1e-3 and np.isfinite(placed.covariance).all()
    assert math.isfinite(placed.pose.x_px + placed.pose.heading_rad + placed.pose.log_scale)


def placed_all(reference, level, poses, starts=None, seed=5, ground=GROUND, **view):
    """Errors (N, 4) and covariances (N, 4, 4) of noisy views at poses, refined from `starts`."""
    rng, off, covariances = np.random.default_rng(seed), [], []
    for pose, start in zip(poses, starts or poses, strict=True):
        template = noisy(ground, pose, rng, **view).at(level)
        placed = Refiner(template, reference).place(start, with_covariance=True)
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
    poses = random_poses(50, SHAPE, REACH_PX, seed=10 + level, log_scale=0.1)
    off, covariances = placed_all(reference, level, poses, seed=10 + level, **view)
    squares = normalized_squares(off, covariances)
    assert 0.75 < squares.mean() < 3.0
    assert np.mean(squares < 9.21) > 0.95  # 99 % of a true one's
    for axis in (2, 3):
        ratio = (off[:, axis] ** 2 / covariances[:, axis, axis]).mean()
        assert 0.4 < ratio < 4.0


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


@pytest.mark.parametrize("shape", [(2, 2), (7, 12), (16, 16)])
def test_tiny_views_are_no_crash(reference, shape):
    pose = Pose(200.0, 180.0, 0.3, 0.0)
    view = templates_of(GROUND, pose, shape)
    for recipe in (FINE, COARSE):
        placed = Refiner(view.at(0, recipe), reference).place(pose, with_covariance=True)
        assert math.isfinite(placed.score) and np.isfinite(placed.covariance).all()


@pytest.mark.parametrize("hole", [hole for hole, _ in HOLES.values()], ids=HOLES.keys())
@pytest.mark.parametrize("level", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_errors_on_a_part_of_the_map_are_as_large_as_the_covariance_says(hole, level):
    valid = np.ones(SHAPE, bool)
    valid[hole] = False
    moves = np.random.default_rng(4).uniform(-1, 1, (60 if level else 30, 4))
    moves *= [8, 8, math.pi, 0.05]
    poses = [Pose(222 + x, 181 + y, turn, log_scale) for x, y, turn, log_scale in moves]
    starts = [moved(each, 2.0**level, number, 1.0, 1.01) for number, each in enumerate(poses)]
    reference = reference_of(GROUND, SHAPE, valid)
    found = placed_all(reference, level, poses, starts, noise=10.0, clutter=12.0)
    assert 1.0 < normalized_squares(*found).mean() < 3.5


@pytest.mark.parametrize("log_scale", [2.0, 7.0, 700.0])
def test_an_absurd_scale_takes_no_memory(log_scale, monkeypatch):
    """As computed from a bank at a low height: a window of 129 GiB was asked for."""
    pose = Pose(222.0, 181.0, 0.1, 0.0)
    view = noisy(GROUND, pose, np.random.default_rng(1), noise=10.0).at(0)
    reference = reference_of(GROUND, SHAPE)
    monkeypatch.setattr(Reference, "caches", lambda self, level: False)
    sizes, window = [], Reference.window

    def counted(self, level, row, col, height, width, *more):
        sizes.append(height * width)
        return window(self, level, row, col, height, width, *more)

    monkeypatch.setattr(Reference, "window", counted)
    usual = Refiner(view, reference).place(pose)
    absurd = Refiner(view, reference).place(replace(pose, log_scale=log_scale))
    assert sizes[-1] < 10 * sizes[0] and not absurd.score > 0.5 * usual.score


@pytest.mark.parametrize("spread_rad", [0.12, 0.6])
@pytest.mark.parametrize("level", [0, 1])
def test_where_the_ground_runs_in_one_direction_the_covariance_covers_the_errors(spread_rad, level):
    """Furrows: a changed view says nothing along them, whatever its own noise says."""
    furrows = Ground(seed=1, spread_rad=spread_rad)
    poses = random_poses(20, SHAPE, REACH_PX, seed=5)
    view = {"ground": furrows, "noise": 8.0, "clutter": 24.0}
    found = placed_all(reference_of(furrows, SHAPE), level, poses, **view)
    assert normalized_squares(*found).mean() < 3.5
