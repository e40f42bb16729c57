"""Folders of photographs: what EXIF and XMP tell, and what they do not."""

import math

import numpy as np
import pytest
from recorders import (
    AUTEL,
    DJI,
    PIX4D,
    SENSEFLY,
    START_S,
    camera_file,
    dji,
    maker_notes,
    packet,
    photo,
    picture,
    place,
)

from orthonav.core.errors import CameraError, FlightError, MissingFileError
from orthonav.core.flight import open_flight, read_image, read_truth
from orthonav.core.tilt import MOUNT_STD_DEG
from orthonav.ground.recordings import SourceOptions, import_flight, open_source
from orthonav.ground.recordings.exif import FocalLength, Optics, Xmp, focal_length, read_photo
from orthonav.ground.recordings.photos import posed

SUBSEC, OFFSET = 0x9291, 0x9011
LEVEL_GROUND = (
    "height above ground is taken from the height above take-off: level ground is assumed"
)
FILM_NOTE = "focal length 44 px, good to 3 %: 35 mm equivalent of EXIF"

SOFTWARE, FIRMWARE, VIEWER = 0x0131, "v01.43.0039", "Microsoft Windows Photo Viewer 10.0"


def series(folder, *each, first=20, **common):
    """Photographs 0.jpg, 1.jpg, .. a second apart, of what differs and what does not."""
    for number, values in enumerate(each):
        time = f"2023:11:14 22:13:{first + number}"
        photo(folder / f"{number}.jpg", time, **{"xmp": dji()} | common | values)
    return folder


def attitude(photo):
    """Heading, pitch and roll of a photograph by itself."""
    (photo,), _ = posed([photo], [])
    pose = photo.pose
    return pose["yaw_deg"], pose["pitch_deg"], pose["roll_deg"]


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


@pytest.mark.parametrize("make, roll", [("Sony", 4), ("senseFly", -4), ("Parrot", 4)])
def test_angles_as_pix4d_names_them(tmp_path, make, roll):
    xmp = packet(PIX4D, Yaw="200.0", Pitch="6.0", Roll="4.0")
    telemetry = read_photo(photo(tmp_path / "a.jpg", xmp=xmp, make=make))
    assert attitude(telemetry) == pytest.approx((200, 6, roll))
    zeros = photo(tmp_path / "b.jpg", xmp=packet(PIX4D, Yaw="0", Pitch="0.0", Roll="0"), make=make)
    assert read_photo(zeros).rotation is None


@pytest.mark.parametrize(
    "time, more, gps, seconds, known",
    [
        ("2023:11:14 23:13:20", {OFFSET: "+01:00"}, {}, 0, True),
        ("2023:11:14 17:13:20", {OFFSET: "-05:00", SUBSEC: "5"}, {}, 0.5, True),
        ("2023:11:14 22:13:20", {OFFSET: None, SUBSEC: "007"}, {}, 0.007, False),
        ("2023:11:14 22:13:20", {OFFSET: None}, {29: "x", 7: ()}, 0, False),
    ],
)
def test_times(tmp_path, time, more, gps, seconds, known):
    read = read_photo(photo(tmp_path / "a.jpg", time, more=more, gps=gps))
    assert (read.time_ns - START_S * 10**9, read.zone_known) == (round(seconds * 1e9), known)


@pytest.mark.parametrize(
    "time, offset, utc, said",
    [
        # Two hours and some seconds after the GPS: the zone is two hours, the rest a slow clock.
        ("2023:11:15 00:13:20", None, (22, 13, 20), None),
        ("2023:11:15 03:58:20", None, (22, 13, 20), None),  # 5:45 h, Nepal
        ("2023:11:14 22:50:32", None, (22, 13, 25.5), "+2226 s"),  # 37 minutes are no zone
        ("2023:11:15 00:13:20", "+01:00", (22, 13, 25.5), "+3594 s"),
        ("2023:11:13 09:13:20", None, (22, 13, 25.5), "-133206 s"),  # 37 hours neither
    ],
)
def test_a_clock_that_differs_from_the_gps(tmp_path, time, offset, utc, said):
    for number in range(3):
        day = {29: "2023:11:14", 7: (*utc[:2], utc[2] + number)}
        each = f"{time[:-1]}{int(time[-1]) + number}"
        photo(tmp_path / f"p/{number}.jpg", each, {OFFSET: offset}, place(46.5, 2.5) | day)
    photo(
        tmp_path / "p/3.jpg", f"{time[:-1]}{int(time[-1]) + 3}", {OFFSET: offset}, place(46.5, 2.5)
    )
    recording = open_source(tmp_path / "p")
    warned = [each for each in recording.warnings if "clock of the camera" in each]
    assert len(warned) == bool(said) and (said or "") in "".join(warned)
    assert not any("UTC assumed" in each for each in recording.warnings)
    off_s = utc[2] - 20
    times = [view.telemetry.time_ns / 1e9 - START_S - off_s for view in recording.views]
    assert times == pytest.approx([0, 1, 2, 3], abs=1e-6)


@pytest.mark.parametrize("maker", [DJI, AUTEL])
@pytest.mark.parametrize("name", ["GpsLongitude", "GpsLongtitude"])
def test_position_and_time_of_xmp_are_the_better_ones(tmp_path, maker, name):
    xmp = packet(maker, GpsLatitude="+29.282190206", **{name: "-94.922448090"})
    gps, time = place(-33.9, 151.2), "2023:11:14 23:13:20"
    assert read_photo(photo(tmp_path / "a.jpg", gps=gps)).latlon_deg == pytest.approx(
        (-33.9, 151.2)
    )
    read = read_photo(photo(tmp_path / "a.jpg", time, {OFFSET: None}, gps=gps, xmp=xmp))
    assert read.latlon_deg == (29.282190206, -94.92244809) and not read.zone_known
    xmp = packet(UTCAtExposure="2023-11-14T22:13:20.073960")
    read = read_photo(photo(tmp_path / "a.jpg", time, {OFFSET: None}, xmp=xmp))
    assert read.time_ns == START_S * 10**9 + 73_960_000 and read.zone_known


@pytest.mark.parametrize(
    "gps, said",
    [({9: "V"}, "without a fix"), ({10: "0"}, "without a fix"), ({31: 900.0}, "a large error")],
)
def test_a_position_without_a_fix_is_no_truth(tmp_path, gps, said):
    xmp = dji().replace("drone-dji:Flight", 'drone-dji:GpsLatitude="46.5" drone-dji:Flight', 1)
    xmp = xmp.replace("drone-dji:Flight", 'drone-dji:GpsLongitude="2.5" drone-dji:Flight', 1)
    photo(tmp_path / "p/a.jpg", gps=place(46.5, 2.5) | gps, xmp=xmp)
    recording = open_source(tmp_path / "p")
    assert any(said in each for each in recording.warnings)
    assert next(recording.views).truth_latlon_deg is None
    photo(tmp_path / "q/a.jpg", gps=place(46.5, 2.5) | {9: "A", 10: "3", 31: 9.0, 11: 1.2}, xmp=xmp)
    assert next(open_source(tmp_path / "q").views).truth_latlon_deg == (46.5, 2.5)


@pytest.mark.parametrize("reference", [b"\1", b"\3"])
def test_altitudes_below_the_sea(tmp_path, reference):
    gps = place(46.5, 2.5, alt=12.0) | {5: reference}
    assert read_photo(photo(tmp_path / "a.jpg", gps=gps)).alt_m == -12


def test_a_photograph_that_programs_turn_is_used_as_stored(tmp_path):
    tags = [{"first": {0x0112: tag}, "seed": seed} for seed, tag in enumerate((1, 3, 8))]
    recording = open_source(series(tmp_path / "p", *tags))
    assert any("show 2 of 3 photographs turned" in each for each in recording.warnings)
    stored = read_image(tmp_path / "p/1.jpg")
    assert np.array_equal([*recording.views][1].grey(), stored)
    assert np.abs(stored.astype(int) - picture(1)).mean() < 6


PARROT = "drone-parrot", "http://www.parrot.com/drone-parrot/1.0/"
SKYDIO = "drone-skydio", "http://www.skydio.com/drone-skydio/1.0/"


@pytest.mark.parametrize("nested", [True, False])
def test_parrot_and_skydio(tmp_path, nested):
    """Their cameras look ahead at 0, 0, 0, as DJI's do."""
    xmp = packet(PARROT, CameraYawDegree="30.5", CameraPitchDegree="-80", CameraRollDegree="0")
    assert attitude(read_photo(photo(tmp_path / "a.jpg", xmp=xmp))) == pytest.approx((30.5, 10, 0))
    names = {"Roll": "0", "Pitch": "-80.0", "Yaw": "30.5"}
    attributes = " ".join(f'drone-skydio:{name}="{value}"' for name, value in names.items())
    camera = f"<drone-skydio:CameraOrientationNED {attributes}/>"
    if nested:
        inner = "".join(f"<drone-skydio:{n}>{v}</drone-skydio:{n}>" for n, v in names.items())
        camera = 'CameraOrientationNED rdf:parseType="Resource"'
        camera = f"<drone-skydio:{camera}>{inner}</drone-skydio:CameraOrientationNED>"
    body = camera.replace("Camera", "Vehicle").replace("30.5", "99").replace("-80.0", "1")
    xmp = packet(SKYDIO, RelativeAltitude="55.5")
    xmp = xmp.replace("</rdf:Description>", f"{camera}{body}</rdf:Description>")
    read = read_photo(photo(tmp_path / "b.jpg", xmp=xmp))
    assert attitude(read) == pytest.approx((30.5, 10, 0)) and read.home_m == 55.5


@pytest.mark.parametrize(
    "maker, gps, named",
    [
        (("Maker", "http://maker.com/"), {}, "Maker:MountYaw"),
        (PARROT, {}, "drone-parrot:MountYaw"),
        (DJI, {16: "M", 17: 30.0}, "GPSImgDirection"),
    ],
)
def test_angles_that_are_not_read_are_named(tmp_path, maker, gps, named):
    xmp = packet(maker, **({} if maker == DJI else {"MountYaw": "30.5"}))
    photo(tmp_path / "p/a.jpg", gps=place(46.5, 2.5) | gps, xmp=xmp)
    recording = open_source(tmp_path / "p")
    said = f"such as angles of {named}, which are not read"
    assert any(said in each for each in recording.warnings)
    assert "yaw_deg" in next(recording.views).telemetry.missing()


def test_missing_metadata_stays_missing(tmp_path):
    photo(tmp_path / "p/a.jpg", gps={1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0)})
    view = next(open_source(tmp_path / "p").views)
    assert view.telemetry.missing() == ["yaw_deg", "pitch_deg", "roll_deg", "agl_m"]
    assert view.truth_latlon_deg is None and view.telemetry.vel_en_mps is None
    photo(tmp_path / "q/a.jpg", gps=place(46.5, 2.5, alt=400.0))
    options = SourceOptions(ground_alt_m=290.0, looks_down=True)
    telemetry = next(open_source(tmp_path / "q", options).views).telemetry
    assert telemetry.missing() == ["yaw_deg"] and telemetry.agl_m == 110.0
    photo(tmp_path / "r/a.jpg", gps=place(46.5, 2.5), xmp=dji(height=0.0))  # 0 was not measured
    recording = open_source(tmp_path / "r")
    assert next(recording.views).telemetry.missing() == ["agl_m"]
    assert recording.warnings[0].startswith("no height above ground was recorded")


def test_values_that_cannot_be_used_are_counted_with_an_example(tmp_path):
    """The heading of the aircraft does not stand in for one of the gimbal that cannot be read."""
    xmp = dji().replace('GimbalYawDegree="+30.00"', 'GimbalYawDegree="30 deg"')
    recording = open_source(series(tmp_path / "p", {"xmp": xmp}, {}))
    assert (
        "values of 1 of 2 photographs cannot be used, such as unreadable value "
        "drone-dji:GimbalYawDegree='30 deg': 0.jpg" in recording.warnings
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


MAKER_NOTE = 0x927C


def views_of(folder, **options):
    return list(open_source(folder, SourceOptions(**options)).views)


@pytest.mark.parametrize(
    "headings, expected", [((152.0, -154.2, 0.0), (152.0, 205.8, 0.0)), ((0.0, 0.0), None)]
)
def test_a_gimbal_that_reports_zero_was_not_recorded(tmp_path, headings, expected):
    """Nor was a heading of the aircraft that is 0 throughout."""
    series(tmp_path / "p", *({"xmp": dji(0, 0, 0, body=body)} for body in headings))
    said = f"gimbal angles of {len(headings)} photographs are all 0"
    assert said in open_source(tmp_path / "p").warnings[0]
    reported = [view.telemetry for view in views_of(tmp_path / "p")]
    if expected is None:
        assert reported[0].missing() == ["yaw_deg"]
    else:
        assert [each.yaw_deg for each in reported] == pytest.approx(expected)
    assert all(each.pitch_deg == each.roll_deg == 0 for each in reported)
    assert {(each.tilt_std_deg, each.mount_std_deg) for each in reported} == {(6.0, None)}


# Focal lengths.


def optics(model="Model", **values):
    nothing = dict.fromkeys(("focal_mm", "film_mm", "plane", "taken_px", "zoom"), math.nan)
    return Optics("DJI", model, **{**nothing, "plane_unit": 2, **values})


DJI_300S = optics("FC300S", focal_mm=3.6, film_mm=20)


CAMERAS = {  # optics, size, focal length in pixels and its standard deviation
    "Phantom 3, 16:9 of 4:3": (DJI_300S, (4000, 2250), (2323, 0.02)),
    "the same thinned": (DJI_300S, (2000, 1125), (1161, 0.02)),
    "on its side": (DJI_300S, (2250, 4000), (2323, 0.02)),
    "Mini 2, by its film": (optics("FC7303", focal_mm=4, film_mm=24), (4000, 2250), (2773, 0.03)),
    "Phantom 4 Pro": (optics("FC6310", focal_mm=8.8, film_mm=24), (4864, 3648), (3648, 0.015)),
    "unknown, 4:3": (optics(film_mm=24), (4000, 3000), (2773, 0.03)),
    "unknown, 3:2": (optics(film_mm=24), (6000, 4000), (4000, 0.03)),
    "unknown, 16:9": (optics(film_mm=24), (4000, 2250), (2773, 0.06)),
    "resolution of the sensor": (
        optics(focal_mm=4.3, plane=16393.44, taken_px=4000), (3600, 2700), (2498, 0.03),
    ),
    "width of the sensor in its place": (
        optics("XT2", focal_mm=13, plane=10.88, plane_unit=4), (640, 512), (765, 0.03),
    ),
}  # fmt: skip


@pytest.mark.parametrize("camera", CAMERAS)
def test_focal_lengths(camera):
    given, size, (px, std) = CAMERAS[camera]
    found = focal_length(given, *size)
    assert isinstance(found, FocalLength) and found.std == std
    assert found.px == pytest.approx(px, abs=1)


def test_what_is_not_believed_is_an_error(tmp_path):
    wide = optics(focal_mm=13, plane=10.88, plane_unit=3)
    with pytest.raises(CameraError, match=r"field of view of 1\d\d deg; give --camera"):
        focal_length(wide, 640, 512)
    with pytest.raises(CameraError, match="digital zoom of 2; give --camera"):
        focal_length(optics(film_mm=24, zoom=2.0), 4000, 3000)
    assert focal_length(optics(film_mm=24, zoom=1.0), 4000, 3000) is not None
    photo(tmp_path / "p/a.jpg", more={0xA405: 4})
    with pytest.raises(CameraError, match=r"give --camera FILE: .*a\.jpg"):
        open_source(tmp_path / "p")


def dewarped(flag=0, fx=44.8, right=0.5, k1=-0.2687):
    """XMP as a Phantom 4 RTK writes it, for the pictures of these tests."""
    numbers = fx, fx + 0.1, right, -0.3, k1, 0.1147, 0.000015, -0.000046, -0.035
    data = "2018-09-04;" + ",".join(f"{number:.12f}" for number in numbers)
    return packet(GimbalYawDegree="+30.00", DewarpFlag=flag, DewarpData=data)


def test_the_calibration_of_dji_is_used(tmp_path):
    path = photo(tmp_path / "p/a.jpg", xmp=dewarped())
    recording = open_source(path.parent)
    camera = recording.camera
    assert (camera.fx_px, camera.fy_px, camera.focal_std) == (44.8, 44.9, 0.01)
    assert (camera.cx_px, camera.cy_px) == (
        camera.width_px / 2 + 0.5,
        camera.height_px / 2 - 0.3,
    )
    assert camera.distortion == (-0.2687, 0.1147, 0.000015, -0.000046, -0.035)
    assert "focal length 45 px and distortion: DewarpData of DJI" in recording.note


@pytest.mark.parametrize("other", [{"flag": 1}, {"fx": 49}, {"right": 30}, {"k1": math.nan}])
def test_other_calibrations_of_dji_are_not(tmp_path, other):
    """The picture was dewarped; of another size; not of this camera; damaged."""
    path = photo(tmp_path / "p/a.jpg", xmp=dewarped(**other))
    photo(tmp_path / "mixed/a.jpg", "2023:11:14 22:13:20", xmp=dewarped())
    photo(tmp_path / "mixed/b.jpg", "2023:11:14 22:13:21", xmp=dewarped(**other))
    assert open_source(tmp_path / "mixed").camera.distortion == ()
    recording = open_source(path.parent)
    assert FILM_NOTE in recording.note and recording.camera.distortion == ()


# senseFly, maker notes, XMP in the Exif directory.


def test_sensefly(tmp_path):
    xmp = packet(
        SENSEFLY,
        Heading="70.062057499999995",
        PitchAngle="2.5",
        RollAngle="-3.5",
        Height="66.111175540000005",
        UTCTime="2023:11:14 22:13:20",
        AltitudeAMSL="313.99",
        AltitudeWGS84="281.69",
        Latitude="41.0346708",
        Longitude="-83.3057253",
    )
    made = photo(
        tmp_path / "p/a.jpg", "2023:11:14 18:12:46", {0x9011: None}, place(41, -83), xmp, make="C"
    )
    assert read_photo(made).time_ns == START_S * 10**9 and read_photo(made).zone_known
    (view,) = views_of(tmp_path / "p")
    reported = view.telemetry
    assert (reported.yaw_deg, reported.pitch_deg, reported.roll_deg) == pytest.approx(
        (70.0620575, 2.5, -3.5)
    )
    assert reported.agl_m == reported.home_m == pytest.approx(66.11117554)
    assert reported.tilt_std_deg == pytest.approx(math.hypot(1.0, MOUNT_STD_DEG))
    assert reported.mount_std_deg == MOUNT_STD_DEG
    assert (reported.amsl_m, reported.hae_m) == (313.99, 281.69)
    assert view.truth_latlon_deg == (41.0346708, -83.3057253)


@pytest.mark.parametrize("flag, hae", [("50", 431.5), ("0", None)])
def test_altitudes_of_rtk_are_above_the_ellipsoid(tmp_path, flag, hae):
    rtk = f'drone-dji:RtkFlag="{flag}" drone-dji:AbsoluteAltitude="+431.50"'
    xmp = dji().replace('drone-dji:AbsoluteAltitude="+400.00"', rtk)
    photo(tmp_path / "p/a.jpg", xmp=xmp)
    import_flight(open_source(tmp_path / "p"), tmp_path / "flight")
    (view,) = open_flight(tmp_path / "flight").views
    assert (view.telemetry.hae_m, view.telemetry.amsl_m) == (hae, None)
    assert view.telemetry.home_m == view.telemetry.agl_m == 120.5


@pytest.mark.parametrize("order", "<>")
def test_maker_notes_of_older_models(tmp_path, order):
    notes = maker_notes(order, yaw=177.6, camera_pitch=-80.0, camera_yaw=-176.6, camera_roll=0.0)
    made = photo(tmp_path / "p/a.jpg", more={MAKER_NOTE: notes})
    assert read_photo(made).body_yaw_deg == pytest.approx(177.6)
    reported = views_of(tmp_path / "p")[0].telemetry
    assert (reported.yaw_deg, reported.pitch_deg) == pytest.approx((183.4, 10.0), abs=1e-4)
    assert reported.missing() == ["agl_m"]


@pytest.mark.parametrize(
    "more",
    [
        {0xA210: "x"},
        {0x9003: "0001:01:01 00:00:00", 0x9011: "+10:00"},
        {0x9003: "9999:12:31 23:00:00", 0x9011: "-10:00"},
    ],
)
def test_impossible_exif_is_missing(tmp_path, more):
    found = read_photo(photo(tmp_path / "a.jpg", more=more))
    assert (found.time_ns is None) == (0x9003 in more)
    assert (found.optics.plane_unit == 0) == (0xA210 in more)


@pytest.mark.parametrize(
    "text, value",
    [
        ("+45.50", 45.5),
        ("1.2e-05", 1.2e-5),
        ("-9000/100", -90.0),
        (" 1,5 ", 1.5),
        ("1/0", None),
        ("1.2.3", None),
        ("n/a", None),
    ],
)
def test_whole_values_of_xmp_are_read_and_others_named(text, value):
    expected = {} if value is None else {"Camera:Yaw": value}
    unread = (f"Camera:Yaw='{text}'",) if value is None else ()
    for packet_of in (f'<a Camera:Yaw="{text}"/>', f"<Camera:Yaw>{text}</Camera:Yaw>"):
        assert Xmp(packet_of).values == expected and Xmp(packet_of).unread == unread


# Photographs that an editor has written.


@pytest.mark.parametrize(
    "programs, edited",
    [
        ([FIRMWARE, VIEWER, FIRMWARE], [1]),
        ([FIRMWARE, "v01.50.0000", ""], []),
        (["Camera App", "Camera App", "Camera App"], []),
        ([FIRMWARE, "Some Program", FIRMWARE], [1]),
        (["", "", "GIMP 2.10"], [2]),
    ],
)
def test_an_editor_may_have_turned_a_photograph(tmp_path, programs, edited):
    software = ({"first": {SOFTWARE: each} if each else {}} for each in programs)
    recording = open_source(series(tmp_path / "p", *software))
    stds = {number: view.telemetry.yaw_std_deg for number, view in enumerate(recording.views)}
    assert [number for number in stds if stds[number] == 180.0] == edited
    assert ("1 of 3 photographs were written by an editor" in recording.warnings[0]) == bool(edited)


# Photographs of another size, and without a time.


OTHER_FOCAL = [{0xA405: 48, 0x920A: 17.6}, {0xA404: 2.0}, {0xA405: 8}]  # zoomed; cropped; too wide


@pytest.mark.parametrize(
    "kind, other",
    [("size", {"width": 48, "height": 64}), *(("focal length", {"more": x}) for x in OTHER_FOCAL)],
)
def test_photographs_of_another_size_or_focal_length_are_left_out(tmp_path, kind, other):
    photo(tmp_path / "p/a.jpg", "2023:11:14 22:13:19", xmp=dji(), **other)
    photo(tmp_path / "p/none.jpg", "2023:11:14 22:13:25", {0xA405: None, 0x920A: None}, xmp=dji())
    recording = open_source(series(tmp_path / "p", {}, {}))
    said = f"1 of 4 photographs left out, of another {kind} than most, the first: a.jpg"
    assert recording.warnings[0] == said
    assert [view.frame for view in recording.views] == ["0.jpg", "1.jpg", "none.jpg"]
    assert recording.camera.fx_px == pytest.approx(math.hypot(64, 48) * 24 / math.hypot(36, 24))
    given = SourceOptions(camera=camera_file(tmp_path / "camera.json"))
    assert open_source(tmp_path / "p", given).expected == 3


def test_as_many_photographs_of_several_cameras_are_not_guessed(tmp_path):
    """As of a drone with several cameras that expose together."""
    for number in range(2):
        time = f"2023:11:14 22:13:2{number}"
        photo(tmp_path / f"p/{number}_W.jpg", time, xmp=dji())
        photo(tmp_path / f"p/{number}_T.jpg", time, width=32, height=24)
        photo(tmp_path / f"q/{number}_W.jpg", time, xmp=dji())
        photo(tmp_path / f"q/{number}_Z.jpg", time, {0xA405: 162, 0x920A: 30}, xmp=dji())
    for folder, other in (("p", "T"), ("q", "Z")):
        with pytest.raises(
            FlightError, match=f"2 as ._{other}.jpg.*; give the files of one camera"
        ):
            open_source(tmp_path / folder)
        found = open_source(sorted((tmp_path / folder).glob("*_W.jpg")))
        assert found.expected == 2


@pytest.mark.parametrize(
    "focal_mm, sensor_mm, count",
    [
        ((8.8, 8.8, 8.9), 13.2, 3),
        ((24.0, 24.0, 24.1, 24.1, 24.2, 24.2, 48.0, 48.0, 48.0), 36.0, 6),
    ],
)
def test_focal_lengths_that_differ_by_rounding_are_of_one_lens(
    tmp_path, focal_mm, sensor_mm, count
):
    series(tmp_path / "p", *({"more": {0xA405: None, 0x920A: each}} for each in focal_mm))
    assert len(views_of(tmp_path / "p", sensor_width_mm=sensor_mm)) == count


def test_a_stated_zone_holds_where_the_time_of_the_gps_stands_still(tmp_path):
    """A receiver without a fix repeats its last time."""
    for minute in range(4):
        gps = place(46.5, 2.5) | {29: "2023:11:14", 7: (22, 13, 20.0)}
        photo(tmp_path / f"p/{minute}.jpg", f"2023:11:14 22:1{minute}:20", gps=gps, xmp=dji())
    recording = open_source(tmp_path / "p")
    assert not any("clock of the camera" in said for said in recording.warnings)
    first = next(recording.views).telemetry.time_ns
    assert first == (START_S - 180) * 10**9


def test_photographs_without_a_time_go_in_the_order_of_their_names(tmp_path):
    for name in ("IMG_9", "IMG_10", "IMG_11"):
        photo(tmp_path / f"p/{name}.jpg", time=None, xmp=dji())
    photo(tmp_path / "p/IMG_12.jpg", time=None)
    recording = open_source(tmp_path / "p")
    assert "1 of 4 photographs left out, no time in EXIF, the first: IMG_12.jpg" in (
        recording.warnings
    )
    assert any("ordered by name, one second apart" in each for each in recording.warnings)
    views = list(recording.views)
    assert [view.frame for view in views] == ["IMG_9.jpg", "IMG_10.jpg", "IMG_11.jpg"]
    assert [view.telemetry.time_ns for view in views] == [0, 10**9, 2 * 10**9]
    (tmp_path / "log.csv").write_text("time_s,pitch_deg,roll_deg\n0,0,0\n9,0,0\n")
    with pytest.raises(FlightError, match="no time in EXIF"):
        open_source(tmp_path / "p", SourceOptions(telemetry=tmp_path / "log.csv"))
