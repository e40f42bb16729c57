"""Resampling the sheets of an atlas into another local plane.

Within a block of a kilometre two planes differ by a shift, a rotation of less than a degree and
millimetres, so each sheet is resampled by one affine per block. A place is taken from the sheet
whose box holds it; where that sheet shows nothing, from neighbours that reach over their border."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AtlasError, MapFileError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.mapfile.layer import GreyLayer
from orthonav.core.mapfile.manifest import Manifest
from orthonav.core.mapfile.terrain import TerrainLayer
from orthonav.core.tiles.cells import CellLayout
from orthonav.core.tiles.represent import HARMONICS
from orthonav.ground.atlas.catalog import Sheet
from orthonav.ground.build.layer import StoredCells
from orthonav.ground.build.sheet import Block
from orthonav.ground.planning.area import Extent

KERNEL_PX = 3  # margin of cubic interpolation, 2 pixels, and one more for rounding
EDGE_POINTS = 16  # points along an edge of a box, which is not straight in another plane
FILL_PX = 5  # kernel of cubic interpolation: imagery is extended beyond its edge
OWN_BONUS = 0.01  # decides ties between sheets for the one whose box holds the cell
_SHIFT = 6  # fractional bits of polygon corners in OpenCV
Array = NDArray[np.float64]
Pixels = tuple[NDArray[np.uint8], NDArray[np.bool_]]
Cells = tuple[NDArray[np.float32], NDArray[np.float32]]
Made = TypeVar("Made")


@dataclass(frozen=True, eq=False)
class SheetSource:
    """A sheet that a map is cut from: its item, manifest, pixels, cells and, if it has one, terrain
    layer."""

    sheet: Sheet
    manifest: Manifest
    layer: GreyLayer
    cells: StoredCells
    terrain: TerrainLayer | None

    @property
    def frame(self) -> LocalFrame:
        return self.manifest.sheets[0].frame

    @property
    def grid(self) -> TileGrid:
        return self.manifest.sheets[0].grid

    def covers(self, lat_deg: Array, lon_deg: Array) -> NDArray[np.bool_]:
        """Which places (N,) lie on the raster of the sheet."""
        px = _px_from_latlon(self.frame, self.grid, lat_deg, lon_deg)
        return np.asarray(((px >= 0) & (px <= [self.grid.width_px, self.grid.height_px])).all(-1))


@dataclass(frozen=True, eq=False)
class Warp:
    source: SheetSource
    frame: LocalFrame
    grid: TileGrid
    turns: bool  # whether cells are harmonics of a direction, which rotate with the plane

    def reaches(self, block: Block) -> bool:
        left, top, right, bottom = self._box_px
        return (
            block.col < right
            and block.row < bottom
            and block.col + block.width > left
            and block.row + block.height > top
        )

    def affine(self, block: Block) -> Array:
        """Affine (2, 3) from pixels of the grid to pixels of the sheet (pixel-is-area), fitted to
        the corners of a block."""
        corners = _corners(block)
        places = _latlon_from_px(self.frame, self.grid, corners)
        there = _px_from_latlon(self.source.frame, self.source.grid, *places)
        design = np.column_stack([corners - corners[0], np.ones(len(corners))])
        solved = np.linalg.lstsq(design, there, rcond=None)[0].T
        solved[:, 2] -= solved[:, :2] @ corners[0]
        return np.asarray(solved)

    def owned(self, block: Block, layout: CellLayout | None = None) -> NDArray[np.bool_]:
        spacing, middle = (1, 0.5) if layout is None else (layout.spacing_px, layout.micro_px / 2)
        shape = -(-block.height // spacing), -(-block.width // spacing)
        # OpenCV's coordinates 0, 0 are the middle of pixel or cell 0, 0.
        points = (self._outline_px - [block.col + middle, block.row + middle]) / spacing
        points = np.rint(points * 2**_SHIFT).astype(np.int32)
        mask = np.zeros(shape, dtype=np.uint8)
        cv2.fillPoly(mask, [points], 1, lineType=cv2.LINE_8, shift=_SHIFT)
        return mask.astype(np.bool_)

    def grey(self, block: Block) -> Pixels:
        """Grey levels and validity (H, W) of a block; 0 where not valid."""
        affine = self.affine(block)
        matrix = _by_middles(affine, block, 1, 0.5)
        size = block.width, block.height
        top, left, height, width = _window(matrix, size)
        grey, valid = self._read(lambda: self.source.layer.read(0, top, left, height, width))
        shape = block.height, block.width
        if not valid.any():
            return np.zeros(shape, np.uint8), np.zeros(shape, np.bool_)
        matrix[:, 2] -= [left, top]
        whole = bool(valid.all())
        if not whole:  # zeros beyond the imagery must not darken its edge
            grown = cv2.dilate(grey, np.ones((FILL_PX, FILL_PX), np.uint8))
            grey = np.where(valid, grey, grown).astype(np.uint8)
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        made = cv2.warpAffine(grey, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        if whole:
            return np.asarray(made, np.uint8), np.ones(shape, np.bool_)
        mask = valid.astype(np.uint8) * 255
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        shown = cv2.warpAffine(mask, matrix, size, flags=flags) >= 254
        return np.where(shown, made, 0).astype(np.uint8), np.asarray(shown, np.bool_)

    def cells(self, block: Block, layout: CellLayout) -> Cells:
        """Means (h, w, C) and valid shares (h, w) of the cells that begin in a block."""
        spacing, middle = layout.spacing_px, layout.micro_px / 2
        rows, cols = -(-block.height // spacing), -(-block.width // spacing)
        matrix = _by_middles(self.affine(block), block, spacing, middle)
        top, left, height, width = _window(matrix, (cols, rows))
        means, share = self._read(lambda: self.source.cells.read(top, left, height, width))
        matrix[:, 2] -= [left, top]
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        planes = [
            cv2.warpAffine(np.ascontiguousarray(plane), matrix, (cols, rows), flags=flags)
            for plane in (*np.moveaxis(means, 2, 0), share)
        ]
        made = np.stack(planes[:-1], axis=2).astype(np.float32)
        if self.turns:
            _turn(made, math.atan2(matrix[1, 0], matrix[0, 0]))
        return made, np.asarray(planes[-1], np.float32)

    def _read(self, read: Callable[[], Made]) -> Made:
        try:
            return read()
        except MapFileError as error:
            raise AtlasError(
                f"sheet {self.source.sheet.id} is damaged, rebuild it ({error})"
            ) from error

    @cached_property
    def _outline_px(self) -> Array:
        lon, lat = outline(self.source.sheet.bounds_deg, EDGE_POINTS).T
        return _px_from_latlon(self.frame, self.grid, lat, lon)

    @cached_property
    def _box_px(self) -> tuple[float, float, float, float]:
        grid = self.source.grid
        corners = _corners(Block(0, 0, grid.height_px, grid.width_px))
        places = _latlon_from_px(self.source.frame, grid, corners)
        points = _px_from_latlon(self.frame, self.grid, *places)
        (left, top), (right, bottom) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
        return left - 1, top - 1, right + 1, bottom + 1


def outline(box: Extent, points: int) -> Array:
    """Points (4 * points, 2), x and y, around a box (west, south, east, north) from its corner."""
    west, south, east, north = box
    corners = np.array([[west, south], [east, south], [east, north], [west, north], [west, south]])
    share = np.arange(points)[:, None] / points
    return np.concatenate([start + (end - start) * share for start, end in pairwise(corners)])


def _px_from_latlon(frame: LocalFrame, grid: TileGrid, lat_deg: Array, lon_deg: Array) -> Array:
    points = frame.en_from_latlon(lat_deg, lon_deg)
    return np.asarray((points - [grid.west_m, grid.north_m]) / [grid.gsd_m, -grid.gsd_m])


def _latlon_from_px(frame: LocalFrame, grid: TileGrid, px: Array) -> tuple[Array, Array]:
    places = [grid.west_m, grid.north_m] + px * [grid.gsd_m, -grid.gsd_m]
    return frame.latlon_from_en(places)


def joined_grey(warps: Sequence[Warp], block: Block) -> Pixels:
    """Grey levels and validity (H, W) of a block from all sheets that reach it."""
    grey = np.zeros((block.height, block.width), dtype=np.uint8)
    valid = np.zeros(grey.shape, dtype=np.bool_)
    owners = [(warp, warp.owned(block)) for warp in warps]
    for own in (True, False):
        for warp, mask in owners:
            wanted = ~valid & mask if own else ~(valid | mask)
            part = _around(wanted)
            if part is None:
                continue
            rows, cols = part
            size = rows.stop - rows.start, cols.stop - cols.start
            some, there = warp.grey(Block(block.row + rows.start, block.col + cols.start, *size))
            taken = there & wanted[part]
            np.copyto(grey[part], some, where=taken)
            valid[part] |= taken
    return grey, valid


def _around(wanted: NDArray[np.bool_]) -> tuple[slice, slice] | None:
    rows, cols = (np.flatnonzero(wanted.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return None
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)


def joined_cells(warps: Sequence[Warp], block: Block, layout: CellLayout) -> Cells:
    """Means (h, w, C) and valid shares (h, w) of the cells that begin in a block, from one or more
    sheets that reach it."""
    owners = [(warp, warp.owned(block, layout)) for warp in warps]
    owners.sort(key=lambda each: not each[1].any())
    means, share = owners[0][0].cells(block, layout)
    best = share + np.float32(OWN_BONUS) * owners[0][1]
    for warp, mask in owners[1:]:
        if best.min() >= 1:
            break
        some, their_share = warp.cells(block, layout)
        rank = their_share + np.float32(OWN_BONUS) * mask
        better = rank > best
        means[better], share[better] = some[better], their_share[better]
        best = np.maximum(best, rank)
    return means, share


def _turn(means: NDArray[np.float32], angle_rad: float) -> None:
    for k in range(1, HARMONICS + 1):
        cos, sin = np.float32(math.cos(2 * k * angle_rad)), np.float32(math.sin(2 * k * angle_rad))
        real, imaginary = means[..., 2 * k - 1].copy(), means[..., 2 * k].copy()
        means[..., 2 * k - 1] = real * cos + imaginary * sin
        means[..., 2 * k] = imaginary * cos - real * sin


def _corners(block: Block) -> Array:
    right, bottom = block.col + block.width, block.row + block.height
    return np.array(
        [[block.col, block.row], [right, block.row], [block.col, bottom], [right, bottom]], float
    )


def _by_middles(affine: Array, block: Block, spacing: int, middle: float) -> Array:
    """The affine between indices of pixels (or cells) whose middles lie `middle` px into them.
    Index 0, 0 is the first of the block, and the first of the raster of the sheet."""
    linear = affine[:, :2]
    first = linear @ [block.col + middle, block.row + middle] + affine[:, 2] - middle
    return np.column_stack([linear, first / spacing])


def _window(matrix: Array, size: tuple[int, int]) -> tuple[int, int, int, int]:
    cols, rows = size
    corners = np.array([[0, 0], [cols - 1, 0], [0, rows - 1], [cols - 1, rows - 1]], float)
    there = corners @ matrix[:, :2].T + matrix[:, 2]
    left, top = (int(value) for value in np.floor(there.min(axis=0)) - KERNEL_PX)
    right, bottom = (int(value) for value in np.ceil(there.max(axis=0)) + KERNEL_PX)
    return top, left, bottom - top + 1, right - left + 1
