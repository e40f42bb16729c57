"""Coordinate systems: how well PROJ converts them to WGS 84, and the plates some are fixed to.

NAD83, ETRS89 and GDA94 are read as WGS 84, from which they drift by some centimetres a year: 1 to
2 m by now. PROJ converts them to the ITRF of an epoch, with which WGS 84 agrees within some
centimetres.
"""

import functools
import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import pyproj
import rasterio
from numpy.typing import ArrayLike, NDArray
from pyproj.aoi import AreaOfInterest
from pyproj.transformer import TransformerGroup
from rasterio.crs import CRS
from rasterio.transform import Affine
from rasterio.warp import transform as transform_coordinates

from orthonav.core.errors import ImageryError, UsageError
from orthonav.core.geo.frames import WGS84_A_M, distances_m, wrapped_deg

if TYPE_CHECKING:
    from orthonav.ground.imagery.source import Source

FRAMES = (
    (r"NAD83(?!\((?:PA|MA)11)", "EPSG:6318"),
    (r"ETRS89|ETRF|RGF93|SWEREF99|EUREF|IGNF", "EPSG:4258"),
    (r"GDA94", "EPSG:4283"),
    (r"GDA2020", "EPSG:7844"),
)
"""Geographic systems for which PROJ knows the motion, by names of those that agree to decimetres.
"""


def converted(
    source: Any, target: Any, x: ArrayLike, y: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Coordinates in another system, by rasterio's PROJ; all NaN where it fails.

    In degrees the longitude comes first."""
    try:
        found = transform_coordinates(source, target, np.ravel(x), np.ravel(y))[:2]
    except Exception:  # rasterio exports no class of the errors of GDAL that it raises here
        return np.full(np.size(x), np.nan), np.full(np.size(x), np.nan)
    return np.asarray(found[0], np.float64), np.asarray(found[1], np.float64)


def unfit(path: Path) -> ImageryError:
    """The error of a raster whose coordinates PROJ cannot convert."""
    return ImageryError(
        "orthophoto does not fit its coordinate system; assign the correct one (for example: "
        f"gdal_edit.py -a_srs EPSG:2154 FILE): {path}"
    )


def accuracy_of(
    system: Any, outline_latlon_deg: NDArray[np.float64], path: Path
) -> tuple[float | None, str]:
    """How well rasterio places a raster by what PROJ states, in metres, and a caution, or nothing.

    None where PROJ states nothing, and for systems of plates, whose motion is known instead. Raises
    `ImageryError` for a system that PROJ would take as WGS 84 although it is another."""
    lat, lon = _middle_deg(outline_latlon_deg)
    accuracy_m, caution = _accuracy(system.to_wkt(), round(lat, 1), round(lon, 1))
    if accuracy_m == math.inf:
        raise ImageryError(f"{caution}: {path}")
    return accuracy_m, caution


def _middle_deg(outline_latlon_deg: NDArray[np.float64]) -> tuple[float, float]:
    """Mean latitude and longitude (-180..180) of points (N, 2), also across the antimeridian."""
    lat, lon = outline_latlon_deg.T
    off = wrapped_deg(lon - lon[0])
    return float(lat.mean()), wrapped_deg(float(lon[0] + off.mean()))


@functools.lru_cache(1024)
def _accuracy(wkt: str, lat_deg: float, lon_deg: float) -> tuple[float | None, str]:
    if _plate_frame(wkt) is not None:
        return None, ""
    system = pyproj.CRS.from_wkt(wkt).to_2d()
    # rasterio has a PROJ of its own, with other grids: which operation gives what it gives?
    x, y = converted("EPSG:4326", CRS.from_wkt(wkt), lon_deg, lat_deg)
    box: Any = AreaOfInterest(lon_deg - 0.1, lat_deg - 0.1, lon_deg + 0.1, lat_deg + 0.1)
    for area in (box, None):  # None: it uses some beyond their area of use
        group = TransformerGroup(system, "EPSG:4326", always_xy=True, area_of_interest=area)
        places = np.array([each.transform(x[0], y[0])[::-1] for each in group.transformers])
        off_m = np.nan_to_num(distances_m([lat_deg, lon_deg], places), nan=math.inf)
        if off_m.min() < 1:
            break
    used, named = group.transformers[int(off_m.argmin())], f"'{system.name:.60}'"
    stated = system.coordinate_operation
    zeros = stated is not None and not any(stated.towgs84 or [1])
    if "Ballpark" in used.description or zeros:
        shape = system.ellipsoid  # of GRS 80 too; a sphere has no flattening
        if shape and shape.semi_major_metre == WGS84_A_M and shape.inverse_flattening:
            return None, f"{named} is taken as WGS 84, from which it may differ by 1 to 2 m"
        zone = (32601 if lat_deg >= 0 else 32701) + int((lon_deg + 180) % 360 // 6)
        return math.inf, (
            f"PROJ cannot convert {named} to WGS 84, from which it may differ by 500 m"
            f"{_better(group, math.inf)}; warp it with the parameters of its survey (gdalwarp "
            f"-s_srs '+proj=.. +towgs84=..' -t_srs EPSG:{zone})"
        )
    if used.accuracy < 0:
        return None, f"the file states how to convert {named} to WGS 84, but not how accurately"
    accuracy_m = round(float(used.accuracy + off_m.min()), 1)
    if accuracy_m <= 2.0:
        return accuracy_m, ""
    said = f"{named} is converted to WGS 84 with an accuracy of {accuracy_m:g} m only"
    return accuracy_m, said + _better(group, accuracy_m)


def _better(group: TransformerGroup, accuracy_m: float) -> str:
    """How to install what the best operation lacks; empty where none would be more accurate."""
    folder = Path(rasterio.__file__).with_name("proj_data")  # of wheels
    target = f" --target-directory {folder}" if folder.is_dir() else ""
    for each in group.unavailable_operations:
        if each.grids and 0 <= each.accuracy < accuracy_m:
            calls = [f"pyproj sync --file {grid.short_name}{target}" for grid in each.grids]
            return f"; install the grid of {each.accuracy:g} m: {' && '.join(calls)}"
    return ""


def plate_shift_deg(
    crs: str, lat_deg: float, lon_deg: float, year: float
) -> tuple[float, float] | None:
    """What latitude and longitude in a system lack to WGS 84 at an epoch; None if unknown."""
    frame = _plate_frame(crs)
    if frame is None:
        return None
    to_itrf = pyproj.Transformer.from_crs(pyproj.CRS(frame).to_3d(), "EPSG:7912", always_xy=True)
    as_read = pyproj.Transformer.from_crs(frame, "EPSG:4326", always_xy=True)
    lon, lat, *_ = to_itrf.transform(lon_deg, lat_deg, 0.0, year)
    read_lon, read_lat = as_read.transform(lon_deg, lat_deg)
    return float(lat - read_lat), float(lon - read_lon)


def plate_shift_m(crs: str, lat_deg: float, lon_deg: float, year: float) -> float:
    north, east = plate_shift_deg(crs, lat_deg, lon_deg, year) or (0.0, 0.0)
    return float(distances_m([lat_deg, lon_deg], [lat_deg + north, lon_deg + east])[0])


def at_epoch(sources: "Sequence[Source]", year: float) -> "list[Source]":
    """The sources, those of one system moved by one distance to where WGS 84 has them."""
    if not 1980 <= year <= 2100:
        raise UsageError(f"epoch must be a year from 1980 to 2100, got {year}")
    lat, lon = _middle_deg(np.concatenate([each.outline_latlon_deg for each in sources]))
    shifts = {each.crs: plate_shift_deg(each.crs, lat, lon, year) for each in sources}
    if not any(shifts.values()):
        raise ImageryError(
            f"an epoch is of use for NAD83, ETRS89, GDA94 and GDA2020, not for {sources[0].crs:.60}"
        )
    return [_moved(each, shift, lat, lon, year) if (shift := shifts[each.crs]) else each
            for each in sources]  # fmt: skip


def _moved(
    source: "Source", shift_deg: tuple[float, float], lat_deg: float, lon_deg: float, year: float
) -> "Source":
    lon, lat = [lon_deg, lon_deg + shift_deg[1]], [lat_deg, lat_deg + shift_deg[0]]
    x, y = converted("EPSG:4326", source.system, lon, lat)
    if not np.isfinite([x, y]).all():
        raise unfit(source.path)
    return replace(
        source,
        transform=Affine.translation(x[1] - x[0], y[1] - y[0]) * source.transform,
        outline_latlon_deg=source.outline_latlon_deg + np.array(shift_deg),
        stamp=(*source.stamp, (f"epoch {year!r}", 0, 0)),
        terms=MappingProxyType({**source.terms, "epoch": f"{year:g}"}),
    )


def _plate_frame(crs: str) -> str | None:
    """The geographic system of the plate that a system is fixed to, by its name as far as it can be
    read."""
    with suppress(pyproj.exceptions.CRSError):  # a WKT that was cut
        system = pyproj.CRS.from_user_input(crs)
        crs = (system.geodetic_crs or system).name
    return next((code for pattern, code in FRAMES if re.search(pattern, crs)), None)
