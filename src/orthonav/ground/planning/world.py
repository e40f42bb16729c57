"""Division of the whole Earth into named sheets.

Rows have equal height in latitude; each row is divided into the number of equal boxes its longest
parallel requires. Rows are counted from the South Pole, columns from 180 deg west.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError
from orthonav.core.geo.frames import MAX_SHEET_M
from orthonav.core.geo.swapped import swapped_hint
from orthonav.ground.planning.area import Extent

LARGEST_SIDE_M = 0.9 * MAX_SHEET_M
"""The box around a sheet is wider than the sheet, because meridians converge."""
SMALLEST_SIDE_M = 200.0
_MERIDIAN_DEGREE_M = 111_695.0
"""Longest degree of latitude, at a pole (WGS84)."""
_PARALLEL_DEGREE_M = 111_320.0
"""Degree of longitude at the equator (WGS84)."""
_NAME = re.compile(r"r([0-9]{6})c([0-9]{6})")


@dataclass(frozen=True)
class WorldSheets:
    """Sheets at most `side_m` wide and high. Raises `AreaError` for an impossible size."""

    side_m: float

    def __post_init__(self) -> None:
        if not SMALLEST_SIDE_M <= self.side_m <= LARGEST_SIDE_M:
            raise AreaError(
                f"sheets of an atlas must be {SMALLEST_SIDE_M / 1000:g} to "
                f"{LARGEST_SIDE_M / 1000:g} km wide, got {self.side_m / 1000:g} km"
            )

    @property
    def rows(self) -> int:
        """Rows from pole to pole."""
        return math.ceil(180 * _MERIDIAN_DEGREE_M / self.side_m)

    def cols(self, row: int) -> int:
        """Columns of a row."""
        south, north = self._parallels(row)
        widest = 0.0 if south <= 0 <= north else min(abs(south), abs(north))
        around_m = 360 * _PARALLEL_DEGREE_M * math.cos(math.radians(widest))
        return max(1, math.ceil(around_m / self.side_m))

    def name_at(self, lat_deg: float, lon_deg: float) -> str:
        """Name of the sheet that contains a position. Raises `AreaError` if it is invalid."""
        if not (abs(lat_deg) <= 90 and math.isfinite(lon_deg)):
            hint = swapped_hint(lat_deg, lon_deg)
            raise AreaError(f"not a latitude and longitude in degrees: {lat_deg}, {lon_deg}{hint}")
        row = min(self.rows - 1, max(0, int((lat_deg + 90) / 180 * self.rows)))
        cols = self.cols(row)
        turned = (lon_deg + 180) % 360
        return _named(row, min(cols - 1, int(turned / 360 * cols)))

    def bounds_deg(self, name: str) -> Extent:
        """West, south, east, north of a sheet. Raises `AreaError` if there is no such sheet."""
        match = _NAME.fullmatch(name)
        row, col = (int(part) for part in match.groups()) if match else (-1, -1)
        if not (0 <= row < self.rows and 0 <= col < self.cols(row)):
            raise AreaError(f"no sheet of {self.side_m / 1000:g} km is named {name!r:.40}")
        south, north = self._parallels(row)
        step = 360 / self.cols(row)
        return -180 + col * step, south, -180 + (col + 1) * step, north

    def over(self, bounds_deg: Extent) -> Iterator[str]:
        """Names of the sheets that intersect a box, from south to north and west to east.

        A box with west > east crosses the antimeridian.
        """
        west, south, east, north = bounds_deg
        if west > east:
            east += 360
        if not (math.isfinite(west + south + east + north) and south <= north and west <= east):
            raise AreaError(
                "bounds must be west,south,east,north in degrees with west < east and "
                f"south < north, got {','.join(map(str, bounds_deg))}"
            )
        first, last = (int((lat + 90) / 180 * self.rows) for lat in (south, north))
        for row in range(max(0, first), min(self.rows - 1, last) + 1):
            cols = self.cols(row)
            left = math.floor((west + 180) / 360 * cols)
            right = math.floor((east + 180) / 360 * cols)
            for col in range(left, min(right, left + cols - 1) + 1):
                yield _named(row, col % cols)

    def _parallels(self, row: int) -> tuple[float, float]:
        return -90 + row * 180 / self.rows, -90 + (row + 1) * 180 / self.rows


def in_box(
    bounds_deg: Extent, lat_deg: NDArray[np.float64], lon_deg: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Which places lie in a box, its southern and western border included; of any shape."""
    west, south, east, north = bounds_deg
    turned = (lon_deg - west) % 360
    return np.asarray((lat_deg >= south) & (lat_deg < north) & (turned < east - west))


def _named(row: int, col: int) -> str:
    return f"r{row:06d}c{col:06d}"
