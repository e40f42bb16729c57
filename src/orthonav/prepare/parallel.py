"""Work shared among threads, its results in order: NumPy, OpenCV and GDAL let go of Python's lock.

Each thread opens what it works with for itself, because GDAL's datasets belong to one thread.
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
"""Results that may wait, beside those being made, for one that takes longer."""


@dataclass(frozen=True)
class _Failed:
    error: BaseException


def in_order(
    items: Sequence[Item], opened: Callable[[], Worker[Item, Made]], workers: int
) -> Iterator[Made]:
    """What a worker makes of each item, in the order of the items.

    `opened` gives each thread its worker. At most `workers + AHEAD` items are begun and not yet
    taken. The first error, in the order of the items, is raised here; then, as when the caller
    ends early, the other threads are awaited, which finish what they are at and begin nothing new.
    """
    workers = min(workers, len(items))
    if workers > 1:
        yield from _Crew(items, opened).results(workers)
        return
    with opened() as work:
        for item in items:
            yield work(item)


class _Crew(Generic[Item, Made]):
    """Threads that take items from one queue; each item has a place for what is made of it."""

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
        at = slice(None)  # whoever waits, until an item is begun
        try:
            with self._opened() as work:
                while (index := self._todo.get()) is not None and not self._stop.is_set():
                    at = slice(index, index + 1)
                    self._done[index].put(work(self._items[index]))
        except BaseException as error:
            for place in self._done[at]:
                place.put(_Failed(error))
