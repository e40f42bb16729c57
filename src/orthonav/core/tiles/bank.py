"""A bank of directions: one view embedded under many headings and scales, its picture not turned.

The view is represented once and averaged to micro-cells; each of them samples `MICRO` x `MICRO` of
them, adds them up to cells and turns the phases of the harmonics: 50 us instead of 1.5 ms.
Gradients are taken at the reported resolution and micro-cells are not turned, but the bank sees
beyond the tile, and finds it no less often. Canny's edges come out less alike."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.tiles.whitened import MICRO, WhitenedEmbedder, WhitenedRecipe

Array = NDArray[np.float32]
Directions = NDArray[np.float64]


class Representation(Protocol):
    """One channel, or a magnitude and real and imaginary parts of harmonics 1, 2, .."""

    @property
    def channels(self) -> int:
        pass

    @property
    def margin_px(self) -> int:
        """How far a pixel's value can reach."""

    def __call__(self, grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> Array:
        pass


def embed_directions(
    embedder: WhitenedEmbedder,
    representation: Representation,
    grey: NDArray[np.uint8],
    valid: NDArray[np.bool_],
    directions: Sequence[tuple[float, float]],
    tile_px: int,
) -> Array:
    """Unit embeddings (Q, D) of a view under `directions`; zero where one sees nothing.

    `grey`, `valid` (H, W): heading up, at the reported resolution. A direction: true heading (rad)
    and log of true over reported resolution. Each is close to that of the tile about the view's
    middle, up to a third of scale. Raises `ValueError` for a bad `tile_px` or an unknown kind of
    representation."""
    channels = representation.channels
    if tile_px % MICRO or (channels > 1 and channels % 2 == 0):
        raise ValueError(
            f"tile must be a multiple of {MICRO} px and channels odd, got {tile_px}, {channels}"
        )
    if len(directions) == 0:
        return np.zeros((0, embedder.dims), dtype=np.float32)
    all_directions = np.asarray(directions, dtype=np.float64).reshape(-1, 2)
    thinned = _thinned(representation, grey, valid, all_directions, tile_px)
    side = embedder.recipe.cells
    sums = np.empty((len(directions), side, side, channels + 1), dtype=np.float32)
    for start in range(0, len(directions), 64):  # few enough for the processor's cache
        part = slice(start, start + 64)
        sums[part] = _pooled(embedder.recipe, thinned, all_directions[part], tile_px)
    return embedder.cells(_turned(sums[..., :channels], all_directions), sums[..., channels])


@dataclass(frozen=True, eq=False)
class _Thinned:
    """Averaged over `cell_px`, the valid share as the last; up to four channels a plane, which
    OpenCV resamples at once.

    `middle_px` (x, y): of the view's window, in its pixels."""

    planes: list[Array]
    middle_px: tuple[float, float]
    cell_px: int


def _thinned(
    representation: Representation,
    grey: NDArray[np.uint8],
    valid: NDArray[np.bool_],
    directions: Directions,
    tile_px: int,
) -> _Thinned:
    """The part of the view that the directions reach."""
    turns, log_scales = directions.T
    across = np.abs(np.cos(turns)) + np.abs(np.sin(turns))
    cell_px = tile_px // MICRO
    reach = float((tile_px / 2 * across * np.exp(-log_scales)).max())
    margin = cell_px + representation.margin_px
    rows, cols = (_around_middle(size, reach + margin) for size in grey.shape)
    middle = grey.shape[1] / 2 - cols.start, grey.shape[0] / 2 - rows.start
    grey, valid = grey[rows, cols], valid[rows, cols]
    channels = [*representation(grey, valid), valid.astype(np.float32)]
    small = [_averaged(channel, cell_px) for channel in channels]
    planes = [np.stack(small[first : first + 4], axis=-1) for first in range(0, len(small), 4)]
    return _Thinned(planes, middle, cell_px)


def _around_middle(size: int, reach: float) -> slice:
    start = max(0, math.floor(size / 2 - reach))
    return slice(start, size - start)


def _averaged(channel: Array, cell_px: int) -> Array:
    """Over squares of `cell_px`; beyond the border lie zeros."""
    if cell_px == 1:
        return channel
    height, width = channel.shape
    below, beside = -height % cell_px, -width % cell_px
    if below or beside:
        channel = np.asarray(
            cv2.copyMakeBorder(channel, 0, below, 0, beside, cv2.BORDER_CONSTANT), dtype=np.float32
        )
    size = (width + beside) // cell_px, (height + below) // cell_px
    small = cv2.resize(channel, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float32).reshape(size[1], size[0])


def _pooled(
    recipe: WhitenedRecipe, thinned: _Thinned, directions: Directions, tile_px: int
) -> Array:
    """Sums (Q, cells, cells, C + 1) of channels and valid share over a tile's cells."""
    x, y = _samples(thinned, directions, tile_px)
    count, cells = len(directions), recipe.cells
    pooled = []
    for plane in thinned.planes:
        sampled = cv2.remap(plane, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        rows = recipe.pooling @ np.asarray(sampled).reshape(count, MICRO, -1)
        # One large product: the second sum over all directions, rows and channels at once.
        spread = np.kron(recipe.pooling.T, np.eye(plane.shape[-1], dtype=np.float32))
        sums = rows.reshape(count * cells, -1) @ spread
        pooled.append(sums.reshape(count, cells, cells, -1))
    return np.concatenate(pooled, axis=-1)


def _samples(thinned: _Thinned, directions: Directions, tile_px: int) -> tuple[Array, Array]:
    """Middles of micro-cells, x and y (Q, MICRO * MICRO) each."""
    along = ((np.arange(MICRO) + 0.5) / MICRO - 0.5) * (tile_px / thinned.cell_px)
    east, south = np.tile(along, MICRO), np.repeat(along, MICRO)
    turns, log_scales = directions.T
    shrink = np.exp(-log_scales)
    cos, sin = (shrink * np.cos(turns))[:, None], (shrink * np.sin(turns))[:, None]
    # OpenCV counts from the middle of the first pixel, we from its corner.
    middle_x, middle_y = (value / thinned.cell_px - 0.5 for value in thinned.middle_px)
    x = cos * east + sin * south + middle_x
    y = cos * south - sin * east + middle_y
    return x.astype(np.float32), y.astype(np.float32)


def _turned(cells: Array, directions: Directions) -> Array:
    """Cells (Q, cells, cells, C) as on the map: harmonic k of the doubled direction turns by 2 k
    turns, and grey levels spread over more pixels where the view is coarser than reported."""
    channels = cells.shape[-1]
    if channels == 1:
        return np.ascontiguousarray(cells)
    turns, log_scales = directions.T
    gain = np.exp(-log_scales)[:, None]
    angles = 2 * turns[:, None] * np.arange(1, channels // 2 + 1)
    cos = (gain * np.cos(angles)).astype(np.float32)[:, None, None]
    sin = (gain * np.sin(angles)).astype(np.float32)[:, None, None]
    real, imaginary = cells[..., 1::2], cells[..., 2::2]
    out = np.empty(cells.shape, dtype=np.float32)
    out[..., 0] = cells[..., 0] * gain.astype(np.float32)[:, None]
    out[..., 1::2] = real * cos - imaginary * sin
    out[..., 2::2] = real * sin + imaginary * cos
    return out
