"""Maps in systems that are fixed to a tectonic plate, as NAD83, ETRS89 and GDA94 are.

They are read as WGS 84, from which they drift by some centimetres a year: 1 to 2 m by now. PROJ
converts them to the ITRF of an epoch, with which WGS 84 agrees within some centimetres.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from orthonav.core.errors import ImageryError
from orthonav.core.extras import missing_extra
from orthonav.ground.imagery.source import Source

try:
    import pyproj
    from rasterio.transform import Affine
except ImportError as error:
    raise missing_extra("systems of plates", "geo", "pyproj", error) from error

_FRAMES = (
    (r"NAD83(?!\((?:PA|MA)11)", "EPSG:6318"),
    (r"ETRS89|ETRF|RGF93|SWEREF99|EUREF|IGNF", "EPSG:4258"),
    (r"GDA94", "EPSG:4283"),
    (r"GDA2020", "EPSG:7844"),
)
"""Geographic systems for which PROJ knows the motion, by names of those that agree to decimetres.
"""


def plate_shift_deg(
    crs: str, lat_deg: float, lon_deg: float, year: float
) -> tuple[float, float] | None:
    """What latitude and longitude in a system lack to WGS 84 at an epoch; None if unknown."""
    name = _name(crs)
    frame = next((code for pattern, code in _FRAMES if re.search(pattern, name)), None)
    if frame is None:
        return None
    to_itrf = pyproj.Transformer.from_crs(pyproj.CRS(frame).to_3d(), "EPSG:7912", always_xy=True)
    as_read = pyproj.Transformer.from_crs(frame, "EPSG:4326", always_xy=True)
    lon, lat, *_ = to_itrf.transform(lon_deg, lat_deg, 0.0, year)
    read_lon, read_lat = as_read.transform(lon_deg, lat_deg)
    return float(lat - read_lat), float(lon - read_lon)


def plate_shift_m(crs: str, lat_deg: float, lon_deg: float, year: float) -> float:
    shift = plate_shift_deg(crs, lat_deg, lon_deg, year)
    if shift is None:
        return 0.0
    east = shift[1] * np.cos(np.radians(lat_deg))
    return float(np.hypot(shift[0], east)) * 111_320.0


def at_epoch(sources: Sequence[Source], year: float) -> list[Source]:
    """The sources, those of one system moved by one distance to where WGS 84 has them."""
    if not 1980 <= year <= 2100:
        raise ImageryError(f"epoch must be a year from 1980 to 2100, got {year}")
    lat, lon = np.concatenate([each.outline_latlon_deg for each in sources]).mean(axis=0).tolist()
    shifts = {each.crs: plate_shift_deg(each.crs, lat, lon, year) for each in sources}
    if not any(shifts.values()):
        raise ImageryError(
            f"an epoch is of use for NAD83, ETRS89, GDA94 and GDA2020, not for {sources[0].crs:.60}"
        )
    return [_moved(each, shift, lat, lon, year) if (shift := shifts[each.crs]) else each
            for each in sources]  # fmt: skip


def _moved(
    source: Source, shift_deg: tuple[float, float], lat_deg: float, lon_deg: float, year: float
) -> Source:
    to_system = pyproj.Transformer.from_crs(
        "EPSG:4326", pyproj.CRS.from_wkt(source.system.to_wkt()), always_xy=True
    )
    x, y = to_system.transform([lon_deg, lon_deg + shift_deg[1]], [lat_deg, lat_deg + shift_deg[0]])
    return replace(
        source,
        transform=Affine.translation(x[1] - x[0], y[1] - y[0]) * source.transform,
        outline_latlon_deg=source.outline_latlon_deg + np.array(shift_deg),
        stamp=(*source.stamp, (f"epoch {year!r}", 0, 0)),
        terms=MappingProxyType({**source.terms, "epoch": f"{year:g}"}),
    )


def _name(crs: str) -> str:
    """That of its geographic system too, as far as it can be read."""
    try:
        system = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError:  # a WKT that was cut
        return crs
    geodetic = system.geodetic_crs
    return system.name if geodetic is None else geodetic.name
