"""Tiles by template: `{z}/{x}/{y}` in Web Mercator, as maps on the web have them.

`{-y}` counts rows from the south (TMS), `{q}` is a quadkey, `{s}` one of several hosts, `{r}` the
`@2x` of tiles of 512 px.
"""

import math
import re
from collections.abc import Callable

from orthonav.errors import FetchError
from orthonav.fetch.crs import MERCATOR_HALF_M, ground_scale
from orthonav.fetch.grid import CellGrid
from orthonav.fetch.service import About, TileSource, Wish, finest_fitting
from orthonav.fetch.urls import checked_url
from orthonav.geo.frames import LocalFrame

MAX_ZOOM = 24
_PARTS = {"z", "x", "y", "-y", "q", "s", "r", "key"}


def xyz_tiles(
    template: str, wish: Wish, frame: LocalFrame, about: About, *, rows_from_south: bool = False
) -> TileSource:
    """The tiles of a template at the zoom that is wished.

    `rows_from_south` makes `{y}` mean `{-y}`. Raises `FetchError`.
    """
    parts = set(re.findall(r"\{([^{}]*)\}", template))
    if parts - _PARTS or not (({"z", "x"} <= parts and parts & {"y", "-y"}) or "q" in parts):
        raise FetchError(
            "template needs {z}, {x} and {y} (or {-y}), or {q}, and knows {s}, {r} and {key}; "
            f"got: {template[:200]}"
        )
    checked_url(re.sub(r"\{[^{}]*\}", "0", template))
    tile_px = wish.tile_px or (512 if "{r}" in template or "@2x" in template else 256)
    if not 64 <= tile_px <= 4096:
        raise FetchError(f"tiles must be 64 to 4096 px across, got {tile_px}")
    zoom = _zoom(wish, frame, tile_px)
    res = 2 * MERCATOR_HALF_M / tile_px / 2.0**zoom
    last = 2**zoom - 1
    grid = CellGrid(
        "EPSG:3857",
        -MERCATOR_HALF_M,
        MERCATOR_HALF_M,
        res,
        res,
        tile_px,
        tile_px,
        (0, 0, last, last),
    )
    url_of = _url_of(template, zoom, wish.subdomains, tile_px, rows_from_south)
    return TileSource(about, grid, url_of, _format(template), wish.empty)


def quadkey(zoom: int, row: int, col: int) -> str:
    """Name of a tile as digits 0 to 3, one per zoom (Bing Maps tile system)."""
    return "".join(
        str(((col >> bit) & 1) + 2 * ((row >> bit) & 1)) for bit in range(zoom - 1, -1, -1)
    )


def _zoom(wish: Wish, frame: LocalFrame, tile_px: int) -> int:
    low, high = wish.min_zoom or 0, min(MAX_ZOOM, wish.max_zoom or MAX_ZOOM)
    if wish.zoom is not None:
        if not wish.zoom.isdecimal() or not low <= int(wish.zoom) <= high:
            raise FetchError(f"no zoom {wish.zoom}; there is {low} to {high}")
        return int(wish.zoom)
    scale = math.sqrt(math.prod(ground_scale("EPSG:3857", frame)))
    zooms = list(range(low, high + 1))
    gsds_m = [2 * MERCATOR_HALF_M / tile_px / 2.0**zoom * scale for zoom in zooms]
    return zooms[finest_fitting(gsds_m, wish.ground_m, f"zoom {low} to {high}")]


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
    low = template.partition("?")[0].lower()
    if low.endswith(".png"):
        return "image/png"
    return "image/webp" if low.endswith(".webp") else "image/jpeg"
