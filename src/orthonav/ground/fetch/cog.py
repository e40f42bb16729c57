"""Cloud-optimized GeoTIFFs read by windows: one file, or several that overlap.

Files on one pixel grid are read without resampling. A file off the grid of the first (another zone
or phase) is resampled into it, and `Provenance.note` says so.
"""

import io
import math
import warnings
import zlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import MaskFlags, Resampling
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import Affine
from rasterio.warp import reproject, transform_bounds
from rasterio.windows import Window

from orthonav.core.errors import FetchError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.fetch.client import Client
from orthonav.ground.fetch.crs import ground_scale
from orthonav.ground.fetch.grid import CellGrid
from orthonav.ground.fetch.images import CellPixels
from orthonav.ground.fetch.options import ImageryOptions, SourceSpec, finest_fitting
from orthonav.ground.fetch.remote import CACHE_BYTES, MAX_RANGE, RangeCache, RemoteFile
from orthonav.ground.fetch.service import CellSource
from orthonav.ground.fetch.urls import shown
from orthonav.ground.imagery.mosaic import WHOLLY_VALID
from orthonav.ground.planning.area import Area

CELL_PX = 512
"""GDAL's block size for COG, so a cell is usually one block."""
_RESAMPLING_PX = 3
"""Pixels read beyond a window that is resampled: bilinear needs one, rounding another."""
ALIGNED_PX = 0.02
"""Grids that differ by less count as one: a fiftieth of a pixel is below any error of imagery."""
_PACKED_SHARE = 0.35
"""Size of a usual JPEG block relative to its pixels, for the estimate."""
_DTYPES = ("uint8", "uint16", "int16", "float32")
Box = tuple[float, float, float, float]
Part = tuple[tuple[int, int], NDArray[Any], NDArray[np.bool_]]


@dataclass(frozen=True, eq=False)
class CogLevel:
    """One file at the resolution that is read."""

    remote: RemoteFile
    """The file."""
    level: int | None
    """Index of the overview; None is the full resolution."""
    transform: Affine
    """From column, row of this level to coordinates of `crs`."""
    width_px: int
    """Columns of this level."""
    height_px: int
    """Rows of this level."""
    crs: str
    """Coordinate system, as rasterio writes it."""
    dtype: str
    """Pixel type."""
    count: int
    """Bands."""


@dataclass(frozen=True, eq=False)
class _CogCells:
    """Cells of one or several files; where they overlap, the first valid pixel counts."""

    grid: CellGrid
    files: list[CogLevel]
    bands: tuple[int, ...]
    dtype: str

    def address(self, row: int, col: int) -> str:
        """Files, their versions, and the window."""
        files = " ".join(f"{file.remote.url} {file.remote.identity}" for file in self.files)
        return f"{files} {self.grid} {self.bands} {row} {col}"

    def fetch(self, client: Client, row: int, col: int) -> bytes | None:
        """Pixels of the cell, packed; None where no file has valid pixels there."""
        shape = (self.grid.cell_h_px, self.grid.cell_w_px)
        bands = np.zeros((len(self.bands), *shape), dtype=self.dtype)
        valid = np.zeros(shape, dtype=bool)
        box = self.grid.bounds(row, col)
        for file in self.files:
            if valid.all():
                break
            self._add(file, box, bands, valid)
        if not valid.any():
            return None
        packed = io.BytesIO()
        for array in (bands, np.packbits(valid, axis=1)):
            np.save(packed, array, allow_pickle=False)
        return zlib.compress(packed.getbuffer(), 1)

    def decode(self, body: bytes) -> CellPixels:
        """Pixels of what `fetch` packed."""
        packed = io.BytesIO(zlib.decompress(body))
        bands, valid = (np.load(packed, allow_pickle=False) for _ in range(2))
        return CellPixels(bands, np.unpackbits(valid, axis=1, count=bands.shape[2]).astype(bool))

    def _add(self, file: CogLevel, box: Box, bands: NDArray[Any], valid: NDArray[np.bool_]) -> None:
        """Fill pixels of a box that are not valid yet from one file."""
        offset = _offset_px(self.grid, file, box)
        found = self._aligned(file, offset) if offset else self._warped(file, box)
        if found is None:
            return
        (top, left), pixels, mask = found
        part = np.s_[top : top + mask.shape[0], left : left + mask.shape[1]]
        new = mask & ~valid[part]
        bands[:, *part][:, new] = pixels[:, new]
        valid[part] |= new

    def _aligned(self, file: CogLevel, offset: tuple[int, int]) -> Part | None:
        """Pixels of a file on the same grid; `offset` is the cell's row and column in the file."""
        row1, col1 = offset[0] + self.grid.cell_h_px, offset[1] + self.grid.cell_w_px
        found = self._read(file, (*offset, row1, col1))
        if found is None:
            return None
        (row0, col0), pixels, mask = found
        return (row0 - offset[0], col0 - offset[1]), pixels, mask

    def _warped(self, file: CogLevel, box: Box) -> Part | None:
        """Pixels of a file on another grid, resampled into a box of this one."""
        grid = self.grid
        west, south, east, north = transform_bounds(grid.crs, file.crs, *box, densify_pts=21)
        col0, row0 = ~file.transform @ (west, north)
        col1, row1 = ~file.transform @ (east, south)
        low = (math.floor(value) - _RESAMPLING_PX for value in (row0, col0))
        high = (math.ceil(value) + _RESAMPLING_PX for value in (row1, col1))
        found = self._read(file, (*low, *high))
        if found is None:
            return None
        (top, left), pixels, mask = found
        shape = (grid.cell_h_px, grid.cell_w_px)
        placement: dict[str, Any] = {
            "src_transform": file.transform @ Affine.translation(left, top),
            "src_crs": file.crs,
            "dst_transform": Affine(grid.res_x, 0, box[0], 0, -grid.res_y, box[3]),
            "dst_crs": grid.crs,
            "resampling": Resampling.bilinear,
        }
        resampled = np.zeros((len(self.bands), *shape), dtype=self.dtype)
        validity = np.zeros(shape, dtype=np.uint8)
        reproject(pixels, resampled, **placement)
        reproject(np.where(mask, 255, 0).astype(np.uint8), validity, **placement)
        return (0, 0), resampled, validity >= WHOLLY_VALID

    def _read(self, file: CogLevel, edges: tuple[int, ...]) -> Part | None:
        """Row, column, pixels and mask between edges (row, col, row, col), as far as they exist."""
        row0, col0 = max(0, edges[0]), max(0, edges[1])
        row1, col1 = min(file.height_px, edges[2]), min(file.width_px, edges[3])
        if row0 >= row1 or col0 >= col1:
            return None
        window = Window(col0, row0, col1 - col0, row1 - row0)
        # Opened for every window: rasterio 1.4 crashes where a file of an opener is closed in
        # another thread than it was opened in. Its head is in memory, so this takes milliseconds.
        with file.remote.opened(file.level) as dataset:
            pixels = dataset.read(list(self.bands), window=window)
            mask = _mask(dataset, self.bands, window)
        return (row0, col0), pixels, mask


def cog_source(client: Client, spec: SourceSpec, area: Area, urls: list[str]) -> CellSource:
    """The files as one source, on the grid of the first at the level that fits the options.

    Raises `FetchError` where one cannot be read or they differ in pixel type or bands.
    """
    options, provenance = spec.options, spec.provenance
    cache = RangeCache(CACHE_BYTES, len)
    files = [_inspect(RemoteFile(client, url, cache), options, area.frame) for url in urls]
    first = files[0]
    bands = options.bands or ((1,) if first.count < 3 else (1, 2, 3))
    for file in files:
        if file.dtype != first.dtype or max(bands) > file.count:
            raise FetchError(
                f"files are of different kinds ({first.count} bands of {first.dtype}, "
                f"{file.count} of {file.dtype}): {shown(file.remote.url)}"
            )
    res_x, res_y = first.transform.a, -first.transform.e
    grid = CellGrid(first.crs, first.transform.c, first.transform.f, res_x, res_y, CELL_PX, CELL_PX)
    corner = (first.transform.c, 0.0, 0.0, first.transform.f)
    off_grid = sum(_offset_px(grid, file, corner) is None for file in files)
    if off_grid:
        note = f"{off_grid} of {len(files)} files resampled (bilinear)"
        note = "; ".join(part for part in (provenance.note, note) if part)
        provenance = replace(provenance, note=note)
    cell_bytes = CELL_PX**2 * np.dtype(first.dtype).itemsize * len(bands) * _PACKED_SHARE
    cells = _CogCells(grid, files, bands, first.dtype)
    functions = cells.address, cells.fetch, cells.decode
    return CellSource(provenance, grid, len(bands), first.dtype, cell_bytes, *functions)


def _inspect(file: RemoteFile, options: ImageryOptions, frame: LocalFrame) -> CogLevel:
    """A file at the level that fits `options`, read from its head."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # refused below
        with file.opened() as whole:
            level = _level(whole, options, frame, file)
        with file.opened(level) as dataset:
            _check(dataset, file)
            return CogLevel(
                remote=file,
                level=level,
                transform=dataset.transform,
                width_px=dataset.width,
                height_px=dataset.height,
                crs=dataset.crs.to_string(),
                dtype=str(dataset.dtypes[0]),
                count=dataset.count,
            )


def _level(
    dataset: Any, options: ImageryOptions, frame: LocalFrame, file: RemoteFile
) -> int | None:
    """Index of the overview to read; None is the full resolution."""
    if dataset.crs is None:
        raise FetchError(f"file has no coordinate system: {shown(file.url)}")
    if options.gsd_m is None:
        return None
    scale = math.sqrt(math.prod(ground_scale(dataset.crs.to_string(), frame)))
    native_m = abs(dataset.transform.a) * scale
    gsds_m = [native_m * factor for factor in (1, *dataset.overviews(1))]
    levels = ", ".join(f"{gsd_m:.3g} m" for gsd_m in gsds_m)
    chosen = finest_fitting(gsds_m, options.gsd_m, levels)
    return None if chosen == 0 else chosen - 1


def _check(dataset: Any, file: RemoteFile) -> None:
    """Raise `FetchError` for a file that cannot be read by windows."""
    where = shown(file.url)
    transform = dataset.transform
    if transform.b or transform.d or transform.a <= 0 or transform.e >= 0:
        raise FetchError(f"file is rotated or not georeferenced: {where}")
    if dataset.dtypes[0] not in _DTYPES:
        raise FetchError(f"file has unsupported pixels ({dataset.dtypes[0]}): {where}")
    # Neither packed nor unpacked may a block exhaust memory: an untiled file is one huge block.
    block_px = max(height * width for height, width in dataset.block_shapes)
    if block_px * dataset.count * np.dtype(dataset.dtypes[0]).itemsize > MAX_RANGE:
        raise file.unreadable("blocks too large to be read by windows")


def _mask(dataset: Any, bands: tuple[int, ...], window: Window) -> NDArray[np.bool_]:
    """Valid pixels (H, W) by alpha, mask or nodata: those valid in any band."""
    flags = dataset.mask_flag_enums[bands[0] - 1]
    if MaskFlags.all_valid in flags:
        return np.ones((int(window.height), int(window.width)), dtype=bool)
    masks = dataset.read_masks(list(bands), window=window)
    if MaskFlags.alpha in flags:
        return np.asarray(masks[0] > 0)
    return np.asarray((masks > 0).any(axis=0))


def _offset_px(grid: CellGrid, file: CogLevel, box: Box) -> tuple[int, int] | None:
    """Row and column of a box's corner in a file on the same grid; None where it is on another."""
    if file.crs != grid.crs or not (
        math.isclose(file.transform.a, grid.res_x, rel_tol=1e-9)
        and math.isclose(-file.transform.e, grid.res_y, rel_tol=1e-9)
    ):
        return None
    col = (box[0] - file.transform.c) / grid.res_x
    row = (file.transform.f - box[3]) / grid.res_y
    if max(abs(col - round(col)), abs(row - round(row))) > ALIGNED_PX:
        return None
    return round(row), round(col)
