"""Byte strings of a map that are read one by one."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MapFileError
from orthonav.core.mapfile.reader import MapFile


class Blobs:
    """Byte strings concatenated in one part of a map, with their offsets in another."""

    def __init__(self, opened: MapFile, data: str, offsets: str, count: int) -> None:
        """The `count` strings of the parts `data` and `offsets`.

        Raises `MapFileError` where the offsets do not fit.
        """
        size = opened.size_of(data, np.uint8, 1)
        self._opened, self._name = opened, data
        self._offsets: NDArray[Any] = opened.array(offsets, np.int64, 1)
        places = self._offsets
        sane = (
            len(places) == count + 1
            and places[0] == 0
            and places[-1] == size
            and bool((places[1:] >= places[:-1]).all())
        )
        if not sane:
            raise MapFileError(
                f"map part {offsets} must rise from 0 to {size} in {count + 1} numbers: "
                f"{opened.path}"
            )

    def is_empty(self, number: int) -> bool:
        """Whether a string has no bytes."""
        return bool(self._offsets[number] == self._offsets[number + 1])

    def blob(self, number: int) -> NDArray[np.uint8]:
        """The bytes of a string. Raises `MapChangedError`."""
        first, last = int(self._offsets[number]), int(self._offsets[number + 1])
        return np.frombuffer(self._opened.range(self._name, first, last), dtype=np.uint8)
