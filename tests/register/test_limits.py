"""Limits of registration: partly missing maps, ground of one direction, wide priors, threads."""

import math
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scenes import Ground, random_poses, reference_of
from test_refine import GROUND, HOLES, REACH_PX, SHAPE, errors, moved, noisy, normalized_squares

from orthonav.core.register.channels import FINE
from orthonav.core.register.pose import Pose
from orthonav.core.register.refine import Refiner
from orthonav.core.register.search import SearchWindows
from orthonav.core.register.window import Reference


@pytest.mark.parametrize("hole", [hole for hole, _ in HOLES.values()], ids=HOLES.keys())
@pytest.mark.parametrize("level", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_errors_on_a_part_of_the_map_are_as_large_as_the_covariance_says(hole, level):
    valid = np.ones(SHAPE, bool)
    valid[hole] = False
    reference = reference_of(GROUND, SHAPE, valid)
    rng = np.random.default_rng(5)
    off, covariances = [], []
    for number in range(60 if level else 30):
        x, y, turn, log_scale = rng.uniform(-1, 1, 4) * [8, 8, math.pi, 0.05]
        pose = Pose(222 + x, 181 + y, turn, log_scale)
        start = moved(pose, 2.0**level, number, 1.0, 1.01)
        view = noisy(GROUND, pose, rng, noise=10.0, clutter=12.0).at(level)
        placed = Refiner(view, reference).place(start, with_covariance=True)
        off.append(errors(placed, pose))
        covariances.append(placed.covariance)
    squares = normalized_squares(np.array(off), np.array(covariances))
    assert 1.0 < squares.mean() < 3.5


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
    reference = reference_of(furrows, SHAPE)
    rng = np.random.default_rng(5)
    off, covariances = [], []
    for pose in random_poses(20, SHAPE, REACH_PX, seed=5):
        view = noisy(furrows, pose, rng, noise=8.0, clutter=24.0).at(level)
        placed = Refiner(view, reference).place(pose, with_covariance=True)
        off.append(errors(placed, pose))
        covariances.append(placed.covariance)
    assert normalized_squares(np.array(off), np.array(covariances)).mean() < 3.5


def test_threads_may_ask_for_windows_of_many_sizes():
    windows = SearchWindows(reference_of(GROUND, (64, 64)))
    windows.whole(2, FINE, 20.0)

    def ask(seed):
        for view_px in np.random.default_rng(seed).uniform(8, 300, 400):
            windows.whole(2, FINE, float(view_px))

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(ask, range(8)))
    finally:
        sys.setswitchinterval(interval)
