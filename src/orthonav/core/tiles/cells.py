"""Means of a representation over small square cells: what the whitened embedding is made of.

A tile is divided into `MICRO` x `MICRO` micro-cells. Their means are computed once for a whole
sheet, at a spacing that fits both the micro-cells and the stride of the tiles, so overlapping
tiles share the work; a single view goes through the same code.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError

MICRO = 32
"""Micro-cells along one side of a tile."""


@dataclass(frozen=True)
class CellLayout:
    """How micro-cells of `micro_px` pixels are sampled every `spacing_px` pixels."""

    micro_px: int
    spacing_px: int

    @classmethod
    def for_tiles(cls, tile_px: int, stride_px: int) -> "CellLayout":
        """Layout that serves all tiles `stride_px` apart. Raises `AreaError` if there is none."""
        if tile_px % MICRO:
            raise AreaError(f"tile width must be a multiple of {MICRO} px, got {tile_px}")
        micro_px = tile_px // MICRO
        return cls(micro_px, math.gcd(micro_px, stride_px))

    @property
    def step(self) -> int:
        """Samples from one micro-cell of a tile to the next."""
        return self.micro_px // self.spacing_px

    def samples(self, size_px: int) -> int:
        """How many micro-cells begin, and end, within `size_px` pixels."""
        return max(0, (size_px - self.micro_px) // self.spacing_px + 1)


def cell_means(
    maps: NDArray[np.float32], valid: NDArray[np.bool_], layout: CellLayout
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Means (h, w, C) of maps (C, H, W) over micro-cells, and the share of valid pixels (h, w).

    Sample (i, j) is the micro-cell whose first pixel is row i * spacing, column j * spacing.
    """
    shape = (layout.samples(maps.shape[1]), layout.samples(maps.shape[2]))
    means = np.empty((*shape, len(maps)), dtype=np.float32)
    for channel, single in enumerate(maps):
        means[:, :, channel] = _sampled_means(single, shape, layout)
    if valid.all():
        return means, np.ones(shape, dtype=np.float32)
    return means, _sampled_means(valid.astype(np.float32), shape, layout)


def _sampled_means(
    single: NDArray[np.float32], shape: tuple[int, int], layout: CellLayout
) -> NDArray[np.float32]:
    size, spacing = layout.micro_px, layout.spacing_px
    rows, cols = shape
    if spacing == size:
        whole = np.ascontiguousarray(single[: rows * size, : cols * size])
        return np.asarray(cv2.resize(whole, (cols, rows), interpolation=cv2.INTER_AREA))
    # An even box has no centre pixel: anchor 0 makes the output pixel the box's first.
    boxes = cv2.boxFilter(
        single, cv2.CV_32F, (size, size), anchor=(0, 0), borderType=cv2.BORDER_REPLICATE
    )
    return np.asarray(boxes, dtype=np.float32)[::spacing, ::spacing][:rows, :cols]
