"""Camera positions for other programs."""

import csv
import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from orthonav.errors import VariantError
from orthonav.flight.export import CSV_COLUMNS, camera_positions, export, export_of
from orthonav.records import Fix, NoFix, ViewResult


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


def written(tmp_path, name, terrain):
    path = tmp_path / "out"
    export(path, name, camera_positions(RESULTS, terrain))
    return path.read_text(encoding="utf-8")


def test_only_confident_positions_are_taken_with_heights_above_sea():
    one, other = camera_positions(RESULTS, hill)
    assert (one.frame, one.height_m, one.std_m) == ("a.jpg", 425.0, 5.0)
    assert other.frame == "b.jpg" and other.height_m == pytest.approx(420.0 - 810.0)
    assert math.isnan(camera_positions(RESULTS, None)[0].height_m)
    tracked = replace(RESULTS[0], state="tracking")
    assert camera_positions([tracked], None)[0].std_m == 4.0


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


def test_opendronemap_takes_accuracy_only_after_a_height(tmp_path):
    lines = written(tmp_path, "odm-geo", hill).splitlines()
    assert lines[0] == "EPSG:4326"
    assert lines[1] == "a.jpg -2.25000000 48.50000000 425.000 0 0 0 5.000"
    assert written(tmp_path, "odm-geo", None).splitlines()[1] == "a.jpg -2.25000000 48.50000000"


def test_opendronemap_takes_no_names_with_spaces(tmp_path):
    positions = camera_positions([result("a b.jpg", 1.0, 2.0)], None)
    with pytest.raises(VariantError, match="spaces"):
        export(tmp_path / "geo.txt", "odm-geo", positions)
    assert not (tmp_path / "geo.txt").exists()


def test_exiftool_gets_references_of_both_hemispheres(tmp_path):
    one, other = csv.DictReader(io.StringIO(written(tmp_path, "exif", hill)))
    assert one["SourceFile"] == "a.jpg"
    assert (one["GPSLatitudeRef"], one["GPSLongitudeRef"]) == ("North", "West")
    assert (one["GPSAltitude"], one["GPSAltitudeRef"]) == ("425.000", "Above Sea Level")
    assert (other["GPSLatitude"], other["GPSLatitudeRef"]) == ("33.00000000", "South")
    assert other["GPSAltitudeRef"] == "Below Sea Level" and other["GPSImgDirection"] == ""


@pytest.mark.parametrize("text", ["csv", "csv=", "kml=a", "=a", ""])
def test_an_unknown_export_is_refused(text):
    with pytest.raises(VariantError, match="odm-geo"):
        export_of(text)


def test_an_export_is_a_format_and_a_path(tmp_path):
    name, path = export_of(f"csv={tmp_path}/a=b.csv")
    assert name == "csv" and path == tmp_path / "a=b.csv"
