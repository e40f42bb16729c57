"""Estimates of maps agree with built maps."""

import math

import numpy as np
import pytest

from orthonav.core.errors import AreaError
from orthonav.core.geo.grid import TileGrid
from orthonav.ground.planning import spacing as estimate
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Route, read_route
from orthonav.ground.planning.spacing import estimate_map

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
    less = estimate_map(area, gsd_m=1.0, tile_px=256, overlap=0.875, registration=False)
    assert less.map_mb == pytest.approx((0.267 * made.area_km2,) * 2, rel=0.01)


def test_tiles_of_a_route_are_those_that_are_built():
    area = Area.from_route(L_ROUTE)
    made = estimate_map(area, gsd_m=2.0, tile_px=128, overlap=0.75)
    grid = TileGrid.covering(area.extent_en_m, gsd_m=2.0, tile_px=128, overlap=0.75)
    rows, cols = np.mgrid[: grid.rows, : grid.cols]
    centres = grid.centres_en_m(np.stack([rows.ravel(), cols.ravel()], axis=1))
    assert made.tiles == area.contains(centres, grid.stride_m * math.sqrt(0.5)).sum()
    assert made.area_km2 < made.imagery_km2


def test_a_sample_agrees_with_the_count(monkeypatch):
    area = Area.from_route(L_ROUTE)
    exact = estimate_map(area, gsd_m=1.0, tile_px=128, overlap=0.75)
    monkeypatch.setattr(estimate, "_MOST_POINTS", 5000)
    rough = estimate_map(area, gsd_m=1.0, tile_px=128, overlap=0.75)
    assert rough.tiles == pytest.approx(exact.tiles, rel=0.03)
    assert rough.imagery_km2 == pytest.approx(exact.imagery_km2, rel=0.03)


def test_large_and_small_maps_take_the_time_that_was_measured():
    box = Area.from_bounds((2.435, 46.455, 2.565, 46.545))  # 10 x 10 km
    made = estimate_map(box, gsd_m=1.0, tile_px=256, overlap=0.875)
    assert made.build_s == pytest.approx(93, rel=0.1)
    single = Area.from_route(read_route("paper:A@46.5,2.5"))
    assert estimate_map(single, gsd_m=0.2, tile_px=256, overlap=0.875).build_s < 60


def test_impossible_numbers_are_refused():
    area = Area.from_bounds((2.48, 46.48, 2.52, 46.52))
    for numbers in ({"gsd_m": 0.0}, {"tile_px": 3}, {"overlap": 1.0}):
        with pytest.raises(AreaError):
            estimate_map(area, **{"gsd_m": 1.0, "tile_px": 256, "overlap": 0.5, **numbers})


def test_estimates_of_many_maps_are_made_from_fewer_points(monkeypatch):
    """Their sum takes as much work as one; each stays within some percent."""
    area, asked, contains = Area.from_route(L_ROUTE), [], Area.contains

    def counted(self, points, margin_m=0.0):
        asked.append(len(points))
        return contains(self, points, margin_m)

    monkeypatch.setattr(Area, "contains", counted)
    alone = estimate_map(area, gsd_m=1.0, tile_px=128, overlap=0.75)
    one, asked[:] = sum(asked), []
    of_many = estimate_map(area, gsd_m=1.0, tile_px=128, overlap=0.75, maps=100)
    assert sum(asked) < one / 20
    assert of_many.tiles == pytest.approx(alone.tiles, rel=0.05)
