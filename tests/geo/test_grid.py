"""The tile grid: nothing of the extent is farther than half a stride from a tile centre."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.core.errors import AreaError, UsageError
from orthonav.core.geo.grid import TileGrid

coordinates = st.floats(-25_000, 25_000)
shares = st.floats(0, 1)
GOOD = {"gsd_m": 1.0, "tile_px": 256, "overlap": 0.875}


@st.composite
def grids(draw):
    west, south = draw(coordinates), draw(coordinates)
    extent = (west, south, west + draw(st.floats(0, 3000)), south + draw(st.floats(0, 3000)))
    grid = TileGrid.covering(
        extent,
        gsd_m=draw(st.floats(0.5, 5)),
        tile_px=draw(st.integers(64, 512)),
        overlap=draw(st.floats(0, 0.95)),
    )
    return extent, grid


def every_centre(grid: TileGrid) -> np.ndarray:
    rows, cols = np.mgrid[: grid.rows, : grid.cols]
    return grid.centres_en_m(np.stack([rows.ravel(), cols.ravel()], axis=1))


@given(grids(), shares, shares)
def test_every_point_is_within_half_a_stride_of_a_centre(extent_and_grid, along_east, along_north):
    (west, south, east, north), grid = extent_and_grid
    point = np.array([west + along_east * (east - west), south + along_north * (north - south)])
    off = np.abs(every_centre(grid) - point).max(axis=1).min()
    assert off <= grid.stride_m / 2 + 1e-6


@given(grids())
def test_tiles_fill_the_raster_exactly(extent_and_grid):
    _, grid = extent_and_grid
    half = grid.tile_m / 2
    first, last = grid.centres_en_m(np.array([[0, 0], [grid.rows - 1, grid.cols - 1]]))
    corner = [grid.west_m + grid.width_px * grid.gsd_m, grid.north_m - grid.height_px * grid.gsd_m]
    np.testing.assert_allclose(first, [grid.west_m + half, grid.north_m - half], atol=1e-6)
    np.testing.assert_allclose(last, [corner[0] - half, corner[1] + half], atol=1e-6)


def test_impossible_numbers_are_refused():
    values = {"gsd_m": (0, math.nan, math.inf), "tile_px": (15,), "overlap": (1.0, -0.1, math.nan)}
    for name, bad in values.items():
        for value in bad:
            said = "16 to 4096 px" if name == "tile_px" else name
            with pytest.raises(UsageError, match=said):
                TileGrid.covering((0, 0, 1000, 1000), **(GOOD | {name: value}))
    for extent in ((1, 0, 0, 1), (0, 1, 1, 0), (math.nan, 0, 1, 1), (-math.inf, 0, math.inf, 1)):
        with pytest.raises(AreaError, match="area is empty or not finite"):
            TileGrid.covering(extent, **GOOD)
