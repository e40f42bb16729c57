"""The grid of a service, cells of pixels in its own coordinate system, and the cells of an area."""

import logging
import math
import re
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pyproj
from numpy.typing import NDArray
from rasterio.transform import Affine, array_bounds
from rasterio.warp import transform_bounds

from orthonav.core.errors import AreaError, FetchError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.planning.area import Area

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CellGrid:
    """Cells of `cell_w_px` x `cell_h_px` pixels in `crs`, rows downwards, columns to the right.

    The outer north-west corner of cell (0, 0) lies at `west, north`; a pixel is `res_x` wide and
    `res_y` high, in units of the coordinate system, x eastwards and y northwards whatever its
    axis order. Cells outside `limits` (first row, first column, last row, last column) do not
    exist.
    """

    crs: str
    west: float
    north: float
    res_x: float
    res_y: float
    cell_w_px: int
    cell_h_px: int
    limits: tuple[int, int, int, int] | None = None

    def transform(self, row: int, col: int) -> Affine:
        """From column and row of a pixel, counted from a cell's corner, to coordinates."""
        west = self.west + col * self.cell_w_px * self.res_x
        north = self.north - row * self.cell_h_px * self.res_y
        return Affine(self.res_x, 0, west, 0, -self.res_y, north)

    def bounds(self, row: int, col: int) -> tuple[float, float, float, float]:
        west, south, east, north = array_bounds(
            self.cell_h_px, self.cell_w_px, self.transform(row, col)
        )
        return west, south, east, north


@dataclass(frozen=True, eq=False)
class Selection:
    """The cells of `grid` that cover an area: `cells` (N, 2) rows and columns, by row; `gsd_m`."""

    grid: CellGrid
    cells: NDArray[np.int64]
    gsd_m: float

    @property
    def first(self) -> tuple[int, int]:
        """Row and column of the north-west cell of the box around all."""
        row, col = self.cells.min(axis=0).tolist()
        return int(row), int(col)

    @property
    def shape_px(self) -> tuple[int, int]:
        rows, cols = (np.ptp(self.cells, axis=0) + 1).tolist()
        return int(rows) * self.grid.cell_h_px, int(cols) * self.grid.cell_w_px


def select(grid: CellGrid, area: Area, margin_m: float) -> Selection:
    """The cells that touch the area or lie within `margin_m` of it, and perhaps a few more.

    Raises `AreaError` where there is none, or where the box around the area has too many.
    """
    row0, col0, row1, col1 = wanted = _box(grid, area, margin_m)
    if grid.limits is not None:
        row0, col0 = max(row0, grid.limits[0]), max(col0, grid.limits[1])
        row1, col1 = min(row1, grid.limits[2]), min(col1, grid.limits[3])
    rows, cols = range(row0, row1 + 1), np.arange(col0, col1 + 1, dtype=np.int64)
    if len(rows) * len(cols) > 40_000_000:  # some hundred megabytes at one row a time
        raise AreaError(
            f"area is {len(rows)} x {len(cols)} cells of this service, more than can be planned; "
            "ask for coarser pixels (--gsd-m) or a part of the area"
        )
    scale = ground_scale(grid.crs, area.frame)
    across, down = grid.cell_w_px * grid.res_x, grid.cell_h_px * grid.res_y
    half_m = 1.02 * math.hypot(across * scale[0], down * scale[1]) / 2  # scale changes across it
    x = grid.west + (cols + 0.5) * across
    chosen = []
    for row in rows:
        y = np.full(len(x), grid.north - (row + 0.5) * down)
        lon, lat = transformers(grid.crs)[1].transform(x, y)
        centres = area.frame.en_from_latlon(np.asarray(lat), np.asarray(lon))
        taken = cols[area.contains(centres, margin_m + half_m)]
        chosen.append(np.stack([np.full(len(taken), row), taken], axis=1))
    cells = np.concatenate(chosen or [np.zeros((0, 2), dtype=np.int64)])
    if not len(cells):
        raise AreaError("area lies outside what the service covers")
    if wanted != (row0, col0, row1, col1):
        log.warning("part of the area lies outside what the service covers")
    return Selection(grid, cells, math.sqrt(scale[0] * grid.res_x * scale[1] * grid.res_y))


def _box(grid: CellGrid, area: Area, margin_m: float) -> tuple[int, int, int, int]:
    west, south, east, north = area.extent_en_m
    wide = west - margin_m, south - margin_m, east + margin_m, north + margin_m
    box = transform_bounds(area.frame.proj4, grid.crs, *wide)
    if not all(map(math.isfinite, box)):
        raise AreaError(f"area lies outside the coordinate system {grid.crs}")
    across, down = grid.cell_w_px * grid.res_x, grid.cell_h_px * grid.res_y
    col0, col1 = (math.floor((edge - grid.west) / across) for edge in box[::2])
    row0, row1 = (math.floor((grid.north - edge) / down) for edge in box[:0:-2])
    return row0, col0, row1, col1


def ground_scale(crs: str, frame: LocalFrame) -> tuple[float, float]:
    """Metres on the ground per unit of `crs`, along x and along y, at the centre of `frame`."""
    to_crs, to_degrees = transformers(crs)
    x, y = to_crs.transform(frame.lon_deg, frame.lat_deg)
    step = 1e-3 if known_crs(crs).is_geographic else 100.0
    if not (math.isfinite(x) and math.isfinite(y)):
        raise FetchError(f"area lies outside the coordinate system {crs}")
    lon, lat = to_degrees.transform([x - step, x + step, x, x], [y, y, y - step, y + step])
    points = frame.en_from_latlon(np.asarray(lat), np.asarray(lon))
    along_x = float(np.linalg.norm(points[1] - points[0])) / (2 * step)
    along_y = float(np.linalg.norm(points[3] - points[2])) / (2 * step)
    return along_x, along_y


def mean_scale(crs: str, frame: LocalFrame) -> float:
    """The geometric mean of `ground_scale`."""
    return math.sqrt(math.prod(ground_scale(crs, frame)))


@lru_cache(maxsize=16)
def known_crs(crs: str) -> pyproj.CRS:
    """A coordinate system by name. Raises `FetchError`."""
    try:
        return pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.ProjError as error:
        raise FetchError(f"unknown coordinate system: {crs[:100]}") from error


@lru_cache(maxsize=16)
def transformers(crs: str) -> tuple[pyproj.Transformer, pyproj.Transformer]:
    """From longitude, latitude (WGS84) to x, y of `crs`, and back. Raises `FetchError`."""
    known = known_crs(crs)
    return (
        pyproj.Transformer.from_crs("EPSG:4326", known, always_xy=True),
        pyproj.Transformer.from_crs(known, "EPSG:4326", always_xy=True),
    )


def north_first(crs: str) -> bool:
    """Whether the authority of `crs` names the northing or latitude first."""
    axes = known_crs(crs).axis_info
    return bool(axes) and axes[0].direction.lower() == "north"


def epsg_name(crs: str) -> str:
    """A coordinate system as EPSG:CODE. Raises `FetchError` where it has no such code."""
    if crs.endswith(("CRS84", "CRS:84")):
        return "EPSG:4326"
    found = re.search(r"EPSG\b.*?[:/](\d{4,6})$", crs[-200:])
    code = int(found.group(1)) if found else known_crs(crs).to_epsg()
    if code in (900913, 3785, 102100, 102113):
        code = 3857
    if code is None:
        raise FetchError(f"unknown coordinate system: {crs[:100]}")
    return f"EPSG:{code}"
