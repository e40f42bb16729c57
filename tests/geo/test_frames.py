"""The local plane: inverse of itself, PROJ's azimuthal-equidistant plane, true to geodesics."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pyproj import Geod, Transformer

from orthonav.core.errors import AreaError
from orthonav.core.geo.frames import MAX_SHEET_M, LocalFrame

HALF_DIAGONAL_M = MAX_SHEET_M / math.sqrt(2)
ONE_MM = 1e-3

frames = st.builds(LocalFrame, st.floats(-80, 80), st.floats(-180, 180))
azimuths_deg = st.floats(0, 360)


def en_of(distance_m: float, azimuth_deg: float) -> np.ndarray:
    azimuth = math.radians(azimuth_deg)
    return np.array([distance_m * math.sin(azimuth), distance_m * math.cos(azimuth)])


@given(
    st.builds(LocalFrame, st.floats(-89.9, 89.9), st.floats(-360, 360)),
    st.floats(0, HALF_DIAGONAL_M),
    azimuths_deg,
)
def test_local_to_latlon_and_back(frame, distance_m, azimuth_deg):
    position = en_of(distance_m, azimuth_deg)
    lat, lon = frame.latlon_from_en(position)
    assert abs(lat) <= 90 and abs(lon) <= 180
    np.testing.assert_allclose(frame.en_from_latlon(lat, lon), position, atol=ONE_MM)


@given(frames, st.floats(0, 25_000), azimuths_deg)
@example(LocalFrame(1e-07, -1e-07), 25_000.0, 45.0)
@example(LocalFrame(48.1, 179.99), 20_000.0, 90.0)
@example(LocalFrame(-80, -180), 25_000.0, 270.0)
def test_is_the_plane_of_proj_within_a_millimetre(frame, distance_m, azimuth_deg):
    proj = Transformer.from_crs("EPSG:4326", frame.proj4, always_xy=True)
    position = en_of(distance_m, azimuth_deg)
    lat, lon = frame.latlon_from_en(position)
    np.testing.assert_allclose(proj.transform(lon, lat), position, atol=ONE_MM)
    lon, lat = proj.transform(*position, direction="INVERSE")
    np.testing.assert_allclose(frame.en_from_latlon(lat, lon), position, atol=ONE_MM)


@given(frames, st.floats(0, 25_000), azimuths_deg)
def test_distance_and_azimuth_are_those_of_the_geodesic(frame, distance_m, azimuth_deg):
    lon, lat, _ = Geod(ellps="WGS84").fwd(frame.lon_deg, frame.lat_deg, azimuth_deg, distance_m)
    expected = en_of(distance_m, azimuth_deg)
    np.testing.assert_allclose(frame.en_from_latlon(lat, lon), expected, atol=ONE_MM)


@pytest.mark.parametrize(
    "lat, lon", [(90, 0), (-89.95, 0), (math.nan, 0), (0, math.nan), (0, 361), (120.0, 48.0)]
)
def test_an_invalid_centre_is_refused(lat, lon):
    swapped = "; latitude and longitude seem" if lat == 120 else ""
    with pytest.raises(AreaError, match=f"centre of a sheet .* got {lat}, {lon}{swapped}"):
        LocalFrame(lat, lon)
