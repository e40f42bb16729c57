"""The peak between tiles: parabola, neighbours, gated searches, centres that are no grid."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.core.errors import MapFileError
from orthonav.core.geo.grid import TileGrid
from orthonav.core.tiles.position import TileNeighbours

GRID = TileGrid.covering((0.0, 0.0, 900.0, 600.0), gsd_m=1.0, tile_px=256, overlap=0.875)


def tiles(keep=lambda row, col: True):
    rows, cols = np.mgrid[: GRID.rows, : GRID.cols]
    both = np.stack([rows.ravel(), cols.ravel()], axis=1)
    return both[[keep(row, col) for row, col in both]]


def scores_with_peak(centres, east_m, north_m):
    """A parabola of the scores, so interpolation has an exact answer."""
    offset = (centres - [east_m, north_m]) / GRID.stride_m
    return (1 - 0.01 * (offset**2).sum(axis=1)).astype(np.float32)


@given(st.floats(64, 830), st.floats(64, 530))
def test_peak_lies_where_the_scores_say(east_m, north_m):
    centres = GRID.centres_en_m(tiles()).astype(np.float32)
    scores = scores_with_peak(centres, east_m, north_m)
    best = int(scores.argmax())
    offset = np.array(TileNeighbours(GRID, centres).peak_offset(scores, best)) * GRID.stride_m
    # Scores are float32: a hundredth of a stride is what they resolve.
    np.testing.assert_allclose(centres[best] + offset, [east_m, north_m], atol=0.5)


@given(st.integers(0, 10**6), st.integers(0, 12), st.sampled_from([0.0, 0.3, 0.7]), st.booleans())
def test_maxima_are_the_tiles_that_no_neighbour_exceeds(seed, count, missing, gated):
    rng = np.random.default_rng(seed)
    some = tiles(lambda row, col: rng.random() >= missing)
    centres = GRID.centres_en_m(some).astype(np.float32)
    scores = rng.integers(0, 9, len(centres)).astype(np.float32)  # many are equal
    scores[rng.random(len(scores)) < 0.1] = np.nan
    rows = np.flatnonzero(rng.random(len(centres)) < 0.6) if gated else None
    seen, values = (some, scores) if rows is None else (some[rows], scores[rows])
    known = {tuple(tile): value for tile, value in zip(seen.tolist(), values, strict=True)}

    def is_peak(tile, value):
        steps = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1)]
        around = [known.get((tile[0] + down, tile[1] + right), np.nan) for down, right in steps]
        return np.isfinite(value) and value >= np.nanmax(around)

    peaks = [at for at, each in enumerate(seen) if is_peak(each, values[at])]
    found = TileNeighbours(GRID, centres).maxima(values, count, rows)
    assert found.tolist() == sorted(peaks, key=lambda at: (-values[at], at))[:count]


@pytest.mark.parametrize("broken", ["reversed", "twice", "outside"])
def test_centres_that_are_no_grid_are_refused(broken):
    centres = GRID.centres_en_m(tiles()).astype(np.float32)
    if broken == "reversed":
        centres = centres[::-1]
    elif broken == "twice":
        centres = np.concatenate([centres[:1], centres])
    else:
        centres = centres - np.float32(10 * GRID.stride_m)
    with pytest.raises(MapFileError, match="grid"):
        TileNeighbours(GRID, centres)
