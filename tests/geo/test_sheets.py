"""Areas too large for a sheet: the parts fit, and together they are the whole."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orthonav.core.errors import AreaError, OrthonavError
from orthonav.core.geo.frames import MAX_SHEET_M
from orthonav.ground.planning import sheets as sheets_module
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Height, Route, leg_lengths_m
from orthonav.ground.planning.sheets import sheets_of_route


def across_m(area):
    west, south, east, north = area.extent_en_m
    return max(east - west, north - south)


steps = st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))


@settings(max_examples=40)
@given(st.floats(-60, 60), st.floats(-180, 180), st.lists(steps, min_size=1, max_size=6), st.data())
def test_parts_of_a_route_fit_and_follow_each_other(lat, lon, turns, data):
    places = np.cumsum([(lat, lon), *turns], axis=0)
    places[:, 0] = np.clip(places[:, 0], -80, 80)
    bands = data.draw(st.lists(st.floats(10, 9000), min_size=len(turns), max_size=len(turns)))
    heights = tuple(Height(100.0 * each, "agl") for each in range(len(places)))
    route = Route(tuple(map(tuple, places.tolist())), heights, tuple(bands))
    parts = sheets_of_route(route, None)
    assert max(across_m(Area.from_route(part)) for part in parts) <= MAX_SHEET_M
    for before, after in pairwise(parts):
        assert before.waypoints[-1] == after.waypoints[0]
        assert before.heights[-1] == after.heights[0]
        whole = before.waypoints + after.waypoints[1:2]
        with pytest.raises(AreaError):  # each part as long as fits
            longer = before.leg_bands_m + after.leg_bands_m[:1]
            Area.from_route(Route(whole, leg_bands_m=longer))
    if len(parts) == 1:
        assert parts == [route]
    found = [place for part in parts for place in part.waypoints]
    assert [place for place in found if place in route.waypoints][-1] == route.waypoints[-1]
    assert set(route.waypoints) <= set(found)
    length = sum(leg_lengths_m(part).sum() for part in parts)
    assert length == pytest.approx(leg_lengths_m(route).sum(), rel=1e-3)
    assert {band for part in parts for band in part.leg_bands_m} == set(bands)


def test_a_leg_longer_than_a_sheet_is_cut():
    route = Route(((46.6, 1.574), (46.6, 2.227)), (Height(4000, "agl"),) * 2, (5000,))
    parts = sheets_of_route(route, None)
    assert [part.name for part in parts] == ["sheet-1", "sheet-2"]
    assert [leg_lengths_m(part).sum() for part in parts] == pytest.approx(
        [25_000, 25_000], rel=1e-3
    )
    assert {height for part in parts for height in part.heights} == {Height(4000, "agl")}
    diagonal = Route(((46.44, 1.67), (46.76, 2.13)), leg_bands_m=(5000,))
    assert len(sheets_of_route(diagonal, None)) == 1  # its corners are nearer


@pytest.mark.parametrize(
    "route, band_m, message",
    [
        (Route(((46, 2), (47, 3))), None, "no search band"),
        (Route(((46, 2), (47, 3))), 50_000, "as wide as a sheet"),
        (Route(((0, 0), (0, 180))), 100, "half of the Earth"),
    ],
)
def test_routes_that_cannot_be_cut_are_refused(route, band_m, message):
    with pytest.raises(OrthonavError, match=message):
        sheets_of_route(route, band_m)


@pytest.mark.parametrize(
    "route",
    [
        Route(((0.0, 0.0), (1.0, 9.0)), leg_bands_m=(49_900.0,)),
        Route(((0.0, 0.0), (0.0, 179.0)) * 3),
        Route(tuple((0.0, longitude) for longitude in (0.0, 100.0) * 40_000)),
    ],
)
def test_routes_of_too_many_sheets_are_refused_before_the_work(route, monkeypatch):
    monkeypatch.setattr(Area, "contains", None)
    fits, tried = sheets_module._fits, []
    monkeypatch.setattr(sheets_module, "_fits", lambda *each: tried.append(each) or fits(*each))
    with pytest.raises(AreaError, match="at most 500 are planned"):
        sheets_of_route(route, 500.0)
    assert len(tried) <= 1000
