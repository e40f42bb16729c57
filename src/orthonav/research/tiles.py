"""Reference tiles for training, cut on demand out of one sheet; no tile is stored.

"The reference area is divided into tiles (256x256)"; "the training set is made of images of the
reference area in a given year" (Di Piazza et al. 2024, section Dataset). Edges are extracted from
the sheet before tiles are cut out of it, unless tiles are given as `singles`.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class SheetTiles:
    """Tiles of one sheet picture, an array or a memory map."""

    pixels: NDArray[np.uint8]  # (C, H, W)
    valid: NDArray[np.bool_]  # (H, W), pixels that are imagery
    tiles_px: NDArray[np.integer[Any]]  # (N, 2), row and column of the first pixel of each tile
    tile_px: int  # side S of a tile, pixels
    scale: float = 255.0  # value that stands for 1.0: 255 for grey levels, 1 for edge maps
    grey: NDArray[np.uint8] | None = None
    """(H, W), the source of the positives of triplets; None: first channel of `pixels`."""
    singles: NDArray[np.uint8] | None = None
    """(N, C, S, S), tiles represented each by itself; None: they are cut out of `pixels`."""

    def __len__(self) -> int:
        return len(self.tiles_px)

    @property
    def channels(self) -> int:
        return int(self.pixels.shape[0])

    def batch(self, indices: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
        """Tiles (B, C, S, S) with the given indices (B,), 1.0 for `scale`, zero where not valid."""
        out = np.empty((len(indices), self.channels, self.tile_px, self.tile_px), np.float32)
        for row, index in enumerate(indices):
            part = self._part(int(index))
            raw = self.pixels[:, *part] if self.singles is None else self.singles[int(index)]
            self.scaled(raw, self.valid[part], out[row])
        return out

    def scaled(
        self, raw: NDArray[np.uint8], valid: NDArray[np.bool_], out: NDArray[np.float32]
    ) -> None:
        """Write raw (C, S, S) as float32 into `out` (C, S, S), zero where not valid (S, S)."""
        np.multiply(raw, valid, out=out, casting="unsafe")
        out /= np.float32(self.scale)

    def grey_tile(self, index: int) -> NDArray[np.uint8]:
        """Grey levels (S, S) of a tile, a copy."""
        part = self._part(index)
        picture = self.pixels[0] if self.grey is None else self.grey
        return np.array(picture[part])

    def valid_tile(self, index: int) -> NDArray[np.bool_]:
        """Mask (S, S) of the pixels of a tile that are imagery."""
        return self.valid[self._part(index)]

    def _part(self, index: int) -> tuple[slice, slice]:
        row, col = (int(first) for first in self.tiles_px[index])
        return slice(row, row + self.tile_px), slice(col, col + self.tile_px)


def epoch_batches(count: int, batch: int, seed: int, epoch: int) -> list[NDArray[np.intp]]:
    """Batches of an epoch: indices below `count`, in random order.

    Batches hold at most `batch` tiles, nearly the same number each, and at least 2; to make that
    possible a tile may be repeated.
    """
    order = np.random.default_rng([seed, epoch]).permutation(count)
    parts = np.array_split(order, math.ceil(count / batch))
    return [np.resize(part, max(len(part), min(2, batch))) for part in parts]
