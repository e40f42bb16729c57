"""Cloud-optimized GeoTIFFs read by windows: one, or several that are laid over each other.

Where all lie on one grid, pixels are taken as they are. Where one is off it (another zone, another
phase), it alone is resampled into the grid of the first; `About.note` then says so.
"""

import io
import math
import tempfile
import threading
import warnings
import zlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import MaskFlags, Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.transform import Affine
from rasterio.warp import reproject, transform_bounds
from rasterio.windows import Window

from orthonav.errors import FetchError
from orthonav.fetch.client import Client
from orthonav.fetch.crs import ground_scale
from orthonav.fetch.grid import CellGrid
from orthonav.fetch.layout import Page, read_layout
from orthonav.fetch.pictures import Picture
from orthonav.fetch.remote import RemoteFile
from orthonav.fetch.service import About, Wish, finest_fitting
from orthonav.fetch.urls import shown
from orthonav.geo.frames import LocalFrame

CELL_PX = 512
_RESAMPLING_PX = 3
_WHOLLY_VALID = 250
ALIGNED_PX = 0.02
"""Files whose grids differ by less are read as if they were one."""
GDAL_OPTIONS = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_CACHEMAX": 64 * 2**20,
}
Box = tuple[float, float, float, float]
Part = tuple[tuple[int, int], NDArray[Any], NDArray[np.bool_]]
_DTYPES = ("uint8", "uint16", "int16", "float32")


@dataclass(frozen=True, eq=False)
class _File:
    """One file at the level that is read: its affine transform, size and coordinate system.

    `pages` are the picture at that level and, if there is one, its mask.
    """

    remote: RemoteFile
    pages: list[Page]
    level: int | None
    transform: Affine
    width_px: int
    height_px: int
    crs: str
    dtype: str
    count: int


@dataclass(eq=False)
class CogSource:
    """Cells of one or several files; the first that has something at a place wins."""

    about: About
    grid: CellGrid
    files: list[_File]
    band_indexes: tuple[int, ...]
    dtype: str
    cell_bytes: float
    _folder: tempfile.TemporaryDirectory[str]
    _local: threading.local = field(default_factory=threading.local)
    _open: list[Any] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def bands(self) -> int:
        """Bands that are read."""
        return len(self.band_indexes)

    def address(self, row: int, col: int) -> str:
        """Files, their versions, and the window."""
        files = " ".join(f"{file.remote.url} {file.remote.identity}" for file in self.files)
        return f"{files} {self.grid} {self.band_indexes} {row} {col}"

    def fetch(self, client: Client, row: int, col: int) -> bytes | None:
        """Pixels of the cell, packed; None where no file has anything there."""
        shape = (self.grid.cell_h_px, self.grid.cell_w_px)
        bands = np.zeros((self.bands, *shape), dtype=self.dtype)
        valid = np.zeros(shape, dtype=bool)
        west, south, east, north = self.grid.bounds(row, col)
        for index, file in enumerate(self.files):
            if valid.all():
                break
            self._add(index, file, (west, south, east, north), bands, valid)
        if not valid.any():
            return None
        packed = io.BytesIO()
        for array in (bands, np.packbits(valid, axis=1)):
            np.save(packed, array, allow_pickle=False)
        return zlib.compress(packed.getbuffer(), 1)

    def decode(self, body: bytes) -> Picture:
        """Pixels of what `fetch` packed."""
        packed = io.BytesIO(zlib.decompress(body))
        bands, valid = (np.load(packed, allow_pickle=False) for _ in range(2))
        return Picture(bands, np.unpackbits(valid, axis=1, count=bands.shape[2]).astype(bool))

    def close(self) -> None:
        """Close every file, and remove what was copied of them."""
        with self._lock:
            for dataset in self._open:
                dataset.close()
            self._open.clear()
        self._folder.cleanup()

    def _add(
        self, index: int, file: _File, box: Box, bands: NDArray[Any], valid: NDArray[np.bool_]
    ) -> None:
        """Put what a file has in a box where nothing is yet."""
        off = _offset_px(self.grid, file, box) if file.crs == self.grid.crs else None
        found = self._taken(index, file, off) if off else self._warped(index, file, box)
        if found is None:
            return
        (top, left), pixels, mask = found
        part = np.s_[top : top + mask.shape[0], left : left + mask.shape[1]]
        new = mask & ~valid[part]
        bands[:, *part][:, new] = pixels[:, new]
        valid[part] |= new

    def _taken(self, index: int, file: _File, off: tuple[int, int]) -> Part | None:
        """Pixels as they are, of a file on the same grid; `off` are row and column in the file."""
        row1, col1 = off[0] + self.grid.cell_h_px, off[1] + self.grid.cell_w_px
        found = self._read(index, file, (off[0], off[1], row1, col1))
        if found is None:
            return None
        (row0, col0), pixels, mask = found
        return (row0 - off[0], col0 - off[1]), pixels, mask

    def _warped(self, index: int, file: _File, box: Box) -> Part | None:
        """Pixels resampled into the grid, of a file that lies otherwise."""
        grid = self.grid
        west, south, east, north = transform_bounds(grid.crs, file.crs, *box, densify_pts=21)
        (col0, row0), (col1, row1) = (
            ~file.transform @ (west, north),
            ~file.transform @ (east, south),
        )
        pad = _RESAMPLING_PX
        edges = (
            math.floor(row0) - pad,
            math.floor(col0) - pad,
            math.ceil(row1) + pad,
            math.ceil(col1) + pad,
        )
        found = self._read(index, file, edges)
        if found is None:
            return None
        (top, left), pixels, mask = found
        shape = (grid.cell_h_px, grid.cell_w_px)
        places: dict[str, Any] = {
            "src_transform": file.transform @ Affine.translation(left, top),
            "src_crs": file.crs,
            "dst_transform": Affine(grid.res_x, 0, box[0], 0, -grid.res_y, box[3]),
            "dst_crs": grid.crs,
            "resampling": Resampling.bilinear,
        }
        turned = np.zeros((self.bands, *shape), dtype=self.dtype)
        share = np.zeros(shape, dtype=np.uint8)
        reproject(pixels, turned, **places)
        reproject(np.where(mask, 255, 0).astype(np.uint8), share, **places)
        return (0, 0), turned, share >= _WHOLLY_VALID

    def _read(self, index: int, file: _File, edges: tuple[int, int, int, int]) -> Part | None:
        """Row and column, pixels and mask of what a file has between edges (row, col, row, col)."""
        row0, col0 = max(0, edges[0]), max(0, edges[1])
        row1, col1 = min(file.height_px, edges[2]), min(file.width_px, edges[3])
        if row0 >= row1 or col0 >= col1:
            return None
        file.remote.require(
            [part for page in file.pages for part in page.ranges(row0, col0, row1, col1)]
        )
        window = Window(col0, row0, col1 - col0, row1 - row0)
        try:
            with rasterio.Env(**GDAL_OPTIONS):
                dataset = self._dataset(index)
                pixels = dataset.read(list(self.band_indexes), window=window)
                return (row0, col0), pixels, _mask(dataset, self.band_indexes, window)
        except RasterioError as error:
            raise _unreadable(file.remote, error) from None

    def _dataset(self, index: int) -> Any:
        """The file opened, once per thread: a dataset serves one thread at a time."""
        opened = getattr(self._local, "opened", None)
        if opened is None:
            opened = self._local.opened = {}
        if index not in opened:
            file = self.files[index]
            opened[index] = _opened(file.remote.copy, file.level)
            with self._lock:
                self._open.append(opened[index])
        return opened[index]


def cog_source(
    client: Client, urls: list[str], wish: Wish, frame: LocalFrame, about: About
) -> CogSource:
    """The files as one source, on the grid of the first at the level that fits the wish.

    Raises `FetchError` where one cannot be read or they are of different kinds.
    """
    folder = tempfile.TemporaryDirectory(prefix="orthonav-")
    try:
        files = [
            _inspect(RemoteFile(client, url, Path(folder.name) / f"{number}.tif"), wish, frame)
            for number, url in enumerate(urls)
        ]
        return _source(files, wish, about, folder)
    except BaseException:
        folder.cleanup()
        raise


def _source(
    files: list[_File], wish: Wish, about: About, folder: "tempfile.TemporaryDirectory[str]"
) -> CogSource:
    first = files[0]
    bands = wish.bands or ((1,) if first.count < 3 else (1, 2, 3))
    for file in files:
        if file.dtype != first.dtype or max(bands) > file.count:
            raise FetchError(
                f"files are of different kinds ({first.count} bands of {first.dtype}, "
                f"{file.count} of {file.dtype}): {shown(file.remote.url)}"
            )
    res_x, res_y = first.transform.a, -first.transform.e
    grid = CellGrid(first.crs, first.transform.c, first.transform.f, res_x, res_y, CELL_PX, CELL_PX)
    corner = (first.transform.c, 0.0, 0.0, first.transform.f)
    odd = [f for f in files if f.crs != first.crs or _offset_px(grid, f, corner) is None]
    note = f"{len(odd)} of {len(files)} files resampled (bilinear)" if odd else None
    if note:
        about = replace(about, note="; ".join(part for part in (about.note, note) if part))
    per_px = np.dtype(first.dtype).itemsize * len(bands) * 0.35
    return CogSource(about, grid, files, bands, first.dtype, CELL_PX**2 * per_px, folder)


def _inspect(remote: RemoteFile, wish: Wish, frame: LocalFrame) -> _File:
    """What is known of a file from its head, and the level that fits the wish."""
    pages = read_layout(remote)
    try:
        with rasterio.Env(**GDAL_OPTIONS), warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with _opened(remote.copy, None) as whole:
                level = _level(whole, wish, frame, remote)
            with _opened(remote.copy, level) as dataset:
                _check(dataset, remote)
                size = (dataset.width, dataset.height)
                used = [page for page in pages if (page.width_px, page.height_px) == size]
                if not any(not page.mask for page in used):
                    raise FetchError(f"file's pages are not understood: {shown(remote.url)}")
                return _File(
                    remote=remote,
                    pages=used,
                    level=level,
                    transform=dataset.transform,
                    width_px=dataset.width,
                    height_px=dataset.height,
                    crs=dataset.crs.to_string(),
                    dtype=str(dataset.dtypes[0]),
                    count=dataset.count,
                )
    except RasterioError as error:
        raise _unreadable(remote, error) from None


def _level(dataset: Any, wish: Wish, frame: LocalFrame, remote: RemoteFile) -> int | None:
    """Which overview is read; None is the full resolution."""
    if dataset.crs is None:
        raise FetchError(f"file has no coordinate system: {shown(remote.url)}")
    scale = math.sqrt(math.prod(ground_scale(dataset.crs.to_string(), frame)))
    native_m = abs(dataset.transform.a) * scale
    factors = [1, *dataset.overviews(1)]
    if wish.gsd_m is None:
        return None
    gsds_m = [native_m * factor for factor in factors]
    what = ", ".join(f"{gsd_m:.3g} m" for gsd_m in gsds_m)
    chosen = finest_fitting(gsds_m, wish.gsd_m, what)
    return None if chosen == 0 else chosen - 1


def _check(dataset: Any, remote: RemoteFile) -> None:
    """Raise `FetchError` for files that cannot be read by windows as they are."""
    where = shown(remote.url)
    transform = dataset.transform
    if transform.b or transform.d or transform.a <= 0 or transform.e >= 0:
        raise FetchError(f"file is turned or has no georeference: {where}")
    if dataset.dtypes[0] not in _DTYPES:
        raise FetchError(f"file has pixels of {dataset.dtypes[0]}, which are not read: {where}")


def _mask(dataset: Any, bands: tuple[int, ...], window: Window | None) -> NDArray[np.bool_]:
    """What is valid (H, W), by alpha, mask or nodata; not valid is what has nothing in any band."""
    flags = dataset.mask_flag_enums[bands[0] - 1]
    if MaskFlags.all_valid in flags:
        shape = (dataset.height, dataset.width)
        if window is not None:
            shape = (int(window.height), int(window.width))
        return np.ones(shape, dtype=bool)
    masks = dataset.read_masks(list(bands), window=window)
    if MaskFlags.alpha in flags:
        return np.asarray(masks[0] > 0)
    return np.asarray((masks > 0).any(axis=0))


def _offset_px(grid: CellGrid, file: _File, box: Box) -> tuple[int, int] | None:
    """Row and column of a box's corner in a file on the same grid; None if it is on another."""
    if not (
        math.isclose(file.transform.a, grid.res_x, rel_tol=1e-9)
        and math.isclose(-file.transform.e, grid.res_y, rel_tol=1e-9)
    ):
        return None
    col = (box[0] - file.transform.c) / grid.res_x
    row = (file.transform.f - box[3]) / grid.res_y
    if max(abs(col - round(col)), abs(row - round(row))) > ALIGNED_PX:
        return None
    return round(row), round(col)


def _opened(file: Path, level: int | None) -> Any:
    options = {} if level is None else {"overview_level": level}
    return rasterio.open(file, driver="GTiff", **options)


def _unreadable(remote: RemoteFile, error: Exception) -> FetchError:
    """What GDAL says of a file."""
    reason = " ".join(str(error.__cause__ or error).split()).replace(str(remote.copy), "file")
    return FetchError(f"not a GeoTIFF that can be read ({reason[:200]}): {shown(remote.url)}")
