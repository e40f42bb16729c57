"""A cache in memory of limited size."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class ByteCache(Generic[Key, Value]):
    """The values that were used last, of at most `limit_bytes` in all; threads may share it.

    `size_of` returns the bytes of a value. `held_bytes`: those of all values held.
    """

    def __init__(self, limit_bytes: int, size_of: Callable[[Value], int]) -> None:
        self._limit_bytes, self._size_of = limit_bytes, size_of
        self._values: OrderedDict[Key, Value] = OrderedDict()
        self._lock = threading.Lock()
        self.held_bytes = 0

    def get(self, key: Key) -> Value | None:
        """The value of a key, or None."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
            return self._values.get(key)

    def put(self, key: Key, value: Value) -> None:
        """Hold a value, unless another thread was faster; those not used for longest are dropped.

        A value larger than the limit is not held, and no other one remains.
        """
        with self._lock:
            if key in self._values:
                return
            self._values[key] = value
            self.held_bytes += self._size_of(value)
            while self.held_bytes > self._limit_bytes:
                self.held_bytes -= self._size_of(self._values.popitem(last=False)[1])
