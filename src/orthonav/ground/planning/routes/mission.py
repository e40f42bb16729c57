"""MAVLink missions, independent of their file format.

Commands and frames: MAV_CMD and MAV_FRAME of MAVLink's common.xml.
"""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

from orthonav.core.errors import RouteError
from orthonav.ground.planning.routes.record import MAX_NAMED, Height, HeightFrame, Route

WAYPOINT, RETURN_HOME, LAND, TAKEOFF, VTOL_TAKEOFF, VTOL_LAND = 16, 20, 21, 22, 84, 85
_CIRCLES = (17, 18, 19, 31, 34)
_ARC, _SPLINE, _PLACE, _REPOSITION = 36, 82, 94, 192
_OF_USERS = range(31000, 31005)
FLOWN = {
    *(WAYPOINT, LAND, TAKEOFF, VTOL_TAKEOFF, VTOL_LAND),
    *(*_CIRCLES, _ARC, _SPLINE, _PLACE, _REPOSITION, *_OF_USERS),
}
"""Commands with a position that the aircraft flies to."""
_NOT_FLOWN = {
    *(80, 83, 92, 93, 95),  # regions of interest, delays
    *range(112, 160),  # conditions
    *range(176, 301),  # servos, speeds, cameras, gimbals, jumps, landing markers, home, fences
    *range(400, 3001),  # the vehicle's state, gimbals, cameras, payloads
    *(4000, 4001, 4501, *range(5000, 5101)),  # gates, fences, rally points
    *range(31005, 31010),  # positions that are not flown through
    *range(42000, 44000),  # of ArduPilot
}
"""Commands that do not change the route, although some state a position, or use its numbers for
something else."""
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
    position, None if it has none. `number`: of the item in its file. `pattern`: number shared by
    all items of one survey or corridor, which is flown as a whole. `band_m`: search band between
    items of one pattern.
    """

    command: int
    frame: int
    lat_deg: float | None
    lon_deg: float | None
    height_m: float | None = None
    number: int = 0
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
    a position is at home. A return to launch ends the route at home. Jumps are not followed; a
    circle is replaced by its centre. Items with a position that are left out are named: those after
    the return, and those whose command is not known.
    """
    stops: list[MissionItem] = []
    left_out: list[str] = []
    remaining = iter(items)
    for item in remaining:
        if item.command == RETURN_HOME:
            if home is not None:
                stops.append(_at_home(home))
            break
        if item.command in FLOWN and _has_place(item):
            height_frame(item.frame)
            stops.append(item)
        elif item.command in (TAKEOFF, VTOL_TAKEOFF) and home is not None:
            stops.append(_at_home(home))
        elif _is_lost(item):
            left_out.append(_named(item))
    left_out += [f"{_named(item)} after the return" for item in remaining if _is_lost(item)]
    if not stops:
        held = f"; left out are {', '.join(left_out[:MAX_NAMED])}" if left_out else ""
        raise RouteError(f"mission holds no waypoint with a position{held}")
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
        left_out=tuple(left_out),
    )


def _at_home(home: Home) -> MissionItem:
    return MissionItem(WAYPOINT, 0, home.lat_deg, home.lon_deg)


def _has_place(item: MissionItem) -> bool:
    if item.lat_deg is None or item.lon_deg is None:
        return False
    return item.lat_deg != 0 or item.lon_deg != 0


def _is_lost(item: MissionItem) -> bool:
    """Whether an item that is left out may be flown to."""
    return (item.command in FLOWN or item.command not in _NOT_FLOWN) and _has_place(item)


def _named(item: MissionItem) -> str:
    return f"item {item.number} (command {item.command})"


def _height(item: MissionItem) -> Height | None:
    if item.height_m is None:
        return None
    return Height(item.height_m, height_frame(item.frame))
