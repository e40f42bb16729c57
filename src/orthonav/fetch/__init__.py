"""Fetching orthophotos of an area from open services: WMTS, WMS, XYZ and TMS tiles, STAC, COG.

The only part of orthonav that opens connections to services of others, and only when asked to.
Imports requests, Pillow, pyproj and GDAL; nothing that flies imports it.
"""

from orthonav.fetch.politeness import Limits
from orthonav.fetch.run import Estimate, FetchRequest, FetchResult, estimate_fetch, fetch
from orthonav.fetch.service import About, Wish
from orthonav.fetch.sources import SourceSpec, parse_source
from orthonav.fetch.write import Packing

__all__ = [
    "About",
    "Estimate",
    "FetchRequest",
    "FetchResult",
    "Limits",
    "Packing",
    "SourceSpec",
    "Wish",
    "estimate_fetch",
    "fetch",
    "parse_source",
]
