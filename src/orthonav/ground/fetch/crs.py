"""Coordinate systems: names in documents, axis order, and scale on the ground."""

import math
import re
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pyproj

from orthonav.core.errors import FetchError
from orthonav.core.geo.frames import LocalFrame

MERCATOR_HALF_M = math.pi * 6378137.0
"""Half the width of the square of EPSG:3857, metres of that projection."""
METRES_PER_DEGREE = 6378137.0 * math.pi / 180
"""At the equator of WGS84, as scale denominators are defined (OGC 07-057r7, 6.1)."""


def mercator_resolution(zoom: int, tile_px: int) -> float:
    """Metres of EPSG:3857 per pixel of the usual web tiles."""
    return 2 * MERCATOR_HALF_M / tile_px / 2.0**zoom


def ground_scale(crs: str, frame: LocalFrame) -> tuple[float, float]:
    """Metres on the ground per unit of `crs`, along x and along y, at the centre of `frame`."""
    to_crs, to_degrees = transformers(crs)
    x, y = to_crs.transform(frame.lon_deg, frame.lat_deg)
    step = 1e-3 if _known(crs).is_geographic else 100.0
    if not (math.isfinite(x) and math.isfinite(y)):
        raise FetchError(f"area lies outside the coordinate system {crs}")
    lon, lat = to_degrees.transform([x - step, x + step, x, x], [y, y, y - step, y + step])
    points = frame.en_from_latlon(np.asarray(lat), np.asarray(lon))
    along_x = float(np.linalg.norm(points[1] - points[0])) / (2 * step)
    along_y = float(np.linalg.norm(points[3] - points[2])) / (2 * step)
    return along_x, along_y


@lru_cache(maxsize=16)
def _known(crs: str) -> pyproj.CRS:
    try:
        return pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.ProjError as error:
        raise FetchError(f"unknown coordinate system: {crs[:100]}") from error


@lru_cache(maxsize=16)
def transformers(crs: str) -> tuple[pyproj.Transformer, pyproj.Transformer]:
    """From longitude, latitude (WGS84) to x, y of `crs`, and back. Raises `FetchError`."""
    try:
        return (
            pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True),
            pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True),
        )
    except pyproj.exceptions.ProjError as error:
        raise FetchError(f"unknown coordinate system: {crs}") from error


def north_first(crs: str) -> bool:
    """Whether the authority of `crs` names the northing or latitude first."""
    axes = _known(crs).axis_info
    return bool(axes) and axes[0].direction.lower() == "north"


def epsg_name(crs: str) -> str:
    """A coordinate system as EPSG:CODE. Raises `FetchError` where it has no such code."""
    if crs.endswith(("CRS84", "CRS:84")):
        return "EPSG:4326"
    found = re.search(r"EPSG\b.*?[:/](\d{4,6})$", crs)
    code = int(found.group(1)) if found else _known(crs).to_epsg()
    if code in (900913, 3785, 102100, 102113):
        code = 3857
    if code is None:
        raise FetchError(f"unknown coordinate system: {crs[:100]}")
    return f"EPSG:{code}"


def swapped_corner(crs: str) -> Callable[[float], bool]:
    """Predicate on the first number of a corner: whether it is the northing or latitude."""
    if crs.endswith(("CRS84", "CRS:84")):
        return lambda first: False
    name = epsg_name(crs)
    if not north_first(name):
        return lambda first: False
    if _known(name).is_geographic:
        return lambda first: abs(first) <= 90  # some services put the longitude first nevertheless
    return lambda first: crs.startswith("urn:") or crs.startswith("http")


def metres_per_unit(crs: str) -> float:
    """Metres per unit of a coordinate system, for scale denominators (OGC 07-057r7, 6.1)."""
    known = _known(crs)
    if known.is_geographic:
        return METRES_PER_DEGREE
    return float(known.axis_info[0].unit_conversion_factor) if known.axis_info else 1.0
