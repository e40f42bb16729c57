"""Inputs as they are: other runs, missing and resized images, odd arrays, wrong options."""

import json
import math
import shutil
from dataclasses import astuple, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers import change_rows, shorten
from orthonav.cli import main
from orthonav.core.errors import FlightError, VariantError
from orthonav.core.flight import open_flight
from orthonav.core.flight.fixes import Identity, flight_digest, read_identity, read_results
from orthonav.core.geo.camera import Camera
from orthonav.core.localize.confidence import Acceptance
from orthonav.core.mapfile import open_map
from orthonav.core.records import Prior, Telemetry, View, grey_levels

CAMERA = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
NADIR = Telemetry(0, 0.0, 0.0, 0.0, 100.0)
GREY = np.random.default_rng(0).integers(0, 256, (48, 64)).astype(np.uint8)


@pytest.fixture(scope="module")
def few(flight_path, tmp_path_factory):
    """A flight of four views, not to be changed."""
    return shorten(shutil.copytree(flight_path, tmp_path_factory.mktemp("few") / "flight"), 4)


@pytest.fixture(scope="module")
def fixes(map_path, few):
    """Its fixes, not to be changed."""
    path = few.parent / "fixes.jsonl"
    assert main(["localize", str(map_path), str(few), "--out", str(path), "-q"]) == 0
    return path


def test_the_truth_is_that_of_the_flight(run, fixes, few, tmp_path):
    done = run("evaluate", fixes, "--flight", few)
    lines = done.out.splitlines()
    assert (done.code, done.err) == (0, "") and "confident" in lines[0]
    assert lines[1].startswith(("Covariances are ", "Whether covariances are right"))
    assert run("evaluate", fixes, "--truth", few / "truth.csv").out == done.out
    again = shutil.copy(fixes, tmp_path / "again.jsonl")
    runs = json.loads(run("evaluate", fixes, again, "--flight", few, "--json").out)["runs"]
    assert {name: each["n_views"] for name, each in runs.items()} == {"fixes": 4, "again": 4}
    limited = run("evaluate", fixes, "--flight", few, "--alert-limit-m", "35", "--risk", "0.01")
    assert "available at the alert limit of 35 m" in limited.out and "risk of 0.01" in limited.out


def test_fixes_state_their_map_and_flight(fixes, few, map_path):
    first, *others = (json.loads(line) for line in fixes.read_text().splitlines())
    stated = Identity(open_map(map_path).manifest.sha256, flight_digest(open_flight(few).views))
    assert (first["map_sha256"], first["flight_sha256"]) == astuple(stated)
    assert not any("map_sha256" in each for each in others)
    assert read_identity(fixes) == stated and len(read_results(fixes)) == 4
    assert stated.differences(stated, map_path, few) == ""
    assert Identity().differences(stated, map_path, few) == ""


def test_fixes_of_another_run_are_named(run, fixes, few, map_path, tmp_path):
    def turn(number, row):
        row["yaw_deg"] = float(row["yaw_deg"]) + 1

    other = shutil.copytree(few, tmp_path / "other")
    change_rows(other / "telemetry.csv", turn)
    stated = fixes.read_text().replace(open_map(map_path).manifest.sha256, "0" * 64)
    fixes = tmp_path / "fixes.jsonl"
    fixes.write_text(stated)
    of_map, of_flight = f"another map (00000000) than {map_path}", "another flight ("
    done = run("evaluate", fixes, "--truth", other / "truth.csv", "--map", map_path)
    assert done.code == 0 and of_map in done.err and of_flight in done.err
    done = run("locate-pixel", fixes, "0001.jpg", 10, 20, "--flight", other)
    assert done.code == 0 and of_flight in done.err and of_map not in done.err


def test_swapped_true_positions_end_every_command(run, fixes, few, map_path, tmp_path):
    def swap(number, row):
        row["lat_deg"], row["lon_deg"] = row["lon_deg"], row["lat_deg"]

    def lose_first(number, row):  # a receiver without a fix
        row.update({"lat_deg": 0, "lon_deg": 0} if number == 0 else {})

    turned = shutil.copytree(few, tmp_path / "turned")
    swapped = turned / "truth.csv"
    change_rows(swapped, swap)
    lost = shutil.copytree(turned, tmp_path / "lost")
    change_rows(lost / "truth.csv", lose_first)
    none = tmp_path / "none.jsonl"
    none.write_text(fixes.read_text().replace('"status": "fix"', '"status": "no_fix"'))
    none.write_text(none.read_text().replace('"reason": null', '"reason": "blank"'))
    for command in (
        ["evaluate", fixes, "--truth", swapped],
        ["evaluate", none, "--truth", swapped, "--map", map_path],
        ["view", fixes, "--map", map_path, "--truth", swapped],
        ["calibrate", map_path, turned, "--out", tmp_path / "m", "--prior-std-m", 5],
        ["calibrate", map_path, lost, "--out", tmp_path / "m", "--prior-std-m", 5],
    ):
        done = run(*command)
        assert (done.code, done.out) == (1, ""), command
        assert "latitude and longitude seem to be swapped" in done.err


def test_only_recorded_positions_calibrate_a_mount(run, few, map_path, tmp_path, monkeypatch):
    """Other priors of a flight are guesses, and no measurements."""
    flight = shutil.copytree(few, tmp_path / "flight")
    header, *rows = (flight / "truth.csv").read_text().splitlines()
    (flight / "truth.csv").write_text("\n".join([header, *rows[:2]]) + "\n")
    guess = {"prior_lat_deg": 46.5, "prior_lon_deg": 2.5, "prior_std_m": 5000}
    change_rows(flight / "telemetry.csv", lambda number, row: row.update(guess))
    tracked = []

    def located(_, tracker, flight, views, shown, heights):
        tracked.extend(view.telemetry.prior for view in views)
        raise FlightError("enough")

    monkeypatch.setattr("orthonav.cli.calibrate.located", located)
    calibrate = ["calibrate", map_path, flight, "--out", tmp_path / "mount.json"]
    assert "enough" in run(*calibrate, "--prior-std-m", 5).err
    measured = [tuple(map(float, row.split(",")[1:3])) for row in rows[:2]]
    assert tracked == [*(Prior(*place, 5.0) for place in measured), None, None]
    tracked.clear()
    assert "enough" in run(*calibrate).err and tracked == [None] * 4
    (flight / "truth.csv").unlink()
    done = run(*calibrate, "--prior-std-m", 5)
    assert done.code == 2 and "no view has one" in done.err


def test_lines_of_health_are_skipped(run, fixes, few, tmp_path):
    lines = fixes.read_text().splitlines()
    mixed = tmp_path / "lines.jsonl"
    mixed.write_text('{"health": "OK", "reasons": []}\n' + "\n".join([*lines, '{"health": "OK"}']))
    assert run("evaluate", mixed, "--flight", few).code == 0
    assert read_identity(mixed) == read_identity(fixes)


def test_a_dash_is_stdout(run, fixes, few, map_path):
    done = run("localize", map_path, few, "--out", "-", "--export", "csv=-")
    lines, table = done.out.splitlines()[:4], done.out.splitlines()[4:]
    assert [json.loads(line)["frame"] for line in lines] == [f"000{i}.jpg" for i in range(1, 5)]
    assert table[0].startswith("frame,lat_deg") and done.err.startswith("4 views: ")
    assert not Path("-").exists()


def test_missing_images_are_skipped_and_counted(run, few, map_path, tmp_path):
    flight, out = shutil.copytree(few, tmp_path / "flight"), tmp_path / "fixes.jsonl"
    (flight / "frames" / "0001.jpg").unlink()
    (flight / "frames" / "0003.jpg").write_bytes(b"")
    done = run("localize", map_path, flight, "--out", out)
    assert done.code == 1 and "0001.jpg" in done.err and "--skip-bad-images" in done.err
    done = run("localize", map_path, flight, "--out", out, "--skip-bad-images")
    assert done.code == 0 and "2 without a position (bad_image 2)" in done.out
    assert run("evaluate", out, "--flight", flight).code == 0
    plain = run("localize", map_path, flight, "--out", out, "--skip-bad-images", "--json").out
    assert json.loads(plain)["reasons"] == {"bad_image": 2}


def test_images_of_another_size_are_scaled_in_a_flight_folder(run, few, map_path, tmp_path):
    flight, out = shutil.copytree(few, tmp_path / "flight"), tmp_path / "fixes.jsonl"
    for path in sorted((flight / "frames").iterdir()):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(path), cv2.resize(image, None, fx=0.75, fy=0.75, interpolation=3))
    assert open_flight(flight).camera.width_px == 0.75 * open_flight(few).camera.width_px
    plain = json.loads(run("localize", map_path, flight, "--out", out, "--json").out)
    assert plain["n_confident"] >= 3
    cv2.imwrite(str(flight / "frames" / "0001.jpg"), GREY)
    cv2.imwrite(str(flight / "frames" / "0002.jpg"), GREY[:20])
    done = run("localize", map_path, flight, "--out", out)
    assert done.code == 1 and "another aspect ratio" in done.err and "0002.jpg" in done.err


@pytest.mark.parametrize(
    "options",
    [
        *(["--alert-limit-m", text] for text in ("0.9", "100001", "nan", "far")),
        *(["--risk", text] for text in ("1e-7", "0.6", "0", "nan")),
        ["--alert-limit-m", "35", "--accept", "confidence:0.9"],
    ],
)
def test_an_alert_limit_and_a_risk_are_limited_and_replace_the_criterion(run, few, fixes, options):
    for command in (["localize", "m", few], ["fly", "m", few], ["evaluate", fixes]):
        done = run(*command, *options)
        assert done.code == 2 and options[-2] in done.err


def test_a_fix_is_confident_up_to_the_alert_limit(run, few, map_path, tmp_path):
    """Others are written too; risk and limit change no position."""
    out, command = tmp_path / "f.jsonl", ["localize", map_path, few, "--risk", "0.1", "--out"]

    def lines(*options):
        done = run(*command, out, *options)
        assert done.code == 0, done.err
        return done.out, [json.loads(line) for line in out.read_text().splitlines()]

    _, before = lines()
    levels_m = sorted(line["protection_level_m"] or math.inf for line in before)
    assert levels_m[0] < levels_m[1]
    limit_m = (levels_m[0] + min(levels_m[1], 2 * levels_m[0])) / 2
    said, after = lines("--alert-limit-m", str(limit_m))
    assert [line["confident"] for line in after].count(True) == 1
    for one, other in zip(before, after, strict=True):
        assert other["confident"] is ((other["protection_level_m"] or math.inf) <= limit_m)
        assert (one["lat_deg"], one["risk"]) == (other["lat_deg"], 0.1)
    assert "1 confident (a protection level of at most" in said
    assert f"above the alert limit ({levels_m.count(math.inf)} infinite: place in doubt)" in said


@pytest.mark.parametrize(
    "text", ["confidence:90", "confidence:0", "confidence:-1", "confidence:nan", "peak_ratio:0.5"]
)
def test_thresholds_that_make_no_sense_name_the_option(run, few, map_path, tmp_path, text):
    with pytest.raises(VariantError, match="--accept"):
        Acceptance.parse(text)
    for command in (
        ["localize", map_path, few, "--out", tmp_path / "f.jsonl"],
        ["fly", map_path, few, "--recorded-telemetry", "--dry-run"],
    ):
        done = run(*command, "--accept", text)
        assert done.code == 2 and "--accept" in done.err and not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    "image",
    [
        GREY[:, :, None],
        np.dstack([GREY] * 3),
        np.dstack([GREY] * 4),
        GREY.astype(np.uint16) << 8,
        GREY.astype(np.float32),
        GREY / 255.0,
        GREY.astype(np.int64),
    ],
)
def test_images_are_converted(image):
    found = View(image, CAMERA, NADIR).grey
    assert found.dtype == np.uint8 and found.shape == GREY.shape and np.ptp(found) > 200
    np.testing.assert_array_equal(found, GREY)


def test_deep_colours_with_alpha_and_the_other_byte_order():
    deep = GREY.astype(np.uint16) * 12
    alpha = np.full_like(deep, 65535)
    seen = View(np.dstack([deep, deep, deep, alpha]), CAMERA, NADIR).grey
    np.testing.assert_allclose(seen, View(deep, CAMERA, NADIR).grey, atol=1)
    np.testing.assert_array_equal(View(deep.astype(">u2"), CAMERA, NADIR).grey, seen)


@pytest.mark.parametrize("first, step", [(7000, 3), (29_000, 8), (0, 16), (300, 31)])
def test_a_small_part_of_16_bits_is_stretched(first, step):
    """Thermal cameras of 14 bits, temperatures in 0.01 K, and 12 bits in 16."""
    found = View((GREY.astype(np.uint16) * step + first).astype(np.uint16), CAMERA, NADIR).grey
    assert np.ptp(found) == 255 and np.corrcoef(found.ravel(), GREY.ravel())[0, 1] > 0.999
    noise = np.random.default_rng(1).normal(first, 1.3, GREY.shape).clip(0).astype(np.uint16)
    assert View(noise, CAMERA, NADIR).grey.std() < 3  # still uniform


@pytest.mark.parametrize(
    ("image", "said"),
    [
        (None, "None"),
        (GREY > 9, "bool"),
        (GREY - 300.0, "values of -300"),
        (np.full((48, 64), np.nan), "values of nan"),
        (np.stack([GREY] * 3), r"shape \(3, 48, 64\)"),
        (GREY[:0], "shape"),
        (GREY.astype(np.int32) * 9, "values of 0 to"),
        (GREY.astype(complex), "complex"),
    ],
)
def test_what_is_no_image_is_refused(image, said):
    with pytest.raises(FlightError, match=f"{said}.*expected"):
        grey_levels(image)


def test_a_camera_is_scaled_to_the_image():
    half = View(GREY[::2, ::2], CAMERA, NADIR)
    assert half.camera == CAMERA.resized(32, 24)
    assert View(GREY, CAMERA, NADIR).camera is CAMERA
    assert replace(half, grey=GREY).camera == CAMERA
