"""From scores to a position, by the rules of the literature."""

import numpy as np
import pytest

from orthonav.core.geo.grid import TileGrid
from orthonav.core.tiles.position import RULES, TileNeighbours, offset_en_m

GRID = TileGrid.covering((0.0, 0.0, 800.0, 640.0), gsd_m=1.0, tile_px=256, overlap=0.875)
ROWS, COLS = np.mgrid[: GRID.rows, : GRID.cols]
TILES = np.stack([ROWS.ravel(), COLS.ravel()], axis=1)
CENTRES = GRID.centres_en_m(TILES).astype(np.float32)
NEIGHBOURS = TileNeighbours(GRID, CENTRES)


def scores_around(east, north, width_m=60.0):
    away = CENTRES - np.array([east, north])
    return np.exp(-(away**2).sum(axis=1) / (2 * width_m**2)).astype(np.float32)


def position(rule, scores, rows=None):
    best = int(scores.argmax()) if rows is None else int(rows[scores.argmax()])
    offset = offset_en_m(rule, scores, best, rows, CENTRES, NEIGHBOURS, GRID.stride_m)
    return CENTRES[best] + np.array(offset)


def inner_tile():
    return int(np.flatnonzero(([GRID.rows // 2, GRID.cols // 2] == TILES).all(axis=1))[0])


@pytest.mark.parametrize("rule, within_m", [("peak", 1.0), ("neighbours", 6.0)])
def test_neighbours_tell_where_between_tiles(rule, within_m):
    tile = inner_tile()
    for away in ([9.0, -12.0], [-14.0, 3.0], [0.0, 0.0]):
        truth = CENTRES[tile] + np.array(away, np.float32)
        found = position(rule, scores_around(*truth))
        best = position("best", scores_around(*truth))
        assert np.hypot(*(found - truth)) < within_m
        assert np.hypot(*(found - truth)) <= np.hypot(*(best - truth)) + 1e-3


@pytest.mark.parametrize("rule", RULES)
def test_a_part_of_the_tiles_is_a_part_of_the_answer(rule):
    tile = inner_tile()
    near = np.flatnonzero(np.hypot(*(CENTRES - CENTRES[tile]).T) < 100)
    scores = scores_around(*(CENTRES[tile] + [5.0, 5.0]))
    found = position(rule, scores[near], near)
    assert np.hypot(*(found - CENTRES[tile])) < 32
    if rule != "weighted":
        np.testing.assert_allclose(found, position(rule, scores), atol=1e-3)
