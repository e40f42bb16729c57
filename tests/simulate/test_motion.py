"""How the aircraft moves: along its route, corners as arcs, odometry off as stated."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from orthonav.core.geo.camera import enu_from_camera
from orthonav.ground.planning.route import distance_to_polyline_m
from orthonav.ground.simulate.motion import drifting, mounted, rounded, steady_path

LINE = np.array([[0.0, 0.0], [0.0, 4000.0], [3000.0, 4000.0], [2000.0, 0.0]])
AIRSPEED = 25.0


def test_velocities_integrate_to_the_path():
    way = steady_path(LINE, 70.0, AIRSPEED)
    assert np.diff(way.times_s) == pytest.approx(70.0 / AIRSPEED)
    steps = way.velocities_en_mps[1:] * np.diff(way.times_s)[:, None]
    assert steps.sum(axis=0) == pytest.approx(way.places_en_m[-1] - way.places_en_m[0])
    assert way.velocities_en_mps[0] == pytest.approx([0, AIRSPEED], abs=1e-9)


def test_dead_reckoning_drifts_by_the_stated_share_of_the_path():
    true, times = np.tile([15.0, -20.0], (100, 1)), np.arange(100) * 1.0
    way = true.sum(axis=0)
    ends = [drifting(true, times, 0.02, np.random.default_rng(n)).sum(axis=0) for n in range(300)]
    along = (ends - way) @ way / (way @ way)
    across = (ends - way) @ [-way[1], way[0]] / (way @ way)
    assert along.std() == pytest.approx(0.02, rel=0.15)
    assert across.std() == pytest.approx(0.02, rel=0.15)
    assert drifting(true, times, 0.0, np.random.default_rng(0)) == pytest.approx(true)


corners = st.tuples(st.floats(-5000, 5000), st.floats(-5000, 5000))


@given(st.lists(corners, min_size=3, max_size=8), st.floats(1, 1000))
def test_rounded_corners_stay_near_the_route(points, radius_m):
    line = np.array(points)
    made = rounded(line, radius_m)
    assert np.isfinite(made).all()
    assert (made[0] == line[0]).all() and (made[-1] == line[-1]).all()
    legs = np.linalg.norm(np.diff(line, axis=0), axis=1)
    assert distance_to_polyline_m(made, line).max() <= legs.max() / 2 + 1e-6
    assert np.linalg.norm(np.diff(made, axis=0), axis=1).sum() <= legs.sum() + 1e-6


def test_a_rounded_corner_is_an_arc_of_the_radius():
    made = rounded(LINE, 400.0)
    steps = np.diff(made, axis=0)
    turns = np.diff(np.unwrap(np.arctan2(steps[:, 0], steps[:, 1])))
    assert np.degrees(np.abs(turns)).max() <= 2.01
    first = made[1:48]  # 90 deg in steps of 2
    assert first[0] == pytest.approx([0, 3600]) and first[-1] == pytest.approx([400, 4000])
    assert np.linalg.norm(first - [400, 3600], axis=1) == pytest.approx(400)


angles = st.floats(-180, 180), st.floats(-30, 30), st.floats(-30, 30)


@given(st.tuples(*angles), st.tuples(st.floats(-10, 10), st.floats(-10, 10)))
def test_the_mount_tilts_in_the_aircraft(attitude, tilt):
    """Against SciPy's rotations."""
    aircraft = Rotation.from_euler("ZYX", attitude, degrees=True)
    camera = Rotation.from_euler("ZYX", (0, *tilt), degrees=True)
    axis_ned = (aircraft * camera).apply([0, 0, 1])
    axis_enu = enu_from_camera(*mounted(attitude, *tilt))[:, 2]
    assert axis_enu == pytest.approx([axis_ned[1], axis_ned[0], -axis_ned[2]], abs=1e-9)
