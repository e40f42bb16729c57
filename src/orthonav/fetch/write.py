"""Cells into one cloud-optimized GeoTIFF, block by block, whole or not at all."""

import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasterio.errors import RasterioError
from rasterio.transform import Affine
from rasterio.windows import Window

from orthonav import __version__
from orthonav.errors import FetchError, OutputError
from orthonav.fetch.cache import FileCache
from orthonav.fetch.grid import Selection
from orthonav.fetch.service import About, CellSource
from orthonav.files import replacing

BLOCK_PX = 512
GDAL_OPTIONS = {
    "GDAL_TIFF_INTERNAL_MASK": "YES",
    "GDAL_CACHEMAX": 128 * 2**20,
    "GDAL_NUM_THREADS": "2",
}
COMPRESSIONS = ("jpeg", "deflate")
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Packing:
    """How the file is packed: `compress` jpeg or deflate, `quality` of JPEG."""

    compress: str = "jpeg"
    quality: int = 90


@dataclass
class Counts:
    """Cells by what they hold, and the share of pixels of all of them that is valid."""

    pictures: int = 0
    blank: int = 0
    placeholder: int = 0
    valid_px: int = 0


def write_mosaic(
    out: Path,
    source: CellSource,
    selection: Selection,
    digests: NDArray[np.uint64],
    placeholders: NDArray[np.bool_],
    cache: FileCache,
    packing: Packing,
    progress: Progress,
) -> Counts:
    """Write the cells as one GeoTIFF and say what they held. What is missing is masked.

    Raises `FetchError` where nothing is valid, `OutputError` where the disk refuses.
    """
    counts = Counts()
    with (
        replacing(out) as temporary,
        tempfile.TemporaryDirectory(
            prefix=f".{out.name}.", suffix=".tmp", dir=temporary.parent
        ) as folder,
        rasterio.Env(**GDAL_OPTIONS),
    ):
        raw = Path(folder) / "mosaic.tif"
        try:
            _write_raw(raw, source, selection, digests, placeholders, cache, counts, progress)
            if counts.valid_px == 0:
                raise FetchError("the service has no imagery of this area in this layer")
            progress("pack", 0.1)
            _pack(raw, temporary, source, packing)
            _check(temporary, raw, source)
            progress("pack", 1.0)
        except (RasterioError, MemoryError) as error:
            raise _not_written(error, out) from error
    return counts


def _write_raw(
    raw: Path,
    source: CellSource,
    selection: Selection,
    digests: NDArray[np.uint64],
    placeholders: NDArray[np.bool_],
    cache: FileCache,
    counts: Counts,
    progress: Progress,
) -> None:
    """The mosaic as a sparse tiled file; a block is written once where cells and blocks agree."""
    grid = selection.grid
    first_row, first_col = selection.first
    height, width = selection.shape_px
    west, north = grid.corner(first_row, first_col)
    cell = min(grid.cell_w_px, grid.cell_h_px, BLOCK_PX)
    block = cell if cell % 16 == 0 and grid.cell_w_px % cell == grid.cell_h_px % cell == 0 else 256
    fits = grid.cell_w_px % block == 0 and grid.cell_h_px % block == 0
    profile = {
        "driver": "GTiff",
        "width": width,
        "height": height,
        "count": source.bands,
        "dtype": source.dtype,
        "crs": grid.crs,
        "tiled": True,
        "blockxsize": block,
        "blockysize": block,
        "bigtiff": "YES",
        "sparse_ok": True,
        "interleave": "pixel",
        "transform": Affine(grid.res_x, 0, west, 0, -grid.res_y, north),
        "photometric": "RGB" if source.bands == 3 else "MINISBLACK",
    }
    if fits:
        profile |= {"compress": "DEFLATE", "zlevel": 1}
    tags = tags_of(source.about, selection)
    with rasterio.open(raw, "w", **profile) as dataset:
        dataset.update_tags(**tags)
        if source.bands == 3:
            dataset.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
        for number, (row, col) in enumerate(selection.cells.tolist()):
            if digests[number] == 0:
                continue
            if placeholders[number]:
                counts.placeholder += 1
                continue
            _write_cell(dataset, source, cache, (row, col), (first_row, first_col), counts)
            progress("mosaic", (number + 1) / len(selection.cells))


def _write_cell(
    dataset: Any,
    source: CellSource,
    cache: FileCache,
    at: tuple[int, int],
    first: tuple[int, int],
    counts: Counts,
) -> None:
    entry = cache.read(source.address(*at))
    if entry is None or entry.body is None:
        raise OutputError(f"what was fetched is gone from the cache: {cache.folder}")
    picture = source.decode(entry.body)
    if picture.blank:
        counts.blank += 1
        return
    grid = source.grid
    height, width = picture.valid.shape
    window = Window(
        (at[1] - first[1]) * grid.cell_w_px, (at[0] - first[0]) * grid.cell_h_px, width, height
    )
    dataset.write(np.where(picture.valid, picture.bands, 0), window=window)
    dataset.write_mask(np.where(picture.valid, 255, 0).astype(np.uint8), window=window)
    counts.pictures += 1
    counts.valid_px += int(picture.valid.sum())


def _pack(raw: Path, out: Path, source: CellSource, packing: Packing) -> None:
    """Copy into a cloud-optimized file; JPEG takes one or three bands of bytes only."""
    jpeg = packing.compress == "jpeg" and source.dtype == "uint8" and source.bands in (1, 3)
    options: dict[str, Any] = {
        "BLOCKSIZE": BLOCK_PX,
        "BIGTIFF": "IF_SAFER",
        "OVERVIEW_RESAMPLING": "AVERAGE",
        "SPARSE_OK": "YES",
        "NUM_THREADS": "2",
    }
    if jpeg:
        options |= {"COMPRESS": "JPEG", "QUALITY": packing.quality}
    else:
        options |= {"COMPRESS": "DEFLATE", "PREDICTOR": "YES"}
    rasterio.shutil.copy(raw, out, driver="COG", **options)


def _check(out: Path, raw: Path, source: CellSource) -> None:
    """What was packed has the size, place and kind of what was written."""
    with rasterio.open(out) as packed, rasterio.open(raw) as written:
        same = (
            packed.shape == written.shape
            and packed.transform == written.transform
            and packed.crs == written.crs
            and packed.count == source.bands
        )
        if not same:
            raise OutputError(f"the file that was written is not what it should be: {out}")


def tags_of(about: About, selection: Selection) -> dict[str, str]:
    """What the file says of itself, without keys: terms, source, layer, dates.

    ACQUISITION_DATE is the date of the imagery as far as it is known; TIFFTAG_DATETIME is there
    only where the day is, for that tag has no shorter form.
    """
    tags = {
        "ORTHONAV_SOURCE": about.source,
        "ORTHONAV_LAYER": about.layer,
        "ORTHONAV_LICENCE": about.licence or "unknown",
        "ORTHONAV_ATTRIBUTION": about.attribution or "",
        "ORTHONAV_NOTE": about.note or "",
        "ORTHONAV_FETCHED": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "ORTHONAV_GSD_M": json.dumps(round(selection.gsd_m, 4)),
        "TIFFTAG_COPYRIGHT": about.attribution or "",
        "TIFFTAG_SOFTWARE": f"orthonav {__version__}",
    }
    if about.date is not None:
        tags["ACQUISITION_DATE"] = about.date.partition("/")[0]
        if "/" in about.date:
            tags["ORTHONAV_DATES"] = about.date
        elif len(about.date) == 10:
            tags["TIFFTAG_DATETIME"] = about.date.replace("-", ":") + " 00:00:00"
    return {name: value for name, value in tags.items() if value}


def _not_written(error: BaseException, out: Path) -> OutputError:
    reason = " ".join(str(error.__cause__ or error).split())[:200]
    free = shutil.disk_usage(out.resolve().parent).free
    full = " (disk full)" if free < 2**20 else ""
    return OutputError(f"cannot write{full} ({reason}); nothing was written: {out}")
