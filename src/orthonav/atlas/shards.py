"""Shards of an index of vectors: files that are memory-mapped and searched together.

A shard NAME is four files in a folder: `NAME.vectors.npy` (rows, D) float16, `NAME.codes` with the
codes and rows of every list, `NAME.lists.npy` telling where each list lies, and `NAME.json`,
written last and removed first: a shard is there if and only if it is. `NAME.retired.npy` lists rows
that no longer count.
"""

import json
import os
import weakref
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.atlas.vectors import BLOCK, SCAN_ONE, Array, Trained, faiss, one_thread
from orthonav.errors import AtlasError, OutputError
from orthonav.files import replacing, write_text

FORMAT = "orthonav-vector-shard"
TRAINED_NAME = "trained.safetensors"
PARTS = ("vectors.npy", "codes", "lists.npy")
BLOCK_ROWS = 16_384
ADD_ROWS = 32_768
NONE = -1
"""Id where fewer than k vectors were found."""

Ids = NDArray[np.int64]


@dataclass(frozen=True)
class Shard:
    """A shard's manifest: ids are `base` to `base + rows - 1`, in the order they were written."""

    name: str
    base: int
    rows: int
    trained: str

    def write(self, folder: Path) -> None:
        """Write it, which makes the shard exist."""
        told = json.dumps({"format": FORMAT, "schema": 1, **asdict(self)}, sort_keys=True)
        write_text(folder / f"{self.name}.json", told + "\n")

    @classmethod
    def read(cls, path: Path) -> "Shard":
        """Inverse of `write`; raises `AtlasError`."""
        try:
            told = json.loads(path.read_text(encoding="utf-8"))
            if told["format"] != FORMAT or told["schema"] != 1:
                raise ValueError(f"format {told['format']!r}, schema {told['schema']!r}")
            shard = cls(str(told["name"]), int(told["base"]), int(told["rows"]), told["trained"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise AtlasError(f"shard of an index cannot be read ({error}): {path}") from error
        if shard.name != path.stem or shard.rows < 0 or shard.base < 0:
            raise AtlasError(f"shard of an index says it is {shard}: {path}")
        return shard


class ShardWriter:
    """Writes a shard from blocks of vectors; a context manager. Nothing is there until its end.

    Memory grows by the codes: some 24 bytes a vector.
    """

    def __init__(self, folder: Path, name: str, trained: Trained, base: int) -> None:
        self.folder, self.name, self.base = Path(folder), name, base
        self._trained = trained
        self._index = trained.empty_index()
        self._rows = 0
        self._writing = replacing(self.folder / f"{name}.vectors.npy")

    def __enter__(self) -> "ShardWriter":
        self._file = self._writing.__enter__().open("wb")
        self._header()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self._file.seek(0)
                self._header()
                remove_shard(self.folder, self.name)  # what the new files are to replace
        finally:
            self._file.close()
            self._writing.__exit__(kind, error, trace)
        if kind is None:
            self._finish()

    def add(self, vectors: NDArray[np.floating[Any]]) -> None:
        """Take in unit vectors (N, D), whose ids follow those before."""
        if vectors.ndim != 2 or vectors.shape[1] != self._trained.dims:
            raise AtlasError(f"vectors must be (N, {self._trained.dims}), got {vectors.shape}")
        for start in range(0, len(vectors), ADD_ROWS):
            stored = np.ascontiguousarray(vectors[start : start + ADD_ROWS], dtype=np.float16)
            if not np.isfinite(stored).all():
                raise AtlasError("vectors of an index must be finite")
            self._file.write(stored.data)
            with one_thread():
                self._index.add(self._trained.turned(stored.astype(np.float32)))
        self._rows += len(vectors)

    def _header(self) -> None:
        """NumPy's header, which leaves room for more rows than are there yet."""
        shape = (self._rows, self._trained.dims)
        about = {"descr": "<f2", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(self._file, about)

    def _finish(self) -> None:
        table = np.zeros((self._trained.recipe.lists, 3), dtype=np.uint64)
        with replacing(self.folder / f"{self.name}.codes") as path, path.open("wb") as out:
            for number, codes, rows in self._lists():
                table[number] = len(rows), len(codes) // self._trained.recipe.code_bytes, out.tell()
                out.write(codes.data)
                out.write(np.pad(rows, (0, int(table[number, 1]) - len(rows))).data)
            if out.tell() == 0:
                out.write(bytes(BLOCK))  # an empty file cannot be mapped
        with replacing(self.folder / f"{self.name}.lists.npy") as path:
            np.save(path, table)
        Shard(self.name, self.base, self._rows, self._trained.digest).write(self.folder)

    def _lists(self) -> Iterator[tuple[int, NDArray[np.uint8], Ids]]:
        """Number, codes in blocks, and rows of each list that has any."""
        module, lists = faiss(), self._index.invlists
        for number in range(self._trained.recipe.lists):
            size = lists.list_size(number)
            if size == 0:
                continue
            room = -(-size // BLOCK) * BLOCK * self._trained.recipe.code_bytes
            codes = module.rev_swig_ptr(lists.get_codes(number), room)
            rows = module.rev_swig_ptr(lists.get_ids(number), size)
            yield number, np.asarray(codes), np.asarray(rows, dtype=np.int64)


def remove_shard(folder: Path, name: str) -> None:
    """Remove a shard if it is there, its manifest first."""
    try:
        for part in ("json", "retired.npy", *PARTS):
            (Path(folder) / f"{name}.{part}").unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"cannot remove a shard ({error}): {folder}") from error


def retire_rows(folder: Path, name: str, rows: Ids) -> None:
    """Make rows of a shard no longer count, beside those that already do not."""
    path = Path(folder) / f"{name}.retired.npy"
    before = np.load(path) if path.is_file() else np.empty(0, dtype=np.int64)
    with replacing(path) as temporary:
        np.save(temporary, np.union1d(before, np.asarray(rows, dtype=np.int64)))


class OpenShard:
    """A shard's files: lists are mapped; vectors are read row by row, for the system would map a
    megabyte around each. `retired` are rows, sorted."""

    def __init__(self, folder: Path, shard: Shard, trained: Trained) -> None:
        if shard.trained != trained.digest:
            raise AtlasError(
                f"shard was made with other quantizers than {TRAINED_NAME}; index anew: {folder}"
            )
        self.shard = shard
        try:
            path = folder / f"{shard.name}.vectors.npy"
            vectors = np.load(path, mmap_mode="r")
            table = np.load(folder / f"{shard.name}.lists.npy")
            codes_bytes = (folder / f"{shard.name}.codes").stat().st_size
            retired = folder / f"{shard.name}.retired.npy"
            self.retired: Ids = np.load(retired) if retired.is_file() else np.empty(0, np.int64)
        except (OSError, ValueError) as error:
            raise AtlasError(f"shard cannot be read ({error}): {folder / shard.name}") from error
        if vectors.shape != (shard.rows, trained.dims) or vectors.dtype != np.float16:
            raise AtlasError(
                f"shard holds {vectors.shape} {vectors.dtype}, not {shard.rows} vectors of "
                f"{trained.dims} halves; index anew: {path}"
            )
        self._dims, self._offset = trained.dims, path.stat().st_size - vectors.nbytes
        self._file = os.open(path, os.O_RDONLY)
        weakref.finalize(self, os.close, self._file)
        if hasattr(os, "posix_fadvise"):
            os.posix_fadvise(self._file, 0, 0, os.POSIX_FADV_RANDOM)
        self._index = trained.empty_index()
        self._map_lists(folder / f"{shard.name}.codes", codes_bytes, table, trained)

    def _map_lists(
        self, path: Path, size: int, table: NDArray[np.uint64], trained: Trained
    ) -> None:
        """Let FAISS scan the lists where they lie in the file."""
        module, recipe = faiss(), trained.recipe
        _check_table(table, recipe.lists, recipe.code_bytes, size, path)
        if int(table[:, 0].sum()) != self.shard.rows:
            raise AtlasError(f"lists hold {table[:, 0].sum()} of {self.shard.rows}: {path}")
        mapped = module.OnDiskInvertedLists(recipe.lists, recipe.code_bytes, str(path))
        mapped.lists.resize(recipe.lists)
        contents = np.ascontiguousarray(table)
        module.memcpy(mapped.lists.data(), module.swig_ptr(contents), contents.nbytes)
        mapped.totsize, mapped.read_only, mapped.prefetch_nthread = size, True, 0
        mapped.do_mmap()
        self._index.replace_invlists(mapped, False)
        self._index.ntotal = self.shard.rows
        self._index.referenced_objects.append(mapped)

    def scan(self, turned: Array, lists: Ids, scores: Array, count: int) -> tuple[Array, Ids]:
        """Approximate products (Q, count) and rows, best first, of the lists (Q, probes)."""
        module, index = faiss(), self._index
        found = np.empty((len(turned), count), dtype=np.float32)
        rows = np.empty((len(turned), count), dtype=np.int64)
        index.nprobe = lists.shape[1]
        index.implem = SCAN_ONE if len(turned) == 1 else 0
        point = module.swig_ptr
        index.search_preassigned_c(
            len(turned), point(turned), count, point(lists), point(scores),
            point(found), point(rows), False,
        )  # fmt: skip
        if rows.max(initial=NONE) >= self.shard.rows or rows.min(initial=NONE) < NONE:
            raise AtlasError(f"codes of shard {self.shard.name} are damaged; index anew")
        if len(self.retired):
            gone = np.isin(rows, self.retired)
            rows[gone], found[gone] = NONE, -np.inf
        return found, rows

    def take(self, rows: Ids) -> Array:
        """Stored vectors (N, D) of rows."""
        size, offset, file = 2 * self._dims, self._offset, self._file
        read = b"".join([os.pread(file, size, offset + size * row) for row in rows.tolist()])
        return self._decoded(read)

    def blocks(self) -> Iterator[tuple[int, Array]]:
        """First row and stored vectors (n, D) of one block after the other."""
        size = 2 * self._dims
        for start in range(0, self.shard.rows, BLOCK_ROWS):
            count = min(BLOCK_ROWS, self.shard.rows - start)
            read = os.pread(self._file, size * count, self._offset + size * start)
            yield start, self._decoded(read)

    def _decoded(self, read: bytes) -> Array:
        halves = np.frombuffer(read, dtype=np.float16)
        return halves.astype(np.float32).reshape(-1, self._dims)


def _check_table(
    table: NDArray[np.uint64], lists: int, code_bytes: int, size: int, path: Path
) -> None:
    """Raise `AtlasError` unless every list lies within the file."""
    fits = table.shape == (lists, 3) and table.dtype == np.uint64
    if fits:
        count, room, offset = table.astype(np.float64).T
        ends = offset + room * (code_bytes + 8)
        fits = bool(((count <= room) & (ends <= size) & (room % BLOCK == 0)).all())
    if not fits:
        raise AtlasError(f"lists do not fit their file; index anew: {path}")
