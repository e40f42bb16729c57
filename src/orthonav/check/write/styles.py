"""How QGIS shows what a check wrote, as it keeps styles (QML), so that the files open readable.

Layers of the GeoPackage carry theirs in its table `layer_styles`, where QGIS looks for one to begin
with; the raster has a file of the same name beside it.
"""

import math
from xml.sax.saxutils import quoteattr

from orthonav.check.write.risk import ALL_RISKS, CIVIDIS, Risk, colour_at

_STEPS = 10
_HEAD = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"


def layer_styles() -> dict[str, str]:
    """QML by layer of the GeoPackage."""
    return {
        "cells": _cells(),
        "route": _route(),
        "blind": _single("line", _line("#1a1a1a", 2.2, 0.45)),
        "lookalikes": _single("line", _line("#b8558f", 0.6, 1.0, "dash")),
        "legs": _single("line", _line("#ffffff", 0.5, 1.0)),
        "waypoints": _single("marker", _marker("#ffffff", "#1a1a1a")),
    }


def raster_style() -> str:
    """QML of the raster: its first band, the probability, in cividis."""
    stops = len(CIVIDIS) - 1
    items = "".join(
        f'<item value="{i / stops:.6g}" label="{i / stops:.2f}" color="{colour}" alpha="255"/>'
        for i, colour in enumerate(CIVIDIS)
    )
    return (
        f'{_HEAD}<qgis version="3.28.0" styleCategories="Symbology"><pipe>'
        '<rasterrenderer type="singlebandpseudocolor" band="1" opacity="0.7" alphaBand="-1" '
        'classificationMin="0" classificationMax="1"><rastershader>'
        '<colorrampshader colorRampType="INTERPOLATED" classificationMode="1" clip="0" '
        f'minimumValue="0" maximumValue="1">{items}</colorrampshader></rastershader>'
        "</rasterrenderer></pipe></qgis>\n"
    )


def _cells() -> str:
    """Probability in ten steps of cividis; what is not known is not drawn."""
    ranges, symbols = [], []
    for i in range(_STEPS):
        low, high = i / _STEPS, (i + 1) / _STEPS
        ranges.append(_range(i, low, high, f"{low:.1f} to {high:.1f}"))
        symbols.append(_symbol("fill", i, _fill(colour_at((i + 0.5) / _STEPS)), 0.6))
    return _graduated("probability", ranges, symbols)


def _route() -> str:
    """The classes of risk of the page, from the least to the most probable."""
    known = [risk for risk in reversed(ALL_RISKS) if math.isfinite(risk.least)]
    highs = [*(risk.least for risk in known[1:]), 1.0]
    ranges = [
        _range(i, risk.least, high, f"{risk.name}: {risk.said}")
        for i, (risk, high) in enumerate(zip(known, highs, strict=True))
    ]
    symbols = [
        _symbol("line", i, _line(risk.colour, 0.3 * risk.width, 1.0, _dashed(risk)))
        for i, risk in enumerate(known)
    ]
    return _graduated("probability", ranges, symbols)


def _dashed(risk: Risk) -> str:
    return "dash" if risk.dash else "solid"


def _graduated(attribute: str, ranges: list[str], symbols: list[str]) -> str:
    return _qgis(
        f'<renderer-v2 type="graduatedSymbol" attr="{attribute}" graduatedMethod="GraduatedColor" '
        'symbollevels="0" enableorderby="0" forceraster="0">'
        f"<ranges>{''.join(ranges)}</ranges><symbols>{''.join(symbols)}</symbols></renderer-v2>"
    )


def _single(kind: str, layer: str) -> str:
    return _qgis(
        '<renderer-v2 type="singleSymbol" symbollevels="0" enableorderby="0" forceraster="0">'
        f"<symbols>{_symbol(kind, 0, layer)}</symbols></renderer-v2>"
    )


def _qgis(inside: str) -> str:
    return f'{_HEAD}<qgis version="3.28.0" styleCategories="Symbology">{inside}</qgis>\n'


def _range(number: int, low: float, high: float, label: str) -> str:
    return (
        f'<range lower="{low:.6f}" upper="{high:.6f}" symbol="{number}" '
        f'label={quoteattr(label)} render="true"/>'
    )


def _symbol(kind: str, number: int, layer: str, alpha: float = 1.0) -> str:
    return (
        f'<symbol type="{kind}" name="{number}" alpha="{alpha:g}" clip_to_extent="1" '
        f'force_rhr="0">{layer}</symbol>'
    )


def _fill(colour: str) -> str:
    return _layer("SimpleFill", color=_rgba(colour), style="solid", outline_style="no")


def _line(colour: str, width_mm: float, alpha: float, style: str = "solid") -> str:
    return _layer(
        "SimpleLine",
        line_color=_rgba(colour, alpha),
        line_width=f"{width_mm:g}",
        line_width_unit="MM",
        line_style=style,
        capstyle="round",
        joinstyle="round",
    )


def _marker(fill: str, outline: str) -> str:
    return _layer(
        "SimpleMarker",
        name="circle",
        color=_rgba(fill),
        outline_color=_rgba(outline),
        outline_width="0.4",
        size="2.6",
        size_unit="MM",
    )


def _layer(kind: str, **properties: str) -> str:
    """A layer of a symbol, in the words of QGIS from 3.20 on and in those before."""
    options = "".join(
        f'<Option type="QString" name="{name}" value="{value}"/>'
        for name, value in properties.items()
    )
    props = "".join(f'<prop k="{name}" v="{value}"/>' for name, value in properties.items())
    return (
        f'<layer class="{kind}" enabled="1" pass="0" locked="0">'
        f'<Option type="Map">{options}</Option>{props}</layer>'
    )


def _rgba(colour: str, alpha: float = 1.0) -> str:
    parts = [str(int(colour[k : k + 2], 16)) for k in (1, 3, 5)]
    return ",".join([*parts, str(round(255 * alpha))])
