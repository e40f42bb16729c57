"""Cells read in parallel into one cloud-optimized GeoTIFF, whole or not at all."""

import hashlib
import json
import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.enums import ColorInterp
from rasterio.errors import RasterioError
from rasterio.windows import Window

from orthonav import __version__
from orthonav.core.errors import FetchError, OutputError
from orthonav.core.files import Progress, not_written, replacing
from orthonav.ground.fetch.grid import Selection
from orthonav.ground.fetch.options import Provenance
from orthonav.ground.fetch.service import CellPixels, CellReader, CellSource

BLOCK_PX = 512  # GDAL's default block of a COG
GDAL_OPTIONS = {
    "GDAL_TIFF_INTERNAL_MASK": "YES",
    "GDAL_CACHEMAX": 128 * 2**20,
}
GIVE_UP_AFTER = 20  # failed cells in a row after which the service counts as down
_BATCH_PER_THREAD = 8  # cells that may wait in memory until they are written
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Packing:
    """Compression of the file: `compress` jpeg or deflate, `quality` of JPEG, 1 to 100."""

    compress: str = "jpeg"
    quality: int = 90


@dataclass(eq=False)
class CellCounts:
    """What became of the cells of a selection."""

    images: int = 0
    absent: int = 0  # without imagery, as the service reports
    blank: int = 0  # wholly black or white
    placeholders: int = 0  # with the same image as another: no two orthophotos agree
    failed: Counter[str] = field(default_factory=Counter)  # by reason
    examples: dict[str, str] = field(default_factory=dict)  # a whole message for each reason
    valid_px: int = 0

    def holes(self) -> str:
        """Cells without imagery by reason, on one line; empty where there are none."""
        names = ("failed", "not covered", "blank", "placeholders")
        numbers = (self.failed.total(), self.absent, self.blank, self.placeholders)
        counted = zip(numbers, names, strict=True)
        return ", ".join(f"{number} {name}" for number, name in counted if number)

    def add_failure(self, error: FetchError) -> None:
        """Count a cell that failed."""
        reason = str(error).partition(" (")[0].partition(": http")[0]
        self.failed[reason] += 1
        self.examples.setdefault(reason, str(error))
        log.info("not fetched: %s", error)

    def failure(self, cells: int) -> str:
        """Why nothing was written."""
        common = self.failed.most_common(4)
        reasons = ", ".join(f"{reason}: {count}" for reason, count in common)
        return (
            f"{self.failed.total()} of {cells} tiles failed ({reasons}; for example "
            f"{self.examples[common[0][0]]}); nothing was written; --allow-holes writes the file "
            "without them"
        )


def write_mosaic(
    out: Path,
    source: CellSource,
    selection: Selection,
    read: CellReader,
    folder: Path,
    packing: Packing,
    progress: Progress,
    *,
    parallel: int,
    allow_holes: bool,
) -> CellCounts:
    """Read the cells and write them as one GeoTIFF, with missing ones masked.

    The raw mosaic is written into `folder` first. Raises `FetchError` where cells failed, unless
    `allow_holes`, and where no pixel is valid; `OutputError` where the file cannot be written.
    """
    raw = folder / "mosaic.tif"
    try:
        with rasterio.Env(**GDAL_OPTIONS):
            with rasterio.open(raw, "w", **_profile(source, selection)) as dataset:
                dataset.update_tags(**tags_of(source.provenance, selection))
                if source.bands == 3:
                    dataset.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
                counts = _write_cells(dataset, selection, read, parallel, progress)
            if counts.failed and not allow_holes:
                raise FetchError(counts.failure(len(selection.cells)))
            if counts.valid_px == 0:
                raise FetchError("the service has no imagery of this area in this layer")
            progress("pack", 0.1)
            with replacing(out) as temporary:
                _pack(raw, temporary, packing)
            progress("pack", 1.0)
    except (RasterioError, MemoryError) as error:
        raise not_written(error.__cause__ or error, out) from error
    return counts


def _write_cells(
    dataset: Any, selection: Selection, read: CellReader, parallel: int, progress: Progress
) -> CellCounts:
    counts, (row0, col0) = CellCounts(), selection.first
    written: dict[bytes, list[tuple[Window, int]]] = {}
    in_a_row = 0
    for number, ((row, col), found) in enumerate(_read_cells(selection, read, parallel), start=1):
        progress("fetch", number / len(selection.cells))
        in_a_row = in_a_row + 1 if isinstance(found, FetchError) else 0
        if in_a_row >= GIVE_UP_AFTER:
            raise FetchError(f"{in_a_row} requests in a row failed, the last: {found}")
        if isinstance(found, FetchError):
            counts.add_failure(found)
        elif not found.valid.any():
            counts.absent += 1
        elif found.blank:
            counts.blank += 1
        else:
            height, width = found.valid.shape
            window = Window((col - col0) * width, (row - row0) * height, width, height)
            _write(dataset, window, found)
            digest = hashlib.sha256(found.bands.tobytes()).digest()
            written.setdefault(digest, []).append((window, int(found.valid.sum())))
    for same in written.values():
        if len(same) == 1:
            counts.images += 1
            counts.valid_px += same[0][1]
            continue
        counts.placeholders += len(same)
        for window, _ in same:
            shape = window.height, window.width
            nothing = np.zeros((dataset.count, *shape), dataset.dtypes[0])
            _write(dataset, window, CellPixels(nothing, np.zeros(shape, dtype=bool)))
    return counts


def _read_cells(
    selection: Selection, read: CellReader, parallel: int
) -> Iterator[tuple[list[int], CellPixels | FetchError]]:

    def read_one(cell: list[int]) -> tuple[list[int], CellPixels | FetchError]:
        try:
            return cell, read(*cell)
        except FetchError as error:
            return cell, error

    cells, batch = selection.cells.tolist(), parallel * _BATCH_PER_THREAD
    # Its threads are daemons and are not joined. Those of `ThreadPoolExecutor` would delay the
    # end of the program after an error or an interrupt until the last server has answered.
    with ThreadPool(parallel) as pool:
        for start in range(0, len(cells), batch):
            yield from pool.imap_unordered(read_one, cells[start : start + batch])


def _write(dataset: Any, window: Window, pixels: CellPixels) -> None:
    dataset.write(np.where(pixels.valid, pixels.bands, 0), window=window)
    dataset.write_mask(np.where(pixels.valid, 255, 0).astype(np.uint8), window=window)


def _profile(source: CellSource, selection: Selection) -> dict[str, Any]:
    """How the raw file is laid out: blocks that are not written take no space."""
    height, width = selection.shape_px
    return {
        "driver": "GTiff",
        "width": width,
        "height": height,
        "count": source.bands,
        "dtype": source.dtype,
        "crs": selection.grid.crs,
        "transform": selection.grid.transform(*selection.first),
        "tiled": True,
        "bigtiff": "YES",
        "sparse_ok": True,
        "interleave": "pixel",
        "photometric": "RGB" if source.bands == 3 else "MINISBLACK",
    }


def _pack(raw: Path, out: Path, packing: Packing) -> None:
    """Copy into a cloud-optimized file; JPEG takes one or three bands of bytes only.

    Raises `OutputError` unless its size, place and bands are those of the raw one.
    """
    options: dict[str, Any] = {
        "BLOCKSIZE": BLOCK_PX,
        "BIGTIFF": "IF_SAFER",
        "OVERVIEW_RESAMPLING": "AVERAGE",
        "SPARSE_OK": "YES",
        "NUM_THREADS": "2",
        "COMPRESS": "DEFLATE",
        "PREDICTOR": "YES",
    }
    with rasterio.open(raw) as written:
        bytes_only = set(written.dtypes) == {"uint8"} and written.count in (1, 3)
        if packing.compress == "jpeg" and bytes_only:
            options |= {"COMPRESS": "JPEG", "QUALITY": packing.quality, "PREDICTOR": "NO"}
        rasterio.shutil.copy(raw, out, driver="COG", **options)
        with rasterio.open(out) as packed:
            for name in ("shape", "transform", "crs", "count"):
                if getattr(packed, name) != getattr(written, name):
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
