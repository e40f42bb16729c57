"""Odometry over a plane that is not level, against its exact geometry."""

import math

import numpy as np
import pytest

from orthonav.core.localize.odometry import (
    CameraDisplacement,
    Terrain,
    ViewDisplacement,
    over_terrain,
)

AGL_M, HALF_M = 200.0, 100.0
BELOW = np.zeros(2)


def similarity(before, now):
    """Displacement of the origin, clockwise turn and log scale from one picture (N, 2) to the
    other, by least squares."""
    x, y = (now - now.mean(axis=0)).T
    rows = np.concatenate([np.stack([x, y], -1), np.stack([y, -x], -1)])  # clockwise turns
    target = (before - before.mean(axis=0)).T.reshape(-1)
    (c, s), *_ = np.linalg.lstsq(rows, target, rcond=None)
    moved_m = before.mean(axis=0) - np.array([[c, s], [-s, c]]) @ now.mean(axis=0)
    return moved_m, math.atan2(s, c), math.log(math.hypot(c, s))


def as_measured(moved_m, slope, ahead_m=BELOW):
    """What registration of one view on the other measures: the similarity between what both see,
    `ahead_m` of the camera, as rectified for level ground at height `AGL_M`."""
    square = np.stack(np.meshgrid(*[np.linspace(-HALF_M, HALF_M, 21)] * 2), -1).reshape(-1, 2)
    before = square + ahead_m
    # The camera flies at a constant altitude, `AGL_M` above the ground below it before.
    points = before / (1 + before @ slope / AGL_M)[:, None]
    depth = AGL_M - points @ slope
    now = (points - moved_m) * (AGL_M / depth)[:, None]
    seen = (np.abs(now - ahead_m) <= HALF_M).all(axis=1)
    return similarity(before[seen], now[seen])


def terrain_of(slope, ahead_m=BELOW):
    """A plane through the ground below the camera, as seen `ahead_m` of it."""
    rise = float(ahead_m @ slope) / AGL_M
    return Terrain(slope, slope, rise / (1 + rise))


@pytest.mark.parametrize("slope", [(0.15, 0.0), (0.0, 0.15), (-0.1, 0.1), (-0.05, -0.1)])
@pytest.mark.parametrize("ahead_m", [0.0, 115.0])
def test_long_displacements_are_those_over_the_ground_of_both_views(ahead_m, slope):
    moved_m, slope, ahead_m = (
        np.array([24.0, 32.0]),
        np.array(slope),
        ahead_m * np.array([0.6, 0.8]),
    )
    measured_m, turned, scaled = as_measured(moved_m, slope, ahead_m)
    seen = CameraDisplacement(measured_m, np.eye(2), 100.0, turned, scaled)
    between, at_the_first = (
        over_terrain(ViewDisplacement(seen, 0.8), (AGL_M, AGL_M), terrain_of(slope, at_m), ahead_m)
        for at_m in (ahead_m + measured_m / 2, ahead_m)
    )
    left_m, more_m = (
        np.hypot(*(each.displacement.moved_en_m - moved_m)) for each in (between, at_the_first)
    )
    assert left_m < 0.012 * np.hypot(*moved_m)
    assert left_m < more_m


@pytest.mark.parametrize("off_nadir_deg", [30, 45, 60])
@pytest.mark.parametrize("slope", [(0.15, 0.0), (0.0, 0.15), (-0.1, 0.1), (-0.05, -0.1)])
def test_slope_seen_ahead_does_not_displace_the_camera(off_nadir_deg, slope):
    moved_m, slope = np.array([5.0, 8.75]), np.array(slope)
    ahead_m = AGL_M * math.tan(math.radians(off_nadir_deg)) * np.array([0.6, 0.8])
    measured_m, turned, scaled = as_measured(moved_m, slope, ahead_m)
    seen = CameraDisplacement(measured_m, np.eye(2), 100.0, turned, scaled)
    terrain = terrain_of(slope, ahead_m + measured_m / 2)
    measured = ViewDisplacement(seen, 0.8)
    known = over_terrain(measured, (AGL_M, AGL_M), terrain, ahead_m).displacement
    off_m, left_m = (np.hypot(*(m - moved_m)) for m in (measured_m, known.moved_en_m))
    assert off_m > 0.035 * np.hypot(*moved_m)
    assert left_m < off_m / 4
    assert known.turned_rad == pytest.approx(0.0, abs=0.0006)
    there = AGL_M - float(moved_m @ slope)
    assert known.scaled == pytest.approx(math.log(there / AGL_M), abs=0.0006)
    unknown = over_terrain(measured, (AGL_M, AGL_M), None, ahead_m).displacement
    np.testing.assert_array_equal(unknown.moved_en_m, measured_m)
    # The farther ahead, the less a displacement over unknown ground counts.
    least = seen.covariance[0, 0]
    assert unknown.covariance[0, 0] > known.covariance[0, 0] > least
