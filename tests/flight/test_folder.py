"""Flight folders come back as they were written; what is broken in them is named."""

import json
import math
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from orthonav.core.errors import CameraError, FlightError, MissingFileError
from orthonav.core.flight import FlightWriter, open_flight, read_image, read_truth
from orthonav.core.geo.camera import Camera
from orthonav.core.records import STRETCHED_PERCENT, Prior, Telemetry

CAMERA = Camera(64, 48, 60.0, 61.5, 32.25, 23.75, (0.01, -0.02, 1e-4, 2e-4))
FULL = Telemetry(
    *(1_500_000_000, -12.5, 1.25, -0.5, 120.0),
    yaw_std_deg=3.0,
    agl_std_m=2.5,
    prior=Prior(46.5, -0.0001, 30.0),
    vel_en_mps=(-3.5, 0.0),
)
BARE = Telemetry(2_000_000_000, math.nan, 0.0, 0.0, 99.75)
HEADER = "frame,time_s,yaw_deg,pitch_deg,roll_deg,agl_m"
ROW = "a.png,1,90,0,0,100"
PRIOR = "prior_lat_deg,prior_lon_deg,prior_std_m"


def scene(height=48, width=64, seed=0):
    """Smooth grey levels (H, W) uint8 over the whole range."""
    noise = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def rgb():
    """Three unlike bands (48, 64, 3)."""
    return np.stack([scene(seed=1), scene(seed=2), scene(seed=3)], axis=-1)


@pytest.fixture
def folder(tmp_path):
    """A flight of three views as the writer leaves it."""
    writer = FlightWriter(tmp_path, CAMERA, "été")
    writer.add("a.png", rgb(), FULL, (46.5, 2.5))
    writer.add("b.jpg", rgb(), BARE, (-46.123456789, 179.5))
    writer.add("c.tif", rgb(), replace(FULL, time_ns=3_000_000_001, prior=None), (0.0, 0.0))
    writer.close()
    return tmp_path


def telemetry(folder, text):
    (folder / "telemetry.csv").write_text(text, encoding="utf-8")
    return folder


def refused(folder, message, error=FlightError, names="telemetry.csv"):
    with pytest.raises(error, match=message) as caught:
        open_flight(folder)
    assert str(caught.value).endswith(str(folder / names))


def test_round_trip(folder):
    flight = open_flight(folder)
    assert flight.camera == CAMERA and flight.note == "été"
    assert [view.frame for view in flight.views] == ["a.png", "b.jpg", "c.tif"]
    assert [Path(view.where) for view in flight.views] == sorted((folder / "frames").iterdir())
    first, second, third = (view.telemetry for view in flight.views)
    assert first == FULL and third.prior is None and third.vel_en_mps == (-3.5, 0.0)
    assert third.time_ns == pytest.approx(3_000_000_001, abs=10)
    assert math.isnan(second.yaw_deg) and second.missing() == ["yaw_deg"]
    assert replace(second, yaw_deg=0.0) == replace(BARE, yaw_deg=0.0)
    truth = read_truth(folder / "truth.csv")
    assert truth == {"a.png": (46.5, 2.5), "b.jpg": (-46.12345679, 179.5), "c.tif": (0.0, 0.0)}


def test_spreadsheets_are_read(folder):
    row = '"a.png", 1.5, 361, , west, 100, , "46.5", 2.5, 30, extra, more'
    text = f"\ufeff{HEADER.replace(',', ', ')}, note, {PRIOR.replace(',', ', ')}\r\n"
    view = open_flight(telemetry(folder, f"{text}{row}\r\n\r\n")).views[0]
    assert view.frame == "a.png" and view.telemetry.time_ns == 1_500_000_000
    assert view.telemetry.yaw_deg == 361 and view.telemetry.prior == Prior(46.5, 2.5, 30.0)
    assert view.telemetry.missing() == ["pitch_deg", "roll_deg"]
    plain = json.loads((folder / "flight.json").read_text())
    del plain["note"], plain["camera"]["distortion"]
    (folder / "flight.json").write_text("\ufeff" + json.dumps(plain), encoding="utf-8")
    flight = open_flight(folder)
    assert flight.camera == replace(CAMERA, distortion=()) and flight.note == ""


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "columns are missing: frame, time_s, yaw_deg, pitch_deg, roll_deg, agl_m"),
        (f"{HEADER[:-6]}\n{ROW[:-4]}\n", "columns are missing: agl_m"),
        (f"{HEADER}\n", "telemetry has no views"),
        (f"{HEADER}\n\n{ROW}\na.png,2,90\n", "line 4 has too few fields"),
        (f"{HEADER}\n{ROW}\n{ROW}\n", "line 3: frame a.png appears twice"),
        (f"{HEADER}\n../{ROW}\n", r"line 2: '../a.png' is not a name inside frames/"),
        (f"{HEADER}\nx/../../{ROW}\n", "not a name inside"),
        (f"{HEADER}\n/etc/{ROW}\n", "not a name inside"),
        (f"{HEADER}\n..\\{ROW}\n", "not a name inside"),
        (f"{HEADER}\n,1,90,0,0,100\n", "not a name inside"),
        (f"{HEADER}\na.png,soon,90,0,0,100\n", "line 2: time_s is not a time"),
        (f"{HEADER}\na.png,1e10,90,0,0,100\n", "line 2: time_s is not a time"),
        (f"{HEADER}\na.png,1e-{10**30},90,0,0,100\n", "line 2: time_s is not a time"),
        (f"{HEADER}\na.png,1,{'9' * 200_000},0,0,100\n", "line 2 is longer than 65,536"),
        (f"{HEADER},{PRIOR}\n{ROW},121.5,24,30\n", "line 2: prior .* seem to be swapped"),
    ],
)
def test_broken_telemetry(folder, text, message):
    refused(telemetry(folder, text), message)


@pytest.mark.parametrize("frame", ["none.png", ".", "a.png/b", "x" * 5000, "a\0.png"])
def test_views_without_an_image(folder, frame):
    text = f"{HEADER}\n{frame},1,90,0,0,100\n"
    refused(telemetry(folder, text), "line 2 names an image that does not", names=f"frames/{frame}")


@pytest.mark.parametrize("name", ["telemetry.csv", "flight.json"])
def test_missing_files(folder, name):
    (folder / name).unlink()
    refused(folder, "of the flight does not exist", MissingFileError, name)
    (folder / name).mkdir()
    refused(folder, "is a folder, not a file", MissingFileError, name)


def test_missing_folders(folder):
    refused(folder / "none", "flight folder does not exist", MissingFileError, "")
    refused(folder / "flight.json", "is a file, not a folder", MissingFileError, "")
    (folder / "frames").rename(folder / "pictures")
    refused(folder, "does not exist", names="frames/a.png")


def camera(folder, **changes):
    plain = json.loads((folder / "flight.json").read_text())
    plain["camera"] = {**plain["camera"], **changes}
    (folder / "flight.json").write_text(json.dumps(plain))
    return folder


IMPOSSIBLE = [{"width_px": 0}, {"height_px": 10**6}, {"fx_px": -5}, {"fy_px": math.nan}]
IMPOSSIBLE += [{"cx_px": math.inf}, {"distortion": [1, 2, 3]}, {"distortion": [1, 2, 3, math.nan]}]
NO_NUMBERS = [{"width_px": None}, {"width_px": math.inf}, {"fx_px": "wide"}, {"fx_px": 10**400}]
NO_NUMBERS += [{"distortion": bad} for bad in (None, "1234", {"k1": 0}, [[0], 0, 0, 0])]


@pytest.mark.parametrize("changes", IMPOSSIBLE + NO_NUMBERS, ids=lambda each: str(each)[:30])
def test_invalid_cameras_are_rejected(folder, changes):
    error, message = CameraError, "camera"
    if changes in NO_NUMBERS:
        error, message = FlightError, "expected {camera"
    refused(camera(folder, **changes), message, error, "flight.json")


@pytest.mark.parametrize("text", ["", "{", "null", "5", "[]", "{}", '{"camera": 5}', "[" * 10**5])
def test_invalid_camera_files_are_rejected(folder, text):
    (folder / "flight.json").write_text(text)
    refused(folder, "expected {camera.*as JSON", names="flight.json")


@pytest.mark.parametrize(
    "text, message",
    [
        ("frame,lat_deg\na.png,46\n", "columns are missing: lon_deg"),
        ("frame,lat_deg,lon_deg\na.png,46\n", "line 2 has too few fields"),
        ("frame,lat_deg,lon_deg\na.png,46,2\na.png,46,2\n", "line 3: frame a.png appears twice"),
        ("frame,lat_deg,lon_deg\na.png,91,2\n", "line 2: not a latitude and longitude"),
        ("frame,lat_deg,lon_deg\na.png,121.5,24\n", "line 2: .* seem to be swapped"),
        ("frame,lat_deg,lon_deg\na.png,46,nan\n", "line 2: not a latitude and longitude"),
        ("frame,lat_deg,lon_deg\na.png,,2\n", "line 2: not a latitude and longitude"),
    ],
)
def test_broken_truth(tmp_path, text, message):
    path = tmp_path / "truth.csv"
    with pytest.raises(MissingFileError, match="truth does not exist"):
        read_truth(path)
    path.write_text(text)
    with pytest.raises(FlightError, match=message) as caught:
        read_truth(path)
    assert str(caught.value).endswith(str(path))


def encoded(kind, image, *options):
    return cv2.imencode(kind, image, list(options))[1].tobytes()


def unreadable(path, content, message="cannot be decoded|was cut short"):
    path.write_bytes(content)
    with pytest.raises(FlightError, match=message) as caught:
        read_image(path)
    assert str(caught.value).endswith(str(path))


PROGRESSIVE = (cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
KINDS = {"jpeg": (".jpg",), "progressive": (".jpg", *PROGRESSIVE), "png": (".png",)}
KINDS |= {"tiff": (".tif",), "raw tiff": (".tif", cv2.IMWRITE_TIFF_COMPRESSION, 1)}


@pytest.mark.parametrize("kept", [0.03, 0.5, 0.95, 0.999])
@pytest.mark.parametrize("kind", KINDS)
def test_images_that_were_cut_short(tmp_path, kind, kept):
    """Also where the file system left zeros in place of what is missing."""
    suffix, *options = KINDS[kind]
    whole = encoded(suffix, scene(240, 320), *options)
    cut = whole[: int(kept * len(whole))]
    unreadable(tmp_path / "a", cut, "was cut short" if suffix == ".jpg" else "cannot be decoded")
    if suffix != ".tif":  # the directory of a TIFF lies at its end
        unreadable(tmp_path / "a", cut + bytes(len(whole) - len(cut)))


def with_exif(jpeg, orientation, thumbnail=b"", filling=b""):
    """The JPEG with an orientation tag and a thumbnail in front."""
    tag = struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0)
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + tag + bytes(4) + thumbnail
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    return jpeg[:2] + filling + segment + jpeg[2:]


def test_the_orientation_tag_does_not_turn_the_picture(tmp_path):
    path, jpeg = tmp_path / "a.jpg", encoded(".jpg", scene())
    path.write_bytes(jpeg)
    plain = read_image(path)
    path.write_bytes(with_exif(jpeg, 6))
    turned = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert turned.shape == plain.shape[::-1]  # the tag is one that decoders heed
    assert np.array_equal(read_image(path), plain)


def test_thumbnails_padding_and_previews_do_not_hide_a_cut(tmp_path):
    jpeg, small = encoded(".jpg", scene(240, 320)), encoded(".jpg", scene(24, 32))
    whole = with_exif(jpeg, 1, thumbnail=small, filling=b"\xff\xff")
    path = tmp_path / "a.jpg"
    for behind in (b"", bytes(9000), small, b"motion picture" * 1000):
        path.write_bytes(whole + behind)
        assert read_image(path).shape == (240, 320)
    unreadable(path, whole[: len(whole) // 2], "was cut short")
    unreadable(path, whole[: len(small) + 60], "was cut short")


def test_every_depth_and_kind_becomes_8_bit_grey(tmp_path):
    grey, colours = scene(), rgb()[..., ::-1]
    colour, deep = cv2.cvtColor(rgb(), cv2.COLOR_RGB2GRAY), grey.astype(np.uint16) * 257
    celsius = (grey / 12.0 - 5).astype(np.float32)
    dark, bright = np.percentile(grey, STRETCHED_PERCENT)
    filled = ((grey - dark) * 255 / (bright - dark)).clip(0, 255)
    for name, image, expected in (
        ("deep.png", deep, grey),
        ("thermal.png", grey.astype(np.uint16) * 4 + 7000, filled),
        ("celsius.tif", celsius, filled),
        ("reflectance.tif", (grey / 2550.0).astype(np.float32), filled),
        ("clear.png", np.dstack([colours, np.full_like(grey, 7)]), colour),
        ("deep.tif", deep, grey),
        ("colour.TIFF", colours, colour),
        ("colour.JPEG", colours, colour),
    ):
        (tmp_path / name).write_bytes(encoded(Path(name).suffix.lower(), image))
        read = read_image(tmp_path / name)
        assert read.dtype == np.uint8 and read.shape == grey.shape, name
        assert np.abs(read.astype(int) - expected).max() <= (15 if "JPEG" in name else 1), name


@pytest.mark.parametrize("unknown", [np.nan, -9999.0, 3.4e38])
def test_unknown_temperatures_do_not_stretch_the_others(tmp_path, unknown):
    celsius = (scene() / 12.0 - 5).astype(np.float32)
    celsius[: len(celsius) // 3] = unknown
    (tmp_path / "a.tif").write_bytes(encoded(".tif", celsius))
    read = read_image(tmp_path / "a.tif")
    assert set(np.unique(read[: len(read) // 3])) <= {127, 128}
    known = read[len(read) // 3 :].astype(float).ravel()
    assert (
        np.corrcoef(known, scene()[len(read) // 3 :].ravel())[0, 1] > 0.99 and np.ptp(known) > 200
    )


@pytest.mark.parametrize("values", ["nan,2,3", "46,,3", "46,2,", "91,92,3", "46,361,3", "46,2,inf"])
def test_an_incomplete_prior_is_ignored(folder, values):
    text = f"{HEADER},{PRIOR},vel_east_mps\n{ROW},{values},1\n"
    view = open_flight(telemetry(folder, text)).views[0]
    assert view.telemetry.prior is None and view.telemetry.vel_en_mps is None
