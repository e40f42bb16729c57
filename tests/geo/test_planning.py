"""Camera, height and map that suit each other; height above terrain; estimates of maps."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers import waypoints
from orthonav.cli.common import OPTIONS
from orthonav.core.errors import CameraError, RouteError
from orthonav.core.geo.camera import Camera, footprint_en_m
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.geo.ground import RELIEF_SLOPES, unknown_slope_share
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Height, Route
from orthonav.ground.planning.spacing import (
    LIMITS,
    ViewPlan,
    estimate_map,
    profile,
    suited_map,
    suited_tile_px,
    terrain_cautions,
    view_cautions,
)

CAMERA = Camera(1280, 960, 1000.0, 1000.0, 640.0, 480.0)


def codes(found):
    return [each.code for each in found]


def test_the_view_is_the_footprint():
    view = ViewPlan.of(CAMERA, 500)
    corners = footprint_en_m(CAMERA, 0, 0, 0, 500)
    assert (view.width_m, view.height_m) == pytest.approx(tuple(np.ptp(corners, axis=0)))
    assert view.gsd_m == 0.5 and view.short_m == 480
    assert view.spacing_m == pytest.approx(192)
    assert view.across_px(2) == pytest.approx(math.sqrt(640 * 480) / 2)
    assert view.tile_share(480) == 1 and view.tile_share(960) == pytest.approx(1 / 3)
    with pytest.raises(CameraError, match="height above ground"):
        ViewPlan.of(CAMERA, math.nan)


@given(st.floats(1, 50_000), st.integers(64, 6000), st.integers(64, 6000), st.floats(0.3, 5))
def test_the_map_that_is_advised_is_good_for_the_view(agl_m, width_px, height_px, focal):
    focal_px = focal * width_px
    camera = Camera(width_px, height_px, focal_px, focal_px, 10.0, 10.0, unusual=True)
    view = ViewPlan.of(camera, agl_m)
    gsd_m, tile_px = suited_map(view)
    assert gsd_m >= 0.995 * max(LIMITS.finest_imagery_m, view.gsd_m)
    said = set(codes(view_cautions(view, gsd_m, tile_px)))
    assert "too_coarse" not in said
    if tile_px == 256:
        assert said <= {"low"} and view.across_px(gsd_m) >= 256
    if "part_of_tile" in said or "tile_too_large" in said:
        assert tile_px == 64 and view.short_m < 64 * gsd_m
    assert suited_tile_px(view, gsd_m) == tile_px


@pytest.mark.parametrize(
    "agl_m, gsd_m, tile_px, expected",
    [
        (500, 1.8, 256, []),
        (500, 1.0, 256, []),
        (500, 4.0, 256, ["few_pixels", "tile_too_large"]),
        (500, 3.0, 256, ["part_of_tile"]),
        (500, 0.1, 256, ["too_coarse"]),
        (50, 0.2, 128, ["low"]),
        (50, 5.0, 256, ["low", "too_small", "tile_too_large"]),
    ],
)
def test_what_speaks_against_a_map(agl_m, gsd_m, tile_px, expected):
    view = ViewPlan.of(CAMERA, agl_m)
    assert codes(view_cautions(view, gsd_m, tile_px)) == expected
    is_small = view.tile_share(gsd_m * tile_px) < LIMITS.min_tile_share
    assert is_small or "tile_too_large" not in expected


FRAME = LocalFrame(46.5, 2.5)
ENDS = np.array([[0.0, 0.0], [0.0, 4000.0], [2000.0, 4000.0]])
PLACES = waypoints(FRAME, ENDS)


def slope(lat, lon):
    """300 m above the sea at the first waypoint, 5 m more every 100 m to the north."""
    return 300 + FRAME.en_from_latlon(lat, lon)[..., 1] * 0.05


@pytest.mark.parametrize(
    "heights, agl_m, expected",
    [
        ((), 400, [(400, 400), (400, 400)]),
        ((Height(700, "amsl"),) * 3, None, [(200, 400), (200, 200)]),
        ((Height(400, "home"),) * 3, None, [(200, 400), (200, 200)]),
        ((Height(400, "agl"),) * 3, None, [(400, 400), (400, 400)]),
        ((Height(700, "amsl"), Height(900, "amsl"), None), 150, [(400, 400), (150, 150)]),
        ((Height(400), Height(400), Height(400)), 250, [(250, 250), (250, 250)]),
    ],
)
def test_height_above_ground_leg_by_leg(heights, agl_m, expected):
    legs = profile(Route(PLACES, heights), (100.0, 100.0), agl_m, 200.0, slope)
    grounds = (300, 500), (500, 500)
    for leg, length_m, ground_m, over in zip(legs, (4000, 2000), grounds, expected, strict=True):
        assert leg.length_m == pytest.approx(length_m, abs=0.1)
        assert leg.ground_m == pytest.approx(ground_m, abs=0.1)
        assert leg.agl_m == pytest.approx(over, abs=0.2)
    assert legs[0].relief == pytest.approx(10 / expected[0][0], rel=0.15)


def test_hills_and_collisions_give_cautions():
    route = Route(PLACES, (Height(450, "amsl"),) * 3)
    low = profile(route, (10.0, 10.0), None, 100.0, slope)
    assert codes(terrain_cautions(low)) == ["ground"]
    bent = profile(Route(PLACES), (10.0, 10.0), 80, 200.0, slope)
    (caution,) = terrain_cautions(bent)
    assert caution.code == "relief" and "13% of the height on legs 1, 2" in caution.text
    beside = profile(Route(PLACES), (10_000.0, 10.0), 80, 0.0, slope)
    assert terrain_cautions(beside) == []
    landing = Route(PLACES, (Height(0, "home"), Height(300, "home"), Height(300, "home")))
    assert codes(terrain_cautions(profile(landing, (9.0, 9.0), None, 100.0, slope))) == ["relief"]


def test_a_hill_beside_the_leg_counts_within_the_band():
    def wall(lat, lon):
        return np.where(FRAME.en_from_latlon(lat, lon)[..., 0] > 500, 100.0, 0.0)

    route = Route(PLACES[:2])
    assert profile(route, (890.0,), 300, 100.0, wall)[0].relief == 0
    (leg,) = profile(route, (960.0,), 300, 100.0, wall)
    assert leg.relief == pytest.approx(1 / 3, rel=0.01) and leg.agl_m == (300, 300)


def test_unknown_heights_are_refused():
    with pytest.raises(RouteError, match=r"height of leg 1 .*is unknown, or .*--agl-m"):
        profile(Route(PLACES), (1.0, 1.0), None, 10.0, slope)
    ellipsoid = Route(PLACES, tuple(Height(400.0, "hae") for _ in PLACES))
    with pytest.raises(RouteError, match=r"or it is above the ellipsoid; .*--agl-m"):
        profile(ellipsoid, (1.0, 1.0), None, 10.0, slope)
    middle = (PLACES[0][0] + PLACES[1][0]) / 2, (PLACES[0][1] + PLACES[1][1]) / 2

    def hole(lat, lon):
        north = (lat - middle[0]) * (PLACES[1][0] - PLACES[0][0])
        east = (lon - middle[1]) * (PLACES[1][1] - PLACES[0][1])
        return np.where(north + east > 0, np.nan, 0.0)

    with pytest.raises(RouteError, match=r"no height for (49|50|51)% of leg 1 .*a hole, or beyond"):
        profile(Route(PLACES), (1.0, 1.0), 100, 10.0, hole)


L_ROUTE = Route(((46.5, 2.5), (46.53, 2.5), (46.53, 2.56)), leg_bands_m=(200, 900))


def test_a_box_is_counted_exactly():
    area = Area.from_bounds((2.48, 46.48, 2.52, 46.52))
    made = estimate_map(area, gsd_m=1.0, tile_px=256, overlap=0.875)
    grid = TileGrid.covering(area.extent_en_m, gsd_m=1.0, tile_px=256, overlap=0.875)
    assert made.tiles == grid.rows * grid.cols
    assert made.area_km2 == pytest.approx(made.tiles * 32**2 / 1e6)
    assert made.imagery_km2 == pytest.approx(grid.width_px * grid.height_px / 1e6)
    low, high = (size / made.area_km2 for size in made.map_mb)
    assert 0.267 + 0.15 <= low < 0.267 + 0.35 <= high < 0.7


def test_tiles_of_a_route_are_those_that_are_built():
    area = Area.from_route(L_ROUTE)
    made = estimate_map(area, gsd_m=2.0, tile_px=128, overlap=0.75)
    grid = TileGrid.covering(area.extent_en_m, gsd_m=2.0, tile_px=128, overlap=0.75)
    rows, cols = np.mgrid[: grid.rows, : grid.cols]
    centres = grid.centres_en_m(np.stack([rows.ravel(), cols.ravel()], axis=1))
    assert made.tiles == area.contains(centres, grid.stride_m * math.sqrt(0.5)).sum()
    assert made.area_km2 < made.imagery_km2


def test_a_sample_agrees_with_the_count():
    area = Area.from_route(L_ROUTE)
    exact = estimate_map(area, gsd_m=1.0, tile_px=128, overlap=0.75)
    rough = estimate_map(area, gsd_m=1.0, tile_px=128, overlap=0.75, maps=40)
    assert rough.tiles == pytest.approx(exact.tiles, rel=0.03)
    assert rough.imagery_km2 == pytest.approx(exact.imagery_km2, rel=0.03)


def test_slope_and_tilt_are_told_apart_by_what_is_known_of_each():
    assert unknown_slope_share(0) == 0
    assert unknown_slope_share(90, "rolling") == pytest.approx(0.05 / math.sqrt(2), rel=1e-3)
    for relief, slope in RELIEF_SLOPES.items():
        exact = 1 / math.sqrt(1 / math.radians(1) ** 2 + 2 / slope**2)
        assert unknown_slope_share(1, relief) == pytest.approx(exact)
    assert OPTIONS["--relief"]["choices"] == tuple(RELIEF_SLOPES)
