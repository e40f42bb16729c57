"""The scale expected at each place of the map, by a height above sea and the terrain below."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
SIGMAS = 3.0
"""A place is compared under scales within so many standard deviations of the expected one."""
HALF_STEP = 0.07
"""And half a step of the bank of scales farther."""


@dataclass(frozen=True, eq=False)
class ScaleMap:
    """Log scales (true over reported height) expected over a sheet.

    `values` (H, W): at nodes `step_px` apart, the first at (0, 0), x and y in pixels of level 0.
    `std`: their standard deviation.
    """

    values: Array
    step_px: float
    std: float

    def at(self, x_px: float, y_px: float) -> float:
        """The log scale expected at a place; beyond the sheet that of its border."""
        rows, cols = self.values.shape
        row = min(max(round(y_px / self.step_px), 0), rows - 1)
        col = min(max(round(x_px / self.step_px), 0), cols - 1)
        return float(self.values[row, col])

    def over(self, level: int, row: int, col: int, shape: tuple[int, int]) -> Array:
        """Log scales expected at the pixels of a window (H, W) of a level."""
        unit = 2.0**level / self.step_px
        matrix = np.array([[unit, 0, col * unit], [0, unit, row * unit]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        made = cv2.warpAffine(
            self.values, matrix, shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(made, np.float32)

    def reach(self, log_scale: float) -> tuple[float, float]:
        """Least and greatest expected log scale of the places where `log_scale` is compared."""
        off = SIGMAS * self.std + HALF_STEP
        return log_scale - off, log_scale + off
