"""From a request to a file: read the capabilities, plan, estimate the cost, fetch, write."""

import logging
import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from orthonav.core.errors import AreaError, FetchError, OutputError
from orthonav.core.files import Progress, no_progress, with_paths
from orthonav.core.geo.swapped import swapped_hint
from orthonav.ground.fetch.client import Client
from orthonav.ground.fetch.download import FetchedCells, FileCache, fetch_cells
from orthonav.ground.fetch.grid import Selection, select
from orthonav.ground.fetch.options import Provenance, SourceSpec
from orthonav.ground.fetch.politeness import RequestLimits, Stopped
from orthonav.ground.fetch.service import CellSource
from orthonav.ground.fetch.sources import open_cells
from orthonav.ground.fetch.write import Packing, write_mosaic
from orthonav.ground.planning.area import Area

DEFAULT_MAX_TILES = 50_000
"""About 200 km2 at 0.5 m: more than a flight needs, less than a service minds."""
DEFAULT_MAX_MB = 4000.0
DEFAULT_MARGIN_M = 200.0
"""Reference tiles at the border of a map reach beyond its area by less than this."""
_SECONDS_PER_TILE = 0.3
"""Usual latency of a tile service; an assumption for the estimate."""
_BYTES_PER_SECOND = 3e6
"""Usual throughput of a connection; an assumption for the estimate."""
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FetchRequest:
    """Which imagery is fetched, and where it is written."""

    spec: SourceSpec
    """The service and the imagery requested of it."""
    area: Area
    """The area to cover."""
    out: Path
    """The GeoTIFF, .tif or .tiff."""
    margin_m: float = DEFAULT_MARGIN_M
    """Fetched beyond the area, metres."""
    packing: Packing = field(default_factory=Packing)
    """Compression of the file."""
    cache: Path | None = None
    """Folder of fetched cells; None: one beside `out` that is removed at the end."""
    max_tiles: int = DEFAULT_MAX_TILES
    """A fetch of more tiles is refused before it starts."""
    max_mb: float = DEFAULT_MAX_MB
    """A fetch of more megabytes (estimated) is refused before it starts."""
    allow_holes: bool = False
    """Whether the file is written although tiles failed; they are masked."""
    limits: RequestLimits = field(default_factory=RequestLimits)
    """How the service is asked."""

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
    cells: FetchedCells
    valid_share: float
    received_mb: float
    size_bytes: int

    def describe(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "tiles": self.estimate.tiles,
            "gsd_m": round(self.estimate.gsd_m, 4),
            "width_px": self.estimate.width_px,
            "height_px": self.estimate.height_px,
            "images": self.cells.images,
            "from_cache": self.cells.from_cache,
            "not_covered": self.cells.absent,
            "blank": self.cells.blank,
            "placeholders": self.cells.placeholders,
            "failed": dict(self.cells.failed),
            "valid_share": round(self.valid_share, 4),
            "received_mb": round(self.received_mb, 3),
            "size_bytes": self.size_bytes,
            **vars(self.estimate.provenance),
        }

    def holes(self) -> str:
        """Cells without imagery by reason, on one line; empty where there are none."""
        numbers = {
            "failed": self.cells.failed.total(),
            "not covered": self.cells.absent,
            "blank": self.cells.blank,
            "placeholders": self.cells.placeholders,
        }
        return ", ".join(f"{count} {reason}" for reason, count in numbers.items() if count)


def estimate_fetch(request: FetchRequest) -> CostEstimate:
    """Read the service's capabilities and estimate the cost of a fetch. Raises as `fetch` does."""
    with Client(request.limits, request.spec.secrets) as client:
        return _planned(client, request)[2]


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
    with Client(request.limits, request.spec.secrets) as client:
        source, selection, estimate = _planned(client, request)
        _refuse_large(request, estimate)
        started(estimate)
        cache = FileCache(request.cache or request.out.with_name(f"{request.out.name}.tiles"))
        fetched = _fetched(source, selection, client, cache, progress)
        _refuse_holes(request, fetched)
        write_mosaic(request.out, fetched, request.packing, progress)
        received_mb = client.received_bytes / 1e6
    if request.cache is None:
        cache.remove()
    grid = selection.grid
    share = fetched.valid_px / (len(selection.cells) * grid.cell_w_px * grid.cell_h_px)
    size = request.out.stat().st_size
    result = FetchResult(estimate, fetched, share, received_mb, size)
    if result.holes():
        log.warning("of %d tiles: %s; masked in the file", estimate.tiles, result.holes())
    return result


def _planned(client: Client, request: FetchRequest) -> tuple[CellSource, Selection, CostEstimate]:
    if not (math.isfinite(request.margin_m) and request.margin_m >= 0):
        raise FetchError(f"margin must be 0 m or more, got {request.margin_m}")
    source = open_cells(client, request.spec, request.area)
    selection = _selected(source, request)
    height, width = selection.shape_px
    tiles = len(selection.cells)
    size = tiles * source.cell_bytes
    seconds = max(
        tiles / request.limits.per_second,
        tiles * _SECONDS_PER_TILE / max(1, request.limits.parallel),
        size / _BYTES_PER_SECOND,
    )
    estimate = CostEstimate(
        tiles, selection.gsd_m, width, height, size / 1e6, seconds / 60, source.provenance
    )
    return source, selection, estimate


def _selected(source: CellSource, request: FetchRequest) -> Selection:
    """The cells of the area. Raises `AreaError`, which names swapped coordinates as the cause."""
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


def _refuse_large(request: FetchRequest, estimate: CostEstimate) -> None:
    limit = ""
    if estimate.tiles > request.max_tiles:
        limit = f"--max-tiles {request.max_tiles}"
    elif estimate.megabytes > request.max_mb:
        limit = f"--max-mb {request.max_mb:g}"
    if limit:
        raise FetchError(
            f"this would fetch {estimate.text()}: more than {limit}; choose coarser pixels "
            "(--gsd-m), a part of the area, or raise the limit"
        )


def _fetched(
    source: CellSource, selection: Selection, client: Client, cache: FileCache, progress: Progress
) -> FetchedCells:
    try:
        return fetch_cells(source, selection, client, cache, progress)
    except Stopped:
        raise KeyboardInterrupt from None
    except FetchError as error:
        raise FetchError(f"{error}; {_resume_hint(cache)}") from None


def _refuse_holes(request: FetchRequest, fetched: FetchedCells) -> None:
    failed = fetched.failed.total()
    if not failed or request.allow_holes:
        return
    common = fetched.failed.most_common(4)
    reasons = ", ".join(f"{reason}: {count}" for reason, count in common)
    raise FetchError(
        f"{failed} of {len(fetched.digests)} tiles failed ({reasons}; for example "
        f"{fetched.examples[common[0][0]]}); nothing was written; {_resume_hint(fetched.cache)}; "
        "--allow-holes writes the file without them"
    )


def _resume_hint(cache: FileCache) -> str:
    return f"fetched tiles are stored, rerun the command to resume: {cache.folder}"


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
