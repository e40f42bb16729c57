"""Search in all shards of the vector index."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthonav.atlas.index_manifest import ShardInfo
from orthonav.atlas.index_shards import NONE, Ids, OpenShard
from orthonav.atlas.quantizers import QUANTIZERS_NAME, Array, Quantizers, one_thread


class ShardedIndex:
    """The shards of an index, mapped and searched on one core.

    The id of a vector is the base of its shard plus its row. Not for several threads at once.
    """

    def __init__(self, folder: Path, shards: Sequence[ShardInfo]) -> None:
        """Open shards and quantizers; raises `AtlasError` where a file is damaged."""
        self.quantizers = Quantizers.load(folder / QUANTIZERS_NAME)
        self._shards = [OpenShard(folder, each, self.quantizers) for each in shards]

    def __len__(self) -> int:
        return sum(each.info.rows for each in self._shards)

    def search(
        self, queries: NDArray[np.float32], k: int, probes: int, rerank: int
    ) -> tuple[Array, Ids]:
        """Highest scalar products (Q, k) and ids (Q, k) of queries (Q, D), best first.

        `probes` lists of every shard are scanned. The `rerank` best by code, over all shards, are
        compared by their stored vectors. Where fewer are found: id -1 and product -inf.
        """
        dims = self.quantizers.recipe.dims
        if queries.ndim != 2 or queries.shape[1] != dims:
            raise ValueError(f"queries must be (Q, {dims}), got {queries.shape}")
        queries = np.ascontiguousarray(queries, dtype=np.float32)
        rotated = self.quantizers.rotated(queries)
        lists, centre_scores = self.quantizers.nearest_lists(rotated, probes)
        rerank = max(k, rerank)
        scores = np.full((len(queries), 0), -np.inf, dtype=np.float32)
        ids: Ids = np.empty((len(queries), 0), dtype=np.int64)
        with one_thread():
            for shard in self._shards:
                found, rows = shard.scan(rotated, lists, centre_scores, rerank)
                some = np.where(rows == NONE, NONE, rows + shard.info.base)
                scores, ids = _highest(
                    np.concatenate([scores, found], axis=1),
                    np.concatenate([ids, some], axis=1),
                    rerank,
                )
        return self._compared(queries, ids, k)

    def vectors(self, ids: Ids) -> Array:
        """Stored vectors (N, D) of ids (N,); zeros for ids that are in no shard."""
        out = np.zeros((len(ids), self.quantizers.recipe.dims), dtype=np.float32)
        for shard in self._shards:
            rows = ids - shard.info.base
            ours = np.flatnonzero((rows >= 0) & (rows < shard.info.rows))
            if len(ours):
                ours = ours[np.argsort(rows[ours], kind="stable")]
                out[ours] = shard.vectors(rows[ours])
        return out

    def place_deg(self, number: int) -> tuple[float, float] | None:
        """Latitude and longitude of an id; None where it is in no shard."""
        for shard in self._shards:
            if shard.info.base <= number < shard.info.base + shard.info.rows:
                lat, lon = shard.places_deg[number - shard.info.base].tolist()
                return lat, lon
        return None

    def _compared(self, queries: Array, ids: Ids, k: int) -> tuple[Array, Ids]:
        """The k best of the candidates (Q, R) by their stored vectors; of equal ones the lower id
        first."""
        out_scores = np.full((len(queries), k), -np.inf, dtype=np.float32)
        out_ids = np.full((len(queries), k), NONE, dtype=np.int64)
        for query, candidates in enumerate(ids):
            real = candidates[candidates != NONE]
            scores = self.vectors(real) @ queries[query]
            order = np.lexsort((real, -scores))[:k]
            out_scores[query, : len(order)] = scores[order]
            out_ids[query, : len(order)] = real[order]
        return out_scores, out_ids


def _highest(scores: Array, ids: Ids, count: int) -> tuple[Array, Ids]:
    """The `count` highest of each row, in no order."""
    if scores.shape[1] <= count:
        return scores, ids
    chosen = np.argpartition(scores, -count, axis=1)[:, -count:]
    return np.take_along_axis(scores, chosen, axis=1), np.take_along_axis(ids, chosen, axis=1)
