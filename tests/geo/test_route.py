"""Routes: what is read, what is refused, distances to them and positions along them."""

import errno
import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from orthonav.errors import MissingFileError, RouteError
from orthonav.geo import route as route_module
from orthonav.geo.frames import LocalFrame
from orthonav.geo.route import (
    Route,
    along_polyline_en_m,
    distance_to_polyline_m,
    read_route,
)

WAYPOINTS = ((46.5, 2.5), (46.51, 2.53), (46.49, 2.55))
LINE = {"type": "LineString", "coordinates": [[lon, lat] for lat, lon in WAYPOINTS]}
HIGH_LINE = LINE | {"coordinates": [[*point, 120.0] for point in LINE["coordinates"]]}
POINT = {"type": "Point", "coordinates": [0, 0]}
OTHER_LINE = {"type": "LineString", "coordinates": [[9, 9], [9.1, 9]]}


def feature(geometry):
    return {"type": "Feature", "properties": {}, "geometry": geometry}


def collection(*geometries):
    return {"type": "FeatureCollection", "features": [feature(geometry) for geometry in geometries]}


def polylines(least=1):
    coordinate = st.floats(-5000, 5000).map(lambda value: round(value, 1))
    return st.integers(least, 6).flatmap(lambda n: arrays(float, (n, 2), elements=coordinate))


@pytest.mark.parametrize(
    "document",
    [
        LINE,
        HIGH_LINE,
        feature(LINE),
        collection(LINE),
        collection(None, POINT, LINE, OTHER_LINE),
        {"type": "GeometryCollection", "geometries": [POINT, LINE, OTHER_LINE]},
        feature({"type": "GeometryCollection", "geometries": [LINE]}),
    ],
    ids=["bare", "with height", "feature", "collection", "first line", "geometries", "nested"],
)
@pytest.mark.parametrize("suffix", [".geojson", ".json", ".GeoJSON"])
def test_geojson_is_read(tmp_path, document, suffix):
    path = tmp_path / f"route{suffix}"
    path.write_text(json.dumps(document))
    assert read_route(path).waypoints == WAYPOINTS


@pytest.mark.parametrize(
    "text",
    [
        "lat_deg,lon_deg\n46.5,2.5\n46.51,2.53\n46.49,2.55\n",
        "\ufeffname,lon_deg,lat_deg\r\nA,2.5,46.5\r\nB,2.53,46.51\r\nC,2.55,46.49\r\n",
    ],
    ids=["plain", "spreadsheet"],
)
def test_csv_is_read(tmp_path, text):
    path = tmp_path / "route.csv"
    path.write_text(text, encoding="utf-8")
    assert read_route(path).waypoints == WAYPOINTS


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("a.geojson", b"", "cannot be read"),
        ("a.geojson", b"{", "cannot be read"),
        ("a.geojson", b"\xff\xfe\x00", "cannot be read"),
        ("a.geojson", b"[" * 100_000, "cannot be read"),
        ("a.geojson", b"[1, 2]", "no LineString"),
        ("a.geojson", b'{"type": "FeatureCollection", "features": 5}', "cannot be read"),
        ("a.geojson", json.dumps(collection(POINT, None)).encode(), "no LineString"),
        ("a.geojson", b'{"type": "LineString"}', "cannot be read"),
        ("a.geojson", b'{"type": "LineString", "coordinates": []}', "no waypoints"),
        ("a.geojson", b'{"type": "LineString", "coordinates": [[1], [2]]}', "as numbers"),
        ("a.geojson", b'{"type": "LineString", "coordinates": [["x", 1]]}', "as numbers"),
        ("a.geojson", b'{"type": "LineString", "coordinates": [[null, 1]]}', "as numbers"),
        ("a.geojson", b'{"type": "LineString", "coordinates": [["1", "2"]]}', "as numbers"),
        ("a.geojson", b'{"type": "LineString", "coordinates": ["12", "34"]}', "as numbers"),
        ("a.geojson", b'{"type": "LineString", "coordinates": "1234"}', "as numbers"),
        ("a.geojson", b'{"type": "LineString", "coordinates": {"12": 1}}', "as numbers"),
        ("a.geojson", b'{"type": "LineString", "coordinates": [[true, 2]]}', "as numbers"),
        ("a.geojson", b'{"type": "LineString", "coordinates": [[NaN, 1]]}', "not a latitude"),
        ("a.geojson", b'{"coordinates": [[1%s, 1]], "type": "LineString"}' % (b"0" * 400), "read"),
        ("a.geojson", b'{"type": "LineString", "coordinates": [[1, 91]]}', "not a latitude"),
        ("a.csv", b"", "columns lat_deg,lon_deg"),
        ("a.csv", b"lat,lon\n1,2\n", "columns lat_deg,lon_deg"),
        ("a.csv", b"lat_deg,lon_deg\n", "no waypoints"),
        ("a.csv", b"lat_deg,lon_deg\n46.5\n", "cannot be read"),
        ("a.csv", b"lat_deg,lon_deg\n46.5,east\n", "cannot be read"),
        ("a.csv", b"lat_deg,lon_deg\n46.5,inf\n", "not a latitude"),
        ("a.csv", b"lat_deg,lon_deg\n" + b"4" * 200_000 + b",2\n", "cannot be read"),
        ("a.gpx", b"<gpx/>", "must be .geojson, .json or .csv, got '.gpx'"),
    ],
)
def test_bad_files_are_named(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(RouteError, match=message) as caught:
        read_route(path)
    assert str(caught.value).endswith(str(path))


def test_missing_folder_and_huge_files_are_refused(tmp_path, monkeypatch):
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(MissingFileError, match="does not exist"):
            read_route(path)
    monkeypatch.setattr(route_module, "MAX_ROUTE_BYTES", 10)
    (tmp_path / "a.csv").write_text("lat_deg,lon_deg\n1,2\n")
    with pytest.raises(RouteError, match="larger than"):
        read_route(tmp_path / "a.csv")


def test_a_file_that_may_not_be_read_is_named(tmp_path, monkeypatch):
    path = tmp_path / "a.csv"
    path.write_text("lat_deg,lon_deg\n1,2\n")

    def refuse(*args, **kwargs):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "read_text", refuse)
    with pytest.raises(MissingFileError, match="cannot be read"):
        read_route(path)


@given(polylines(), arrays(float, (8, 2), elements=st.floats(-6000, 6000)))
def test_distances_are_those_of_shapely(line, points):
    geometry = shapely.LineString(line) if len(line) > 1 else shapely.Point(line[0])
    expected = shapely.distance(geometry, shapely.points(points))
    np.testing.assert_allclose(distance_to_polyline_m(points, line), expected, atol=1e-6)


@given(polylines(least=2), st.floats(1, 500))
def test_positions_along_a_polyline_are_those_of_shapely(line, spacing_m):
    positions, course_deg = along_polyline_en_m(line, spacing_m)
    geometry = shapely.LineString(line)
    if geometry.length == 0:
        assert positions.tolist() == line[:1].tolist() and course_deg.tolist() == [0]
        return
    assert len(positions) == len(course_deg) == int((geometry.length + 1e-9) / spacing_m) + 1
    at = np.arange(len(positions)) * spacing_m
    expected = shapely.get_coordinates(shapely.line_interpolate_point(geometry, at))
    np.testing.assert_allclose(positions, expected, atol=1e-6)


def test_course_is_clockwise_from_north_and_turns_at_the_vertex():
    line = np.array([[0.0, 0], [0, 0], [0, 100], [100, 100], [0, 0]])
    positions, course_deg = along_polyline_en_m(line, 50)
    assert positions[:5].tolist() == [[0, 0], [0, 50], [0, 100], [50, 100], [100, 100]]
    assert course_deg.tolist() == pytest.approx([0, 0, 0, 90, 90, 225, 225])


def test_one_waypoint_is_one_position():
    positions, course_deg = along_polyline_en_m(np.array([[3.0, 4.0]]), 10)
    assert positions.tolist() == [[3, 4]] and course_deg.tolist() == [0]


def test_waypoints_in_a_frame():
    frame = LocalFrame(46.5, 2.5)
    points = Route(WAYPOINTS).points_en_m(frame)
    assert points[0] == pytest.approx([0, 0], abs=1e-6)
    np.testing.assert_allclose(np.stack(frame.latlon_from_en(points), axis=1), WAYPOINTS)
