"""WMTS 1.0.0 (OGC 07-057r7): a layer as its capabilities describe it, and the tiles of it.

Both encodings of requests are supported: address templates (REST) and parameters (KVP).
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from orthonav.errors import FetchError
from orthonav.fetch.client import Client
from orthonav.fetch.crs import (
    MERCATOR_HALF_M,
    epsg_name,
    ground_scale,
    mercator_resolution,
    metres_per_unit,
    swapped_corner,
)
from orthonav.fetch.documents import XmlDocument, capabilities, get_xml
from orthonav.fetch.grid import CellGrid
from orthonav.fetch.options import (
    ImageryOptions,
    Provenance,
    choose,
    choose_format,
    choose_layer,
    choose_time,
    finest_fitting,
)
from orthonav.fetch.service import CellSource, tile_source
from orthonav.fetch.urls import carrying_key, joined, quoted, with_query
from orthonav.geo.frames import LocalFrame

PIXEL_M = 0.28e-3
"""Width of the standardized pixel of scale denominators (OGC 07-057r7, 6.1)."""
_MAX_TILE_PX = 4096
"""Largest tile that is accepted; usual ones have 256 or 512 px."""


@dataclass(frozen=True)
class TileMatrix:
    """One zoom level of a tile matrix set: its `name` and the grid of its tiles."""

    name: str
    grid: CellGrid


@dataclass(frozen=True)
class WmtsLayer:
    """A layer as its capabilities describe it."""

    name: str
    styles: tuple[str, ...]
    """Styles, the default one first."""
    formats: tuple[str, ...]
    """Media types."""
    sets: dict[str, list[TileMatrix]]
    """Zoom levels by matrix set, each within the limits of the layer."""
    limited: frozenset[str]
    """Matrix sets of which the service lists the zooms of the layer."""
    templates: dict[str, str]
    """Address templates by media type."""
    dimensions: dict[str, tuple[str, ...]]
    """Values by name of the dimension, the default one first."""
    kvp_url: str | None
    """Address of GetTile, if the service takes parameters."""


def open_wmts(client: Client, url: str, name: str | None) -> WmtsLayer:
    """A layer of a service. Raises `FetchError` with the available layers."""
    if not _is_document(url):
        url = with_query(url, {"SERVICE": "WMTS", "REQUEST": "GetCapabilities", "VERSION": "1.0.0"})
    return read_layer(client, get_xml(client, url), url, name)


def read_layer(client: Client, document: XmlDocument, url: str, name: str | None) -> WmtsLayer:
    """The layer of that name, or the only one. Raises `FetchError`."""
    with capabilities("WMTS", url):
        from owslib.wmts import WebMapTileService

        service = WebMapTileService(url, xml=document.body)
        found = service.contents[choose_layer(list(service.contents), name, url)]
        default = [name for name, style in found.styles.items() if style.get("isDefault")]
        sets = {
            name: _matrices(name, service.tilematrixsets[name], link.tilematrixlimits)
            for name, link in found.tilematrixsetlinks.items()
            if name in service.tilematrixsets
        }
        templates: dict[str, str] = {}
        for resource in found.resourceURLs:
            if resource["resourceType"] == "tile":
                template = _template(client, url, resource["template"])
                templates.setdefault(resource["format"], template)
        dimensions = {
            name: tuple(filter(None, dict.fromkeys([plain.get("default"), *plain["values"]])))
            for name, plain in found.dimensions.items()
        }
        return WmtsLayer(
            name=found.id,
            styles=tuple(dict.fromkeys(name or "" for name in [*default, *found.styles])),
            formats=tuple(filter(None, dict.fromkeys([*found.formats, *templates]))),
            sets={name: matrices for name, matrices in sets.items() if matrices},
            limited=frozenset(n for n, k in found.tilematrixsetlinks.items() if k.tilematrixlimits),
            templates=templates,
            dimensions={name: values for name, values in dimensions.items() if values},
            kvp_url=_kvp_url(client, service, url),
        )


def _is_document(url: str) -> bool:
    return url.partition("?")[0].lower().endswith(".xml")


def _matrices(set_name: str, matrix_set: Any, limits: dict[str, Any]) -> list[TileMatrix]:
    """The zoom levels of a set, those with `limits` if there are any, in these limits.

    None where the coordinate system is unknown.
    """
    try:
        crs = epsg_name(matrix_set.crs)
        swapped = swapped_corner(matrix_set.crs)
        metres = metres_per_unit(crs)
    except FetchError:
        return []
    matrices = []
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
        matrices.append(
            TileMatrix(name, CellGrid(crs, west, north, res, res, width, height, edges))
        )
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


def wmts_tiles(
    layer: WmtsLayer, options: ImageryOptions, frame: LocalFrame, provenance: Provenance
) -> CellSource:
    """The tiles of a layer. Raises `FetchError` with the available choices."""
    format_ = choose_format(layer.formats, options, f"layer {layer.name}")
    preferred = options.preferred_style if options.preferred_style in layer.styles else None
    style = choose(
        list(layer.styles) or ["default"],
        options.style or preferred,
        f"layer {layer.name} has no style",
    )
    set_name, matrix = _matrix(layer, options, frame)
    dimensions = {name: values[0] for name, values in layer.dimensions.items()}
    if options.time is not None:
        time = next((name for name in dimensions if name.lower() == "time"), None)
        if time is None:
            raise FetchError(f"layer {layer.name} has no time to choose, --time was {options.time}")
        dimensions[time] = choose_time(layer.dimensions[time], options.time, layer.name)
    names = {
        "layer": layer.name,
        "style": style,
        "tilematrixset": set_name,
        "tilematrix": matrix.name,
    }
    url_of = _url_of(layer, format_, names, dimensions)
    return tile_source(provenance, matrix.grid, url_of, format_, options.empty)


def _url_of(
    layer: WmtsLayer, format_: str, names: dict[str, str], dimensions: dict[str, str]
) -> Callable[[int, int], str]:
    template = layer.templates.get(format_)
    if template is not None:
        filled = _filled(template, names | {k.lower(): v for k, v in dimensions.items()})
        return lambda row, col: _filled(filled, {"tilerow": str(row), "tilecol": str(col)})
    if layer.kvp_url is None:
        raise FetchError(f"service offers no tiles of {layer.name} as {format_}")
    fixed = with_query(
        layer.kvp_url,
        {
            "SERVICE": "WMTS",
            "REQUEST": "GetTile",
            "VERSION": "1.0.0",
            "LAYER": names["layer"],
            "STYLE": names["style"],
            "FORMAT": format_,
            "TILEMATRIXSET": names["tilematrixset"],
            "TILEMATRIX": names["tilematrix"],
            **{name.upper(): value for name, value in dimensions.items()},
        },
    )
    return lambda row, col: f"{fixed}&TILEROW={row}&TILECOL={col}"


def _filled(template: str, values: dict[str, str]) -> str:
    """A template with these parts filled in, whatever their case; others stay."""

    def fill(found: re.Match[str]) -> str:
        value = values.get(found.group(1).lower())
        return found.group(0) if value is None else quoted(value)

    return re.sub(r"\{([^{}]+)\}", fill, template)


def _matrix(layer: WmtsLayer, options: ImageryOptions, frame: LocalFrame) -> tuple[str, TileMatrix]:
    """Name of the matrix set, and the zoom level."""
    if not layer.sets:
        raise FetchError(f"layer {layer.name} has no grid that can be read")
    if options.matrix_set is not None:
        name = choose(list(layer.sets), options.matrix_set, f"layer {layer.name} has no grid")
    else:
        name = _set_of_crs(layer, options.crs)
    matrices = layer.sets[name]
    if name not in layer.limited:
        matrices = [m for m in matrices if not _beyond(m.name, options)]
    if not matrices:
        raise FetchError(f"layer {layer.name} has no zoom in its grid {name}")
    scale = math.sqrt(math.prod(ground_scale(matrices[0].grid.crs, frame)))
    gsds_m = [scale * m.grid.res_x for m in matrices]
    levels = ", ".join(f"{m.name} ({g:.3g} m)" for m, g in zip(matrices, gsds_m, strict=True))
    if options.zoom is None:
        return name, matrices[finest_fitting(gsds_m, options.wanted_gsd_m, f"zoom {levels}")]
    found = [m for m in matrices if _is_zoom(m.name, options.zoom)]
    if not found:
        raise FetchError(f"layer {layer.name} has no zoom {options.zoom}; available: {levels}")
    return name, found[0]


def _set_of_crs(layer: WmtsLayer, crs: str | None) -> str:
    """The matrix set in the coordinate system requested, else in Web Mercator, else the first."""
    by_crs: dict[str, str] = {}
    for name, matrices in layer.sets.items():
        by_crs.setdefault(matrices[0].grid.crs, name)
    if crs is None and "EPSG:3857" in by_crs:
        return by_crs["EPSG:3857"]
    return by_crs[choose(list(by_crs), crs, f"layer {layer.name} does not come in")]


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
