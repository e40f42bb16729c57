"""Ordered results of work in threads; NumPy, OpenCV and GDAL release the interpreter lock.

`ThreadPoolExecutor.map` is not used: it submits all items at once, which would fill memory with
results, and a GDAL dataset must be opened and closed by the thread that uses it.
"""

import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Generic, TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")
Worker = AbstractContextManager[Callable[[Item], Made]]
AHEAD = 2
"""Finished results that may wait for a slower one."""


@dataclass(frozen=True)
class _Failed:
    error: BaseException


def in_order(
    items: Sequence[Item], opened: Callable[[], Worker[Item, Made]], workers: int
) -> Iterator[Made]:
    """Results of a worker for each item, in the order of the items.

    `opened` opens the worker of each thread. At most `workers + AHEAD` items are started and not
    yet consumed. The first error, in the order of the items, is raised here. After an error, and if
    the caller stops early, the threads finish their current items and start no new ones.
    """
    workers = min(workers, len(items))
    if workers > 1:
        yield from _Crew(items, opened).results(workers)
        return
    with opened() as work:
        for item in items:
            yield work(item)


class _Crew(Generic[Item, Made]):
    """Threads that take items from one queue; each item has a queue for its result."""

    def __init__(self, items: Sequence[Item], opened: Callable[[], Worker[Item, Made]]) -> None:
        self._items, self._opened = items, opened
        self._todo: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        self._done: list[queue.SimpleQueue[Made | _Failed]] = [queue.SimpleQueue() for _ in items]
        self._stop = threading.Event()

    def results(self, workers: int) -> Iterator[Made]:
        threads = [threading.Thread(target=self._serve, daemon=True) for _ in range(workers)]
        try:
            for thread in threads:
                thread.start()
            for index in range(workers + AHEAD):
                self._begin(index)
            for index, place in enumerate(self._done):
                made = place.get()
                if isinstance(made, _Failed):
                    raise made.error
                self._begin(index + workers + AHEAD)
                yield made
        finally:
            self._stop.set()
            for _ in threads:
                self._todo.put(None)
            for thread in threads:
                thread.join()

    def _begin(self, index: int) -> None:
        if index < len(self._items):
            self._todo.put(index)

    def _serve(self) -> None:
        at = slice(None)  # all waiting items, until one is started
        try:
            with self._opened() as work:
                while (index := self._todo.get()) is not None and not self._stop.is_set():
                    at = slice(index, index + 1)
                    self._done[index].put(work(self._items[index]))
        except BaseException as error:
            for place in self._done[at]:
                place.put(_Failed(error))
