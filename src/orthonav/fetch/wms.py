"""WMS 1.1.1 and 1.3.0: images of any box, requested as the cells of a fixed grid.

In 1.3.0 the order of coordinates is that of the coordinate system's authority, so northing first
in EPSG:4326 and in many national ones (OGC 06-042, 6.7.2); in 1.1.1 it is always x, y.
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
from orthonav.fetch.options import ImageryOptions, Provenance, choose, listed
from orthonav.fetch.service import TileSource, resolution
from orthonav.fetch.urls import carrying_key, joined, with_query
from orthonav.geo.frames import LocalFrame

CELL_PX = 1024
"""Width of the images requested: services render several per second at this size."""
_MIN_CELL_PX = 64
_FORMATS = ("image/jpeg", "image/png", "image/webp")
_VERSIONS = ("1.3.0", "1.1.1")


@dataclass(frozen=True)
class WmsLayer:
    """A layer: `crs` maps EPSG names to the names in the document; `times` where it has any."""

    name: str
    styles: tuple[str, ...]
    crs: dict[str, str]
    times: tuple[str, ...]


@dataclass(frozen=True)
class Wms:
    """A service: `url` of GetMap, largest image, and its layers that have a name."""

    url: str
    version: str
    formats: tuple[str, ...]
    max_px: int
    layers: dict[str, WmsLayer]


def open_wms(client: Client, url: str, version: str | None = None) -> Wms:
    """The capabilities of a service in the version it answers with. Raises `FetchError`."""
    wanted = version or _VERSIONS[0]
    if wanted not in _VERSIONS:
        raise FetchError(f"supported versions of WMS are 1.1.1 and 1.3.0, not {wanted}")
    where = with_query(url, {"SERVICE": "WMS", "REQUEST": "GetCapabilities", "VERSION": wanted})
    return read_capabilities(get_xml(client, where), where, client.redacted)


def read_capabilities(
    document: bytes, url: str, redacted: Callable[[str], str] = lambda text: text
) -> Wms:
    """The content of a capabilities document that was checked before. Raises `FetchError`."""
    owslib = needed("owslib.wms", "fetch", "reading capabilities")
    root = parse_xml(document)
    version = root.get("version", "")
    if version not in _VERSIONS:
        found = version or root.tag
        raise FetchError(f"supported versions of WMS are 1.1.1 and 1.3.0, got '{found}': {url}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            service = owslib.WebMapService(url, version=version, xml=document)
            get_map = service.getOperationByName("GetMap")
            layers = {
                name: layer
                for name, content in service.contents.items()
                if name and (layer := _layer(name, content)).crs
            }
            formats = tuple(get_map.formatOptions)
            address = next(
                method["url"] for method in get_map.methods if method["type"].lower() == "get"
            )
    except Exception as error:  # OWSLib raises AttributeError and others for odd documents
        raise FetchError(
            f"WMS capabilities cannot be read ({type(error).__name__}): {url}"
        ) from None
    if not layers:
        raise FetchError(f"document lists no layer of a WMS: {url}")
    map_url = carrying_key(url, joined(url, redacted(address)))
    return Wms(map_url, version, formats, _max_px(root), layers)


def wms_cells(
    service: Wms, options: ImageryOptions, frame: LocalFrame, provenance: Provenance
) -> TileSource:
    """Cells of the selected layer. Raises `FetchError` with the available choices."""
    if options.layer is None:
        available = listed(list(service.layers), "ortho")
        raise FetchError(f"choose one with --layer; available: {available}")
    layer = service.layers[choose(list(service.layers), options.layer, "no layer")]
    if options.style is not None:
        choose(list(layer.styles), options.style, f"layer {layer.name} has no style")
    crs = _crs(layer, options.crs, frame)
    format_ = _format(service, options)
    scale_x, scale_y = ground_scale(crs, frame)
    cell_px = min(CELL_PX, service.max_px, options.tile_px or CELL_PX)
    res_x = resolution(options.wanted_gsd_m, scale_x)
    res_y = resolution(options.wanted_gsd_m, scale_y)
    grid = CellGrid(crs, 0.0, 0.0, res_x, res_y, cell_px, cell_px)
    fixed = _get_map(service, layer, options, format_, layer.crs[crs], cell_px)
    swap = service.version == "1.3.0" and not layer.crs[crs].startswith("CRS:") and north_first(crs)

    def url_of(row: int, col: int) -> str:
        west, south, east, north = grid.bounds(row, col)
        box = (south, west, north, east) if swap else (west, south, east, north)
        return with_query(fixed, {"BBOX": ",".join(_number(value) for value in box)})

    return TileSource(provenance, grid, url_of, format_, options.empty, tiled=False)


def _get_map(
    service: Wms, layer: WmsLayer, options: ImageryOptions, format_: str, crs: str, cell_px: int
) -> str:
    """The address of GetMap without the box."""
    preferred = options.preferred_style if options.preferred_style in layer.styles else None
    parameters = {
        "SERVICE": "WMS",
        "VERSION": service.version,
        "REQUEST": "GetMap",
        "LAYERS": layer.name,
        "STYLES": options.style or preferred or "",
        "CRS" if service.version == "1.3.0" else "SRS": crs,
        "WIDTH": str(cell_px),
        "HEIGHT": str(cell_px),
        "FORMAT": format_,
        "TRANSPARENT": "TRUE" if format_ != "image/jpeg" else "FALSE",
    }
    if options.time is not None:
        if not any("/" in value for value in layer.times):  # else any time within an interval
            choose(list(layer.times), options.time, f"layer {layer.name} has no time")
        parameters["TIME"] = options.time
    return with_query(service.url, parameters)


def _crs(layer: WmsLayer, wanted: str | None, frame: LocalFrame) -> str:
    """The coordinate system requested, else UTM, else Web Mercator, else the first."""
    names = list(layer.crs)
    if wanted is not None:
        return choose(names, wanted, f"layer {layer.name} does not come in")
    zone = int((frame.lon_deg + 180) % 360 // 6) + 1
    utm = [f"EPSG:258{zone:02d}", f"EPSG:{326 if frame.lat_deg >= 0 else 327}{zone:02d}"]
    return next(name for name in [*utm, "EPSG:3857", *names] if name in layer.crs)


def _format(service: Wms, options: ImageryOptions) -> str:
    formats = list(service.formats)
    if options.format is not None:
        return choose(formats, options.format, "service has no format")
    for name in (options.preferred_format, *_FORMATS):
        if name is not None and name in formats:
            return name
    raise FetchError(f"service sends {listed(formats)}; supported are JPEG, PNG and WebP")


def _layer(name: str, content: Any) -> WmsLayer:
    crs: dict[str, str] = {}
    # OWSLib returns them in no order; addresses must be the same every time, for the cache.
    for option in sorted(content.crsOptions or [], key=lambda name: (name[:5] != "EPSG:", name)):
        try:
            epsg = epsg_name(option)
        except FetchError:
            continue
        crs[epsg] = option if option == epsg else crs.get(epsg, option)
    times = tuple(value.strip() for value in content.timepositions or [] if value and value.strip())
    return WmsLayer(name, tuple(content.styles), crs, times)


def _max_px(root: Any) -> int:
    """Largest width and height of an image, `CELL_PX` where the service sets no limit."""
    limits = [
        int(element.text)
        for element in root.iter()
        if re.fullmatch(r"(\{.*\})?Max(Width|Height)", str(element.tag))
        and str(element.text or "").strip().isdecimal()
    ]
    return max(_MIN_CELL_PX, min([value for value in limits if value > 0], default=CELL_PX))


def _number(value: float) -> str:
    """A coordinate with at most nine decimals, without an exponent."""
    return f"{value:.9f}".rstrip("0").rstrip(".")
