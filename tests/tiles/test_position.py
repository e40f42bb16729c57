"""Exact search against float64, and from scores to a position by the rules of the literature."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers import memory_below
from orthonav.core.errors import MapFileError
from orthonav.core.geo.grid import TileGrid
from orthonav.core.tiles.position import (
    BLOCK_ROWS,
    RULES,
    ExactIndex,
    TileNeighbours,
    rows_within,
)

CACHES = pytest.mark.parametrize("cache_bytes", [0, 2**27], ids=["blocks", "cached"])


def embeddings(count, width=128, seed=0):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(count, width)) / np.sqrt(width)
    return values.astype(np.float16)


def queries(count=3, width=128):
    return embeddings(count, width, seed=1).astype(np.float32)


@CACHES
@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, BLOCK_ROWS - 1, BLOCK_ROWS, 2 * BLOCK_ROWS + 7])
@pytest.mark.parametrize("width", [1, 3, 4, 128])
def test_scores_are_scalar_products(cache_bytes, count, width):
    stored, asked = embeddings(count, width), queries(width=width)
    scores = ExactIndex(stored, cache_bytes).scores(asked)
    assert scores.shape == (count, 3) and scores.dtype == np.float32
    np.testing.assert_allclose(scores, stored.astype(float) @ asked.astype(float).T, atol=1e-5)


@CACHES
@pytest.mark.parametrize("picked", [0, 1, 500, 1500])
def test_rows_give_the_same_as_all(cache_bytes, picked):
    index = ExactIndex(embeddings(2000), cache_bytes)
    rows = np.random.default_rng(2).permutation(2000)[:picked]
    some = index.scores(queries(), rows)
    np.testing.assert_allclose(some, index.scores(queries())[rows], atol=1e-6)


@CACHES
def test_every_float16_is_decoded_exactly(cache_bytes):
    every = np.arange(2**16, dtype=np.uint16).view(np.float16)
    stored = every[np.isfinite(every)].reshape(-1, 2).copy()
    scores = ExactIndex(stored, cache_bytes).scores(np.eye(2, dtype=np.float32))
    assert (scores == stored.astype(np.float32)).all()


@given(
    st.lists(st.tuples(st.integers(-99, 99), st.integers(-99, 99)), max_size=30),
    st.integers(-99, 99),
    st.integers(0, 150),
)
def test_gate_is_a_closed_circle(centres, east, radius_m):
    points = np.array(centres, dtype=np.float32).reshape(-1, 2)
    rows = rows_within(points, np.array([east, 0.0]), float(radius_m))
    expected = [i for i, (e, n) in enumerate(centres) if (e - east) ** 2 + n**2 <= radius_m**2]
    assert rows.tolist() == expected


@CACHES
@pytest.mark.parametrize("count", [0, 1, BLOCK_ROWS - 1, BLOCK_ROWS, 2 * BLOCK_ROWS + 7])
@pytest.mark.parametrize("asked", [1, 2, 50])
def test_best_is_that_of_all_scores(cache_bytes, count, asked):
    index, many = ExactIndex(embeddings(count, 16), cache_bytes), queries(asked, 16)
    scores = index.scores(many)
    best = index.best(many)
    assert best.shape == (count,) and best.dtype == np.float32
    np.testing.assert_allclose(best, scores.max(axis=1), atol=1e-6)
    rows = np.random.default_rng(3).permutation(count)[:40]
    np.testing.assert_allclose(index.best(many, rows), best[rows], atol=1e-6)


def test_best_needs_little_memory():
    stored, many = embeddings(60_000, 8), queries(300, 8)
    index = ExactIndex(stored, cache_bytes=0)
    with memory_below(4 * 2**20):  # all scores would be 72 MB
        index.best(many)


# The peak between tiles.

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


# Rules of position.

WHOLE = GRID.centres_en_m(tiles()).astype(np.float32)


def scores_around(east, north, width_m=60.0):
    away = WHOLE - np.array([east, north])
    return np.exp(-(away**2).sum(axis=1) / (2 * width_m**2)).astype(np.float32)


def position(rule, scores, rows=None):
    best = int(scores.argmax()) if rows is None else int(rows[scores.argmax()])
    offset = TileNeighbours(GRID, WHOLE).offset_en_m(rule, scores, best, rows)
    return WHOLE[best] + np.array(offset)


def inner_tile():
    return int(np.flatnonzero(([GRID.rows // 2, GRID.cols // 2] == tiles()).all(axis=1))[0])


@pytest.mark.parametrize("rule, within_m", [("peak", 1.0), ("neighbours", 6.0)])
def test_neighbours_tell_where_between_tiles(rule, within_m):
    tile = inner_tile()
    for away in ([9.0, -12.0], [-14.0, 3.0], [0.0, 0.0]):
        truth = WHOLE[tile] + np.array(away, np.float32)
        found = position(rule, scores_around(*truth))
        best = position("best", scores_around(*truth))
        assert np.hypot(*(found - truth)) < within_m
        assert np.hypot(*(found - truth)) <= np.hypot(*(best - truth)) + 1e-3


@pytest.mark.parametrize("rule", RULES)
def test_a_part_of_the_tiles_is_a_part_of_the_answer(rule):
    tile = inner_tile()
    near = np.flatnonzero(np.hypot(*(WHOLE - WHOLE[tile]).T) < 100)
    scores = scores_around(*(WHOLE[tile] + [5.0, 5.0]))
    found = position(rule, scores[near], near)
    assert np.hypot(*(found - WHOLE[tile])) < 32
    if rule != "weighted":
        np.testing.assert_allclose(found, position(rule, scores), atol=1e-3)
