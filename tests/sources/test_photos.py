"""Folders of photographs: what EXIF and XMP tell, and what they do not."""

import math

import numpy as np
import pytest
from recorders import (
    AUTEL,
    DJI,
    HEIGHT,
    PIX4D,
    START_S,
    WIDTH,
    camera_file,
    dji,
    packet,
    photo,
    place,
)

from orthonav.core.errors import CameraError, FlightError, MissingFileError
from orthonav.core.flight import open_flight, read_image, read_truth
from orthonav.ground.recordings import SourceOptions, import_flight, open_source
from orthonav.ground.recordings.exif import read_photo
from orthonav.ground.recordings.photos import posed
from orthonav.ground.recordings.recording import LEVEL_GROUND

SUBSEC, OFFSET = 0x9291, 0x9011
FILM_NOTE = "focal length 44 px, good to 3 %: 35 mm equivalent of EXIF"


def attitude(photo):
    """Heading, pitch and roll of a photograph by itself."""
    (photo,), _ = posed([photo])
    pose = photo.pose
    return pose.yaw_deg, pose.pitch_deg, pose.roll_deg


@pytest.fixture
def folder(tmp_path):
    """Three photographs of a DJI drone, the names not in the order of time."""
    root = tmp_path / "DCIM"
    for name, second in (("c.jpg", 0), ("sub/b.jpg", 1), ("a.jpg", 2)):
        photo(
            root / name,
            f"2023:11:14 22:13:2{second}",
            more={SUBSEC: "250"},
            gps=place(46.5 + second / 1000, -0.25),
            xmp=dji(yaw=30 + second, pitch=-80),
            seed=second,
        )
    (root / "notes.txt").write_text("a flight")
    return root


def test_a_folder_of_dji(folder, tmp_path):
    recording = open_source(folder)
    assert recording.kind == "photos" and recording.expected == 3
    assert FILM_NOTE in recording.note and recording.warnings == (LEVEL_GROUND, FILM_NOTE)
    done = import_flight(recording, tmp_path / "flight")
    assert (done.views, done.complete, done.with_truth, done.broken) == (3, 3, 3, 0)
    flight = open_flight(tmp_path / "flight")
    assert [view.frame for view in flight.views] == ["c.jpg", "sub/b.jpg", "a.jpg"]
    telemetry = flight.views[1].telemetry
    assert telemetry.time_ns == (START_S + 1) * 10**9 + 250_000_000
    assert (telemetry.yaw_deg, telemetry.pitch_deg, telemetry.roll_deg) == pytest.approx(
        (31, 10, 0)
    )
    assert (
        telemetry.agl_m == 120.5
        and telemetry.vel_en_mps == (-1.25, 3.5)
        and telemetry.prior is None
    )
    truth = read_truth(tmp_path / "flight/truth.csv")
    assert truth["sub/b.jpg"] == pytest.approx((46.501, -0.25), abs=1e-7)
    copied = tmp_path / "flight/frames/sub/b.jpg"
    assert copied.read_bytes() == (folder / "sub/b.jpg").read_bytes()
    assert np.array_equal(read_image(copied), next(iter(recording.views)).grey()) is False


def test_the_camera_is_that_of_the_focal_length(folder):
    camera = open_source(folder).camera
    assert (
        camera.fx_px == camera.fy_px == pytest.approx(24 * math.hypot(64, 48) / math.hypot(36, 24))
    )
    assert (camera.cx_px, camera.cy_px) == (32, 24) and camera.focal_std == 0.03
    telemetry = open_source(folder, SourceOptions(sensor_width_mm=13.2)).camera
    assert telemetry.fx_px == pytest.approx(8.8 / 13.2 * 64)


def test_a_camera_file_replaces_exif(folder, tmp_path):
    file = camera_file(tmp_path / "c.json", width_px=128, height_px=96, cx_px=66.0)
    recording = open_source(folder, SourceOptions(camera=file))
    assert (recording.camera.width_px, recording.camera.cx_px) == (WIDTH, 33.0)
    assert recording.camera.focal_std == 0 and recording.warnings == (LEVEL_GROUND,)
    wrong = camera_file(tmp_path / "d.json", width_px=128, height_px=72)
    with pytest.raises(CameraError, match="another aspect ratio"):
        open_source(folder, SourceOptions(camera=wrong))


@pytest.mark.parametrize("as_elements", [False, True])
@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_xmp_in_every_form(tmp_path, suffix, as_elements):
    values = {"GimbalYawDegree": "-12.5", "GimbalPitchDegree": "-70.0", "GimbalRollDegree": "0.0"}
    xmp = packet(as_elements=as_elements, **values)
    telemetry = read_photo(photo(tmp_path / f"a.{suffix}", xmp=xmp))
    assert attitude(telemetry) == pytest.approx((347.5, 20, 0))
    assert math.isnan(telemetry.home_m) and (telemetry.width_px, telemetry.height_px) == (
        WIDTH,
        HEIGHT,
    )


def test_autel(tmp_path):
    xmp = packet(
        AUTEL,
        GimbalYawDegree="90.0",
        GimbalPitchDegree="-90.0",
        GimbalRollDegree="0.0",
        RelativeAltitude="80.25",
    )
    telemetry = read_photo(photo(tmp_path / "a.jpg", xmp=xmp, make="Autel Robotics"))
    assert attitude(telemetry) == pytest.approx((90, 0, 0), abs=1e-6)
    assert telemetry.home_m == 80.25


@pytest.mark.parametrize("make, roll", [("Sony", 4), ("senseFly", -4), ("Parrot", 4)])
def test_angles_as_pix4d_names_them(tmp_path, make, roll):
    xmp = packet(PIX4D, Yaw="200.0", Pitch="6.0", Roll="4.0")
    telemetry = read_photo(photo(tmp_path / "a.jpg", xmp=xmp, make=make))
    assert attitude(telemetry) == pytest.approx((200, 6, roll))


@pytest.mark.parametrize(
    "time, more, gps, seconds, known",
    [
        ("2023:11:14 22:13:20", {}, {}, 0, True),
        ("2023:11:14 23:13:20", {OFFSET: "+01:00"}, {}, 0, True),
        ("2023:11:14 17:13:20", {OFFSET: "-05:00", SUBSEC: "5"}, {}, 0.5, True),
        ("2023:11:14 22:13:20", {OFFSET: None, SUBSEC: "007"}, {}, 0.007, False),
        # Two hours and some seconds after the GPS: the zone is two hours, the rest a slow clock.
        (
            "2023:11:15 00:13:20",
            {OFFSET: None},
            {29: "2023:11:14", 7: (22.0, 13.0, 25.5)},
            0,
            True,
        ),
        ("2023:11:14 22:13:20", {OFFSET: None}, {29: "x", 7: ()}, 0, False),
    ],
)
def test_times(tmp_path, time, more, gps, seconds, known):
    telemetry = read_photo(photo(tmp_path / "a.jpg", time, more=more, gps=gps))
    assert (
        telemetry.time_ns == START_S * 10**9 + round(seconds * 1e9)
        and telemetry.zone_known == known
    )


@pytest.mark.parametrize("lat, lon", [(46.5, 2.5), (-33.9, 151.2), (10.0, -179.5)])
def test_places(tmp_path, lat, lon):
    telemetry = read_photo(photo(tmp_path / "a.jpg", gps=place(lat, lon)))
    assert telemetry.latlon_deg == pytest.approx((lat, lon), abs=1e-7) and telemetry.alt_m == 400


@pytest.mark.parametrize("maker", [DJI, AUTEL])
@pytest.mark.parametrize("name", ["GpsLongitude", "GpsLongtitude"])
def test_the_position_of_xmp_is_the_better_one(tmp_path, maker, name):
    xmp = packet(maker, GpsLatitude="+29.282190206", **{name: "-94.922448090"})
    telemetry = read_photo(photo(tmp_path / "a.jpg", gps=place(29.28, -94.92), xmp=xmp))
    assert telemetry.latlon_deg == (29.282190206, -94.92244809)


def test_the_time_of_exposure_is_the_better_one(tmp_path):
    xmp = packet(UTCAtExposure="2023-11-14T22:13:20.073960")
    telemetry = read_photo(
        photo(tmp_path / "a.jpg", "2023:11:14 23:13:20", more={OFFSET: None}, xmp=xmp)
    )
    assert telemetry.time_ns == START_S * 10**9 + 73_960_000 and telemetry.zone_known
    wrong = packet(UTCAtExposure="2023-99-14T22:13:20")
    assert read_photo(photo(tmp_path / "b.jpg", xmp=wrong)).time_ns == START_S * 10**9


def test_missing_metadata_stays_missing(tmp_path):
    photo(tmp_path / "p/a.jpg", gps={1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0)})
    view = next(open_source(tmp_path / "p").views)
    assert view.telemetry.missing() == ["yaw_deg", "pitch_deg", "roll_deg", "agl_m"]
    assert view.truth_latlon_deg is None and view.telemetry.vel_en_mps is None
    photo(tmp_path / "q/a.jpg", gps=place(46.5, 2.5, alt=400.0))
    options = SourceOptions(ground_alt_m=290.0, looks_down=True)
    telemetry = next(open_source(tmp_path / "q", options).views).telemetry
    assert telemetry.missing() == ["yaw_deg"] and telemetry.agl_m == 110.0


def test_angles_as_fractions_or_with_a_comma(tmp_path):
    for number, (yaw, pitch) in enumerate([("-9000/100", "-85/1"), ("-90,00", "-85,0")]):
        xmp = packet(GimbalYawDegree=yaw, GimbalPitchDegree=pitch, GimbalRollDegree="0/1")
        read = read_photo(photo(tmp_path / f"{number}.jpg", xmp=xmp))
        assert attitude(read) == pytest.approx((270, 5, 0), abs=1e-6)


def test_values_that_cannot_be_used_are_counted_with_an_example(tmp_path):
    """The heading of the aircraft does not stand in for one of the gimbal that cannot be read."""
    xmp = dji().replace('GimbalYawDegree="+30.00"', 'GimbalYawDegree="30 deg"')
    photo(tmp_path / "p/a.jpg", xmp=xmp)
    photo(tmp_path / "p/b.jpg", "2023:11:14 22:13:21", xmp=dji())
    recording = open_source(tmp_path / "p")
    assert (
        "values of 1 of 2 photographs cannot be used, such as unreadable value "
        "drone-dji:GimbalYawDegree='30 deg': a.jpg" in recording.warnings
    )
    first, second = (view.telemetry.yaw_deg for view in recording.views)
    assert math.isnan(first) and second == pytest.approx(30)


@pytest.mark.parametrize("more", [{1: None}, {3: None}, {1: "\0"}, {1: None, 3: None}])
def test_a_position_without_a_hemisphere_is_not_guessed(tmp_path, more):
    gps = {tag: value for tag, value in (place(46.5, 2.5) | more).items() if value is not None}
    photo(tmp_path / "p/a.jpg", gps=gps)
    recording = open_source(tmp_path / "p")
    assert next(recording.views).truth_latlon_deg is None
    assert any("GPS position without N or S, or without E" in each for each in recording.warnings)


def test_a_height_of_0_was_not_measured(tmp_path):
    photo(tmp_path / "p/a.jpg", gps=place(46.5, 2.5), xmp=dji(height=0.0))
    recording = open_source(tmp_path / "p")
    assert next(recording.views).telemetry.missing() == ["agl_m"]
    assert recording.warnings[0].startswith("no height above ground was recorded")


def test_equal_times_are_named_at_import_and_afterwards(tmp_path):
    for name in "abc":
        photo(tmp_path / f"p/{name}.jpg", xmp=dji())
    recording = open_source(tmp_path / "p")
    import_flight(recording, tmp_path / "flight")
    for each in (recording, open_source(tmp_path / "flight")):
        assert sum("3 of 3 views have the same time" in text for text in each.warnings) == 1


def test_pointers_of_git_lfs_are_named(tmp_path):
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"
    (tmp_path / "p").mkdir()
    (tmp_path / "p/a.jpg").write_text(pointer)
    with pytest.raises(FlightError, match="Git LFS pointer"):
        open_source(tmp_path / "p")
    for name in ("a.mp4", "a.bag", "a.mcap"):
        (tmp_path / name).write_text(pointer)
        with pytest.raises(MissingFileError, match="git lfs pull"):
            open_source(tmp_path / name)


def test_damaged_photographs_are_left_out_with_a_warning(folder, tmp_path):
    (folder / "d.jpg").write_bytes(b"not a picture")
    (folder / "e.jpg").touch()
    photo(folder / "f.jpg", time=None)
    photo(folder / "g.jpg", time="2023:11:14 22:14:00", more={OFFSET: None})
    whole = photo(folder / "h.jpg", time="2023:11:14 22:15:00", seed=7).read_bytes()
    (folder / "h.jpg").write_bytes(whole[: len(whole) - 300])  # its header can be read
    recording = open_source(folder)
    assert recording.warnings[:3] == (
        "2 of 8 photographs left out, not readable, the first: d.jpg",
        "1 of 8 photographs left out, no time in EXIF, the first: f.jpg",
        "no time zone in EXIF of 1 photographs: UTC assumed",
    )
    done = import_flight(recording, tmp_path / "flight")
    assert (done.views, done.broken) == (4, 1) and "h.jpg" in done.first_broken
    assert len(open_flight(tmp_path / "flight").views) == 4
