"""How the aircraft moves: on its route in any wind, corners as arcs, odometry off as stated."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from orthonav.core.errors import FlightError
from orthonav.core.geo.camera import enu_from_camera
from orthonav.ground.planning.route import distance_to_polyline_m
from orthonav.ground.simulate.motion import (
    Wind,
    drifting,
    mounted,
    rounded,
    steady_path,
    windy_path,
)

LINE = np.array([[0.0, 0.0], [0.0, 4000.0], [3000.0, 4000.0], [2000.0, 0.0]])
NORTH = np.array([[0.0, 0.0], [0.0, 400_000.0]])
AIRSPEED = 25.0


def flown(line, wind, spacing_m=100.0, seed=1):
    return windy_path(line, spacing_m, AIRSPEED, wind, np.random.default_rng(seed), 10**6)


def off_course_deg(way, course_deg=0.0):
    return (way.headings_deg - course_deg + 180) % 360 - 180


def test_wind_never_pushes_the_aircraft_off_its_route():
    way = flown(LINE, Wind(12.0, 200.0))
    assert distance_to_polyline_m(way.places_en_m, LINE).max() < 1e-6
    assert way.places_en_m[0] == pytest.approx(LINE[0])
    assert np.linalg.norm(way.places_en_m[-1] - LINE[-1]) < 150
    assert np.diff(way.times_s) == pytest.approx(4.0)


@pytest.mark.parametrize(
    "from_deg, crab_deg, ground_mps",
    [(270, -math.degrees(math.asin(8 / 25)), math.sqrt(25**2 - 8**2)), (0, 0, 17), (180, 0, 33)],
    ids=["from the left", "head wind", "tail wind"],
)
def test_heading_and_speed_are_those_of_the_wind_triangle(from_deg, crab_deg, ground_mps):
    way = flown(NORTH / 2, Wind(8.0, from_deg))
    assert off_course_deg(way).mean() == pytest.approx(crab_deg, abs=0.5)
    speed = np.diff(way.places_en_m[:, 1]) / 4.0
    assert speed.mean() == pytest.approx(ground_mps, abs=0.3)
    assert speed.std() > 0.5


@pytest.mark.parametrize(
    "wind, message",
    [
        ((-1.0, 0.0), "wind must be 0 to 200 m/s"),
        ((math.nan, 0.0), "wind must be 0 to 200 m/s"),
        ((5.0, math.nan), "wind direction must be"),
        ((5.0, 1e9), "wind direction must be"),
    ],
)
def test_impossible_wind_is_refused(wind, message):
    with pytest.raises(FlightError, match=message):
        Wind(*wind)


def test_velocities_integrate_to_the_path():
    for way in (flown(LINE, Wind(8.0, 100.0)), steady_path(LINE, 70.0, AIRSPEED)):
        steps = way.velocities_en_mps[1:] * np.diff(way.times_s)[:, None]
        assert steps.sum(axis=0) == pytest.approx(way.places_en_m[-1] - way.places_en_m[0])
        assert way.velocities_en_mps[0, 0] == pytest.approx(0, abs=1e-9)
        assert 15 < way.velocities_en_mps[0, 1] < 35


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


def test_flights_of_too_many_time_steps_are_refused():
    line, rng = np.array([[0.0, 0.0], [50_000.0, 0.0]]), np.random.default_rng(0)
    for spacing_m, airspeed_mps in ((1.0, 1e-3), (1e12, 1.0), (1e9, 1e-3)):
        with pytest.raises(FlightError, match="time steps"):
            windy_path(line, spacing_m, airspeed_mps, Wind(0.0), rng, 10)
