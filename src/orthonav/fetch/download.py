"""Parallel fetching of the cells of a selection; each is stored as soon as it arrives."""

import logging
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing.pool import ThreadPool

import numpy as np

from orthonav.errors import FetchError, OutputError
from orthonav.fetch.cache import FileCache
from orthonav.fetch.client import Client
from orthonav.fetch.grid import Selection
from orthonav.fetch.service import CellSource
from orthonav.files import Progress

GIVE_UP_AFTER = 20
"""Failed cells in a row after which the service counts as down."""
PLACEHOLDER_CELLS = 2
"""Cells with identical bytes from which they count as a placeholder: no two orthophotos agree."""
log = logging.getLogger(__name__)


@dataclass(eq=False)
class FetchedCells:
    """What became of the cells of a selection: first fetched, then written."""

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
    fetched = FetchedCells(np.zeros(len(cells), dtype=np.uint64))
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
