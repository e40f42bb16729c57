"""What MAVLink missions have in common, whatever file holds them.

Commands and frames: MAV_CMD and MAV_FRAME of MAVLink's common.xml.
"""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

from orthonav.errors import RouteError
from orthonav.geo.routes.record import Height, HeightFrame, Route

WAYPOINT, RETURN_HOME, LAND, TAKEOFF, VTOL_TAKEOFF, VTOL_LAND = 16, 20, 21, 22, 84, 85
_LOITERS = (17, 18, 19, 31)
_ARC, _SPLINE, _PLACE = 36, 82, 94
FLOWN = {WAYPOINT, LAND, TAKEOFF, VTOL_TAKEOFF, VTOL_LAND, *_LOITERS, _ARC, _SPLINE, _PLACE}
"""Commands with a place that the aircraft flies to; all others (cameras, regions of interest,
speeds, jumps, conditions, landing markers) say nothing of the way."""
_HEIGHT_FRAMES: dict[int, HeightFrame] = {
    0: "amsl",
    5: "amsl",
    3: "home",
    6: "home",
    10: "agl",
    11: "agl",
}


@dataclass(frozen=True)
class Item:
    """A mission item: `command` with its place in degrees, None where it has none.

    `height_m` is above what `frame` (MAV_FRAME) says. Items of one `pattern` (a survey, a corridor)
    are flown as a whole, and `band_m` is the search band between them.
    """

    command: int
    frame: int
    lat_deg: float | None
    lon_deg: float | None
    height_m: float | None = None
    pattern: int | None = None
    band_m: float | None = None


@dataclass(frozen=True)
class Home:
    """The planned take-off place, and its height above mean sea level."""

    lat_deg: float
    lon_deg: float
    amsl_m: float | None = None


def height_frame(frame: int) -> HeightFrame:
    """Above what the heights of a MAV_FRAME are. Raises `RouteError` on frames without a globe."""
    if frame not in _HEIGHT_FRAMES:
        raise RouteError(
            f"mission has a waypoint in MAV_FRAME {frame}; expected a global one "
            f"({', '.join(map(str, sorted(_HEIGHT_FRAMES)))})"
        )
    return _HEIGHT_FRAMES[frame]


def route_of(items: Iterable[Item], home: Home | None) -> Route:
    """The route of a mission. Raises `RouteError` where no item has a place.

    As autopilots do: a place of 0, 0 or none is "where you are"; so a take-off without a place is
    at home. A return to launch ends the route at home; what follows it is not flown. Jumps are not
    followed, circles are their middle.
    """
    stops: list[Item] = []
    for item in items:
        if item.command == RETURN_HOME:
            if home is not None:
                stops.append(_at_home(home))
            break
        if item.command not in FLOWN:
            continue
        if _has_place(item):
            height_frame(item.frame)
            stops.append(item)
        elif item.command in (TAKEOFF, VTOL_TAKEOFF) and home is not None:
            stops.append(_at_home(home))
    if not stops:
        raise RouteError("mission holds no waypoint with a place")
    heights = tuple(_height(stop) for stop in stops)
    bands = tuple(
        start.band_m if start.pattern is not None and start.pattern == end.pattern else None
        for start, end in itertools.pairwise(stops)
    )
    return Route(
        tuple((stop.lat_deg or 0.0, stop.lon_deg or 0.0) for stop in stops),
        heights if any(heights) else (),
        bands if any(bands) else (),
        home_amsl_m=None if home is None else home.amsl_m,
    )


def _at_home(home: Home) -> Item:
    return Item(WAYPOINT, 0, home.lat_deg, home.lon_deg)


def _has_place(item: Item) -> bool:
    if item.lat_deg is None or item.lon_deg is None:
        return False
    return item.lat_deg != 0 or item.lon_deg != 0


def _height(item: Item) -> Height | None:
    if item.height_m is None:
        return None
    return Height(item.height_m, height_frame(item.frame))
