"""Square cells that a check predicts for."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.frames import LocalFrame

_CORNERS = np.array([(0, 0), (0, 1), (1, 1), (1, 0), (0, 0)])

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CellGrid:
    """Square cells of `side_m` from a north-west corner, row 0 in the north."""

    west_m: float
    north_m: float
    side_m: float
    rows: int
    cols: int

    @classmethod
    def over(cls, extent: tuple[float, float, float, float], side_m: float) -> "CellGrid":
        west, south, east, north = extent
        rows, cols = (max(1, math.ceil(d / side_m - 1e-9)) for d in (north - south, east - west))
        return cls(west, north, side_m, rows, cols)

    @property
    def centres_en_m(self) -> Array:
        """Centres (rows * cols, 2) of the cells, row by row."""
        east = self.west_m + (np.arange(self.cols) + 0.5) * self.side_m
        north = self.north_m - (np.arange(self.rows) + 0.5) * self.side_m
        return np.stack(np.meshgrid(east, north), axis=-1).reshape(-1, 2)

    def drawn(self, rng: np.random.Generator) -> Array:
        off = rng.uniform(-0.5, 0.5, (self.rows * self.cols, 2)) * self.side_m
        return np.asarray(self.centres_en_m + off)

    def numbers(self, points_en_m: Array, margin: int = 0) -> NDArray[np.intp]:
        """Number (...) of the cell, row by row, under each of points (..., 2); -1 outside.

        `margin` cells are added and counted on each side.
        """
        cols = np.floor((points_en_m[..., 0] - self.west_m) / self.side_m).astype(np.intp) + margin
        rows = np.floor((self.north_m - points_en_m[..., 1]) / self.side_m).astype(np.intp) + margin
        height, width = self.rows + 2 * margin, self.cols + 2 * margin
        inside = (rows >= 0) & (cols >= 0) & (rows < height) & (cols < width)
        return np.where(inside, rows * width + cols, -1)

    def counts(self, points_en_m: Array) -> NDArray[np.int32]:
        found = np.bincount(self.numbers(points_en_m) + 1, minlength=self.rows * self.cols + 1)
        return found[1:].astype(np.int32).reshape(self.rows, self.cols)

    def ring_en_m(self, row: int, col: int) -> Array:
        """Corners (5, 2) of a cell, counter-clockwise, the first one again at the end."""
        corners = (_CORNERS + np.array([col, row])) * (self.side_m, -self.side_m)
        return np.asarray(corners + np.array([self.west_m, self.north_m]))


def lonlat(frame: LocalFrame, points_en_m: Array) -> list[list[float]]:
    """Longitude and latitude of points (N, 2) for GeoJSON, with no jump at the date line."""
    lat, lon = frame.latlon_from_en(points_en_m)
    lon = frame.lon_deg + (lon - frame.lon_deg + 180) % 360 - 180
    found: list[list[float]] = np.round(np.stack([lon, lat], axis=-1), 7).tolist()
    return found
