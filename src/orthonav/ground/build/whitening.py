"""Learning the whitened embedding of a reference area: mean and principal components."""

from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from orthonav.core.cores import in_order
from orthonav.core.tiles.whitened import (
    CellSheet,
    Made,
    WhitenedEmbedder,
    WhitenedRecipe,
    chunks,
    pooled_features,
)

MAX_LEARNT_TILES = 20_000  # 44 for each of 448 features
Features = NDArray[np.float32]
Work = Callable[[Features, Features], Made]


def learn(
    recipe: WhitenedRecipe, sheet: CellSheet, tiles_px: NDArray[np.intp], workers: int = 1
) -> WhitenedEmbedder:
    """From at most `MAX_LEARNT_TILES` tiles, by any number of threads; fewer than `dims` components
    where the tiles do not span more."""
    taken = tiles_px[:: max(1, -(-len(tiles_px) // MAX_LEARNT_TILES))]

    def over_batches(work: Work[Made]) -> Iterator[Made]:
        def worked(part: slice) -> Made:
            return work(*pooled_features(recipe, sheet, taken[part]))

        return in_order(worked, chunks(len(taken)), workers)

    return learn_in_two_passes(recipe, over_batches)


class OverBatches(Protocol):
    """Runs a function on features and weights (N, F) of every batch, in order."""

    def __call__(self, work: "Work[Made]") -> Iterator[Made]:
        pass


def learn_in_two_passes(recipe: WhitenedRecipe, over_batches: OverBatches) -> WhitenedEmbedder:
    """One pass for the mean, one for scatter."""

    def sums(features: Features, weights: Features) -> tuple[Any, Any]:
        total = np.einsum("nf,nf->f", features, weights, dtype=np.float64)
        return total, weights.sum(axis=0, dtype=np.float64)

    total: Any = 0.0
    weight: Any = 1e-9
    for some, their_weight in over_batches(sums):
        total, weight = total + some, weight + their_weight
    mean = (total / weight).astype(np.float16)

    def products(features: Features, weights: Features) -> tuple[Any, int]:
        centred = (features - mean.astype(np.float32)) * weights
        return (centred.T @ centred).astype(np.float64), len(features)

    scatter: Any = 0.0
    count = 0
    for product, size in over_batches(products):
        scatter, count = scatter + product, count + size
    return _whitening(recipe, mean, scatter, count)


def _whitening(
    recipe: WhitenedRecipe, mean: NDArray[np.float16], scatter: NDArray[np.float64], count: int
) -> WhitenedEmbedder:
    """Of `count` features with mean (F,) and scatter matrix (F, F)."""
    variances, vectors = np.linalg.eigh(scatter / count)
    variances, vectors = variances[::-1], vectors[:, ::-1]
    kept = int(np.count_nonzero(variances[: recipe.dims] > 1e-6 * max(variances[0], 1e-12)))
    kept = max(1, min(kept, count))
    scale = 1 / np.sqrt(np.maximum(variances[:kept], 1e-12))
    basis = vectors[:, :kept] * (scale / scale.max())
    # The sign of an eigenvector is arbitrary: the largest entry is made positive.
    largest = np.abs(basis).argmax(axis=0)
    basis *= np.sign(basis[largest, np.arange(kept)])
    return WhitenedEmbedder(recipe, mean, basis.astype(np.float16))
