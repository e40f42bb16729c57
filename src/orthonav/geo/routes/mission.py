"""MAVLink missions, independent of their file format.

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
"""Commands with a position that the aircraft flies to. All others (cameras, regions of interest,
speeds, jumps, conditions, landing markers) do not change the route."""
_HEIGHT_FRAMES: dict[int, HeightFrame] = {
    0: "amsl",
    5: "amsl",
    3: "home",
    6: "home",
    10: "agl",
    11: "agl",
}


@dataclass(frozen=True)
class MissionItem:
    """A mission item.

    `command`: MAV_CMD. `frame`: MAV_FRAME, the reference of `height_m`. `lat_deg`, `lon_deg`:
    position, None if it has none. `pattern`: number shared by all items of one survey or corridor,
    which is flown as a whole. `band_m`: search band between items of one pattern.
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
    """The planned take-off position, and its height above mean sea level."""

    lat_deg: float
    lon_deg: float
    amsl_m: float | None = None


def height_frame(frame: int) -> HeightFrame:
    """Height reference of a MAV_FRAME. Raises `RouteError` for frames that are not global."""
    if frame not in _HEIGHT_FRAMES:
        raise RouteError(
            f"mission has a waypoint in MAV_FRAME {frame}; expected a global one "
            f"({', '.join(map(str, sorted(_HEIGHT_FRAMES)))})"
        )
    return _HEIGHT_FRAMES[frame]


def route_of(items: Iterable[MissionItem], home: Home | None) -> Route:
    """The route of a mission. Raises `RouteError` if no item has a position.

    As in autopilots, a position of 0, 0 or none means the current position, so a take-off without
    a position is at home. A return to launch ends the route at home; later items are ignored. Jumps
    are not followed; a circle is replaced by its centre.
    """
    stops: list[MissionItem] = []
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
        raise RouteError("mission holds no waypoint with a position")
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


def _at_home(home: Home) -> MissionItem:
    return MissionItem(WAYPOINT, 0, home.lat_deg, home.lon_deg)


def _has_place(item: MissionItem) -> bool:
    if item.lat_deg is None or item.lon_deg is None:
        return False
    return item.lat_deg != 0 or item.lon_deg != 0


def _height(item: MissionItem) -> Height | None:
    if item.height_m is None:
        return None
    return Height(item.height_m, height_frame(item.frame))
