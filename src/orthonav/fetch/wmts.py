"""WMTS 1.0.0 (OGC 07-057r7): the capabilities of a service, read with OWSLib.

Both encodings of requests are supported: address templates (REST) and parameters (KVP).
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from orthonav.errors import FetchError
from orthonav.extras import needed
from orthonav.fetch.client import Client
from orthonav.fetch.crs import (
    MERCATOR_HALF_M,
    epsg_name,
    metres_per_unit,
    swapped_corner,
)
from orthonav.fetch.documents import get_xml
from orthonav.fetch.grid import CellGrid
from orthonav.fetch.urls import carrying_key, joined, with_query

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
    links: dict[str, dict[str, tuple[int, int, int, int]]]
    """First row and column, last row and column, by matrix set and matrix; empty: no limits."""
    templates: dict[str, str]
    """Address templates by media type."""
    dimensions: dict[str, tuple[str, ...]]
    """Values by name of the dimension, the default one first."""


@dataclass(frozen=True)
class Wmts:
    """A service: its layers, matrix sets, and address of GetTile, if it takes parameters."""

    url: str
    layers: dict[str, WmtsLayer]
    sets: dict[str, tuple[TileMatrix, ...]]
    kvp_url: str | None


def capabilities_url(url: str) -> str:
    """The address of a service's capabilities: a document, or the parameters that request it."""
    if url.partition("?")[0].lower().endswith(".xml"):
        return url
    return with_query(url, {"SERVICE": "WMTS", "REQUEST": "GetCapabilities", "VERSION": "1.0.0"})


def open_wmts(client: Client, url: str) -> Wmts:
    """The capabilities of a service. Raises `FetchError`."""
    where = capabilities_url(url)
    return read_capabilities(get_xml(client, where), where, client.redacted)


def read_capabilities(
    document: bytes, url: str, redacted: Callable[[str], str] = lambda text: text
) -> Wmts:
    """The content of a capabilities document that was checked before. Raises `FetchError`."""
    owslib = needed("owslib.wmts", "fetch", "reading capabilities")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = owslib.WebMapTileService(url, xml=document)
            sets = {
                name: tuple(_matrices(name, matrix_set))
                for name, matrix_set in found.tilematrixsets.items()
            }
            layers = {name: _layer(layer, url, redacted) for name, layer in found.contents.items()}
            kvp_url = _kvp_url(found, url, redacted)
    except FetchError:
        raise
    except Exception as error:  # OWSLib raises AttributeError and others for odd documents
        raise FetchError(
            f"WMTS capabilities cannot be read ({type(error).__name__}): {url}"
        ) from None
    if not layers:
        raise FetchError(f"document lists no layer of a WMTS: {url}")
    return Wmts(url, layers, sets, kvp_url)


def _matrices(set_name: str, matrix_set: Any) -> list[TileMatrix]:
    """The zoom levels of a set; none where its coordinate system is unknown."""
    try:
        crs = epsg_name(matrix_set.crs)
        swapped = swapped_corner(matrix_set.crs)
        metres = metres_per_unit(crs)
    except FetchError:
        return []
    matrices = []
    for name, found in matrix_set.tilematrix.items():
        first, second = (float(value) for value in found.topleftcorner)
        west, north = (second, first) if swapped(first) else (first, second)
        res = float(found.scaledenominator) * PIXEL_M / metres
        width, height = int(found.tilewidth), int(found.tileheight)
        if not (res > 0 and 0 < width <= _MAX_TILE_PX and 0 < height <= _MAX_TILE_PX):
            raise FetchError(f"tile matrix {name} of {set_name} has an impossible size")
        if (
            crs == "EPSG:3857"
            and max(abs(west + MERCATOR_HALF_M), abs(north - MERCATOR_HALF_M)) < 1
        ):
            west, north = -MERCATOR_HALF_M, MERCATOR_HALF_M
            res = _exact_mercator(res, width)
        limits = (0, 0, int(found.matrixheight) - 1, int(found.matrixwidth) - 1)
        matrices.append(
            TileMatrix(name, CellGrid(crs, west, north, res, res, width, height, limits))
        )
    return matrices


def _exact_mercator(res: float, tile_px: int) -> float:
    """The resolution of the web grid, where a document states it with fewer digits.

    An error of one part in a million moves the far corner of this grid by 20 m.
    """
    zoom = round(math.log2(2 * MERCATOR_HALF_M / tile_px / res))
    exact = 2 * MERCATOR_HALF_M / tile_px / 2.0**zoom
    return exact if math.isclose(res, exact, rel_tol=1e-4) else res


def _layer(found: Any, url: str, redacted: Callable[[str], str]) -> WmtsLayer:
    default = [name for name, style in found.styles.items() if style.get("isDefault")]
    styles = tuple(dict.fromkeys(name or "" for name in [*default, *found.styles]))
    links = {
        name: {
            limit.tilematrix: (
                limit.mintilerow,
                limit.mintilecol,
                limit.maxtilerow,
                limit.maxtilecol,
            )
            for limit in link.tilematrixlimits.values()
        }
        for name, link in found.tilematrixsetlinks.items()
    }
    templates: dict[str, str] = {}
    for resource in found.resourceURLs:
        if resource["resourceType"] == "tile":
            templates.setdefault(resource["format"], _template(url, redacted(resource["template"])))
    dimensions = {
        name: tuple(
            value for value in dict.fromkeys([plain.get("default"), *plain["values"]]) if value
        )
        for name, plain in found.dimensions.items()
    }
    formats = tuple(name for name in dict.fromkeys([*found.formats, *templates]) if name)
    return WmtsLayer(
        found.id,
        styles,
        formats,
        links,
        templates,
        {name: values for name, values in dimensions.items() if values},
    )


def _template(url: str, template: str) -> str:
    # A template is checked as an address once it is filled in.
    absolute = joined(url, template.replace("{", "%7B").replace("}", "%7D"))
    return carrying_key(url, absolute.replace("%7B", "{").replace("%7D", "}"))


def _kvp_url(found: Any, url: str, redacted: Callable[[str], str]) -> str | None:
    """Address of GetTile with parameters; the service's own where the document has none."""
    operations = {getattr(known, "name", ""): known for known in found.operations or []}
    if "GetTile" not in operations:
        return None if url.partition("?")[0].lower().endswith(".xml") else url
    for method in operations["GetTile"].methods:
        encodings = [
            value
            for constraint in method.get("constraints", [])
            if constraint.name == "GetEncoding"
            for value in constraint.values
        ]
        if method.get("type", "").lower() == "get" and (not encodings or "KVP" in encodings):
            return carrying_key(url, joined(url, redacted(method["url"])))
    return None
