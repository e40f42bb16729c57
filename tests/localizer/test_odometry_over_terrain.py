"""Odometry over a plane that is not level, against its exact geometry."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from orthonav.core.track import CameraDisplacement, tracker
from orthonav.core.track.odometry import Terrain, ViewDisplacement, over_terrain

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


@pytest.mark.parametrize("slope", [(0.2, 0.0), (0.0, 0.2), (-0.15, 0.1)])
def test_parallax_of_a_slope_is_no_turn_and_no_climb(slope):
    moved_m, slope = np.array([30.0, 20.0]), np.array(slope)
    _, turned, scaled = as_measured(moved_m, slope)
    seen = CameraDisplacement(moved_m, np.eye(2), 100.0, turned, scaled)
    there, heights_m = AGL_M - float(moved_m @ slope), (AGL_M, AGL_M)
    terrain, measured = terrain_of(slope), ViewDisplacement(seen, 0.8)
    known = over_terrain(measured, heights_m, terrain, BELOW).displacement
    # The reported height is the same at both, so the bias takes what the ground rises.
    assert known.scaled == pytest.approx(math.log(there / AGL_M), abs=0.006)
    assert abs(known.turned_rad) < 0.15 * abs(turned) + 0.001
    # A camera that looks straight down is above what it sees.
    np.testing.assert_array_equal(known.moved_en_m, moved_m)
    np.testing.assert_array_equal(known.covariance, seen.covariance)
    # Reported heights that follow the ground leave the bias as it is.
    follows = CameraDisplacement(
        moved_m, np.eye(2), 100.0, turned, scaled - math.log(there / AGL_M)
    )
    left = over_terrain(ViewDisplacement(follows, 0.8), (AGL_M, there), terrain, BELOW).displacement
    assert left.scaled == pytest.approx(0.0, abs=0.006)
    unknown = over_terrain(measured, heights_m, None, BELOW).displacement
    assert (unknown.turned_rad, unknown.scaled) == pytest.approx((turned, scaled))
    assert unknown.scaled_std > known.scaled_std > seen.scaled_std


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


def test_the_tracker_takes_the_ground_between_both_views(monkeypatch):
    moved_m, ahead_m, asked = np.array([40.0, 0.0]), np.array([0.0, 115.0]), []
    seen = CameraDisplacement(moved_m, np.eye(2), 100.0, 0.0, 0.0)
    monkeypatch.setattr(tracker, "displacement", lambda *_: ViewDisplacement(seen, 0.8))
    telemetry = SimpleNamespace(agl_m=AGL_M)
    view = SimpleNamespace(
        pixel_m=1.0, ahead_en_m=ahead_m, view=SimpleNamespace(telemetry=telemetry), telemetry=None
    )

    def terrain(relief, agl_m, at_en_m):
        asked.append(at_en_m)
        return terrain_of(np.array([0.15, 0.0]), at_en_m)

    following = SimpleNamespace(
        _registration=SimpleNamespace(relief=SimpleNamespace(is_level=False)),
        _terrain=terrain,
    )
    found = tracker.Tracker._displacement(following, view, view, np.zeros(3), None)
    np.testing.assert_array_equal(asked, [ahead_m + moved_m / 2])
    assert found.displacement.moved_en_m[0] < 40.0  # uphill ground is nearer
