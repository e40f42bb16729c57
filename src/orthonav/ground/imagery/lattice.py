"""Orthophotos on one pixel lattice, such as the tiles of a producer, read as one image.

Resampled one by one, neighbouring tiles would leave a line of invalid pixels between them. They
are joined on their own pixels first and then resampled across the seam.
"""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.transform import Affine
from rasterio.windows import Window

from orthonav.core.caches import ByteCache
from orthonav.ground.imagery.source import Source
from orthonav.ground.imagery.thin import cells_of, read_thinned

MAX_OFF_PX = 0.05
"""Largest deviation of a tile from the lattice, pixels: far below the error of orthophotos."""
FULL = 1 - 1e-3
"""Weight from which a cell counts as filled: rounding of masks of 8 bits."""
MAX_CACHED_CELLS = 2 * 2**20
CACHE_BYTES = 192 * 2**20
"""Members of up to so many cells are cached, up to so many bytes in all."""
Cells = tuple[NDArray[Any], NDArray[np.float32]]
"""Means (C, h, w) and the share (h, w) of each that is valid."""

Thinned = tuple[NDArray[Any], NDArray[np.uint8], Affine]
"""Bands (C, h, w), mask (h, w) 0..255 and transform."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Sources on one pixel lattice; where several overlap, the first wins.

    `members` are indexes of the mosaic's sources. Pixel (0, 0) of the lattice is the corner that
    `transform` places; `boxes_px` (N, 4) are left, top, right, bottom of the members in it.
    `decoded` caches small members, for all threads.
    """

    members: tuple[int, ...]
    sources: tuple[Source, ...]
    transform: Affine
    boxes_px: NDArray[np.int64]
    decoded: "CellCache"

    @property
    def first(self) -> Source:
        """The source whose CRS, type and resolution all share."""
        return self.sources[0]

    @cached_property
    def size_px(self) -> tuple[int, int]:
        """Columns and rows that hold all members."""
        return int(self.boxes_px[:, 2].max()), int(self.boxes_px[:, 3].max())

    def factor(self, wanted: int) -> int:
        """Pixels per side that are averaged, at best `wanted`.

        Down to half of it, the largest factor with which cells end where tiles do, if any.
        """
        for factor in range(wanted, max(1, (wanted + 1) // 2) - 1, -1):
            if not (self.boxes_px % factor).any():
                return factor
        return wanted

    def read(self, window: Window, gsd_m: float, opened: Callable[[int], Any]) -> Thinned:
        """A window of the lattice, averaged to about `gsd_m` where that is coarser.

        `opened` gives the dataset of a member of the mosaic. Raises as rasterio does.
        """
        if len(self.members) == 1:
            return read_thinned(opened(self.members[0]), self.first, window, gsd_m)
        factor = self.factor(max(1, round(gsd_m / self.first.gsd_m)))
        left, top = window.col_off // factor, window.row_off // factor
        right = -(-(window.col_off + window.width) // factor)
        bottom = -(-(window.row_off + window.height) // factor)
        near = []
        for number in self._near(left * factor, top * factor, right * factor, bottom * factor):
            x0, y0, x1, y1 = (int(edge) for edge in self.boxes_px[number])
            c0, c1 = max(left, x0 // factor), min(right, -(-x1 // factor))
            r0, r1 = max(top, y0 // factor), min(bottom, -(-y1 // factor))
            part = np.s_[r0 - top : r1 - top, c0 - left : c1 - left]
            near.append((number, part, (c0 * factor - x0, r0 * factor - y0)))
        self._begin(near, (bottom - top, right - left), factor, opened)
        canvas = _Canvas(self.first, bottom - top, right - left)
        for number, part, at in near:
            if not canvas.is_full(part):
                shape = (part[0].stop - part[0].start, part[1].stop - part[1].start)
                canvas.add(part, *self._cells(number, at, shape, factor, opened))
        placed = self.transform * Affine.translation(left * factor, top * factor)
        return *canvas.picture(), placed * Affine.scale(factor)

    def _begin(
        self,
        near: Sequence[tuple[int, tuple[slice, slice], tuple[int, int]]],
        shape: tuple[int, int],
        factor: int,
        opened: Callable[[int], Any],
    ) -> None:
        """Read the members that will be cached, except those that another thread is reading.

        Members that others cover wholly are read only on request.
        """
        covered = np.zeros(shape, bool)
        for number, part, _ in near:
            if self._is_cached(number, factor) and not covered[part].all():
                reader = self._reader(number, factor, opened)
                self.decoded.begin((self.members[number], factor), reader)
            covered[part] = True

    def _cells(
        self,
        number: int,
        at: tuple[int, int],
        shape: tuple[int, int],
        factor: int,
        opened: Callable[[int], Any],
    ) -> Cells:
        """Cells of a member, the first of which begins at its column and row `at`."""
        source, index = self.sources[number], self.members[number]
        if not self._is_cached(number, factor):
            return cells_of(opened(index), source, at, shape, factor)
        values, share = self.decoded.get((index, factor), self._reader(number, factor, opened))
        col, row = at[0] // factor, at[1] // factor
        part = np.s_[row : row + shape[0], col : col + shape[1]]
        return values[(slice(None), *part)], share[part]

    def _is_cached(self, number: int, factor: int) -> bool:
        """Whether a member is read whole and cached, for the blocks next to it."""
        source = self.sources[number]
        cells = source.width_px * source.height_px / factor**2
        return cells <= MAX_CACHED_CELLS and not (self.boxes_px[number] % factor).any()

    def _reader(
        self, number: int, factor: int, opened: Callable[[int], Any]
    ) -> Callable[[], Cells]:
        source, index = self.sources[number], self.members[number]
        shape = source.height_px // factor, source.width_px // factor
        return lambda: cells_of(opened(index), source, (0, 0), shape, factor)

    def _near(self, left: int, top: int, right: int, bottom: int) -> list[int]:
        boxes = self.boxes_px
        near = (boxes[:, 0] < right) & (boxes[:, 2] > left)
        near &= (boxes[:, 1] < bottom) & (boxes[:, 3] > top)
        return [int(number) for number in np.flatnonzero(near)]


class CellCache:
    """Cache of the members that were read last; each is read by one thread only."""

    def __init__(self, limit_bytes: int = CACHE_BYTES) -> None:
        self._lock = threading.Lock()
        self._cells = ByteCache[tuple[int, int], Cells](limit_bytes, _bytes)
        self._turns: dict[tuple[int, int], threading.Lock] = {}

    def get(self, key: tuple[int, int], read: Callable[[], Cells]) -> Cells:
        """The cells of a key, read if they are not cached. Raises as `read` does."""
        with self._turn(key):
            return self._cached_or_read(key, read)

    def begin(self, key: tuple[int, int], read: Callable[[], Cells]) -> None:
        """Read the cells of a key unless they are cached or another thread reads them."""
        turn = self._turn(key)
        if turn.acquire(blocking=False):
            try:
                self._cached_or_read(key, read)
            finally:
                turn.release()

    def _turn(self, key: tuple[int, int]) -> threading.Lock:
        with self._lock:
            return self._turns.setdefault(key, threading.Lock())

    def _cached_or_read(self, key: tuple[int, int], read: Callable[[], Cells]) -> Cells:
        cells = self._cells.get(key)
        if cells is None:
            cells = read()
            self._cells.put(key, cells)
        return cells


def _bytes(cells: Cells) -> int:
    return cells[0].nbytes + cells[1].nbytes


class _Canvas:
    """Cells that several sources fill, each where the ones before it left them empty."""

    def __init__(self, like: Source, rows: int, cols: int) -> None:
        self._dtype = np.dtype("uint8" if like.palette is not None else like.dtype)
        self._total = np.zeros((like.colours, rows, cols), np.float32)
        self._weight = np.zeros((rows, cols), np.float32)

    def is_full(self, part: tuple[slice, slice]) -> bool:
        return bool((self._weight[part] >= FULL).all())

    def add(
        self, part: tuple[slice, slice], values: NDArray[Any], share: NDArray[np.float32]
    ) -> None:
        """Add cells (C, h, w), of which a share (h, w) is valid."""
        weight = self._weight[part]
        new = np.minimum(share, 1 - weight)
        if values.dtype.kind == "f":
            values = np.where(new > 0, values, 0)
        self._total[(slice(None), *part)] += values * new
        weight += new

    def picture(self) -> tuple[NDArray[Any], NDArray[np.uint8]]:
        """Bands (C, h, w) and mask (h, w), 0 (invalid) to 255."""
        mean = self._total / np.maximum(self._weight, 1e-6)
        if self._dtype.kind in "iu":
            mean = np.rint(mean)
        mask = np.rint(np.minimum(self._weight, 1) * 255).astype(np.uint8)
        return mean.astype(self._dtype), mask


def lattices_of(sources: Sequence[Source]) -> list[Lattice]:
    """The sources grouped into lattices.

    Only consecutive sources share one, so that earlier sources still cover later ones.
    """
    runs: list[list[int]] = []
    for index, source in enumerate(sources):
        if runs and _offset_px(sources[runs[-1][0]], source) is not None:
            runs[-1].append(index)
        else:
            runs.append([index])
    return [_lattice(run, [sources[index] for index in run]) for run in runs]


def _lattice(members: list[int], sources: list[Source]) -> Lattice:
    offsets = np.array([_offset_px(sources[0], each) for each in sources], np.int64)
    corner = offsets.min(axis=0)
    sizes = np.array([(each.width_px, each.height_px) for each in sources], np.int64)
    boxes = np.concatenate([offsets - corner, offsets - corner + sizes], axis=1)
    transform = sources[0].transform * Affine.translation(int(corner[0]), int(corner[1]))
    return Lattice(tuple(members), tuple(sources), transform, boxes, CellCache())


def _offset_px(first: Source, other: Source) -> tuple[int, int] | None:
    """Columns and rows from the corner of one to that of another; None where no lattice fits."""
    alike = (
        first.crs == other.crs
        and first.colours == other.colours
        and (first.palette is None) == (other.palette is None)
        and first.dtype == other.dtype
    )
    if not alike:
        return None
    col, row = ~first.transform * (other.transform.c, other.transform.f)
    offset = round(col), round(row)
    longest = max(other.width_px, other.height_px)
    skew = np.array(other.transform[:6]) - np.array(first.transform[:6])
    unit = min(
        np.hypot(first.transform.a, first.transform.d),
        np.hypot(first.transform.b, first.transform.e),
    )
    stretch_px = np.abs(skew[[0, 1, 3, 4]]).max() * longest / unit
    off_px = max(abs(col - offset[0]), abs(row - offset[1])) + stretch_px
    return offset if off_px <= MAX_OFF_PX else None
