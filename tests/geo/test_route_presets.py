"""The paper's trajectories, put anywhere."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod

from orthonav.core.errors import RouteError
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import TABLE_1, Height, leg_lengths_m, preset, read_route

GEOD = Geod(ellps="WGS84")


@given(st.sampled_from("abcdABCD"), st.floats(-80, 80), st.floats(-180, 180), st.floats(-360, 360))
def test_a_preset_has_its_length_centre_and_bearing(name, lat, lon, bearing):
    route = preset(f"paper:{name}@{lat},{lon},{bearing}")
    shape = TABLE_1[name.upper()]
    (lat0, lon0), (lat1, lon1) = route.waypoints
    assert leg_lengths_m(route)[0] == pytest.approx(shape.length_m, rel=1e-5)
    azimuth, _, half_m = GEOD.inv(lon, lat, lon1, lat1)
    assert half_m == pytest.approx(shape.length_m / 2, rel=1e-5)
    assert (azimuth - bearing + 180) % 360 - 180 == pytest.approx(0, abs=0.01)
    assert GEOD.inv(lon0, lat0, lon, lat)[2] == pytest.approx(half_m, rel=1e-4)
    assert route.leg_bands_m == (shape.band_m,)
    assert route.heights == (Height(shape.agl_m, "agl"),) * 2


def test_it_is_read_like_a_file_and_makes_an_area():
    route = read_route("paper:B@46.6,1.9")
    assert route.name == "paper:B" and route.waypoints[0][0] == pytest.approx(46.6, abs=1e-3)
    west, south, east, north = Area.from_route(route).extent_en_m
    assert (east - west, north - south) == pytest.approx((13_000, 1000), abs=10)


@pytest.mark.parametrize(
    "text, message",
    [
        ("paper:", "one of A, B, C, D"),
        ("paper:E@1,2", "one of A, B, C, D as paper:A@LAT,LON"),
        ("paper:A", "must be paper:A@LAT,LON"),
        ("paper:A@1", "must be paper:A@LAT,LON"),
        ("paper:A@1,2,3,4", "must be paper:A@LAT,LON"),
        ("paper:A@1,east", "must be paper:A@LAT,LON"),
        ("paper:A@nan,2", "must be paper:A@LAT,LON"),
        ("paper:A@90,2", "latitude of -89 to 89"),
        ("paper:A@120,46", "got 120.0, 46.0; latitude and longitude seem to be swapped"),
    ],
)
def test_other_presets_are_refused(text, message):
    with pytest.raises(RouteError, match=message):
        read_route(text)
