"""Selection of a WMTS layer's style, format, grid, zoom and time, and addresses of its tiles."""

import math
import re
from collections.abc import Callable
from dataclasses import replace

from orthonav.errors import FetchError
from orthonav.fetch.crs import ground_scale
from orthonav.fetch.options import ImageryOptions, Provenance, choose, finest_fitting, listed
from orthonav.fetch.service import TileSource
from orthonav.fetch.urls import quoted, with_query
from orthonav.fetch.wmts import TileMatrix, Wmts, WmtsLayer
from orthonav.geo.frames import LocalFrame

_FORMATS = ("image/jpeg", "image/webp", "image/png")


def wmts_tiles(
    service: Wmts, options: ImageryOptions, frame: LocalFrame, provenance: Provenance
) -> TileSource:
    """The tiles of the selected layer. Raises `FetchError` with the available choices."""
    layer = _layer(service, options.layer)
    format_ = _format(layer, options)
    preferred = options.preferred_style if options.preferred_style in layer.styles else None
    style = choose(
        list(layer.styles) or ["default"],
        options.style or preferred,
        f"layer {layer.name} has no style",
    )
    set_name, matrix = _matrix(service, layer, options, frame)
    dimensions = {name: _dimension(layer, name, options.time) for name in layer.dimensions}
    if options.time is not None and not any(name.lower() == "time" for name in dimensions):
        raise FetchError(f"layer {layer.name} has no time to choose, --time was {options.time}")
    names = {
        "layer": layer.name,
        "style": style,
        "tilematrixset": set_name,
        "tilematrix": matrix.name,
        **{name.lower(): value for name, value in dimensions.items()},
    }
    url_of = _url_of(service, layer, format_, names, dimensions)
    return TileSource(provenance, matrix.grid, url_of, format_, options.empty)


def _url_of(
    service: Wmts, layer: WmtsLayer, format_: str, names: dict[str, str], dimensions: dict[str, str]
) -> Callable[[int, int], str]:
    template = layer.templates.get(format_)
    if template is not None:
        filled = _filled(template, names)
        return lambda row, col: _filled(filled, {"tilerow": str(row), "tilecol": str(col)})
    if service.kvp_url is None:
        raise FetchError(f"service offers no tiles of {layer.name} as {format_}")
    fixed = with_query(
        service.kvp_url,
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


def _layer(service: Wmts, name: str | None) -> WmtsLayer:
    if name is None and len(service.layers) > 1:
        raise FetchError(
            f"choose one with --layer; available: {listed(list(service.layers), 'ortho')}"
        )
    return service.layers[choose(list(service.layers), name, "no layer")]


def _format(layer: WmtsLayer, options: ImageryOptions) -> str:
    known = [name for name in layer.formats if name.partition(";")[0] in _FORMATS]
    if options.format is not None:
        return choose(known, options.format, f"layer {layer.name} has no format")
    for name in (options.preferred_format, *_FORMATS):
        if name is not None and name in known:
            return name
    raise FetchError(
        f"layer {layer.name} comes as {listed(list(layer.formats))}; "
        "supported are JPEG, PNG and WebP"
    )


def _dimension(layer: WmtsLayer, name: str, time: str | None) -> str:
    values = layer.dimensions[name]
    if time is None or name.lower() != "time":
        return values[0]
    if any("/" in value for value in values):  # an interval: any time within it
        return time
    return choose(list(values), time, f"layer {layer.name} has no time")


def _matrix(
    service: Wmts, layer: WmtsLayer, options: ImageryOptions, frame: LocalFrame
) -> tuple[str, TileMatrix]:
    """Name of the matrix set, and the matrix with its limits."""
    links = {name: limits for name, limits in layer.links.items() if service.sets.get(name)}
    if not links:
        raise FetchError(f"layer {layer.name} has no grid that can be read")
    if options.matrix_set is not None:
        name = choose(list(links), options.matrix_set, f"layer {layer.name} has no grid")
    else:
        name = _set_of_crs(service, layer, list(links), options.crs)
    limits = links[name]
    matrices = [m for m in service.sets[name] if not limits or m.name in limits]
    if not limits:  # otherwise the service itself lists the zooms of the layer
        matrices = [m for m in matrices if not _beyond(m.name, options)]
    if not matrices:
        raise FetchError(f"layer {layer.name} has no zoom in its grid {name}")
    scale = ground_scale(matrices[0].grid.crs, frame)
    gsds_m = [math.sqrt(scale[0] * scale[1]) * m.grid.res_x for m in matrices]
    levels = ", ".join(f"{m.name} ({g:.3g} m)" for m, g in zip(matrices, gsds_m, strict=True))
    if options.zoom is not None:
        found = [m for m in matrices if _is_zoom(m.name, options.zoom)]
        if not found:
            raise FetchError(f"layer {layer.name} has no zoom {options.zoom}; available: {levels}")
        matrix = found[0]
    else:
        matrix = matrices[finest_fitting(gsds_m, options.wanted_gsd_m, f"zoom {levels}")]
    return name, _limited(matrix, limits.get(matrix.name))


def _is_zoom(name: str, zoom: str) -> bool:
    """Whether a matrix has that name or number: EPSG:3857:07 is zoom 7."""
    number = name.rpartition(":")[2]
    same_number = number.isdecimal() and zoom.isdecimal() and int(number) == int(zoom)
    return zoom in (name, number) or same_number


def _set_of_crs(service: Wmts, layer: WmtsLayer, names: list[str], crs: str | None) -> str:
    """The matrix set in the coordinate system requested, else in Web Mercator, else the first."""
    by_crs: dict[str, str] = {}
    for name in names:
        by_crs.setdefault(service.sets[name][0].grid.crs, name)
    if crs is None and "EPSG:3857" in by_crs:
        return by_crs["EPSG:3857"]
    return by_crs[choose(list(by_crs), crs, f"layer {layer.name} does not come in")]


def _beyond(name: str, options: ImageryOptions) -> bool:
    """Whether a zoom lies outside those that the preset names."""
    number = name.rpartition(":")[2]
    if not number.isdecimal():
        return False
    low, high = options.min_zoom, options.max_zoom
    return (low is not None and int(number) < low) or (high is not None and int(number) > high)


def _limited(matrix: TileMatrix, limits: tuple[int, int, int, int] | None) -> TileMatrix:
    """The matrix with the layer's limits of rows and columns, within its own."""
    own = matrix.grid.limits
    if limits is None or own is None:
        return matrix
    low = (max(own[0], limits[0]), max(own[1], limits[1]))
    both = (*low, min(own[2], limits[2]), min(own[3], limits[3]))
    return replace(matrix, grid=replace(matrix.grid, limits=both))
