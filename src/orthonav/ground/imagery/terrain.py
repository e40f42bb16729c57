"""A terrain model in a file that GDAL reads: heights above mean sea level by position."""

import functools
import logging
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import ImageryError
from orthonav.core.extras import missing_extra
from orthonav.core.files import require_file
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.ground import HIGHEST_M, LOWEST_M, bilinear_of, by_value
from orthonav.core.mapfile.manifest import UNKNOWN_DATUM

try:
    import pyproj
    import rasterio
    from pyproj.exceptions import ProjError
    from rasterio.crs import CRS
    from rasterio.enums import Resampling
    from rasterio.transform import Affine
    from rasterio.vrt import WarpedVRT
    from rasterio.windows import Window

    from orthonav.ground.imagery.source import (
        GDAL_ERRORS,
        ground_m,
        outline_of,
        quiet,
        system_beside,
        unreadable,
        unwarped,
    )
    from orthonav.ground.imagery.systems import accuracy_of
except ImportError as error:
    raise missing_extra("reading terrain", "geo", "rasterio", error) from error

Array = NDArray[np.float64]
DATUM_TAG = "ORTHONAV_VERTICAL_DATUM"
"""In files that `orthonav fetch` wrote."""
UNITS_M = {
    "m": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0,
    "ft": 0.3048, "foot": 0.3048, "feet": 0.3048, "international foot": 0.3048,
    "us-ft": 1200 / 3937, "us survey foot": 1200 / 3937, "ftus": 1200 / 3937,
}  # fmt: skip
GDAL_OPTIONS = {"GTIFF_REPORT_COMPD_CS": "YES", "GDAL_CACHEMAX": 64 * 2**20}
NAMED = {"egm96": "EPSG:5773", "egm2008": "EPSG:3855", "msl": "EPSG:5714"}
ELLIPSOID = "ellipsoid"
OPTION = f"--dem-datum {'|'.join((*NAMED, ELLIPSOID))}|EPSG:NUMBER"
GEOIDS = ("us_nga_egm08_25.tif", "egm08_25.gtx", "us_nga_egm96_15.tif", "egm96_15.gtx")
"""In the order of preference; the second names are those of older PROJ."""
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class VerticalDatum:
    """National systems count as mean sea level, from which they differ by up to two metres."""

    name: str
    above_ellipsoid: bool
    unit_m: float = 1.0

    @property
    def is_known(self) -> bool:
        return self.name != UNKNOWN_DATUM


def horizontal_and_vertical(
    crs: Any, given: str | None, path: Path
) -> tuple[pyproj.CRS, VerticalDatum]:
    """Of a file with the system `crs`; `given` counts where it states no vertical datum."""
    try:
        system = pyproj.CRS.from_wkt(crs.to_wkt())
        stated, horizontal = _stated(system)
        named = None if given is None else datum_of(given)
    except ProjError as error:
        raise ImageryError(f"coordinate system cannot be used ({error}): {path}") from error
    found = stated or named or VerticalDatum(UNKNOWN_DATUM, False)
    if named is not None and found.above_ellipsoid != named.above_ellipsoid:
        raise ImageryError(
            f"terrain file states heights as {found.name}, --dem-datum {given} contradicts it; "
            f"leave the option out: {path}"
        )
    return horizontal, found


def datum_of(text: str) -> VerticalDatum:
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
def geoid() -> Callable[[Array, Array], Array]:
    """Height of the geoid above the ellipsoid (m) by latitudes and longitudes (deg).

    From a grid of PROJ on this machine; nothing is downloaded.
    """
    for name in GEOIDS:
        with suppress(ProjError):
            found = pyproj.Transformer.from_pipeline(
                "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
                f"+step +proj=vgridshift +grids={name} +multiplier=1 "
                "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
            )
            return functools.partial(_undulation, found)
    raise ImageryError(
        "heights above the ellipsoid need a geoid, and PROJ has none of the grids "
        f"{', '.join(GEOIDS[::2])} in {pyproj.datadir.get_data_dir()}: install one (projsync "
        f"--file {GEOIDS[0]}, or Debian's proj-data with PROJ_DATA=/usr/share/proj), or use "
        "heights above the sea"
    )


def _undulation(transformer: pyproj.Transformer, lat_deg: Array, lon_deg: Array) -> Array:
    """NaN outside the grid."""
    lat, lon = np.asarray(lat_deg, np.float64), np.asarray(lon_deg, np.float64)
    shifted = transformer.transform(lon, lat, np.zeros_like(lat))[2]
    found = np.asarray(shifted, np.float64)
    return np.where(np.isfinite(found), found, np.nan)


@dataclass(frozen=True, eq=False)
class Dem:
    """Calling it gives heights above mean sea level, or above an unknown datum (`TerrainHeights`);
    for one thread."""

    path: Path
    datum: VerticalDatum
    gsd_m: float
    _data: Any = field(repr=False)
    _horizontal: pyproj.CRS = field(repr=False)

    @functools.cached_property
    def _system_from_world(self) -> pyproj.Transformer:
        return pyproj.Transformer.from_crs("EPSG:4326", self._horizontal, always_xy=True)

    def __call__(self, lat_deg: Array, lon_deg: Array) -> Array:
        """Bilinear; NaN for no data and outside the file."""
        lat, lon = np.asarray(lat_deg, np.float64), np.asarray(lon_deg, np.float64)
        col, row = self._pixels(lat.ravel(), lon.ravel())
        found = np.full(col.shape, np.nan)
        wide, high, side = self._data.width, self._data.height, 256
        inside = np.flatnonzero((col >= 0) & (col <= wide) & (row >= 0) & (row <= high))
        across = wide // side + 1
        blocks = row[inside] // side * across + col[inside] // side
        for block, some in by_value(blocks.astype(np.intp)):
            corner = block % across * side, block // across * side
            left, top = (max(0, at - 1) for at in corner)
            right, bottom = min(corner[0] + side + 1, wide), min(corner[1] + side + 1, high)
            heights = self._read(Window(left, top, right - left, bottom - top))
            here = inside[some]
            found[here] = bilinear_of(heights, col[here] - left - 0.5, row[here] - top - 0.5)
        return self._above_sea(found.reshape(lat.shape), lat, lon)

    def _read(self, window: Window) -> Array:
        try:
            return self._metres(self._data.read(1, window=window, masked=True))
        except GDAL_ERRORS as error:
            raise unreadable(self.path, error, "terrain file") from error

    def require_datum(self, why: str) -> None:
        """Raise `ImageryError` where heights do not count from the sea. `why`: what needs them."""
        if not self.datum.is_known:
            raise ImageryError(
                f"{why}, and the vertical datum of the terrain file is not known (not stated, or "
                "a geoid grid is missing); see its documentation and give "
                f"{OPTION}: {self.path}"
            )

    def covers(self, lat_deg: float, lon_deg: float) -> bool:
        return self.meets(np.array([lat_deg]), np.array([lon_deg]))

    def meets(self, lat_deg: Array, lon_deg: Array) -> bool:
        """Whether the box around positions may hold heights of the file."""
        col, row = self._pixels(np.asarray(lat_deg).ravel(), np.asarray(lon_deg).ravel())
        ends = ((col, self._data.width), (row, self._data.height))
        return all(
            bool(np.isfinite(at).all()) and at.max() >= -1 and at.min() <= side + 1
            for at, side in ends
        )

    def in_plane(
        self,
        frame: LocalFrame,
        west_m: float,
        north_m: float,
        posting_m: float,
        rows: int,
        cols: int,
    ) -> Array:
        """Mean heights (rows, cols) of squares of `posting_m` from a north-west corner; NaN for
        holes."""
        row, col = np.mgrid[:rows, :cols] + 0.5
        points = np.stack([west_m + col * posting_m, north_m - row * posting_m], axis=-1)
        lat, lon = frame.latlon_from_en(points)
        if self.gsd_m >= 0.75 * posting_m:
            return self(lat, lon)
        grid = {
            "crs": CRS.from_string(frame.proj4),
            "transform": Affine(posting_m, 0, west_m, 0, -posting_m, north_m),
            "width": cols,
            "height": rows,
        }
        mean = self._warped(Resampling.average, **grid)
        # The mean of heights and of a value that no ground can have may look like a height.
        for kind in (Resampling.min, Resampling.max):
            mean = np.where(np.isnan(self._warped(kind, **grid)), np.nan, mean)
        return self._above_sea(mean, lat, lon)

    def _warped(self, resampling: Resampling, **grid: Any) -> Array:
        try:
            with (
                quiet(),
                rasterio.Env(**GDAL_OPTIONS),
                WarpedVRT(
                    self._data,
                    src_crs=CRS.from_wkt(self._horizontal.to_wkt()),
                    nodata=math.nan,
                    dtype="float64",
                    resampling=resampling,
                    **grid,
                ) as warped,
            ):
                return self._metres(warped.read(1, masked=True))
        except MemoryError:
            raise
        except Exception as error:  # rasterio exports no class of the errors of GDAL it raises here
            raise unreadable(self.path, error, "terrain file") from error

    def _above_sea(self, heights: Array, lat_deg: Array, lon_deg: Array) -> Array:
        if self.datum.above_ellipsoid:
            heights = heights - geoid()(lat_deg, lon_deg)
        return heights

    def _metres(self, raw: Any) -> Array:
        """NaN where masked, or where no ground can be."""
        data = self._data
        heights = np.ma.filled(raw.astype(np.float64), np.nan)
        heights = (heights * data.scales[0] + data.offsets[0]) * self.datum.unit_m
        sound = (heights >= LOWEST_M) & (heights <= HIGHEST_M)
        return np.where(sound, heights, np.nan)

    def _pixels(self, lat_deg: Array, lon_deg: Array) -> tuple[Array, Array]:
        """Columns and rows from the outer corner of the first pixel; not finite where none."""
        x, y = self._system_from_world.transform(lon_deg, lat_deg)
        with np.errstate(invalid="ignore"):
            col, row = ~self._data.transform * (np.asarray(x), np.asarray(y))
        return col, row


def open_dem(path: Path, datum: str | None = None) -> Dem:
    """`datum`: what heights count from, where the file does not state it (`OPTION`)."""
    path = require_file(Path(path), "terrain file")
    try:
        with quiet(), rasterio.Env(**GDAL_OPTIONS):
            return _inspected(path, rasterio.open(path), datum)
    except GDAL_ERRORS as error:
        raise unreadable(path, error, "terrain file") from error


def _inspected(path: Path, data: Any, given: str | None) -> Dem:
    if reason := unwarped(path, data):
        raise ImageryError(f"terrain file {reason}: {path}")
    crs = data.crs or system_beside(path)
    if crs is None:
        raise ImageryError(f"terrain file has no coordinate reference system: {path}")
    if data.transform.is_identity or not abs(data.transform.determinant) > 0:  # NaN too
        raise ImageryError(f"terrain file has no georeference (geotransform): {path}")
    if data.count != 1 or data.dtypes[0] in ("uint8", "int8"):
        raise ImageryError(
            f"terrain file has {data.count} bands of {data.dtypes[0]}, which is a picture: one "
            f"band of heights is expected: {path}"
        )
    known = given or data.tags().get(DATUM_TAG)
    horizontal, vertical = horizontal_and_vertical(crs, known, path)
    if caution := accuracy_of(crs, outline_of(path, data, crs), path)[1]:
        log.warning("%s: %s", caution, path)
    unit = (data.units[0] or "").strip().lower()
    axes = pyproj.CRS.from_wkt(crs.to_wkt()).axis_info
    in_feet = horizontal.is_projected and axes[0].unit_conversion_factor != 1
    if in_feet and len(axes) < 3 and vertical.unit_m == 1:
        unit = unit or "no unit, and its coordinates in feet"
    if unit and unit not in UNITS_M:
        raise ImageryError(
            f"heights of the terrain file are in {unit:.60}: metres or feet are expected; state "
            f"the unit (gdal_edit.py -units m, or ft): {path}"
        )
    unit_m = UNITS_M.get(unit, vertical.unit_m)
    vertical = replace(vertical, unit_m=unit_m)
    _require_heights(path, data, vertical)
    if vertical.above_ellipsoid:
        try:
            geoid()
        except ImageryError as error:
            log.warning("%s; without it the vertical datum counts as unknown: %s", error, path)
            vertical = VerticalDatum(UNKNOWN_DATUM, False, unit_m)
    return Dem(path, vertical, ground_m(data, CRS.from_wkt(horizontal.to_wkt())), data, horizontal)


def _require_heights(path: Path, data: Any, datum: VerticalDatum) -> None:
    """Heights that ground can have, beside at most one value that stands for none."""
    shape = min(data.height, 512), min(data.width, 512)
    raw = data.read(1, out_shape=shape, masked=True, resampling=Resampling.nearest)
    values = np.unique(np.ma.compressed(raw).astype(np.float64))
    heights = (values[np.isfinite(values)] * data.scales[0] + data.offsets[0]) * datum.unit_m
    sound = (heights >= LOWEST_M) & (heights <= HIGHEST_M)
    if (~sound).sum() > 1:
        raise ImageryError(
            f"heights of the terrain file are {heights.min():.6g} to {heights.max():.6g} m: "
            f"{LOWEST_M:g} to {HIGHEST_M:g} m above the sea are expected; state its unit and its "
            f"value for no data (gdal_edit.py -units, -a_nodata): {path}"
        )
    if not sound.any():
        raise ImageryError(f"terrain file holds no height: {path}")
    ground = heights[sound & (heights != 0)]
    if (heights == 0).any() and ground.size and ground.min() > 20.0:  # m: no coast
        log.warning(
            "heights of 0 beside others from %.0f m on are taken as heights; if they are holes, "
            "say so (gdal_edit.py -a_nodata 0): %s",
            ground.min(),
            path,
        )
