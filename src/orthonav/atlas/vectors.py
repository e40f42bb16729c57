"""Search among up to hundreds of millions of unit vectors by scalar product.

Vectors fall into lists (an inverted multi-index: Babenko and Lempitsky, CVPR 2012) and are scanned
as codes of 4 bits per quantizer (product quantization: Jegou, Douze and Schmid, PAMI 2011; the
scan: Andre, Kermarrec and Le Scouarnec, VLDB 2015), both by FAISS; the best few hundred are then
compared as they are stored. `train` makes what all shards share; a shard depends on nothing else,
so shards are added, replaced and retired one by one (`orthonav.atlas.shards`) and searched together
(`orthonav.atlas.vector_search`).
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from orthonav.errors import AtlasError
from orthonav.extras import needed
from orthonav.files import replacing

Array = NDArray[np.float32]

MAX_LEARNT = 200_000
"""Vectors that quantizers are learnt from."""
POINTS_PER_CENTROID = 256
ROUNDS = 12
CODE_BITS = 4
BLOCK = 32
"""Codes that FAISS scans together; a list takes room for a multiple of them."""
SCAN_ONE = 10
"""FAISS's way of scanning that is fastest for one query at a time."""
FORMAT = "orthonav-vectors"


def faiss() -> Any:
    """The module, or `MissingExtraError`."""
    return needed("faiss", "atlas", "searching an atlas")


@contextmanager
def one_thread() -> Iterator[None]:
    """FAISS on one thread: with more, sums may come out in another order."""
    module = faiss()
    threads = module.omp_get_max_threads()
    module.omp_set_num_threads(1)
    try:
        yield
    finally:
        module.omp_set_num_threads(threads)


@dataclass(frozen=True)
class VectorRecipe:
    """How vectors are listed and coded.

    `dims`: numbers per vector. `list_bits`: there are 2 to the power of it lists, half of the bits
    from either half of the numbers. `quantizers`: codes of 4 bits per vector.
    """

    dims: int
    list_bits: int = 14
    quantizers: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        if self.dims < 2 or self.dims % 2:
            raise AtlasError(f"vectors must have an even number of dims, got {self.dims}")
        if not 2 <= self.list_bits <= 20 or self.list_bits % 2:
            raise AtlasError(f"list_bits must be even and 2 to 20, got {self.list_bits}")
        if self.quantizers < 2 or self.quantizers % 2 or self.dims % self.quantizers:
            raise AtlasError(
                f"quantizers must be even and divide dims ({self.dims}), got {self.quantizers}"
            )

    @classmethod
    def for_count(cls, count: int, dims: int, seed: int = 0) -> "VectorRecipe":
        """What suits `count` vectors: lists of up to 1600, 4 bits for every two numbers."""
        list_bits = 4
        while list_bits < 16 and count > 800 * 2 ** (list_bits + 1):
            list_bits += 2
        quantizers = dims // 2 if dims % 4 == 0 else 2
        return cls(dims, list_bits, quantizers, seed)

    @property
    def lists(self) -> int:
        """Number of lists."""
        return int(2**self.list_bits)

    @property
    def code_bytes(self) -> int:
        """Bytes of a code."""
        return self.quantizers // 2


@dataclass(frozen=True, eq=False)
class Trained:
    """What all shards share.

    `turn` (D, D) rotates vectors so that every quantizer has as much to say; `halves`
    (2, sqrt(lists), D / 2) are centres of lists, one of each half; `codebook`
    (quantizers, 16, D / quantizers) codes what is left.
    """

    recipe: VectorRecipe
    turn: Array
    halves: Array
    codebook: Array

    @property
    def dims(self) -> int:
        """Numbers per vector."""
        return self.recipe.dims

    @cached_property
    def digest(self) -> str:
        """Short digest: shards made with another training are refused."""
        return sha256(self._bytes()).hexdigest()[:16]

    def save(self, path: Path) -> None:
        """Write to `path` (safetensors), whole or not at all."""
        with replacing(path) as temporary:
            temporary.write_bytes(self._bytes())

    @classmethod
    def load(cls, path: Path) -> "Trained":
        """Read what `save` wrote; raises `AtlasError`."""
        try:
            with safe_open(path, framework="numpy") as stored:
                said = (stored.metadata() or {}).get(FORMAT, "")
                recipe = VectorRecipe(**json.loads(said))
                made = cls(recipe, *(stored.get_tensor(name) for name in _parts(recipe)))
        except (OSError, SafetensorError, ValueError, TypeError) as error:
            raise AtlasError(f"quantizers of an index cannot be read ({error}): {path}") from error
        for name, shape in _parts(recipe).items():
            array = getattr(made, name)
            if array.shape != shape or array.dtype != np.float32:
                raise AtlasError(f"{name} of an index must be {shape}, got {array.shape}: {path}")
        return made

    def _bytes(self) -> bytes:
        arrays = {name: np.ascontiguousarray(getattr(self, name)) for name in _parts(self.recipe)}
        told = json.dumps(asdict(self.recipe), sort_keys=True)
        return bytes(save(arrays, metadata={FORMAT: told}))

    def turned(self, vectors: Array) -> Array:
        """Vectors (N, D) as lists and codes see them."""
        return np.ascontiguousarray(np.asarray(vectors, dtype=np.float32) @ self.turn)

    def nearest_lists(self, turned: Array, probes: int) -> tuple[NDArray[np.int64], Array]:
        """The `probes` lists (Q, probes) whose centres have the highest scalar products with
        turned queries (Q, D), in the order of lists, and those products (Q, probes)."""
        half = self.dims // 2
        probes = min(probes, self.recipe.lists)
        lists = np.empty((len(turned), probes), dtype=np.int64)
        scores = np.empty((len(turned), probes), dtype=np.float32)
        side = self.halves.shape[1]
        first, second = _pairs(side, probes)
        products = turned[:, :half] @ self.halves[0].T, turned[:, half:] @ self.halves[1].T
        for query, (low, high) in enumerate(zip(*products, strict=True)):
            lows, highs = np.argsort(-low), np.argsort(-high)
            sums = low[lows][first] + high[highs][second]
            chosen = np.arange(len(sums))
            if probes < len(sums):
                chosen = np.argpartition(sums, -probes)[-probes:]
            numbers = highs[second[chosen]] * side + lows[first[chosen]]
            order = np.argsort(numbers)
            lists[query], scores[query] = numbers[order], sums[chosen[order]]
        return lists, scores

    def empty_index(self) -> Any:
        """A FAISS index (IndexIVFPQFastScan) that knows the quantizers and holds nothing."""
        module, recipe = faiss(), self.recipe
        coarse = module.MultiIndexQuantizer(recipe.dims, 2, recipe.list_bits // 2)
        module.copy_array_to_vector(self.halves.reshape(-1), coarse.pq.centroids)
        coarse.is_trained, coarse.ntotal = True, recipe.lists
        index = module.IndexIVFPQFastScan(
            coarse,
            recipe.dims,
            recipe.lists,
            recipe.quantizers,
            CODE_BITS,
            module.METRIC_INNER_PRODUCT,
            BLOCK,
        )
        index.by_residual, index.quantizer_trains_alone, index.is_trained = True, 1, True
        module.copy_array_to_vector(self.codebook.reshape(-1), index.pq.centroids)
        index.referenced_objects = [coarse]
        return index


def _parts(recipe: VectorRecipe) -> dict[str, tuple[int, ...]]:
    """Arrays of `Trained` and their shapes."""
    dims, quantizers = recipe.dims, recipe.quantizers
    return {
        "turn": (dims, dims),
        "halves": (2, 2 ** (recipe.list_bits // 2), dims // 2),
        "codebook": (quantizers, 2**CODE_BITS, dims // quantizers),
    }


@lru_cache(maxsize=16)
def _pairs(side: int, count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Ranks in either half of all pairs that may be among the `count` with the highest sums.

    Of a pair of ranks (i, j), from 1, no fewer than i * j pairs are as good or better.
    """
    ranks = np.arange(1, side + 1)
    first, second = np.nonzero(np.multiply.outer(ranks, ranks) <= count)
    return first, second


def train(sample: NDArray[np.floating[Any]], recipe: VectorRecipe) -> Trained:
    """Learn from a sample (N, D) of the vectors what lists and codes are made with.

    At most `MAX_LEARNT` of them, evenly taken. The same sample gives the same bytes. Raises
    `AtlasError` where there are fewer vectors than centres.
    """
    if sample.ndim != 2 or sample.shape[1] != recipe.dims:
        raise AtlasError(f"vectors must be (N, {recipe.dims}), got {sample.shape}")
    least = max(2 ** (recipe.list_bits // 2), 2**CODE_BITS)
    if len(sample) < least:
        raise AtlasError(f"an index with these lists needs {least} vectors, got {len(sample)}")
    taken = np.asarray(sample[:: max(1, -(-len(sample) // MAX_LEARNT))], dtype=np.float32)
    turn = _turn(taken, recipe.quantizers)
    turned = np.ascontiguousarray(taken @ turn)
    with one_thread():
        halves = _centres(turned, 2, recipe.list_bits // 2, recipe.seed)
        left = turned - _reconstructed(turned, halves)
        codebook = _centres(left, recipe.quantizers, CODE_BITS, recipe.seed)
    return Trained(recipe, turn, halves, codebook)


def _turn(vectors: Array, groups: int) -> Array:
    """Rotation (D, D) to principal axes, dealt out so that each group's variances have a like
    product (Ge et al., Optimized Product Quantization, CVPR 2013, section 3.3)."""
    wide = vectors.astype(np.float64)
    variances, axes = np.linalg.eigh(wide.T @ wide / len(wide))
    variances, axes = variances[::-1], axes[:, ::-1]
    largest = np.abs(axes).argmax(axis=0)
    axes = axes * np.sign(axes[largest, np.arange(len(axes))])
    room = len(axes) // groups
    dealt: list[list[int]] = [[] for _ in range(groups)]
    weight = np.zeros(groups)
    logs = np.log(np.maximum(variances, 1e-9 * variances[0]))
    logs -= logs.min() - 1e-3
    for axis, log in enumerate(logs):
        open_groups = [group for group in range(groups) if len(dealt[group]) < room]
        # The two halves, too, are to have as much to say: groups are filled from either in turn.
        least = min(open_groups, key=lambda group: (weight[group], _interleaved(group, groups)))
        dealt[least].append(axis)
        weight[least] += log
    order = [axis for group in dealt for axis in group]
    return np.ascontiguousarray(axes[:, order], dtype=np.float32)


def _interleaved(group: int, groups: int) -> int:
    half = groups // 2
    return 2 * group if group < half else 2 * (group - half) + 1


def _centres(vectors: Array, parts: int, bits: int, seed: int) -> Array:
    """k-means centres (parts, 2^bits, D / parts) of consecutive parts of vectors (N, D)."""
    module = faiss()
    width = vectors.shape[1] // parts
    centres = np.empty((parts, 2**bits, width), dtype=np.float32)
    for part in range(parts):
        means = module.Kmeans(
            width,
            2**bits,
            niter=ROUNDS,
            seed=seed + part + 1,
            min_points_per_centroid=1,
            max_points_per_centroid=POINTS_PER_CENTROID * (1 if bits > CODE_BITS else 16),
        )
        means.train(np.ascontiguousarray(vectors[:, part * width : (part + 1) * width]))
        centres[part] = means.centroids
    return centres


def _reconstructed(vectors: Array, centres: Array) -> Array:
    """Vectors (N, D) with each part replaced by its nearest centre."""
    module = faiss()
    out = np.empty_like(vectors)
    width = centres.shape[2]
    for part, of_part in enumerate(centres):
        columns = slice(part * width, (part + 1) * width)
        _, nearest = module.knn(np.ascontiguousarray(vectors[:, columns]), of_part, 1)
        out[:, columns] = of_part[nearest[:, 0]]
    return out
