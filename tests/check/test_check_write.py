"""The files of a check are complete, strict, readable by others, and reproducible."""

import errno
import json
import math
import os
import shutil
from dataclasses import replace

import made_check
import numpy as np
import pytest
from made_check import FILES, made_cells, small_route

from orthonav.core.errors import OutputError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.check.layers import check_to_plain, features
from orthonav.ground.check.records import CELL_VALUES
from orthonav.ground.check.wording import conditions_text
from orthonav.ground.check.write import require_free, write_check

FRAME = LocalFrame(48.2, -3.1)


@pytest.fixture(scope="module")
def written(opened, frame, tmp_path_factory):
    """A check of a short route and the folder it was written to, once."""
    result = small_route(frame)
    folder = tmp_path_factory.mktemp("written") / "check"
    write_check(result, opened, folder)
    return result, folder


@pytest.fixture
def folder(written, tmp_path):
    """A copy of that folder, to be changed."""
    return shutil.copytree(written[1], tmp_path / "check")


def strict(written_text):
    return json.loads(written_text, parse_constant=pytest.fail)


def tree(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_the_same_check_gives_the_same_bytes(written, opened, tmp_path):
    result, folder = written
    write_check(result, opened, tmp_path / "again")
    assert tree(folder) == tree(tmp_path / "again")


# JSON


def test_json_holds_what_was_found():
    result = small_route(FRAME)
    plain = check_to_plain(result)
    points = plain["route"]["points"]
    en_m = FRAME.en_from_latlon(points["lat_deg"], points["lon_deg"])
    np.testing.assert_allclose(en_m, result.along.points_en_m, atol=0.02)
    np.testing.assert_allclose(points["probability"], result.along.probability, atol=6e-4)
    corners = FRAME.en_from_latlon(*np.array(plain["cells"]["corners_latlon_deg"]).T)
    square = [(-500, 500), (500, 500), (500, -500), (-500, -500)]
    np.testing.assert_allclose(corners, square, atol=0.02)
    assert plain["summary"]["longest_stretch"] == len(result.outages) == len(plain["stretches"])
    assert plain["stretches"][-1]["end_m"] == pytest.approx(points["distance_m"][-1])
    assert plain["flights"]["availability"]["low"] < plain["flights"]["availability"]["high"]
    np.testing.assert_allclose(points["available"], result.flights.available, atol=6e-4)
    assert plain["verdict"]["exit_code"] == 4


def test_unknown_values_are_null():
    unknown = replace(made_check.CONDITIONS, yaw_std_deg=None, prior_std_m=None)
    cells = made_cells(4, 4, 50.0)
    cells.error_m[:] = np.nan
    result = made_check.made_check(FRAME, cells, conditions=unknown)
    plain = strict(json.dumps(check_to_plain(result)))
    assert plain["flights"] is None and plain["summary"]["error_m"] is None
    assert plain["conditions"]["prior_std_m"] is None
    said = conditions_text(unknown, None)
    assert said["error of reported heading"] == "heading unknown: all headings are searched"
    assert said["error of prior position"] == "no prior: the whole map is searched"


# GeoTIFF


def test_the_raster_lies_where_the_cells_do(written):
    import rasterio

    result, folder = written
    cells = result.cells
    with rasterio.open(folder / "check.tif") as raster:
        assert raster.bounds == (-500, -500, 500, 500)
        names = tuple(CELL_VALUES)
        assert raster.descriptions == names
        assert raster.dtypes == ("float32",) * len(names) and math.isnan(raster.nodata)
        assert raster.compression.name == "deflate"
        for number, name in enumerate(names, start=1):
            np.testing.assert_allclose(raster.read(number), getattr(cells, name), rtol=1e-6)
        plane = raster.crs.to_dict()
        assert plane["proj"] == "aeqd" and plane["datum"] == "WGS84"
        assert (plane["lat_0"], plane["lon_0"]) == (result.frame.lat_deg, result.frame.lon_deg)
        tags = raster.tags()
        assert tags["ORTHONAV_ACCEPT"] == "0.9" and tags["ORTHONAV_VERDICT"] == "no-go"


# GeoJSON


@pytest.fixture(scope="module")
def layers(written):
    """Features of the short route by layer, as shapes and properties."""
    import shapely

    plain = strict((written[1] / "check.geojson").read_text(encoding="utf-8"))
    assert plain["type"] == "FeatureCollection" and "crs" not in plain
    found = {}
    for feature in plain["features"]:
        assert feature["type"] == "Feature"
        shape = shapely.from_geojson(json.dumps(feature["geometry"]))
        shapes, rows = found.setdefault(feature["properties"].pop("layer"), ([], []))
        shapes.append(shape)
        rows.append(feature["properties"])
    return found


def test_shapes_lie_where_things_are(written, layers):
    import shapely

    result, _ = written
    assert {name: len(shapes) for name, (shapes, _) in layers.items()} == {
        "route": len(result.along.distance_m) - 1,
        "blind": len(result.outages),
        "waypoints": 4,
    }
    for shapes, _ in layers.values():
        assert shapely.is_valid(shapes).all() and not shapely.is_empty(shapes).any()
    blind, rows = layers["blind"]
    ends = shapely.get_coordinates(shapely.get_point(blind[-1:], -1))
    last = result.frame.en_from_latlon(*ends[0][::-1])
    np.testing.assert_allclose(last, result.along.points_en_m[-1], atol=0.05)
    np.testing.assert_allclose(
        [row["available"] for row in rows], [each.available for each in result.outages], atol=6e-4
    )


# The folder


def test_an_earlier_check_is_replaced(folder, opened, frame):
    (folder / "check.tif.aux.xml").write_text("of a GIS program")
    write_check(made_check.nearly_empty(frame), opened, folder)
    assert {path.name for path in folder.iterdir()} == FILES


@pytest.mark.parametrize(
    "others", [{"notes.txt": "mine"}, {"check.json": '{"format": "another"}'}], ids=str
)
def test_files_of_others_are_never_touched(written, folder, opened, others):
    result, _ = written
    for name, text in others.items():
        (folder / name).write_text(text)
    before = tree(folder)
    with pytest.raises(OutputError, match="no check wrote"):
        require_free(folder)
    with pytest.raises(OutputError, match="no check wrote"):
        write_check(result, opened, folder)
    assert tree(folder) == before
    with pytest.raises(OutputError, match="is a file"):
        require_free(folder / "check.tif")


@pytest.mark.parametrize("at", [0, 2])
def test_a_full_disk_leaves_the_old_check(folder, opened, frame, monkeypatch, at):
    before, left = tree(folder), [at]
    sync = os.fsync

    def full(handle):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(handle)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match="disk full"):
        write_check(small_route(frame), opened, folder)
    assert tree(folder) == before
    assert [path.name for path in folder.parent.iterdir()] == ["check"]


def test_the_date_line_is_crossed_without_a_jump():
    route = [each for each in features(small_route(LocalFrame(-17.0, 179.9999)))]
    lines = [each["geometry"] for each in route if each["properties"]["layer"] == "route"]
    lon = np.array([each["coordinates"] for each in lines])[..., 0]
    assert 0 < np.ptp(lon) < 0.02 and lon.max() > 180
