"""The tile grid of a sheet: positions and spacing of reference tiles of `tile_px` pixels.

Di Piazza et al. 2024, section Dataset; a position is the centre of a tile."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError, UsageError

MAX_TILE_PX = 4096


@dataclass(frozen=True)
class TileGrid:
    """Overlapping square tiles on the pixel raster of a sheet, north up.

    The raster's outer north-west corner lies at `west_m, north_m`; tile i, j starts at pixel row `i
    * stride_px`, column `j * stride_px`. Every point of the extent lies within half a stride of a
    tile centre, per axis."""

    west_m: float
    north_m: float
    gsd_m: float
    tile_px: int
    stride_px: int
    rows: int
    cols: int

    @classmethod
    def covering(
        cls,
        extent_en_m: tuple[float, float, float, float],
        *,
        gsd_m: float,
        tile_px: int,
        overlap: float,
    ) -> "TileGrid":
        """Over west, south, east, north (m); `overlap` of neighbours, 0.875 and 0.995 in Table 1.

        The stride is rounded to whole pixels. Raises `AreaError` or `UsageError`."""
        west, south, east, north = extent_en_m
        if not (np.isfinite(gsd_m) and gsd_m > 0):
            raise UsageError(f"gsd_m must be above 0 m per pixel, got {gsd_m}")
        if not 16 <= tile_px <= MAX_TILE_PX:
            raise UsageError(f"tiles must be 16 to {MAX_TILE_PX} px across, got {tile_px}")
        if not 0 <= overlap < 1:
            raise UsageError(f"overlap must be at least 0 and below 1, got {overlap}")
        if not (np.isfinite(extent_en_m).all() and east >= west and north >= south):
            raise AreaError(
                f"area is empty or not finite: west, south, east, north {extent_en_m} m"
            )
        stride_px = max(1, round(tile_px * (1 - overlap)))
        stride_m = stride_px * gsd_m
        cols = max(1, int(np.ceil((east - west) / stride_m - 1e-9)))
        rows = max(1, int(np.ceil((north - south) / stride_m - 1e-9)))
        half_m = tile_px * gsd_m / 2
        return cls(
            west_m=(west + east) / 2 - (cols - 1) * stride_m / 2 - half_m,
            north_m=(south + north) / 2 + (rows - 1) * stride_m / 2 + half_m,
            gsd_m=gsd_m,
            tile_px=tile_px,
            stride_px=stride_px,
            rows=rows,
            cols=cols,
        )

    @property
    def stride_m(self) -> float:
        return self.stride_px * self.gsd_m

    @property
    def tile_m(self) -> float:
        return self.tile_px * self.gsd_m

    @property
    def width_px(self) -> int:
        return (self.cols - 1) * self.stride_px + self.tile_px

    @property
    def height_px(self) -> int:
        return (self.rows - 1) * self.stride_px + self.tile_px

    @property
    def extent_en_m(self) -> tuple[float, float, float, float]:
        """West, south, east, north."""
        return (
            self.west_m,
            self.north_m - self.height_px * self.gsd_m,
            self.west_m + self.width_px * self.gsd_m,
            self.north_m,
        )

    def tiles_rc(self, centres_en_m: NDArray[np.floating[Any]]) -> NDArray[np.intp]:
        """Grid rows and columns (N, 2) of tile centres (N, 2)."""
        centres = np.asarray(centres_en_m, dtype=np.float64)
        half_m = self.tile_m / 2
        rows = (self.north_m - half_m - centres[:, 1]) / self.stride_m
        cols = (centres[:, 0] - self.west_m - half_m) / self.stride_m
        with np.errstate(invalid="ignore"):  # NaN becomes a row far outside
            return np.rint(np.stack([rows, cols], axis=1)).astype(np.intp)

    def centres_en_m(self, tiles_rc: NDArray[np.integer]) -> NDArray[np.float64]:
        """Centres (N, 2) of grid rows and columns (N, 2)."""
        tiles = np.asarray(tiles_rc, dtype=np.float64)
        half_m = self.tile_m / 2
        return np.stack(
            [
                self.west_m + tiles[:, 1] * self.stride_m + half_m,
                self.north_m - tiles[:, 0] * self.stride_m - half_m,
            ],
            axis=1,
        )
