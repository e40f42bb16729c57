"""Single photographs, and folders of images that a table describes by file name."""

import math
from types import SimpleNamespace

import cv2
import pytest
from recorders import dji, photo, picture, place

from orthonav.core.errors import CameraError, FlightError
from orthonav.ground.recordings import SourceOptions, open_source
from orthonav.ground.recordings.image_table import read_image_table

FOV = SourceOptions(fov_deg=60.0)


@pytest.fixture
def images(tmp_path):
    """Three images without metadata."""
    folder = tmp_path / "images"
    (folder / "sub").mkdir(parents=True)
    for number, name in enumerate(("a.png", "sub/b.jpg", "c.png")):
        cv2.imwrite(str(folder / name), picture(number))
    return folder


def views_of(folder, table, options=FOV):
    (folder / "poses.csv").write_bytes(table.encode("utf-8", "surrogateescape"))
    recording = open_source(folder, options)
    return SimpleNamespace(
        warnings="\n".join(recording.warnings), by={view.frame: view for view in recording.views}
    )


def angles(view):
    now = view.telemetry
    return now.yaw_deg, now.pitch_deg, now.roll_deg, now.agl_m


def test_a_table_beside_images_is_found(images):
    table = (
        "filename,time,yaw,pitch,roll,agl,lat,lon\n"
        "a.png,2024-05-01T10:00:01.5Z,370,1,-2,120,46.5,2.5\n"
        "sub/b.jpg,1714557600,20,0,0,121,46.5001,2.5\n"
        "c.png,2024:05:01 10:00:03,30,0,0,122,,\n"
    )
    found = views_of(images, table)
    assert list(found.by) == ["sub/b.jpg", "a.png", "c.png"], "by time"
    assert angles(found.by["a.png"]) == (10, 1, -2, 120) and found.warnings == ""
    assert found.by["a.png"].telemetry.time_ns == 1_714_557_601_500_000_000
    assert found.by["a.png"].truth_latlon_deg == (46.5, 2.5)
    assert found.by["c.png"].truth_latlon_deg is None
    again = open_source(images / "poses.csv", FOV)
    assert [view.frame for view in again.views] == list(found.by)


@pytest.mark.parametrize(
    "header",
    [
        "Image,Heading,Height",
        "SourceFile;GimbalYawDegree;AGL",
        "File Name\tHeading [deg]\tagl_m",
    ],
)
def test_columns_by_many_names(images, header):
    rows = "a.png,20.5,120\n./sub/B.JPG,21,121\nC:\\dcim\\c,22,122\n"
    delimiter = max(",;\t", key=header.count)
    found = views_of(images, header + "\n" + rows.replace(",", delimiter))
    assert angles(found.by["a.png"]) == (20.5, 0, 0, 120)
    assert angles(found.by["sub/b.jpg"]) == (21, 0, 0, 121)
    assert angles(found.by["c.png"]) == (22, 0, 0, 122)
    assert "pitch and roll of 3 of 3 photographs are not known" in found.warnings
    assert "ordered by name" in found.warnings
    feet = views_of(images, "file;yaw;height (ft)\na.png;20,5;1000,0\n")
    assert angles(feet.by["a.png"]) == pytest.approx((20.5, 0, 0, 304.8))


@pytest.mark.parametrize(
    "header, row, expected",
    [
        ("yaw (rad),pitch [rad],agl", "1.5707963,0.1745329,120", (90, 10, 0, 120)),
        ("yaw_rad,pitch_rad,agl_ft", "-0.5235988,0,1000", (330, 0, 0, 304.8)),
        ("yaw,pitch,Height (ft AGL)", "20,1,1000", (20, 1, 0, 304.8)),
        ("yaw,pitch,height (cm)", "20,1,12000", (20, 1, 0, 120)),
    ],
)
def test_units_of_the_header(images, header, row, expected):
    found = views_of(images, f"file,{header}\na.png,{row}\n")
    assert angles(found.by["a.png"]) == pytest.approx(expected, abs=1e-5)


def test_headings_that_seem_to_be_in_radians_are_named(images):
    for name in "defg":
        (images / f"{name}.png").write_bytes((images / "a.png").read_bytes())
    rows = "".join(
        f"{name}.png,{yaw},120\n" for name, yaw in {"a": -3, "d": -2, "e": 0, "f": 1}.items()
    )
    assert "as in radians" in views_of(images, f"file,yaw,agl\n{rows}").warnings


def test_a_table_of_metashape(images):
    table = "#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll\na.png,2.5,46.5,400,30,1,2\n"
    found = views_of(images, table, SourceOptions(fov_deg=60.0, ground_alt_m=280.0))
    assert angles(found.by["a.png"]) == (30, 1, 2, 120)
    assert found.by["a.png"].truth_latlon_deg == (46.5, 2.5)


def test_columns_of_angles_that_are_not_read_are_named(images):
    found = views_of(images, "file,lat,lon,agl,Omega,phi,kappa\na.png,46.5,2.5,120,1,2,3\n")
    assert "columns Omega, phi, kappa are not read" in found.warnings


@pytest.mark.parametrize(
    "name, text",
    [
        (
            "location.txt",
            "#name latitude/Y longitude/X height/Z yaw pitch roll SAlt\nA.png 46.5 2.5 9 1 2 3 0\n",
        ),
        ("geo.csv", "a.png,46.5,2.5,400\n"),
    ],
)
def test_files_that_name_photographs_and_are_not_read_are_named(tmp_path, caplog, name, text):
    """Of Mission Planner, and of Pix4D without a header."""
    photo(tmp_path / "p/a.png", gps=place(46.5, 2.5))
    (tmp_path / "p/notes.txt").write_text("words of b.png and others")
    (tmp_path / "p" / name).write_text(text)
    assert len(list(open_source(tmp_path / "p").views)) == 1
    assert "not read, for want of a header such as file,yaw" in caplog.text
    assert name in caplog.text and "notes.txt" not in caplog.text


@pytest.mark.parametrize(
    "column, text, seconds",
    [
        ("timestamp", "1714557601500", 1_714_557_601.5),
        ("DateTimeOriginal", "2024:05:01 12:00:01.5+02:00", 1_714_557_601.5),
        ("time", "2024-05-01 10:00:01.5", 1_714_557_601.5),
    ],
)
def test_times_in_many_forms(images, column, text, seconds):
    found = views_of(images, f"file,yaw,{column}\na.png,1,{text}\n")
    assert found.by["a.png"].telemetry.time_ns == round(seconds * 1e9)


def test_the_roll_of_the_aircraft_is_not_that_of_a_gimbal(images):
    table = "file,yaw,pitch,roll,gimbal_pitch,agl\na.png,30,3,20,-90,100\n"
    found = views_of(images, table)
    assert angles(found.by["a.png"]) == (30, 0, 0, 100)


@pytest.mark.parametrize("yaw, heading", [(0, math.nan), (7, 7)])
def test_a_heading_that_is_0_beside_an_unrecorded_gimbal_is_unknown(images, yaw, heading):
    found = views_of(images, f"file,yaw,gimbal_pitch,agl\na.png,{yaw},0,100\n")
    assert angles(found.by["a.png"])[0] == pytest.approx(heading, nan_ok=True)


@pytest.mark.parametrize(
    "column, pitch, expected, said",
    [("pitch", -80, 10, True), ("pitch", 5, 5, False), ("gimbal_pitch", -40, 50, False)],
)
def test_a_pitch_near_90_is_that_of_a_gimbal(images, column, pitch, expected, said):
    found = views_of(images, f"file,yaw,{column},height\na.png,30,{pitch},120\n")
    assert angles(found.by["a.png"]) == pytest.approx((30, expected, 0, 120), abs=1e-6)
    assert ("taken as that of a gimbal" in found.warnings) == said


def test_what_is_missing_is_named(images):
    found = views_of(images, "file,lat,lon\na.png,46.5,2.5\nz.png,46.5,2.5\n")
    assert "no column of heading (yaw or heading) and of height (agl or height)" in found.warnings
    assert "2 of 3 photographs left out, not in the table, the first: c.png" in found.warnings
    assert "1 rows of the table have no photograph" in found.warnings
    zero = views_of(images, "file,yaw,agl\na.png,1,0\n")
    assert math.isnan(zero.by["a.png"].telemetry.agl_m), "0 was not measured"


@pytest.mark.parametrize(
    "table, message",
    [
        ("file,yaw\na.png,north\n", "line 2: yaw is not a number, got 'north'"),
        ("file,lat,lon\na.png,146.5,2.5\n", "line 2: not a latitude and longitude in degrees"),
        (f"file,time\na.png,1e-{10**30}\n", "line 2: time must be seconds or a date"),
        ("file,time\na.png,noon\n", "line 2: time must be seconds or a date"),
        ("file,yaw\na.png,1\na.png,2\n", "names 'a.png' twice"),
        ("file,yaw\n", "names no image"),
        ("file,yaw,\udcff\n", "not a CSV file in UTF-8"),
    ],
)
def test_tables_that_are_refused(images, table, message):
    with pytest.raises(FlightError, match=message):
        views_of(images, table)


def test_a_table_of_other_files_is_used_only_where_it_is_given(images, caplog):
    table = images / "other.csv"
    table.write_text("file,yaw\nx.png,1\n")
    with pytest.raises(FlightError, match="no time in EXIF"):
        open_source(images, FOV)
    assert "names none of the photographs is not used" in caplog.text
    with pytest.raises(FlightError, match=r"names none of the 3 photographs, such as a\.png"):
        open_source(table, FOV)
    for name in ("p.csv", "q.csv"):  # several are not guessed
        (images / name).write_text("file,yaw\na.png,1\n")
    with pytest.raises(FlightError, match=r"several tables of images \(p.csv, q.csv\)"):
        open_source(images, FOV)
    given = SourceOptions(fov_deg=60.0, telemetry=images / "p.csv")
    assert [view.frame for view in open_source(images, given).views] == ["a.png"]


def test_rows_with_folders_are_of_these_folders(images):
    for folder in ("a", "b"):
        (images / folder).mkdir()
        (images / folder / "same.png").write_bytes((images / "a.png").read_bytes())
    found = views_of(images, "file,yaw,time\na/same.png,7,2024-05-01T10:00:00\n")
    assert list(found.by) == ["a/same.png"]
    assert found.by["a/same.png"].telemetry.time_ns == 1714557600 * 10**9
    with pytest.raises(FlightError, match="several photographs of one name"):
        views_of(images, "file,yaw\nsame.png,7\n")


def test_the_table_comes_before_metadata(tmp_path):
    gps = place(46.5, 2.5) | {29: "2023:11:14", 7: (20, 1, 2)}
    photo(tmp_path / "p/a.jpg", gps=gps, xmp=dji(yaw=30, pitch=-80))
    table = "file,yaw,agl,lat,lon,time\na.jpg,77,99,47,3,7\n"
    found = views_of(tmp_path / "p", table, SourceOptions())
    assert angles(found.by["a.jpg"]) == pytest.approx((77, 10, 0, 99), abs=1e-6)
    assert found.by["a.jpg"].truth_latlon_deg == (47, 3)
    assert found.by["a.jpg"].telemetry.time_ns == 7 * 10**9


def test_a_gimbal_that_is_0_in_all_rows_was_not_recorded(images):
    rows = "file,yaw,gimbal_pitch,gimbal_roll\na.png,30,0,0\n{},40,{},0\n"
    (images / "a.csv").write_text(rows.format("c.png", 0))
    found = read_image_table(images / "a.csv")
    assert any("of the gimbal are 0 throughout" in each for each in found.warnings)
    assert [row["pose"]["pitch_deg"] for row in found.rows.values()] == [0, 0]
    assert {row["pose"]["tilt_std_deg"] for row in found.rows.values()} == {6.0}
    (images / "a.csv").write_text(
        "file,yaw,gimbal_yaw,gimbal_pitch,gimbal_roll\na.png,77,0,0,0\nc.png,80,0,0,0\n"
    )
    found = read_image_table(images / "a.csv")
    assert [row["pose"]["yaw_deg"] for row in found.rows.values()] == [77, 80]
    (images / "a.csv").write_text(rows.format("c.png", -90))
    found = read_image_table(images / "a.csv")
    assert not any("0 throughout" in each for each in found.warnings)
    assert {row["pose"]["tilt_std_deg"] for row in found.rows.values()} == {0.5}


def test_single_photographs(images):
    options = SourceOptions(fov_deg=60.0, agl_m=120.0)
    recording = open_source(images / "a.png", options)
    (view,) = recording.views
    assert view.telemetry.missing() == ["yaw_deg"] and view.telemetry.agl_m == 120
    assert view.telemetry.tilt_std_deg == 6 and view.frame == "a.png"
    assert recording.camera.fx_px == pytest.approx(32 / math.tan(math.radians(30)))
    two = open_source([images / "c.png", images / "sub/b.jpg"], options)
    assert [view.frame for view in two.views] == ["c.png", "sub/b.jpg"], "as they were given"
    with pytest.raises(CameraError, match="--camera FILE or --fov-deg"):
        open_source(images / "a.png")
    (images / "a.txt").write_text("words")
    with pytest.raises(FlightError, match="expected photographs"):
        open_source([images / "a.png", images / "a.txt"], options)
