"""Metadata of photographs by maker, model and editor."""

import math

import pytest
from recorders import SENSEFLY, START_S, dji, maker_notes, packet, photo, place

from orthonav.core.errors import CameraError, FlightError
from orthonav.core.flight import open_flight
from orthonav.core.geo.attitude import (
    ASSUMED_TILT_STD_DEG,
    AUTOPILOT_TILT_STD_DEG,
    GIMBAL_TILT_STD_DEG,
)
from orthonav.ground.recordings import SourceOptions, import_flight, open_source
from orthonav.ground.recordings.exif import Xmp, read_maker_notes, read_photo
from orthonav.ground.recordings.focal import FocalLength, Optics, focal_length
from orthonav.ground.recordings.photos import UNKNOWN_YAW_STD_DEG

SOFTWARE, MAKER_NOTE = 0x0131, 0x927C
FIRMWARE, VIEWER = "v01.43.0039", "Microsoft Windows Photo Viewer 10.0"


def views_of(folder, **options):
    return list(open_source(folder, SourceOptions(**options)).views)


def gimbal(yaw, pitch, roll, body):
    return packet(
        GimbalYawDegree=f"{yaw:+.2f}",
        GimbalPitchDegree=f"{pitch:+.2f}",
        GimbalRollDegree=f"{roll:+.2f}",
        FlightYawDegree=f"{body:+.2f}",
        RelativeAltitude="+119.30",
    )


# A gimbal that was not recorded.


def test_a_gimbal_that_reports_zero_was_not_recorded(tmp_path):
    for second, body in enumerate((152.0, -154.2, 0.0)):
        time = f"2023:11:14 22:13:2{second}"
        photo(tmp_path / f"p/{second}.jpg", time, xmp=gimbal(0, 0, 0, body))
    recording = open_source(tmp_path / "p")
    assert "gimbal angles of 3 photographs are all 0" in recording.warnings[0]
    reported = [view.telemetry for view in recording.views]
    assert [each.yaw_deg for each in reported] == pytest.approx([152.0, 205.8, 0.0])
    assert all(each.pitch_deg == each.roll_deg == 0 for each in reported)
    assert all(each.tilt_std_deg == ASSUMED_TILT_STD_DEG for each in reported)


@pytest.mark.parametrize("angles", [(0, 0, 0.1), (0, -30, 0), (90, 0, 0)])
def test_one_angle_that_is_not_zero_was_recorded(tmp_path, angles):
    photo(tmp_path / "p/a.jpg", xmp=gimbal(*angles, 152.0))
    photo(tmp_path / "p/b.jpg", "2023:11:14 22:13:21", xmp=gimbal(0, 0, 0, 152.0))
    recording = open_source(tmp_path / "p")
    assert not any("gimbal" in warning for warning in recording.warnings)
    first, second = recording.views
    assert first.telemetry.pitch_deg == pytest.approx(90 + angles[1], abs=0.2)
    assert second.telemetry.pitch_deg == pytest.approx(90)
    assert first.telemetry.tilt_std_deg == second.telemetry.tilt_std_deg == GIMBAL_TILT_STD_DEG


def test_a_camera_that_looks_ahead_to_the_north_is_believed(tmp_path):
    photo(tmp_path / "p/a.jpg", xmp=gimbal(0, 0, 0, 1.5))
    assert views_of(tmp_path / "p")[0].telemetry.pitch_deg == pytest.approx(90)


# Focal lengths.


def optics(make="Maker", model="Model", **values):
    nothing = dict.fromkeys(("focal_mm", "film_mm", "plane", "taken_px", "zoom"), math.nan)
    return Optics(make, model, **{**nothing, "plane_unit": 2, **values})


CAMERAS = {  # optics, size, focal length in pixels and its standard deviation
    "Phantom 3, 16:9 of 4:3": (
        optics("DJI", "FC300S", focal_mm=3.6, film_mm=20),
        (4000, 2250),
        (2323, 0.02),
    ),
    "the same thinned": (optics("DJI", "FC300S", focal_mm=3.6), (2000, 1125), (1161, 0.02)),
    "on its side": (optics("DJI", "FC300S", focal_mm=3.6), (2250, 4000), (2323, 0.02)),
    "Mini 2, by its 35 mm equivalent": (
        optics("DJI", "FC7303", focal_mm=4.5, film_mm=24),
        (4000, 2250),
        (2773, 0.03),
    ),
    "Phantom 4 Pro, 4:3 of 3:2": (
        optics("DJI", "FC6310", focal_mm=8.8, film_mm=24),
        (4864, 3648),
        (3648, 0.015),
    ),
    "unknown, 4:3": (optics(film_mm=24), (4000, 3000), (2773, 0.03)),
    "unknown, 3:2": (optics(film_mm=24), (6000, 4000), (4000, 0.03)),
    "unknown, 16:9": (optics(film_mm=24), (4000, 2250), (2773, 0.06)),
    "resolution of the sensor": (
        optics(focal_mm=4.3, plane=16393.44, taken_px=4000),
        (3600, 2700),
        (2498, 0.03),
    ),
    "width of the sensor in its place": (
        optics("DJI", "XT2", focal_mm=13, plane=10.88, plane_unit=4),
        (640, 512),
        (765, 0.03),
    ),
}


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
    assert reported.tilt_std_deg == AUTOPILOT_TILT_STD_DEG
    assert (reported.amsl_m, reported.hae_m) == (313.99, 281.69)
    assert view.truth_latlon_deg == (41.0346708, -83.3057253)


@pytest.mark.parametrize("flag, hae", [("50", 431.5), ("0", None)])
def test_altitudes_of_rtk_are_above_the_ellipsoid(tmp_path, flag, hae):
    xmp = dji().replace('drone-dji:AbsoluteAltitude="+400.00"', "")
    more = f'drone-dji:RtkFlag="{flag}" drone-dji:AbsoluteAltitude="+431.50" '
    photo(
        tmp_path / "p/a.jpg", xmp=xmp.replace("drone-dji:FlightYaw", f"{more}drone-dji:FlightYaw")
    )
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


def test_maker_notes_that_hold_none(tmp_path):
    whole = maker_notes(yaw=1.0, camera_pitch=-90.0, camera_yaw=2.0, camera_roll=0.0)
    for data in (b"", b"\1", whole[:20], b"[ae_dbg_info:0]" * 9, maker_notes(yaw=float("nan"))):
        assert read_maker_notes(data, "DJI")[0] is None
    assert read_maker_notes(whole, "Canon")[0] is None
    assert read_maker_notes(whole, "DJI")[0] == pytest.approx((2, -90, 0))


def test_the_heading_of_the_aircraft_without_a_gimbal(tmp_path):
    photo(tmp_path / "p/a.jpg", more={MAKER_NOTE: maker_notes(yaw=-90.0)})
    assert views_of(tmp_path / "p")[0].telemetry.missing() == ["pitch_deg", "roll_deg", "agl_m"]
    level = views_of(tmp_path / "p", looks_down=True)[0].telemetry
    assert (level.yaw_deg, level.pitch_deg) == (270, 0)


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
        assert Xmp.of(packet_of).values == expected and Xmp.of(packet_of).unread == unread


# Photographs that an editor has written.


def strip(root, programs, yaws):
    for number, (program, yaw) in enumerate(zip(programs, yaws, strict=True)):
        first = {SOFTWARE: program} if program else {}
        time = f"2023:11:14 22:13:2{number}"
        photo(root / f"{number}.jpg", time, xmp=dji(yaw=yaw), first=first)
    return root


def test_an_editor_may_have_turned_a_photograph(tmp_path):
    folder = strip(tmp_path / "p", [FIRMWARE, VIEWER, FIRMWARE], [45, -132, 42])
    recording = open_source(folder)
    assert recording.warnings[0].startswith("1 of 3 photographs were written by an editor (Micro")
    assert "against the direction of the rest" in recording.warnings[0]
    stds = [view.telemetry.yaw_std_deg for view in recording.views]
    assert stds == [None, UNKNOWN_YAW_STD_DEG, None]


@pytest.mark.parametrize(
    "programs, edited",
    [
        ([FIRMWARE, "v01.50.0000", FIRMWARE], 0),
        ([FIRMWARE, "", FIRMWARE], 0),
        (["Camera App", "Camera App", "Camera App"], 0),
        ([FIRMWARE, "Some Program", FIRMWARE], 1),
        (["", "", "GIMP 2.10"], 1),
        (["Adobe Photoshop Lightroom Classic"] * 3, 3),
    ],
)
def test_which_programs_are_editors(tmp_path, programs, edited):
    views = views_of(strip(tmp_path / "p", programs, [40, 50, 60]))
    assert sum(view.telemetry.yaw_std_deg is not None for view in views) == edited


def test_a_jump_of_the_position_is_named(tmp_path):
    for number, lat in enumerate((46.5, 46.5001, 46.6)):
        time = f"2023:11:14 22:13:2{number}"
        photo(tmp_path / f"p/{number}.jpg", time, gps=place(lat, 2.5), xmp=dji())
    assert "jumps 1 times, the first by 11.1 km" in open_source(tmp_path / "p").warnings[1]


# Photographs of another size, and without a time.


def test_photographs_of_another_size_are_left_out(tmp_path):
    for number in range(3):
        photo(tmp_path / f"p/{number}.jpg", f"2023:11:14 22:13:2{number}", xmp=dji())
    photo(tmp_path / "p/z.jpg", "2023:11:14 22:13:19", width=48, height=64)
    recording = open_source(tmp_path / "p")
    assert recording.warnings[0] == (
        "1 of 4 photographs left out, of another size than most, the first: z.jpg"
    )
    done = import_flight(recording, tmp_path / "flight")
    assert (done.views, done.broken) == (3, 0)


@pytest.mark.parametrize(
    "other",
    [{0xA405: 48, 0x920A: 17.6}, {0xA404: 2.0}, {0xA405: 8}],
    ids=["lens zoom", "digital zoom", "too wide"],
)
def test_photographs_of_another_focal_length_are_left_out(tmp_path, other):
    photo(tmp_path / "p/a.jpg", "2023:11:14 22:13:19", more=other, xmp=dji())
    for number in range(2):
        photo(tmp_path / f"p/{number}.jpg", f"2023:11:14 22:13:2{number}", xmp=dji())
    photo(tmp_path / "p/none.jpg", "2023:11:14 22:13:25", {0xA405: None, 0x920A: None}, xmp=dji())
    recording = open_source(tmp_path / "p")
    assert recording.warnings[0] == (
        "1 of 4 photographs left out, of another focal length than most, the first: a.jpg"
    )
    assert [view.frame for view in recording.views] == ["0.jpg", "1.jpg", "none.jpg"]
    assert recording.camera.fx_px == pytest.approx(math.hypot(64, 48) * 24 / math.hypot(36, 24))


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
