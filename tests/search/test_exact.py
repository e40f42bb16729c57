"""Exact search: the oracle itself, against float64."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers import memory_below
from orthonav.core.tiles.position import BLOCK_ROWS, ExactIndex, rows_within

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
