"""The vertical reference of a terrain file, and the geoid between the ellipsoid and the sea."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import ImageryError
from orthonav.core.extras import missing_extra

try:
    import pyproj
    from pyproj.exceptions import ProjError
except ImportError as error:
    raise missing_extra("heights of terrain", "geo", "pyproj", error) from error

Array = NDArray[np.float64]
Undulation = Callable[[Array, Array], Array]
"""Function of latitudes and longitudes (deg): height of the geoid above the ellipsoid (m)."""
NAMED = {"egm96": "EPSG:5773", "egm2008": "EPSG:3855", "msl": "EPSG:5714"}
"""Vertical systems with short names; `ellipsoid` is the ellipsoid of WGS 84."""
ELLIPSOID = "ellipsoid"
OPTION = f"--dem-datum {'|'.join((*NAMED, ELLIPSOID))}|EPSG:NUMBER"
GEOIDS = ("us_nga_egm08_25.tif", "egm08_25.gtx", "us_nga_egm96_15.tif", "egm96_15.gtx")
"""Grids of the geoid, in the order of preference; the second names are those of older PROJ."""
_DEGREES = "+proj=unitconvert +xy_in=deg +xy_out=rad"
_RADIANS = "+proj=unitconvert +xy_in=rad +xy_out=deg"


@dataclass(frozen=True)
class VerticalDatum:
    """What heights count from.

    `name`: for people. `above_ellipsoid`: whether they are above the ellipsoid; all others are
    taken as above mean sea level, from which national systems differ by up to two metres.
    `unit_m`: metres of one unit.
    """

    name: str
    above_ellipsoid: bool
    unit_m: float = 1.0


def horizontal_and_vertical(
    crs: Any, given: str | None, path: Path
) -> tuple[pyproj.CRS, VerticalDatum]:
    """The horizontal system of a terrain file, and its vertical datum.

    `crs`: system of the file, of rasterio. `given`: the datum that the user names, see `OPTION`;
    needed where the file states none. Raises `ImageryError`.
    """
    try:
        system = pyproj.CRS.from_wkt(crs.to_wkt())
        stated, horizontal = _stated(system)
        named = None if given is None else datum_of(given)
    except ProjError as error:
        raise ImageryError(f"coordinate system cannot be used ({error}): {path}") from error
    found = stated or named
    if found is None:
        raise ImageryError(
            "terrain file does not state its vertical datum; see its documentation and "
            f"give {OPTION}: {path}"
        )
    if named is not None and found.above_ellipsoid != named.above_ellipsoid:
        raise ImageryError(
            f"terrain file states heights as {found.name}, --dem-datum {given} contradicts it; "
            f"leave the option out: {path}"
        )
    return horizontal, found


def datum_of(text: str) -> VerticalDatum:
    """The datum of a name of `OPTION`. Raises `ImageryError` for others."""
    if text.lower() == ELLIPSOID:
        return VerticalDatum("above the ellipsoid of WGS 84", True)
    try:
        system = pyproj.CRS.from_user_input(NAMED.get(text.lower(), text))
    except ProjError:
        system = None
    if system is None or not system.is_vertical or system.is_compound:
        raise ImageryError(f"unknown vertical datum '{text:.40}'; give {OPTION}")
    return _vertical(system)


def _stated(system: pyproj.CRS) -> tuple[VerticalDatum | None, pyproj.CRS]:
    """The datum that a system states, None without one, and the horizontal system."""
    if system.is_bound and system.source_crs is not None:
        system = system.source_crs
    if system.is_compound:
        horizontal, vertical = system.sub_crs_list[0], system.sub_crs_list[-1]
        return _vertical(vertical), horizontal
    if len(system.axis_info) == 3:
        unit_m = float(system.axis_info[2].unit_conversion_factor)
        return VerticalDatum(f"{system.name}, ellipsoidal", True, unit_m), system.to_2d()
    return None, system


def _vertical(system: pyproj.CRS) -> VerticalDatum:
    axis = system.axis_info[0]
    if axis.direction != "up":
        raise ImageryError(
            f"heights in '{system.name:.60}' count {axis.direction}: a terrain model with heights "
            "that count up is needed"
        )
    return VerticalDatum(system.name, False, float(axis.unit_conversion_factor))


@functools.cache
def geoid() -> Undulation:
    """The geoid, from a grid of PROJ on this machine; nothing is downloaded.

    Raises `ImageryError`, which names the grids and where to get them, if there is none.
    """
    for name in GEOIDS:
        try:
            found = pyproj.Transformer.from_pipeline(
                f"+proj=pipeline +step {_DEGREES} +step +proj=vgridshift +grids={name} "
                f"+multiplier=1 +step {_RADIANS}"
            )
        except ProjError:
            continue
        return functools.partial(_undulation, found)
    raise ImageryError(
        "heights above the ellipsoid need a geoid, and PROJ has none of the grids "
        f"{', '.join(GEOIDS[::2])} in {pyproj.datadir.get_data_dir()}: install one (projsync "
        f"--file {GEOIDS[0]}, or Debian's proj-data with PROJ_DATA=/usr/share/proj), or use "
        "heights above the sea"
    )


def _undulation(transformer: pyproj.Transformer, lat_deg: Array, lon_deg: Array) -> Array:
    """Height of the geoid above the ellipsoid; NaN outside the grid."""
    lat, lon = np.asarray(lat_deg, np.float64), np.asarray(lon_deg, np.float64)
    shifted = transformer.transform(lon, lat, np.zeros_like(lat))[2]
    found = np.asarray(shifted, np.float64)
    return np.where(np.isfinite(found), found, np.nan)
