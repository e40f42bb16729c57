"""Suppression of rasterio warnings about cases that are checked elsewhere, or intended."""

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from rasterio.errors import NodataShadowWarning, NotGeoreferencedWarning


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress them in all threads while this is open.

    Warning filters belong to the process, and threads that change them would interfere. So this
    does nothing outside the main thread; callers that start threads enter it for them.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        warnings.simplefilter("ignore", NodataShadowWarning)
        yield
