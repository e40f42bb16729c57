"""Tiles by address template: `{z}/{x}/{y}` in Web Mercator, as web maps use them.

`{-y}` counts rows from the south (TMS), `{q}` is a quadkey, `{s}` one of several hosts, `{r}` the
`@2x` of tiles of 512 px.
"""

import math
import re
from collections.abc import Callable

from orthonav.core.errors import FetchError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.fetch.client import Client
from orthonav.ground.fetch.crs import MERCATOR_HALF_M, ground_scale, mercator_resolution
from orthonav.ground.fetch.grid import CellGrid
from orthonav.ground.fetch.options import ImageryOptions, SourceSpec, finest_fitting
from orthonav.ground.fetch.service import CellSource, tile_source
from orthonav.ground.fetch.urls import checked_url
from orthonav.ground.planning.area import Area

MAX_ZOOM = 24
"""Finest zoom level, 9 mm per pixel at the equator: finer than any orthophoto."""
_PARTS = {"z", "x", "y", "-y", "q", "s", "r", "key"}


def xyz_tiles(_: Client, spec: SourceSpec, area: Area) -> CellSource:
    """The tiles of a template at the zoom that fits the options; as TMS, `{y}` means `{-y}`.

    Raises `FetchError`.
    """
    template, options, from_south = spec.url, spec.options, spec.protocol == "tms"
    parts = set(re.findall(r"\{([^{}]*)\}", template))
    if parts - _PARTS or not (({"z", "x"} <= parts and parts & {"y", "-y"}) or "q" in parts):
        raise FetchError(
            "template needs {z}, {x} and {y} (or {-y}), or {q}, and may hold {s}, {r} and {key}; "
            f"got: {template[:200]}"
        )
    checked_url(re.sub(r"\{[^{}]*\}", "0", template))
    tile_px = options.tile_px or (512 if "{r}" in template or "@2x" in template else 256)
    if not 64 <= tile_px <= 4096:
        raise FetchError(f"tiles must be 64 to 4096 px wide, got {tile_px}")
    zoom = _zoom(options, area.frame, tile_px)
    half, last = MERCATOR_HALF_M, 2**zoom - 1
    res = mercator_resolution(zoom, tile_px)
    grid = CellGrid("EPSG:3857", -half, half, res, res, tile_px, tile_px, (0, 0, last, last))
    subdomains = "abc" if options.subdomains is None else options.subdomains
    url_of = _url_of(template, zoom, subdomains, tile_px, from_south)
    return tile_source(spec.provenance, grid, url_of, _format(template), options.empty)


def quadkey(zoom: int, row: int, col: int) -> str:
    """Name of a tile as digits 0 to 3, one per zoom level (Bing Maps tile system)."""
    return str(int(f"{col:b}") + 2 * int(f"{row:b}")).zfill(zoom) if zoom else ""


def _zoom(options: ImageryOptions, frame: LocalFrame, tile_px: int) -> int:
    low, high = options.min_zoom or 0, min(MAX_ZOOM, options.max_zoom or MAX_ZOOM)
    if options.zoom is not None:
        if not options.zoom.isdecimal() or not low <= int(options.zoom) <= high:
            raise FetchError(f"no zoom {options.zoom}; available: {low} to {high}")
        return int(options.zoom)
    scale = math.sqrt(math.prod(ground_scale("EPSG:3857", frame)))
    zooms = list(range(low, high + 1))
    gsds_m = [mercator_resolution(zoom, tile_px) * scale for zoom in zooms]
    return zooms[finest_fitting(gsds_m, options.wanted_gsd_m, f"zoom {low} to {high}")]


def _url_of(
    template: str, zoom: int, subdomains: str, tile_px: int, rows_from_south: bool
) -> Callable[[int, int], str]:
    def url_of(row: int, col: int) -> str:
        from_south = 2**zoom - 1 - row
        values = {
            "z": str(zoom),
            "x": str(col),
            "y": str(from_south if rows_from_south else row),
            "-y": str(from_south),
            "q": quadkey(zoom, row, col),
            "s": subdomains[(row + col) % len(subdomains)] if subdomains else "",
            "r": "@2x" if tile_px == 512 else "",
        }
        return re.sub(
            r"\{([^{}]+)\}", lambda found: values.get(found.group(1), found.group(0)), template
        )

    return url_of


def _format(template: str) -> str:
    path = template.partition("?")[0].lower()
    formats = {".png": "image/png", ".webp": "image/webp"}
    return next((kind for end, kind in formats.items() if path.endswith(end)), "image/jpeg")
