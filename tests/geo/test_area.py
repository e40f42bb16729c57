"""The reference area: its box in its own plane, and the search band around a route."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod

from orthonav.core.errors import AreaError, OrthonavError, UsageError
from orthonav.core.geo.grid import TileGrid
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Route

GEOD = Geod(ellps="WGS84")
offsets_deg = st.floats(-0.03, 0.03)


@st.composite
def routes(draw):
    lat, lon = draw(st.floats(-70, 70)), draw(st.floats(-179, 179))
    legs = draw(st.lists(st.tuples(offsets_deg, offsets_deg), min_size=1, max_size=5))
    return Route(tuple((lat + dlat, lon + dlon) for dlat, dlon in legs))


@given(
    st.floats(-79, 79),
    st.floats(-179, 179),
    st.floats(0.001, 0.3),
    st.floats(0.001, 0.3),
    st.floats(0, 1),
    st.floats(0, 1),
)
def test_every_point_of_the_bounds_is_in_the_area(south, west, height, width, up, right):
    area = Area.from_bounds((west, south, west + width, south + height))
    point = area.frame.en_from_latlon([south + up * height], [west + right * width])
    assert area.contains(point, margin_m=0.05).all()


def test_extent_of_bounds_is_true_metres():
    area = Area.from_bounds((2.4, 46.4, 2.6, 46.6))
    west, south, east, north = area.extent_en_m
    _, _, across = GEOD.inv(2.4, 46.4, 2.6, 46.4)  # the southern edge is the longer one
    _, _, along = GEOD.inv(2.5, 46.4, 2.5, 46.6)
    assert east - west == pytest.approx(across, abs=0.05)
    assert north - south == pytest.approx(along, abs=10)  # the northern edge bends up
    assert (area.frame.lat_deg, area.frame.lon_deg) == (46.5, 2.5)
    assert west == pytest.approx(-east, abs=1e-6)


def test_band_is_as_wide_as_asked_in_true_metres():
    area = Area.from_route(Route(((46.5, 2.5), (46.6, 2.5))), band_m=400)
    side = [GEOD.fwd(2.5, 46.55, 90, distance)[:2] for distance in (199.9, 200.1)]
    points = area.frame.en_from_latlon([lat for _, lat in side], [lon for lon, _ in side])
    assert area.contains(points).tolist() == [True, False]
    beyond = [GEOD.fwd(2.5, 46.6, 0, distance)[:2] for distance in (199.9, 200.1)]
    points = area.frame.en_from_latlon([lat for _, lat in beyond], [lon for lon, _ in beyond])
    assert area.contains(points).tolist() == [True, False]


def test_each_leg_has_its_own_band():
    corner = ((46.5, 2.5), (46.52, 2.5), (46.52, 2.54))
    area = Area.from_route(Route(corner, leg_bands_m=(100, None)), band_m=600)
    line = area.route.points_en_m(area.frame)
    west, _, east, north = area.extent_en_m
    assert line[0, 0] - west == pytest.approx(300, abs=1)  # the corner belongs to both legs
    assert (east - line[2, 0], north - line[:, 1].max()) == pytest.approx((300, 300), abs=1)
    first = (line[0] + line[1]) / 2
    points = first + np.array([[49.0, 0], [51, 0], [-49, 0], [-51, 0]])
    assert area.contains(points).tolist() == [True, False, True, False]
    second = (line[1] + line[2]) / 2
    points = second + np.array([[0, 299.0], [0, 301]])
    assert area.contains(points).tolist() == [True, False]
    assert area.contains(points, margin_m=2).all()


def test_a_band_is_needed_where_a_leg_has_none():
    route = Route(((46.5, 2.5), (46.51, 2.5), (46.51, 2.51)), leg_bands_m=(100, None))
    with pytest.raises(UsageError, match="no search band"):
        Area.from_route(route)
    whole = Route(route.waypoints, leg_bands_m=(100, 300))
    assert Area.from_route(whole) == Area.from_route(whole, None)
    same = Area.from_route(Route(route.waypoints, leg_bands_m=(200, 200)))
    plain = Area.from_route(Route(route.waypoints), 200)
    assert (same.frame, same.extent_en_m) == (plain.frame, plain.extent_en_m)


@given(routes(), st.floats(50, 800), st.sampled_from([0.0, 0.5, 0.875]), st.integers(0, 2**32 - 1))
def test_every_point_of_the_band_is_near_a_tile(route, band_m, overlap, seed):
    area = Area.from_route(route, band_m)
    grid = TileGrid.covering(area.extent_en_m, gsd_m=5.0, tile_px=128, overlap=overlap)
    rows, cols = np.mgrid[: grid.rows, : grid.cols]
    centres = grid.centres_en_m(np.stack([rows.ravel(), cols.ravel()], axis=1))
    kept = centres[area.contains(centres, margin_m=grid.stride_m * math.sqrt(2) / 2)]

    rng = np.random.default_rng(seed)
    line = area.route.points_en_m(area.frame)
    start = rng.integers(0, max(1, len(line) - 1), 20)
    end = np.minimum(start + 1, len(line) - 1)
    on_line = line[start] + rng.random((20, 1)) * (line[end] - line[start])
    angle, reach = rng.uniform(0, 2 * np.pi, 20), rng.uniform(0, band_m / 2, 20)
    points = on_line + np.stack([np.cos(angle), np.sin(angle)], axis=1) * reach[:, None]

    assert area.contains(points, margin_m=1e-6).all()
    off = np.abs(points[:, None] - kept[None]).max(axis=2).min(axis=1)
    assert (off <= grid.stride_m / 2 + 1e-6).all()


@pytest.mark.parametrize(
    "bounds, message",
    [
        ((2.6, 46.4, 2.4, 46.6), "west < east"),
        ((2.4, 46.6, 2.6, 46.4), "south < north"),
        ((math.nan, 46.4, 2.6, 46.6), "west,south,east,north"),
        ((2.0, 46.0, 2.2, 46.6), r"66\.\d km across.*50 km.*--bounds or --route"),
        ((-170.0, -80.0, 170.0, 80.0), "at most 10 degrees"),
        ((2.4, 89.8, 2.6, 90.0), "at most 10 degrees"),
        ((500.0, 46.4, 500.1, 46.6), "centre of a sheet"),
    ],
)
def test_bounds_that_are_no_area_are_refused(bounds, message):
    with pytest.raises(OrthonavError, match=message):
        Area.from_bounds(bounds)


def test_a_band_that_makes_the_sheet_too_large_is_refused():
    route = Route(((46.28, 2.5), (46.72, 2.5)))  # 49 km
    Area.from_route(route, 500)
    with pytest.raises(AreaError, match="50 km"):
        Area.from_route(route, 2000)


@pytest.mark.parametrize("band_m", [0, -5, math.nan, math.inf])
def test_a_band_without_width_is_refused(band_m):
    with pytest.raises(UsageError, match="wider than 0"):
        Area.from_route(Route(((46.5, 2.5),)), band_m)


@pytest.mark.parametrize("lon_deg", [179.95, -179.95])
def test_an_area_may_lie_across_the_antimeridian(lon_deg):
    there = np.array([lon_deg, lon_deg - math.copysign(359.9, lon_deg), lon_deg])
    outline = Area.from_outline(np.array([-17.0, -17.05, -17.1]), there)
    bounds = Area.from_bounds((179.95, -17.1, -179.95, -17.0))
    route = Route(((-17.0, lon_deg), (-17.05, there[1]), (-17.1, lon_deg)))
    band = Area.from_route(route, band_m=200)
    _, _, across = GEOD.inv(179.95, -17.0, -179.95, -17.0)
    for area in (outline, bounds, band):
        west, _, east, _ = area.extent_en_m
        assert east - west == pytest.approx(across + area.band_m, rel=1e-3)
        _, lon = area.frame.latlon_from_en(np.array([[east - 1, 0], [west + 1, 0]]))
        assert lon.tolist() == pytest.approx([-179.95, 179.95], abs=2e-3)
    points = band.frame.en_from_latlon([-17.025, -17.0], [180.0, -179.95])
    assert band.contains(points).tolist() == [True, lon_deg < 0]
