"""From a request to a cloud-optimized GeoTIFF: read the capabilities, plan, fetch, write."""

import hashlib
import json
import logging
import math
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
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
from orthonav.core.errors import FetchError, OutputError, UsageError
from orthonav.core.files import Progress, no_progress, not_written, replacing
from orthonav.ground.fetch.files import cog_source, stac_source
from orthonav.ground.fetch.grid import Selection, select
from orthonav.ground.fetch.presets import Provenance, SourceSpec
from orthonav.ground.fetch.service import CellPixels, CellReader, CellSource
from orthonav.ground.fetch.tiles import wcs_cells, wms_cells, wmts_tiles, xyz_tiles
from orthonav.ground.fetch.web import RequestLimits, Web
from orthonav.ground.planning.area import Area

BESIDE = {"terrain": ("dem", 1000.0), "surface": ("dsm", 0.0)}
"""Heights fetched beside imagery: end of the file's name, and metres beyond the imagery, as a view
from 450 m sees so far 65 deg off nadir; a surface is used below the imagery only."""
GIVE_UP_AFTER = 20  # failed cells in a row after which the service counts as down
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FetchRequest:
    """Which imagery is fetched, and where it is written."""

    spec: SourceSpec
    area: Area
    out: Path  # the GeoTIFF, .tif or .tiff
    margin_m: float = 200.0  # fetched beyond the area, as tiles of a map reach beyond its border
    compress: str = "jpeg"  # of quality 90, or deflate
    max_mb: float = 2000.0  # a fetch of more, as estimated, is refused before it starts
    allow_holes: bool = False  # whether the file is written although tiles failed
    limits: RequestLimits = field(default_factory=RequestLimits)

    @property
    def cache(self) -> Path:
        """Folder of the tiles, from which an interrupted fetch resumes."""
        return self.out.resolve().with_name(f"{self.out.name}.tiles")


@dataclass(frozen=True)
class CostEstimate:
    tiles: int
    gsd_m: float
    width_px: int
    height_px: int
    megabytes: float
    minutes: float
    provenance: Provenance

    def text(self) -> str:
        minutes = "less than a minute" if self.minutes < 1 else f"about {self.minutes:.0f} minutes"
        return (
            f"{self.tiles} tiles, {self.width_px} x {self.height_px} px of {self.gsd_m:.3g} m, "
            f"about {max(self.megabytes, 0.1):.3g} MB, {minutes}"
        )


@dataclass(eq=False)
class FetchResult:
    estimate: CostEstimate
    images: int = 0
    not_covered: int = 0  # without imagery, as the service reports
    blank: int = 0  # wholly black or white
    placeholders: int = 0  # with the same image as another: no two orthophotos agree
    failed: Counter[str] = field(default_factory=Counter)  # by reason
    example: str = ""  # a whole message of a failure
    valid_share: float = 0.0  # fraction of valid pixels, 0 to 1
    size_bytes: int = 0

    def holes(self) -> str:
        """Cells without imagery by reason, on one line; empty where there are none."""
        names = ("failed", "not covered", "blank", "placeholders")
        numbers = (self.failed.total(), self.not_covered, self.blank, self.placeholders)
        counted = zip(numbers, names, strict=True)
        return ", ".join(f"{number} {name}" for number, name in counted if number)

    def describe(self) -> dict[str, Any]:
        own = {name: value for name, value in vars(self).items() if name != "example"}
        estimate = own.pop("estimate")
        return {
            "tiles": estimate.tiles,
            "gsd_m": round(estimate.gsd_m, 4),
            "width_px": estimate.width_px,
            "height_px": estimate.height_px,
            **own,
            "failed": dict(self.failed),
            "valid_share": round(self.valid_share, 4),
            **vars(estimate.provenance),
        }


def estimate_fetch(request: FetchRequest) -> CostEstimate:
    """Read the service's capabilities and estimate the cost of a fetch. Raises as `fetch` does."""
    with Web(request.limits, request.spec.secrets) as web:
        return _planned(web, request)[2]


def fetch(
    request: FetchRequest,
    progress: Progress = no_progress,
    started: Callable[[CostEstimate], None] = lambda estimate: None,
) -> FetchResult:
    """Fetch the imagery and write `request.out`, whole or not at all.

    `started` receives the estimate before the first tile. Raises `FetchError` where the service
    has no such imagery, answers wrongly, or tiles failed (what arrived stays in the cache, and the
    same request resumes), `AreaError` where the area lies outside the service's coverage,
    `OutputError` where the file cannot be written.
    """
    if request.out.suffix.lower() not in (".tif", ".tiff"):
        raise UsageError(f"--out must be a .tif file, got: {request.out}")
    if request.out.exists() and not request.out.is_file():
        raise OutputError(f"cannot write over a folder or a device: {request.out}")
    with Web(request.limits, request.spec.secrets) as web:
        source, selection, estimate = _planned(web, request)
        if estimate.megabytes > request.max_mb:
            raise FetchError(
                f"this would fetch {estimate.text()}: more than --max-mb {request.max_mb:g}; "
                "choose coarser pixels (--gsd-m), a part of the area, or raise the limit"
            )
        started(estimate)
        result = FetchResult(estimate)
        with _tiles_in(request.cache) as folder:
            read = source.reader(web, selection, request.cache)
            _write_mosaic(request, source, selection, read, folder, result, progress)
    if result.holes():
        log.warning("of %d tiles: %s; masked in the file", estimate.tiles, result.holes())
    result.size_bytes = request.out.stat().st_size
    return result


@contextmanager
def _tiles_in(cache: Path) -> Iterator[Path]:
    """A temporary folder within that of the tiles, which is kept after an error if it has some."""
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="mosaic-", dir=cache) as folder:
            yield Path(folder)
    except FetchError as error:
        if not any(cache.iterdir()):
            cache.rmdir()
            raise
        stored = f"fetched tiles are stored, rerun the command to resume: {cache}"
        raise FetchError(f"{error}; {stored}") from None
    except OutputError:
        raise
    except OSError as error:
        raise not_written(error, cache) from error
    # GDAL and this program make only such names.
    if all(re.fullmatch(r"[0-9a-f]|mosaic-\w+", path.name) for path in cache.iterdir()):
        shutil.rmtree(cache, ignore_errors=True)


def holds_heights(path: Path) -> bool:
    """Whether a fetched file has one band of signed numbers, which is no imagery."""
    with rasterio.open(path) as data:
        return bool(data.count == 1 and data.dtypes[0].startswith(("float", "int")))


def fetch_heights(
    imagery: FetchRequest, kind: str, spec: SourceSpec, progress: Progress = no_progress
) -> tuple[Path, FetchResult]:
    """The file of heights of a source, fetched beside imagery of another, and the result; `kind` as
    in `BESIDE`.

    Raises as `fetch`, and `OutputError` where a file that was not fetched has that name.
    """
    end, beyond_m = BESIDE[kind]
    out = imagery.out.with_name(f"{imagery.out.stem}_{end}{imagery.out.suffix}")
    if out.exists():
        fetched = False
        with suppress(RasterioError), rasterio.open(out) as data:
            fetched = "ORTHONAV_FETCHED" in data.tags()
        if not fetched:
            raise OutputError(f"the file exists and is not a fetched one: {out}")
    wider_m = imagery.margin_m + beyond_m
    return out, fetch(replace(imagery, spec=spec, out=out, margin_m=wider_m), progress)


def _planned(web: Web, request: FetchRequest) -> tuple[CellSource, Selection, CostEstimate]:
    if not (math.isfinite(request.margin_m) and request.margin_m >= 0):
        raise UsageError(f"margin must be 0 m or more, got {request.margin_m}")
    spec, area, margin_m = request.spec, request.area, request.margin_m
    by_protocol: dict[str, Callable[[], CellSource]] = {
        "wmts": lambda: wmts_tiles(web, spec, area),
        "wms": lambda: wms_cells(web, spec, area),
        "wcs": lambda: wcs_cells(web, spec, area),
        "xyz": lambda: xyz_tiles(spec, area),
        "cog": lambda: cog_source(web, spec, area, [spec.url]),
        "stac": lambda: stac_source(web, spec, area, margin_m),
    }
    source = by_protocol[spec.protocol]()
    selection = select(source.grid, area, margin_m)
    height, width = selection.shape_px
    tiles = len(selection.cells)
    size = tiles * source.cell_bytes
    # Assumed: a usual latency of 0.3 s, and a connection of 3 MB per second.
    seconds = max(tiles * 0.3 / request.limits.parallel, size / 3e6)
    estimate = CostEstimate(
        tiles, selection.gsd_m, width, height, size / 1e6, seconds / 60, source.provenance
    )
    return source, selection, estimate


def _write_mosaic(
    request: FetchRequest,
    source: CellSource,
    selection: Selection,
    read: CellReader,
    folder: Path,
    result: FetchResult,
    progress: Progress,
) -> None:
    """The raw mosaic is written into `folder` first; missing cells are masked."""
    raw = folder / "mosaic.tif"
    try:
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK="YES", GDAL_CACHEMAX=128 * 2**20):
            with rasterio.open(raw, "w", **_profile(source, selection)) as dataset:
                dataset.update_tags(**_tags(source.provenance, selection))
                if source.bands == 3:
                    dataset.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
                _write_cells(dataset, selection, read, result, request.limits.parallel, progress)
            if result.failed and not request.allow_holes:
                reasons = ", ".join(f"{why}: {n}" for why, n in result.failed.most_common(4))
                raise FetchError(
                    f"{result.failed.total()} of {len(selection.cells)} tiles failed ({reasons}; "
                    f"for example {result.example}); nothing was written; --allow-holes writes the "
                    "file without them"
                )
            if result.valid_share == 0:
                raise FetchError("the service has no imagery of this area in this layer")
            progress("pack", 0.1)
            with replacing(request.out) as temporary:
                _pack(raw, temporary, request)
            progress("pack", 1.0)
    except (RasterioError, MemoryError) as error:
        raise not_written(error.__cause__ or error, request.out) from error


def _write_cells(
    dataset: Any,
    selection: Selection,
    read: CellReader,
    result: FetchResult,
    parallel: int,
    progress: Progress,
) -> None:
    row0, col0 = selection.first
    valid_px = in_a_row = 0
    written: dict[bytes, list[tuple[Window, int]]] = {}
    for number, ((row, col), found) in enumerate(_read_cells(selection, read, parallel), start=1):
        progress("fetch", number / len(selection.cells))
        in_a_row = in_a_row + 1 if isinstance(found, FetchError) else 0
        if in_a_row >= GIVE_UP_AFTER:
            raise FetchError(f"{in_a_row} requests in a row failed, the last: {found}")
        if isinstance(found, FetchError):
            log.info("not fetched: %s", found)
            result.failed[str(found).partition(" (")[0].partition(": http")[0]] += 1
            result.example = result.example or str(found)
        elif not found.valid.any():
            result.not_covered += 1
        elif found.blank:
            result.blank += 1
        else:
            height, width = found.valid.shape
            window = Window((col - col0) * width, (row - row0) * height, width, height)
            _write(dataset, window, found)
            digest = hashlib.sha256(found.bands.tobytes()).digest()
            written.setdefault(digest, []).append((window, int(found.valid.sum())))
    for same in written.values():
        if len(same) == 1:
            result.images += 1
            valid_px += same[0][1]
            continue
        result.placeholders += len(same)
        for window, _ in same:
            shape = window.height, window.width
            nothing = np.zeros((dataset.count, *shape), dataset.dtypes[0])
            _write(dataset, window, CellPixels(nothing, np.zeros(shape, dtype=bool)))
    cell_px = selection.grid.cell_w_px * selection.grid.cell_h_px
    result.valid_share = valid_px / (len(selection.cells) * cell_px)


def _read_cells(
    selection: Selection, read: CellReader, parallel: int
) -> Iterator[tuple[list[int], CellPixels | FetchError]]:

    def read_one(cell: list[int]) -> tuple[list[int], CellPixels | FetchError]:
        try:
            return cell, read(*cell)
        except FetchError as error:
            return cell, error

    cells, batch = selection.cells.tolist(), parallel * 8  # that may wait until they are written
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


def _pack(raw: Path, out: Path, request: FetchRequest) -> None:
    """Copy into a cloud-optimized file; JPEG takes one or three bands of bytes only.

    Raises `OutputError` unless its size, place and bands are those of the raw one."""
    options: dict[str, Any] = {
        "BLOCKSIZE": 512,
        "BIGTIFF": "IF_SAFER",
        "OVERVIEW_RESAMPLING": "AVERAGE",
        "SPARSE_OK": "YES",
        "NUM_THREADS": "2",
        "COMPRESS": "DEFLATE",
        "PREDICTOR": "YES",
    }
    with rasterio.open(raw) as written:
        bytes_only = set(written.dtypes) == {"uint8"} and written.count in (1, 3)
        if request.compress == "jpeg" and bytes_only:
            options |= {"COMPRESS": "JPEG", "QUALITY": 90, "PREDICTOR": "NO"}
        rasterio.shutil.copy(raw, out, driver="COG", **options)
        with rasterio.open(out) as packed:
            for name in ("shape", "transform", "crs", "count"):
                if getattr(packed, name) != getattr(written, name):
                    raise OutputError(f"the packed file differs from the mosaic: {out}")


def _tags(provenance: Provenance, selection: Selection) -> dict[str, str]:
    """TIFFTAG_DATETIME exists only where the day is known: that tag has no shorter form."""
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
