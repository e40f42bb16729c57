"""The index of vectors: against exact search, its files, its shards, what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orthonav.core.errors import AtlasError
from orthonav.ground.atlas.vectors import (
    Part,
    ShardedIndex,
    ShardInfo,
    VectorRecipe,
    train,
    write_shard,
)

DIMS, COUNT = 16, 6000
RECIPE = VectorRecipe(DIMS, list_bits=6, quantizers=8)


def made(count, seed=0):
    rng = np.random.default_rng(seed)
    vectors = rng.standard_normal((count, DIMS), dtype=np.float32)
    vectors *= np.arange(1, DIMS + 1, dtype=np.float32) ** -0.3
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def seen(vectors, count=60):
    rng = np.random.default_rng(9)
    queries = vectors[rng.integers(0, len(vectors), count)]
    queries = queries + 0.1 * rng.standard_normal(queries.shape).astype(np.float32)
    return np.asarray(queries / np.linalg.norm(queries, axis=1, keepdims=True))


@pytest.fixture(scope="module")
def vectors() -> np.ndarray:
    return made(COUNT)


@pytest.fixture(scope="module")
def quantizers(vectors):
    return train(vectors, RECIPE)


SHARDS = (
    ShardInfo("a", 0, (Part("one", "", 1500), Part("two", "", 2500))),
    ShardInfo("b", 4000, (Part("three", "", 2000),)),
)


@pytest.fixture
def folder(tmp_path, vectors, quantizers):
    write(tmp_path, "a", quantizers, vectors[:4000])
    write(tmp_path, "b", quantizers, vectors[4000:])
    return tmp_path


def write(folder, name, quantizers, vectors):
    info = ShardInfo(name, 0, (Part("", "", len(vectors)),))
    batches = (vectors[start : start + 1500] for start in range(0, len(vectors), 1500))
    write_shard(folder, info, quantizers, batches)


def exact(vectors, queries, k):
    products = queries @ vectors.astype(np.float16).astype(np.float32).T
    order = np.argsort(-products, axis=1, kind="stable")[:, :k]
    return np.take_along_axis(products, order, 1), order


def test_search_finds_what_exact_search_finds(folder, vectors, quantizers):
    index, queries = ShardedIndex(folder.joinpath, SHARDS, quantizers), seen(vectors)
    exact_scores, expected = exact(vectors, queries, 10)
    scores, ids = index.search(queries, 10, probes=64, rerank=400)
    assert np.mean([np.isin(a, b).mean() for a, b in zip(ids, expected, strict=True)]) > 0.99
    same = ids == expected
    np.testing.assert_allclose(scores[same], exact_scores[same], atol=1e-6)
    assert index.sheets_of(np.array([0, 1499, 1500, 3999, 4000])) == [
        *("one", "one", "two", "two", "three"),
    ]
    _, few = index.search(queries, 10, probes=16, rerank=400)
    assert np.mean([np.isin(a, b).mean() for a, b in zip(few, expected, strict=True)]) > 0.6


def test_same_input_same_bytes(tmp_path, vectors):
    for name in ("one", "other"):
        again = train(vectors, RECIPE)
        write(tmp_path / name, "a", again, vectors[:4000])
    files = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert files == ["a.codes", "a.lists.npy", "a.vectors.npy"]
    for name in files:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()


def test_fewer_vectors_than_requested(tmp_path, vectors, quantizers):
    write(tmp_path, "few", quantizers, vectors[:3])
    write(tmp_path, "none", quantizers, vectors[:0])
    shards = ShardInfo("few", 0, (Part("x", "", 3),)), ShardInfo("none", 3, (Part("y", "", 0),))
    index = ShardedIndex(tmp_path.joinpath, shards, quantizers)
    scores, ids = index.search(vectors[:2], 5, 64, 10)
    assert sorted(ids[0, :3]) == [0, 1, 2]
    assert (ids[:, 3:] == -1).all() and np.isneginf(scores[:, 3:]).all()


@pytest.mark.parametrize("name", ["a.codes", "a.lists.npy", "a.vectors.npy"])
def test_truncated_and_missing_files_are_refused(folder, name, quantizers):
    contents = (folder / name).read_bytes()
    for damage in (lambda path: path.write_bytes(contents[: len(contents) // 2]), Path.unlink):
        damage(folder / name)
        with pytest.raises(AtlasError):
            ShardedIndex(folder.joinpath, SHARDS, quantizers)


def test_damaged_codes_and_a_shard_of_another_size_are_refused(folder, vectors, quantizers):
    other = (replace(SHARDS[0], parts=SHARDS[0].parts[:1]),)
    with pytest.raises(AtlasError, match="expected 1500 rows"):
        ShardedIndex(folder.joinpath, other, quantizers)
    size = (folder / "a.codes").stat().st_size
    (folder / "a.codes").write_bytes(b"\x7f" * size)
    with pytest.raises(AtlasError, match="damaged"):
        ShardedIndex(folder.joinpath, SHARDS, quantizers).search(vectors[:1], 5, 64, 100)
