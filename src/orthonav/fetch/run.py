"""From a request to a file: ask the service, plan, say what it will cost, fetch, write."""

import logging
import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from orthonav.errors import FetchError, OutputError
from orthonav.fetch.cache import FileCache
from orthonav.fetch.client import Client
from orthonav.fetch.download import Fetched, fetch_cells
from orthonav.fetch.grid import Selection, select
from orthonav.fetch.politeness import Limits, Stopped
from orthonav.fetch.service import About, CellSource
from orthonav.fetch.sources import SourceSpec, open_cells
from orthonav.fetch.write import Counts, Packing, write_mosaic
from orthonav.geo.area import Area

DEFAULT_MAX_TILES = 50_000
DEFAULT_MAX_MB = 4000.0
DEFAULT_MARGIN_M = 200.0
_SECONDS_PER_TILE = 0.3
"""A usual answer of a tile service, seen from a usual line; a guess for the estimate."""
_BYTES_PER_SECOND = 3e6
log = logging.getLogger(__name__)
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class FetchRequest:
    """What to fetch, and where to. Lengths in metres on the ground.

    `margin_m` is fetched beyond the area, for tiles at its border. `cache` None keeps what comes
    in a folder beside `out`, which is removed when `out` is written. `max_tiles` and `max_mb` end
    a fetch before it starts. With `allow_holes` tiles that failed are left out of the file.
    """

    spec: SourceSpec
    area: Area
    out: Path
    margin_m: float = DEFAULT_MARGIN_M
    packing: Packing = field(default_factory=Packing)
    cache: Path | None = None
    max_tiles: int = DEFAULT_MAX_TILES
    max_mb: float = DEFAULT_MAX_MB
    allow_holes: bool = False
    limits: Limits = field(default_factory=Limits)


@dataclass(frozen=True)
class Estimate:
    """What a fetch will cost, before it starts: a guess from usual tiles."""

    tiles: int
    gsd_m: float
    width_px: int
    height_px: int
    megabytes: float
    minutes: float
    about: About

    def text(self) -> str:
        """One line for people."""
        minutes = "less than a minute" if self.minutes < 1 else f"about {self.minutes:.0f} minutes"
        return (
            f"{self.tiles} tiles, {self.width_px} x {self.height_px} px of {self.gsd_m:.3g} m, "
            f"about {max(self.megabytes, 0.1):.3g} MB, {minutes}"
        )


@dataclass(frozen=True)
class FetchResult:
    """What was fetched: cells by what became of them, and the share of pixels that is valid."""

    estimate: Estimate
    fetched: Fetched
    counts: Counts
    valid_share: float
    received_mb: float
    size_bytes: int

    def describe(self) -> dict[str, Any]:
        """As plain values for JSON."""
        about = self.estimate.about
        return {
            "tiles": self.estimate.tiles,
            "gsd_m": round(self.estimate.gsd_m, 4),
            "width_px": self.estimate.width_px,
            "height_px": self.estimate.height_px,
            "pictures": self.counts.pictures,
            "from_cache": self.fetched.from_cache,
            "not_covered": self.fetched.absent,
            "blank": self.counts.blank,
            "placeholders": self.counts.placeholder,
            "failed": dict(self.fetched.failed),
            "valid_share": round(self.valid_share, 4),
            "received_mb": round(self.received_mb, 3),
            "size_bytes": self.size_bytes,
            "source": about.source,
            "layer": about.layer,
            "date": about.date,
            "licence": about.licence,
            "attribution": about.attribution,
            "note": about.note,
        }


def estimate_fetch(request: FetchRequest) -> Estimate:
    """Ask the service what it has, and say what the fetch would cost. Raises as `fetch` does."""
    with Client(request.limits, request.spec.secrets) as client:
        source, _, estimate = _planned(client, request)
        source.close()
    return estimate


def fetch(
    request: FetchRequest,
    progress: Progress = lambda stage, share: None,
    started: Callable[[Estimate], None] = lambda estimate: None,
) -> FetchResult:
    """Fetch the imagery and write `request.out`, whole or not at all.

    `started` is told the estimate before the first tile. Raises `FetchError` where the service has
    no such imagery, answers wrongly, or tiles failed (what came is kept in the cache, and the same
    request goes on from there), `AreaError` where the area lies outside, `OutputError` where the
    disk refuses.
    """
    _check_out(request.out)
    with Client(request.limits, request.spec.secrets) as client:
        source, selection, estimate = _planned(client, request)
        try:
            _guard(request, estimate)
            started(estimate)
            cache = FileCache(request.cache or _cache_beside(request.out))
            found = _fetched(source, selection, client, cache, progress)
            _refuse_holes(request, found, cache)
            counts = write_mosaic(
                request.out,
                source,
                selection,
                found.digests,
                found.placeholders,
                cache,
                request.packing,
                progress,
            )
        finally:
            source.close()
        received_mb = client.received_bytes / 1e6
    if request.cache is None:
        cache.remove()
    grid = selection.grid
    share = counts.valid_px / (len(selection.cells) * grid.cell_w_px * grid.cell_h_px)
    _tell_holes(found, counts)
    size = request.out.stat().st_size
    return FetchResult(estimate, found, counts, share, received_mb, size)


def _planned(client: Client, request: FetchRequest) -> tuple[CellSource, Selection, Estimate]:
    if not (math.isfinite(request.margin_m) and request.margin_m >= 0):
        raise FetchError(f"margin must be 0 m or more, got {request.margin_m}")
    source = open_cells(client, request.spec, request.area)
    try:
        selection = select(source.grid, request.area, request.margin_m)
    except BaseException:
        source.close()
        raise
    height, width = selection.shape_px
    tiles = len(selection.cells)
    megabytes = tiles * source.cell_bytes / 1e6
    at_once = max(1, request.limits.parallel)
    seconds = max(
        tiles / request.limits.per_second,
        tiles * _SECONDS_PER_TILE / at_once,
        megabytes * 1e6 / _BYTES_PER_SECOND,
    )
    estimate = Estimate(
        tiles, selection.gsd_m, width, height, megabytes, seconds / 60, source.about
    )
    return source, selection, estimate


def _guard(request: FetchRequest, estimate: Estimate) -> None:
    if estimate.tiles > request.max_tiles:
        raise FetchError(
            f"this would fetch {estimate.text()}: more than --max-tiles {request.max_tiles}; ask "
            "for coarser pixels (--gsd-m), a part of the area, or raise the limit"
        )
    if estimate.megabytes > request.max_mb:
        raise FetchError(
            f"this would fetch {estimate.text()}: more than --max-mb {request.max_mb:g}; ask for "
            "coarser pixels (--gsd-m), a part of the area, or raise the limit"
        )


def _fetched(
    source: CellSource, selection: Selection, client: Client, cache: FileCache, progress: Progress
) -> Fetched:
    try:
        return fetch_cells(source, selection, client, cache, progress)
    except Stopped:
        raise KeyboardInterrupt from None
    except OutputError:
        raise
    except FetchError as error:
        raise FetchError(f"{error}; {_kept(cache)}") from None


def _refuse_holes(request: FetchRequest, found: Fetched, cache: FileCache) -> None:
    failed = found.failed.total()
    if not failed or request.allow_holes:
        return
    reasons = ", ".join(f"{reason}: {count}" for reason, count in found.failed.most_common(4))
    example = found.examples[found.failed.most_common(1)[0][0]]
    raise FetchError(
        f"{failed} of {len(found.digests)} tiles failed ({reasons}; for example {example}); "
        f"nothing was written; {_kept(cache)}; --allow-holes writes the file without them"
    )


def _kept(cache: FileCache) -> str:
    return f"what came is kept, and the same command goes on from there: {cache.folder}"


def _tell_holes(found: Fetched, counts: Counts) -> None:
    """Holes are no error where the service has nothing, but they are told."""
    holes = {
        "failed": found.failed.total(),
        "not covered": found.absent,
        "blank": counts.blank,
        "placeholders": counts.placeholder,
    }
    words = ", ".join(f"{count} {what}" for what, count in holes.items() if count)
    if words:
        log.warning("of %d tiles: %s; masked in the file", len(found.digests), words)


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


def _cache_beside(out: Path) -> Path:
    return out.with_name(f"{out.name}.tiles")
