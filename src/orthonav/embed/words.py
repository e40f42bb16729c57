"""Bag of visual words (Sivic and Zisserman, ICCV 2003): how often which local features occur.

Di Piazza et al. 2024, section 2: features of all reference pictures are grouped into k clusters,
the words; a picture is the vector of how many of its features fall to each word, and two pictures
are as alike as the scalar product of their vectors says. Features are SIFT (Lowe, IJCV 2004) or
SuperPoint (DeTone et al. 2018). Words are meant for grey levels, as in the paper.

SIFT descriptors and words are whole numbers of at most 255, and so are, below 2^24, all sums that
decide on the nearest word: float32 gives them exactly, on every machine and in any order. With
SuperPoint, which needs PyTorch, this does not fly.
"""

import importlib
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.errors import VariantError
from orthonav.extras import needed

CHUNK_FEATURES = 4096
SAMPLES_PER_WORD = 40
MIN_SAMPLES = 100_000
ITERATIONS = 20
DIMS = {"sift": 128, "superpoint": 256}

Grey = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Array = NDArray[np.float32]


@dataclass(frozen=True)
class WordsRecipe:
    """Parameters of a bag of visual words.

    `words`: clusters k; the paper tries 256 to 10000. `features`: "sift" or "superpoint", the
    latter with the path of its `weights`. `max_features`: at most so many of a picture, the
    strongest. `similarity`: "product" compares frequencies (sum 1) as the paper does, "cosine"
    vectors of unit length. `tfidf`: 1 weighs each word by how rare it is among the pictures.
    """

    words: int = 1024
    features: str = "sift"
    weights: str = ""
    max_features: int = 2000
    similarity: str = "product"
    tfidf: int = 0

    def __post_init__(self) -> None:
        if not 256 <= self.words <= 10_000:
            raise VariantError(f"words must be 256 to 10000, got {self.words}")
        if self.features not in DIMS:
            raise VariantError(f"features must be sift or superpoint, got '{self.features}'")
        if bool(self.weights) != (self.features == "superpoint"):
            raise VariantError(
                "weights=PATH is for superpoint and needed there, got "
                f"features={self.features}, weights='{self.weights}'"
            )
        if not 1 <= self.max_features <= 100_000:
            raise VariantError(f"max_features must be 1 to 100000, got {self.max_features}")
        if self.similarity not in ("product", "cosine"):
            raise VariantError(f"similarity must be product or cosine, got '{self.similarity}'")
        if self.tfidf not in (0, 1):
            raise VariantError(f"tfidf must be 0 or 1, got {self.tfidf}")


@dataclass(frozen=True, eq=False)
class WordsEmbedder:
    """A learnt vocabulary.

    `vocabulary` (k, D) as stored in the map: uint8 for SIFT (D = 128), float16 for SuperPoint
    (D = 256). `idf` (k,) float32, weights of rare words; empty without `tfidf`.
    """

    recipe: WordsRecipe
    vocabulary: NDArray[Any]
    idf: Array

    def __post_init__(self) -> None:
        recipe = self.recipe
        shape = recipe.words, DIMS[recipe.features]
        dtype = np.uint8 if recipe.features == "sift" else np.float16
        if self.vocabulary.shape != shape or self.vocabulary.dtype != dtype:
            raise VariantError(
                f"expected a vocabulary {shape} {np.dtype(dtype)}, "
                f"got {self.vocabulary.shape} {self.vocabulary.dtype}"
            )
        if self.idf.shape != ((recipe.words,) if recipe.tfidf else (0,)):
            raise VariantError(f"idf does not fit tfidf={recipe.tfidf}, got {self.idf.shape}")
        if not (np.isfinite(self.vocabulary).all() and np.isfinite(self.idf).all()):
            raise VariantError("vocabulary or idf is not finite")

    @property
    def dims(self) -> int:
        """Numbers per embedding, k."""
        return self.recipe.words

    @cached_property
    def _words(self) -> Array:
        return np.ascontiguousarray(self.vocabulary.T, dtype=np.float32)

    @cached_property
    def _half_power(self) -> Array:
        return np.asarray(np.square(self._words).sum(axis=0) / 2, dtype=np.float32)

    def view(self, maps: Array, valid: Mask) -> Array:
        """Frequencies of words (k,) in a view's grey levels (1, S, S), as `similarity` says.

        Grey levels are 0..1 as `orthonav.represent.gray` gives them, or 0..255 if one is above 1.
        A view without features gives zeros. Raises `ValueError` if there is not one channel.
        """
        return self._weighted(self.counts(_levels(maps), valid))

    def views(self, maps: Array, valid: Mask | None = None) -> Array:
        """Frequencies (N, k) of views (N, 1, S, S), everywhere valid or where (N, S, S) says."""
        if valid is None:
            valid = np.ones((len(maps), *maps.shape[2:]), dtype=bool)
        out = np.empty((len(maps), self.dims), dtype=np.float32)
        for index, (one, seen) in enumerate(zip(maps, valid, strict=True)):
            out[index] = self.view(one, seen)
        return out

    def counts(self, grey: Grey, valid: Mask) -> NDArray[np.int64]:
        """How many features of a picture (H, W) fall to each word (k,)."""
        found = self.assigned(describe(self.recipe, grey, valid))
        return np.bincount(found, minlength=self.dims)

    def assigned(self, descriptors: Array) -> NDArray[np.intp]:
        """Nearest words (N,) of descriptors (N, D); the first of equally near ones."""
        out = np.empty(len(descriptors), dtype=np.intp)
        for start in range(0, len(descriptors), CHUNK_FEATURES):
            part = slice(start, start + CHUNK_FEATURES)
            nearness = descriptors[part].astype(np.float32, copy=False) @ self._words
            nearness -= self._half_power
            out[part] = nearness.argmax(axis=1)
        return out

    def _weighted(self, counts: NDArray[np.int64]) -> Array:
        vector = counts / max(1, counts.sum())
        if self.recipe.tfidf:
            vector = vector * self.idf
        if self.recipe.similarity == "cosine":
            vector = vector / max(float(np.linalg.norm(vector)), 1e-12)
        return np.asarray(vector, dtype=np.float32)

    def parts(self) -> dict[str, NDArray[Any]]:
        """Arrays to be stored in the map."""
        return {"vocabulary": self.vocabulary, "idf": self.idf}


def _levels(maps: Array) -> Grey:
    """Grey levels (S, S) uint8 of a representation (1, S, S) of 0..1 or 0..255."""
    if maps.ndim != 3 or len(maps) != 1:
        raise ValueError(f"words are of grey levels, one channel (1, S, S); got {maps.shape}")
    factor = 255 if maps.max(initial=0) <= 1 else 1
    return np.asarray(np.rint(maps[0] * factor).clip(0, 255), dtype=np.uint8)


def describe(recipe: WordsRecipe, grey: Grey, valid: Mask) -> Array:
    """Descriptors (N, D) of the features of a picture (H, W) that see valid pixels only.

    A SIFT feature is left out if a pixel within its radius is not valid, a SuperPoint if its own
    pixel or one of its cell's neighbourhood (8 px) is not.
    """
    if not valid.any():
        return np.zeros((0, DIMS[recipe.features]), dtype=np.float32)
    if not valid.all():
        grey = np.where(valid, grey, np.uint8(round(float(grey[valid].mean()))))
    found = _sift if recipe.features == "sift" else _superpoint
    points, radii, descriptors = found(recipe, np.ascontiguousarray(grey))
    if len(points) and not valid.all():
        free = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        height, width = valid.shape
        columns, rows = np.floor(points).astype(int).T
        descriptors = descriptors[
            free.reshape(height, width)[rows.clip(0, height - 1), columns.clip(0, width - 1)]
            > radii
        ]
    return descriptors


def _sift(recipe: WordsRecipe, grey: Grey) -> tuple[Array, Array, Array]:
    """Points (N, 2) from the outer corner, radii (N,) and descriptors (N, 128), whole numbers."""
    sift = cv2.SIFT.create(nfeatures=recipe.max_features)
    found, descriptors = sift.detectAndCompute(grey, None)
    if not len(found):
        nothing = np.zeros((0, 2), dtype=np.float32)
        return nothing, nothing[:, 0], np.zeros((0, DIMS["sift"]), dtype=np.float32)
    points = np.array([point.pt for point in found], dtype=np.float32) + np.float32(0.5)
    radii = np.array([point.size / 2 for point in found], dtype=np.float32)
    kept = slice(recipe.max_features)  # equally strong ones may be more than asked for
    return points[kept], radii[kept], np.asarray(descriptors, dtype=np.float32)[kept]


def _superpoint(recipe: WordsRecipe, grey: Grey) -> tuple[Array, Array, Array]:
    """Points (N, 2) from the outer corner, radii (N,) and unit descriptors (N, 256)."""
    # By name: what flies must not depend on PyTorch.
    library: Any = importlib.import_module("orthonav.neural.superpoint")
    network = library.SuperPoint(recipe.weights, max_points=recipe.max_features)
    points, descriptors = network.describe(grey)
    return points, np.full(len(points), 8, dtype=np.float32), descriptors


class _Sample:
    """A random sample of all rows that are put in, without knowing how many will come."""

    def __init__(self, size: int, seed: int) -> None:
        self.size = size
        self._random = np.random.default_rng(seed)
        self._rows: list[NDArray[Any]] = []
        self._tickets: list[NDArray[np.float64]] = []
        self._count = 0

    def put(self, rows: NDArray[Any]) -> None:
        """Take in rows (N, ..)."""
        self._rows.append(rows)
        self._tickets.append(self._random.random(len(rows)))
        self._count += len(rows)
        if self._count >= 2 * self.size:
            self._draw()

    def rows(self) -> NDArray[Any]:
        """The sample, in the order in which its rows came."""
        self._draw()
        return self._rows[0]

    def _draw(self) -> None:
        """Keep the rows with the lowest tickets."""
        rows, tickets = np.concatenate(self._rows), np.concatenate(self._tickets)
        if len(rows) > self.size:
            kept = np.sort(np.argsort(tickets, kind="stable")[: self.size])
            rows, tickets = rows[kept], tickets[kept]
        self._rows, self._tickets, self._count = [rows], [tickets], len(rows)


def learn_words(
    recipe: WordsRecipe,
    pictures: Iterable[tuple[Grey, Mask]],
    seed: int = 0,
    report: Callable[[float], None] = lambda share: None,
) -> WordsEmbedder:
    """Learn the words from pictures (S, S) uint8, each with its valid pixels (S, S).

    k-means of at most 40 descriptors per word, and at least 100000, drawn evenly from all; the
    same seed gives the same words. With `tfidf`, a word found in n of N pictures weighs
    log((N + 1) / n), counted on the descriptors drawn. `report` is told the share of k-means done.
    Raises `VariantError` if there are fewer descriptors than words, `MissingExtraError` without
    faiss.
    """
    faiss = _faiss()
    sample = _Sample(max(MIN_SAMPLES, SAMPLES_PER_WORD * recipe.words), seed)
    owners = _Sample(sample.size, seed)  # draws the same tickets: the picture of each row
    stored = np.uint8 if recipe.features == "sift" else np.float16
    count = 0
    for grey, valid in pictures:
        rows = describe(recipe, grey, valid).astype(stored)
        sample.put(rows)
        owners.put(np.full(len(rows), count, dtype=np.int64))
        count += 1
    drawn = sample.rows() if count else np.zeros((0, DIMS[recipe.features]), stored)
    if len(drawn) < recipe.words:
        raise VariantError(
            f"{recipe.words} words cannot be learnt from {len(drawn)} features in {count} "
            "pictures; take fewer words or more imagery"
        )
    centres = _clustered(faiss, drawn.astype(np.float32), recipe.words, seed, report)
    vocabulary = np.rint(centres).clip(0, 255) if recipe.features == "sift" else centres
    plain = replace(recipe, tfidf=0)
    nothing = np.zeros(0, dtype=np.float32)
    embedder = WordsEmbedder(plain, vocabulary.astype(stored), nothing)
    if not recipe.tfidf:
        return embedder
    pairs = np.unique(np.stack([embedder.assigned(drawn), owners.rows()]), axis=1)
    pictures_with = np.bincount(pairs[0], minlength=recipe.words)
    idf = np.log((count + 1) / np.maximum(1, pictures_with)).astype(np.float32)
    return WordsEmbedder(recipe, embedder.vocabulary, idf)


def _clustered(
    faiss: Any, drawn: Array, words: int, seed: int, report: Callable[[float], None]
) -> Array:
    """Centres (words, D) of k-means, one iteration of faiss at a time to be able to report."""
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
        report((done + 1) / ITERATIONS)
    assert centres is not None
    return centres


def _faiss() -> Any:
    with warnings.catch_warnings():
        # SWIG's types, at import, in some versions
        warnings.filterwarnings("ignore", "builtin type .* has no __module__", DeprecationWarning)
        return needed("faiss", "train", "learning visual words")


def pictures_of(greys: Iterable[Grey]) -> Iterator[tuple[Grey, Mask]]:
    """Pictures (H, W) that are valid everywhere, as `learn_words` takes them."""
    for grey in greys:
        yield grey, np.ones(grey.shape, dtype=bool)
