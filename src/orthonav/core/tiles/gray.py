"""Grey levels: the paper's baseline representation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Gray:
    """Grey levels scaled to 0..1, (1, H, W)."""

    @property
    def channels(self) -> int:
        """Number of channels C."""
        return 1

    @property
    def margin_px(self) -> int:
        """Radius of influence of a pixel on the representation."""
        return 0

    def __call__(self, grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Grey levels (1, H, W) in 0..1."""
        return np.where(valid, grey, 0).astype(np.float32)[None] / np.float32(255)
