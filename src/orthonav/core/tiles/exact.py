"""Exact search: the scalar product with every stored embedding; the oracle for any other index."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

BLOCK_ROWS = 1024
"""Decoded at once: half a megabyte at 128 numbers, which stays in the cache."""
CACHE_BYTES = 128 * 2**20
"""Decoded embeddings kept: 260,000 tiles of 128 numbers."""
_CONVERT_FP16 = getattr(cv2, "convertFp16", None)  # OpenCV 4, where cv2.add knows no float16
_ZERO = np.zeros(1, dtype=np.float16)


class ExactIndex:
    """Scalar products with stored embeddings (N, D) float16.

    Up to `cache_bytes` are kept decoded to float32; larger maps are decoded at every search."""

    def __init__(self, embeddings: NDArray[np.float16], cache_bytes: int = CACHE_BYTES) -> None:
        if embeddings.ndim != 2 or embeddings.dtype != np.float16:
            raise ValueError(
                f"embeddings must be (N, D) float16, got {embeddings.shape} {embeddings.dtype}"
            )
        self._stored = embeddings
        self._may_cache = embeddings.size * 4 <= cache_bytes
        self._decoded: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self._stored)

    def scores(
        self, queries: NDArray[np.float32], rows: NDArray[np.intp] | None = None
    ) -> NDArray[np.float32]:
        """(N, Q) of queries (Q, D), with `rows` or all."""
        columns = np.ascontiguousarray(queries.T, dtype=np.float32)
        out = np.empty((self._count(rows), columns.shape[1]), dtype=np.float32)
        for part, block in self._blocks(rows):
            np.matmul(block, columns, out=out[part])
        return out

    def best(
        self, queries: NDArray[np.float32], rows: NDArray[np.intp] | None = None
    ) -> NDArray[np.float32]:
        """Highest (N,) of any query (Q, D), without memory of N times Q. Raises `ValueError` for
        none."""
        if len(queries) == 0:
            raise ValueError("at least one query is needed, got none")
        columns = np.ascontiguousarray(queries.T, dtype=np.float32)
        count = self._count(rows)
        out = np.empty(count, dtype=np.float32)
        scores = np.empty((min(count, BLOCK_ROWS), columns.shape[1]), dtype=np.float32)
        for part, block in self._blocks(rows):
            some = np.matmul(block, columns, out=scores[: len(block)])
            some.max(axis=1, out=out[part])
        return out

    def _count(self, rows: NDArray[np.intp] | None) -> int:
        return len(self._stored) if rows is None else len(rows)

    def _blocks(self, rows: NDArray[np.intp] | None) -> Iterator[tuple[slice, NDArray[np.float32]]]:
        if self._may_cache and self._decoded is None:
            self._decoded = self._stored.astype(np.float32)
        source = self._stored if self._decoded is None else self._decoded
        # In blocks also where nothing is decoded: BLAS then takes a few queries twice as fast.
        for start in range(0, self._count(rows), BLOCK_ROWS):
            part = slice(start, start + BLOCK_ROWS)
            yield part, _float32(source[part] if rows is None else source[rows[part]])


def _float32(block: NDArray[np.float16] | NDArray[np.float32]) -> NDArray[np.float32]:
    """OpenCV's conversions are several times as fast as NumPy's."""
    if block.dtype == np.float32:
        return np.asarray(block, dtype=np.float32)
    halves = np.ascontiguousarray(block, dtype=np.float16)
    if _CONVERT_FP16 is not None:
        return np.asarray(_CONVERT_FP16(halves.view(np.int16))).reshape(halves.shape)
    decoded = cv2.add(halves, _ZERO, dtype=cv2.CV_32F)
    return np.asarray(decoded, dtype=np.float32).reshape(halves.shape)


def rows_within(
    centres_en_m: NDArray[np.float32], centre_en_m: NDArray[np.float64], radius_m: float
) -> NDArray[np.intp]:
    offset = centres_en_m - np.asarray(centre_en_m, dtype=np.float32)
    return np.flatnonzero(np.einsum("ij,ij->i", offset, offset) <= radius_m**2)
