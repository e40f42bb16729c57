"""Means of a representation over micro-cells, computed once for tiles that overlap."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import UsageError

MICRO = 32  # along one side of a tile


@dataclass(frozen=True)
class CellLayout:
    """Micro-cells of `micro_px`, every `spacing_px`."""

    micro_px: int
    spacing_px: int

    @classmethod
    def for_tiles(cls, tile_px: int, stride_px: int) -> "CellLayout":
        """Raises `AreaError` if none serves all tiles."""
        if tile_px % MICRO:
            raise UsageError(f"tile_px must be a multiple of {MICRO} px, got {tile_px}")
        micro_px = tile_px // MICRO
        return cls(micro_px, math.gcd(micro_px, stride_px))

    @property
    def step(self) -> int:
        return self.micro_px // self.spacing_px

    def samples(self, size_px: int) -> int:
        return max(0, (size_px - self.micro_px) // self.spacing_px + 1)


def cell_means(
    maps: NDArray[np.float32], valid: NDArray[np.bool_], layout: CellLayout
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Of (C, H, W), valid share (h, w); sample (i, j) begins at spacing * (i, j)."""
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
