"""The index of vectors: against exact search, its files, its shards, what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("faiss")

from orthonav.atlas.shards import TRAINED_NAME, ShardWriter, remove_shard, retire_rows
from orthonav.atlas.vector_search import ShardedIndex
from orthonav.atlas.vectors import Trained, VectorRecipe, train
from orthonav.errors import AtlasError

DIMS, COUNT = 16, 6000
RECIPE = VectorRecipe(DIMS, list_bits=6, quantizers=8)


def made(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    vectors = rng.standard_normal((count, DIMS), dtype=np.float32)
    vectors *= np.arange(1, DIMS + 1, dtype=np.float32) ** -0.3
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def seen(vectors: np.ndarray, count: int = 60) -> np.ndarray:
    rng = np.random.default_rng(9)
    queries = vectors[rng.integers(0, len(vectors), count)]
    queries = queries + 0.1 * rng.standard_normal(queries.shape).astype(np.float32)
    return np.asarray(queries / np.linalg.norm(queries, axis=1, keepdims=True))


@pytest.fixture(scope="module")
def vectors() -> np.ndarray:
    return made(COUNT)


@pytest.fixture(scope="module")
def trained(vectors: np.ndarray) -> Trained:
    return train(vectors, RECIPE)


@pytest.fixture
def folder(tmp_path: Path, vectors: np.ndarray, trained: Trained) -> Path:
    trained.save(tmp_path / TRAINED_NAME)
    write(tmp_path, "a", trained, 0, vectors[:4000])
    write(tmp_path, "b", trained, 10_000, vectors[4000:])
    return tmp_path


def write(folder: Path, name: str, trained: Trained, base: int, vectors: np.ndarray) -> None:
    with ShardWriter(folder, name, trained, base) as writer:
        for start in range(0, len(vectors), 1500):
            writer.add(vectors[start : start + 1500])


def test_exact_is_exact(folder: Path, vectors: np.ndarray) -> None:
    queries = seen(vectors)
    products = queries @ vectors.astype(np.float16).astype(np.float32).T
    order = np.argsort(-products, axis=1)[:, :10]
    scores, ids = ShardedIndex.open(folder).exact(queries, 10)
    np.testing.assert_allclose(scores, np.take_along_axis(products, order, 1), atol=1e-6)
    assert np.mean(ids == np.where(order >= 4000, order + 6000, order)) > 0.99


def test_finds_what_exact_search_finds(folder: Path, vectors: np.ndarray) -> None:
    index, queries = ShardedIndex.open(folder), seen(vectors)
    exact_scores, exact = index.exact(queries, 10)
    scores, ids = index.search(queries, 10, probes=64, rerank=400)
    assert np.mean([np.isin(a, b).mean() for a, b in zip(ids, exact, strict=True)]) > 0.99
    same = ids == exact
    np.testing.assert_allclose(scores[same], exact_scores[same], atol=1e-6)
    _, few = index.search(queries, 10, probes=16, rerank=400)
    assert np.mean([np.isin(a, b).mean() for a, b in zip(few, exact, strict=True)]) > 0.6


def test_one_query_finds_the_same_as_many(folder: Path, vectors: np.ndarray) -> None:
    index, queries = ShardedIndex.open(folder), seen(vectors)
    scores, ids = index.search(queries, 5, probes=20, rerank=200)
    for query in range(10):
        alone_scores, alone = index.search(queries[query : query + 1], 5, probes=20, rerank=200)
        np.testing.assert_array_equal(alone[0], ids[query])
        np.testing.assert_allclose(alone_scores[0], scores[query], atol=1e-6)


def test_same_input_same_bytes(tmp_path: Path, vectors: np.ndarray) -> None:
    for name in ("one", "other"):
        again = train(vectors, RECIPE)
        again.save(tmp_path / name / TRAINED_NAME)
        write(tmp_path / name, "a", again, 0, vectors[:4000])
    files = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert files == ["a.codes", "a.json", "a.lists.npy", "a.vectors.npy", TRAINED_NAME]
    for name in files:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()


def test_a_shard_does_not_depend_on_blocks(tmp_path: Path, folder: Path, trained: Trained) -> None:
    stored = np.load(folder / "a.vectors.npy")
    with ShardWriter(tmp_path / "again", "a", trained, 0) as writer:
        writer.add(stored)
    assert (tmp_path / "again" / "a.codes").read_bytes() == (folder / "a.codes").read_bytes()


def test_quantizers_survive_saving(tmp_path: Path, trained: Trained) -> None:
    trained.save(tmp_path / "t")
    loaded = Trained.load(tmp_path / "t")
    assert loaded.recipe == trained.recipe
    assert loaded.digest == trained.digest
    np.testing.assert_allclose(trained.turn.T @ trained.turn, np.eye(DIMS), atol=1e-5)


def test_retired_rows_are_not_found(folder: Path, vectors: np.ndarray) -> None:
    queries = seen(vectors)
    _, before = ShardedIndex.open(folder).exact(queries, 3)
    gone = np.unique(before[:, 0])
    retire_rows(folder, "a", gone[gone < 10_000][:5])
    retire_rows(folder, "a", gone[gone < 10_000][5:])
    retire_rows(folder, "b", gone[gone >= 10_000] - 10_000)
    index = ShardedIndex.open(folder)
    for _, ids in (index.exact(queries, 3), index.search(queries, 3, 64, 400)):
        assert not np.isin(ids, gone).any()
        np.testing.assert_array_equal(ids[:, 0] == before[:, 1], ~np.isin(before[:, 1], gone))


def test_shards_come_and_go(folder: Path, vectors: np.ndarray, trained: Trained) -> None:
    remove_shard(folder, "a")
    index = ShardedIndex.open(folder)
    assert len(index) == 2000
    assert index.search(vectors[:5], 4, 64, 100)[1].min() >= 10_000
    remove_shard(folder, "a")
    write(folder, "b", trained, 500, vectors[:100])
    _, ids = ShardedIndex.open(folder).search(vectors[:5], 1, 64, 100)
    np.testing.assert_array_equal(ids[:, 0], 500 + np.arange(5))


def test_fewer_vectors_than_asked_for(
    tmp_path: Path, vectors: np.ndarray, trained: Trained
) -> None:
    trained.save(tmp_path / TRAINED_NAME)
    write(tmp_path, "few", trained, 7, vectors[:3])
    write(tmp_path, "none", trained, 100, vectors[:0])
    index = ShardedIndex.open(tmp_path)
    for scores, ids in (index.search(vectors[:2], 5, 64, 10), index.exact(vectors[:2], 5)):
        assert sorted(ids[0, :3]) == [7, 8, 9]
        assert (ids[:, 3:] == -1).all() and np.isneginf(scores[:, 3:]).all()
    np.testing.assert_array_equal(index.vectors(np.array([99]))[0], 0)
    np.testing.assert_allclose(index.vectors(np.array([9, 7])), vectors[[2, 0]], atol=1e-3)


def test_nothing_is_there_after_a_failure(
    tmp_path: Path, vectors: np.ndarray, trained: Trained
) -> None:
    with pytest.raises(RuntimeError), ShardWriter(tmp_path, "a", trained, 0) as writer:
        writer.add(vectors[:50])
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    with (
        pytest.raises(AtlasError, match="finite"),
        ShardWriter(tmp_path, "a", trained, 0) as writer,
    ):
        writer.add(np.full((1, DIMS), np.nan, dtype=np.float32))
    with (
        pytest.raises(AtlasError, match="must be"),
        ShardWriter(tmp_path, "a", trained, 0) as writer,
    ):
        writer.add(vectors[:, :8])


@pytest.mark.parametrize("name", ["a.codes", "a.lists.npy", "a.vectors.npy", "a.json"])
def test_truncated_files_are_refused(folder: Path, name: str) -> None:
    contents = (folder / name).read_bytes()
    (folder / name).write_bytes(contents[: len(contents) // 2])
    with pytest.raises(AtlasError):
        ShardedIndex.open(folder)


@pytest.mark.parametrize("name", ["a.codes", "a.lists.npy", "a.vectors.npy", TRAINED_NAME])
def test_missing_files_are_told(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(AtlasError, match="cannot be read"):
        ShardedIndex.open(folder)


def test_damaged_codes_are_told(folder: Path, vectors: np.ndarray) -> None:
    size = (folder / "a.codes").stat().st_size
    (folder / "a.codes").write_bytes(b"\x7f" * size)
    with pytest.raises(AtlasError, match="damaged"):
        ShardedIndex.open(folder).search(vectors[:1], 5, 64, 100)


def test_other_quantizers_are_refused(folder: Path, vectors: np.ndarray) -> None:
    train(vectors[::2], RECIPE).save(folder / TRAINED_NAME)
    with pytest.raises(AtlasError, match="other quantizers"):
        ShardedIndex.open(folder)


def test_damaged_quantizers_are_refused(folder: Path) -> None:
    (folder / TRAINED_NAME).write_bytes(b"no")
    with pytest.raises(AtlasError, match="cannot be read"):
        ShardedIndex.open(folder)
    with pytest.raises(AtlasError, match="cannot be read"):
        Trained.load(folder / "absent")


def test_ids_must_not_overlap(folder: Path, vectors: np.ndarray, trained: Trained) -> None:
    write(folder, "c", trained, 3999, vectors[:10])
    with pytest.raises(AtlasError, match="begin before"):
        ShardedIndex.open(folder)
    told = json.loads((folder / "c.json").read_text())
    (folder / "c.json").write_text(json.dumps({**told, "schema": 2}))
    with pytest.raises(AtlasError, match="schema 2"):
        ShardedIndex.open(folder)


def test_impossible_recipes_are_refused(vectors: np.ndarray) -> None:
    for fields in ({"dims": 15}, {"list_bits": 5}, {"quantizers": 5}, {"list_bits": 40}):
        with pytest.raises(AtlasError):
            VectorRecipe(**{"dims": DIMS, "quantizers": 8, **fields})
    with pytest.raises(AtlasError, match="needs 16 vectors"):
        train(vectors[:10], RECIPE)
    with pytest.raises(AtlasError, match="must be"):
        train(vectors[:, :8], RECIPE)
    with pytest.raises(ValueError, match="queries"):
        ShardedIndex(train(vectors, RECIPE), []).search(vectors[:1, :8], 1, 1, 1)


def test_lists_grow_with_the_count() -> None:
    lists = [VectorRecipe.for_count(10**power, 64).lists for power in range(3, 9)]
    assert lists == sorted(lists)
    assert lists[-1] == 65_536
