"""The quantizers of the vector index: how unit vectors are assigned to lists and coded.

Lists are an inverted multi-index (Babenko and Lempitsky, CVPR 2012). Codes have 4 bits per
quantizer (product quantization: Jegou, Douze and Schmid, PAMI 2011; fast scan: Andre, Kermarrec and
Le Scouarnec, VLDB 2015). Both are computed by FAISS. All shards of an index share one set of
quantizers (`train`) and depend on nothing else, so they can be added and removed one by one.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from orthonav.core.errors import AtlasError
from orthonav.core.extras import needed

Array = NDArray[np.float32]

QUANTIZERS_NAME = "quantizers.safetensors"
MAX_TRAINING_VECTORS = 200_000
"""Vectors that quantizers are trained on, as in `python -m benchmarks.atlas_search`."""
POINTS_PER_CENTRE = 4096
"""Training vectors per centre, if there are as many. FAISS's default, 256, loses 2 to 4 points of
recall where lists or codes have few centres (2e5 vectors of `benchmarks.atlas_fields`)."""
ROUNDS = 12
"""Iterations of k-means, as in `python -m benchmarks.atlas_search`."""
CODE_BITS = 4
"""Bits per quantizer: what the fast scan of FAISS supports."""
BLOCK = 32
"""Codes that FAISS scans together; the room of a list is a multiple of it."""
FORMAT = "orthonav-vectors"


def faiss() -> Any:
    """The module FAISS; raises `MissingExtraError` where it is not installed."""
    return needed("faiss", "atlas", "searching an atlas")


@contextmanager
def one_thread() -> Iterator[None]:
    """FAISS on one thread: with more threads sums are added in a varying order."""
    module = faiss()
    threads = module.omp_get_max_threads()
    module.omp_set_num_threads(1)
    try:
        yield
    finally:
        module.omp_set_num_threads(threads)


@dataclass(frozen=True)
class VectorRecipe:
    """How vectors are assigned to lists and coded.

    `dims`: components per vector, even.
    `list_bits`: there are 2 ** `list_bits` lists, half of the bits from either half of a vector;
    even, 2 to 20.
    `quantizers`: codes of 4 bits per vector; even, divides `dims`.
    `seed`: seed of k-means.
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
        """The recipe for `count` vectors: lists of up to 1600, 4 bits for every two components."""
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
class Quantizers:
    """The trained quantizers that all shards of an index share.

    `recipe`: how they were made.
    `rotation` (D, D): rotates vectors so that variance is spread evenly over the quantizers.
    `halves` (2, sqrt(lists), D / 2): list centres of each half of a rotated vector.
    `codebook` (quantizers, 16, D / quantizers): codes of the residual.
    """

    recipe: VectorRecipe
    rotation: Array
    halves: Array
    codebook: Array

    @cached_property
    def digest(self) -> str:
        """Short digest of all arrays."""
        return sha256(self._bytes()).hexdigest()[:16]

    def save(self, path: Path) -> None:
        """Write to `path` (safetensors)."""
        path.write_bytes(self._bytes())

    @classmethod
    def load(cls, path: Path) -> "Quantizers":
        """Read what `save` wrote; raises `AtlasError`."""
        try:
            with safe_open(path, framework="numpy") as stored:
                recipe = VectorRecipe(**json.loads((stored.metadata() or {}).get(FORMAT, "")))
                made = cls(recipe, *(stored.get_tensor(name) for name in _shapes(recipe)))
        except (OSError, SafetensorError, ValueError, TypeError) as error:
            raise AtlasError(f"quantizers of an index cannot be read ({error}): {path}") from error
        for name, shape in _shapes(recipe).items():
            array = getattr(made, name)
            if array.shape != shape or array.dtype != np.float32:
                raise AtlasError(f"{name} of an index must be {shape}, got {array.shape}: {path}")
        return made

    def _bytes(self) -> bytes:
        arrays = {name: np.ascontiguousarray(getattr(self, name)) for name in _shapes(self.recipe)}
        recipe = json.dumps(asdict(self.recipe), sort_keys=True)
        return bytes(save(arrays, metadata={FORMAT: recipe}))

    def rotated(self, vectors: Array) -> Array:
        """Vectors (N, D) in the axes of lists and codes."""
        return np.ascontiguousarray(np.asarray(vectors, dtype=np.float32) @ self.rotation)

    def nearest_lists(self, rotated: Array, probes: int) -> tuple[NDArray[np.int64], Array]:
        """The `probes` lists (Q, probes) whose centres have the highest scalar products with
        rotated queries (Q, D), in the order of list numbers, and those products (Q, probes)."""
        half = self.recipe.dims // 2
        low, high = rotated[:, :half] @ self.halves[0].T, rotated[:, half:] @ self.halves[1].T
        probes = min(probes, low.shape[1] * high.shape[1])
        lists = np.empty((len(rotated), probes), np.int64)
        products = np.empty(lists.shape, np.float32)
        for number in range(len(rotated)):  # one at a time: 2^16 sums each
            sums = (high[number, :, None] + low[number]).ravel()
            lists[number] = np.sort(np.argpartition(sums, -probes)[-probes:])
            products[number] = sums[lists[number]]
        return lists, products

    def empty_index(self) -> Any:
        """An empty FAISS index (IndexIVFPQFastScan) with these quantizers."""
        module = faiss()
        index, coarse = _untrained(self.recipe)
        module.copy_array_to_vector(self.halves.reshape(-1), coarse.pq.centroids)
        module.copy_array_to_vector(self.codebook.reshape(-1), index.pq.centroids)
        coarse.is_trained, coarse.ntotal, index.is_trained = True, self.recipe.lists, True
        return index


def _untrained(recipe: VectorRecipe) -> tuple[Any, Any]:
    """An index of FAISS to be trained, and its quantizer of lists."""
    module = faiss()
    coarse = module.MultiIndexQuantizer(recipe.dims, 2, recipe.list_bits // 2)
    index = module.IndexIVFPQFastScan(
        coarse,
        recipe.dims,
        recipe.lists,
        recipe.quantizers,
        CODE_BITS,
        module.METRIC_INNER_PRODUCT,
        BLOCK,
    )
    index.by_residual, index.quantizer_trains_alone = True, 1
    index.referenced_objects = [coarse]
    return index, coarse


def _shapes(recipe: VectorRecipe) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of `Quantizers` by name."""
    dims, quantizers = recipe.dims, recipe.quantizers
    return {
        "rotation": (dims, dims),
        "halves": (2, 2 ** (recipe.list_bits // 2), dims // 2),
        "codebook": (quantizers, 2**CODE_BITS, dims // quantizers),
    }


def train(sample: NDArray[np.floating[Any]], recipe: VectorRecipe) -> Quantizers:
    """Train quantizers on a sample (N, D) of the vectors; the same sample gives the same bytes.

    At most `MAX_TRAINING_VECTORS` evenly spaced vectors are used.
    """
    step = max(1, -(-len(sample) // MAX_TRAINING_VECTORS))
    taken = np.asarray(sample[::step], dtype=np.float32)
    rotation = _rotation(taken, recipe.quantizers)
    index, coarse = _untrained(recipe)
    for each in (coarse, index):
        means = each.pq.cp
        means.niter, means.seed = ROUNDS, recipe.seed + 1
        means.min_points_per_centroid, means.max_points_per_centroid = 1, POINTS_PER_CENTRE
    with one_thread():
        index.train(np.ascontiguousarray(taken @ rotation))
    halves, codebook = (faiss().vector_to_array(each.pq.centroids) for each in (coarse, index))
    shapes = _shapes(recipe)
    return Quantizers(
        recipe,
        rotation,
        halves.reshape(shapes["halves"]),
        codebook.reshape(shapes["codebook"]),
    )


def _rotation(vectors: Array, groups: int) -> Array:
    """Rotation (D, D) to principal axes, assigned so that the products of the groups' variances
    are similar (Ge et al., Optimized Product Quantization, CVPR 2013, section 3.3).

    The PCAMatrix of FAISS, which balances sums of variances, finds 1 to 4 % fewer vectors.
    """
    wide = vectors.astype(np.float64)
    variances, axes = np.linalg.eigh(wide.T @ wide / len(wide))
    variances, axes = variances[::-1], axes[:, ::-1]
    largest = np.abs(axes).argmax(axis=0)
    axes = axes * np.sign(axes[largest, np.arange(len(axes))])
    room = len(axes) // groups
    assigned: list[list[int]] = [[] for _ in range(groups)]
    weight = np.zeros(groups)
    logs = np.log(np.maximum(variances, 1e-9 * variances[0]))
    logs -= logs.min() - 1e-3
    # The two halves are balanced as well: groups are filled from either half in turn.
    in_turn = np.arange(groups).reshape(2, -1).T.ravel().tolist()
    for axis, log in enumerate(logs):
        open_groups = [group for group in in_turn if len(assigned[group]) < room]
        least = min(open_groups, key=weight.__getitem__)
        assigned[least].append(axis)
        weight[least] += log
    order = [axis for group in assigned for axis in group]
    return np.ascontiguousarray(axes[:, order], dtype=np.float32)
