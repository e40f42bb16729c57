"""Division of areas into sheets: an area too large for one map, and the whole Earth.

A map holds one sheet, so each part becomes a separate map. Neighbouring parts share a border; tiles
reach half a tile beyond the area, so a view near the border lies completely on one of the two maps.

The sheets of the Earth (`WorldSheets`) have names. Rows have equal height in latitude; each row is
divided into the number of equal boxes its longest parallel requires. Rows are counted from the
South Pole, columns from 180 deg west.
"""

import itertools
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError
from orthonav.core.geo.frames import MAX_SHEET_M, WGS84_A_M
from orthonav.core.geo.swapped import swapped_bounds_hint, swapped_hint
from orthonav.ground.planning.area import Area, Extent, unwrapped
from orthonav.ground.planning.route import Array, Height, Route, leg_lengths_m

MAX_SHEETS = 10_000  # limit of the program; 2500 km2 each, so 25 million km2
MAX_ROUTE_SHEETS = 500  # more than once around the Earth with bands of less than 10 km
_DEGREE_M = 110_574.0  # shortest degree of latitude, at the equator (WGS84)
_LON_DEGREE_M = 111_320.0  # degree of longitude at the equator (WGS84)
_TRIES = 4  # numbers of columns tried for one row before rows are made lower


def sheets_of_bounds(bounds_deg: Extent) -> list[Extent]:
    """Boxes (west, south, east, north in degrees) that each fit a sheet and together fill the box.
    Rows of equal height, from south to north; each row is divided into the number of equal boxes
    its width requires, from west to east."""
    west, south, east, north = unwrapped(bounds_deg)
    if max(abs(south), abs(north)) > 89.5 or abs(west) > 360:
        hint = swapped_bounds_hint((west, south, east, north))
        raise AreaError(
            f"bounds must lie within 89.5 deg of the equator{hint}, "
            f"got {','.join(map(str, bounds_deg))}"
        )
    zone = math.sin(math.radians(north)) - math.sin(math.radians(south))
    least = math.radians(east - west) * zone * WGS84_A_M**2 / MAX_SHEET_M**2
    if least > MAX_SHEETS:
        raise _too_many(round(least))
    rows = max(1, int((north - south) * _DEGREE_M / MAX_SHEET_M))
    while True:
        edges = np.linspace(south, north, rows + 1).tolist()
        found = [_row(west, low, east, high) for low, high in itertools.pairwise(edges)]
        if all(found):
            break
        rows += 1
    sheets = [sheet for row in found for sheet in row]
    if len(sheets) > MAX_SHEETS:
        raise _too_many(len(sheets))
    return sheets


def _row(west: float, south: float, east: float, north: float) -> list[Extent]:
    widest = 0.0 if south <= 0 <= north else min(abs(south), abs(north))
    width_m = (east - west) * _LON_DEGREE_M * math.cos(math.radians(widest))
    least = max(1, int(width_m / MAX_SHEET_M))
    for count in range(least, least + _TRIES):
        edges = np.linspace(west, east, count + 1).tolist()
        boxes = [
            (_wrapped(left), south, _wrapped(right), north)
            for left, right in itertools.pairwise(edges)
        ]
        if _box_fits((edges[0], south, edges[1], north)):
            return boxes
    return []


def _box_fits(bounds_deg: Extent) -> bool:
    try:
        Area.from_bounds(bounds_deg)
    except AreaError:
        return False
    return True


def _wrapped(lon_deg: float) -> float:
    return lon_deg if abs(lon_deg) <= 180 else (lon_deg + 180) % 360 - 180


def sheets_of_route(route: Route, band_m: float | None) -> list[Route]:
    """Parts of a route, in order, whose search bands each fit a sheet. The route is divided at
    waypoints, each part as long as possible. A leg too long for a sheet is divided into equal
    pieces on the great circle. Each part begins at the end of the previous one. Parts are named
    sheet-1, sheet-2 and so on."""
    bands_m = route.bands_m(band_m)
    if bands_m is None or _route_fits(route, band_m):
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
        if len(parts) == MAX_ROUTE_SHEETS:
            raise _route_too_long(f"more than {MAX_ROUTE_SHEETS}")
        last = _last_that_fits(cut, first, band_m)
        parts.append(cut.part(first, last, f"sheet-{len(parts) + 1}"))
        first = last
    return parts


def _route_fits(route: Route, band_m: float | None) -> bool:
    try:
        Area.from_route(route, band_m)
    except AreaError:
        return False
    return True


def _last_that_fits(route: Route, first: int, band_m: float | None) -> int:
    """The last waypoint for which the legs from `first` fit a sheet; at least one leg."""
    step, last = 1, first + 1
    while last + step < len(route.waypoints) and _route_fits(
        route.part(first, last + step), band_m
    ):
        last += step
        step *= 2
    while step > 0:
        if last + step < len(route.waypoints) and _route_fits(
            route.part(first, last + step), band_m
        ):
            last += step
        step //= 2
    return last


def _with_short_legs(route: Route, bands_m: tuple[float, ...]) -> Route:
    waypoints, heights = [route.waypoints[0]], list(route.heights[:1])
    leg_bands: list[float | None] = []
    lengths_m = leg_lengths_m(route)
    divided = 0
    for leg, (start, end) in enumerate(zip(route.waypoints, route.waypoints[1:], strict=False)):
        pieces = math.ceil(lengths_m[leg] / (0.99 * (MAX_SHEET_M - bands_m[leg])))
        if pieces <= 1 or _route_fits(Route((start, end)), bands_m[leg]):
            pieces = 1  # most legs
        divided += pieces if pieces > 1 else 0
        if divided > MAX_ROUTE_SHEETS:
            raise _route_too_long(f"{divided:,} or more")
        shares = [number / pieces for number in range(1, pieces)]
        waypoints += [*_on_great_circle(start, end, shares), end]
        if route.heights:
            below, above = route.heights[leg], route.heights[leg + 1]
            heights += [*(_between(below, above, share) for share in shares), above]
        if route.leg_bands_m:
            leg_bands += [route.leg_bands_m[leg]] * pieces
    return replace(
        route, waypoints=tuple(waypoints), heights=tuple(heights), leg_bands_m=tuple(leg_bands)
    )


def _between(below: Height | None, above: Height | None, share: float) -> Height | None:
    if below is None or above is None or below.frame != above.frame:
        return None
    return Height(below.height_m + share * (above.height_m - below.height_m), below.frame)


def _on_great_circle(
    start: tuple[float, float], end: tuple[float, float], shares: list[float]
) -> Iterator[tuple[float, float]]:
    one, other = _direction(start), _direction(end)
    angle = math.atan2(float(np.linalg.norm(np.cross(one, other))), float(one @ other))
    if shares and math.sin(angle) < 1e-6:
        raise AreaError(f"leg from {start} to {end} spans half of the Earth: add waypoints")
    for share in shares:
        x, y, z = math.sin((1 - share) * angle) * one + math.sin(share * angle) * other
        yield math.degrees(math.atan2(z, math.hypot(x, y))), math.degrees(math.atan2(y, x))


def _direction(place: tuple[float, float]) -> Array:
    lat, lon = (math.radians(value) for value in place)
    return np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])


def _route_too_long(sheets: str) -> AreaError:
    return AreaError(
        f"route needs {sheets} sheets, at most {MAX_ROUTE_SHEETS} are planned at once; plan it in "
        "parts, or with a narrower search band"
    )


def _too_many(count: int) -> AreaError:
    return AreaError(f"area needs {count:,} sheets, more than the limit of {MAX_SHEETS:,}")


LARGEST_SIDE_M = 0.9 * MAX_SHEET_M  # boxes are wider than sheets: meridians converge
SMALLEST_SIDE_M = 200.0
_MERIDIAN_DEGREE_M = 111_695.0  # longest degree of latitude, at a pole (WGS84)
_PARALLEL_DEGREE_M = 111_320.0  # degree of longitude at the equator (WGS84)
_NAME = re.compile(r"r([0-9]{6})c([0-9]{6})")


@dataclass(frozen=True)
class WorldSheets:
    side_m: float

    def __post_init__(self) -> None:
        if not SMALLEST_SIDE_M <= self.side_m <= LARGEST_SIDE_M:
            raise AreaError(
                f"sheets of an atlas must be {SMALLEST_SIDE_M / 1000:g} to "
                f"{LARGEST_SIDE_M / 1000:g} km wide, got {self.side_m / 1000:g} km"
            )

    @property
    def rows(self) -> int:
        return math.ceil(180 * _MERIDIAN_DEGREE_M / self.side_m)

    def cols(self, row: int) -> int:
        south, north = self._parallels(row)
        widest = 0.0 if south <= 0 <= north else min(abs(south), abs(north))
        around_m = 360 * _PARALLEL_DEGREE_M * math.cos(math.radians(widest))
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
        match = _NAME.fullmatch(name)
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


def in_box(bounds_deg: Extent, lat_deg: Array, lon_deg: Array) -> NDArray[np.bool_]:
    """Which places lie in a box, its southern and western border included; of any shape."""
    west, south, east, north = bounds_deg
    turned = (lon_deg - west) % 360
    return np.asarray((lat_deg >= south) & (lat_deg < north) & (turned < east - west))


def _named(row: int, col: int) -> str:
    return f"r{row:06d}c{col:06d}"
