"""Orthophotos of an area from open services: WMTS, WMS, XYZ and TMS tiles, STAC, COG.

This is the only part of orthonav that opens connections to servers of others, and only on request.
Start reading at `run`. All modules but `presets` and `urls` need the extra `fetch`. Nothing that
flies imports this package.
"""
