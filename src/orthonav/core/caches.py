"""A cache in memory of limited size."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class ByteCache(Generic[Key, Value]):
    """The values used last, of at most `limit_bytes` in all by `size_of`; threads may share it."""

    def __init__(self, limit_bytes: int, size_of: Callable[[Value], int]) -> None:
        self._limit_bytes, self._size_of = limit_bytes, size_of
        self._values: OrderedDict[Key, Value] = OrderedDict()
        self._lock = threading.Lock()
        self.held_bytes = 0

    def get(self, key: Key) -> Value | None:
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
            return self._values.get(key)

    def put(self, key: Key, value: Value) -> None:
        """Hold a value unless the key is held; a value larger than the limit empties the cache."""
        with self._lock:
            if key in self._values:
                return
            self._values[key] = value
            self.held_bytes += self._size_of(value)
            while self.held_bytes > self._limit_bytes:
                self.held_bytes -= self._size_of(self._values.popitem(last=False)[1])
