"""Memory that a thread uses again and again: fresh pages cost more than the arithmetic on them."""

import threading

import numpy as np
from numpy.typing import NDArray

_kept = threading.local()


def thread_memory(name: str, size: int) -> NDArray[np.float32]:
    """`size` numbers of this thread, the same ones at every call with that `name`.

    Who asks again under the same name overwrites what it held before.
    """
    found: NDArray[np.float32] | None = getattr(_kept, name, None)
    if found is None or found.size < size:
        found = np.empty(size, np.float32)
        setattr(_kept, name, found)
    return found[:size]
