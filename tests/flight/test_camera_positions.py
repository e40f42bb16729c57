"""Camera positions for other programs."""

import csv
import io
import json
import math
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from orthonav.core.errors import VariantError
from orthonav.core.records import Fix, NoFix, ViewResult
from orthonav.ground.recordings.export import CSV_COLUMNS, camera_positions, export_all, export_of


def result(frame, lat_deg, lon_deg, confidence=0.97, heading_deg=271.5):
    covariance = np.array([[9.0, 0.0], [0.0, 16.0]])  # and 3 m of the map
    fix = Fix(lat_deg, lon_deg, covariance, confidence, 35.0, heading_deg, 120.0)
    return ViewResult(frame, 0, fix, 1.0)


def hill(lat_deg, lon_deg):
    return 300.0 + 10 * (np.asarray(lat_deg) - 48.0)


RESULTS = [
    result("a.jpg", 48.5, -2.25),
    result("doubtful.jpg", 48.5, -2.25, confidence=0.5),
    ViewResult("none.jpg", 0, NoFix("blank", ""), 1.0),
    result("b.jpg", -33.0, 18.0, heading_deg=math.nan),
]


def written(tmp_path, name, terrain, results=RESULTS):
    export_all([export_of(f"{name}={tmp_path / 'out'}")], results, terrain)
    return (tmp_path / "out").read_text(encoding="utf-8")


def test_only_confident_positions_are_taken_with_heights_above_sea():
    one, other = camera_positions(RESULTS, hill)
    assert (one.view.frame, one.height_m, one.std_m) == ("a.jpg", 425.0, 5.0)
    assert other.view.frame == "b.jpg" and other.height_m == pytest.approx(420.0 - 810.0)
    assert math.isnan(camera_positions(RESULTS, None)[0].height_m)
    tracked = replace(RESULTS[0], state="tracking")
    assert camera_positions([tracked], None)[0].std_m == 4.0
    for text in ("csv", "csv=", "shp=a", ""):
        with pytest.raises(VariantError, match="odm-geo"):
            export_of(text)


@pytest.mark.parametrize(("terrain", "height"), [(hill, "425.000"), (None, "")])
def test_csv(tmp_path, terrain, height):
    rows = list(csv.DictReader(io.StringIO(written(tmp_path, "csv", terrain))))
    assert tuple(rows[0]) == CSV_COLUMNS and len(rows) == 2
    assert rows[0]["lat_deg"] == "48.50000000" and rows[0]["height_m"] == height
    assert (rows[0]["heading_deg"], rows[1]["heading_deg"]) == ("271.500", "")


def test_geojson(tmp_path):
    features = json.loads(written(tmp_path, "geojson", hill))["features"]
    assert features[0]["geometry"] == {"type": "Point", "coordinates": [-2.25, 48.5, 425.0]}
    assert features[0]["properties"]["std_m"] == 5.0
    assert features[1]["properties"]["heading_deg"] is None
    level = json.loads(written(tmp_path, "geojson", None))["features"]
    assert level[0]["geometry"]["coordinates"] == [-2.25, 48.5]


def test_exiftool_gets_references_of_both_hemispheres(tmp_path):
    one, other = csv.DictReader(io.StringIO(written(tmp_path, "exif", hill)))
    assert one["SourceFile"] == "a.jpg"
    assert (one["GPSLatitudeRef"], one["GPSLongitudeRef"]) == ("North", "West")
    assert (one["GPSAltitude"], one["GPSAltitudeRef"]) == ("425.000", "Above Sea Level")
    assert (other["GPSLatitude"], other["GPSLatitudeRef"]) == ("33.00000000", "South")
    assert other["GPSAltitudeRef"] == "Below Sea Level" and other["GPSImgDirection"] == ""


def test_opendronemap_takes_accuracy_only_after_a_height(tmp_path):
    lines = written(tmp_path, "odm-geo", hill).splitlines()
    assert lines[0] == "EPSG:4326"
    assert lines[1] == "a.jpg -2.25000000 48.50000000 425.000 0 0 0 5.000"
    assert written(tmp_path, "odm-geo", None).splitlines()[1] == "a.jpg -2.25000000 48.50000000"


def test_where_opendronemap_takes_no_name_the_other_formats_are_written(tmp_path):
    spaced = [replace(RESULTS[0], frame="a b.jpg")]
    paths = {name: tmp_path / name for name in ("odm-geo", "csv")}
    with pytest.raises(VariantError, match="all other results are written"):
        export_all([export_of(f"{name}={path}") for name, path in paths.items()], spaced, None)
    assert "a b.jpg" in paths["csv"].read_text("utf-8") and not paths["odm-geo"].exists()


def test_a_trajectory_for_evo(tmp_path):
    """Columns of TUM: seconds, position, and a quaternion that turns camera axes to east, north,
    up."""
    comment, first, second = written(tmp_path, "tum", hill).splitlines()
    assert comment == "# east, north, up (m) of 48.50000000, -2.25000000 (WGS84)"
    numbers = np.array(first.split(), dtype=float)
    assert numbers[:4].tolist() == [0, 0, 0, 425.0] and len(second.split()) == 8
    x, y, z, w = numbers[4:]
    down = np.array([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)])
    right = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])
    assert down == pytest.approx([0, 0, -1], abs=1e-6)  # the optical axis
    heading = np.radians(271.5)
    assert right == pytest.approx([np.cos(heading), -np.sin(heading), 0], abs=1e-6)


@pytest.mark.parametrize("terrain", [hill, None])
def test_kml_is_xml(tmp_path, terrain):
    space = {"k": "http://www.opengis.net/kml/2.2"}
    named = [replace(RESULTS[0], frame="a & b.jpg"), *RESULTS[1:]]
    kml = ElementTree.fromstring(written(tmp_path, "kml", terrain, named))
    mode = {each.text for each in kml.iterfind(".//k:altitudeMode", space)}
    assert mode == {"absolute" if terrain else "relativeToGround"}
    line, one, _ = (each.text for each in kml.iterfind(".//k:coordinates", space))
    assert one == line.split()[0] == f"-2.25000000,48.50000000,{425 if terrain else 120}.00"
    assert kml.findall(".//k:name", space)[1].text == "a & b.jpg"
