"""Simulated flights of a real aircraft: wind, odometry, biases, clouds, ground beyond the map."""

import math

import numpy as np
import pytest
from test_flight import PLAIN, SMALL, plane_of, route_of

from helpers import textured
from orthonav.core.errors import AreaError, FlightError
from orthonav.core.flight import open_flight, read_image, read_truth
from orthonav.core.geo.camera import Camera
from orthonav.ground.planning.route import distance_to_polyline_m
from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight
from orthonav.ground.simulate.motion import Wind
from orthonav.ground.simulate.render import Clouds

SEEN = Camera(160, 120, 130.0, 130.0, 80.0, 60.0)
CORNERS = np.array([[-300.0, -200.0], [-300.0, 100.0], [200.0, 100.0]])
ALL = Errors(5.0, 0.05, 1.0, 2.0, 40.0)


@pytest.fixture(scope="module")
def ortho(make_ortho, tmp_path_factory):
    return make_ortho(tmp_path_factory.mktemp("blots") / "blots.tif", textured((700, 800)))


@pytest.fixture(scope="module")
def frame(ortho):
    return plane_of(ortho).frame


@pytest.fixture
def fly(ortho, frame, tmp_path):
    def flown(name="f", corners=CORNERS, **request):
        route = route_of(frame, *corners)
        kinds = {"route": route, "agl_m": 100.0, "camera": SMALL, "effects": PLAIN, **request}
        simulate_flight(SimulateRequest([ortho], tmp_path / name, **kinds))
        return open_flight(tmp_path / name), read_truth(tmp_path / name / "truth.csv")

    return flown


def reported(flight, *fields):
    return np.array([[getattr(v.telemetry, name) for name in fields] for v in flight.views])


def pictures(flight):
    return [read_image(view.path) for view in flight.views]


def test_a_flight_without_the_new_options_is_what_it_was(area, tmp_path):
    """Numbers of the simulator as it was before it had wind, biases and clouds."""
    request = SimulateRequest(
        [area.past],
        tmp_path / "f",
        route=route_of(plane_of(area.past).frame, *CORNERS),
        agl_m=100.0,
        camera=SMALL,
        errors=ALL,
        seed=1,
        spacing_m=50.0,
    )
    simulate_flight(request)
    lines = (tmp_path / "f/telemetry.csv").read_text().splitlines()
    assert lines[0].endswith("prior_std_m,tilt_std_deg")
    assert lines[1] == "0001.jpg,0,344.838,0.245,1.841,102.234,5,5,48.85912509,2.34941189,40,1"
    assert lines[4] == "0004.jpg,6,353.495,2.995,0.282,106.121,5,5,48.86032265,2.34959257,40,1"


def test_in_wind_the_aircraft_keeps_its_route_and_crabs(fly, frame):
    flight, truth = fly(wind=Wind(10.0, 270.0), spacing_m=25.0, errors=Errors(velocity_drift=0.0))
    places = np.array([frame.en_from_latlon(*truth[view.frame]) for view in flight.views])
    assert distance_to_polyline_m(places, CORNERS).max() < 0.05
    seconds = reported(flight, "time_ns")[:, 0] / 1e9
    assert np.diff(seconds) == pytest.approx(1.0)
    north = places[:, 1] < 99
    yaw = (reported(flight, "yaw_deg")[:, 0] + 180) % 360 - 180
    assert yaw[north].mean() == pytest.approx(-math.degrees(math.asin(0.4)), abs=6)
    assert yaw[~north] == pytest.approx(90, abs=15)
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps[~north[1:]][1:].min() > 29 and steps[north[1:]].max() < 25
    velocity = reported(flight, "vel_en_mps")[:, 0]
    assert velocity[1:] == pytest.approx(np.diff(places, axis=0), abs=0.01)


def test_biases_are_constant(fly):
    exact, truth = fly("exact", errors=ALL, spacing_m=100.0, seed=3)
    bias = Errors(*[5.0, 0.05, 1.0, 2.0, 40.0], yaw_bias_deg=-4.0, agl_bias=0.08)
    erring, same = fly("erring", errors=bias, spacing_m=100.0, seed=3)
    assert truth == same
    off = reported(erring, "yaw_deg", "agl_m") - reported(exact, "yaw_deg", "agl_m")
    assert (off[:, 0] + 180) % 360 - 180 == pytest.approx(-4)
    assert off[:, 1] == pytest.approx(8)
    rest = ("pitch_deg", "roll_deg", "yaw_std_deg", "agl_std_m", "time_ns")
    assert (reported(erring, *rest) == reported(exact, *rest)).all()
    for a, b in zip(pictures(exact), pictures(erring), strict=True):
        assert (a == b).all()


def test_clouds_hide_some_views_and_leave_the_others(fly):
    kinds = {"camera": SEEN, "spacing_m": 25.0, "seed": 3}
    clear, truth = fly("clear", **kinds)
    hidden, same = fly("hidden", **kinds, cloud_share=0.4)
    assert truth == same
    fields = ("yaw_deg", "time_ns", "agl_m")
    assert (reported(clear, *fields) == reported(hidden, *fields)).all()
    pairs = list(zip(pictures(clear), pictures(hidden), strict=True))
    clouds = Clouds(len(pairs), 0.4, 3)
    degree = np.array([clouds.degree(number) for number in range(len(pairs))])
    assert [not np.array_equal(a, b) for a, b in pairs] == (degree > 0).tolist()
    spread = np.array([b.std() for _, b in pairs])
    assert (degree == 1).sum() >= 3 and spread[degree == 1].max() < 6
    assert spread[(degree > 0.3) & (degree < 0.7)].min() > 15


OUT = [[0.0, 0.0], [700.0, 40.0]]


def test_beyond_the_imagery_the_ground_is_mirrored(fly, frame):
    flight, _ = fly(corners=OUT, beyond=True, camera=SEEN, spacing_m=90.0)
    views = pictures(flight)
    assert len(views) == 8
    for view in views:
        assert view.std() > 4 and (view == 0).mean() < 0.03
    with pytest.raises(AreaError, match=r"view \d of the route, .* completely within"):
        fly("not", corners=OUT, camera=SEEN, spacing_m=90.0)
    inside, _ = fly("inside", corners=[[0.0, 0.0], [280.0, 16.0]], camera=SEEN, spacing_m=90.0)
    for a, b in zip(views, pictures(inside), strict=False):
        assert np.abs(a.astype(int) - b).mean() < 0.5


REFUSED = {
    "gale": ({"wind": Wind(25.0)}, r"too strong .* airspeed of 25 m/s"),
    "turn": ({"turn_radius_m": -1.0}, "turn radius"),
    "cloud nan": ({"cloud_share": math.nan}, "cloud_share must be 0 to 1"),
    "spacing": ({"spacing_m": 0.0}, "above 0"),
    "far": ({"spacing_m": math.inf}, "above 0"),
    "speed": ({"airspeed_mps": math.nan}, "above 0"),
}


@pytest.mark.parametrize("request_, message", REFUSED.values(), ids=REFUSED.keys())
def test_flights_that_cannot_be(fly, tmp_path, names_in, request_, message):
    with pytest.raises(FlightError, match=message):
        fly(**request_)
    assert names_in(tmp_path) == []


@pytest.mark.parametrize(
    "request_",
    [
        {"wind": Wind(5.0)},
        {"turn_radius_m": 10.0},
        {"beyond": True},
        {"errors": Errors(velocity_drift=0.0)},
    ],
    ids=["wind", "turn_radius_m", "beyond", "velocity_drift"],
)
def test_random_positions_refuse_route_options(fly, request, request_):
    with pytest.raises(FlightError, match=f"{request.node.callspec.id}: only along a route"):
        fly(route=None, random=3, **request_)


def test_the_command(run, ortho, frame, tmp_path):
    points = route_of(frame, (0.0, 0.0), (100.0, 40.0)).waypoints
    lines = ["lat_deg,lon_deg", *(f"{lat},{lon}" for lat, lon in points)]
    (tmp_path / "route.csv").write_text("\n".join(lines))
    fly = ["simulate", "--ortho", ortho, "--route", tmp_path / "route.csv", "--agl-m", "100"]
    errors = ["--agl-std", "0.05", "--velocity-drift", "0.02", "--turn-radius-m", "50"]
    done = run(*fly, *errors, "--spacing-m", "50", "--out", tmp_path / "f")
    assert done.code == 0 and "views written" in done.out
    telemetry = open_flight(tmp_path / "f").views[0].telemetry
    assert telemetry.vel_en_mps is not None and telemetry.agl_m != 100
