"""Bag of visual words (Sivic and Zisserman, ICCV 2003): how often which local features occur.

"A frequency vector that records how many features [...] fall into each cluster" (Di Piazza et al.
2024, section Related work, Bag of Visual Words), here divided by the number of features. As in
section Methodology, features are those of grey levels, by SIFT (Lowe, IJCV 2004) or SuperPoint
(DeTone et al. 2018), which needs PyTorch and does not fly. `orthonav.research.words` learns them.

SIFT descriptors and words are whole numbers, and sums below 2^24 that decide on the nearest word
are exact in float32, on every machine and in any order."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MapFileError, VariantError
from orthonav.core.tiles.represent import Grey, Mask, filled
from orthonav.core.variants import Checked, Part, choice, within

DIMS = {"sift": 128, "superpoint": 256}  # numbers per descriptor

Array = NDArray[np.float32]
Detector = Callable[[Grey], tuple[Array, Array, Array]]
"""Points (N, 2) from the outer corner, radii (N,) and descriptors (N, D) of a picture."""


@dataclass(frozen=True)
class WordsRecipe(Checked):
    """Parameters of a bag of visual words.

    `words`: clusters k; the paper tries 256 to 10000. `max_features`: the strongest of a picture.
    `similarity`: "product" compares frequencies (the paper), "cosine" unit vectors. `tfidf`: 1
    weighs words by how rare they are."""

    words: int = within(1024, 256, 10_000)
    features: str = choice("sift", "superpoint")
    weights: str = ""
    max_features: int = within(2000, 1, 100_000)
    similarity: str = choice("product", "cosine")
    tfidf: int = choice(0, 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if bool(self.weights) != (self.features == "superpoint"):
            raise VariantError(
                "weights=PATH is for superpoint and needed there, got "
                f"features={self.features}, weights='{self.weights}'"
            )

    def embedder(self, part: Part, _: int) -> "WordsEmbedder":
        """From a map."""
        if self.features != "sift":
            # Its recipe names a file of weights; a map must not choose which files are read.
            raise MapFileError(f"words of {self.features} do not fly")
        try:
            return WordsEmbedder(self, part("vocabulary", np.uint8, 2), part("idf", np.float32, 1))
        except VariantError as error:
            raise MapFileError(f"map's words do not fit: {error}") from error


@dataclass(frozen=True, eq=False)
class WordsEmbedder:
    """`vocabulary` (k, D): uint8 for SIFT (128), float16 for SuperPoint (256).

    `idf` (k,) float32, empty without `tfidf`. `detector`: None for SIFT."""

    recipe: WordsRecipe
    vocabulary: NDArray[Any]
    idf: Array
    detector: Detector | None = None

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
        return self.recipe.words

    @cached_property
    def _words(self) -> Array:
        return np.ascontiguousarray(self.vocabulary.T, dtype=np.float32)

    @cached_property
    def _half_power(self) -> Array:
        return np.asarray(np.square(self._words).sum(axis=0) / 2, dtype=np.float32)

    def view(self, maps: Array, valid: Mask) -> Array:
        """(k,) of grey levels (1, S, S), 0..1 as of `represent.Gray`, or 0..255 if one is above 1.

        Zeros without features. Raises `ValueError` unless there is one channel."""
        return self.weighted(self.counts(_levels(maps), valid))

    def views(self, maps: Array, valid: Mask | None = None) -> Array:
        """Of (N, 1, S, S), everywhere valid or where (N, S, S) says."""
        if valid is None:
            valid = np.ones((len(maps), *maps.shape[2:]), dtype=bool)
        out = np.empty((len(maps), self.dims), dtype=np.float32)
        for index, (one, seen) in enumerate(zip(maps, valid, strict=True)):
            out[index] = self.view(one, seen)
        return out

    def counts(self, grey: Grey, valid: Mask) -> NDArray[np.int64]:
        """Of features of a picture (H, W) by words (k,)."""
        found = self.assigned(describe(self.recipe, grey, valid, self.detector))
        return np.bincount(found, minlength=self.dims)

    def assigned(self, descriptors: Array) -> NDArray[np.intp]:
        """Nearest words (N,) of descriptors (N, D); the first of equally near ones."""
        out = np.empty(len(descriptors), dtype=np.intp)
        for start in range(0, len(descriptors), 4096):  # 16 MB for 1,024 words
            part = slice(start, start + 4096)
            nearness = descriptors[part].astype(np.float32, copy=False) @ self._words
            nearness -= self._half_power
            out[part] = nearness.argmax(axis=1)
        return out

    def weighted(self, counts: NDArray[np.int64]) -> Array:
        """The embedding (k,) of a picture with so many features of each word (k,)."""
        vector = counts / max(1, counts.sum())
        if self.recipe.tfidf:
            vector = vector * self.idf
        if self.recipe.similarity == "cosine":
            vector = vector / max(float(np.linalg.norm(vector)), 1e-12)
        return np.asarray(vector, dtype=np.float32)

    def parts(self) -> dict[str, NDArray[Any]]:
        return {"vocabulary": self.vocabulary, "idf": self.idf}


def _levels(maps: Array) -> Grey:
    if maps.ndim != 3 or len(maps) != 1:
        raise ValueError(f"words are of grey levels, one channel (1, S, S); got {maps.shape}")
    factor = 255 if maps.max(initial=0) <= 1 else 1
    return np.asarray(np.rint(maps[0] * factor).clip(0, 255), dtype=np.uint8)


def describe(
    recipe: WordsRecipe, grey: Grey, valid: Mask, detector: Detector | None = None
) -> Array:
    """Descriptors (N, D) of features that see valid pixels only, within their radius.

    `detector`: for other features than SIFT; raises `VariantError` without."""
    if detector is None and recipe.features != "sift":
        raise VariantError(f"features '{recipe.features}' do not fly; they need their detector")
    if not valid.any():
        return np.zeros((0, DIMS[recipe.features]), dtype=np.float32)
    picture = filled(grey, valid)
    if detector is None:
        found = sift_features(picture, recipe.max_features)
        points, radii, descriptors = found.points, found.radii, found.descriptors
    else:
        points, radii, descriptors = detector(picture)
    return descriptors[seen(valid, points, radii)]


def seen(valid: Mask, points: Array, radii: Array) -> Mask:
    """Which features (N,) see valid pixels (H, W) only, within their radius."""
    if not len(points) or valid.all():
        return np.ones(len(points), dtype=bool)
    free = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    height, width = valid.shape
    columns, rows = np.floor(points).astype(int).T
    inside = free.reshape(height, width)[rows.clip(0, height - 1), columns.clip(0, width - 1)]
    return np.asarray(inside > radii)


@dataclass(frozen=True, eq=False)
class SiftFeatures:
    """Features of a picture, N of them; `descriptors` (N, 128): whole numbers."""

    keypoints: Sequence[cv2.KeyPoint]
    descriptors: Array

    @property
    def points(self) -> Array:
        """Columns and rows (N, 2) from the outer corner."""
        places = np.array([point.pt for point in self.keypoints], np.float32)
        return places.reshape(-1, 2) + np.float32(0.5)

    @property
    def radii(self) -> Array:
        """(N,) px."""
        return np.array([point.size / 2 for point in self.keypoints], np.float32)

    @property
    def strengths(self) -> Array:
        """Responses (N,)."""
        return np.array([point.response for point in self.keypoints], np.float32)

    @property
    def margins(self) -> Array:
        """Px (N,) from the edge within which OpenCV finds no feature of this scale."""
        octaves = np.array([point.octave & 255 for point in self.keypoints], np.uint8)
        return 5 * np.exp2(octaves.view(np.int8).astype(np.float32))  # 5 px of every octave


def sift_features(grey: Grey, most: int = 0) -> SiftFeatures:
    """The strongest features of a picture (H, W); all of them where `most` is 0."""
    found, descriptors = cv2.SIFT.create(nfeatures=most).detectAndCompute(grey, None)
    found = found[: most or None]  # of equally strong ones there may be more
    if descriptors is None:
        descriptors = np.zeros((0, DIMS["sift"]))
    return SiftFeatures(found, np.asarray(descriptors[: len(found)], np.float32))
