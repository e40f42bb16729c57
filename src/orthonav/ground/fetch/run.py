"""From a request to a file: read the capabilities, plan, estimate the cost, fetch, write."""

import logging
import math
import re
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from orthonav.core.errors import AreaError, FetchError, OutputError
from orthonav.core.files import Progress, no_progress, not_written, with_paths
from orthonav.core.geo.swapped import swapped_hint
from orthonav.ground.fetch.cog import cog_source
from orthonav.ground.fetch.grid import Selection, select
from orthonav.ground.fetch.mosaic import CellCounts, Packing, write_mosaic
from orthonav.ground.fetch.options import Provenance, SourceSpec
from orthonav.ground.fetch.service import CellSource
from orthonav.ground.fetch.stac import find_files
from orthonav.ground.fetch.web import RequestLimits, Web
from orthonav.ground.fetch.wms import wms_cells
from orthonav.ground.fetch.wmts import wmts_tiles
from orthonav.ground.fetch.xyz import xyz_tiles
from orthonav.ground.planning.area import Area

DEFAULT_MAX_TILES = 50_000
"""About 200 km2 at 0.5 m: more than a flight needs, less than a service minds."""
DEFAULT_MAX_MB = 4000.0
DEFAULT_MARGIN_M = 200.0
"""Reference tiles at the border of a map reach beyond its area by less than this."""
_SECONDS_PER_TILE = 0.3  # usual latency of a tile service; an assumption for the estimate
_BYTES_PER_SECOND = 3e6  # usual throughput of a connection; an assumption for the estimate
_OURS = re.compile(r"[0-9a-f]|mosaic-\w+")  # names in a cache that GDAL and this program make
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FetchRequest:
    """Which imagery is fetched, and where it is written."""

    spec: SourceSpec
    area: Area
    out: Path  # the GeoTIFF, .tif or .tiff
    margin_m: float = DEFAULT_MARGIN_M  # fetched beyond the area
    packing: Packing = field(default_factory=Packing)
    cache: Path | None = None  # folder of tiles; None: beside `out`, removed at the end
    max_tiles: int = DEFAULT_MAX_TILES  # a fetch of more is refused before it starts
    max_mb: float = DEFAULT_MAX_MB  # likewise, as estimated
    allow_holes: bool = False  # whether the file is written although tiles failed
    limits: RequestLimits = field(default_factory=RequestLimits)

    def __post_init__(self) -> None:
        with_paths(self, "out", "cache")


@dataclass(frozen=True)
class CostEstimate:
    """Expected cost of a fetch, from usual tiles."""

    tiles: int
    gsd_m: float
    width_px: int
    height_px: int
    megabytes: float
    minutes: float
    provenance: Provenance

    def text(self) -> str:
        """One line for people."""
        minutes = "less than a minute" if self.minutes < 1 else f"about {self.minutes:.0f} minutes"
        return (
            f"{self.tiles} tiles, {self.width_px} x {self.height_px} px of {self.gsd_m:.3g} m, "
            f"about {max(self.megabytes, 0.1):.3g} MB, {minutes}"
        )


@dataclass(frozen=True)
class FetchResult:
    """What was fetched: cells by outcome, and the share of valid pixels, 0 to 1."""

    estimate: CostEstimate
    cells: CellCounts
    valid_share: float
    size_bytes: int

    def describe(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "tiles": self.estimate.tiles,
            "gsd_m": round(self.estimate.gsd_m, 4),
            "width_px": self.estimate.width_px,
            "height_px": self.estimate.height_px,
            "images": self.cells.images,
            "not_covered": self.cells.absent,
            "blank": self.cells.blank,
            "placeholders": self.cells.placeholders,
            "failed": dict(self.cells.failed),
            "valid_share": round(self.valid_share, 4),
            "size_bytes": self.size_bytes,
            **vars(self.estimate.provenance),
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
    _check_out(request.out)
    cache = request.cache or request.out.resolve().with_name(f"{request.out.name}.tiles")
    with Web(request.limits, request.spec.secrets) as web:
        source, selection, estimate = _planned(web, request)
        limits = {
            f"--max-tiles {request.max_tiles}": estimate.tiles > request.max_tiles,
            f"--max-mb {request.max_mb:g}": estimate.megabytes > request.max_mb,
        }
        for limit in (name for name, exceeded in limits.items() if exceeded):
            raise FetchError(
                f"this would fetch {estimate.text()}: more than {limit}; choose coarser pixels "
                "(--gsd-m), a part of the area, or raise the limit"
            )
        started(estimate)
        if selection.is_cut:
            log.warning("part of the area lies outside what the service covers")
        try:
            cache.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix="mosaic-", dir=cache) as folder:
                cells = write_mosaic(
                    request.out,
                    source,
                    selection,
                    source.reader(web, selection, cache),
                    Path(folder),
                    request.packing,
                    progress,
                    parallel=request.limits.parallel,
                    allow_holes=request.allow_holes,
                )
        except FetchError as error:
            if any(cache.iterdir()):
                stored = f"fetched tiles are stored, rerun the command to resume: {cache}"
                raise FetchError(f"{error}; {stored}") from None
            cache.rmdir()
            raise
        except OutputError:
            raise
        except OSError as error:
            raise not_written(error, cache) from error
    if request.cache is None and all(_OURS.fullmatch(path.name) for path in cache.iterdir()):
        shutil.rmtree(cache, ignore_errors=True)
    grid = selection.grid
    share = cells.valid_px / (len(selection.cells) * grid.cell_w_px * grid.cell_h_px)
    if cells.holes():
        log.warning("of %d tiles: %s; masked in the file", estimate.tiles, cells.holes())
    return FetchResult(estimate, cells, share, request.out.stat().st_size)


def _planned(web: Web, request: FetchRequest) -> tuple[CellSource, Selection, CostEstimate]:
    if not (math.isfinite(request.margin_m) and request.margin_m >= 0):
        raise FetchError(f"margin must be 0 m or more, got {request.margin_m}")
    source = open_cells(web, request.spec, request.area)
    selection = _selected(source, request)
    height, width = selection.shape_px
    tiles = len(selection.cells)
    size = tiles * source.cell_bytes
    seconds = max(tiles * _SECONDS_PER_TILE / request.limits.parallel, size / _BYTES_PER_SECOND)
    estimate = CostEstimate(
        tiles, selection.gsd_m, width, height, size / 1e6, seconds / 60, source.provenance
    )
    return source, selection, estimate


def open_cells(web: Web, spec: SourceSpec, area: Area) -> CellSource:
    """The cells of the imagery requested, after reading the service's capabilities.

    Raises `FetchError` with the available choices where it has no such layer, style, zoom or time.
    """
    if spec.protocol == "wmts":
        return wmts_tiles(web, spec, area)
    if spec.protocol == "wms":
        return wms_cells(web, spec, area)
    if spec.protocol in ("xyz", "tms"):
        return xyz_tiles(spec, area)
    if spec.protocol == "cog":
        return cog_source(web, spec, area, [spec.url])
    west, south, east, north = area.extent_en_m
    corners = [(west, south), (west, north), (east, south), (east, north)]
    lat, lon = area.frame.latlon_from_en(corners)
    box = (float(lon.min()), float(lat.min()), float(lon.max()), float(lat.max()))
    urls, date = find_files(web, spec, box)
    provenance = replace(spec.provenance, date=date or spec.provenance.date)
    return cog_source(web, replace(spec, provenance=provenance), area, urls)


def _selected(source: CellSource, request: FetchRequest) -> Selection:
    frame = request.area.frame

    def covered(lat_deg: float, lon_deg: float) -> bool:
        half_deg = 1e-4
        place = (lon_deg - half_deg, lat_deg - half_deg, lon_deg + half_deg, lat_deg + half_deg)
        try:
            select(source.grid, Area.from_bounds(place), 0.0)
        except (AreaError, FetchError):
            return False
        return True

    try:
        return select(source.grid, request.area, request.margin_m)
    except AreaError as error:
        hint = swapped_hint(frame.lat_deg, frame.lon_deg, covered)
        raise AreaError(f"{error}{hint}") from None


def _check_out(out: Path) -> None:
    if out.suffix.lower() not in (".tif", ".tiff"):
        raise FetchError(f"--out must be a .tif file, got: {out}")
    if out.exists() and not out.is_file():
        raise OutputError(f"cannot write over a folder or a device: {out}")
    try:
        out.resolve().parent.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(out.resolve().parent).free
    except OSError as error:
        raise OutputError(f"cannot write ({error.strerror or error}): {out}") from error
    if free < 2**20:
        raise OutputError(f"disk full; nothing was written: {out}")
