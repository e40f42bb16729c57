"""WMS 1.1.1 and 1.3.0: images of any box, requested as the cells of a fixed grid.

In 1.3.0 the order of coordinates is that of the coordinate system's authority, so northing first
in EPSG:4326 and in many national ones (OGC 06-042, 6.7.2); in 1.1.1 it is always x, y.
"""

import math
from xml.etree.ElementTree import Element

from orthonav.core.errors import FetchError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.fetch.grid import CellGrid, epsg_name, ground_scale, north_first
from orthonav.ground.fetch.options import (
    HEIGHTS_FORMAT,
    TERRAIN_GSD_M,
    SourceSpec,
    choose,
    choose_format,
    choose_layer,
    choose_time,
)
from orthonav.ground.fetch.service import CellSource, service_source
from orthonav.ground.fetch.urls import linked, with_query
from orthonav.ground.fetch.web import Web, texts
from orthonav.ground.planning.area import Area

CELL_PX = 1024  # width of the images requested: services render several per second at this size
_MIN_CELL_PX = 64
_VERSIONS = ("1.3.0", "1.1.1")


def wms_cells(web: Web, spec: SourceSpec, area: Area) -> CellSource:
    """Cells of a layer of a service. Raises `FetchError` with the available choices."""
    url, options, frame = spec.url, spec.options, area.frame
    wanted = options.version or _VERSIONS[0]
    if wanted not in _VERSIONS:
        raise FetchError(f"supported versions of WMS are 1.1.1 and 1.3.0, not {wanted}")
    url = with_query(url, {"SERVICE": "WMS", "REQUEST": "GetCapabilities", "VERSION": wanted})
    root = web.get_xml(url)
    version = root.get("version", "")
    if version not in _VERSIONS:
        found = version or root.tag
        raise FetchError(f"supported versions of WMS are 1.1.1 and 1.3.0, got '{found}': {url}")
    get_map = root.find("Capability/Request/GetMap")
    address = root.find("Capability/Request/GetMap/DCPType/HTTP/Get/OnlineResource")
    if get_map is None or address is None:
        raise FetchError(f"WMS capabilities name no address of GetMap: {url}")
    layers = _layers(root)
    name = choose_layer(list(layers), options.layer, url, named=True)
    chain = layers[name]
    styles = [style for each in chain for style in texts(each, "Style/Name")]
    if options.style is not None:
        choose(styles, options.style, f"layer {name} has no style")
    names = _crs_names([crs for each in chain for crs in texts(each, "CRS") + texts(each, "SRS")])
    crs = _crs(names, options.crs, frame, name)
    format_ = choose_format(texts(get_map, "Format"), options, "service")
    limits = [
        int(side) or CELL_PX
        for side in texts(root, "Service/MaxWidth") + texts(root, "Service/MaxHeight")
        if side.isdecimal()
    ]
    cell_px = min(max(_MIN_CELL_PX, min([CELL_PX, *limits])), options.tile_px or CELL_PX)
    gsd_m = options.wanted_gsd_m
    if format_ == HEIGHTS_FORMAT and options.gsd_m is None:
        gsd_m = TERRAIN_GSD_M
    # Where the projection is true to scale within 1 %, so that a round number stays one.
    scales = (
        1.0 if math.isclose(scale, 1.0, rel_tol=0.01) else scale
        for scale in ground_scale(crs, frame)
    )
    res_x, res_y = (gsd_m / scale for scale in scales)
    map_url = linked(url, address.get("href", ""))
    if options.time is not None:
        map_url = with_query(map_url, {"TIME": choose_time(_times(chain), options.time, name)})
    preferred = options.preferred_style or ""
    service = {
        "name": "WMS",
        "Version": version,
        "ServerUrl": map_url,
        "Layers": name,
        "Styles": options.style or (preferred if preferred in styles else ""),
        "CRS" if version == "1.3.0" else "SRS": names[crs],
        "ImageFormat": format_,
        "Transparent": "FALSE" if format_ in ("image/jpeg", HEIGHTS_FORMAT) else "TRUE",
    }
    if version == "1.3.0" and not names[crs].startswith("CRS:") and north_first(crs):
        service["BBoxOrder"] = "yxYX"
    grid = CellGrid(crs, 0.0, 0.0, res_x, res_y, cell_px, cell_px)
    return service_source(spec, grid, format_, service)


def _layers(root: Element) -> dict[str, list[Element]]:
    found: dict[str, list[Element]] = {}
    stack = [[layer] for layer in root.findall("Capability/Layer")]
    while stack:
        chain = stack.pop()
        for name in texts(chain[0], "Name"):
            found[name] = chain
        stack += [[inner, *chain] for inner in reversed(chain[0].findall("Layer"))]
    return found


def _times(chain: list[Element]) -> list[str]:
    """Times of the imagery; in 1.1.1 they stand in `Extent`."""
    elements = [each for layer in chain for each in layer if each.tag in ("Dimension", "Extent")]
    values = [each.text or "" for each in elements if each.get("name", "").lower() == "time"]
    return [value.strip() for text in values for value in text.split(",") if value.strip()]


def _crs_names(options: list[str]) -> dict[str, str]:
    crs: dict[str, str] = {}
    for option in (name for text in options for name in text.split()):
        try:
            epsg = epsg_name(option)
        except FetchError:
            continue
        crs[epsg] = option if option == epsg else crs.get(epsg, option)
    return crs


def _crs(names: dict[str, str], wanted: str | None, frame: LocalFrame, layer: str) -> str:
    """The coordinate system requested, else UTM, else Web Mercator, else the first."""
    zone = int((frame.lon_deg + 180) % 360 // 6) + 1
    utm = [f"EPSG:258{zone:02d}", f"EPSG:{326 if frame.lat_deg >= 0 else 327}{zone:02d}"]
    preferred = (name for name in [*utm, "EPSG:3857", *names] if name in names)
    wanted = wanted or next(preferred, "a known system")
    return choose(list(names), wanted, f"layer {layer} does not come in")
