"""The command line with one more representation: `--edges laplace`.

    python examples/own_representation.py build --ortho PAST.tif --edges laplace --out own.onav

takes every command and option of `orthonav`. Maps made with it fly with this program only.
"""

import sys
from dataclasses import dataclass

import cv2
import numpy as np

from orthonav.cli import main
from orthonav.core.tiles import represent
from orthonav.core.variants import Variant


@dataclass(frozen=True)
class Laplace:
    """How far a pixel stands out from its surroundings, (1, H, W)."""

    sigma_px: float = 2.0

    @property
    def channels(self):
        """Number of channels C."""
        return 1

    @property
    def margin_px(self):
        """How far a pixel's value can reach into the representation."""
        return int(np.ceil(4 * self.sigma_px)) + 1

    def __call__(self, grey, valid):
        """Absolute Laplacian (1, H, W) of grey (H, W) uint8; 0 where a neighbour is not valid."""
        smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), self.sigma_px)
        out = np.abs(cv2.Laplacian(smooth, cv2.CV_32F))
        reach = 2 * self.margin_px + 1
        near = np.ones((reach, reach), np.uint8)
        return (out * cv2.erode(valid.astype(np.uint8), near, borderValue=1))[None]


represent.TABLE["laplace"] = Variant(f"{__name__}:Laplace")

if __name__ == "__main__":
    sys.exit(main())
