"""Waypoint files of Mission Planner and other ground stations: text that begins "QGC WPL 110".

A line an item, twelve numbers: index, current, frame, command, four parameters, latitude,
longitude, altitude, autocontinue (mavlink.io, "Mission Plain-Text File Format"). In version 110 the
first item, with number 0, is the planned home position, in the older 120 of QGroundControl there is
none (QGroundControl, `MissionController::_loadTextMissionFile`).
"""

import io
from collections.abc import Iterator

from orthonav.core.errors import RouteError
from orthonav.core.tables import TableError, bounded_lines
from orthonav.ground.planning.routes.mission import WAYPOINT, Home, MissionItem, route_of
from orthonav.ground.planning.routes.record import Route, require_few_waypoints
from orthonav.ground.planning.routes.values import decoded, parsed

_COLUMNS = 12
_MAGIC = b"QGC WPL"
_HOMES = (0, WAYPOINT, 179)
"""Commands of the home position: none, a waypoint, or one that sets it."""


def is_wpl(data: bytes) -> bool:
    """Whether a file begins like a waypoint file."""
    return data.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(_MAGIC)


def read_wpl(data: bytes) -> list[Route]:
    """The route of a waypoint file. Raises `RouteError`."""
    lines = bounded_lines(io.StringIO(decoded(data).lstrip(), newline=None))
    try:
        first_line = next(lines)
        version = first_line.split()
        if version not in (["QGC", "WPL", "110"], ["QGC", "WPL", "120"]):
            raise RouteError(
                f"waypoint file must begin with 'QGC WPL 110', got {first_line.rstrip()!r:.60}"
            )
        items = list(_items(lines))
    except TableError as error:
        raise RouteError(f"waypoint file cannot be read ({error})") from error
    home = None
    if version[2] == "110" and items and items[0].number == 0 and items[0].command in _HOMES:
        first, *items = items
        if first.lat_deg or first.lon_deg:
            home = Home(first.lat_deg or 0.0, first.lon_deg or 0.0, first.height_m)
    return [route_of(items, home)]


def _items(lines: Iterator[str]) -> Iterator[MissionItem]:
    for number, line in enumerate(lines, 2):
        require_few_waypoints(number - 2)  # the first line is the home position
        if line.strip() and not line.startswith("#"):
            yield _item(line.split(), number)


def _item(values: list[str], line: int) -> MissionItem:
    if len(values) != _COLUMNS:
        raise RouteError(
            f"line {line} of the waypoint file has {len(values)} values, expected {_COLUMNS}"
        )
    number, frame, command = (_whole(values[index], line) for index in (0, 2, 3))
    lat_deg, lon_deg, height_m = (
        parsed(values[index], f"line {line}, column {index + 1}") for index in (8, 9, 10)
    )
    return MissionItem(command, frame, lat_deg, lon_deg, height_m, number)


def _whole(text: str, line: int) -> int:
    what = f"line {line}: number, frame and command"
    value = parsed(text, what)
    if value != int(value):
        raise RouteError(f"{what} must be whole numbers, got {text!r:.40}")
    return int(value)
