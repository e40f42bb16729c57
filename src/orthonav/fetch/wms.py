"""WMS 1.1.1 and 1.3.0: images of any box, requested as the cells of a fixed grid.

In 1.3.0 the order of coordinates is that of the coordinate system's authority, so northing first
in EPSG:4326 and in many national ones (OGC 06-042, 6.7.2); in 1.1.1 it is always x, y.
"""

import re
from dataclasses import dataclass
from xml.etree.ElementTree import Element

from orthonav.errors import FetchError
from orthonav.fetch.client import Client
from orthonav.fetch.crs import epsg_name, ground_scale, north_first
from orthonav.fetch.documents import XmlDocument, capabilities, get_xml
from orthonav.fetch.grid import CellGrid
from orthonav.fetch.options import (
    HEIGHTS_FORMAT,
    TERRAIN_GSD_M,
    ImageryOptions,
    Provenance,
    choose,
    choose_format,
    choose_layer,
    choose_time,
)
from orthonav.fetch.service import CellSource, resolution, tile_source
from orthonav.fetch.urls import with_query
from orthonav.geo.frames import LocalFrame

CELL_PX = 1024
"""Width of the images requested: services render several per second at this size."""
_MIN_CELL_PX = 64
_VERSIONS = ("1.3.0", "1.1.1")


@dataclass(frozen=True)
class WmsLayer:
    """A layer as its capabilities describe it."""

    name: str
    styles: tuple[str, ...]
    """Styles."""
    crs: dict[str, str]
    """Names of coordinate systems in the document by EPSG name."""
    times: tuple[str, ...]
    """Times, or intervals of times; empty where it has none."""
    url: str
    """Address of GetMap."""
    version: str
    """Version of the protocol that the service answers with."""
    formats: tuple[str, ...]
    """Media types."""
    max_px: int
    """Largest width and height of an image."""


def open_wms(client: Client, url: str, name: str | None, version: str | None = None) -> WmsLayer:
    """A layer of a service. Raises `FetchError` with the available layers."""
    wanted = version or _VERSIONS[0]
    if wanted not in _VERSIONS:
        raise FetchError(f"supported versions of WMS are 1.1.1 and 1.3.0, not {wanted}")
    where = with_query(url, {"SERVICE": "WMS", "REQUEST": "GetCapabilities", "VERSION": wanted})
    return read_layer(client, get_xml(client, where), where, name)


def read_layer(client: Client, document: XmlDocument, url: str, name: str | None) -> WmsLayer:
    """The layer of that name. Raises `FetchError` with the available ones."""
    version = document.root.get("version", "")
    if version not in _VERSIONS:
        found = version or document.root.tag
        raise FetchError(f"supported versions of WMS are 1.1.1 and 1.3.0, got '{found}': {url}")
    with capabilities("WMS", url):
        from owslib.wms import WebMapService

        service = WebMapService(url, version=version, xml=document.body)
        get_map = service.getOperationByName("GetMap")
        layers = {name: layer for name, layer in service.contents.items() if name}
        layer = layers[choose_layer(list(layers), name, url, named=True)]
        times = (value.strip() for value in layer.timepositions or [] if value)
        address = next(each["url"] for each in get_map.methods if each["type"].lower() == "get")
        return WmsLayer(
            name=layer.name,
            styles=tuple(layer.styles),
            crs=_crs_names(layer.crsOptions or []),
            times=tuple(filter(None, times)),
            url=client.linked(url, address),
            version=version,
            formats=tuple(get_map.formatOptions),
            max_px=_max_px(document.root),
        )


def _crs_names(options: list[str]) -> dict[str, str]:
    crs: dict[str, str] = {}
    # OWSLib returns them in no order; addresses must be the same every time, for the cache.
    for option in sorted(options, key=lambda name: (name[:5] != "EPSG:", name)):
        try:
            epsg = epsg_name(option)
        except FetchError:
            continue
        crs[epsg] = option if option == epsg else crs.get(epsg, option)
    return crs


def _max_px(root: Element) -> int:
    """Largest width and height of an image, `CELL_PX` where the service sets no limit."""
    limits = [
        int(element.text)
        for element in root.iter()
        if re.fullmatch(r"(\{.*\})?Max(Width|Height)", str(element.tag))
        and element.text is not None
        and element.text.strip().isdecimal()
    ]
    return max(_MIN_CELL_PX, min([value for value in limits if value > 0], default=CELL_PX))


def wms_cells(
    layer: WmsLayer, options: ImageryOptions, frame: LocalFrame, provenance: Provenance
) -> CellSource:
    """Cells of a layer. Raises `FetchError` with the available choices."""
    if options.style is not None:
        choose(list(layer.styles), options.style, f"layer {layer.name} has no style")
    crs = _crs(layer, options.crs, frame)
    format_ = choose_format(layer.formats, options, "service")
    scale_x, scale_y = ground_scale(crs, frame)
    cell_px = min(CELL_PX, layer.max_px, options.tile_px or CELL_PX)
    gsd_m = options.wanted_gsd_m
    if format_ == HEIGHTS_FORMAT and options.gsd_m is None:
        gsd_m = TERRAIN_GSD_M
    res_x, res_y = resolution(gsd_m, scale_x), resolution(gsd_m, scale_y)
    grid = CellGrid(crs, 0.0, 0.0, res_x, res_y, cell_px, cell_px)
    fixed = _get_map(layer, options, format_, layer.crs[crs], cell_px)
    swap = layer.version == "1.3.0" and not layer.crs[crs].startswith("CRS:") and north_first(crs)

    def url_of(row: int, col: int) -> str:
        west, south, east, north = grid.bounds(row, col)
        box = (south, west, north, east) if swap else (west, south, east, north)
        return with_query(fixed, {"BBOX": ",".join(_number(value) for value in box)})

    return tile_source(provenance, grid, url_of, format_, options.empty, tiled=False)


def _get_map(layer: WmsLayer, options: ImageryOptions, format_: str, crs: str, cell_px: int) -> str:
    """The address of GetMap without the box."""
    preferred = options.preferred_style if options.preferred_style in layer.styles else None
    parameters = {
        "SERVICE": "WMS",
        "VERSION": layer.version,
        "REQUEST": "GetMap",
        "LAYERS": layer.name,
        "STYLES": options.style or preferred or "",
        "CRS" if layer.version == "1.3.0" else "SRS": crs,
        "WIDTH": str(cell_px),
        "HEIGHT": str(cell_px),
        "FORMAT": format_,
        "TRANSPARENT": "FALSE" if format_ in ("image/jpeg", HEIGHTS_FORMAT) else "TRUE",
    }
    if options.time is not None:
        parameters["TIME"] = choose_time(layer.times, options.time, layer.name)
    return with_query(layer.url, parameters)


def _crs(layer: WmsLayer, wanted: str | None, frame: LocalFrame) -> str:
    """The coordinate system requested, else UTM, else Web Mercator, else the first."""
    zone = int((frame.lon_deg + 180) % 360 // 6) + 1
    utm = [f"EPSG:258{zone:02d}", f"EPSG:{326 if frame.lat_deg >= 0 else 327}{zone:02d}"]
    preferred = (name for name in [*utm, "EPSG:3857", *layer.crs] if name in layer.crs)
    wanted = wanted or next(preferred, "a known system")
    return choose(list(layer.crs), wanted, f"layer {layer.name} does not come in")


def _number(value: float) -> str:
    """A coordinate with at most nine decimals, without an exponent."""
    return f"{value:.9f}".rstrip("0").rstrip(".")
