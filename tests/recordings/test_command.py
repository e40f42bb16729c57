"""`orthonav import` as it is typed, and `localize` of a source as of its import."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from bags import Messages, record
from PIL import Image
from recorders import START_S, camera_file, packet, photo, place, tlog, video

from orthonav.core.errors import FlightError
from orthonav.core.flight import FlightWriter, open_flight, read_image
from orthonav.core.flight.fixes import read_results
from orthonav.core.geo.camera import Camera
from orthonav.core.records import Fix, Telemetry
from orthonav.ground.recordings.recording import SourceOptions
from orthonav.ground.view.run import Run, ViewRequest

DATA = Path(__file__).parents[1] / "data"
MAP = DATA / "golden_v1.onav"
VIEW = read_image(DATA / "golden_view.png")
PLACE = 46.499856, 2.999830  # of the stored view, with heading 20 and height 160
SIDES = {"width_px": 160, "height_px": 160, "fx_px": 200.0, "fy_px": 200.0}
SIDES |= {"cx_px": 80.0, "cy_px": 80.0}


@pytest.fixture
def camera(tmp_path):
    return camera_file(tmp_path / "camera.json", **SIDES)


def seen(seed):
    """The stored view with noise of its own."""
    noise = np.random.default_rng(seed).normal(0, 3, VIEW.shape)
    return np.clip(VIEW + noise, 0, 255).astype(np.uint8)


XMP = packet(
    GimbalYawDegree="20.0",
    GimbalPitchDegree="-90.0",
    GimbalRollDegree="0.0",
    RelativeAltitude="160.0",
)


def photographs(folder, at=None):
    """PNG photographs of DJI, with an orientation tag that is not to turn them."""
    gps = () if at is None else place(*at)
    for index in range(2):
        time, more = f"2023:11:14 22:13:2{index}", {"pixels": seen(index), "first": {0x0112: 6}}
        photo(folder / f"{index}.png", time, xmp=XMP, gps=gps, **more)
    return folder


def filmed(folder):
    """A lossless video of 2 s with a table of what was known."""
    folder.mkdir()
    path = video(folder / "film.mkv", 10, 5.0, shown=seen)
    path.with_suffix(".csv").write_text(
        "time_s,yaw_deg,pitch_deg,roll_deg,agl_m\n0,19,0,0,160\n1,21,0,0,160\n2,21,0,0,160\n"
    )
    return path


def bag(folder, form):
    """A recording of ROS messages at that place."""
    messages = Messages(ros1=form == "bag")
    stamps = [START_S * 10**9 + index * 333_333_333 for index in range(4)]
    body = messages.turn(70)
    topics = {
        "/cam": [(t, messages.image(t, seen(i))) for i, t in enumerate(stamps[1:3])],
        "/imu": [(t, messages.imu(t, body)) for t in stamps],
        "/height": [(t, messages.altitude(t, 160.0, 160.0)) for t in stamps],
        "/fix": [(t, messages.fix(t, *PLACE)) for t in stamps],
    }
    return record(folder, topics, messages, form)


def folder_of(path):
    """A flight folder."""
    path.mkdir()
    writer = FlightWriter(path, Camera(**SIDES), "as it was")
    for index in range(2):
        telemetry = Telemetry(index * 10**9, 20.0, 0.0, 0.0, 160.0)
        writer.add(f"{index}.png", np.dstack([seen(index)] * 3), telemetry, PLACE)
    writer.close()
    return path


MAKERS = {
    "photos": lambda folder: photographs(folder / "photos"),
    "video": lambda folder: filmed(folder / "film"),
    "bag": lambda folder: bag(folder / "bag", "bag"),
    "db3": lambda folder: bag(folder / "db3", "db3"),
    "mcap": lambda folder: bag(folder / "mcap", "file"),
    "flight": lambda folder: folder_of(folder / "recorded"),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", MAKERS)
def test_a_source_is_localized_as_its_import_is(run, kind, tmp_path, camera):
    source = MAKERS[kind](tmp_path)
    telemetry = ["--camera", camera]
    code, out, err = run("import", source, "--out", tmp_path / "flight", *telemetry, "--json")
    taken = "is taken from the height above take-off: level ground is assumed"
    gaps = "", "where none was measured "
    warnings = [f"WARNING: height above ground {each}{taken}\n" for each in gaps]
    said = [line for line in err.splitlines(keepends=True) if "show 2 of 2 photog" not in line]
    assert code == 0 and "".join(said) in ("", *warnings)
    plain = json.loads(out)
    assert plain["kind"] == {"bag": "ros", "db3": "ros", "mcap": "ros"}.get(kind, kind)
    assert plain["views"] == plain["complete"] == 2 and plain["broken"] == 0
    flight = open_flight(tmp_path / "flight")
    assert flight.camera == Camera(**SIDES) and len(flight.views) == 2
    results = []
    for name, path, more in (("a", source, telemetry), ("b", tmp_path / "flight", [])):
        fixes = tmp_path / f"{name}.jsonl"
        assert run("localize", MAP, path, "--out", fixes, *more)[0] == 0
        lines = [json.loads(line) for line in fixes.read_text().splitlines()]
        results.append([{k: v for k, v in line.items() if k != "latency_ms"} for line in lines])
        for result in read_results(fixes):
            assert isinstance(result.outcome, Fix)
            off = np.subtract((result.outcome.lat_deg, result.outcome.lon_deg), PLACE)
            assert np.abs(off * [111e3, 76e3]).max() < 2
    assert results[0] == results[1]


def test_import_of_a_flight_changes_nothing(run, tmp_path):
    source = folder_of(tmp_path / "recorded")
    assert run("import", source, "--out", tmp_path / "flight")[0] == 0
    for path in source.rglob("*.*"):
        assert (tmp_path / "flight" / path.relative_to(source)).read_bytes() == path.read_bytes()
    again = run("import", source, "--out", tmp_path / "prior", "--prior-std-m", "25")
    assert again[0] == 0 and "2 views, 2 with heading, pitch, roll and height, 2 with a" in again[1]
    assert "standard deviation of pitch and roll: not stated, 3 deg are assumed" in again[1]
    assert open_flight(tmp_path / "prior").views[0].telemetry.prior.std_m == 25


def test_a_flight_is_localized_whatever_its_truth(run, tmp_path, names_in):
    source = folder_of(tmp_path / "recorded")
    (source / "truth.csv").write_text("frame,lat_deg,lon_deg\n0.png,north,east\n")
    code, out, err = run("localize", MAP, source, "--out", tmp_path / "fixes.jsonl")
    assert code == 0 and "2 views: 2 confident" in out and "ground truth is ignored: line 2" in err
    before = names_in(tmp_path)
    code, _, err = run("import", source, "--out", source)  # what exists is not replaced
    assert code == 1 and "not empty" in err and names_in(tmp_path) == before


def test_a_damaged_photograph_is_left_out_and_named(run, tmp_path):
    source = tmp_path / "photos"
    for index in range(3):
        photo(source / f"{index}.jpg", f"2023:11:14 22:13:2{index}", seed=index)
    cut(source / "1.jpg", -300)
    code, out, err = run("import", source, "--out", tmp_path / "flight")
    assert code == 0 and "2 views, 0 with heading" in out
    assert "1 views left out, the first" in err and "1.jpg" in err
    fixes = tmp_path / "fixes.jsonl"
    code, _, err = run("localize", MAP, source, "--out", fixes)
    assert code == 1 and "1.jpg" in err and not fixes.exists()
    assert run("localize", MAP, source, "--out", fixes, "--skip-bad-images")[0] == 0
    reasons = [result.outcome.reason for result in read_results(fixes)]
    assert reasons == ["missing_telemetry", "bad_image", "missing_telemetry"]


def cut(path, length=700, data=None):
    path.write_bytes((path.read_bytes() if data is None else data)[:length])
    return path


BROKEN = {
    "nothing": (lambda folder: folder / "none", "does not exist"),
    "empty file": (lambda folder: cut(folder / "a.mp4", data=b""), "source is empty"),
    "empty folder": (lambda folder: (folder / "e").mkdir() or folder / "e", "flight log:"),
    "text": (lambda folder: cut(folder / "a.mp4", data=b"words " * 99), "expected photographs"),
    "a log": (lambda folder: tlog(folder / "a.tlog"), "belongs to --telemetry"),
    "mcap cut": (lambda folder: cut(bag(folder / "b", "file")), "recording was cut short"),
    "bag cut": (lambda folder: cut(bag(folder / "b", "bag")), "rosbag reindex"),
    "no flight": (lambda folder: folder_of(folder / "f") / "frames", "no time in EXIF"),
}


@pytest.mark.parametrize("how", BROKEN)
def test_damaged_input_is_one_line_and_nothing_is_written(run, how, tmp_path, camera, names_in):
    make, message = BROKEN[how]
    source = make(tmp_path)
    before = names_in(tmp_path)
    options = ("--camera", camera_file(tmp_path / "camera.json"))
    for arguments in (
        ("import", source, "--out", tmp_path / "flight"),
        ("localize", MAP, source, "--out", tmp_path / "fixes.jsonl"),
    ):
        code, out, err = run(*arguments, *options)
        assert (code, out) == (1, "") and message in err
        assert err.startswith("orthonav: error: ") and err.count("\n") == 1
    assert names_in(tmp_path) == before


def test_a_recording_far_from_the_map_is_named(run, tmp_path, camera):
    localize = "localize", MAP, tmp_path / "photos", "--out", tmp_path / "a.jsonl"
    photographs(tmp_path / "photos", (46.0, 3.0))
    code, _, err = run(*localize, "--camera", camera)
    assert code == 0 and re.search(r"first view is 5\d km from the map; check the map", err)
    photographs(tmp_path / "photos", PLACE)
    assert "from the map" not in run(*localize, "--camera", camera).err


@pytest.mark.parametrize("kind", ["photos", "video", "ros"])
def test_what_was_localized_is_evaluated_and_viewed_as_it_is(run, tmp_path, camera, kind):
    """The recorded positions are the truth; photographs without any say so."""
    given = ["--camera", camera]
    if kind == "video":
        source = filmed(tmp_path / "v")
        header, *rows = source.with_suffix(".csv").read_text().splitlines()
        rows = [f"{header},lat_deg,lon_deg", *(f"{row},{PLACE[0]},{PLACE[1]}" for row in rows)]
        source.with_suffix(".csv").write_text("\n".join(rows) + "\n")
    else:
        photos = kind == "photos"
        source = photographs(tmp_path / "p", PLACE) if photos else bag(tmp_path / "b", "mcap")
    fixes = tmp_path / "fixes.jsonl"
    assert run("localize", MAP, source, "--out", fixes, *given).code == 0
    done = run("evaluate", fixes, "--flight", source, "--map", MAP, *given, "--json")
    assert done.code == 0 and "another flight" not in done.err
    plain = json.loads(done.out)
    assert plain["n_views"] > 1 and plain["standard"]["cep95_m"] < 5
    options = SourceOptions(camera=camera)
    request = ViewRequest(fixes, MAP, flight=source, source=options)
    if kind != "photos":
        with pytest.raises(FlightError, match="convert it with `orthonav import`"):
            Run(request)
        return
    opened = Run(request)
    assert opened.truth_name == "p" and opened.any_known("err") and opened.raw_jpeg(0)
    photographs(source)
    none = run("evaluate", fixes, "--flight", source, *given)
    assert none.code == 1 and "no positions were recorded; give --truth" in none.err


def test_one_photograph_is_placed_and_printed(run, tmp_path):
    path = tmp_path / "photo.png"
    Image.fromarray(seen(0)).save(path)
    one = ("localize", MAP, path, "--agl-m", 160, "--fov-deg", 43.6)
    code, out, err = run(*one, "--heading", "unknown")
    assert re.search(r"protection +\d+ m, which .* with a probability of at most 0.001\n", out)
    assert code == 0 and "looks straight down is assumed" in err
    lat, lon = map(float, re.search(r"position +([\d.]+), ([\d.]+) ", out).groups())
    assert np.abs(np.subtract((lat, lon), PLACE) * [111e3, 76e3]).max() < 3
    assert re.search(r"heading +(19|20)\.\d deg", out) and re.search(r"height +1[56]\d\.", out)
    code, out, err = run(*one, "--heading", "unknown", "--out", "-")
    (line,) = map(json.loads, out.splitlines())
    assert code == 0 and line["frame"] == "photo.png" and "1 view: " in err
    noise = np.random.default_rng(1).integers(0, 255, seen(0).shape, np.uint8)
    Image.fromarray(cv2.GaussianBlur(noise, (0, 0), 2)).save(tmp_path / "noise.png")
    guess = run(*one[:2], tmp_path / "noise.png", *one[3:], "--heading", "unknown").out
    assert re.search(r"protection +none: the place itself may be wrong .* above 0.001; more", guess)
    unknown = run(*one)
    assert "heading_deg (yaw_deg) (missing_telemetry); give --heading unknown" in unknown.out
    plain = json.loads(run(*one, "--heading", "unknown", "--json").out)
    assert plain["fixes"] is None and plain["positions"][0]["lat_deg"] == pytest.approx(lat)
    both = run(*one, "--dem", path)
    assert both[0] == 2 and "above ground of the views: give it or --dem" in both[2]
    refused = run("localize", MAP, tmp_path)
    assert refused[0] == 2 and "give --out FILE, or --out - for stdout" in refused[2]
