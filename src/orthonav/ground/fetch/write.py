"""Cells into one cloud-optimized GeoTIFF, block by block, whole or not at all."""

import json
import tempfile
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.enums import ColorInterp
from rasterio.errors import RasterioError
from rasterio.transform import Affine
from rasterio.windows import Window

from orthonav import __version__
from orthonav.core.errors import FetchError, OutputError
from orthonav.core.files import Progress, not_written, replacing
from orthonav.ground.fetch.download import FetchedCells
from orthonav.ground.fetch.grid import Selection
from orthonav.ground.fetch.options import Provenance
from orthonav.ground.fetch.service import CellSource

BLOCK_PX = 512
"""GDAL's default block of a COG."""
GDAL_OPTIONS = {
    "GDAL_TIFF_INTERNAL_MASK": "YES",
    "GDAL_CACHEMAX": 128 * 2**20,
    "GDAL_NUM_THREADS": "2",
}


@dataclass(frozen=True)
class Packing:
    """Compression of the file: `compress` jpeg or deflate, `quality` of JPEG, 1 to 100."""

    compress: str = "jpeg"
    quality: int = 90


def write_mosaic(out: Path, fetched: FetchedCells, packing: Packing, progress: Progress) -> None:
    """Write the cells as one GeoTIFF, with missing ones masked, and count them in `fetched`.

    Raises `FetchError` where no pixel is valid, `OutputError` where the file cannot be written.
    """
    with (
        replacing(out) as temporary,
        tempfile.TemporaryDirectory(
            prefix=f".{out.name}.", suffix=".tmp", dir=temporary.parent
        ) as folder,
        rasterio.Env(**GDAL_OPTIONS),
    ):
        raw = Path(folder) / "mosaic.tif"
        try:
            _write_raw(raw, fetched, progress)
            if fetched.valid_px == 0:
                raise FetchError("the service has no imagery of this area in this layer")
            progress("pack", 0.1)
            _pack(raw, temporary, fetched.source, packing)
            _verify(temporary, raw, fetched.source)
            progress("pack", 1.0)
        except (RasterioError, MemoryError) as error:
            raise not_written(error.__cause__ or error, out) from error


def _write_raw(raw: Path, fetched: FetchedCells, progress: Progress) -> None:
    """The mosaic as a sparse tiled file."""
    source, selection = fetched.source, fetched.selection
    placeholders = fetched.are_placeholders
    with rasterio.open(raw, "w", **_profile(source, selection)) as dataset:
        dataset.update_tags(**tags_of(source.provenance, selection))
        if source.bands == 3:
            dataset.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
        for number, (row, col) in enumerate(selection.cells.tolist()):
            if fetched.digests[number] == 0:
                continue
            if placeholders[number]:
                fetched.placeholders += 1
                continue
            _write_cell(dataset, fetched, row, col)
            progress("mosaic", (number + 1) / len(selection.cells))


def _profile(source: CellSource, selection: Selection) -> dict[str, Any]:
    """How the sparse file is laid out.

    It is compressed only where cells consist of whole blocks: a compressed block that is written
    twice leaves its first version in the file.
    """
    grid = selection.grid
    height, width = selection.shape_px
    west, north = grid.corner(*selection.first)
    cell = min(grid.cell_w_px, grid.cell_h_px, BLOCK_PX)
    block = cell if cell % 16 == 0 and grid.cell_w_px % cell == grid.cell_h_px % cell == 0 else 256
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
    if grid.cell_w_px % block == grid.cell_h_px % block == 0:
        profile |= {"compress": "DEFLATE", "zlevel": 1}
    return profile


def _write_cell(dataset: Any, fetched: FetchedCells, row: int, col: int) -> None:
    entry = fetched.cache.read(fetched.source.address(row, col))
    if entry is None or entry.body is None:
        raise OutputError(f"a fetched cell is missing from the cache: {fetched.cache.folder}")
    pixels = fetched.source.decode(entry.body)
    if pixels.blank:
        fetched.blank += 1
        return
    height, width = pixels.valid.shape
    first_row, first_col = fetched.selection.first
    window = Window((col - first_col) * width, (row - first_row) * height, width, height)
    dataset.write(np.where(pixels.valid, pixels.bands, 0), window=window)
    dataset.write_mask(np.where(pixels.valid, 255, 0).astype(np.uint8), window=window)
    fetched.images += 1
    fetched.valid_px += int(pixels.valid.sum())


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


def _verify(out: Path, raw: Path, source: CellSource) -> None:
    """Raise `OutputError` unless the packed file has the size, place and bands of the raw one."""
    with rasterio.open(out) as packed, rasterio.open(raw) as written:
        same = (
            packed.shape == written.shape
            and packed.transform == written.transform
            and packed.crs == written.crs
            and packed.count == source.bands
        )
        if not same:
            raise OutputError(f"the packed file differs from the mosaic: {out}")


def tags_of(provenance: Provenance, selection: Selection) -> dict[str, str]:
    """Origin, terms and dates as tags of the file, without keys.

    ACQUISITION_DATE is the date of the imagery as far as it is known; TIFFTAG_DATETIME exists only
    where the day is known, because that tag has no shorter form.
    """
    tags = {
        "ORTHONAV_SOURCE": provenance.source,
        "ORTHONAV_LAYER": provenance.layer,
        "ORTHONAV_LICENCE": provenance.licence or "unknown",
        "ORTHONAV_ATTRIBUTION": provenance.attribution or "",
        "ORTHONAV_NOTE": provenance.note or "",
        "ORTHONAV_VERTICAL_DATUM": provenance.datum or "",
        "ORTHONAV_FETCHED": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "ORTHONAV_GSD_M": json.dumps(round(selection.gsd_m, 4)),
        "TIFFTAG_COPYRIGHT": provenance.attribution or "",
        "TIFFTAG_SOFTWARE": f"orthonav {__version__}",
    }
    date = provenance.date
    if date is not None:
        tags["ACQUISITION_DATE"] = date.partition("/")[0]
        if "/" in date:
            tags["ORTHONAV_DATES"] = date
        elif len(date) == 10:
            tags["TIFFTAG_DATETIME"] = date.replace("-", ":") + " 00:00:00"
    return {name: value for name, value in tags.items() if value}
