"""Learns a bag of visual words: k-means of the features of reference pictures.

"The BoVW method gathers features from all the images and group them into k clusters" (Di Piazza et
al. 2024, section Related work, Bag of Visual Words); k-means, of a sample, is our choice. Needs
faiss, and PyTorch for SuperPoint. The embedder that flies is `orthonav.core.tiles.words`.
"""

import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import VariantError
from orthonav.core.extras import needed
from orthonav.core.tiles.represent import Grey, Mask, filled
from orthonav.core.tiles.words import (
    DIMS,
    Array,
    Detector,
    WordsEmbedder,
    WordsRecipe,
    describe,
    seen,
    sift_features,
)

SAMPLES_PER_WORD = 40
"""Descriptors per word: faiss warns below 39, as fewer make empty clusters."""
MIN_SAMPLES = 100_000
"""Descriptors that are clustered at least, if the pictures have that many."""
BLOCK_PX, AROUND_PX = 1024, 256
"""Side of the blocks in which features of a sheet are found, and what is seen around them."""
ITERATIONS = 20
"""Iterations of k-means; faiss's own default is 25."""


class _Sample:
    """Uniform random sample of the descriptors of a stream of pictures (reservoir sampling)."""

    def __init__(self, size: int, seed: int) -> None:
        self.size, self._random = size, np.random.default_rng(seed)
        self._parts: list[tuple[NDArray[Any], ...]] = []
        self._count = 0

    def put(self, rows: NDArray[Any], picture: int) -> None:
        tickets = self._random.random(len(rows))
        self._parts.append((tickets, rows, np.full(len(rows), picture)))
        self._count += len(rows)
        if self._count >= 2 * self.size:
            self._draw()

    def drawn(self) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Rows (N, D), and the pictures (N,) to which they belong."""
        self._draw()
        _, rows, pictures = self._parts[0]
        return rows, pictures

    def _draw(self) -> None:
        """Leave the rows with the lowest tickets."""
        joined = tuple(np.concatenate(each) for each in zip(*self._parts, strict=True))
        lowest = np.sort(np.argsort(joined[0], kind="stable")[: self.size])
        self._parts = [tuple(each[lowest] for each in joined)]
        self._count = len(lowest)


def learn_words(
    recipe: WordsRecipe,
    pictures: Iterable[tuple[Grey, Mask]],
    seed: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> WordsEmbedder:
    """Embedder learned from pictures (S, S) uint8, each with its valid pixels (S, S).

    k-means of at most 40 descriptors per word, and at least 100000, drawn evenly from all; the
    same seed gives the same words. With `tfidf`, a word found in n of N pictures weighs
    log((N + 1) / n), counted on the descriptors drawn. `progress` is called with the fraction of
    k-means done. Raises `VariantError` if there are fewer descriptors than words,
    `MissingExtraError` without faiss.
    """
    faiss = _faiss()
    detector: Detector | None = None  # SIFT is built in
    if recipe.features != "sift":
        from orthonav.research.superpoint import SuperPoint  # only here is PyTorch needed

        detector = SuperPoint(recipe.weights, max_points=recipe.max_features)
    stored = np.uint8 if recipe.features == "sift" else np.float16
    sample, count = _Sample(max(MIN_SAMPLES, SAMPLES_PER_WORD * recipe.words), seed), 0
    sample.put(np.zeros((0, DIMS[recipe.features]), stored), count)
    for grey, valid in pictures:
        sample.put(describe(recipe, grey, valid, detector).astype(stored), count)
        count += 1
    drawn, pictures_of = sample.drawn()
    if len(drawn) < recipe.words:
        raise VariantError(
            f"{recipe.words} words cannot be learned from {len(drawn)} features in {count} "
            "pictures; use fewer words or more imagery"
        )
    centres = _clustered(faiss, drawn.astype(np.float32), recipe.words, seed, progress)
    vocabulary = np.rint(centres).clip(0, 255) if recipe.features == "sift" else centres
    plain = replace(recipe, tfidf=0)
    nothing = np.zeros(0, dtype=np.float32)
    embedder = WordsEmbedder(plain, vocabulary.astype(stored), nothing, detector)
    if not recipe.tfidf:
        return embedder
    pairs = np.unique(np.stack([embedder.assigned(drawn), pictures_of]), axis=1)
    pictures_with = np.bincount(pairs[0], minlength=recipe.words)
    idf = np.log((count + 1) / np.maximum(1, pictures_with)).astype(np.float32)
    return WordsEmbedder(recipe, embedder.vocabulary, idf, detector)


@dataclass(frozen=True, eq=False)
class SheetWords:
    """SIFT features of a sheet picture and their words, found once for all tiles.

    With tiles that overlap by 87.5 %, finding the features of each would take 64 times as long. A
    tile has the features farther from its edge than OpenCV's border, which SIFT could find in it
    alone; their descriptors see what is beyond the edge, and the strongest are chosen among those
    that see valid pixels only.

    - `points` (N, 2): column and row, by rows. `margins` (N,): OpenCV's border, px.
    - `strengths` (N,), `words` (N,): responses and nearest words of the features.
    """

    embedder: WordsEmbedder
    points: Array
    margins: Array
    strengths: Array
    words: NDArray[np.intp]

    @classmethod
    def find(
        cls, embedder: WordsEmbedder, grey: Grey, valid: Mask, progress: Callable[[float], None]
    ) -> "SheetWords":
        """`grey` (H, W) uint8 and `valid` (H, W): arrays or memory maps."""
        blocks, nothing = _blocks(*grey.shape), np.zeros(0, np.float32)
        parts = [(np.zeros((0, 2), np.float32), nothing, nothing, np.zeros(0, np.intp))]
        for done, (block, window) in enumerate(blocks):
            if valid[block].any():
                parts.append(_found(embedder, block, window, grey[window], valid[window]))
            progress((done + 1) / len(blocks))
        points, margins, strengths, words = (
            np.concatenate(each) for each in zip(*parts, strict=True)
        )
        order = np.argsort(points[:, 1], kind="stable")
        return cls(embedder, points[order], margins[order], strengths[order], words[order])

    def views(self, tiles_px: NDArray[np.integer[Any]], tile_px: int) -> Array:
        """Embeddings (N, k) of tiles whose first pixels are `tiles_px` (N, 2), row and column."""
        made = [self.embedder.weighted(self._counts(at[::-1], tile_px)) for at in tiles_px]
        return np.stack(made)

    def _counts(self, corner: NDArray[np.integer[Any]], tile_px: int) -> NDArray[np.int64]:
        """Features by words (k,) of the tile whose first column and row are `corner` (2,)."""
        # Limits of the type of the points: else all points are converted for every tile.
        rows = np.array([corner[1], corner[1] + tile_px], np.float32)
        first, last = np.searchsorted(self.points[:, 1], rows)
        points = self.points[first:last] - corner
        to_edge = np.minimum(points, tile_px - points).min(axis=1)
        inside = first + np.flatnonzero(to_edge >= self.margins[first:last])
        most = self.embedder.recipe.max_features
        if len(inside) > most:
            inside = inside[np.argpartition(-self.strengths[inside], most)[:most]]
        return np.bincount(self.words[inside], minlength=self.embedder.dims)


Part = tuple[slice, slice]


def _found(
    embedder: WordsEmbedder, block: Part, window: Part, grey: Grey, valid: Mask
) -> tuple[Array, Array, Array, NDArray[np.intp]]:
    """Points (N, 2), margins, strengths and words (N,) in a block, found in the window around."""
    found = sift_features(filled(grey, valid))
    here = found.points
    points = here + np.array([window[1].start, window[0].start], np.float32)
    low, high = ([getattr(part, end) for part in block[::-1]] for end in ("start", "stop"))
    kept = seen(valid, here, found.radii)
    kept &= ((points >= low) & (points < high)).all(axis=1)
    words = embedder.assigned(found.descriptors[kept])
    return points[kept], found.margins[kept], found.strengths[kept], words


def _blocks(height: int, width: int) -> list[tuple[Part, Part]]:
    """Blocks of a picture, and each with the pixels around it that its features see."""
    made = []
    for row in range(0, height, BLOCK_PX):
        for col in range(0, width, BLOCK_PX):
            block = slice(row, min(row + BLOCK_PX, height)), slice(col, min(col + BLOCK_PX, width))
            window = tuple(
                slice(max(0, each.start - AROUND_PX), each.stop + AROUND_PX) for each in block
            )
            made.append((block, (window[0], window[1])))
    return made


def _clustered(
    faiss: Any, drawn: Array, words: int, seed: int, progress: Callable[[float], None]
) -> Array:
    """Centres (words, D) of k-means, one iteration of faiss at a time to show progress."""
    centres: Array | None = None
    for done in range(ITERATIONS):
        kmeans = faiss.Kmeans(
            drawn.shape[1],
            words,
            niter=1,
            seed=seed,
            min_points_per_centroid=1,
            max_points_per_centroid=-(-len(drawn) // words),
        )
        kmeans.train(drawn, init_centroids=centres)
        centres = np.asarray(kmeans.centroids, dtype=np.float32)
        progress((done + 1) / ITERATIONS)
    assert centres is not None
    return centres


def _faiss() -> Any:
    with warnings.catch_warnings():
        # SWIG's types, at import, in some versions
        warnings.filterwarnings("ignore", "builtin type .* has no __module__", DeprecationWarning)
        return needed("faiss", "train", "learning visual words")
