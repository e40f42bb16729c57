"""Parallel fetching of the cells of a selection; each is stored on disk as soon as it arrives.

So an interrupted run resumes with the cells that are missing. There is one file per cell, named by
a hash of its address without keys. Each is written under a temporary name and renamed, and its
checksum is verified when it is read: a file that a kill or a full disk left incomplete counts as
missing.
"""

import hashlib
import logging
import os
import shutil
import threading
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing.pool import ThreadPool
from pathlib import Path

import numpy as np

from orthonav.core.errors import FetchError, OutputError
from orthonav.core.files import Progress
from orthonav.ground.fetch.client import Client
from orthonav.ground.fetch.grid import Selection
from orthonav.ground.fetch.service import CellSource

GIVE_UP_AFTER = 20
"""Failed cells in a row after which the service counts as down."""
PLACEHOLDER_CELLS = 2
"""Cells with identical bytes from which they count as a placeholder: no two orthophotos agree."""
_MAGIC = b"ORTHONAV-CELL-1\n"
_MARKER = "orthonav-fetch-cache"
_DIGEST = 32
_ABSENT, _IMAGE = b"-", b"+"
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class CachedCell:
    """A stored cell: `body`, or None where the service has no imagery; `digest` of it."""

    body: bytes | None
    digest: bytes


class FileCache:
    """Cells by address, in a folder; several threads may use it."""

    def __init__(self, folder: Path) -> None:
        """Raises `OutputError` where the folder cannot be created or holds other files."""
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            marker = self.folder / _MARKER
            if not marker.exists():
                if any(self.folder.iterdir()):
                    raise OutputError(
                        f"cache folder holds other files; choose an empty one: {self.folder}"
                    )
                marker.write_text("Answers of services, kept by orthonav fetch.\n")
        except OSError as error:
            if isinstance(error, OutputError):
                raise
            raise OutputError(
                f"cache folder cannot be used ({error.strerror or error}): {self.folder}"
            ) from error

    def read(self, address: str) -> CachedCell | None:
        """The stored cell, or None where there is none or it is damaged."""
        path = self._path(address)
        try:
            data = path.read_bytes()
        except OSError:
            return None
        head = len(_MAGIC) + 1 + _DIGEST
        magic, digest, body = data[: len(_MAGIC)], data[head - _DIGEST : head], data[head:]
        kind = data[len(_MAGIC) : len(_MAGIC) + 1]
        whole = magic == _MAGIC and hashlib.sha256(kind + body).digest() == digest
        if not whole or kind not in (_ABSENT, _IMAGE):
            path.unlink(missing_ok=True)
            return None
        return CachedCell(None if kind == _ABSENT else body, digest)

    def write(self, address: str, body: bytes | None) -> None:
        """Store a cell. Raises `OutputError` where it cannot be written."""
        kind = _ABSENT if body is None else _IMAGE
        digest = hashlib.sha256(kind + (body or b"")).digest()
        path = self._path(address)
        temporary = path.with_name(f"{path.name}.{os.getpid()}-{threading.get_ident()}.tmp")
        try:
            path.parent.mkdir(exist_ok=True)
            temporary.write_bytes(_MAGIC + kind + digest + (body or b""))
            temporary.replace(path)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            raise OutputError(
                f"cannot store a fetched cell ({error.strerror or error}): {self.folder}"
            ) from error

    def remove(self) -> None:
        """Remove the folder and its content."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, address: str) -> Path:
        name = hashlib.sha256(address.encode()).hexdigest()
        return self.folder / name[:2] / name[2:]


@dataclass(eq=False)
class FetchedCells:
    """What became of the cells of a selection: first fetched, then written."""

    source: CellSource
    """Where they come from."""
    selection: Selection
    """Which cells."""
    cache: FileCache
    """Where they are stored."""
    digests: np.ndarray
    """(N,) uint64 digest of each cell's image, 0 where there is none."""
    from_cache: int = 0
    """Cells that were in the cache already."""
    absent: int = 0
    """Cells without imagery, as the service reports."""
    failed: Counter[str] = field(default_factory=Counter)
    """Number of failed cells by reason."""
    examples: dict[str, str] = field(default_factory=dict)
    """One whole message for each reason."""
    images: int = 0
    """Cells with imagery that were written."""
    blank: int = 0
    """Cells that came without any imagery."""
    placeholders: int = 0
    """Cells that hold a placeholder."""
    valid_px: int = 0
    """Valid pixels of all cells that were written."""

    @property
    def are_placeholders(self) -> np.ndarray:
        """Which cells (N,) hold an image that another cell holds too."""
        values, inverse, counts = np.unique(self.digests, return_inverse=True, return_counts=True)
        return np.asarray((counts[inverse] >= PLACEHOLDER_CELLS) & (values[inverse] != 0))


def fetch_cells(
    source: CellSource, selection: Selection, client: Client, cache: FileCache, progress: Progress
) -> FetchedCells:
    """Fetch every cell that is not in the cache.

    A failed cell is counted and the others continue, until `GIVE_UP_AFTER` fail in a row: then
    raises `FetchError`. What arrived stays in the cache. Raises `OutputError` where it cannot be
    stored.
    """
    cells = selection.cells.tolist()
    fetched = FetchedCells(source, selection, cache, np.zeros(len(cells), dtype=np.uint64))
    in_a_row = 0

    def fetch_one(number: int) -> tuple[int, FetchError | None, int, bool]:
        try:
            return number, None, *_digest(source, cache, client, *cells[number])
        except FetchError as error:
            return number, error, 0, False

    # Its threads are daemons and are not joined. Those of `ThreadPoolExecutor` would delay the end
    # of the program after an error or an interrupt until the last server has answered.
    with ThreadPool(client.limits.parallel) as pool:
        outcomes = pool.imap_unordered(fetch_one, range(len(cells)))
        for done, (number, error, digest, cached) in enumerate(outcomes, start=1):
            if error is None:
                in_a_row = 0
                fetched.digests[number] = digest
                fetched.absent += digest == 0
                fetched.from_cache += cached
            else:
                in_a_row += 1
                _count(fetched, error)
                if in_a_row >= GIVE_UP_AFTER:
                    raise FetchError(f"{in_a_row} requests in a row failed, the last: {error}")
            progress("fetch", done / len(cells))
    return fetched


def _count(fetched: FetchedCells, error: FetchError) -> None:
    text = str(error)
    reason = text.partition(" (")[0].partition(": http")[0]
    fetched.failed[reason] += 1
    fetched.examples.setdefault(reason, text)
    log.info("not fetched: %s", text)


def _digest(
    source: CellSource, cache: FileCache, client: Client, row: int, col: int
) -> tuple[int, bool]:
    """Digest of a cell's image (0 where there is none), and whether it was in the cache."""
    address = source.address(row, col)
    entry = cache.read(address)
    cached = entry is not None
    if entry is None:
        cache.write(address, source.fetch(client, row, col))
        entry = cache.read(address)
        if entry is None:
            raise OutputError(f"a stored cell cannot be read back: {cache.folder}")
    if entry.body is None:
        return 0, cached
    return int.from_bytes(entry.digest[:8], "little") or 1, cached
