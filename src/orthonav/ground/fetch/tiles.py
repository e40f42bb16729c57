"""Tiles and images of services: by address template (XYZ), WMTS 1.0.0, WMS 1.1.1 and 1.3.0, and
heights of WCS 1.0.0.

Tiles of a WMTS (OGC 07-057r7) are read by address template, as those of XYZ: GDAL's own driver of
WMTS takes the default time only, and resolutions as they are rounded in the document.
"""

import math
import re
from contextlib import suppress
from urllib.parse import quote
from xml.etree.ElementTree import Element

from orthonav.core.errors import FetchError
from orthonav.core.geo.frames import WGS84_A_M, LocalFrame
from orthonav.ground.fetch.grid import (
    CellGrid,
    epsg_name,
    ground_scale,
    known_crs,
    mean_scale,
    north_first,
)
from orthonav.ground.fetch.presets import (
    HEIGHTS_FORMAT,
    ImageryOptions,
    SourceSpec,
    choose,
    choose_crs,
    choose_format,
    choose_layer,
    finest_fitting,
)
from orthonav.ground.fetch.service import CellSource, service_source
from orthonav.ground.fetch.urls import linked, with_query
from orthonav.ground.fetch.web import Web, texts
from orthonav.ground.planning.area import Area

MERCATOR_HALF_M = math.pi * WGS84_A_M
"""Half the width of the square of EPSG:3857, metres of that projection."""
MAX_ZOOM = 24  # finest zoom level, 9 mm per pixel at the equator: finer than any orthophoto
MAX_TILE_PX = 4096  # largest tile that is accepted; usual ones have 256 or 512 px


def xyz_tiles(spec: SourceSpec, area: Area) -> CellSource:
    """The tiles of a template with `{z}/{x}/{y}` in Web Mercator, as web maps use them.

    `{-y}` counts rows from the south. Tiles are 256 px wide, with `@2x` in the template 512. Raises
    `FetchError`.
    """
    template, options = spec.url, spec.options
    parts = set(re.findall(r"\{([^{}]*)\}", template)) - {"key"}
    if parts not in ({"z", "x", "y"}, {"z", "x", "-y"}):
        raise FetchError(
            "template needs {z}, {x} and {y} (or {-y}), and may hold {key}; "
            f"got: {template[:200]}"
        )
    tile_px = options.tile_px or (512 if "@2x" in template else 256)
    if not 64 <= tile_px <= MAX_TILE_PX:
        raise FetchError(f"tiles must be 64 to {MAX_TILE_PX} px wide, got {tile_px}")
    high = min(MAX_ZOOM, options.max_zoom or MAX_ZOOM)
    resolutions = [2 * MERCATOR_HALF_M / tile_px / 2.0**zoom for zoom in range(high + 1)]
    scale = mean_scale("EPSG:3857", area.frame)
    gsds_m = [res * scale for res in resolutions]
    zoom = finest_fitting(gsds_m, options.wanted_gsd_m, f"zoom 0 to {high}")
    half, last, res = MERCATOR_HALF_M, 2**zoom - 1, resolutions[zoom]
    grid = CellGrid("EPSG:3857", -half, half, res, res, tile_px, tile_px, (0, 0, last, last))
    for part, value in (("z", str(zoom)), ("x", "${x}"), ("y", "${y}"), ("-y", "${y}")):
        template = template.replace(f"{{{part}}}", value)
    path = template.partition("?")[0].lower()
    formats = {".png": "image/png", ".webp": "image/webp"}
    format_ = next((kind for end, kind in formats.items() if path.endswith(end)), "image/jpeg")
    service = {"name": "TMS", "ServerUrl": template}
    return service_source(spec, grid, format_, service, zoom, from_south="-y" in parts)


def wmts_tiles(web: Web, spec: SourceSpec, area: Area) -> CellSource:
    """The tiles of a layer of a service. Raises `FetchError` with the available choices."""
    url, options = spec.url, spec.options
    if not url.partition("?")[0].lower().endswith(".xml"):
        url = with_query(url, {"SERVICE": "WMTS", "REQUEST": "GetCapabilities", "VERSION": "1.0.0"})
    root = web.get_xml(url)
    layers = {name: layer for layer in root.iterfind("Contents/Layer") for name in _id(layer)}
    name = choose_layer(list(layers), options.layer, url)
    layer = layers[name]
    templates: dict[str, str] = {}
    for resource in layer.iterfind("ResourceURL[@resourceType='tile']"):
        templates.setdefault(resource.get("format", ""), resource.get("template", ""))
    formats = list(filter(None, dict.fromkeys([*texts(layer, "Format"), *templates])))
    format_ = choose_format(formats, options, f"layer {name}")
    set_name, grids = _grids(root, layer, name, options)
    scale = mean_scale(next(iter(grids.values())).crs, area.frame)
    gsds_m = [scale * grid.res_x for grid in grids.values()]
    named = zip(grids, gsds_m, strict=True)
    levels = ", ".join(f"{zoom} ({gsd_m:.3g} m)" for zoom, gsd_m in named)
    matrix = list(grids)[finest_fitting(gsds_m, options.wanted_gsd_m, f"zoom {levels}")]
    values = {
        "Layer": name,
        "Style": _style(layer, name, options),
        "Format": format_,
        "TileMatrixSet": set_name,
        "TileMatrix": matrix,
        "TileRow": "${y}",
        "TileCol": "${x}",
        **_dimensions(layer, name, options),
    }
    template = templates.get(format_) or _kvp_template(root, list(values))
    if template is None:
        raise FetchError(f"service offers no tiles of {name} as {format_}: {url}")
    template = linked(url, template)
    for field, value in values.items():
        part = re.compile(rf"\{{{re.escape(field)}\}}", re.IGNORECASE)
        template = part.sub(quote(value, safe="${}:,/"), template)
    service = {"name": "TMS", "ServerUrl": template}
    return service_source(spec, grids[matrix], format_, service)


def _id(element: Element) -> list[str]:
    return texts(element, "Identifier")[:1]


def _style(layer: Element, name: str, options: ImageryOptions) -> str:
    elements = sorted(layer.iterfind("Style"), key=lambda each: each.get("isDefault") != "true")
    styles = [style for element in elements for style in _id(element)] or ["default"]
    return choose(styles, options.style, f"layer {name} has no style")


def _dimensions(layer: Element, name: str, options: ImageryOptions) -> dict[str, str]:
    """Values of the dimensions by name in lower case: the time requested, else the default."""
    found = {}
    for element in layer.iterfind("Dimension"):
        values = texts(element, "Default") + texts(element, "Value")
        for dimension in map(str.lower, _id(element) if values else []):
            found[dimension] = values[0]
            if dimension == "time" and options.time is not None:
                any_time = any("/" in value for value in values)  # of an interval
                known = [options.time] if any_time else values
                found[dimension] = choose(known, options.time, f"layer {name} has no time")
    if options.time is not None and "time" not in found:
        raise FetchError(f"layer {name} has no time to choose, --time was {options.time}")
    return found


def _kvp_template(root: Element, names: list[str]) -> str | None:
    """Address with these parameters in its query, where the service takes them there."""
    for method in root.iterfind("OperationsMetadata/Operation[@name='GetTile']/DCP/HTTP/Get"):
        encodings = texts(method, "Constraint[@name='GetEncoding']/AllowedValues/Value")
        address = method.get("href")
        if address is not None and (not encodings or "KVP" in encodings):
            request = {"SERVICE": "WMTS", "REQUEST": "GetTile", "VERSION": "1.0.0"}
            return with_query(address, request | {name.upper(): f"{{{name}}}" for name in names})
    return None


def _grids(
    root: Element, layer: Element, name: str, options: ImageryOptions
) -> tuple[str, dict[str, CellGrid]]:
    """Name of the first tile matrix set in the coordinate system, and its grids by matrix."""
    known = {name: each for each in root.iterfind("Contents/TileMatrixSet") for name in _id(each)}
    by_crs: dict[str, tuple[str, Element]] = {}
    for link in layer.iterfind("TileMatrixSetLink"):
        for set_name in texts(link, "TileMatrixSet"):
            with suppress(FetchError, KeyError, IndexError):
                crs = epsg_name(texts(known[set_name], "SupportedCRS")[0])
                by_crs.setdefault(crs, (set_name, link))
    if not by_crs:
        raise FetchError(f"layer {name} has no grid that can be read")
    set_name, link = by_crs[choose_crs(list(by_crs), options.crs, f"layer {name}")]
    limits = texts(link, "TileMatrixSetLimits/TileMatrixLimits/TileMatrix")
    finest = math.inf if options.max_zoom is None else options.max_zoom
    crs_name = texts(known[set_name], "SupportedCRS")[0]
    grids = {}
    matrices = known[set_name].iterfind("TileMatrix")
    for zoom, element in ((zoom, each) for each in matrices for zoom in _id(each)):
        number = zoom.rpartition(":")[2]  # EPSG:3857:07 is zoom 7
        level = int(number) if number.isdecimal() else 0
        if zoom in limits or (not limits and level <= finest):
            try:
                grids[zoom] = _grid(element, crs_name)
            except (ValueError, IndexError, OverflowError):
                problem = f"tile matrix {zoom} of {set_name} cannot be read"
                raise FetchError(problem) from None
    if not grids:
        raise FetchError(f"layer {name} has no zoom in its grid {set_name}")
    return set_name, grids


def _grid(matrix: Element, crs_name: str) -> CellGrid:
    """The grid of a tile matrix. Raises `ValueError` and `IndexError` for a malformed one."""
    crs = epsg_name(crs_name)
    known = known_crs(crs)
    first, second = map(float, texts(matrix, "TopLeftCorner")[0].split())
    is_swapped = north_first(crs) and not crs_name.endswith(("CRS84", "CRS:84"))
    if known.is_geographic:
        is_swapped &= abs(first) <= 90  # some services put the longitude first nevertheless
    else:
        is_swapped &= crs_name.startswith(("urn:", "http"))
    west, north = (second, first) if is_swapped else (first, second)
    tags = "TileWidth", "TileHeight", "MatrixWidth", "MatrixHeight"
    width, height, cols, rows = (int(texts(matrix, tag)[0]) for tag in tags)
    # Of pixels of 0.28 mm, with degrees as long as at the equator (OGC 07-057r7, 6.1).
    unit_m = MERCATOR_HALF_M / 180
    if not known.is_geographic:
        unit_m = known.axis_info[0].unit_conversion_factor
    res = float(texts(matrix, "ScaleDenominator")[0]) * 0.28e-3 / unit_m
    if not (res > 0 and 0 < width <= MAX_TILE_PX and 0 < height <= MAX_TILE_PX):
        raise ValueError("impossible size")
    if crs == "EPSG:3857" and max(abs(west + MERCATOR_HALF_M), abs(north - MERCATOR_HALF_M)) < 1:
        # The web grid, stated with fewer digits: one part in a million moves its far corner 20 m.
        west, north, whole = -MERCATOR_HALF_M, MERCATOR_HALF_M, 2 * MERCATOR_HALF_M / width
        exact = whole / 2.0 ** round(math.log2(whole / res))
        res = exact if math.isclose(res, exact, rel_tol=1e-4) else res
    return CellGrid(crs, west, north, res, res, width, height, (0, 0, rows - 1, cols - 1))


def wms_cells(web: Web, spec: SourceSpec, area: Area) -> CellSource:
    """Images of any box, requested as the cells of a fixed grid. Raises `FetchError`.

    In 1.3.0 the order of coordinates is that of the coordinate system's authority, so northing
    first in EPSG:4326 and in many national ones (OGC 06-042, 6.7.2); in 1.1.1 it is always x, y.
    """
    url, options, frame = spec.url, spec.options, area.frame
    if options.time is not None:
        raise FetchError(f"times of a WMS cannot be chosen, --time was {options.time}")
    url = with_query(url, {"SERVICE": "WMS", "REQUEST": "GetCapabilities", "VERSION": "1.3.0"})
    root = web.get_xml(url)
    version = root.get("version", "")
    if version not in ("1.3.0", "1.1.1"):
        found = version or root.tag
        raise FetchError(f"supported versions of WMS are 1.1.1 and 1.3.0, got '{found}': {url}")
    get_map = root.find("Capability/Request/GetMap")
    address = root.find("Capability/Request/GetMap/DCPType/HTTP/Get/OnlineResource")
    if get_map is None or address is None:
        raise FetchError(f"WMS capabilities name no address of GetMap: {url}")
    layers = _wms_layers(root)
    name = choose_layer(list(layers), options.layer, url)
    chain = layers[name]
    styles = [style for each in chain for style in texts(each, "Style/Name")]
    if options.style is not None:
        choose(styles, options.style, f"layer {name} has no style")
    names = _crs_names([crs for each in chain for crs in texts(each, "CRS") + texts(each, "SRS")])
    crs = choose_crs(list(names), options.crs, f"layer {name}")
    format_ = choose_format(texts(get_map, "Format"), options, "service")
    service = {
        "name": "WMS",
        "Version": version,
        "ServerUrl": linked(url, address.get("href", "")),
        "Layers": name,
        "Styles": options.style or "",
        "CRS" if version == "1.3.0" else "SRS": names[crs],
        "ImageFormat": format_,
        "Transparent": "FALSE" if format_ in ("image/jpeg", HEIGHTS_FORMAT) else "TRUE",
    }
    if version == "1.3.0" and not names[crs].startswith("CRS:") and north_first(crs):
        service["BBoxOrder"] = "yxYX"
    return service_source(spec, _any_box(crs, format_, options, frame), format_, service)


def wcs_cells(web: Web, spec: SourceSpec, area: Area) -> CellSource:
    """Heights of a coverage of WCS 1.0.0 (OGC 03-065r6) as cells of a fixed grid.

    `BBOX` holds the outer edges, x before y in every coordinate system. GDAL's driver of coverages
    of the OGC API fills in the address; its driver of WCS knows neither keys nor this cache. Raises
    `FetchError` with the available choices.
    """
    url, options = spec.url, spec.options
    query = {"SERVICE": "WCS", "VERSION": "1.0.0"}
    query |= {} if options.layer is None else {"COVERAGE": options.layer}
    root = web.get_xml(with_query(url, query | {"REQUEST": "DescribeCoverage"}))
    offerings = root.iterfind("CoverageOffering")
    layers = {name: each for each in offerings for name in texts(each, "name")[:1]}
    name = choose_layer(list(layers), options.layer, url)
    tags = ("supportedCRSs/nativeCRSs", "supportedCRSs/requestResponseCRSs")
    names = _crs_names([crs for tag in tags for crs in texts(layers[name], tag)])
    crs = choose(list(names), options.crs, f"coverage {name} does not come in")
    formats = " ".join(texts(layers[name], "supportedFormats/formats")).split()
    tiffs = [each for each in formats if "tif" in each.lower()]
    tiffs.sort(key=lambda each: "float32" not in each.lower())
    wanted = options.format or (tiffs or ["GeoTIFF"])[0]
    query |= {
        "REQUEST": "GetCoverage",
        "COVERAGE": name,
        "CRS": names[crs],
        "FORMAT": choose(tiffs, wanted, f"coverage {name} does not come as"),
        "BBOX": "{minx},{miny},{maxx},{maxy}",
        "WIDTH": "{width}",
        "HEIGHT": "{height}",
    }
    address = re.sub(r"\{(?!key\})", "${", with_query(url, query))
    service = {"name": "OGCAPICoverage", "ServerUrl": address}
    grid = _any_box(crs, HEIGHTS_FORMAT, options, area.frame)
    return service_source(spec, grid, HEIGHTS_FORMAT, service)


def _any_box(crs: str, format_: str, options: ImageryOptions, frame: LocalFrame) -> CellGrid:
    """The grid of a service that renders any box at any resolution.

    Services render several images of 1024 px per second. Heights come every 5 m where none is
    requested: half the posting of a map's terrain."""
    gsd_m, cell_px = options.wanted_gsd_m, options.tile_px or 1024
    if format_ == HEIGHTS_FORMAT and options.gsd_m is None:
        gsd_m = 5.0
    res_x, res_y = (gsd_m / scale for scale in ground_scale(crs, frame))
    return CellGrid(crs, 0.0, 0.0, res_x, res_y, cell_px, cell_px)


def _wms_layers(root: Element) -> dict[str, list[Element]]:
    """Each layer, by name, with the layers that it lies in."""
    found: dict[str, list[Element]] = {}
    stack = [[layer] for layer in root.findall("Capability/Layer")]
    while stack:
        chain = stack.pop()
        for name in texts(chain[0], "Name"):
            found[name] = chain
        stack += [[inner, *chain] for inner in reversed(chain[0].findall("Layer"))]
    return found


def _crs_names(options: list[str]) -> dict[str, str]:
    """The service's names of coordinate systems by EPSG:CODE."""
    crs: dict[str, str] = {}
    for option in (name for text in options for name in text.split()):
        with suppress(FetchError):
            epsg = epsg_name(option)
            crs[epsg] = option if option == epsg else crs.get(epsg, option)
    return crs
