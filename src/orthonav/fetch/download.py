"""Fetching the cells of a selection, several at a time, each kept as it comes."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator
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

GIVE_UP_AFTER = 20
"""So many cells in a row that fail, and the service is taken to be down."""
SAME_PICTURE = 2
"""Two cells that came with the very same bytes show a placeholder, not the ground."""
_AHEAD = 4
_PATIENCE_S = 1.0
Progress = Callable[[str, float], None]
log = logging.getLogger(__name__)


@dataclass(eq=False)
class Fetched:
    """What came: `digests` (N,) uint64 of the pictures by cell, 0 where there is none; reasons of
    failed cells with how many, and one example of each."""

    digests: np.ndarray
    from_cache: int = 0
    absent: int = 0
    failed: Counter[str] = field(default_factory=Counter)
    examples: dict[str, str] = field(default_factory=dict)

    @property
    def placeholders(self) -> np.ndarray:
        """Which cells (N,) hold a picture that another cell holds too."""
        values, inverse, counts = np.unique(self.digests, return_inverse=True, return_counts=True)
        return np.asarray((counts[inverse] >= SAME_PICTURE) & (values[inverse] != 0))


def fetch_cells(
    source: CellSource, selection: Selection, client: Client, cache: FileCache, progress: Progress
) -> Fetched:
    """Fetch every cell that is not in the cache yet.

    A cell that fails is counted, and the others go on, until many in a row fail: then raises
    `FetchError`; what came is kept in the cache. Raises `OutputError` where the disk refuses.
    """
    cells = selection.cells
    found = Fetched(np.zeros(len(cells), dtype=np.uint64))
    in_a_row = 0
    done = 0
    with _Pool(client) as pool:
        jobs = ((n, int(row), int(col)) for n, (row, col) in enumerate(cells))
        for number, error, digest, cached in pool.run(source, cache, jobs):
            done += 1
            if error is None:
                in_a_row = 0
                found.digests[number] = digest
                found.absent += digest == 0
                found.from_cache += cached
            else:
                in_a_row += 1
                _count(found, error)
                if in_a_row >= GIVE_UP_AFTER:
                    raise FetchError(f"{in_a_row} requests in a row failed, the last: {error}")
            progress("fetch", done / len(cells))
    return found


def _count(found: Fetched, error: FetchError) -> None:
    text = str(error)
    reason = text.partition(" (")[0].partition(": http")[0]
    found.failed[reason] += 1
    found.examples.setdefault(reason, text)
    log.info("not fetched: %s", text)


Job = tuple[int, int, int]
Outcome = tuple[int, FetchError | None, int, bool]


class _Pool:
    """Threads that fetch. Left by an error or an interrupt, it does not wait for slow answers.

    The threads are daemons for that: those of the standard pool would hold up the end of the
    program until the last server has answered.
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
        until_s = time.monotonic() + _PATIENCE_S
        for thread in self._threads:
            thread.join(None if kind is None else max(0.0, until_s - time.monotonic()))

    def run(self, source: CellSource, cache: FileCache, jobs: Iterator[Job]) -> Iterator[Outcome]:
        """Outcomes as they come; only a few jobs are handed out ahead, however many there are."""
        for number in range(self._client.limits.parallel):
            thread = Thread(
                target=self._work, args=(source, cache), name=f"fetch-{number}", daemon=True
            )
            thread.start()
            self._threads.append(thread)
        waiting = 0
        while True:
            for job in islice(jobs, _AHEAD * self._client.limits.parallel - waiting):
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
                self._outcomes.put(_one(source, cache, self._client, job))
            except Exception as error:
                self._outcomes.put(error)
                if self._client.turns.stop.is_set():
                    return


def _one(source: CellSource, cache: FileCache, client: Client, job: Job) -> Outcome:
    """Number, error, digest of the picture (0 where there is none), whether it was in the cache."""
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
            raise OutputError(f"what was kept cannot be read back: {cache.folder}")
    if entry.body is None:
        return number, None, 0, cached
    return number, None, int.from_bytes(entry.digest[:8], "little") or 1, cached
