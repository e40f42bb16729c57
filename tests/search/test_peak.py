"""The peak between tiles: parabola, neighbours, gated searches, centres that are no grid."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.core.errors import MapFileError
from orthonav.core.geo.grid import TileGrid
from orthonav.core.tiles.position import TileNeighbours, parabola_peak

GRID = TileGrid.covering((0.0, 0.0, 900.0, 600.0), gsd_m=1.0, tile_px=256, overlap=0.875)


def tiles(keep=lambda row, col: True):
    rows, cols = np.mgrid[: GRID.rows, : GRID.cols]
    both = np.stack([rows.ravel(), cols.ravel()], axis=1)
    return both[[keep(row, col) for row, col in both]]


def scores_with_peak(centres, east_m, north_m):
    """A parabola of the scores, so interpolation has an exact answer."""
    offset = (centres - [east_m, north_m]) / GRID.stride_m
    return (1 - 0.01 * (offset**2).sum(axis=1)).astype(np.float32)


@given(st.floats(-0.5, 0.5), st.floats(0.1, 5), st.floats(-3, 3))
def test_parabola_is_recovered(peak, curvature, height):
    behind, middle, ahead = (height - curvature * (x - peak) ** 2 for x in (-1.0, 0.0, 1.0))
    if middle >= behind and middle >= ahead:
        assert parabola_peak(behind, middle, ahead) == pytest.approx(peak, abs=1e-6)


@given(st.floats(64, 830), st.floats(64, 530))
def test_peak_lies_where_the_scores_say(east_m, north_m):
    centres = GRID.centres_en_m(tiles()).astype(np.float32)
    scores = scores_with_peak(centres, east_m, north_m)
    best = int(scores.argmax())
    offset = np.array(TileNeighbours(GRID, centres).peak_offset(scores, best)) * GRID.stride_m
    # Scores are float32: a hundredth of a stride is what they resolve.
    np.testing.assert_allclose(centres[best] + offset, [east_m, north_m], atol=0.5)


def test_gated_search_gives_the_same_offset():
    centres = GRID.centres_en_m(tiles()).astype(np.float32)
    scores = scores_with_peak(centres, 410.0, 290.0)
    best = int(scores.argmax())
    neighbours = TileNeighbours(GRID, centres)
    rows = np.flatnonzero(np.hypot(*(centres - centres[best]).T) <= 2 * GRID.stride_m)
    assert neighbours.peak_offset(scores[rows], best, rows) == neighbours.peak_offset(scores, best)


@given(
    st.integers(0, 10**6),
    st.integers(0, 12),
    st.sampled_from([0.0, 0.3, 0.7]),
    st.booleans(),
)
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


def test_missing_neighbours_leave_their_axis_alone():
    centres = GRID.centres_en_m(tiles(lambda row, col: col != 5)).astype(np.float32)
    neighbours = TileNeighbours(GRID, centres)
    best = int(np.flatnonzero((GRID.tiles_rc(centres) == [6, 6]).all(axis=1))[0])
    assert neighbours.beside(best, -1, 0) is None
    north_of = neighbours.beside(best, 0, 1)
    assert north_of is not None and centres[north_of][1] == centres[best][1] + GRID.stride_m
    offset = neighbours.peak_offset(scores_with_peak(centres, *(centres[best] + 8)), best)
    assert offset[0] == 0.0 and offset[1] == pytest.approx(0.25, abs=0.02)


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
