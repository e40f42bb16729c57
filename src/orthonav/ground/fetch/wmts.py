"""WMTS 1.0.0 (OGC 07-057r7): a layer as its capabilities describe it, and the tiles of it.

Both encodings of requests are supported: address templates (REST) and parameters (KVP).
"""

import math
import re
from collections.abc import Callable
from typing import Any

from orthonav.core.errors import FetchError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.fetch.client import Client
from orthonav.ground.fetch.crs import (
    MERCATOR_HALF_M,
    epsg_name,
    ground_scale,
    mercator_resolution,
    metres_per_unit,
    swapped_corner,
)
from orthonav.ground.fetch.documents import capabilities, get_xml
from orthonav.ground.fetch.grid import CellGrid
from orthonav.ground.fetch.options import (
    ImageryOptions,
    SourceSpec,
    choose,
    choose_format,
    choose_layer,
    choose_time,
    finest_fitting,
)
from orthonav.ground.fetch.service import CellSource, tile_source
from orthonav.ground.fetch.urls import carrying_key, joined, quoted, with_query
from orthonav.ground.planning.area import Area

PIXEL_M = 0.28e-3
"""Width of the standardized pixel of scale denominators (OGC 07-057r7, 6.1)."""
_MAX_TILE_PX = 4096
"""Largest tile that is accepted; usual ones have 256 or 512 px."""


def wmts_tiles(client: Client, spec: SourceSpec, area: Area) -> CellSource:
    """The tiles of a layer of a service. Raises `FetchError` with the available choices."""
    url, options = spec.url, spec.options
    if not _is_document(url):
        url = with_query(url, {"SERVICE": "WMTS", "REQUEST": "GetCapabilities", "VERSION": "1.0.0"})
    body, _ = get_xml(client, url)
    with capabilities("WMTS", url):
        from owslib.wmts import WebMapTileService

        service = WebMapTileService(url, xml=body)
        layer = service.contents[choose_layer(list(service.contents), options.layer, url)]
        default = [name for name, style in layer.styles.items() if style.get("isDefault")]
        styles = list(dict.fromkeys(name or "" for name in [*default, *layer.styles]))
        templates: dict[str, str] = {}
        for resource in layer.resourceURLs:
            if resource["resourceType"] == "tile":
                template = _template(client, url, resource["template"])
                templates.setdefault(resource["format"], template)
        formats = list(filter(None, dict.fromkeys([*layer.formats, *templates])))
        format_ = choose_format(formats, options, f"layer {layer.id}")
        set_name, matrix, grid = _matrix(service, layer, options, area.frame)
        values = _dimensions(layer, options)
        kvp_url = _kvp_url(client, service, url)
    preferred = options.preferred_style if options.preferred_style in styles else None
    no_style = f"layer {layer.id} has no style"
    values = {
        "layer": layer.id,
        "style": choose(styles or ["default"], options.style or preferred, no_style),
        "format": format_,
        "tilematrixset": set_name,
        "tilematrix": matrix,
        **values,
    }
    url_of = _url_of(templates.get(format_), kvp_url, values)
    return tile_source(spec.provenance, grid, url_of, format_, options.empty)


def _url_of(
    template: str | None, kvp_url: str | None, values: dict[str, str]
) -> Callable[[int, int], str]:
    if template is not None:
        filled = _filled(template, values)
        return lambda row, col: _filled(filled, {"tilerow": str(row), "tilecol": str(col)})
    if kvp_url is None:
        raise FetchError(f"service offers no tiles of {values['layer']} as {values['format']}")
    request = {"SERVICE": "WMTS", "REQUEST": "GetTile", "VERSION": "1.0.0"}
    fixed = with_query(kvp_url, request | {name.upper(): each for name, each in values.items()})
    return lambda row, col: f"{fixed}&TILEROW={row}&TILECOL={col}"


def _dimensions(layer: Any, options: ImageryOptions) -> dict[str, str]:
    """Values of the dimensions by name in lower case: the time requested, else the default."""
    found = {}
    for name, each in layer.dimensions.items():
        values = list(filter(None, dict.fromkeys([each.get("default"), *each["values"]])))
        if values and name.lower() == "time" and options.time is not None:
            found[name.lower()] = choose_time(values, options.time, layer.id)
        elif values:
            found[name.lower()] = values[0]
    if options.time is not None and "time" not in found:
        raise FetchError(f"layer {layer.id} has no time to choose, --time was {options.time}")
    return found


def _is_document(url: str) -> bool:
    return url.partition("?")[0].lower().endswith(".xml")


def _matrices(set_name: str, matrix_set: Any, limits: dict[str, Any]) -> dict[str, CellGrid]:
    """The zoom levels of a set by name, those with `limits` if there are any, in these limits.

    Empty where the coordinate system is unknown.
    """
    try:
        crs = epsg_name(matrix_set.crs)
        swapped = swapped_corner(matrix_set.crs)
        metres = metres_per_unit(crs)
    except FetchError:
        return {}
    matrices = {}
    for name, found in matrix_set.tilematrix.items():
        if limits and name not in limits:
            continue
        first, second = (float(value) for value in found.topleftcorner)
        west, north = (second, first) if swapped(first) else (first, second)
        res = float(found.scaledenominator) * PIXEL_M / metres
        width, height = int(found.tilewidth), int(found.tileheight)
        if not (res > 0 and 0 < width <= _MAX_TILE_PX and 0 < height <= _MAX_TILE_PX):
            raise FetchError(f"tile matrix {name} of {set_name} has an impossible size")
        corner_off = max(abs(west + MERCATOR_HALF_M), abs(north - MERCATOR_HALF_M))
        if crs == "EPSG:3857" and corner_off < 1:
            west, north = -MERCATOR_HALF_M, MERCATOR_HALF_M
            res = _exact_mercator(res, width)
        rows, cols = int(found.matrixheight), int(found.matrixwidth)
        edges = (0, 0, rows - 1, cols - 1)
        if limits:
            of = limits[name]
            low = (max(0, of.mintilerow), max(0, of.mintilecol))
            edges = (*low, min(rows - 1, of.maxtilerow), min(cols - 1, of.maxtilecol))
        matrices[name] = CellGrid(crs, west, north, res, res, width, height, edges)
    return matrices


def _exact_mercator(res: float, tile_px: int) -> float:
    """The resolution of the web grid, where a document states it with fewer digits.

    An error of one part in a million moves the far corner of this grid by 20 m.
    """
    exact = mercator_resolution(round(math.log2(mercator_resolution(0, tile_px) / res)), tile_px)
    return exact if math.isclose(res, exact, rel_tol=1e-4) else res


def _template(client: Client, url: str, template: str) -> str:
    # A template is checked as an address once it is filled in.
    absolute = joined(url, client.redacted(template).replace("{", "%7B").replace("}", "%7D"))
    return carrying_key(url, absolute.replace("%7B", "{").replace("%7D", "}"))


def _kvp_url(client: Client, service: Any, url: str) -> str | None:
    """Address of GetTile with parameters; the service's own where the document has none."""
    operations = {getattr(known, "name", ""): known for known in service.operations or []}
    if "GetTile" not in operations:
        return None if _is_document(url) else url
    for method in operations["GetTile"].methods:
        encodings = [
            value
            for constraint in method.get("constraints", [])
            if constraint.name == "GetEncoding"
            for value in constraint.values
        ]
        if method.get("type", "").lower() == "get" and (not encodings or "KVP" in encodings):
            return client.linked(url, method["url"])
    return None


def _filled(template: str, values: dict[str, str]) -> str:
    """A template with these parts filled in, whatever their case; others stay."""

    def fill(found: re.Match[str]) -> str:
        value = values.get(found.group(1).lower())
        return found.group(0) if value is None else quoted(value)

    return re.sub(r"\{([^{}]+)\}", fill, template)


def _matrix(
    service: Any, layer: Any, options: ImageryOptions, frame: LocalFrame
) -> tuple[str, str, CellGrid]:
    """Names of the matrix set and of the zoom level, and the grid of its tiles."""
    links = layer.tilematrixsetlinks
    sets = {
        name: matrices
        for name, link in links.items()
        if name in service.tilematrixsets
        and (matrices := _matrices(name, service.tilematrixsets[name], link.tilematrixlimits))
    }
    if not sets:
        raise FetchError(f"layer {layer.id} has no grid that can be read")
    if options.matrix_set is not None:
        name = choose(list(sets), options.matrix_set, f"layer {layer.id} has no grid")
    else:
        by_crs: dict[str, str] = {}
        for name, matrices in sets.items():
            by_crs.setdefault(next(iter(matrices.values())).crs, name)
        usual = "EPSG:3857" if "EPSG:3857" in by_crs else None
        no_crs = f"layer {layer.id} does not come in"
        name = by_crs[choose(list(by_crs), options.crs or usual, no_crs)]
    grids = sets[name]
    if not links[name].tilematrixlimits:
        grids = {zoom: grid for zoom, grid in grids.items() if not _beyond(zoom, options)}
    if not grids:
        raise FetchError(f"layer {layer.id} has no zoom in its grid {name}")
    scale = math.sqrt(math.prod(ground_scale(next(iter(grids.values())).crs, frame)))
    gsds_m = {zoom: scale * grid.res_x for zoom, grid in grids.items()}
    levels = ", ".join(f"{zoom} ({gsd_m:.3g} m)" for zoom, gsd_m in gsds_m.items())
    if options.zoom is None:
        fit = finest_fitting(list(gsds_m.values()), options.wanted_gsd_m, f"zoom {levels}")
        zoom = list(grids)[fit]
    else:
        found = next((zoom for zoom in grids if _is_zoom(zoom, options.zoom)), None)
        if found is None:
            raise FetchError(f"layer {layer.id} has no zoom {options.zoom}; available: {levels}")
        zoom = found
    return name, zoom, grids[zoom]


def _is_zoom(name: str, zoom: str) -> bool:
    """Whether a matrix has that name or number: EPSG:3857:07 is zoom 7."""
    number = name.rpartition(":")[2]
    same_number = number.isdecimal() and zoom.isdecimal() and int(number) == int(zoom)
    return zoom in (name, number) or same_number


def _beyond(name: str, options: ImageryOptions) -> bool:
    """Whether a zoom lies outside those that the preset names."""
    number = name.rpartition(":")[2]
    if not number.isdecimal():
        return False
    low, high = options.min_zoom, options.max_zoom
    return (low is not None and int(number) < low) or (high is not None and int(number) > high)
