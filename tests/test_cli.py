"""Every command as it is typed: what it prints, how it exits, what it leaves behind."""

import contextlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys

import cv2
import numpy as np
import pytest
from PIL import Image

from helpers import Done, change_rows, refused, shorten
from orthonav import __version__
from orthonav.cli import COMMANDS, common, main, module_of
from orthonav.core.flight import open_flight
from orthonav.core.flight.fixes import read_results
from orthonav.core.geo.ground import unknown_slope_share
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix
from orthonav.ground.report.drawing import Drawing

SIMULATE = ["simulate", "--random", "3", "--agl-m", "60"]
WHOLE_MAP = ["--tile-px", "64", "--overlap", "0.75"]
SMALL_MAP = ["--tile-px", "64", "--overlap", "0.75", "--no-registration"]


def swap(number, row):
    row["lat_deg"], row["lon_deg"] = row["lon_deg"], row["lat_deg"]


def process(*arguments):
    """A command in a process of its own."""
    words = [sys.executable, "-B", "-m", "orthonav", *map(str, arguments)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.fixture(scope="module")
def ortho(make_ortho, tmp_path_factory):
    """An orthophoto of 400 x 400 m."""
    return make_ortho(tmp_path_factory.mktemp("cli") / "2020.tif")


@pytest.fixture(autouse=True)
def fewer_crops(map_path, monkeypatch):
    """Calibration from few crops and views, but for the map that all tests share."""
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 24)
    monkeypatch.setattr("orthonav.ground.build.calibrate.ENOUGH_RIGHT", 1)


@pytest.fixture
def out(tmp_path):
    """A folder that holds nothing, for what a command writes."""
    folder = tmp_path / "out"
    folder.mkdir()
    return folder


@pytest.fixture
def flown(flight_path, tmp_path):
    """A copy of the flight, to be broken."""
    return shutil.copytree(flight_path, tmp_path / "flight")


@pytest.fixture
def undrawn(monkeypatch):
    """Reports have no pictures, which take longest."""
    nothing = Drawing(b"", "", (1.0, 1.0))
    for name in ("draw_axes", "draw_figure"):
        monkeypatch.setattr(f"orthonav.ground.evaluate.report.{name}", lambda *_: nothing)


@pytest.fixture(scope="module")
def fixes_path(map_path, flight_path, tmp_path_factory):
    path = tmp_path_factory.mktemp("fixes") / "fixes.jsonl"
    assert main(["localize", str(map_path), str(flight_path), "--out", str(path), "-q"]) == 0
    return path


@pytest.fixture(scope="module")
def truth_path(flight_path):
    return flight_path / "truth.csv"


def test_build(run, ortho, out, names_in):
    done = run("build", "--ortho", ortho, *WHOLE_MAP, "--out", out / "a.onav")
    assert (done.code, done.err) == (0, "") and "km2" in done.out and "built in" in done.out
    assert "terrain    none: rolling land" in done.out and "--dem FILE" in done.out
    assert "1.6 % of the height where its tilt is known to 1 deg, 2.9 %" in done.out
    again = run("build", "--ortho", ortho, *SMALL_MAP, "--out", out / "b.onav", "--json", "-q")
    assert (again.code, again.err) == (0, "")
    plain = json.loads(again.out)
    assert plain["map"] == str(out / "b.onav") and plain["tiles"] > 300 and plain["build_s"] > 0
    assert names_in(out) == ["a.onav", "b.onav"]


@pytest.mark.parametrize("method", [(), ("--method", "bovw:words=64")])
def test_checkpoints_are_those_of_a_network(run, ortho, out, names_in, method):
    done = run("build", "--ortho", ortho, *method, "--work", out / "w", "--out", out / "a.onav")
    assert done.code == 2 and "training of a network: give --method autoencoder" in done.err
    assert names_in(out) == []


@pytest.mark.parametrize(
    "options",
    [
        ["--edges", "canny:low=50,high=120", "--method", "gradient:dims=16"],
        ["--edges", "gray", "--gsd-m", "2", "--tile-px", "32"],
        ["--seed", "7", "--overlap", "0.5"],
    ],
)
def test_build_options_are_in_the_recipe(run, ortho, out, options):
    done = run("build", "--ortho", ortho, *SMALL_MAP, *options, "--json", "--out", out / "m.onav")
    assert done.code == 0
    recipe = json.loads(done.out)["recipe"]
    assert recipe == open_map(out / "m.onav").manifest.recipe
    if "canny" in options[1]:
        assert recipe["represent"]["low"] == 50 and recipe["embed"]["dims"] == 16


def test_relief_is_in_the_map(run, ortho, out):
    built = ("build", "--ortho", ortho, *SMALL_MAP, "--out", out / "m.onav", "--relief", "level")
    done = run(*built)
    assert done.code == 0 and "terrain    none: level land" in done.out
    assert open_map(out / "m.onav").manifest.sheets[0].relief == "level"
    assert json.loads(run("info", out / "m.onav", "--json").out)["relief"] == "level"
    share = unknown_slope_share(1.0, "level")
    assert f"{100 * share:.1f} % of the height" in run("info", out / "m.onav").out


def test_info(run, map_path):
    done = run("info", map_path)
    assert "terrain    none: rolling land is assumed" in done.out
    assert (done.code, done.err) == (0, "")
    assert str(map_path) in done.out and "2.5 m per pixel" in done.out and "2016-07" in done.out
    plain = json.loads(run("info", map_path, "--json").out)
    manifest = open_map(map_path).manifest
    assert plain["radius_m"] == manifest.registration["radius_m"] == 35.0  # that fixes state
    assert plain["tile_radius_m"] == manifest.radius_m != 35.0
    assert "confidence probability of an error below 35 m" in done.out
    assert plain["tiles"] == open_map(map_path).manifest.sheets[0].tiles and plain["calibrated"]
    west, south, east, north = plain["sheets"][0]["bounds_deg"]
    assert west < plain["sheets"][0]["centre_lon_deg"] < east and south < north
    assert plain["size_mb"] == pytest.approx(map_path.stat().st_size / 1e6, abs=1e-3)


def test_localize(run, map_path, flown, short_flight, out, names_in):
    done = run("localize", map_path, short_flight, "--out", out / "fixes.jsonl", "--json")
    assert (done.code, done.err) == (0, "") and names_in(out) == ["fixes.jsonl"]
    plain = json.loads(done.out)
    assert plain["views"] == plain["n_confident"] + plain["n_low_confidence"] == 8
    assert plain["n_confident"] > 5 and plain["median_latency_ms"] > 0 and not plain["advice"]
    lines = [json.loads(line) for line in (out / "fixes.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == [f"{n:04d}.jpg" for n in range(1, 9)]
    assert {line["status"] for line in lines} == {"fix"}
    assert sum(line["confident"] for line in lines) == plain["n_confident"]
    few = shorten(flown, 2)
    to = ["--out", out / "fixes.jsonl", "--prior", "none"]
    text = run("localize", map_path, few, *to, "--export", f"csv={out / 'cameras.csv'}")
    assert text.code == 0 and "2 views: " in text.out
    cameras = (out / "cameras.csv").read_text().splitlines()
    assert f"{len(cameras) - 1} camera positions: " in text.out
    refused(run("localize", map_path, few, *to, "--export", "shp=a.shp"), "odm-geo", code=2)
    assert "confident (confidence 0.9 or more), " in text.out


def test_localize_without_what_a_mask_hides(run, map_path, short_flight, out):
    flight = shorten(shutil.copytree(short_flight, out / "flight"), 3)
    frames = sorted((flight / "frames").iterdir())
    rows, cols = cv2.imread(str(frames[0]), cv2.IMREAD_GRAYSCALE).shape
    mask = np.full((rows, cols), 255, np.uint8)
    mask[: rows // 3] = 0
    cv2.imwrite(str(out / "mask.png"), mask)
    to = ["localize", map_path, flight, "--out", out / "fixes.jsonl", "--json", "--mask"]
    placed = []
    for seed in (1, 2):
        text = np.random.default_rng(seed).integers(0, 255, (rows // 3 - 16, cols, 1))
        for path in frames:
            image = cv2.imread(str(path))
            image[: rows // 3 - 16] = text
            cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 100])
        assert json.loads(run(*to, out / "mask.png").out)["n_confident"] == 3
        fixes = read_results(out / "fixes.jsonl")
        placed.append([(each.outcome.lat_deg, each.outcome.lon_deg) for each in fixes])
    np.testing.assert_allclose(*placed, atol=1e-6)  # 0.1 m, of another compression
    refused(run(*to, out / "none.png"), "mask of the camera")
    copy = run("import", flight, "--out", out / "copy", "--mask", out / "mask.png")
    refused(copy, "keeps no mask", code=2)


def test_locate_pixel(run, map_path, flight_path, fixes_path):
    to = ["locate-pixel", fixes_path, "0001.jpg", 10, 20, "--flight", flight_path]
    plain = json.loads(run(*to, "--json").out)
    placed = json.loads(fixes_path.read_text().splitlines()[0])
    assert abs(plain["lat_deg"] - placed["lat_deg"]) < 0.01 and plain["height_m"] is None
    assert plain["confident"] == placed["confident"]
    assert plain["ellipse_95"]["major_m"] >= plain["ellipse_95"]["minor_m"] > 0
    assert list(plain["ellipse_95"]) == ["major_m", "minor_m", "direction_deg"]
    text = run(*to)
    assert text.code == 0 and "95 % ellipse" in text.out
    refused(run(*to[:2], "none.jpg", *to[3:]), "no view 'none.jpg'")
    refused(run(*to, "--map", map_path), "no terrain")


def test_locate_pixel_counts_in_the_image_as_stored(run, flight_path, fixes_path, flown):
    """Also where the orientation of EXIF has other programs turn it; it says so."""
    exif = Image.Exif()
    exif[0x0112] = 3
    data, segment = (flown / "frames/0001.jpg").read_bytes(), exif.tobytes()
    segment = b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment
    (flown / "frames/0001.jpg").write_bytes(data[:2] + segment + data[2:])
    found = []
    for folder, said in ((flight_path, False), (flown, True)):
        done = run("locate-pixel", fixes_path, "0001.jpg", 10, 20, "--flight", folder, "--json")
        found.append(json.loads(done.out))
        assert found[-1].pop("shown_turned") is said
        assert ("X and Y count as stored" in done.err) == said
    assert found[0] == found[1]


@pytest.mark.long
def test_calibrate_and_fly_with_it(run, map_path, flown, out, monkeypatch):
    monkeypatch.setattr("orthonav.ground.recordings.setups.FEW", 0.0)  # no other configurations
    mount, fixes, few = out / "mount.json", out / "fixes.jsonl", shorten(flown, 10)
    done = run("calibrate", map_path, few, "--out", mount, "--prior-std-m", "5")
    assert (done.code, done.err) == (0, "")
    assert "pitch, deg" in done.out and str(mount) in done.out
    plain = json.loads(mount.read_text())
    assert abs(plain["heading_deg"]["value"]) < 8 and 5 <= plain["views"] <= 10
    to = ["--out", fixes, "--mount", mount]
    shorten(few, 4)
    assert run("localize", map_path, few, *to, "--smooth").code == 0
    turned = json.loads(mount.read_text())
    turned["heading_deg"]["value"] = 90.0
    mount.write_text(json.dumps(turned))
    assert run("localize", map_path, few, *to, "--json").code == 0
    found = [result.outcome for result in read_results(fixes)]
    assert not any(isinstance(each, Fix) and each.confidence > 0.9 for each in found)
    refused(run("localize", map_path, few, "--out", mount, "--mount", fixes), "mount file")


def test_evaluate(run, fixes_path, truth_path, map_path, out, names_in, undrawn):
    of = ("evaluate", fixes_path, "--truth", truth_path)
    done = run(*of, "--map", map_path, "--report", out / "report")
    assert (done.code, done.err) == (0, "") and "fixes" in done.out and "index.html" in done.out
    names = [name for name in names_in(out) if not name.startswith("report/figures/")]
    assert names == ["report", "report/figures", "report/index.html"]
    assert (out / "report" / "figures" / "reliability.svg").is_file()
    metrics = json.loads(run(*of, "--radius-m", "40", "--json").out)
    assert metrics["n_views"] == 30 and metrics["radius_m"] == 40
    assert metrics["acc_at_15m"] <= metrics["acc_at_40m"] and metrics["acc_at_40m"] >= 0.9
    assert json.loads(run(*of, "--json").out)["radius_m"] == 15


def test_a_map_of_another_area_is_named(run, map_path, flown, out):
    """Nothing is tried where the recorded positions lie elsewhere."""
    few = shorten(flown, 4)
    change_rows(few / "truth.csv", swap)
    sure = ["--accept", "confidence:0.9999999"]
    done = run("localize", map_path, few, "--out", out / "f.jsonl", "--json", *sure)
    plain = json.loads(done.out)
    assert plain["n_confident"] == 0 and plain["setups"] == []
    assert "seem to be swapped" in done.err and "seem to be swapped" in plain["advice"][0]


def test_simulate(run, ortho, out, names_in):
    fly = ["simulate", "--ortho", ortho, "--agl-m", "60"]
    done = run(*fly, "--random", "3", "--prior-std-m", "20", "--out", out / "random")
    assert (done.code, done.err) == (0, "") and "3 views written" in done.out
    assert "prior_lat_deg" in (out / "random" / "telemetry.csv").read_text()
    route = out / "route.csv"
    route.write_text("lat_deg,lon_deg\n46.4980,3.0020\n46.4985,3.0030\n")
    camera = out / "random" / "flight.json"
    along = ["--route", route, "--spacing-m", "20", "--camera", camera, "--turn-radius-m", "50"]
    errors = ["--agl-std", "0.05", "--velocity-drift", "0.02"]
    done = run(*fly, *along, *errors, "--out", out / "route", "--json")
    assert done.code == 0 and json.loads(done.out)["views"] == 5
    telemetry = open_flight(out / "route").views[0].telemetry
    assert telemetry.vel_en_mps is not None and telemetry.agl_m != 60
    assert not [name for name in names_in(out) if name.startswith(".")]


def test_the_program_is_installed():
    popen = process("--version")
    assert popen.communicate(timeout=120) == (f"orthonav {__version__}\n", "")
    assert popen.returncode == 0


@pytest.mark.parametrize("command", [None, *COMMANDS])
def test_help(run, command):
    done = run(*([command] if command else []), "--help")
    assert done.code == 0 and done.err == "" and "usage: orthonav" in done.out
    if command is None:
        assert all(name in done.out for name in COMMANDS)
    else:
        assert COMMANDS[command] in " ".join(done.out.split()) and "--quiet" in done.out


@pytest.mark.parametrize(
    "arguments",
    [
        ["fly-away"],
        ["localize", "a.onav", "flight", "--out", "c", "--head", "unknown"],
        ["--vers"],
        ["info"],
        ["build", "--out", "a.onav"],
        ["build", "--ortho", "a", "--out", "b", "--bounds", "1,2,3"],
        ["build", "--ortho", "a", "--out", "b", "--tile-px", "big"],
        ["build", "--ortho", "a", "--out", "b", "--route", "r", "--bounds", "1,2,3,4"],
        ["simulate", "--ortho", "a", "--out", "b"],
        ["simulate", "--ortho", "a", "--out", "b", "--route", "r", "--random", "3"],
        ["check", "a.onav", "--out", "b", "--heading", "maybe"],
        ["check", "a.onav", "--out", "b", "--heading", "unknown", "--yaw-std-deg", "3"],
    ],
    ids=" ".join,
)
def test_wrong_usage(run, tmp_path, monkeypatch, names_in, arguments):
    monkeypatch.chdir(tmp_path)
    done = run(*arguments)
    assert done.code == 2 and done.out == "" and done.err.startswith("usage: orthonav")
    assert "orthonav" in done.err.splitlines()[-1] and "error: " in done.err
    assert names_in(tmp_path) == []


def test_build_refuses(run, ortho, out, names_in, make_ortho, tmp_path):
    def built(*arguments):
        return run("build", *arguments, "--out", out / "map.onav")

    text = tmp_path / "text.tif"
    text.write_text("not a picture")
    no_crs = make_ortho(tmp_path / "no_crs.tif", crs=None)
    nothing = make_ortho(tmp_path / "nothing.tif", np.zeros((400, 400), np.uint8), nodata=0)
    cut = tmp_path / "cut.tif"
    cut.write_bytes(ortho.read_bytes()[:60_000])
    route = tmp_path / "route.csv"
    route.write_text("lat_deg,lon_deg\n46.0,3.0\n46.001,3.0\n")
    good, small = ["--ortho", ortho], SMALL_MAP
    refused(built("--ortho", tmp_path / "no.tif"), "does not exist", "no.tif")
    refused(built("--ortho", text, *small), "text.tif")
    refused(built("--ortho", cut, *small), "cut.tif")
    refused(built("--ortho", no_crs, *small), "coordinate reference system", "no_crs.tif")
    refused(built("--ortho", nothing, *small))
    refused(built(*good, "--bounds=5.0,46.0,5.01,46.01", *small), "the orthophotos cover")
    refused(built(*good, "--bounds=5.0,46.0,4.0,46.01", *small), "west < east", code=2)
    refused(built(*good, "--tile-px", "1024"), "larger than the area")
    refused(built(*good, "--tile-px", "100"), "--tile-px must be a multiple of 32", code=2)
    refused(built(*good, "--gsd-m", "0", *small), "--gsd-m must be", code=2)
    refused(built(*good, "--overlap", "1.0"), "--overlap", code=2)
    refused(built(*good, "--band-m", "100"), "--route", code=2)
    refused(built(*good, "--route", route), "--band-m", code=2)
    refused(built(*good, "--route", route, "--band-m", "50", *small), "no imagery")
    refused(built(*good, "--route", tmp_path / "no.csv", "--band-m", "50"), "does not exist")
    refused(built(*good, "--method", "magic"), "unknown variant 'magic'", code=2)
    refused(built(*good, "--edges", "canny:low=300,high=100"), "canny", code=2)
    assert names_in(out) == []


def test_a_map_cannot_be_written_there(run, ortho, out, names_in):
    (out / "file").write_text("in the way")
    (out / "folder.onav").mkdir()
    build = ["build", "--ortho", ortho, *SMALL_MAP, "--out"]
    refused(run(*build, out / "file" / "map.onav"), "cannot write")
    refused(run(*build, out / "folder.onav"), "cannot write")
    assert names_in(out) == ["file", "folder.onav"]


def test_bad_maps(run, map_path, flight_path, fixes_path, truth_path, out, names_in):
    bad, data = out / "bad.onav", bytearray(map_path.read_bytes())
    data[-5000] ^= 1
    bad.write_bytes(data)
    refused(run("info", bad), "altered", str(bad))
    refused(run("localize", bad, flight_path, "--out", out / "fixes.jsonl"), "altered", str(bad))
    report = ["--map", bad, "--report", out / "report"]
    refused(run("evaluate", fixes_path, "--truth", truth_path, *report), "altered", str(bad))
    assert names_in(out) == ["bad.onav"]


BAD_FLIGHTS = {
    "no folder": (shutil.rmtree, "does not exist"),
    "camera is no json": (lambda f: (f / "flight.json").write_text("{"), "flight.json"),
    "empty telemetry": (lambda f: (f / "telemetry.csv").write_text(""), "columns are missing"),
    "missing image": (lambda f: (f / "frames/0002.jpg").unlink(), "0002.jpg"),
    "cut image": (
        lambda f: (f / "frames/0002.jpg").write_bytes((f / "frames/0002.jpg").read_bytes()[:3000]),
        "0002.jpg",
    ),
}


@pytest.mark.parametrize("break_, word", BAD_FLIGHTS.values(), ids=BAD_FLIGHTS.keys())
def test_bad_flights(run, map_path, flown, out, names_in, break_, word):
    break_(flown)
    refused(run("localize", map_path, flown, "--out", out / "fixes.jsonl"), word)
    assert names_in(out) == []


@pytest.mark.parametrize("value", ["nan", "", "unknown", "inf"])
@pytest.mark.parametrize("column", ["yaw_deg", "agl_m"])
def test_views_without_telemetry_do_not_end_a_flight(run, map_path, flown, out, column, value):
    first = shorten(flown, 2) / "telemetry.csv"
    change_rows(first, lambda number, row: row.update({column: value} if number == 0 else {}))
    done = run("localize", map_path, flown, "--out", out / "fixes.jsonl", "--json")
    assert (done.code, done.err) == (0, "") and json.loads(done.out)["n_none"] == 1
    outcome = read_results(out / "fixes.jsonl")[0].outcome
    assert outcome.reason == "missing_telemetry"


def test_evaluate_refuses(run, fixes_path, truth_path, out, names_in, tmp_path, undrawn):
    def evaluated(fixes, truth, *more):
        return run("evaluate", fixes, "--truth", truth, *more)

    broken, other = tmp_path / "broken.jsonl", tmp_path / "other.csv"
    broken.write_text(fixes_path.read_text()[:-20])
    other.write_text("frame,lat_deg,lon_deg\nelse.jpg,46.0,3.0\n")
    refused(evaluated(tmp_path / "no.jsonl", truth_path), "does not exist")
    refused(evaluated(fixes_path, tmp_path / "no.csv"), "does not exist")
    refused(evaluated(broken, truth_path), "line 30")
    refused(evaluated(fixes_path, fixes_path), "columns are missing")
    refused(evaluated(fixes_path, other), "same flight")
    twice = evaluated(fixes_path, truth_path, "--truth", other)
    refused(twice, "give --truth once per file", code=2)
    refused(evaluated(fixes_path, truth_path, "--radius-m", "0"), "--radius-m must be", code=2)
    refused(run("evaluate", fixes_path), "give --flight", code=2)
    (out / "file").write_text("in the way")
    refused(evaluated(fixes_path, truth_path, "--report", out / "file" / "report"), "cannot write")
    assert names_in(out) == ["file"]


def test_simulate_refuses(run, ortho, out, names_in, tmp_path):
    def simulated(*arguments):
        return run("simulate", "--ortho", ortho, *arguments, "--out", out / "flight")

    route = tmp_path / "route.csv"
    route.write_text("lat_deg,lon_deg\n46.498,3.002\n46.60,3.002\n")
    random, low = ["--random", "3"], ["--agl-m", "60"]
    refused(simulated("--random", "0"), "--random must be", code=2)
    refused(simulated("--route", route, *low), "within the imagery")
    refused(simulated("--route", route, *low, "--spacing-m", "0"), "--spacing-m must be", code=2)
    refused(simulated("--route", tmp_path / "no.csv", *low), "does not exist")
    refused(simulated(*random, *low, "--agl-std", "5"), "--agl-std must be", "0.05 is 5 %", code=2)
    assert names_in(out) == []
    (out / "flight").mkdir()
    (out / "flight" / "mine").write_text("mine")
    refused(simulated(*random, *low), "not empty")
    assert names_in(out) == ["flight", "flight/mine"]


@pytest.fixture
def writing(ortho, map_path, short_flight, fixes_path, truth_path, out):
    """One call of every command that writes, by name."""
    return {
        "build": ["build", "--ortho", ortho, *SMALL_MAP, "--out", out / "map.onav"],
        "simulate": [*SIMULATE, "--ortho", ortho, "--out", out / "flight"],
        "localize": ["localize", map_path, short_flight, "--out", out / "fixes.jsonl"],
        "evaluate": ["evaluate", fixes_path, "--truth", truth_path, "--report", out / "report"],
    }


@pytest.fixture(scope="module")
def short_flight(flight_path, tmp_path_factory):
    """Its first views, whose fixes fill more than a page of a disk."""
    return shorten(shutil.copytree(flight_path, tmp_path_factory.mktemp("short") / "flight"), 8)


WRITERS = ["build", "simulate", "localize", "evaluate"]


@contextlib.contextmanager
def largest_file(size_bytes):
    """The kernel refuses to write more to a file."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("name", WRITERS)
def test_no_room_for_the_whole_file(run, writing, out, name, undrawn):
    with largest_file(4096):
        done = run(*writing[name])
    refused(done, "File too large")
    assert list(out.iterdir()) == []  # nor hidden temporaries


@pytest.mark.parametrize("name", [*WRITERS, "check"])
def test_outputs_are_tested_before_the_work(run, writing, map_path, out, name, monkeypatch):
    command = [*map(str, writing.get(name, ["check", map_path, "--out", out / "check"]))]
    monkeypatch.setattr(module_of(command[0]), "run", lambda options: pytest.fail("it worked"))
    (out / "file").write_text("in the way")
    refused(run(*command[:-1], out / "file" / "x"), f"not a folder: {out / 'file'})")
    monkeypatch.setattr(os, "access", lambda *_: False)
    refused(run(*command), "cannot write (no permission, or a read-only disk: ", command[-1])
    monkeypatch.undo()
    monkeypatch.setattr(module_of(command[0]), "run", lambda options: pytest.fail("it worked"))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(9, 9, 0))
    refused(run(*command), "disk full; nothing was written", command[-1])


def test_a_folder_is_no_place_for_a_file(run, map_path, short_flight, out):
    done = run("localize", map_path, short_flight, "--out", out)
    refused(done, "cannot write over a folder or a device", str(out))


def test_no_output_replaces_an_input_or_another_output(run, map_path, short_flight, out):
    made = out / "fixes.jsonl"
    command = ("localize", map_path, short_flight)
    for more in (("--out", map_path), ("--out", made, "--export", f"csv={made}")):
        refused(run(*command, *more), "would replace an input or another output")
    route = out / "route.csv"
    route.write_text("lat,lon\n46.5,2.5\n")
    refused(run("plan", "--route", route, "--agl-m", 300, "--out", route), "would replace an input")
    assert route.read_text().startswith("lat,lon") and not made.exists()


def test_a_reader_that_has_gone_is_no_traceback(fixes_path, truth_path):
    with process("evaluate", fixes_path, "--truth", truth_path) as popen:
        popen.stdout.close()
        err = popen.stderr.read()
    assert popen.returncode == 1 and err == ""


INTERRUPTED = "orthonav: error: interrupted; nothing was written\n"


@pytest.mark.parametrize(
    "name, stage, code",
    [
        ("build", "imagery", 130),
        ("build", "calibrate", 143),
        ("simulate", "simulate", 130),
        ("localize", "localize", 143),
    ],
)
def test_an_interrupt_leaves_nothing(run, writing, out, monkeypatch, name, stage, code):
    class Interrupted(common.Progress):
        def __call__(self, at, share):
            if at == stage and share > 0:
                if code == 143:
                    signal.raise_signal(signal.SIGTERM)
                raise KeyboardInterrupt

    monkeypatch.setattr(common, "Progress", Interrupted)
    assert run(*writing[name]) == Done(code, "", INTERRUPTED)
    assert list(out.iterdir()) == []  # nor hidden temporaries
