"""What a check leaves behind is whole, strict, read back by others, and the same every time."""

import errno
import json
import math
import os
import sqlite3
import sys
from dataclasses import replace

import made_check
import numpy as np
import pytest
from made_check import EVIL, lost_in, made_cells, small_route

from orthonav.check.outcome import Conditions
from orthonav.check.write import require_free, write_check
from orthonav.check.write.plain import to_json, to_plain
from orthonav.check.write.said import fine_said
from orthonav.check.write.text import text
from orthonav.errors import MissingExtraError, OutputError
from orthonav.geo.frames import LocalFrame
from orthonav.mapfile import open_map

KINDS = ("tiny", "small_route", "long_route", "nearly_empty")
FILES = {"index.html", "check.json", "check.tif", "check.gpkg", "check.qml", "figures"}
FRAME = LocalFrame(48.2, -3.1)


@pytest.fixture(scope="module")
def opened(map_path):
    return open_map(map_path)


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Pictures of few pixels, which is fast."""
    monkeypatch.setattr("orthonav.report.canvas.DPI", 20)


@pytest.fixture(scope="module")
def frame(opened):
    return opened.manifest.sheets[0].frame


@pytest.fixture
def written(opened, frame, tmp_path):
    """A check of a short route and the folder it was written to."""
    result = small_route(frame)
    write_check(result, opened, tmp_path / "check")
    return result, tmp_path / "check"


def refuse(constant):
    raise AssertionError(f"not strict JSON: {constant}")


def strict(written_text):
    return json.loads(written_text, parse_constant=refuse)


def tree(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_check_is_written(kind, opened, frame, tmp_path):
    page = write_check(getattr(made_check, kind)(frame), opened, tmp_path / "check")
    assert page == tmp_path / "check" / "index.html"
    assert {path.name for path in page.parent.iterdir()} == FILES
    assert page.stat().st_size < 4_000_000
    assert [p.name for p in tmp_path.iterdir()] == ["check"]


def test_the_same_check_gives_the_same_bytes(written, opened, tmp_path):
    result, folder = written
    write_check(result, opened, tmp_path / "again")
    assert tree(folder) == tree(tmp_path / "again")


# JSON


@pytest.mark.parametrize("kind", KINDS)
def test_json_is_strict(kind):
    result = getattr(made_check, kind)(FRAME)
    plain = strict(to_json(result))
    assert plain == to_plain(result)
    assert (plain["format"], plain["version"]) == ("orthonav-check", 1)
    assert np.shape(plain["cells"]["trials"]) == result.cells.probability.shape


def test_json_holds_what_was_found():
    result = small_route(FRAME)
    plain = to_plain(result)
    points = plain["route"]["points"]
    en_m = FRAME.en_from_latlon(points["lat_deg"], points["lon_deg"])
    np.testing.assert_allclose(en_m, result.along.points_en_m, atol=0.02)
    np.testing.assert_allclose(points["probability"], result.along.probability, atol=6e-4)
    corners = FRAME.en_from_latlon(*np.array(plain["cells"]["corners_latlon_deg"]).T)
    square = [(-500, 500), (500, 500), (500, -500), (-500, -500)]
    np.testing.assert_allclose(corners, square, atol=0.02)
    assert plain["summary"]["longest_stretch"] == len(result.stretches)
    assert plain["stretches"][-1]["ends_lost"] and not plain["stretches"][-1]["bearable"]
    assert plain["verdict"]["exit_code"] == 4


def test_what_is_not_known_is_null():
    unknown = Conditions(240, 180, None, None, 0.05, None, 0.9, 35, 20, 0.02)
    plain = to_plain(made_check.nearly_empty(FRAME))
    assert plain["cells"]["probability"][0][0] is None and plain["route"] is None
    empty = lost_in(made_cells(4, 4, 50.0), np.ones((4, 4), bool))
    result = made_check.made_check(FRAME, empty, conditions=unknown)
    plain = strict(to_json(result))
    assert plain["summary"]["mean_probability"] is None
    assert plain["summary"]["error_m"] is None
    assert plain["conditions"]["prior_std_m"] is None


def test_a_check_of_nothing_is_written(opened, frame, tmp_path):
    empty = lost_in(made_cells(4, 4, 50.0), np.ones((4, 4), bool))
    unknown = Conditions(240, 180, None, None, 0.05, None, 0.9, 35, 20, 0.02)
    result = made_check.made_check(frame, empty, conditions=unknown, lookalikes=())
    page = write_check(result, opened, tmp_path / "check")
    assert "whole map" in page.read_text()
    assert "not told" in page.read_text()
    assert text(result)


# GeoTIFF


def test_the_raster_lies_where_the_cells_do(written):
    import rasterio

    result, folder = written
    cells = result.cells
    with rasterio.open(folder / "check.tif") as raster:
        assert raster.bounds == (-500, -500, 500, 500)
        names = ("probability", "low", "high", "error_m", "wrong", "trials", "texture")
        assert raster.descriptions == names
        assert raster.dtypes == ("float32",) * 7 and math.isnan(raster.nodata)
        assert raster.compression.name == "deflate"
        for number, name in enumerate(names, start=1):
            np.testing.assert_allclose(raster.read(number), getattr(cells, name), rtol=1e-6)
        plane = raster.crs.to_dict()
        assert plane["proj"] == "aeqd" and plane["datum"] == "WGS84"
        assert (plane["lat_0"], plane["lon_0"]) == (result.frame.lat_deg, result.frame.lon_deg)
        tags = raster.tags()
        assert tags["ORTHONAV_ACCEPT"] == "0.9" and tags["ORTHONAV_VERDICT"] == "no-go"


def test_the_raster_has_holes(opened, frame, tmp_path):
    import rasterio

    result = made_check.nearly_empty(frame)
    folder = write_check(result, opened, tmp_path / "check").parent
    with rasterio.open(folder / "check.tif") as raster:
        known = raster.read(1, masked=True)
        assert known.count() == 2
        np.testing.assert_array_equal(raster.read(6), result.cells.trials)


# GeoPackage


def layer(folder, name):
    import pyogrio
    import shapely

    meta, _, shapes, columns = pyogrio.raw.read(folder / "check.gpkg", layer=name)
    return meta, shapely.from_wkb(shapes), dict(zip(meta["fields"], columns, strict=True))


def test_layers_are_read_back(written):
    import shapely

    result, folder = written
    counts = {
        "cells": 400,
        "route": len(result.along.distance_m) - 1,
        "blind": len(result.stretches),
        "lookalikes": 2,
        "legs": 3,
        "waypoints": 4,
    }
    for name, count in counts.items():
        meta, shapes, columns = layer(folder, name)
        assert len(shapes) == count and meta["crs"] == "EPSG:4326", name
        assert shapely.is_valid(shapes).all() and not shapely.is_empty(shapes).any(), name
        assert all(len(column) == count for column in columns.values())


def test_shapes_lie_where_things_are(written):
    import shapely

    result, folder = written
    _, cells, columns = layer(folder, "cells")
    east, north = result.frame.en_from_latlon(*shapely.get_coordinates(cells).T[::-1]).T
    assert [east.min(), north.min(), east.max(), north.max()] == pytest.approx(
        [-500, -500, 500, 500], abs=0.01
    )
    assert shapely.is_ccw(shapely.get_exterior_ring(cells)).all()
    probability = np.full((20, 20), np.nan)
    probability[columns["row"], columns["col"]] = columns["probability"]
    np.testing.assert_allclose(probability, result.cells.probability, atol=6e-4)
    _, blind, columns = layer(folder, "blind")
    ends = shapely.get_coordinates(shapely.get_point(blind[-1:], -1))
    last = result.frame.en_from_latlon(*ends[0][::-1])
    np.testing.assert_allclose(last, result.along.points_en_m[-1], atol=0.05)
    assert columns["ends_lost"].tolist() == [each.ends_lost for each in result.stretches]


def test_the_route_is_coloured_by_the_worse_end(written):
    result, folder = written
    _, _, columns = layer(folder, "route")
    ends = result.along.probability
    np.testing.assert_allclose(columns["probability"], np.minimum(ends[:-1], ends[1:]), atol=6e-4)
    assert set(columns["risk"]) <= {"sure", "likely", "doubtful", "unlikely", "unknown"}


def test_without_a_route_there_are_no_layers_of_one(opened, frame, tmp_path):
    import pyogrio

    folder = write_check(made_check.tiny(frame), opened, tmp_path / "check").parent
    names = set(pyogrio.list_layers(folder / "check.gpkg")[:, 0])
    assert names == {"cells", "lookalikes", "layer_styles"}


def test_a_route_of_unknown_places_has_nulls(opened, frame, tmp_path):
    cells = made_cells(20, 20, 50.0)
    gone = lost_in(cells, np.ones((20, 20), bool))
    waypoints = np.array([(-400.0, 0.0), (400.0, 0.0)])
    result = made_check.made_check(frame, gone, waypoints, 200.0, stretches=())
    folder = write_check(result, opened, tmp_path / "check").parent
    _, _, columns = layer(folder, "route")
    assert np.isnan(columns["probability"]).all() and set(columns["risk"]) == {"unknown"}
    assert text(result)


def test_every_layer_has_a_style_that_is_xml(written):
    from xml.etree import ElementTree

    _, folder = written
    with sqlite3.connect(folder / "check.gpkg") as database:
        styles = database.execute(
            "SELECT f_table_name, styleQML, useAsDefault FROM layer_styles"
        ).fetchall()
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    database.close()
    assert {name for name, _, _ in styles} == {
        *("cells", "route", "blind", "lookalikes", "legs", "waypoints")
    }
    for _, qml, default in styles:
        root = ElementTree.fromstring(qml)
        assert default == 1
        renderer = root.find("renderer-v2")
        used = {each.get("symbol") for each in renderer.iter("range")} or {"0"}
        assert used == {each.get("name") for each in renderer.iter("symbol")}
    ElementTree.fromstring((folder / "check.qml").read_text())


def test_the_date_line_is_crossed_without_a_jump():
    from orthonav.check.write.shapes import layers

    cells = next(iter(layers(made_check.tiny(LocalFrame(-17.0, 179.9999)))))
    import shapely

    west, _, east, _ = shapely.total_bounds(cells.shapes)
    assert 0 < east - west < 0.02


# The folder


def test_an_earlier_check_is_replaced(written, opened, frame):
    _, folder = written
    (folder / "check.tif.aux.xml").write_text("of a GIS program")
    write_check(made_check.nearly_empty(frame), opened, folder)
    assert {path.name for path in folder.iterdir()} == FILES
    assert {path.stem for path in (folder / "figures").glob("*.svg")} == {"map"}


@pytest.mark.parametrize("name", ["notes.txt", "figures/mine.svg", "project.qgz"])
def test_files_of_others_are_never_touched(written, opened, name):
    result, folder = written
    (folder / name).write_text("mine")
    before = tree(folder)
    with pytest.raises(OutputError, match="no check wrote"):
        require_free(folder)
    with pytest.raises(OutputError, match="no check wrote"):
        write_check(result, opened, folder)
    assert tree(folder) == before


def test_names_alone_do_not_make_a_check(opened, frame, tmp_path):
    folder = tmp_path / "check"
    folder.mkdir()
    require_free(folder)
    (folder / "index.html").write_text("mine")
    (folder / "check.json").write_text('{"format": "another"}')
    with pytest.raises(OutputError, match="no check wrote"):
        write_check(small_route(frame), opened, folder)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="is a file"):
        require_free(tmp_path / "file")


@pytest.mark.parametrize("at", [0, 2, 4, 8])
def test_a_full_disk_leaves_the_old_check(written, opened, frame, monkeypatch, at):
    _, folder = written
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


def test_an_interrupt_leaves_nothing(opened, frame, tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("orthonav.check.write.folder.write_geopackage", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_check(small_route(frame), opened, tmp_path / "check")
    assert list(tmp_path.iterdir()) == []


def test_a_geopackage_that_is_cut_off_is_refused(opened, frame, tmp_path, monkeypatch):
    import orthonav.check.write.geopackage as geopackage

    whole = geopackage._write_layer

    def fewer(path, layer, append):
        whole(path, layer, append)
        with sqlite3.connect(path) as database:
            database.execute(f'DELETE FROM "{layer.name}" WHERE fid = 3')
        database.close()

    monkeypatch.setattr(geopackage, "_write_layer", fewer)
    with pytest.raises(OutputError, match="were written"):
        write_check(small_route(frame), opened, tmp_path / "check")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("module", "extra"),
    [("pyogrio", "geo"), ("rasterio", "geo"), ("matplotlib", "report"), ("xstatic", "web")],
)
def test_what_is_not_installed_is_told_beforehand(module, extra, tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=rf"orthonav\[{extra}\]"):
        require_free(tmp_path / "check")


# Text


def test_text_says_what_matters():
    said = text(small_route(FRAME)).splitlines()
    assert said[0].startswith("NO-GO: ")
    assert any("the route ends in it" in line for line in said)
    assert any(line.startswith("area ") and "1.00 km2" in line for line in said)
    table = [line for line in said if "found again" in line or "ends in it" in line]
    assert len({line.index(" m  ") for line in table}) == 1


def test_what_is_unknown_of_an_envelope_is_said_so():
    unknown = replace(made_check.envelope(), fine_yaw_deg=math.nan)
    assert "not known" in fine_said(unknown)


@pytest.mark.parametrize("kind", KINDS)
def test_text_fits_a_terminal(kind):
    lines = text(getattr(made_check, kind)(FRAME)).splitlines()
    assert len(lines) <= 28 and max(map(len, lines)) <= 100


def test_text_holds_no_control_characters():
    result = small_route(FRAME)
    named = replace(result, about=replace(result.about, map_name="a\x1b[31mb\nc"))
    assert "\x1b" not in text(named) and "b\nc" not in text(named)


def test_names_do_no_harm(opened, frame, tmp_path):
    about = made_check.tiny(frame).about
    odd = EVIL + "\udc80"
    names = dict.fromkeys(("map_name", "imagery", "route_name", "command"), odd)
    result = small_route(frame, about=replace(about, **names, terms=(odd,)))
    page = write_check(result, opened, tmp_path / "check").read_text(encoding="utf-8")
    assert "alert(" in page and "<script>alert" not in page and "<img src=x" not in page
    assert strict((tmp_path / "check" / "check.json").read_text(encoding="utf-8"))
