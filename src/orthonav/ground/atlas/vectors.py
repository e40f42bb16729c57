"""The vector index: unit vectors assigned to lists and coded, in shards that are mapped.

Lists are an inverted multi-index (Babenko and Lempitsky, CVPR 2012). Codes have 4 bits per
quantizer (product quantization: Jegou, Douze and Schmid, PAMI 2011; fast scan: Andre, Kermarrec and
Le Scouarnec, VLDB 2015). Both are computed by FAISS. All shards of an index share one set of
quantizers (`train`) and depend on nothing else, so they can be added and removed one by one.

A shard NAME is three files in a folder: `NAME.vectors.npy` (rows, D) float16, `NAME.codes` with the
codes and rows of every list, and `NAME.lists.npy` (lists, 3) uint64 with count, room and offset of
each list. Every length is checked before FAISS is given the map."""

import os
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AtlasError
from orthonav.core.extras import needed

Array = NDArray[np.float32]

MAX_TRAINING_VECTORS = 200_000  # as in `benchmarks.atlas_search` at d63ac91
CODE_BITS = 4  # bits per quantizer: what the fast scan of FAISS supports
BLOCK = 32  # codes that FAISS scans together; the room of a list is a multiple of it


def faiss() -> Any:
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
    """How vectors are assigned to lists and coded. `list_bits`: there are 2 ** `list_bits` lists,
    half of the bits from either half of a vector; even, 2 to 20."""

    dims: int  # components per vector, even
    list_bits: int = 14
    quantizers: int = 32  # codes of 4 bits per vector; even, divides `dims`

    def __post_init__(self) -> None:
        even = not (self.dims % 2 or self.list_bits % 2 or self.quantizers % 2)
        large = self.dims >= 2 and 2 <= self.list_bits <= 20 and self.quantizers >= 2
        if not (even and large and self.dims % self.quantizers == 0):
            raise AtlasError(f"impossible recipe of an index: {self}")

    @classmethod
    def for_count(cls, count: int, dims: int) -> "VectorRecipe":
        list_bits = 4
        while list_bits < 16 and count > 800 * 2 ** (list_bits + 1):
            list_bits += 2
        quantizers = dims // 2 if dims % 4 == 0 else 2
        return cls(dims, list_bits, quantizers)

    @property
    def lists(self) -> int:
        return int(2**self.list_bits)

    @property
    def code_bytes(self) -> int:
        return self.quantizers // 2


@dataclass(frozen=True, eq=False)
class Quantizers:
    """`rotation` (D, D) spreads variance evenly over the quantizers. `halves` (2, sqrt(lists), D /
    2): list centres of each half of a rotated vector."""

    recipe: VectorRecipe  # how they were made
    rotation: Array
    halves: Array
    codebook: Array  # (quantizers, 16, D / quantizers), codes of the residual

    @classmethod
    def of(cls, recipe: VectorRecipe, parts: Mapping[str, NDArray[Any]]) -> "Quantizers":
        """From `parts`, which may be untrusted; raises `AtlasError` unless they fit the recipe."""
        for name, shape in _shapes(recipe).items():
            array = parts.get(name)
            if array is None or array.shape != shape or array.dtype != np.float32:
                raise AtlasError(f"{name} of an index is not float32 {shape}")
        return cls(recipe, *(parts[name] for name in _shapes(recipe)))

    @property
    def parts(self) -> dict[str, Array]:
        return {name: np.ascontiguousarray(getattr(self, name)) for name in _shapes(self.recipe)}

    def rotated(self, vectors: Array) -> Array:
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
        module = faiss()
        index, coarse = _untrained(self.recipe)
        module.copy_array_to_vector(self.halves.reshape(-1), coarse.pq.centroids)
        module.copy_array_to_vector(self.codebook.reshape(-1), index.pq.centroids)
        coarse.is_trained, coarse.ntotal, index.is_trained = True, self.recipe.lists, True
        return index


def _untrained(recipe: VectorRecipe) -> tuple[Any, Any]:
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
    dims, quantizers = recipe.dims, recipe.quantizers
    return {
        "rotation": (dims, dims),
        "halves": (2, 2 ** (recipe.list_bits // 2), dims // 2),
        "codebook": (quantizers, 2**CODE_BITS, dims // quantizers),
    }


def train(sample: NDArray[np.floating[Any]], recipe: VectorRecipe) -> Quantizers:
    """Train quantizers on a sample (N, D) of the vectors; the same sample gives the same bytes. At
    most `MAX_TRAINING_VECTORS` evenly spaced vectors are used."""
    step = max(1, -(-len(sample) // MAX_TRAINING_VECTORS))
    taken = np.asarray(sample[::step], dtype=np.float32)
    rotation = _rotation(taken, recipe.quantizers)
    index, coarse = _untrained(recipe)
    for each in (coarse, index):
        means = each.pq.cp
        means.niter, means.seed = 12, 1
        # FAISS's limit of 256 points loses 2 to 4 points of recall where there are few centres.
        means.min_points_per_centroid, means.max_points_per_centroid = 1, 4096
    with one_thread():
        index.train(np.ascontiguousarray(taken @ rotation))
    halves, codebook = (faiss().vector_to_array(each.pq.centroids) for each in (coarse, index))
    shapes = _shapes(recipe)
    return Quantizers(
        recipe, rotation, halves.reshape(shapes["halves"]), codebook.reshape(shapes["codebook"])
    )


def _rotation(vectors: Array, groups: int) -> Array:
    """Rotation (D, D) to principal axes, assigned so that the products of the groups' variances are
    similar (Ge et al., Optimized Product Quantization, CVPR 2013, section 3.3). The PCAMatrix of
    FAISS, which balances sums of variances, finds 1 to 4 % fewer vectors."""
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


NONE = -1  # id where fewer than k vectors were found
Ids = NDArray[np.int64]


@dataclass(frozen=True)
class Part:
    sheet: str  # name of the sheet
    sha256: str  # digest of its coarse tiles (hex)
    rows: int  # how many


@dataclass(frozen=True)
class ShardInfo:
    name: str
    base: int
    parts: tuple[Part, ...]

    @property
    def rows(self) -> int:
        return sum(part.rows for part in self.parts)


def write_shard(
    folder: Path,
    info: ShardInfo,
    quantizers: Quantizers,
    batches: Iterable[Array],
) -> None:
    """`batches`: unit vectors (n, D) of some rows at a time. Memory grows by codes, some 24 bytes a
    vector."""
    folder.mkdir(parents=True, exist_ok=True)
    dims, index = quantizers.recipe.dims, quantizers.empty_index()
    header = {"descr": "<f2", "fortran_order": False, "shape": (info.rows, dims)}
    with (folder / f"{info.name}.vectors.npy").open("wb") as out:
        np.lib.format.write_array_header_1_0(out, header)
        for batch in batches:
            stored = np.ascontiguousarray(batch, dtype=np.float16)
            if not np.isfinite(stored).all():
                raise AtlasError("vectors of an index must be finite")
            out.write(stored.data)
            with one_thread():
                index.add(quantizers.rotated(stored.astype(np.float32)))
    _write_lists(folder, info.name, index, quantizers.recipe)


def _write_lists(folder: Path, name: str, index: Any, recipe: VectorRecipe) -> None:
    module, lists = faiss(), index.invlists
    table = np.zeros((recipe.lists, 3), dtype=np.uint64)
    with (folder / f"{name}.codes").open("wb") as out:
        for number in range(recipe.lists):
            if not (size := lists.list_size(number)):
                continue
            room = -(-size // BLOCK) * BLOCK
            table[number] = size, room, out.tell()
            codes = module.rev_swig_ptr(lists.get_codes(number), room * recipe.code_bytes)
            rows = module.rev_swig_ptr(lists.get_ids(number), size)
            out.write(np.asarray(codes).data)
            out.write(np.pad(np.asarray(rows, dtype=np.int64), (0, room - size)).data)
        if out.tell() == 0:
            out.write(bytes(BLOCK))  # an empty file cannot be mapped
    np.save(folder / f"{name}.lists.npy", table)


class OpenShard:
    """The files of a shard, opened. Lists are mapped. Vectors are read row by row: the system
    would map a megabyte around each."""

    def __init__(
        self, file: Callable[[str], Path], info: ShardInfo, quantizers: Quantizers
    ) -> None:
        self.info = info
        ends = ("vectors.npy", "codes", "lists.npy")
        path, codes, lists = (file(f"{info.name}.{end}") for end in ends)
        dims = quantizers.recipe.dims
        try:
            vectors = np.load(path, mmap_mode="r")
            table = np.load(lists)
            if vectors.shape != (info.rows, dims) or vectors.dtype != "<f2":
                raise ValueError(f"{vectors.shape} {vectors.dtype}, expected {info.rows} rows")
            _check_table(table, quantizers.recipe, info.rows, codes.stat().st_size)
        except (OSError, ValueError) as error:
            raise AtlasError(
                f"shard {info.name} is damaged ({error}); rebuild the index"
            ) from error
        self._dims, self._offset = dims, path.stat().st_size - vectors.nbytes
        self._file = os.open(path, os.O_RDONLY)
        weakref.finalize(self, os.close, self._file)
        os.posix_fadvise(self._file, 0, 0, os.POSIX_FADV_RANDOM)
        self._index = quantizers.empty_index()
        module, recipe = faiss(), quantizers.recipe
        mapped = module.OnDiskInvertedLists(recipe.lists, recipe.code_bytes, str(codes))
        mapped.lists.resize(recipe.lists)
        contents = np.ascontiguousarray(table)
        module.memcpy(mapped.lists.data(), module.swig_ptr(contents), contents.nbytes)
        mapped.totsize, mapped.read_only, mapped.prefetch_nthread = codes.stat().st_size, True, 0
        mapped.do_mmap()
        self._index.replace_invlists(mapped, False)
        self._index.ntotal = self.info.rows
        self._index.referenced_objects.append(mapped)

    def scan(self, rotated: Array, lists: Ids, scores: Array, count: int) -> tuple[Array, Ids]:
        """Scores by code and ids (Q, count) of the best vectors in these lists."""
        module, index = faiss(), self._index
        found = np.empty((len(rotated), count), dtype=np.float32)
        rows = np.empty((len(rotated), count), dtype=np.int64)
        index.nprobe = lists.shape[1]
        index.implem = 10 if len(rotated) == 1 else 0  # 10 is faster for one query
        point = module.swig_ptr
        index.search_preassigned_c(
            len(rotated),
            point(rotated),
            count,
            point(lists),
            point(scores),
            point(found),
            point(rows),
            False,
        )
        if rows.max(initial=NONE) >= self.info.rows or rows.min(initial=NONE) < NONE:
            raise AtlasError(f"codes of shard {self.info.name} are damaged; rebuild the index")
        return found, np.where(rows == NONE, NONE, rows + self.info.base)

    def vectors(self, rows: Ids) -> Array:
        size, offset, file = 2 * self._dims, self._offset, self._file
        read = b"".join([os.pread(file, size, offset + size * row) for row in rows.tolist()])
        return np.frombuffer(read, dtype=np.float16).astype(np.float32).reshape(-1, self._dims)


def _check_table(table: NDArray[np.uint64], recipe: VectorRecipe, rows: int, size: int) -> None:
    if table.shape != (recipe.lists, 3) or table.dtype != np.uint64:
        raise ValueError("another number of lists")
    count, room, offset = table.astype(np.float64).T
    ends = offset + room * (recipe.code_bytes + 8)
    fits = ((count <= room) & (ends <= size) & (room % BLOCK == 0)).all()
    if not fits or count.sum() != rows:
        raise ValueError("lists do not fit their file")


class ShardedIndex:
    """The shards of an index, mapped and searched on one core. The id of a vector is the base of
    its shard plus its row. Not for several threads at once."""

    def __init__(
        self, file: Callable[[str], Path], shards: Sequence[ShardInfo], quantizers: Quantizers
    ) -> None:
        self.quantizers = quantizers
        self._shards = [OpenShard(file, each, quantizers) for each in shards]

    def __len__(self) -> int:
        return sum(each.info.rows for each in self._shards)

    def search(
        self, queries: NDArray[np.float32], k: int, probes: int, rerank: int
    ) -> tuple[Array, Ids]:
        """Highest scalar products (Q, k) and ids (Q, k) of queries (Q, D), best first. `probes`
        lists of every shard are scanned. The `rerank` best by code, over all shards, are compared
        by their stored vectors. Where fewer are found: id -1 and product -inf."""
        queries = np.ascontiguousarray(queries, dtype=np.float32)
        rotated = self.quantizers.rotated(queries)
        lists, centre_scores = self.quantizers.nearest_lists(rotated, probes)
        rerank = max(k, rerank)
        with one_thread():
            found = [shard.scan(rotated, lists, centre_scores, rerank) for shard in self._shards]
        scores, ids = (np.concatenate(each, axis=1) for each in zip(*found, strict=True))
        if ids.shape[1] > rerank:
            best = np.argpartition(scores, -rerank, axis=1)[:, -rerank:]
            ids = np.take_along_axis(ids, best, axis=1)
        return self._compared(queries, ids, k)

    def vectors(self, ids: Ids) -> Array:
        out = np.zeros((len(ids), self.quantizers.recipe.dims), dtype=np.float32)
        for shard in self._shards:
            rows = ids - shard.info.base
            ours = np.flatnonzero((rows >= 0) & (rows < shard.info.rows))
            if len(ours):
                ours = ours[np.argsort(rows[ours], kind="stable")]
                out[ours] = shard.vectors(rows[ours])
        return out

    def sheets_of(self, ids: Ids) -> list[str]:
        """Names of the sheets to which vectors belong."""
        parts = [part for shard in self._shards for part in shard.info.parts]
        ends = np.cumsum([part.rows for part in parts])
        return [parts[at].sheet for at in np.searchsorted(ends, ids, side="right").tolist()]

    def _compared(self, queries: Array, ids: Ids, k: int) -> tuple[Array, Ids]:
        out_scores = np.full((len(queries), k), -np.inf, dtype=np.float32)
        out_ids = np.full((len(queries), k), NONE, dtype=np.int64)
        for query, candidates in enumerate(ids):
            real = candidates[candidates != NONE]
            scores = self.vectors(real) @ queries[query]
            order = np.lexsort((real, -scores))[:k]
            out_scores[query, : len(order)] = scores[order]
            out_ids[query, : len(order)] = real[order]
        return out_scores, out_ids
