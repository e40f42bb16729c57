"""Simulated flights: the picture shows the ground at the truth, the telemetry errs as stated."""

import errno
import json
import math

import cv2
import numpy as np
import pytest

from orthonav.core.errors import AreaError, OutputError, UsageError
from orthonav.core.flight import FlightWriter, open_flight, read_truth
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.swapped import HINT
from orthonav.core.localize import downsampled, rectify
from orthonav.core.records import View
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Route
from orthonav.ground.simulate import flight as flight_module
from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight
from orthonav.ground.simulate.render import ViewEffects

PLAIN = ViewEffects(exposure_std=0.0, blur_px=0.0, noise_std=0.0, jpeg_quality=100)
SMALL = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
SEEN = Camera(320, 240, 260.0, 255.0, 158.0, 121.5)
LENS = Camera(320, 240, 260.0, 255.0, 158.0, 121.5, (-0.15, 0.03, 0.001, -0.002))
FISH = Camera(320, 240, 260.0, 255.0, 158.0, 121.5, (0.02, -0.01, 0.003, -0.001), "fisheye")
SIZE_PX = 96


def plane_of(ortho):
    outline = Mosaic.open([ortho]).outline_latlon_deg
    return Area.from_outline(outline[:, 0], outline[:, 1])


@pytest.fixture(scope="module")
def plane(area):
    return plane_of(area.past)


def flown(area, path, **request):
    request = {"random": 5, "agl_m": 100.0, "camera": SMALL, "effects": PLAIN, **request}
    simulate_flight(SimulateRequest([area.past], path, **request))
    return open_flight(path), read_truth(path / "truth.csv")


def unseen(area, path, **request):
    """The same without the time that pictures take: they are of one grey."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flight_module, "_picture", lambda *_: np.full((48, 64, 3), 99, np.uint8))
        return flown(area, path, **request)


def route_of(frame, *points_en_m):
    return Route(tuple(zip(*(c.tolist() for c in frame.latlon_from_en(points_en_m)), strict=True)))


@pytest.fixture(scope="module")
def exact(area, tmp_path_factory):
    return unseen(area, tmp_path_factory.mktemp("exact") / "f", random=180, seed=9)


def ground_at(area, frame, place_en_m, gsd_m=1.0):
    half = SIZE_PX * gsd_m / 2
    with Mosaic.open([area.past]).sheet(
        frame,
        west_m=place_en_m[0] - half,
        north_m=place_en_m[1] + half,
        width_px=SIZE_PX,
        height_px=SIZE_PX,
        gsd_m=gsd_m,
    ) as raster:
        return raster.read(0, 0, SIZE_PX, SIZE_PX).grey


@pytest.mark.parametrize(
    "camera, attitude_std_deg",
    [(SEEN, 0.0), (SEEN, 6.0), (LENS, 6.0), (FISH, 6.0)],
    ids=["pinhole level", "pinhole", "lens", "fisheye"],
)
def test_the_picture_shows_the_ground_at_the_truth(area, plane, tmp_path, camera, attitude_std_deg):
    flight, truth = flown(
        area,
        tmp_path / "f",
        random=3,
        camera=camera,
        agl_m=150.0,
        errors=Errors(attitude_std_deg=attitude_std_deg),
        seed=4,
    )
    for view in flight.views:
        telemetry = view.telemetry
        seen = View(view.grey(), camera, telemetry)
        rectified = rectify(downsampled(seen, 1.0), gsd_m=1.0, size_px=SIZE_PX)
        place = plane.frame.en_from_latlon(*truth[view.frame]) + rectified.offset_en_m
        ground = ground_at(area, plane.frame, place)
        assert rectified.valid.all()
        found = np.eye(2, 3, dtype=np.float32)
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-6)
        alike, found = cv2.findTransformECC(
            ground, rectified.grey, found, cv2.MOTION_TRANSLATION, stop
        )
        assert np.hypot(*found[:, 2]) < 0.1 and alike > 0.9


def test_errors_have_the_stated_size(area, plane, exact, tmp_path):
    errors = Errors(yaw_std_deg=4.0, agl_std=0.05, tilt_std_deg=1.5, prior_std_m=30.0)
    exact, truth = exact
    erring, same = unseen(area, tmp_path / "f", random=len(truth), errors=errors, seed=9)
    assert truth == same
    pairs = [(a.telemetry, b.telemetry) for a, b in zip(exact.views, erring.views, strict=True)]
    yaw = np.array([(b.yaw_deg - a.yaw_deg + 180) % 360 - 180 for a, b in pairs])
    height = np.array([b.agl_m / 100.0 - 1 for _, b in pairs])
    tilt = np.array([[b.pitch_deg, b.roll_deg] for _, b in pairs]).ravel()
    places = np.array([plane.frame.en_from_latlon(*truth[v.frame]) for v in erring.views])
    priors = [b.prior for _, b in pairs]
    prior = plane.frame.en_from_latlon([p.lat_deg for p in priors], [p.lon_deg for p in priors])
    for values, std in ((yaw, 4.0), (height, 0.05), (tilt, 1.5), ((prior - places).ravel(), 30.0)):
        assert values.std() == pytest.approx(std, rel=0.15)
        assert abs(values.mean()) < 4 * std / math.sqrt(len(values))
    assert {p.std_m for p in priors} == {30.0}
    assert {b.yaw_std_deg for _, b in pairs} == {4.0} and {b.agl_std_m for _, b in pairs} == {5.0}
    assert {(a.pitch_deg, a.roll_deg, a.agl_m) for a, _ in pairs} == {(0.0, 0.0, 100.0)}
    assert all(a.prior is None for a, _ in pairs)


def test_positions_and_headings_are_arbitrary(plane, exact):
    flight, truth = exact
    places = np.array([plane.frame.en_from_latlon(*value) for value in truth.values()])
    for step in (1.0, 8.0, 16.0, 40.0):
        rest = places.ravel() % step / step
        assert abs(rest.mean() - 0.5) < 0.08 and rest.std() == pytest.approx(0.289, abs=0.04)
    assert np.ptp(places, axis=0) == pytest.approx([1060, 860], abs=60)
    yaw = np.array([view.telemetry.yaw_deg for view in flight.views])
    assert np.histogram(yaw, 4, (0, 360))[0].min() > 25


def bytes_of(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_the_same_seed_gives_the_same_bytes(area, tmp_path):
    errors = Errors(5.0, 0.05, 1.0, 2.0, 40.0)
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        flown(area, tmp_path / name, random=2, errors=errors, seed=seed, effects=ViewEffects())
    assert bytes_of(tmp_path / "a") == bytes_of(tmp_path / "b") != bytes_of(tmp_path / "c")
    long = flown(area, tmp_path / "d", random=4, errors=errors, seed=1, effects=ViewEffects())[1]
    assert list(read_truth(tmp_path / "a/truth.csv").items()) == list(long.items())[:2]


def test_a_route(area, plane, tmp_path):
    corners = np.array([[-300.0, -200.0], [-300.0, 100.0], [200.0, 100.0]])
    flight, truth = unseen(
        area,
        tmp_path / "f",
        random=None,
        route=route_of(plane.frame, *corners),
        spacing_m=50.0,
        airspeed_mps=20.0,
    )
    places = np.array([plane.frame.en_from_latlon(*truth[view.frame]) for view in flight.views])
    assert len(places) == 17 and places[0] == pytest.approx(corners[0], abs=0.01)
    assert np.linalg.norm(np.diff(places, axis=0), axis=1) == pytest.approx(50, abs=0.05)
    yaw = np.array([view.telemetry.yaw_deg for view in flight.views])
    assert set(yaw[:6].round(1) % 360) == {0.0} and set(yaw[7:].round(1)) == {90.0}
    seconds = np.array([view.telemetry.time_ns / 1e9 for view in flight.views])
    assert seconds == pytest.approx(np.arange(17) * 2.5, abs=1e-6)


def test_the_folder(area, tmp_path, names_in):
    flight, truth = flown(area, tmp_path / "f", camera=LENS, agl_m=60.0, random=2)
    frames = [view.frame for view in flight.views]
    assert flight.camera == LENS and frames == list(truth) == ["0001.jpg", "0002.jpg"]
    assert names_in(tmp_path) == sorted(
        ["f", "f/flight.json", "f/frames", "f/telemetry.csv", "f/truth.csv"]
        + [f"f/frames/{frame}" for frame in frames]
    )
    assert area.past.name in flight.note and json.loads((tmp_path / "f/flight.json").read_text())
    assert flight.views[0].grey().shape == (240, 320)
    header = (tmp_path / "f/telemetry.csv").read_text().splitlines()[0]
    assert header == "frame,time_s,yaw_deg,pitch_deg,roll_deg,agl_m,tilt_std_deg"


REFUSED = {
    "too high": ({"agl_m": 5000.0}, AreaError, "fly lower"),
    "too low": ({"agl_m": 0.1}, UsageError, "1 to 50,000"),
    "nan": ({"agl_m": math.nan}, UsageError, "1 to 50,000"),
    "none": ({"random": 0}, UsageError, "random must be 1 to"),
    "neither": ({"random": None}, UsageError, "either a route or"),
    "turn": ({"turn_radius_m": -1.0}, UsageError, "turn_radius_m"),
    "corners": ({"turn_radius_m": 10.0}, UsageError, "turn_radius_m: only along a route"),
    "odometry": ({"errors": Errors(velocity_drift=0.0)}, UsageError, "drift: only along a route"),
    "ahead": ({"camera_pitch_deg": 70.0}, UsageError, "camera_pitch_deg must be 0 to 65"),
}


@pytest.mark.parametrize("request_, error, message", REFUSED.values(), ids=REFUSED.keys())
def test_flights_that_cannot_be(area, tmp_path, names_in, request_, error, message):
    with pytest.raises(error, match=message):
        flown(area, tmp_path / "out" / "f", **request_)
    assert [name for name in names_in(tmp_path) if name != "out"] == []


@pytest.mark.parametrize(
    "request_, message",
    [
        ({"spacing_m": 1e-6}, "with a view every 1e-06 m has more than"),
        *(
            ({name: value}, "above 0")
            for name in ("spacing_m", "airspeed_mps")
            for value in (0.0, math.inf, math.nan)
        ),
    ],
)
def test_routes_that_cannot_be_are_refused_before_views_are_placed(
    area, plane, tmp_path, monkeypatch, request_, message
):
    monkeypatch.setattr(flight_module, "steady_path", None)
    route = route_of(plane.frame, [0.0, 0.0], [100.0, 0.0])
    with pytest.raises(UsageError, match=message):
        flown(area, tmp_path / "f", random=None, route=route, **request_)


def test_views_keep_off_missing_imagery(make_ortho, tmp_path):
    grey = np.full((300, 300), 100, np.uint8)
    grey[:, :150] = 0
    ortho = make_ortho(tmp_path / "half.tif", grey, nodata=0)
    request = SimulateRequest(
        [ortho], tmp_path / "f", random=20, agl_m=50.0, camera=SMALL, effects=PLAIN
    )
    simulate_flight(request)
    for view in open_flight(tmp_path / "f").views:
        assert view.grey().min() > 90


@pytest.mark.parametrize(
    "name, value",
    [
        ("yaw_std_deg", -1.0),
        ("agl_std", 5.0),
        ("tilt_std_deg", 90.0),
        ("mount_std_deg", 21.0),
        ("velocity_drift", math.nan),
        ("yaw_bias_deg", 270.0),
        ("pitch_bias_deg", -45.0),
        ("roll_bias_deg", math.inf),
        ("jpeg_quality", 0),
        ("blur_px", -1),
        ("noise_std", 1e9),
    ],
)
def test_impossible_values_are_refused(name, value):
    kind = Errors if hasattr(Errors, name) else ViewEffects
    with pytest.raises(UsageError, match=r"must be -?\d"):
        kind(**{name: value})


@pytest.mark.parametrize(
    "error, expected",
    [(OSError(errno.ENOSPC, "No space left on device"), OutputError), (KeyboardInterrupt(),) * 2],
    ids=["disk", "interrupt"],
)
def test_a_failure_leaves_nothing(area, tmp_path, names_in, monkeypatch, error, expected):
    whole, calls = FlightWriter.add, []

    def add(*arguments, **keywords):
        calls.append(1)
        if len(calls) == 3:
            raise error
        whole(*arguments, **keywords)

    monkeypatch.setattr(FlightWriter, "add", add)
    with pytest.raises(expected if isinstance(expected, type) else type(expected)):
        flown(area, tmp_path / "f")
    assert len(calls) == 3 and names_in(tmp_path) == []


def test_a_route_with_swapped_latitude_and_longitude_is_named(area, tmp_path):
    latlon = Mosaic.open([area.present]).outline_latlon_deg
    lat, lon = (float(value) for value in latlon.mean(axis=0))
    swapped = Route(((lon, lat), (lon, lat + 0.001)))
    with pytest.raises(AreaError, match=HINT):
        flown(area, tmp_path / "f", random=None, route=swapped)
    assert not any(tmp_path.iterdir())
