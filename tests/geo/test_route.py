"""Routes: what is read, what is refused, distances to them and positions along them."""

import json

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pyproj import Geod

from orthonav.core.errors import MissingFileError, RouteError
from orthonav.ground.planning import route as route_module
from orthonav.ground.planning.route import (
    Height,
    Route,
    along_polyline_en_m,
    leg_lengths_m,
    read_route,
    to_geojson,
)

GEOD = Geod(ellps="WGS84")
WAYPOINTS = ((46.5, 2.5), (46.51, 2.53), (46.49, 2.55))
POINTS = [[lon, lat] for lat, lon in WAYPOINTS]
LINE = {"type": "LineString", "coordinates": POINTS}
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
        collection(None, POINT, LINE),
        {"type": "MultiLineString", "coordinates": [POINTS[:1], POINTS[1:]]},
        {"type": "GeometryCollection", "geometries": [POINT, LINE]},
        feature({"type": "GeometryCollection", "geometries": [LINE]}),
    ],
)
@pytest.mark.parametrize("suffix", [".geojson", ".json", ".GeoJSON"])
def test_geojson_is_read(read, document, suffix):
    assert read(document, f"route{suffix}").waypoints == WAYPOINTS


@pytest.mark.parametrize(
    "text",
    [
        "lat_deg,lon_deg\n46.5,2.5\n46.51,2.53\n46.49,2.55\n",
        "\ufeffname,lon_deg,lat_deg\r\nA,2.5,46.5\r\nB,2.53,46.51\r\nC,2.55,46.49\r\n",
        "Latitude; Longitude\n46,5; 2,5\n46,51; 2,53\n46,49; 2,55\n",
        "lon\tlat\talt\n2.5\t46.5\t120\n2.53\t46.51\t\n2.55\t46.49\t90\n",
    ],
    ids=["plain", "spreadsheet", "decimal commas", "tabs"],
)
def test_csv_is_read(read, text):
    assert read(text, "route.csv").waypoints == WAYPOINTS


def test_columns_say_heights_and_bands(read):
    rows = "46.5,2.5,120,400\n46.51,2.53,,\n46.49,2.55,100,9\n"
    route = read(f"lat,lon,agl_m,band_m\n{rows}", "route.csv")
    assert route.heights == (Height(120, "agl"), None, Height(100, "agl"))
    assert route.leg_bands_m == (400, None)  # the last row begins no leg
    assert route.bands_m(300) == (400, 300) and route.bands_m(None) is None
    one = read("lat,lon,alt,band_m\n46.5,2.5,120,400\n", "route.csv")
    assert one == Route(((46.5, 2.5),), (Height(120),), (400,))


def test_a_mission_of_litchi_states_what_its_heights_count_from(read):
    def heights(rows, unit="m", mode="altitudemode"):
        header = f"latitude,longitude,altitude({unit}),heading(deg),{mode},poi_altitude(m)\n"
        return read(header + rows, "litchi.csv").heights

    both = heights("46.5,2.5,100,90,0,7\n46.51,2.53,120,90,1,7\n")
    assert both == (Height(100, "home"), Height(120, "agl"))
    assert heights("46.5,2.5,9,0,1,7\n", mode="altitude_mode") == (Height(9, "agl"),)
    assert heights("46.5,2.5,100,90,0,7\n", "ft") == (Height(30.48, "home"),)
    with pytest.raises(RouteError, match="altitudemode must be 0"):
        heights("46.5,2.5,100,90,2,7\n")


@pytest.mark.parametrize("name, fits", [
    ("urn:ogc:def:crs:OGC:1.3:CRS84", True),
    ("EPSG:4326", True),
    ("urn:ogc:def:crs:EPSG::2154", False),
    ("EPSG:4230", False),
])  # fmt: skip
def test_the_system_of_an_older_geojson_is_wgs_84(read, name, fits):
    document = LINE | {"crs": {"type": "name", "properties": {"name": name}}}
    if fits:
        assert read(document).waypoints == WAYPOINTS
        return
    with pytest.raises(RouteError, match=f"is in {name}: convert it to WGS 84 .ogr2ogr"):
        read(document)


@pytest.mark.parametrize("rows", ["46.5,2.5\n0,0\n46.6,2.5", "0.8116,0.0436\n0.8118,0.0436"])
def test_positions_of_none_and_radians_are_refused(read, rows):
    with pytest.raises(RouteError, match="at or around 0, 0, in the sea: give degrees, not rad"):
        read(f"lat,lon\n{rows}\n", "a.csv")


def test_a_pointer_of_git_lfs_is_named(read):
    with pytest.raises(MissingFileError, match=r"Git LFS pointer.*git lfs pull"):
        read("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "a.kml")


def test_properties_say_heights_bands_and_names(read):
    own = {"name": "east", "band_m": [300, None], "height_frame": "amsl", "home_amsl_m": 250}
    heights = (Height(120, "amsl"),) * 3
    found = read(feature(HIGH_LINE) | {"properties": own})
    assert found == Route(WAYPOINTS, heights, (300, None), "east", 250)
    assert read(feature(LINE) | {"properties": {"band_m": 200}}).leg_bands_m == (200, 200)


@pytest.mark.parametrize(
    "own, message",
    [
        ({"band_m": [1, 2, 3]}, "3 bands for 2 legs"),
        ({"band_m": "wide"}, "band_m must be a number"),
        ({"band_m": -1}, "wider than 0"),
        ({"height_frame": "sea"}, "must be agl, home, amsl"),
        ({"height_frame": ["agl"]}, "1 entries for 3 waypoints"),
        ({"home_amsl_m": True}, "home_amsl_m must be a number"),
    ],
)
def test_properties_that_make_no_sense_are_refused(read, own, message):
    with pytest.raises(RouteError, match=message):
        read(feature(HIGH_LINE) | {"properties": own})


def test_lines_are_picked_by_name(read):
    both = collection(LINE, OTHER_LINE)
    with pytest.raises(RouteError, match=r"2 lines; .*: 1 \(no name\), 2 \(no name\)"):
        read(both)
    both["features"][1]["properties"] = {"name": "x#/y"}
    named = r"give FILE#NAME or FILE#NUMBER: 1 \(no name\), 2 'x"
    refused = {"": f"2 lines; {named}", "#z": f"0 lines are named 'z'; {named}"}
    refused |= {f"#{n}": f"0 lines are named '{n}'" for n in ("0", "3", "-1", "1.0")}
    for selected, message in refused.items():
        with pytest.raises(RouteError, match=message):
            read(both, f"a.geojson{selected}")
    for selected, first in (("#x#/y", (9, 9)), ("#1", WAYPOINTS[0]), ("#02", (9, 9))):
        assert read(both, f"a.geojson{selected}").waypoints[0] == first
    both["features"][0]["properties"] = {"name": "2"}  # a name comes before a number
    assert read(both, "a.geojson#2").waypoints == WAYPOINTS


heights = st.none() | st.builds(
    Height, st.floats(-500, 9000), st.sampled_from([None, "agl", "home", "amsl"])
)
degrees = st.tuples(st.floats(-90, 90), st.floats(-180, 180))


@st.composite
def whole_routes(draw):
    count = draw(st.integers(1, 6))
    high = draw(st.booleans())
    bands = st.none() | st.floats(1, 5000)
    return Route(
        tuple(draw(st.lists(degrees, min_size=count, max_size=count))),
        tuple(draw(heights.filter(bool)) for _ in range(count)) if high else (),
        tuple(draw(bands) for _ in range(max(1, count - 1))) if draw(st.booleans()) else (),
        draw(st.none() | st.text(min_size=1)),
        draw(st.none() | st.floats(-400, 5000)),
    )


@given(st.lists(whole_routes(), min_size=1, max_size=3))
def test_what_is_written_as_geojson_is_read_again(routes):
    assert route_module._READERS[".geojson"](to_geojson(routes).encode()) == routes


@given(st.sampled_from(sorted(route_module._READERS)), st.binary(max_size=200))
def test_any_bytes_give_a_route_or_a_route_error(suffix, content):
    try:
        found = route_module._READERS[suffix](content)
    except (RouteError, *route_module._BROKEN):
        return
    assert found


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("a.geojson", b"", "is empty"),
        ("a.geojson", b"{", "cannot be read"),
        ("a.geojson", b"\xff\xfe\x00", "not UTF-8 text"),
        ("a.geojson", b"[" * 100_000, "cannot be read"),
        ("a.geojson", b"[1, 2]", "must be a JSON object, got list"),
        ("a.geojson", json.dumps(collection(POINT, None)).encode(), "no LineString"),
        ("a.geojson", b'{"type": "LineString"}', "coordinates is missing"),
        ("a.geojson", b'{"type": "LineString", "coordinates": []}', "no waypoints"),
        ("a.geojson", b'{"type": "LineString", "coordinates": [[1], [2]]}', "cannot be read"),
        ("a.geojson", b'{"type": "LineString", "coordinates": [[NaN, 1]]}', "must be a number"),
        ("a.geojson", b'{"coordinates": [[1%s, 1]], "type": "LineString"}' % (b"0" * 400), "read"),
        ("a.geojson", b'{"type": "LineString", "coordinates": [[1, 91]]}', "a latitude within 90"),
        ("a.csv", b"x,y\n1,2\n", "columns lat_deg,lon_deg .* got x,y"),
        ("a.csv", b"PNG\0\0\0\n\0", "route table cannot be read|columns"),
        ("a.csv", b"lat,lon,alt\n1,2,1e9\n", "height of a waypoint must be within"),
        ("a.csv", b"lat,lon,band_m\n1,2,0\n1,3,\n", "band of a leg must be wider than 0"),
        ("a.csv", b"lat,lon\n" + b"1,2\n" * 100_001, "100,001 waypoints, at most 100,000"),
        ("a.csv", b"lat_deg,lon_deg\n", "no waypoints"),
        ("a.csv", b"lat_deg,lon_deg\n46.5,inf\n", "row 2, lon_deg must be a number, got 'inf'"),
        ("a.csv", b"lat_deg,lon_deg\n" + b"4" * 200_000 + b",2\n", "cannot be read"),
        ("a.shp", b"", "must be one of .geojson, .*, .gpx, got '.shp'"),
    ],
)
def test_bad_files_are_named(read, tmp_path, name, content, message):
    with pytest.raises(RouteError, match=message) as caught:
        read(content, name)
    assert str(caught.value).endswith(str(tmp_path / name))


def test_missing_folder_and_huge_files_are_refused(read, tmp_path, monkeypatch):
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(MissingFileError, match=r"does not exist|is a folder"):
            read_route(path)
    monkeypatch.setattr(route_module, "MAX_ROUTE_BYTES", 10)
    with pytest.raises(RouteError, match="larger than"):
        read("lat_deg,lon_deg\n1,2\n", "a.csv")


@pytest.mark.parametrize("reach_deg, tolerance", [(1, 5e-6), (25, 5e-3)])
@given(st.floats(-60, 60), st.floats(-180, 180), st.floats(-1, 1), st.floats(-1, 1))
def test_legs_are_as_long_as_geodesics(reach_deg, tolerance, lat, lon, dlat, dlon):
    there = lat + dlat * reach_deg, lon + dlon * reach_deg
    expected = GEOD.inv(lon, lat, there[1], there[0])[2]
    (found,) = leg_lengths_m(Route(((lat, lon), there)))
    assert found == pytest.approx(expected, rel=tolerance, abs=1e-3)


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
