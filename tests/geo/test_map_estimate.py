"""Estimates of maps agree with built maps."""

import math

import numpy as np
import pytest

from orthonav.core.geo.grid import TileGrid
from orthonav.ground.planning import spacing as estimate
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Route
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
