"""Simulated flights: the picture shows the ground at the truth, the telemetry errs as stated."""

import errno
import itertools
import math

import cv2
import numpy as np
import pytest
from simulated import FISH, LENS, SEEN, WIDE, frame_of, route_of

from helpers import content
from orthonav.core.errors import AreaError, OutputError, UsageError
from orthonav.core.flight import FlightWriter
from orthonav.core.geo.camera import ground_en_m
from orthonav.core.geo.swapped import HINT
from orthonav.core.localize import downsampled, rectify
from orthonav.core.records import View
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.route import Route
from orthonav.ground.simulate import flight as flight_module
from orthonav.ground.simulate.flight import Errors
from orthonav.ground.simulate.render import ViewEffects

SIZE_PX = 96
ALL = Errors(5.0, 0.05, 1.0, 2.0, 40.0)


def ground_at(ortho, frame, place_en_m):
    west_m, north_m = place_en_m + np.array([-SIZE_PX / 2, SIZE_PX / 2])
    size = {"width_px": SIZE_PX, "height_px": SIZE_PX, "gsd_m": 1.0}
    with Mosaic.open([ortho]).sheet(frame, west_m=west_m, north_m=north_m, **size) as raster:
        return raster.read(0, 0, SIZE_PX, SIZE_PX).grey


@pytest.mark.parametrize(
    "camera, attitude_std_deg",
    [(SEEN, 0.0), (SEEN, 6.0), (LENS, 6.0), (FISH, 6.0)],
    ids=["pinhole level", "pinhole", "lens", "fisheye"],
)
def test_the_picture_shows_the_ground_at_the_truth(area, fly, camera, attitude_std_deg):
    errors, frame = Errors(attitude_std_deg=attitude_std_deg), frame_of(area.past)
    request = {"random": 3, "camera": camera, "agl_m": 150.0, "errors": errors, "seed": 4}
    flight, truth, _ = fly(over=area.past, **request)
    for view in flight.views:
        seen = View(view.grey(), camera, view.telemetry)
        rectified = rectify(downsampled(seen, 1.0), gsd_m=1.0, size_px=SIZE_PX)
        place = frame.en_from_latlon(*truth[view.frame]) + rectified.offset_en_m
        ground = ground_at(area.past, frame, place)
        assert rectified.valid.all()
        found = np.eye(2, 3, dtype=np.float32)
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-6)
        translation = cv2.MOTION_TRANSLATION, stop
        alike, found = cv2.findTransformECC(ground, rectified.grey, found, *translation)
        assert np.hypot(*found[:, 2]) < 0.1 and alike > 0.9


def test_a_wide_lens_shows_the_ground_up_to_its_corners(area, fly):
    frame = frame_of(area.past)
    flight, truth, _ = fly(over=area.past, random=3, camera=WIDE, agl_m=150.0, seed=4)
    corner = np.stack(np.meshgrid(np.arange(20) + 0.5, np.arange(20) + 0.5), axis=-1)
    for view, (col, row) in itertools.product(flight.views, [(0, 0), (300, 0), (0, 220)]):
        px = corner.reshape(-1, 2) + np.array([col, row])
        yaw_deg = view.telemetry.yaw_deg
        there = frame.en_from_latlon(*truth[view.frame])
        there = there + ground_en_m(WIDE, px, yaw_deg, 0.0, 0.0, 150.0)
        middle = there.mean(axis=0)
        at = (there - middle) * [1, -1] + SIZE_PX / 2 - 0.5
        maps = at.astype(np.float32).reshape(20, 20, 2)
        ground = cv2.remap(ground_at(area.past, frame, middle), maps, None, cv2.INTER_LINEAR)
        seen = view.grey()[row : row + 20, col : col + 20]
        assert np.abs(seen.astype(float) - ground).mean() < 3.0


def test_errors_have_the_stated_size(frame, fly):
    errors = Errors(yaw_std_deg=4.0, agl_std=0.05, tilt_std_deg=1.5, prior_std_m=30.0)
    unseen = {"random": 180, "seed": 9, "pictures": False}
    (exact, truth, _), (erring, same, _) = fly(**unseen), fly(**unseen, errors=errors)
    assert truth == same
    pairs = [(a.telemetry, b.telemetry) for a, b in zip(exact.views, erring.views, strict=True)]
    yaw = np.array([(b.yaw_deg - a.yaw_deg + 180) % 360 - 180 for a, b in pairs])
    height = np.array([b.agl_m / 100.0 - 1 for _, b in pairs])
    tilt = np.array([[b.pitch_deg, b.roll_deg] for _, b in pairs]).ravel()
    places = np.array([frame.en_from_latlon(*truth[v.frame]) for v in erring.views])
    priors = [b.prior for _, b in pairs]
    prior = frame.en_from_latlon([p.lat_deg for p in priors], [p.lon_deg for p in priors])
    for values, std in ((yaw, 4.0), (height, 0.05), (tilt, 1.5), ((prior - places).ravel(), 30.0)):
        assert values.std() == pytest.approx(std, rel=0.15)
        assert abs(values.mean()) < 4 * std / math.sqrt(len(values))
    assert {p.std_m for p in priors} == {30.0}
    assert {b.yaw_std_deg for _, b in pairs} == {4.0} and {b.agl_std_m for _, b in pairs} == {5.0}
    assert {(a.pitch_deg, a.roll_deg, a.agl_m, a.prior) for a, _ in pairs} == {(0, 0, 100, None)}
    # Positions and headings are arbitrary, never on a grid.
    for step in (1.0, 8.0, 16.0, 40.0):
        rest = places.ravel() % step / step
        assert abs(rest.mean() - 0.5) < 0.08 and rest.std() == pytest.approx(0.289, abs=0.04)
    assert np.ptp(places, axis=0) == pytest.approx([1060, 1060], abs=60)
    headings = np.array([view.telemetry.yaw_deg for view in exact.views])
    assert np.histogram(headings, 4, (0, 360))[0].min() > 25


def test_the_same_seed_gives_the_same_bytes(fly):
    flown = {"errors": ALL, "effects": ViewEffects()}
    first, again, other = (content(fly(random=2, seed=n, **flown)[0].path) for n in (1, 1, 2))
    assert first == again != other
    short, long = (fly(random=n, seed=1, **flown)[1] for n in (2, 4))
    assert list(short.items()) == list(long.items())[:2]


def test_a_route(frame, fly):
    corners = np.array([[-300.0, -200.0], [-300.0, 100.0], [200.0, 100.0]])
    along = {"route": route_of(frame, *corners), "spacing_m": 50.0, "airspeed_mps": 20.0}
    flight, truth, _ = fly(pictures=False, **along)
    places = np.array([frame.en_from_latlon(*truth[view.frame]) for view in flight.views])
    assert len(places) == 17 and places[0] == pytest.approx(corners[0], abs=0.01)
    assert np.linalg.norm(np.diff(places, axis=0), axis=1) == pytest.approx(50, abs=0.05)
    yaw = np.array([view.telemetry.yaw_deg for view in flight.views])
    assert set(yaw[:6].round(1) % 360) == {0.0} and set(yaw[7:].round(1)) == {90.0}
    seconds = np.array([view.telemetry.time_ns / 1e9 for view in flight.views])
    assert seconds == pytest.approx(np.arange(17) * 2.5, abs=1e-6)


def test_the_folder(ortho, fly):
    flight, truth, _ = fly(camera=LENS, agl_m=60.0, random=2)
    frames = [view.frame for view in flight.views]
    assert flight.camera == LENS and frames == list(truth) == ["0001.jpg", "0002.jpg"]
    written = content(flight.path)
    tables = {"flight.json", "telemetry.csv", "truth.csv"}
    assert set(written) == tables | {f"frames/{frame}" for frame in frames}
    assert ortho.name in flight.note and flight.views[0].grey().shape == (240, 320)
    header = written["telemetry.csv"].decode().splitlines()[0]
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
def test_flights_that_cannot_be(fly, tmp_path, request_, error, message):
    with pytest.raises(error, match=message):
        fly(**{"random": 5, **request_})
    assert not any(tmp_path.iterdir())


def test_routes_that_cannot_be_are_refused_before_views_are_placed(frame, fly, monkeypatch):
    monkeypatch.setattr(flight_module, "steady_path", None)
    route = route_of(frame, [0.0, 0.0], [100.0, 0.0])
    with pytest.raises(UsageError, match="with a view every 1e-06 m has more than"):
        fly(route=route, spacing_m=1e-6)
    for name in ("spacing_m", "airspeed_mps"):
        for value in (0.0, math.inf, math.nan):
            with pytest.raises(UsageError, match="above 0"):
                fly(route=route, **{name: value})


def test_views_keep_off_missing_imagery(make_ortho, tmp_path, fly):
    grey = np.full((300, 300), 100, np.uint8)
    grey[:, :150] = 0
    ortho = make_ortho(tmp_path / "half.tif", grey, nodata=0)
    flight, _, _ = fly(over=ortho, random=20, agl_m=50.0)
    assert min(view.grey().min() for view in flight.views) > 90


IMPOSSIBLE = {
    "yaw_std_deg": -1.0, "agl_std": 5.0, "tilt_std_deg": 90.0, "mount_std_deg": 21.0,
    "velocity_drift": math.nan, "yaw_bias_deg": 270.0, "pitch_bias_deg": -45.0,
    "roll_bias_deg": math.inf, "jpeg_quality": 0, "blur_px": -1, "noise_std": 1e9,
}  # fmt: skip


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_impossible_values_are_refused(name):
    kind = Errors if hasattr(Errors, name) else ViewEffects
    with pytest.raises(UsageError, match=r"must be -?\d"):
        kind(**{name: IMPOSSIBLE[name]})


@pytest.mark.parametrize(
    "error, expected",
    [(OSError(errno.ENOSPC, "No space left"), OutputError), (KeyboardInterrupt(), None)],
    ids=["disk", "interrupt"],
)
def test_a_failure_leaves_nothing(fly, tmp_path, monkeypatch, error, expected):
    whole, calls = FlightWriter.add, []

    def add(*arguments, **keywords):
        calls.append(1)
        if len(calls) == 3:
            raise error
        whole(*arguments, **keywords)

    monkeypatch.setattr(FlightWriter, "add", add)
    with pytest.raises(expected or type(error)):
        fly(random=5)
    assert len(calls) == 3 and not any(tmp_path.iterdir())


def test_a_route_with_swapped_latitude_and_longitude_is_named(frame, fly, tmp_path):
    swapped = Route(((frame.lon_deg, frame.lat_deg), (frame.lon_deg, frame.lat_deg + 0.001)))
    with pytest.raises(AreaError, match=HINT):
        fly(route=swapped)
    assert not any(tmp_path.iterdir())
