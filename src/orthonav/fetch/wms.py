"""WMS 1.1.1 and 1.3.0: pictures of any box, asked for as the cells of a fixed grid.

In 1.3.0 the order of coordinates is that of the coordinate system's authority, so northing first
in EPSG:4326 and in a good many national ones (OGC 06-042, 6.7.2); in 1.1.1 it is always x, y.
"""

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from orthonav.errors import FetchError
from orthonav.extras import needed
from orthonav.fetch.client import Client
from orthonav.fetch.crs import epsg_name, ground_scale, north_first
from orthonav.fetch.documents import get_xml, parse_xml
from orthonav.fetch.grid import CellGrid
from orthonav.fetch.service import About, TileSource, Wish, listed, resolution
from orthonav.fetch.urls import carrying_key, joined, with_query
from orthonav.geo.frames import LocalFrame

CELL_PX = 1024
_MIN_CELL_PX = 64
_FORMATS = ("image/jpeg", "image/png", "image/webp")
_VERSIONS = ("1.3.0", "1.1.1")


@dataclass(frozen=True)
class WmsLayer:
    """A layer: `crs` by EPSG name to the name it is asked for by; `times` where it has any."""

    name: str
    title: str
    styles: tuple[str, ...]
    crs: dict[str, str]
    times: tuple[str, ...]


@dataclass(frozen=True)
class Wms:
    """A service: `url` of GetMap, largest picture, and its layers that have a name."""

    url: str
    version: str
    formats: tuple[str, ...]
    max_px: int
    layers: dict[str, WmsLayer]


def open_wms(client: Client, url: str, version: str | None = None) -> Wms:
    """What a service says it has; `version` is asked for, and what it answers is used.

    Raises `FetchError`.
    """
    wanted = version or _VERSIONS[0]
    if wanted not in _VERSIONS:
        raise FetchError(f"WMS 1.1.1 and 1.3.0 are known, not {wanted}")
    where = with_query(url, {"SERVICE": "WMS", "REQUEST": "GetCapabilities", "VERSION": wanted})
    return read_capabilities(get_xml(client, where), where, client.redacted)


def read_capabilities(
    document: bytes, url: str, redacted: Callable[[str], str] = lambda text: text
) -> Wms:
    """What a capabilities document, checked before, says. Raises `FetchError`."""
    owslib = needed("owslib.wms", "fetch", "reading capabilities")
    root = parse_xml(document)
    version = root.get("version", "")
    if version not in _VERSIONS:
        raise FetchError(f"WMS 1.1.1 and 1.3.0 are known; this is '{version or root.tag}': {url}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = owslib.WebMapService(url, version=version, xml=document)
            get_map = found.getOperationByName("GetMap")
            layers = {
                name: layer
                for name, plain in found.contents.items()
                if name and (layer := _layer(name, plain)).crs
            }
            formats = tuple(get_map.formatOptions)
            address = next(
                method["url"] for method in get_map.methods if method["type"].lower() == "get"
            )
    except Exception as error:  # OWSLib lets AttributeError and more through for odd documents
        raise FetchError(
            f"WMS capabilities cannot be read ({type(error).__name__}): {url}"
        ) from None
    if not layers:
        raise FetchError(f"document lists no layer of a WMS: {url}")
    map_url = carrying_key(url, joined(url, redacted(address)))
    return Wms(map_url, version, formats, _max_px(root), layers)


def wms_cells(service: Wms, wish: Wish, frame: LocalFrame, about: About) -> TileSource:
    """Cells of the layer that is wished. Raises `FetchError` listing what there is."""
    if wish.layer not in service.layers:
        asked = "name one with --layer" if wish.layer is None else f"no layer {wish.layer}"
        there = listed(list(service.layers), wish.layer or "ortho")
        raise FetchError(f"{asked}; there is {there}")
    layer = service.layers[wish.layer]
    if wish.style is not None and wish.style not in layer.styles:
        raise FetchError(
            f"layer {layer.name} has no style {wish.style}; there is {listed(list(layer.styles))}"
        )
    crs = _chosen_crs(layer, wish.crs, frame)
    format_ = _chosen_format(service, wish)
    scale_x, scale_y = ground_scale(crs, frame)
    cell_px = min(CELL_PX, service.max_px, wish.tile_px or CELL_PX)
    grid = CellGrid(
        crs,
        0.0,
        0.0,
        resolution(wish.ground_m, scale_x),
        resolution(wish.ground_m, scale_y),
        cell_px,
        cell_px,
    )
    fixed = _parameters(service, layer, wish, format_, layer.crs[crs])
    swap = service.version == "1.3.0" and not layer.crs[crs].startswith("CRS:") and north_first(crs)

    def url_of(row: int, col: int) -> str:
        west, south, east, north = grid.bounds(row, col)
        box = (south, west, north, east) if swap else (west, south, east, north)
        return with_query(fixed, {"BBOX": ",".join(_number(value) for value in box)})

    return TileSource(about, grid, url_of, format_, wish.empty, tiled=False)


def _parameters(service: Wms, layer: WmsLayer, wish: Wish, format_: str, crs: str) -> str:
    cell_px = min(CELL_PX, service.max_px, wish.tile_px or CELL_PX)
    parameters = {
        "SERVICE": "WMS",
        "VERSION": service.version,
        "REQUEST": "GetMap",
        "LAYERS": layer.name,
        "STYLES": wish.style
        or (wish.usual_style if wish.usual_style in layer.styles else None)
        or "",
        "CRS" if service.version == "1.3.0" else "SRS": crs,
        "WIDTH": str(cell_px),
        "HEIGHT": str(cell_px),
        "FORMAT": format_,
        "TRANSPARENT": "TRUE" if format_ != "image/jpeg" else "FALSE",
    }
    if wish.time is not None:
        ranges = any("/" in value for value in layer.times)
        if not ranges and wish.time not in layer.times:
            raise FetchError(
                f"layer {layer.name} has no time {wish.time}; there is {listed(list(layer.times))}"
            )
        parameters["TIME"] = wish.time
    return with_query(service.url, parameters)


def _chosen_crs(layer: WmsLayer, wanted: str | None, frame: LocalFrame) -> str:
    """The system that is wished, else UTM, else Web Mercator, else the first that is in metres."""
    if wanted is not None:
        if wanted not in layer.crs:
            raise FetchError(
                f"layer {layer.name} does not come in {wanted}; there is "
                f"{listed(list(layer.crs), wanted)}"
            )
        return wanted
    zone = int((frame.lon_deg + 180) % 360 // 6) + 1
    utm = [f"EPSG:258{zone:02d}", f"EPSG:{326 if frame.lat_deg >= 0 else 327}{zone:02d}"]
    for name in [*utm, "EPSG:3857", *layer.crs]:
        if name in layer.crs:
            return name
    raise FetchError(f"layer {layer.name} tells no coordinate system that is known")


def _chosen_format(service: Wms, wish: Wish) -> str:
    if wish.format is not None and wish.format not in service.formats:
        raise FetchError(
            f"service has no format {wish.format}; "
            f"there is {listed(list(service.formats), wish.format)}"
        )
    for name in (wish.format, wish.usual_format, *_FORMATS):
        if name is not None and name in service.formats:
            return name
    raise FetchError(f"service sends {listed(list(service.formats))}; JPEG, PNG or WebP are read")


def _layer(name: str, plain: Any) -> WmsLayer:
    crs: dict[str, str] = {}
    # OWSLib gives them in no order; addresses must be the same every time, for the cache.
    for named in sorted(plain.crsOptions or [], key=lambda name: (name[:5] != "EPSG:", name)):
        try:
            name_ = epsg_name(named)
        except FetchError:
            continue
        crs[name_] = named if named == name_ else crs.get(name_, named)
    times = tuple(value.strip() for value in plain.timepositions or [] if value and value.strip())
    return WmsLayer(name, plain.title or "", tuple(plain.styles), crs, times)


def _max_px(root: Any) -> int:
    """Largest width and height of a picture, at least a small one; plenty where nothing is told."""
    told = [
        int(element.text)
        for element in root.iter()
        if re.fullmatch(r"(\{.*\})?Max(Width|Height)", str(element.tag))
        and str(element.text or "").strip().isdecimal()
    ]
    return max(_MIN_CELL_PX, min([value for value in told if value > 0], default=CELL_PX))


def _number(value: float) -> str:
    """A coordinate with at most nine decimals, without an exponent."""
    return f"{value:.9f}".rstrip("0").rstrip(".")
