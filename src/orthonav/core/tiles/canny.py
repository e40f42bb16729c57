"""Canny edge maps, with the parameters of Di Piazza et al. 2024, section 4."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import VariantError


@dataclass(frozen=True)
class Canny:
    """Binary edges of the Canny detector; the paper's thresholds are 100 and 200, its kernel 3.

    `low` and `high` are the hysteresis thresholds on the Sobel gradient (L1 norm, 8-bit grey),
    `kernel` the Sobel aperture (3, 5 or 7).
    """

    low: float = 100.0
    high: float = 200.0
    kernel: int = 3

    def __post_init__(self) -> None:
        if not 0 <= self.low <= self.high:
            raise VariantError(f"canny needs 0 <= low <= high, got {self.low}, {self.high}")
        if self.kernel not in (3, 5, 7):
            raise VariantError(f"canny kernel must be 3, 5 or 7, got {self.kernel}")

    @property
    def channels(self) -> int:
        """Number of channels C."""
        return 1

    @property
    def margin_px(self) -> int:
        """Radius of influence of a pixel on the representation, without hysteresis."""
        return self.kernel // 2 + 2

    def __call__(self, grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Edges (1, H, W), 1 on an edge, else 0; none along the border of `valid`."""
        edges = cv2.Canny(np.ascontiguousarray(grey), self.low, self.high, apertureSize=self.kernel)
        if not valid.all():
            reach = self.kernel + 2
            edges = edges * cv2.erode(
                valid.astype(np.uint8), np.ones((reach, reach), np.uint8), borderValue=1
            )
        return (edges > 0).astype(np.float32)[None]
