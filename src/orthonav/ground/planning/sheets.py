"""Division of areas into sheets: an area too large for one map, and the whole Earth.

A map holds one sheet, so each part becomes a separate map. Neighbouring parts share a border; tiles
reach half a tile beyond the area, so a view near the border lies completely on one of the two maps.

The sheets of the Earth (`WorldSheets`) have names. Rows have equal height in latitude; each row is
divided into the number of equal boxes its longest parallel requires. Rows are counted from the
South Pole, columns from 180 deg west."""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError, UsageError
from orthonav.core.geo.frames import MAX_SHEET_M
from orthonav.core.geo.swapped import swapped_hint
from orthonav.ground.planning.area import Area, Extent
from orthonav.ground.planning.route import Array, Height, Route, leg_lengths_m

MAX_ROUTE_SHEETS = 500  # more than once around the Earth with bands of less than 10 km


def _fits(route: Route, band_m: float | None) -> bool:
    try:
        Area.from_route(route, band_m)
    except AreaError:
        return False
    return True


def sheets_of_route(route: Route, band_m: float | None) -> list[Route]:
    """Parts of a route, in order, as long as their search bands fit a sheet. A leg too long for one
    is divided into equal pieces on the great circle."""
    bands_m = route.bands_m(band_m)
    if bands_m is None or _fits(route, band_m):
        Area.from_route(route, band_m)  # raises if a band is missing
        return [route]
    if max(bands_m) >= MAX_SHEET_M:
        raise AreaError(
            f"search band of {max(bands_m):.0f} m is as wide as a sheet, {MAX_SHEET_M:.0f} m"
        )
    cut = _with_short_legs(route, bands_m)
    parts: list[Route] = []
    first = 0
    while first < cut.legs:
        _require_few(len(parts) + 1, f"more than {MAX_ROUTE_SHEETS}")
        last = _last_that_fits(cut, first, band_m)
        parts.append(cut.part(first, last, f"sheet-{len(parts) + 1}"))
        first = last
    return parts


def _last_that_fits(route: Route, first: int, band_m: float | None) -> int:
    """The last waypoint for which the legs from `first` fit a sheet; at least one leg."""

    def fits(last: int) -> bool:
        within = last < len(route.waypoints)
        return within and _fits(route.part(first, last), band_m)

    step, last = 1, first + 1
    while fits(last + step):
        last += step
        step *= 2
    while step > 0:
        if fits(last + step):
            last += step
        step //= 2
    return last


def _with_short_legs(route: Route, bands_m: tuple[float, ...]) -> Route:
    pieces = np.ceil(leg_lengths_m(route) / (0.99 * (MAX_SHEET_M - np.array(bands_m))))
    pieces = np.maximum(pieces, 1).astype(int)
    divided = int(pieces[pieces > 1].sum())
    _require_few(divided, f"{divided:,} or more")
    waypoints, heights = [route.waypoints[0]], list(route.heights[:1])
    leg_bands: list[float | None] = []
    for leg, count in enumerate(pieces.tolist()):
        shares = np.arange(1, count) / count
        start, end = route.waypoints[leg : leg + 2]
        waypoints += [*_on_great_circle(start, end, shares), end]
        if route.heights:
            below, above = route.heights[leg : leg + 2]
            heights += [*(_between(below, above, share) for share in shares.tolist()), above]
        leg_bands += [band for band in route.leg_bands_m[leg : leg + 1] for _ in range(count)]
    return replace(
        route, waypoints=tuple(waypoints), heights=tuple(heights), leg_bands_m=tuple(leg_bands)
    )


def _between(below: Height | None, above: Height | None, share: float) -> Height | None:
    if below is None or above is None or below.frame != above.frame:
        return None
    return Height(below.height_m + share * (above.height_m - below.height_m), below.frame)


def _on_great_circle(
    start: tuple[float, float], end: tuple[float, float], shares: Array
) -> Iterator[tuple[float, float]]:
    lat, lon = np.radians([start, end]).T
    one, other = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], 1)
    angle = math.atan2(float(np.linalg.norm(np.cross(one, other))), float(one @ other))
    if len(shares) and math.sin(angle) < 1e-6:
        raise AreaError(f"leg from {start} to {end} spans half of the Earth: add waypoints")
    for share in shares.tolist():
        x, y, z = math.sin((1 - share) * angle) * one + math.sin(share * angle) * other
        yield math.degrees(math.atan2(z, math.hypot(x, y))), math.degrees(math.atan2(y, x))


def _require_few(sheets: int, said: str) -> None:
    if sheets > MAX_ROUTE_SHEETS:
        raise AreaError(
            f"route needs {said} sheets, at most {MAX_ROUTE_SHEETS} are planned at once; plan it "
            "in parts, or with a narrower search band"
        )


@dataclass(frozen=True)
class WorldSheets:
    side_m: float
    MIN_SIDE_M: ClassVar = 200.0
    MAX_SIDE_M: ClassVar = 0.9 * MAX_SHEET_M  # boxes are wider than sheets: meridians converge

    def __post_init__(self) -> None:
        if not self.MIN_SIDE_M <= self.side_m <= self.MAX_SIDE_M:
            raise UsageError(
                f"sheet_km must be {self.MIN_SIDE_M / 1000:g} to {self.MAX_SIDE_M / 1000:g}, "
                f"got {self.side_m / 1000:g}"
            )

    @property
    def rows(self) -> int:
        longest_degree_m = 111_695.0  # of latitude, at a pole (WGS 84)
        return math.ceil(180 * longest_degree_m / self.side_m)

    def cols(self, row: int) -> int:
        south, north = self._parallels(row)
        widest = 0.0 if south <= 0 <= north else min(abs(south), abs(north))
        equator_degree_m = 111_320.0  # of longitude (WGS 84)
        around_m = 360 * equator_degree_m * math.cos(math.radians(widest))
        return max(1, math.ceil(around_m / self.side_m))

    def name_at(self, lat_deg: float, lon_deg: float) -> str:
        if not (abs(lat_deg) <= 90 and math.isfinite(lon_deg)):
            hint = swapped_hint(lat_deg, lon_deg)
            raise AreaError(f"not a latitude and longitude in degrees: {lat_deg}, {lon_deg}{hint}")
        row = min(self.rows - 1, max(0, int((lat_deg + 90) / 180 * self.rows)))
        cols = self.cols(row)
        turned = (lon_deg + 180) % 360
        return _named(row, min(cols - 1, int(turned / 360 * cols)))

    def bounds_deg(self, name: str) -> Extent:
        match = re.fullmatch(r"r([0-9]{6})c([0-9]{6})", name)
        row, col = (int(part) for part in match.groups()) if match else (-1, -1)
        if not (0 <= row < self.rows and 0 <= col < self.cols(row)):
            raise AreaError(f"no sheet of {self.side_m / 1000:g} km is named {name!r:.40}")
        south, north = self._parallels(row)
        step = 360 / self.cols(row)
        return -180 + col * step, south, -180 + (col + 1) * step, north

    def over(self, bounds_deg: Extent) -> Iterator[str]:
        """Names of the sheets that intersect a box, from south to north and west to east. A box
        with west > east crosses the antimeridian."""
        west, south, east, north = bounds_deg
        if west > east:
            east += 360
        if not (math.isfinite(west + south + east + north) and south <= north and west <= east):
            raise UsageError(
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


def in_box(bounds_deg: Extent, lat_deg: Array, lon_deg: Array) -> NDArray[np.bool_]:
    """Which places lie in a box, its southern and western border included; of any shape."""
    west, south, east, north = bounds_deg
    turned = (lon_deg - west) % 360
    return np.asarray((lat_deg >= south) & (lat_deg < north) & (turned < east - west))


def _named(row: int, col: int) -> str:
    return f"r{row:06d}c{col:06d}"
