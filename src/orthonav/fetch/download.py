"""Parallel fetching of the cells of a selection; each is stored as soon as it arrives."""

import logging
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from queue import SimpleQueue
from threading import Thread

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
_AHEAD = 4
"""Jobs queued per thread."""
_JOIN_S = 1.0
"""Longest wait for the threads after an error or an interrupt."""
log = logging.getLogger(__name__)


@dataclass(eq=False)
class FetchedCells:
    """Result of a download."""

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

    @property
    def placeholders(self) -> np.ndarray:
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
    cells = selection.cells
    fetched = FetchedCells(np.zeros(len(cells), dtype=np.uint64))
    in_a_row = 0
    with _Pool(client) as pool:
        jobs = ((n, int(row), int(col)) for n, (row, col) in enumerate(cells))
        for done, outcome in enumerate(pool.run(source, cache, jobs), start=1):
            number, error, digest, cached = outcome
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


Job = tuple[int, int, int]
Outcome = tuple[int, FetchError | None, int, bool]


class _Pool:
    """Threads that fetch cells. After an error or an interrupt it does not wait for slow answers.

    Its threads are daemons: those of `ThreadPoolExecutor` would delay the end of the program until
    the last server has answered.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._jobs: SimpleQueue[Job | None] = SimpleQueue()
        self._outcomes: SimpleQueue[Outcome | Exception] = SimpleQueue()
        self._threads: list[Thread] = []

    def __enter__(self) -> "_Pool":
        return self

    def __exit__(self, kind: object, *rest: object) -> None:
        if kind is not None:
            self._client.turns.stop.set()
        for _ in self._threads:
            self._jobs.put(None)
        until_s = time.monotonic() + _JOIN_S
        for thread in self._threads:
            thread.join(None if kind is None else max(0.0, until_s - time.monotonic()))

    def run(self, source: CellSource, cache: FileCache, jobs: Iterator[Job]) -> Iterator[Outcome]:
        """Outcomes as they arrive; only a few jobs are queued ahead, however many there are."""
        parallel = self._client.limits.parallel
        for number in range(parallel):
            thread = Thread(
                target=self._work, args=(source, cache), name=f"fetch-{number}", daemon=True
            )
            thread.start()
            self._threads.append(thread)
        waiting = 0
        while True:
            for job in islice(jobs, _AHEAD * parallel - waiting):
                self._jobs.put(job)
                waiting += 1
            if not waiting:
                return
            outcome = self._outcomes.get()
            waiting -= 1
            if isinstance(outcome, Exception):
                raise outcome
            yield outcome

    def _work(self, source: CellSource, cache: FileCache) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                self._outcomes.put(_fetch_one(source, cache, self._client, job))
            except Exception as error:
                self._outcomes.put(error)
                if self._client.turns.stop.is_set():
                    return


def _fetch_one(source: CellSource, cache: FileCache, client: Client, job: Job) -> Outcome:
    """Number, error, digest of the image (0 where there is none), whether it was in the cache."""
    number, row, col = job
    address = source.address(row, col)
    entry = cache.read(address)
    cached = entry is not None
    if entry is None:
        try:
            body = source.fetch(client, row, col)
        except OutputError:
            raise
        except FetchError as error:
            return number, error, 0, False
        cache.write(address, body)
        entry = cache.read(address)
        if entry is None:
            raise OutputError(f"a stored cell cannot be read back: {cache.folder}")
    if entry.body is None:
        return number, None, 0, cached
    return number, None, int.from_bytes(entry.digest[:8], "little") or 1, cached
