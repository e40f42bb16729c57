"""MAVLink missions: plans of QGroundControl, and waypoint files of ground stations.

`.plan` (JSON): QGroundControl developer guide, "Plan File Format", and where that is silent the
code that writes and reads it (`MissionItem`, `SimpleMissionItem`, `TransectStyleComplexItem`,
`CameraCalc`, `CorridorScanComplexItem`, `LandingComplexItem`).

Text that begins "QGC WPL 110": a line an item, twelve numbers: index, current, frame, command, four
parameters, latitude, longitude, altitude, autocontinue (mavlink.io, "Mission Plain-Text File
Format"). In version 110 the first item, with number 0, is the planned home position, in the older
120 of QGroundControl there is none (QGroundControl, `MissionController::_loadTextMissionFile`).

Commands and frames: MAV_CMD and MAV_FRAME of MAVLink's common.xml."""

import io
import itertools
import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

from orthonav.core.errors import RouteError
from orthonav.core.tables import TableError, bounded_lines
from orthonav.ground.planning.record import (
    Height,
    HeightFrame,
    Route,
    decoded,
    listed,
    number,
    number_or_none,
    parsed,
    require_few_waypoints,
)

log = logging.getLogger(__name__)


class Command(IntEnum):
    """Commands of MAV_CMD that a route treats by name."""

    WAYPOINT = 16
    RETURN_HOME = 20
    LAND = 21
    TAKEOFF = 22
    VTOL_TAKEOFF = 84


class Frame(IntEnum):
    """Frames of MAV_FRAME, the reference of a height."""

    ABOVE_SEA = 0
    ABOVE_HOME = 3
    ABOVE_TERRAIN = 10


FLOWN = {  # commands with a position that the aircraft flies to
    *(16, 21, 22, 84, 85),  # waypoints, take-off and landing
    *(17, 18, 19, 31, 34),  # circles
    *(36, 82, 94, 192),  # arc, spline, place of a payload, reposition
    *range(31000, 31005),  # waypoints of users
}
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


@dataclass(frozen=True)
class MissionItem:
    """`lat_deg`, `lon_deg`: position, None if it has none. `pattern`: number shared by all items of
    one survey or corridor, which is flown as a whole."""

    command: int  # MAV_CMD
    frame: int  # MAV_FRAME, the reference of `height_m`
    lat_deg: float | None
    lon_deg: float | None
    height_m: float | None = None
    number: int = 0  # of the item in its file
    pattern: int | None = None
    band_m: float | None = None  # search band between items of one pattern


def route_of(items: Iterable[MissionItem], home: MissionItem | None) -> Route:
    """The route of a mission. As in autopilots, a position of 0, 0 or none means the current
    position, so a take-off without a position is at home. A return to launch ends the route at
    home. Jumps are not followed; a circle is replaced by its centre. A warning names items with a
    position that are left out: those after the return, and those whose command is not known."""
    stops: list[MissionItem] = []
    left_out: list[str] = []
    remaining = iter(items)
    for item in remaining:
        if item.command == Command.RETURN_HOME:
            if home is not None:
                stops.append(replace(home, height_m=None))
            break
        if item.command in FLOWN and _has_place(item):
            stops.append(item)
        elif item.command in (Command.TAKEOFF, Command.VTOL_TAKEOFF) and home is not None:
            stops.append(replace(home, height_m=None))
        elif _is_lost(item):
            left_out.append(_named(item))
    left_out += [f"{_named(item)} after the return" for item in remaining if _is_lost(item)]
    named = listed(left_out, 12)
    if not stops:
        held = f"; left out are {named}" if left_out else ""
        raise RouteError(f"mission holds no waypoint with a position{held}")
    if left_out:
        log.warning(
            "positions that are not part of the route, so the map may not cover them: %s", named
        )
    bands = tuple(
        start.band_m if start.pattern is not None and start.pattern == end.pattern else None
        for start, end in itertools.pairwise(stops)
    )
    return Route(
        tuple((stop.lat_deg or 0.0, stop.lon_deg or 0.0) for stop in stops),
        tuple(map(_height, stops)),
        bands if any(bands) else (),
        home_amsl_m=None if home is None else home.height_m,
    )


def _has_place(item: MissionItem) -> bool:
    if item.lat_deg is None or item.lon_deg is None:
        return False
    return item.lat_deg != 0 or item.lon_deg != 0


def _is_lost(item: MissionItem) -> bool:
    return (item.command in FLOWN or item.command not in _NOT_FLOWN) and _has_place(item)


def _named(item: MissionItem) -> str:
    return f"item {item.number} (command {item.command})"


def _height(item: MissionItem) -> Height | None:
    frames: dict[int, HeightFrame] = {0: "amsl", 5: "amsl", 3: "home", 6: "home"}
    frames |= {10: "agl", 11: "agl"}
    if item.frame not in frames:
        raise RouteError(
            f"mission has a waypoint in MAV_FRAME {item.frame}; expected a global one "
            f"({', '.join(map(str, sorted(frames)))})"
        )
    return None if item.height_m is None else Height(item.height_m, frames[item.frame])


def plan_route(plain: dict[str, Any]) -> Route:
    if plain.get("fileType") != "Plan":
        raise RouteError(f"plan must have fileType 'Plan', got {plain.get('fileType')!r:.40}")
    mission = plain["mission"]
    home = _plan_home(mission.get("plannedHomePosition"))
    items = enumerate(mission["items"])
    return route_of([item for index, raw in items for item in _plan_items(raw, index)], home)


def _plan_home(raw: Any) -> MissionItem | None:
    if not isinstance(raw, list) or len(raw) < 2:
        return None
    lat, lon = (number(raw[index], "plannedHomePosition") for index in (0, 1))
    if lat == 0 and lon == 0:
        return None
    height_m = number_or_none(raw[2] if len(raw) > 2 else None, "height of home")
    return MissionItem(Command.WAYPOINT, Frame.ABOVE_SEA, lat, lon, height_m)


def _plan_items(raw: dict[str, Any], index: int) -> list[MissionItem]:
    where, name = f"item {index + 1} of the plan", raw.get("complexItemType")
    if raw["type"] == "SimpleItem":
        return [_simple(raw, index + 1, where)]
    if name in ("survey", "CorridorScan"):
        return _transects(raw, index, f"{where} ({name})")
    if name in ("fwLandingPattern", "vtolLandingPattern"):
        return _landing(raw, f"{where} ({name})")
    raise RouteError(
        f"{where} is a {name or raw['type']!r:.40}: only surveys, corridor scans and landing "
        "patterns are read besides waypoints, because in others the camera does not look down; "
        "remove it from the plan"
    )


def _simple(raw: dict[str, Any], item: int, where: str) -> MissionItem:
    params = raw.get("params") or ()
    place = params[4:7] if len(params) >= 7 else raw["coordinate"]
    command, frame = (int(number(raw.get(key), f"{where}: {key}")) for key in ("command", "frame"))
    lat, lon, height = (number_or_none(value, f"{where}: params") for value in place[:3])
    if raw.get("AltitudeMode") == 3:  # QGroundControl's own sum of terrain and a height
        frame = Frame.ABOVE_TERRAIN
        height = number_or_none(raw.get("Altitude"), f"{where}: Altitude")
    return MissionItem(command, frame, lat, lon, height, item)


def _transects(raw: dict[str, Any], index: int, where: str) -> list[MissionItem]:
    inner = raw.get("TransectStyleComplexItem") or {}
    points = inner.get("VisualTransectPoints")
    if not points:
        raise RouteError(
            f"{where} has no VisualTransectPoints; open the plan with a later QGroundControl, let "
            "it draw the flight lines, and save it"
        )
    frame, height_m = _survey_height(inner.get("CameraCalc") or {}, inner, where)
    width_m = number_or_none(raw.get("CorridorWidth"), f"{where}: CorridorWidth") or None
    return [
        MissionItem(
            *(Command.WAYPOINT, frame, *_latlon(point, f"{where}: VisualTransectPoints"), height_m),
            pattern=index,
            band_m=width_m,
        )
        for point in points
    ]


def _survey_height(
    camera: dict[str, Any], inner: dict[str, Any], where: str
) -> tuple[int, float | None]:
    height_m = number_or_none(camera.get("DistanceToSurface"), f"{where}: DistanceToSurface")
    mode = camera.get("DistanceMode")  # an altitude mode of QGroundControl
    if mode not in (1, 2, 3, 4):  # an older file
        relative = camera.get("DistanceToSurfaceRelative", True)
        mode = 3 if inner.get("FollowTerrain") is True else 1 if relative else 2
    frames = {1: Frame.ABOVE_HOME, 2: Frame.ABOVE_SEA}
    return frames.get(mode, Frame.ABOVE_TERRAIN), height_m


def _landing(raw: dict[str, Any], where: str) -> list[MissionItem]:
    approach = raw.get("landingApproachCoordinate", raw.get("loiterCoordinate"))
    relative = raw.get("altitudesAreRelative", raw.get("landingAltitudeRelative", True))
    frame = Frame.ABOVE_HOME if relative else Frame.ABOVE_SEA
    items = []
    land: Any = raw.get("landCoordinate")
    ends = [(Command.WAYPOINT, approach), (Command.LAND, land)]
    for command, point in ends:
        lat, lon = _latlon(point, where)
        height = number_or_none(next(iter(point[2:]), None), where)
        items.append(MissionItem(command, frame, lat, lon, height))
    return items


def _latlon(point: Any, what: str) -> tuple[float, float]:
    return number(point[0], what), number(point[1], what)


def is_wpl(data: bytes) -> bool:
    return data.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"QGC WPL")


def read_wpl(data: bytes) -> list[Route]:
    lines = bounded_lines(io.StringIO(decoded(data).lstrip(), newline=None))
    try:
        first_line = next(lines)
        version = first_line.split()
        if version not in (["QGC", "WPL", "110"], ["QGC", "WPL", "120"]):
            raise RouteError(
                f"waypoint file must begin with 'QGC WPL 110', got {first_line.rstrip()!r:.60}"
            )
        items = list(_wpl_items(lines))
    except TableError as error:
        raise RouteError(f"waypoint file cannot be read ({error})") from error
    sets_home = 179
    homes = (0, Command.WAYPOINT, sets_home)
    if version[2] == "120" or not items or items[0].number or items[0].command not in homes:
        return [route_of(items, None)]
    first, *rest = items
    if first.frame != 0 and first.command == Command.WAYPOINT and _has_place(first):
        said = "item 0 is flown to, as it is in frame %d: a home position is in 0"
        log.warning(said, first.frame)
        return [route_of(items, replace(first, height_m=None))]  # not above the sea
    if any((each.frame, each.height_m) == (0, first.height_m) for each in rest):
        log.warning("item 0 is taken as the home position, which is not flown to")
    return [route_of(rest, first if _has_place(first) else None)]


def _wpl_items(lines: Iterator[str]) -> Iterator[MissionItem]:
    for count, line in enumerate(lines, 2):
        require_few_waypoints(count - 2)  # the first line is the home position
        if line.strip() and not line.startswith("#"):
            yield _wpl_item(line.split(), count)


def _wpl_item(values: list[str], line: int) -> MissionItem:
    if len(values) != 12:
        raise RouteError(f"line {line} of the waypoint file has {len(values)} values, expected 12")
    item, frame, command = (_whole(values[index], line) for index in (0, 2, 3))
    lat_deg, lon_deg, height_m = (
        parsed(values[index], f"line {line}, column {index + 1}") for index in (8, 9, 10)
    )
    return MissionItem(command, frame, lat_deg, lon_deg, height_m, item)


def _whole(text: str, line: int) -> int:
    what = f"line {line}: number, frame and command"
    value = parsed(text, what)
    if value != int(value):
        raise RouteError(f"{what} must be whole numbers, got {text!r:.40}")
    return int(value)
