"""The grid of a service, cells of pixels in its own coordinate system, and the cells of an area."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError
from orthonav.ground.fetch.crs import ground_scale, transformers
from orthonav.ground.planning.area import Area

MAX_CANDIDATES = 40_000_000
"""Cells of the box around an area that are examined: some hundred megabytes at one row a time."""
_EDGE = np.linspace(0, 1, 21)
"""Points along an edge that are projected, as rasterio's `transform_bounds` does."""


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

    def corner(self, row: int, col: int) -> tuple[float, float]:
        """North-west corner x, y of a cell."""
        return (
            self.west + col * self.cell_w_px * self.res_x,
            self.north - row * self.cell_h_px * self.res_y,
        )

    def bounds(self, row: int, col: int) -> tuple[float, float, float, float]:
        """West, south, east, north of a cell."""
        west, north = self.corner(row, col)
        east, south = self.corner(row + 1, col + 1)
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
        """Height and width in pixels of the box around all cells."""
        rows, cols = (np.ptp(self.cells, axis=0) + 1).tolist()
        return int(rows) * self.grid.cell_h_px, int(cols) * self.grid.cell_w_px


def select(grid: CellGrid, area: Area, margin_m: float) -> Selection:
    """The cells that touch the area or lie within `margin_m` of it, and perhaps a few more.

    Raises `AreaError` where there is none, or where the box around the area has too many.
    """
    rows, cols = _candidates(grid, area, margin_m)
    if len(rows) * len(cols) > MAX_CANDIDATES:
        raise AreaError(
            f"area is {len(rows)} x {len(cols)} cells of this service, more than can be planned; "
            "ask for coarser pixels (--gsd-m) or a part of the area"
        )
    chosen = [part for row in rows if len(part := _row_cells(grid, area, margin_m, row, cols))]
    if not chosen:
        raise AreaError("area lies outside what the service covers")
    scale = ground_scale(grid.crs, area.frame)
    gsd_m = math.sqrt(scale[0] * grid.res_x * scale[1] * grid.res_y)
    return Selection(grid, np.concatenate(chosen), gsd_m)


def _row_cells(
    grid: CellGrid, area: Area, margin_m: float, row: int, cols: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Cells (N, 2) of one row: those whose circumscribed circle touches the area."""
    corners_x = grid.west + np.append(cols, cols[-1] + 1) * grid.cell_w_px * grid.res_x
    _, south, _, north = grid.bounds(row, 0)
    lon, lat = transformers(grid.crs)[1].transform(*np.meshgrid(corners_x, [north, south]))
    with np.errstate(invalid="ignore"):
        top, bottom = area.frame.en_from_latlon(np.asarray(lat), np.asarray(lon))
    centres = (top[:-1] + top[1:] + bottom[:-1] + bottom[1:]) / 4
    radius = np.maximum(
        np.linalg.norm(top[:-1] - bottom[1:], axis=1), np.linalg.norm(top[1:] - bottom[:-1], axis=1)
    )
    good = np.isfinite(centres).all(axis=1)
    half_m = float(radius[good].max()) / 2 if good.any() else 0.0
    inside = good & area.contains(np.nan_to_num(centres), margin_m + half_m)
    taken = cols[inside]
    return np.stack([np.full(len(taken), row), taken], axis=1).astype(np.int64)


def _candidates(grid: CellGrid, area: Area, margin_m: float) -> tuple[range, NDArray[np.int64]]:
    """Rows and columns of the box around the area."""
    west, south, east, north = area.extent_en_m
    u = (west - margin_m) + _EDGE * (east - west + 2 * margin_m)
    v = (south - margin_m) + _EDGE * (north - south + 2 * margin_m)
    points = np.stack([m.ravel() for m in np.meshgrid(u, v)], axis=1)
    lat, lon = area.frame.latlon_from_en(points)
    x, y = transformers(grid.crs)[0].transform(lon, lat)
    x, y = np.asarray(x), np.asarray(y)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise AreaError(f"area lies outside the coordinate system {grid.crs}")
    across, down = grid.cell_w_px * grid.res_x, grid.cell_h_px * grid.res_y
    col0, col1 = (math.floor((edge - grid.west) / across) for edge in (x.min(), x.max()))
    row0, row1 = (math.floor((grid.north - edge) / down) for edge in (y.max(), y.min()))
    if grid.limits is not None:
        row0, col0 = max(row0, grid.limits[0]), max(col0, grid.limits[1])
        row1, col1 = min(row1, grid.limits[2]), min(col1, grid.limits[3])
    if row1 < row0 or col1 < col0:
        raise AreaError("area lies outside what the service covers")
    return range(row0, row1 + 1), np.arange(col0, col1 + 1, dtype=np.int64)
