"""Grey levels of the images that callers have: grey or colour, integer or floating point."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError

EXPECTED = (
    "expected (H, W) grey, (H, W, 3) BGR or (H, W, 4) BGRA; uint8, uint16 (white is 65535) or "
    "floating point (0 to 1, or 0 to 255)"
)


def grey_levels(image: Any) -> NDArray[np.uint8]:
    """Grey levels (H, W) uint8 of a grey, BGR or BGRA image; uint8 grey is returned as it is.

    uint16 counts to 65535, floating point to 1 where no value is above 1, else to 255. Raises
    `FlightError`."""
    if isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.ndim == 2 and image.size:
        return image
    if image is None:
        raise FlightError(f"the image is None, as of a file that could not be read; {EXPECTED}")
    array = np.asarray(image)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    colour = array.ndim == 3 and array.shape[2] in (3, 4)
    if not (array.ndim == 2 or colour) or array.size == 0:
        raise FlightError(f"the image has the shape {array.shape}; {EXPECTED}")
    levels = _levels(array)
    if not colour:
        return levels
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(levels[:, :, :3]), cv2.COLOR_BGR2GRAY))


def _levels(array: NDArray[Any]) -> NDArray[np.uint8]:
    if array.dtype == np.uint8:
        return array
    if array.dtype == np.uint16:
        return (array >> 8).astype(np.uint8)  # as OpenCV reads files of 16 bits
    if array.dtype.kind not in "iuf":
        raise FlightError(f"the image has values of type {array.dtype}; {EXPECTED}")
    low, high = float(array.min()), float(array.max())
    if not (low >= 0 and high <= 255):  # NaN too
        raise FlightError(f"the image has values of {low:g} to {high:g}; {EXPECTED}")
    scale = 255.0 if array.dtype.kind == "f" and high <= 1 else 1.0
    return np.rint(array * scale).astype(np.uint8)
