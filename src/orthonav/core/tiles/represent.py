"""Image representations that are compared: grey levels, edges or gradients.

`variant(grey, valid)` with (H, W) uint8 and bool gives float32 `(C, H, W)`, zero where not valid.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import VariantError
from orthonav.core.variants import Variant

TABLE = {
    "gradient": Variant("orthonav.core.tiles.gradients:OrientedGradients"),
    "gray": Variant("orthonav.core.tiles.represent:Gray"),
    "canny": Variant("orthonav.core.tiles.represent:Canny"),
    "segments": Variant("orthonav.research.segments:Segments", extra="segments"),
    "onnx": Variant("orthonav.core.tiles.learned:LearnedEdges", extra="neural"),
    "sam": Variant("orthonav.research.sam:SamBoundaries", flies=False, extra="train"),
}


@dataclass(frozen=True)
class Gray:
    """0..1, (1, H, W): the baseline of Di Piazza et al. 2024."""

    @property
    def channels(self) -> int:
        return 1

    @property
    def margin_px(self) -> int:
        return 0

    def __call__(self, grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        return np.where(valid, grey, 0).astype(np.float32)[None] / np.float32(255)


@dataclass(frozen=True)
class Canny:
    """Binary edges, by default as in Di Piazza et al. 2024, section 4.

    `low`, `high`: hysteresis on the Sobel gradient (L1 norm, 8-bit grey), `kernel`: aperture (3, 5,
    7)."""

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
        return 1

    @property
    def margin_px(self) -> int:
        """Without hysteresis."""
        return self.kernel // 2 + 2

    def __call__(self, grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        """None along the border of `valid`."""
        edges = cv2.Canny(np.ascontiguousarray(grey), self.low, self.high, apertureSize=self.kernel)
        if not valid.all():
            reach = self.kernel + 2
            edges = edges * cv2.erode(
                valid.astype(np.uint8), np.ones((reach, reach), np.uint8), borderValue=1
            )
        return (edges > 0).astype(np.float32)[None]
