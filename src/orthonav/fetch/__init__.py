"""Orthophotos of an area from open services: WMTS, WMS, XYZ and TMS tiles, STAC, COG.

This is the only part of orthonav that opens connections to servers of others, and only on request.
Names are imported when they are first used, so that the presets can be read without the extra
`fetch`. Nothing that flies imports this package.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from orthonav.fetch.options import ImageryOptions, Provenance
    from orthonav.fetch.politeness import RequestLimits
    from orthonav.fetch.run import CostEstimate, FetchRequest, FetchResult, estimate_fetch, fetch
    from orthonav.fetch.sources import SourceSpec, parse_source
    from orthonav.fetch.write import Packing

__all__ = [
    "CostEstimate",
    "FetchRequest",
    "FetchResult",
    "ImageryOptions",
    "Packing",
    "Provenance",
    "RequestLimits",
    "SourceSpec",
    "estimate_fetch",
    "fetch",
    "parse_source",
]
_MODULES = {
    "options": ("ImageryOptions", "Provenance"),
    "politeness": ("RequestLimits",),
    "run": ("CostEstimate", "FetchRequest", "FetchResult", "estimate_fetch", "fetch"),
    "sources": ("SourceSpec", "parse_source"),
    "write": ("Packing",),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__} has no attribute {name}")
