"""Arguments that a caller may get wrong are named; records are values."""

import copy
import dataclasses
import json
import math
import os
import pickle
import sys
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import orthonav
from orthonav import Camera, Fix, Localizer, NoFix, Prior, Telemetry, Tracker, View, ViewResult
from orthonav.core.errors import ArgumentError, FlightError, MissingExtraError
from orthonav.core.flight.fixes import result_to_json, write_results
from orthonav.ground.recordings import SourceOptions
from orthonav.ground.view.run import ViewRequest

CAMERA = Camera.from_fov(65, 64, 48)
GREY = np.arange(64 * 48, dtype=np.uint8).reshape(48, 64)
COV = np.array([[4.0, 1.0], [1.0, 9.0]])
FIX = Fix(48.0, 2.0, COV, 0.95, 35.0, 10.0, 100.0, pose_cov=np.eye(6), ground_latlon_deg=(48, 2.1))
NO_FIX = NoFix("blank", "nothing to see", {"share": math.nan})
TELEMETRY = Telemetry(5, math.nan, 0.0, 1.0, 100.0, prior=Prior(48.0, 2.0, 30.0))
RECORDS = [FIX, NO_FIX, TELEMETRY, View(GREY, CAMERA, TELEMETRY), CAMERA, Prior(1, 2, 3),
           ViewResult("a.jpg", 10**9 + 1, FIX, 7.0, "tracking")]  # fmt: skip


@pytest.mark.parametrize("record", RECORDS, ids=lambda each: type(each).__name__)
def test_records_are_values(record):
    for other in (pickle.loads(pickle.dumps(record)), copy.deepcopy(record)):
        assert other == record and hash(other) == hash(record)
    assert record != "another type" and dataclasses.asdict(record)


def test_records_with_other_values_differ():
    assert dataclasses.replace(FIX, cov_en_m2=COV + 1e-9) != FIX
    assert dataclasses.replace(FIX, evidence={"score": 0.5}) != FIX
    assert NoFix("blank", "") != NoFix("dark", "")
    assert View(GREY + 1, CAMERA, TELEMETRY) != View(GREY, CAMERA, TELEMETRY)


def test_a_view_keeps_its_picture():
    """A program may read the next picture into the same memory; a track compares both."""
    buffer = GREY.copy()
    view = View.of(buffer, CAMERA, agl_m=100.0)
    buffer[:] = 0
    assert (view.grey == GREY).all() and not view.grey.flags.writeable


def test_plain_values_are_those_of_the_file(tmp_path):
    for result in (ViewResult("a.jpg", 10**9, FIX, 7.0, "tracking"), ViewResult("b", 0, NO_FIX, 1)):
        assert json.loads(json.dumps(result.to_dict())) == json.loads(result_to_json(result))
        own = result.outcome.to_dict()
        assert own.items() <= result.to_dict().items() and "frame" not in own
    results = [ViewResult("a.jpg", 10**9, FIX, 7.0), ViewResult("b", 0, NO_FIX, 1.0)]
    write_results(tmp_path / "fixes.jsonl", results)
    shown = orthonav.to_geojson(str(tmp_path / "fixes.jsonl"))
    (feature,) = shown["features"]
    assert feature["geometry"] == {"type": "Point", "coordinates": [2.0, 48.0]}
    assert feature["properties"]["frame"] == "a.jpg" and shown["type"] == "FeatureCollection"
    assert feature["properties"]["std_m"] == pytest.approx(FIX.std_m, abs=1e-4)
    assert len(orthonav.to_geojson([FIX, NO_FIX])["features"]) == 1


def test_a_table_of_fixes(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match="pip install pandas"):
        orthonav.to_dataframe([FIX])
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(json_normalize=lambda rows: rows))
    assert orthonav.to_dataframe([FIX, NO_FIX]) == [FIX.to_dict(), NO_FIX.to_dict()]


@pytest.mark.parametrize(
    "values, message",
    [
        ((48.0, 2.0, -5), "std_m must be metres, 0 or more, got -5"),
        ((math.nan, 2.0, 5), "lat_deg must be -90 to 90"),
        ((200, 2.0, 5), "lat_deg must be -90 to 90, before the longitude, got 200"),
        ((2.0, math.inf, 5), "lon_deg must be"),
        (("48", 2.0, 5), "lat_deg must be .* got '48'"),
    ],
)
def test_impossible_priors(values, message):
    with pytest.raises(ArgumentError, match=message):
        Prior(*values)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"heading_std_deg": -1}, "heading_std_deg must be 0 or more"),
        ({"agl_std_m": math.nan}, "agl_std_m must be 0 or more"),
        ({"tilt_std_deg": "1"}, "tilt_std_deg must be 0 or more"),
        ({"agl_m": "270"}, "agl_m must be a number, got '270'"),
        ({"agl_m": None}, "agl_m must be a number, got None"),
        ({"pitch_deg": None}, "pitch_deg must be a number"),
        ({"heading_deg": "N"}, "heading_deg must be a number"),
        ({"prior": (48.8, 2.3)}, r"prior must be an orthonav.Prior\(lat_deg.*, got tuple"),
        ({"time_s": math.nan}, "time_s must be in seconds"),
        ({"time_s": 1.7e12}, "time_s must be in seconds, not ms or ns, got 17"),
        ({"camera": None}, "camera must be an orthonav.Camera, .* got NoneType"),
        ({"camera": np.eye(3)}, "camera must be an orthonav.Camera, .* got ndarray"),
        ({"vel_en_mps": 5}, "vel_en_mps must be a pair, east and north, m/s, got '5'"),
    ],
)
def test_arguments_of_a_view(change, message):
    with pytest.raises(ArgumentError, match=message):
        View.of(**({"image": GREY, "camera": CAMERA, "agl_m": 100.0} | change))
    assert isinstance(ArgumentError(""), TypeError | ValueError)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"time_ns": "5"}, "time_ns must be whole nanoseconds, got '5'"),
        ({"time_ns": math.nan}, "time_ns must be whole nanoseconds, got nan"),
        ({"yaw_deg": "N"}, "yaw_deg must be a number, got 'N'"),
        ({"yaw_std_deg": "1"}, "yaw_std_deg must be a number, got '1'"),
        ({"prior": (48.8, 2.3, 5)}, r"prior must be an orthonav.Prior\(lat_deg.*, got tuple"),
        ({"below": 40.0}, "below must be an orthonav.Ground, got float"),
        ({"vel_en_mps": (1, 2, 3)}, "vel_en_mps must be a pair, east and north"),
    ],
)
def test_arguments_of_telemetry(change, message):
    with pytest.raises(ArgumentError, match=message):
        dataclasses.replace(TELEMETRY, **change)


@pytest.mark.parametrize("kind", [np.float32, np.array, Fraction, Decimal])
def test_every_kind_of_number(kind):
    stds = {"heading_std_deg": kind(5), "agl_std_m": kind(4), "tilt_std_deg": kind(3)}
    made = View.of(GREY, CAMERA, agl_m=kind(100), time_s=kind(2), **stds).telemetry
    expected = Telemetry(2 * 10**9, math.nan, 0, 0, 100, 5, 4, tilt_std_deg=3)
    assert made == expected and json.dumps(dataclasses.asdict(made))
    moved = dataclasses.replace(made, time_ns=kind(7), vel_en_mps=np.array([kind(1), 2.0]))
    assert (moved.time_ns, moved.vel_en_mps) == (7, (1.0, 2.0))
    prior = Prior(kind(48), kind(2), kind(30))
    assert prior == Prior(48.0, 2.0, 30.0) and json.dumps(dataclasses.asdict(prior))
    camera = Camera(kind(64), kind(48), kind(60), kind(60), kind(32), kind(24))
    assert json.dumps(camera.numbers()) and camera.fx_px == 60.0


def test_what_is_no_view_is_named(map_path):
    localizer = Localizer(orthonav.open_map(map_path))
    for locate in (localizer.locate, Tracker(localizer).locate):
        with pytest.raises(ArgumentError, match=r"view must be .* View.of\(..\), got ndarray"):
            locate(GREY)
    with pytest.raises(ArgumentError, match=r"telemetry must be an orthonav\.Telemetry"):
        View(GREY, CAMERA, None)


def test_a_path_is_no_image(tmp_path):
    for path in ("a.jpg", tmp_path / "a.jpg"):
        with pytest.raises(FlightError, match="image is a path, read it first"):
            View.of(path, CAMERA, agl_m=100.0)


class OtherPath(os.PathLike):
    def __init__(self, path):
        self.path = str(path)

    def __fspath__(self):
        return self.path


@pytest.mark.parametrize("kind", [str, OtherPath])
def test_every_kind_of_path(map_path, flight_path, tmp_path, kind):
    map_ = orthonav.open_map(kind(map_path))
    assert orthonav.read_truth(kind(flight_path / "truth.csv"))
    assert orthonav.open_flight(kind(flight_path)).views
    assert Camera.from_file(kind(flight_path / "flight.json")).width_px
    request = orthonav.BuildRequest(kind("a.tif"), kind(tmp_path / "a.onav"))
    assert request.out == tmp_path / "a.onav" and len(request.orthos) == 1
    flown = orthonav.SimulateRequest([kind("a.tif")], kind("flight"), random=1)
    assert (flown.orthos, flown.out) == ((Path("a.tif"),), Path("flight"))
    assert SourceOptions(camera=kind("a.json")).camera == Path("a.json")
    assert ViewRequest(kind("a.jsonl"), kind("a.onav")).map_path == Path("a.onav")
    assert map_.gsd_m == map_.manifest.sheets[0].grid.gsd_m and "+proj=aeqd" in map_.crs
    assert map_.frame.en_from_latlon(map_.frame.lat_deg, map_.frame.lon_deg).tolist() == [0, 0]
    known = {each["date"] for each in map_.manifest.imagery if "date" in each}
    assert set(map_.dates) >= known and list(map_.dates) == sorted(map_.dates)


def test_what_is_no_limit_and_no_risk_is_named():
    for call, message in (
        (lambda: FIX.probability_within("35"), "limit_m must be metres, got '35'"),
        (lambda: FIX.protection_level_m(1.1), "risk must be a probability, 0 to 1, got 1.1"),
        (lambda: FIX.protection_level_m(None), "risk must be .* got None"),
    ):
        with pytest.raises(ArgumentError, match=message):
            call()


def test_what_is_no_path_is_named():
    calls = orthonav.open_map, orthonav.open_flight, orthonav.read_truth, Camera.from_file
    for call in (*calls, orthonav.read_results):
        with pytest.raises(ArgumentError, match=r"must be text or an os\.PathLike, got NoneType"):
            call(None)


def test_what_is_no_map_is_named(map_path):
    for make in (Localizer, Tracker):
        with pytest.raises(ArgumentError, match=r"map must be .*open_map\(path\), got str"):
            make(str(map_path))


def test_a_prior_of_another_type_is_named(map_path, area):
    localizer = Localizer(map=orthonav.open_map(map_path))
    grey = np.zeros((240, 320), np.uint8)
    with pytest.raises(ArgumentError, match="prior must be an orthonav"):
        localizer.localize(grey, area.camera, agl_m=300.0, prior=(48.8, 2.3))
    found = localizer.localize(grey, area.camera, agl_m=300.0, heading_deg=math.nan)
    assert found.detail == "not a number: heading_deg (yaw_deg)"
    assert "0 of 255 or darker" in localizer.localize(grey, area.camera, agl_m=300.0).detail


@pytest.mark.parametrize("step_s", [0.0, -1.0, 500_000.0, 5e8])
def test_times_of_a_track_grow(map_path, area, step_s, caplog):
    tracker = Tracker(orthonav.open_map(map_path), heading_known=False)
    grey = np.zeros((240, 320), np.uint8)
    tracker.update(grey, area.camera, time_s=1000.0, agl_m=300.0)
    tracker.update(grey, area.camera, time_s=1000.0 + step_s, agl_m=300.0)
    assert f"time_s changed by {step_s:+g} s since the image before" in caplog.text
    caplog.clear()
    tracker.update(grey, area.camera, time_s=1000.5 + step_s, agl_m=300.0)
    assert not caplog.text
