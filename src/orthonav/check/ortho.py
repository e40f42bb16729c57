"""An orthophoto of a second date as a grey pyramid in the plane of the checked map."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import AreaError
from orthonav.imagery.mosaic import Mosaic
from orthonav.imagery.raster import SheetRaster
from orthonav.mapfile.layer import level_shape
from orthonav.mapfile.manifest import SheetInfo


class OrthoPyramid:
    """Grey levels of an orthophoto in the plane and at the resolutions of a map's sheet.

    Files stay open until `close`. Not safe to share between threads.
    """

    def __init__(self, path: Path, sheet: SheetInfo, levels: int) -> None:
        """Open the file; raises `ImageryError` where it is not an orthophoto."""
        self.levels = levels
        self._sheet, self._mosaic = sheet, Mosaic.open([path])
        self._opened: dict[int, SheetRaster] = {}
        self._stack = ExitStack()

    def close(self) -> None:
        """Close the files."""
        self._stack.close()
        self._opened.clear()

    def shape(self, level: int) -> tuple[int, int]:
        """Rows and columns of a level: those of the map."""
        return level_shape(self._sheet.grid.height_px, self._sheet.grid.width_px, level)

    def read(
        self, level: int, row: int, col: int, height: int, width: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Grey and valid (height, width) of a window, which may reach beyond the sheet."""
        pixels = self._raster(level).read_grey(col, row, width, height)
        return pixels.grey, pixels.valid

    def _raster(self, level: int) -> SheetRaster:
        if level not in self._opened:
            grid = self._sheet.grid
            rows, cols = self.shape(level)
            raster = self._mosaic.sheet(
                self._sheet.frame,
                west_m=grid.west_m,
                north_m=grid.north_m,
                width_px=cols,
                height_px=rows,
                gsd_m=grid.gsd_m * 2**level,
                threads=1,  # trials run in several processes
            )
            self._opened[level] = self._stack.enter_context(raster)
        return self._opened[level]


def require_overlap(path: Path, sheet: SheetInfo) -> None:
    """Raise `AreaError` where an orthophoto does not overlap a sheet."""
    lat_lon = Mosaic.open([path]).outline_latlon_deg
    points = sheet.frame.en_from_latlon(lat_lon[:, 0], lat_lon[:, 1])
    grid = sheet.grid
    east_m = grid.west_m + grid.width_px * grid.gsd_m
    south_m = grid.north_m - grid.height_px * grid.gsd_m
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    if east < grid.west_m or west > east_m or north < south_m or south > grid.north_m:
        raise AreaError(f"the orthophoto of the other date does not overlap the map: {path}")
