"""WMS 1.1.1 and 1.3.0: images of any box, requested as the cells of a fixed grid.

In 1.3.0 the order of coordinates is that of the coordinate system's authority, so northing first
in EPSG:4326 and in many national ones (OGC 06-042, 6.7.2); in 1.1.1 it is always x, y.
"""

import re
from xml.etree.ElementTree import Element

from orthonav.core.errors import FetchError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.fetch.client import Client
from orthonav.ground.fetch.crs import epsg_name, ground_scale, north_first
from orthonav.ground.fetch.documents import capabilities, get_xml
from orthonav.ground.fetch.grid import CellGrid
from orthonav.ground.fetch.options import (
    HEIGHTS_FORMAT,
    TERRAIN_GSD_M,
    SourceSpec,
    choose,
    choose_format,
    choose_layer,
    choose_time,
)
from orthonav.ground.fetch.service import CellSource, resolution, tile_source
from orthonav.ground.fetch.urls import with_query
from orthonav.ground.planning.area import Area

CELL_PX = 1024
"""Width of the images requested: services render several per second at this size."""
_MIN_CELL_PX = 64
_VERSIONS = ("1.3.0", "1.1.1")


def wms_cells(client: Client, spec: SourceSpec, area: Area) -> CellSource:
    """Cells of a layer of a service. Raises `FetchError` with the available choices."""
    url, options, frame = spec.url, spec.options, area.frame
    wanted = options.version or _VERSIONS[0]
    if wanted not in _VERSIONS:
        raise FetchError(f"supported versions of WMS are 1.1.1 and 1.3.0, not {wanted}")
    url = with_query(url, {"SERVICE": "WMS", "REQUEST": "GetCapabilities", "VERSION": wanted})
    body, root = get_xml(client, url)
    version = root.get("version", "")
    if version not in _VERSIONS:
        found = version or root.tag
        raise FetchError(f"supported versions of WMS are 1.1.1 and 1.3.0, got '{found}': {url}")
    with capabilities("WMS", url):
        from owslib.wms import WebMapService

        service = WebMapService(url, version=version, xml=body)
        get_map = service.getOperationByName("GetMap")
        layers = {name: layer for name, layer in service.contents.items() if name}
        layer = layers[choose_layer(list(layers), options.layer, url, named=True)]
        names = _crs_names(layer.crsOptions or [])
        times = [value.strip() for value in layer.timepositions or [] if value]
        address = next(each["url"] for each in get_map.methods if each["type"].lower() == "get")
        formats, styles = tuple(get_map.formatOptions), list(layer.styles)
        max_px = _max_px(root)
    if options.style is not None:
        choose(styles, options.style, f"layer {layer.name} has no style")
    crs = _crs(names, options.crs, frame, layer.name)
    format_ = choose_format(formats, options, "service")
    cell_px = min(CELL_PX, max_px, options.tile_px or CELL_PX)
    gsd_m = options.wanted_gsd_m
    if format_ == HEIGHTS_FORMAT and options.gsd_m is None:
        gsd_m = TERRAIN_GSD_M
    res_x, res_y = (resolution(gsd_m, scale) for scale in ground_scale(crs, frame))
    grid = CellGrid(crs, 0.0, 0.0, res_x, res_y, cell_px, cell_px)
    preferred = options.preferred_style or ""
    parameters = {
        "LAYERS": layer.name,
        "STYLES": options.style or (preferred if preferred in styles else ""),
        "CRS" if version == "1.3.0" else "SRS": names[crs],
        "WIDTH": str(cell_px),
        "HEIGHT": str(cell_px),
        "FORMAT": format_,
        "TRANSPARENT": "FALSE" if format_ in ("image/jpeg", HEIGHTS_FORMAT) else "TRUE",
    }
    if options.time is not None:
        parameters["TIME"] = choose_time(list(filter(None, times)), options.time, layer.name)
    request = {"SERVICE": "WMS", "VERSION": version, "REQUEST": "GetMap"}
    fixed = with_query(client.linked(url, address), request | parameters)
    swap = version == "1.3.0" and not names[crs].startswith("CRS:") and north_first(crs)

    def url_of(row: int, col: int) -> str:
        west, south, east, north = grid.bounds(row, col)
        box = (south, west, north, east) if swap else (west, south, east, north)
        return with_query(fixed, {"BBOX": ",".join(_number(value) for value in box)})

    return tile_source(spec.provenance, grid, url_of, format_, options.empty, tiled=False)


def _crs_names(options: list[str]) -> dict[str, str]:
    """Names of coordinate systems in the document by EPSG name."""
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


def _crs(names: dict[str, str], wanted: str | None, frame: LocalFrame, layer: str) -> str:
    """The coordinate system requested, else UTM, else Web Mercator, else the first."""
    zone = int((frame.lon_deg + 180) % 360 // 6) + 1
    utm = [f"EPSG:258{zone:02d}", f"EPSG:{326 if frame.lat_deg >= 0 else 327}{zone:02d}"]
    preferred = (name for name in [*utm, "EPSG:3857", *names] if name in names)
    wanted = wanted or next(preferred, "a known system")
    return choose(list(names), wanted, f"layer {layer} does not come in")


def _number(value: float) -> str:
    """A coordinate with at most nine decimals, without an exponent."""
    return f"{value:.9f}".rstrip("0").rstrip(".")
