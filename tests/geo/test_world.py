"""Sheets of the whole Earth: no place without one, each fits a map, and names mean one box."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orthonav.core.errors import AreaError, UsageError
from orthonav.core.geo.frames import MAX_SHEET_M
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.sheets import WorldSheets

SIDES_M = [WorldSheets.MIN_SIDE_M, 1234.5, 10_000.0, WorldSheets.MAX_SIDE_M]
LATITUDES = st.floats(-90, 90)
LONGITUDES = st.floats(-180, 180)


@pytest.mark.parametrize("side_m", SIDES_M)
@settings(max_examples=60)
@given(lat=LATITUDES, lon=LONGITUDES)
def test_every_position_lies_on_its_named_sheet(side_m, lat, lon):
    sheets = WorldSheets(side_m)
    west, south, east, north = sheets.bounds_deg(sheets.name_at(lat, lon))
    lon = -180.0 if lon > 180 - 1e-9 and west == -180 else lon  # the same meridian
    assert south - 1e-9 <= lat <= north + 1e-9 and west - 1e-9 <= lon <= east + 1e-9
    assert -180 <= west < east <= 180 + 1e-9 and -90 <= south < north <= 90 + 1e-9


@pytest.mark.parametrize("side_m", SIDES_M)
@settings(max_examples=40)
@given(up=st.floats(0, 1), along=st.floats(0, 1))
def test_names_round_trip(side_m, up, along):
    sheets = WorldSheets(side_m)
    row = min(sheets.rows - 1, int(up * sheets.rows))
    col = min(sheets.cols(row) - 1, int(along * sheets.cols(row)))
    name = f"r{row:06d}c{col:06d}"
    west, south, east, north = sheets.bounds_deg(name)
    assert sheets.name_at((south + north) / 2, (west + east) / 2) == name


@pytest.mark.parametrize("side_m", [WorldSheets.MIN_SIDE_M, 10_000.0, WorldSheets.MAX_SIDE_M])
@pytest.mark.parametrize("lat", [-87.0, -75.0, -30.0, -0.01, 0.01, 46.6, 60.0, 85.0, 87.0])
def test_every_sheet_fits_a_map(side_m, lat):
    sheets = WorldSheets(side_m)
    west, south, east, north = Area.from_bounds(
        sheets.bounds_deg(sheets.name_at(lat, 12.3))
    ).extent_en_m
    assert max(east - west, north - south) <= MAX_SHEET_M
    assert north - south > 0.9 * side_m  # nor smaller than asked for
    if abs(lat) < 80:
        assert east - west > 0.9 * side_m


@settings(max_examples=60)
@given(
    st.floats(-89, 88.5),
    LONGITUDES,
    st.floats(0, 0.5),
    st.floats(0, 0.5),
    st.floats(0, 1),
    st.floats(0, 1),
)
def test_a_box_is_covered_and_nothing_far_is_named(south, west, height, width, up, right):
    sheets = WorldSheets(10_000.0)
    east = west + width
    box = (west, south, east - 360 if east > 180 else east, south + height)
    names = list(sheets.over(box))
    assert len(names) == len(set(names))
    lat, lon = south + up * height, west + right * width
    assert sheets.name_at(lat, lon - 360 if lon > 180 else lon) in names
    for name in names:
        left, low, right_deg, high = sheets.bounds_deg(name)
        assert low <= south + height and high >= south - 1e-9
        assert any(
            left + turn <= east + 1e-9 and right_deg + turn >= west - 1e-9
            for turn in (-360, 0, 360)
        )


def test_around_the_earth_and_the_poles():
    sheets = WorldSheets(40_000.0)
    row = int(sheets.name_at(10.0, 0.0)[1:7])
    around = list(sheets.over((-180.0, 10.0, 180.0, 10.0)))
    assert len(around) == len(set(around)) == sheets.cols(row)
    assert sheets.name_at(90.0, 5.0) in list(sheets.over((0.0, 89.9, 10.0, 90.0)))
    assert sheets.name_at(-90.0, 5.0) in list(sheets.over((0.0, -90.0, 10.0, -89.9)))


@pytest.mark.parametrize(
    "side_m",
    [0.0, -1.0, WorldSheets.MIN_SIDE_M - 1, WorldSheets.MAX_SIDE_M + 1, math.nan, math.inf],
)
def test_sides_that_no_sheet_can_have(side_m):
    with pytest.raises(UsageError, match="sheet_km must be"):
        WorldSheets(side_m)


@pytest.mark.parametrize(
    "name", ["", "r1", "c1r1", "r999999c000000", "r000000c999999", "r-00001c000000", "../r1c1", "x"]
)
def test_names_that_no_sheet_has(name):
    with pytest.raises(AreaError, match="no sheet of 10 km is named"):
        WorldSheets(10_000.0).bounds_deg(name)


@pytest.mark.parametrize(
    "box", [(1.0, 47.0, 2.0, 46.0), (math.nan, 46.0, 2.0, 47.0), (1.0, 46.0, 2.0, math.inf)]
)
def test_boxes_that_are_none(box):
    with pytest.raises(UsageError, match="bounds must be"):
        list(WorldSheets(10_000.0).over(box))
