"""The whitened embedding: pooled oriented gradients, decorrelated on the reference area itself.

It is orthonav's default, not a method of Di Piazza et al. 2024.

Cells overlap with triangular weights, so that a shift moves energy gradually. Each is divided by
its own norm: contrast differs between years, directions do not. Principal components of the
reference tiles are divided by their standard deviations (whitening, Jegou and Chum, ECCV 2012).
Similarity is the scalar product of unit vectors."""

import contextlib
import math
import mmap
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from orthonav.core.cores import in_order
from orthonav.core.errors import MapFileError, UsageError
from orthonav.core.variants import Checked, Part, choice, within

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


PART_NOISE = 2.0
"""Where cells are missing, over the smallest variance kept (docs/decisions/embedding.md)."""
Made = TypeVar("Made")


@dataclass(frozen=True)
class WhitenedRecipe(Checked):
    """`cells`: along a side of a tile. `floor`: norm below which a cell counts as empty."""

    cells: int = choice(8, 1, 2, 4, 16, 32)
    dims: int = within(128, 1, 4096)
    floor: float = within(0.6, 0, above=True)

    def embedder(self, part: Part, channels: int) -> "WhitenedEmbedder":
        """From a map."""
        mean, basis = part("mean", np.float16, 1), part("basis", np.float16, 2)
        if not basis.shape[0] == mean.shape[0] == self.cells**2 * channels:
            raise MapFileError("map's embedding parts do not fit together")
        if not (np.isfinite(mean).all() and np.isfinite(basis).all()):
            raise MapFileError("map's embedding is not finite")
        return WhitenedEmbedder(self, mean, basis)

    @cached_property
    def pooling(self) -> NDArray[np.float32]:
        """(cells, MICRO): triangles two cells wide."""
        width = MICRO / self.cells
        micro = (np.arange(MICRO) + 0.5) / width
        centre = np.arange(self.cells) + 0.5
        weights = np.maximum(0, 1 - np.abs(micro[None] - centre[:, None])) / width
        return np.asarray(weights, dtype=np.float32)


class CellSheet:
    """Micro-cell means (h, w, C) and valid share (h, w) of a whole sheet, filled block by block."""

    def __init__(self, layout: CellLayout, height_px: int, width_px: int, channels: int) -> None:
        shape = (layout.samples(height_px), layout.samples(width_px))
        self.layout = layout
        self.means = _sparse_zeros((*shape, channels))
        self.valid = _sparse_zeros(shape)

    def fill(
        self, row_px: int, col_px: int, maps: NDArray[np.float32], valid: NDArray[np.bool_]
    ) -> None:
        """Take in maps (C, H, W) and valid (H, W) of the block that starts at a sampled pixel."""
        self.put(row_px, col_px, *cell_means(maps, valid, self.layout))

    def put(
        self, row_px: int, col_px: int, means: NDArray[np.float32], share: NDArray[np.float32]
    ) -> None:
        row, col = row_px // self.layout.spacing_px, col_px // self.layout.spacing_px
        part = np.s_[row : row + share.shape[0], col : col + share.shape[1]]
        self.means[part], self.valid[part] = means, share

    def valid_share(self, tiles_px: NDArray[np.intp]) -> NDArray[np.float64]:
        """Of tiles whose first pixel (row, col) is in (N, 2)."""
        out = np.empty(len(tiles_px))
        for part in chunks(len(tiles_px)):
            cells = self.micro_cells(self.valid[..., None], tiles_px[part])
            out[part] = cells[..., 0].mean(axis=(1, 2))
        return out

    def micro_cells(
        self, samples: NDArray[np.float32], tiles_px: NDArray[np.intp]
    ) -> NDArray[np.float32]:
        """Of samples (h, w, C) a tile's (N, MICRO, MICRO, C). Raises `IndexError`."""
        step = self.layout.step
        height, width = (size - (MICRO - 1) * step for size in samples.shape[:2])
        down, right, deep = samples.strides
        # A view of all tiles: taken from it rows of cells are copied whole, four times as fast.
        windows = np.lib.stride_tricks.as_strided(
            samples,
            (max(0, height), max(0, width), MICRO, MICRO, samples.shape[2]),
            (down, right, down * step, right * step, deep),
            writeable=False,
        )
        row, col = (tiles_px // self.layout.spacing_px).T
        return np.asarray(windows[row, col])


def _sparse_zeros(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Take memory where written; NumPy's huge pages would take megabytes for one number."""
    size = math.prod(shape)
    if 4 * size < 32 * 2**20:
        return np.zeros(shape, dtype=np.float32)
    pages = mmap.mmap(-1, 4 * size)
    if hasattr(mmap, "MADV_NOHUGEPAGE"):
        with contextlib.suppress(OSError):  # a kernel without them
            pages.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(pages, dtype=np.float32).reshape(shape)


def pooled_features(
    recipe: WhitenedRecipe, sheet: CellSheet, tiles_px: NDArray[np.intp]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Features and weights (N, F), the valid fraction of a cell, of tiles by their first pixels."""
    features = _normalized(recipe, _pooled_tiles(recipe, sheet, tiles_px))
    count, channels = len(tiles_px), features.shape[-1]
    valid = sheet.micro_cells(sheet.valid[..., None], tiles_px)
    if valid.min() >= 1:
        weights = np.ones((1, 1), dtype=np.float32)
        return features.reshape(count, -1), np.broadcast_to(weights, (count, features[0].size))
    full = _pooled(recipe, np.ones_like(valid[:1]))
    share = np.repeat(_pooled(recipe, valid) / full, channels, axis=-1)
    return features.reshape(count, -1), share.reshape(count, -1)


def _normalized(recipe: WhitenedRecipe, cells: NDArray[np.float32]) -> NDArray[np.float32]:
    """Each cell divided by its norm; with one channel the tile as a whole, without its mean."""
    axes: tuple[int, ...] = (-1,)
    if cells.shape[-1] == 1:
        cells = cells - cells.mean(axis=(1, 2), keepdims=True)
        axes = (1, 2, 3)
    power = np.sum(cells**2, axis=axes, keepdims=True)
    return np.asarray(cells / np.sqrt(power + np.float32(recipe.floor) ** 2))


def _pooled(recipe: WhitenedRecipe, micro: NDArray[np.float32]) -> NDArray[np.float32]:
    """Cells (N, cells, cells, C) of micro-cells (N, MICRO, MICRO, C)."""
    count, _, _, channels = micro.shape
    cells = recipe.cells
    rows = recipe.pooling @ micro.reshape(count, MICRO, MICRO * channels)
    cols = rows.reshape(count, cells, MICRO, channels).transpose(0, 1, 3, 2) @ recipe.pooling.T
    return np.ascontiguousarray(cols.transpose(0, 1, 3, 2))


def _pooled_tiles(
    recipe: WhitenedRecipe, sheet: CellSheet, tiles_px: NDArray[np.intp]
) -> NDArray[np.float32]:
    """The same of tiles; what those beside each other share is summed once."""
    step, cells, channels = sheet.layout.step, recipe.cells, sheet.means.shape[2]
    reach = (MICRO - 1) * step + 1
    row, col = (tiles_px // sheet.layout.spacing_px).T
    out = np.empty((len(tiles_px), cells, cells, channels), dtype=np.float32)
    for some in np.split(np.arange(len(row)), np.flatnonzero(np.diff(row)) + 1):
        first, last = int(col[some].min()), int(col[some].max()) + reach
        strip = sheet.means[row[some[0]] : row[some[0]] + reach : step, first:last]
        if strip.shape[:2] != (MICRO, last - first) or last - first > len(some) * reach:
            # Far apart they share nothing (or a tile lies beyond the sheet).
            out[some] = _pooled(recipe, sheet.micro_cells(sheet.means, tiles_px[some]))
            continue
        down = recipe.pooling @ strip.reshape(MICRO, -1)
        down = down.reshape(cells, -1, channels).swapaxes(0, 1).reshape(-1, cells * channels)
        windows = sliding_window_view(down, reach, axis=0)[col[some] - first, :, ::step]
        across = recipe.pooling @ windows.swapaxes(1, 2)
        out[some] = across.reshape(-1, cells, cells, channels).swapaxes(1, 2)
    return out


@dataclass(frozen=True, eq=False)
class WhitenedEmbedder:
    """`mean` (F,) and `basis` (F, D) float16 as stored in the map; computed in float32."""

    recipe: WhitenedRecipe
    mean: NDArray[np.float16]
    basis: NDArray[np.float16]

    @cached_property
    def _mean(self) -> NDArray[np.float32]:
        return self.mean.astype(np.float32)

    @cached_property
    def _basis(self) -> NDArray[np.float32]:
        return self.basis.astype(np.float32)

    @property
    def dims(self) -> int:
        return int(self.basis.shape[1])

    def tiles(
        self, sheet: CellSheet, tiles_px: NDArray[np.intp], workers: int = 1
    ) -> NDArray[np.float16]:
        """(N, D), the same for any number of `workers`."""
        out = np.empty((len(tiles_px), self.dims), dtype=np.float16)
        _ = self._mean, self._basis  # made before threads ask for them

        def fill(part: slice) -> None:
            features, weights = pooled_features(self.recipe, sheet, tiles_px[part])
            out[part] = self.features(features, weights)

        for _ in in_order(fill, chunks(len(tiles_px)), workers):
            pass
        return out

    def features(
        self, features: NDArray[np.float32], weights: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        return _unit(((features - self._mean) * weights) @ self._basis)

    def view(self, maps: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        """(D,), zero if empty. Raises `ValueError` unless a square of a multiple of `MICRO`."""
        channels, height, width = maps.shape
        if height != width or height % MICRO:
            raise ValueError(f"view must be square, a multiple of {MICRO} px, got {maps.shape}")
        sheet = CellSheet(CellLayout(height // MICRO, height // MICRO), height, width, channels)
        sheet.fill(0, 0, maps, valid)
        origin = np.zeros((1, 2), dtype=np.intp)
        features, weights = pooled_features(self.recipe, sheet, origin)
        centred = (features - self._mean)[0]
        if weights.min() < 1:
            return _unit(self._from_part(centred, weights[0]))
        return _unit(centred @ self._basis)

    def _from_part(
        self, centred: NDArray[np.float32], weights: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Components (D,) of a view in which cells are missing or partly seen.

        They are not orthogonal on the rest of the tile, so the conditional mean of probabilistic
        PCA is solved for (Tipping and Bishop 1999). In reference tiles missing cells stay at the
        mean: solved for, tiles with little imagery attract too many views."""
        loadings = self._loadings
        seen = loadings.T * (weights / PART_NOISE)
        normal = seen @ loadings + np.eye(self.dims, dtype=np.float32)
        return np.asarray(np.linalg.solve(normal, seen @ centred))

    def cells(self, cells: NDArray[np.float32], valid: NDArray[np.float32]) -> NDArray[np.float32]:
        """(Q, D) of many views, as `view`; sums of micro-cells by `recipe.pooling`, and of their
        shares."""
        out = np.empty((len(cells), self.dims), dtype=np.float32)
        along = self.recipe.pooling.sum(axis=1)
        shares = (valid / np.outer(along, along)).reshape(len(cells), -1)
        for part in chunks(len(cells)):
            features = _normalized(self.recipe, cells[part])
            centred = features.reshape(len(features), -1) - self._mean
            out[part] = centred @ self._basis
            # Resampling rounds: a cell seen to a thousandth less counts as whole.
            missing = shares[part].min(axis=1) < 1 - 1e-3
            if missing.any():
                weights = np.repeat(shares[part][missing], cells.shape[-1], axis=-1)
                out[part][missing] = self._from_parts(centred[missing], weights)
        return _unit(out)

    def _from_parts(
        self, centred: NDArray[np.float32], weights: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """`_from_part` of many views (Q, D), by conjugate gradients, preconditioned as if every
        cell had the mean weight: a twentieth of the time."""
        loadings = self._loadings
        noisy = weights / np.float32(PART_NOISE)
        power = np.square(loadings).sum(axis=0)
        shrink = np.reciprocal(noisy.mean(axis=1, keepdims=True) * power + np.float32(1))
        wanted = (centred * noisy) @ loadings
        solved = shrink * wanted
        residual = wanted - self._normal(solved, noisy)
        step = shrink * residual
        fit, tiny = _dots(residual, step), np.float32(1e-30)
        for _ in range(6):
            response = self._normal(step, noisy)
            length = fit / np.maximum(_dots(step, response), tiny)
            solved += length * step
            residual -= length * response
            scaled = shrink * residual
            before, fit = fit, _dots(residual, scaled)
            step = scaled + (fit / np.maximum(before, tiny)) * step
        return np.asarray(solved)

    def _normal(
        self, components: NDArray[np.float32], noisy: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """The normal matrices of `_from_part` times components (Q, D)."""
        loadings = self._loadings
        return np.asarray(components + ((components @ loadings.T) * noisy) @ loadings)

    @cached_property
    def _loadings(self) -> NDArray[np.float32]:
        """Features (F, D) per unit of each whitened component, smallest variance kept = 1."""
        norms = np.linalg.norm(self._basis, axis=0)
        return np.asarray(self._basis / norms**2 * norms.max())

    def parts(self) -> dict[str, NDArray[Any]]:
        return {"mean": self.mean, "basis": self.basis}


def _unit(vectors: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    norms = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(norms, 1e-12), dtype=np.float32)


def _dots(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(np.einsum("qd,qd->q", first, second)[:, None])


def chunks(count: int) -> list[slice]:
    """Of so many tiles."""
    # 512 are 0.9 MB of features, which stays in the cache.
    return [slice(start, min(count, start + 512)) for start in range(0, count, 512)]
