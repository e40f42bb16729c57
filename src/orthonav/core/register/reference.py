"""The map as registration sees it: evidence of windows, computed on demand."""

import math
import threading
from collections import OrderedDict
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.evidence import CHANNELS, FINE, EvidenceRecipe, evidence

Array = NDArray[np.float32]
LONGEST_PX = 32768
"""Longest side of an array that the kernel and OpenCV sample."""
WHOLE_LEVEL_PX = 2_000_000
"""Levels of up to so many pixels are made ready whole, once (16 bytes each)."""


class GreyPyramid(Protocol):
    """Grey levels of one sheet at several resolutions, each half as fine as the one before."""

    levels: int

    def shape(self, level: int) -> tuple[int, int]:
        """Rows and columns of a level."""
        ...

    def read(
        self, level: int, row: int, col: int, height: int, width: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Grey and valid (height, width) of a window, which may reach beyond the sheet."""
        ...


class Reference:
    """Evidence of one sheet. Safe to share between threads."""

    def __init__(self, pyramid: GreyPyramid) -> None:
        self.pyramid = pyramid
        self._whole: OrderedDict[tuple[int, EvidenceRecipe], Array] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def levels(self) -> int:
        """Number of levels; level 0 is the finest."""
        return self.pyramid.levels

    def shape(self, level: int) -> tuple[int, int]:
        """Rows and columns of a level."""
        return self.pyramid.shape(level)

    def caches(self, level: int) -> bool:
        """Whether the evidence of a level is made once and cached: where it is small enough."""
        return (
            math.prod(self.shape(level)) <= WHOLE_LEVEL_PX and max(self.shape(level)) <= LONGEST_PX
        )

    def whole(self, level: int, recipe: EvidenceRecipe = FINE) -> Array:
        """Evidence (H, W, 4) of a whole level, computed once."""
        with self._lock:
            key = (level, recipe)
            if key not in self._whole:
                made = evidence(*self.pyramid.read(level, 0, 0, *self.shape(level)), recipe)
                made.flags.writeable = False
                self._whole[key] = made
            return self._whole[key]

    def window(
        self, level: int, row: int, col: int, height: int, width: int, recipe: EvidenceRecipe = FINE
    ) -> Array:
        """Evidence (height, width, 4) of a window; zero beyond the sheet."""
        rows, cols = self.shape(level)
        if self.caches(level):
            return cut(self.whole(level, recipe), row, col, height, width)
        # No more than the sheet: a window beyond it costs nothing.
        margin = recipe.margin_px
        top, left = max(row - margin, 0), max(col - margin, 0)
        bottom, right = min(row + height + margin, rows), min(col + width + margin, cols)
        if top >= bottom or left >= right:
            return np.zeros((height, width, CHANNELS), np.float32)
        grey, valid = self.pyramid.read(level, top, left, bottom - top, right - left)
        return cut(evidence(grey, valid, recipe), row - top, col - left, height, width)


def cut(whole: Array, row: int, col: int, height: int, width: int) -> Array:
    """A window (height, width, C) of an array (H, W, C); zero beyond it. A view where possible."""
    rows, cols = whole.shape[:2]
    y0, x0, y1, x1 = max(row, 0), max(col, 0), min(row + height, rows), min(col + width, cols)
    if (y0, x0, y1, x1) == (row, col, row + height, col + width):
        return whole[y0:y1, x0:x1]
    out = np.zeros((height, width, whole.shape[2]), np.float32)
    if y0 < y1 and x0 < x1:
        out[y0 - row : y1 - row, x0 - col : x1 - col] = whole[y0:y1, x0:x1]
    return out
