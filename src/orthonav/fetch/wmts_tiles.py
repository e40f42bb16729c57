"""Choosing a layer of a WMTS, its style, format, grid, zoom and time; addresses of its tiles."""

import math
import re
from collections.abc import Callable
from dataclasses import replace

from orthonav.errors import FetchError
from orthonav.fetch.crs import ground_scale
from orthonav.fetch.service import About, TileSource, Wish, finest_fitting, listed
from orthonav.fetch.urls import quoted, with_query
from orthonav.fetch.wmts import TileMatrix, Wmts, WmtsLayer
from orthonav.geo.frames import LocalFrame

_FORMATS = ("image/jpeg", "image/webp", "image/png")


def wmts_tiles(service: Wmts, wish: Wish, frame: LocalFrame, about: About) -> TileSource:
    """The tiles of the layer that is wished. Raises `FetchError` listing what there is."""
    layer = _chosen_layer(service, wish.layer)
    format_ = _chosen_format(layer, wish)
    usual = wish.usual_style if wish.usual_style in layer.styles else None
    problem = f"layer {layer.name} has no style"
    style = _chosen(layer.styles, wish.style or usual, problem, "default")
    set_name, matrix = _chosen_matrix(service, layer, wish, frame)
    dimensions = {name: _dimension(layer, name, wish.time) for name in layer.dimensions}
    if wish.time is not None and not any(name.lower() == "time" for name in dimensions):
        raise FetchError(f"layer {layer.name} has no time to choose, --time was {wish.time}")
    names = {
        "layer": layer.name,
        "style": style,
        "tilematrixset": set_name,
        "tilematrix": matrix.name,
        **{name.lower(): value for name, value in dimensions.items()},
    }
    url_of = _url_of(service, layer, format_, names, dimensions)
    return TileSource(about, matrix.grid, url_of, format_, wish.empty)


def _url_of(
    service: Wmts, layer: WmtsLayer, format_: str, names: dict[str, str], dimensions: dict[str, str]
) -> Callable[[int, int], str]:
    template = layer.templates.get(format_)
    if template is not None:
        fixed = _filled(template, names)

        def by_template(row: int, col: int) -> str:
            return _filled(fixed, {"tilerow": str(row), "tilecol": str(col)})

        return by_template
    if service.kvp_url is None:
        raise FetchError(f"service tells no way to ask for tiles of {layer.name} as {format_}")
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

    def by_parameters(row: int, col: int) -> str:
        return f"{fixed}&TILEROW={row}&TILECOL={col}"

    return by_parameters


def _filled(template: str, values: dict[str, str]) -> str:
    """A template with the named parts, in any case, put in; others are left."""

    def put(found: re.Match[str]) -> str:
        value = values.get(found.group(1).lower())
        return found.group(0) if value is None else quoted(value)

    return re.sub(r"\{([^{}]+)\}", put, template)


def _chosen_layer(service: Wmts, name: str | None) -> WmtsLayer:
    if name in service.layers:
        return service.layers[name]
    if name is None and len(service.layers) == 1:
        return next(iter(service.layers.values()))
    asked = "name one with --layer" if name is None else f"no layer {name}"
    raise FetchError(f"{asked}; there is {listed(list(service.layers), name or 'ortho')}")


def _chosen_format(layer: WmtsLayer, wish: Wish) -> str:
    known = [name for name in layer.formats if name.partition(";")[0] in _FORMATS]
    if wish.format is not None:
        return _chosen(tuple(known), wish.format, f"layer {layer.name} has no format", "")
    for name in (wish.usual_format, *_FORMATS):
        if name is not None and name in known:
            return name
    raise FetchError(
        f"layer {layer.name} comes as {listed(list(layer.formats))}; JPEG, PNG or WebP are read"
    )


def _chosen(names: tuple[str, ...], wanted: str | None, problem: str, usual: str) -> str:
    if wanted is None:
        return names[0] if names else usual
    if wanted not in names:
        raise FetchError(f"{problem} {wanted}; there is {listed(list(names), wanted)}")
    return wanted


def _dimension(layer: WmtsLayer, name: str, time: str | None) -> str:
    values = layer.dimensions[name]
    if time is None or name.lower() != "time":
        return values[0]
    if time not in values and not any("/" in value for value in values):
        raise FetchError(
            f"layer {layer.name} has no time {time}; there is {listed(list(dict.fromkeys(values)))}"
        )
    return time


def _chosen_matrix(
    service: Wmts, layer: WmtsLayer, wish: Wish, frame: LocalFrame
) -> tuple[str, TileMatrix]:
    """Name of the matrix set, and the matrix with its limits."""
    known = {name: limits for name, limits in layer.links.items() if service.sets.get(name)}
    if not known:
        raise FetchError(f"layer {layer.name} has no grid that can be read")
    if wish.matrix_set is not None:
        name = _chosen(tuple(known), wish.matrix_set, f"layer {layer.name} has no grid", "")
    else:
        name = _set_of_crs(service, layer, tuple(known), wish.crs)
    limits = known[name]
    matrices = [m for m in service.sets[name] if not limits or m.name in limits]
    if not limits:  # else the service itself says which zooms there are
        matrices = [m for m in matrices if not _beyond(m.name, wish)]
    if not matrices:
        raise FetchError(f"layer {layer.name} has no zoom in its grid {name}")
    scale = ground_scale(matrices[0].grid.crs, frame)
    gsds_m = [math.sqrt(scale[0] * scale[1]) * m.grid.res_x for m in matrices]
    what = ", ".join(f"{m.name} ({g:.3g} m)" for m, g in zip(matrices, gsds_m, strict=True))
    if wish.zoom is not None:
        found = [m for m in matrices if _is_zoom(m.name, wish.zoom)]
        if not found:
            raise FetchError(f"layer {layer.name} has no zoom {wish.zoom}; there is {what}")
        matrix = found[0]
    else:
        matrix = matrices[finest_fitting(gsds_m, wish.ground_m, f"zoom {what}")]
    return name, _limited(matrix, limits.get(matrix.name))


def _is_zoom(name: str, zoom: str) -> bool:
    """Whether a matrix goes by that name, or by that number: EPSG:3857:07 is zoom 7."""
    number = name.rpartition(":")[2]
    same_number = number.isdecimal() and zoom.isdecimal() and int(number) == int(zoom)
    return zoom in (name, number) or same_number


def _set_of_crs(service: Wmts, layer: WmtsLayer, names: tuple[str, ...], crs: str | None) -> str:
    """The matrix set in the coordinate system that is wished, or in Web Mercator, or any."""
    by_crs: dict[str, str] = {}
    for name in names:
        by_crs.setdefault(service.sets[name][0].grid.crs, name)
    if crs is None:
        return by_crs.get("EPSG:3857", next(iter(by_crs.values())))
    if crs not in by_crs:
        raise FetchError(
            f"layer {layer.name} does not come in {crs}; there is {listed(list(by_crs))}"
        )
    return by_crs[crs]


def _beyond(name: str, wish: Wish) -> bool:
    """Whether a zoom is beyond what the preset knows to be there."""
    number = name.rpartition(":")[2]
    if not number.isdecimal():
        return False
    low = wish.min_zoom is not None and int(number) < wish.min_zoom
    return low or (wish.max_zoom is not None and int(number) > wish.max_zoom)


def _limited(matrix: TileMatrix, limits: tuple[int, int, int, int] | None) -> TileMatrix:
    if limits is None or matrix.grid.limits is None:
        return matrix
    whole = matrix.grid.limits
    both = (
        max(whole[0], limits[0]),
        max(whole[1], limits[1]),
        min(whole[2], limits[2]),
        min(whole[3], limits[3]),
    )
    return replace(matrix, grid=replace(matrix.grid, limits=both))
