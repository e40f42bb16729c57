"""Searching all shards of an index of vectors; exact search over them is the oracle."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthonav.atlas.shards import NONE, TRAINED_NAME, Ids, OpenShard, Shard
from orthonav.atlas.vectors import Array, Trained, one_thread
from orthonav.errors import AtlasError


class ShardedIndex:
    """All shards of a folder, mapped, searched on one core.

    Ids are those of the shards: base + row. Not for several threads at once.
    """

    def __init__(self, trained: Trained, shards: Sequence[OpenShard]) -> None:
        self.trained = trained
        self.shards = sorted(shards, key=lambda each: each.shard.base)
        ends = [each.shard.base + each.shard.rows for each in self.shards]
        for shard, end in zip(self.shards[1:], ends, strict=False):
            if shard.shard.base < end:
                raise AtlasError(f"ids of shard {shard.shard.name} begin before {end}")

    @classmethod
    def open(cls, folder: Path, names: Sequence[str] | None = None) -> "ShardedIndex":
        """Open the shards of a folder (or those named) and the quantizers they share.

        Raises `AtlasError` where a file is damaged or made with other quantizers.
        """
        folder = Path(folder)
        trained = Trained.load(folder / TRAINED_NAME)
        found = sorted(path.stem for path in folder.glob("*.json")) if names is None else names
        manifests = [Shard.read(folder / f"{name}.json") for name in found]
        return cls(trained, [OpenShard(folder, each, trained) for each in manifests])

    def __len__(self) -> int:
        return sum(each.shard.rows for each in self.shards)

    def search(
        self, queries: NDArray[np.float32], k: int, probes: int, rerank: int
    ) -> tuple[Array, Ids]:
        """Highest scalar products (Q, k) and ids (Q, k) of queries (Q, D), best first.

        `probes` lists are scanned of every shard, and the `rerank` best by code over all shards
        compared as stored. Where fewer are found: id -1 and product -inf.
        """
        queries = self._checked(queries)
        turned = self.trained.turned(queries)
        lists, centre_scores = self.trained.nearest_lists(turned, probes)
        rerank = max(k, rerank)
        scores = np.full((len(queries), 0), -np.inf, dtype=np.float32)
        ids: Ids = np.empty((len(queries), 0), dtype=np.int64)
        with one_thread():
            for shard in self.shards:
                found, rows = shard.scan(turned, lists, centre_scores, rerank)
                some = np.where(rows == NONE, NONE, rows + shard.shard.base)
                scores, ids = _best(
                    np.concatenate([scores, found], axis=1),
                    np.concatenate([ids, some], axis=1),
                    rerank,
                )
        return self._compared(queries, ids, k)

    def exact(self, queries: NDArray[np.float32], k: int) -> tuple[Array, Ids]:
        """What `search` should find: every stored vector compared, block by block."""
        queries = self._checked(queries)
        scores = np.full((len(queries), k), -np.inf, dtype=np.float32)
        ids = np.full((len(queries), k), NONE, dtype=np.int64)
        for shard in self.shards:
            for first, block in shard.blocks():
                rows = np.arange(first, first + len(block))
                products = queries @ block.T
                if len(shard.retired):
                    products[:, np.isin(rows, shard.retired)] = -np.inf
                # After the first blocks hardly a vector is among the best.
                better = products > scores.min(axis=1, keepdims=True)
                for query in np.flatnonzero(better.any(axis=1)):
                    new = np.flatnonzero(better[query])
                    kept, kept_ids = _best(
                        np.concatenate([scores[query], products[query, new]])[None],
                        np.concatenate([ids[query], rows[new] + shard.shard.base])[None],
                        k,
                    )
                    scores[query], ids[query] = kept[0], kept_ids[0]
        return _sorted(scores, ids, k)

    def vectors(self, ids: Ids) -> Array:
        """Stored vectors (N, D) of ids (N,); zeros where an id is no shard's."""
        out = np.zeros((len(ids), self.trained.dims), dtype=np.float32)
        for shard in self.shards:
            rows = ids - shard.shard.base
            ours = np.flatnonzero((rows >= 0) & (rows < shard.shard.rows))
            if len(ours):
                ours = ours[np.argsort(rows[ours], kind="stable")]
                out[ours] = shard.take(rows[ours])
        return out

    def _compared(self, queries: Array, ids: Ids, k: int) -> tuple[Array, Ids]:
        """The best k of the candidates (Q, R), by their stored vectors."""
        scores = np.full(ids.shape, -np.inf, dtype=np.float32)
        for query, candidates in enumerate(ids):
            real = np.flatnonzero(candidates != NONE)
            scores[query, real] = self.vectors(candidates[real]) @ queries[query]
        return _sorted(scores, ids, k)

    def _checked(self, queries: NDArray[np.float32]) -> Array:
        if queries.ndim != 2 or queries.shape[1] != self.trained.dims:
            raise ValueError(f"queries must be (Q, {self.trained.dims}), got {queries.shape}")
        return np.ascontiguousarray(queries, dtype=np.float32)


def _best(scores: Array, ids: Ids, count: int) -> tuple[Array, Ids]:
    """The `count` highest of each row, in no order."""
    if scores.shape[1] <= count:
        return scores, ids
    chosen = np.argpartition(scores, -count, axis=1)[:, -count:]
    return np.take_along_axis(scores, chosen, axis=1), np.take_along_axis(ids, chosen, axis=1)


def _sorted(scores: Array, ids: Ids, k: int) -> tuple[Array, Ids]:
    """The k highest of each row, best first; of equal ones the lower id first."""
    out_scores = np.full((len(scores), k), -np.inf, dtype=np.float32)
    out_ids = np.full((len(scores), k), NONE, dtype=np.int64)
    for query, (row, some) in enumerate(zip(scores, ids, strict=True)):
        order = np.lexsort((some, -row))[:k]
        out_scores[query, : len(order)], out_ids[query, : len(order)] = row[order], some[order]
    out_ids[np.isneginf(out_scores)] = NONE
    return out_scores, out_ids
