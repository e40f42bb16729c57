"""Tiles by address template: `{z}/{x}/{y}` in Web Mercator, as web maps use them.

`{-y}` counts rows from the south (TMS), `{q}` is a quadkey, `{s}` one of the hosts a, b and c (a is
taken), `{r}` the `@2x` of tiles of 512 px.
"""

import re

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.grid import MERCATOR_HALF_M, CellGrid, mean_scale
from orthonav.ground.fetch.options import SourceSpec, finest_fitting
from orthonav.ground.fetch.service import CellSource, service_source
from orthonav.ground.planning.area import Area

MAX_ZOOM = 24  # finest zoom level, 9 mm per pixel at the equator: finer than any orthophoto
_PARTS = {"z", "x", "y", "-y", "q", "s", "r", "key"}


def xyz_tiles(spec: SourceSpec, area: Area) -> CellSource:
    """The tiles of a template at the zoom that fits the options; as TMS, `{y}` means `{-y}`.

    Raises `FetchError`.
    """
    template, options = spec.url, spec.options
    parts = set(re.findall(r"\{([^{}]*)\}", template))
    if parts - _PARTS or not (({"z", "x"} <= parts and parts & {"y", "-y"}) or "q" in parts):
        raise FetchError(
            "template needs {z}, {x} and {y} (or {-y}), or {q}, and may hold {s}, {r} and {key}; "
            f"got: {template[:200]}"
        )
    tile_px = options.tile_px or (512 if "{r}" in template or "@2x" in template else 256)
    if not 64 <= tile_px <= 4096:
        raise FetchError(f"tiles must be 64 to 4096 px wide, got {tile_px}")
    low, high = options.min_zoom or 0, min(MAX_ZOOM, options.max_zoom or MAX_ZOOM)
    zooms = list(range(low, high + 1))
    resolutions = [2 * MERCATOR_HALF_M / tile_px / 2.0**zoom for zoom in zooms]
    if options.zoom is None:
        scale = mean_scale("EPSG:3857", area.frame)
        gsds_m = [res * scale for res in resolutions]
        zoom = zooms[finest_fitting(gsds_m, options.wanted_gsd_m, f"zoom {low} to {high}")]
    elif options.zoom.isdecimal() and low <= int(options.zoom) <= high:
        zoom = int(options.zoom)
    else:
        raise FetchError(f"no zoom {options.zoom}; available: {low} to {high}")
    half, last, res = MERCATOR_HALF_M, 2**zoom - 1, resolutions[zoom - low]
    grid = CellGrid("EPSG:3857", -half, half, res, res, tile_px, tile_px, (0, 0, last, last))
    values = {
        "{z}": str(zoom),
        "{x}": "${x}",
        "{y}": "${y}",
        "{-y}": "${y}",
        "{q}": "${quadkey}",
        "{s}": "a",
        "{r}": "@2x" if tile_px == 512 else "",
    }
    for part, value in values.items():
        template = template.replace(part, value)
    service = {"name": "VirtualEarth" if "q" in parts else "TMS", "ServerUrl": template}
    path = template.partition("?")[0].lower()
    formats = {".png": "image/png", ".webp": "image/webp"}
    format_ = next((kind for end, kind in formats.items() if path.endswith(end)), "image/jpeg")
    from_south = spec.protocol == "tms" or "-y" in parts
    return service_source(spec, grid, format_, service, zoom, from_south=from_south)
