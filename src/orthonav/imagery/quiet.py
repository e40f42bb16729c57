"""Warnings of rasterio that say nothing new: what they warn of is checked, or meant."""

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from rasterio.errors import NodataShadowWarning, NotGeoreferencedWarning


@contextmanager
def quiet() -> Iterator[None]:
    """Keep them away meanwhile, in all threads.

    Filters of warnings belong to the process: threads that set and reset their own would mix them
    up. So this does nothing outside the main thread; whoever starts threads is quiet for them.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        warnings.simplefilter("ignore", NodataShadowWarning)
        yield
