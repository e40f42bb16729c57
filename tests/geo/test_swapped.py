"""Swapped latitude and longitude are named where a position cannot be right."""

import pytest

from orthonav.core.errors import AreaError, RouteError
from orthonav.core.geo.swapped import HINT, swapped_hint
from orthonav.ground.planning.route import Route
from orthonav.ground.planning.sheets import WorldSheets, sheets_of_bounds


def near(lat_deg, lon_deg):
    """Whether a position lies near 46.5 N, 3 E."""
    return abs(lat_deg - 46.5) < 1 and abs(lon_deg - 3.0) < 1


@pytest.mark.parametrize(
    "lat_deg, lon_deg, contains, swapped",
    [
        (121.0, 24.0, None, True),
        (24.0, 121.0, None, False),
        (121.0, 124.0, None, False),
        (3.0, 46.5, near, True),
        (46.5, 3.0, near, False),
        (10.0, 20.0, near, False),
        (float("nan"), 3.0, None, False),
    ],
)
def test_swapped_positions(lat_deg, lon_deg, contains, swapped):
    assert swapped_hint(lat_deg, lon_deg, contains) == (f"; {HINT}" if swapped else "")


def test_swapped_waypoints_out_of_range_are_named():
    with pytest.raises(RouteError, match=HINT):
        Route(((121.0, 24.0),))


def test_swapped_boxes_of_sheets_are_named():
    with pytest.raises(AreaError, match=HINT):
        sheets_of_bounds((24.0, 121.0, 24.1, 121.1))
    with pytest.raises(AreaError, match=HINT):
        WorldSheets(5000.0).name_at(121.0, 24.0)
