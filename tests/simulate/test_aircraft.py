"""Simulated flights of a real aircraft: biases, clouds, corners as arcs, odometry off as stated."""

from functools import partial

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from lab.clouds import Clouds
from scipy.spatial.transform import Rotation
from simulated import frame_of, route_of

from orthonav.core.geo.camera import Camera, enu_from_camera
from orthonav.ground.simulate.flight import Errors
from orthonav.ground.simulate.motion import drifting, mounted, rounded, steady_path
from orthonav.ground.simulate.render import ViewEffects

SEEN = Camera(160, 120, 130.0, 130.0, 80.0, 60.0)
CORNERS = np.array([[-300.0, -200.0], [-300.0, 100.0], [200.0, 100.0]])
ALL = Errors(5.0, 0.05, 1.0, 2.0, 40.0)


def reported(flight, *fields):
    return np.array([[getattr(v.telemetry, name) for name in fields] for v in flight.views])


def pictures(flight):
    return [view.grey() for view in flight.views]


def test_a_seed_gives_the_numbers_of_earlier_versions(area, fly):
    route = route_of(frame_of(area.past), *CORNERS)
    flown = {"over": area.past, "effects": ViewEffects()}
    flight, _, _ = fly(**flown, route=route, errors=ALL, seed=1, spacing_m=50.0)
    lines = (flight.path / "telemetry.csv").read_text().splitlines()
    assert lines[0].endswith("prior_std_m,tilt_std_deg")
    assert lines[1] == "0001.jpg,0,344.838,0.245,1.841,102.234,5,5,48.85912509,2.34941189,40,1"
    assert lines[4] == "0004.jpg,6,353.495,2.995,0.282,106.121,5,5,48.86032265,2.34959257,40,1"


def test_biases_are_constant(fly, frame):
    along = {"route": route_of(frame, *CORNERS), "spacing_m": 100.0, "seed": 3}
    exact, truth, _ = fly(errors=ALL, **along)
    bias = Errors(*[5.0, 0.05, 1.0, 2.0, 40.0], yaw_bias_deg=-4.0, agl_bias=0.08)
    erring, same, _ = fly(errors=bias, **along)
    assert truth == same
    off = reported(erring, "yaw_deg", "agl_m") - reported(exact, "yaw_deg", "agl_m")
    assert (off[:, 0] + 180) % 360 - 180 == pytest.approx(-4)
    assert off[:, 1] == pytest.approx(8)
    rest = ("pitch_deg", "roll_deg", "yaw_std_deg", "agl_std_m", "time_ns")
    assert (reported(erring, *rest) == reported(exact, *rest)).all()
    for a, b in zip(pictures(exact), pictures(erring), strict=True):
        assert (a == b).all()


def test_clouds_hide_some_views_and_leave_the_others(fly, frame):
    along = {"route": route_of(frame, *CORNERS), "spacing_m": 25.0, "seed": 3, "camera": SEEN}
    clear, truth, _ = fly(**along)
    hidden, same, _ = fly(**along, clouds=partial(Clouds, 0.4))
    assert truth == same
    fields = ("yaw_deg", "time_ns", "agl_m")
    assert (reported(clear, *fields) == reported(hidden, *fields)).all()
    pairs = list(zip(pictures(clear), pictures(hidden), strict=True))
    clouds = Clouds(0.4, len(pairs), 3)
    degree = np.array([clouds.degree(number) for number in range(len(pairs))])
    assert [not np.array_equal(a, b) for a, b in pairs] == (degree > 0).tolist()
    spread = np.array([b.std() for _, b in pairs])
    assert (degree == 1).sum() >= 3 and spread[degree == 1].max() < 6
    assert spread[(degree > 0.3) & (degree < 0.7)].min() > 15


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
    off = shapely.distance(shapely.linestrings(line), shapely.points(made))
    assert off.max() <= legs.max() / 2 + 1e-6
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
