"""Plans of QGroundControl (`.plan`, JSON).

Source: QGroundControl developer guide, "Plan File Format", and where that is silent the code that
writes and reads it (`MissionItem`, `SimpleMissionItem`, `TransectStyleComplexItem`, `CameraCalc`,
`CorridorScanComplexItem`, `LandingComplexItem`).
"""

from typing import Any

from orthonav.core.errors import RouteError
from orthonav.ground.planning.routes.mission import LAND, WAYPOINT, Home, MissionItem, route_of
from orthonav.ground.planning.routes.record import Route
from orthonav.ground.planning.routes.values import json_object, number, number_or_none

_AMSL, _ABOVE_HOME, _TERRAIN = 0, 3, 10
_FRAME_OF_MODE = {1: _ABOVE_HOME, 2: _AMSL, 3: _TERRAIN, 4: _TERRAIN}
"""MAV_FRAME of QGroundControl's altitude modes; 3 is its own sum of terrain and a height."""
_ABOVE_TERRAIN_MODE = 3
_TRANSECTS = ("survey", "CorridorScan")
_LANDINGS = ("fwLandingPattern", "vtolLandingPattern")


def read_plan(data: bytes) -> list[Route]:
    """The route of a plan. Raises `RouteError`, naming items that cannot be flown with a map."""
    return [plan_route(json_object(data))]


def is_plan(plain: dict[str, Any]) -> bool:
    """Whether a JSON object is a plan."""
    return plain.get("fileType") == "Plan"


def plan_route(plain: dict[str, Any]) -> Route:
    """The route of a plan read as JSON. Raises `RouteError`."""
    if not is_plan(plain):
        raise RouteError(f"plan must have fileType 'Plan', got {plain.get('fileType')!r:.40}")
    mission = plain.get("mission")
    items = mission.get("items") if isinstance(mission, dict) else None
    if not isinstance(mission, dict) or not isinstance(items, list):
        raise RouteError("plan must hold a mission with a list of items")
    home = _home(mission.get("plannedHomePosition"))
    flown = [item for index, raw in enumerate(items) for item in _items(raw, index)]
    return route_of(flown, home)


def _home(raw: Any) -> Home | None:
    if not isinstance(raw, list) or len(raw) < 2:
        return None
    lat, lon = (number(raw[index], "plannedHomePosition") for index in (0, 1))
    if lat == 0 and lon == 0:
        return None
    return Home(lat, lon, number_or_none(raw[2] if len(raw) > 2 else None, "height of home"))


def _items(raw: Any, index: int) -> list[MissionItem]:
    where = f"item {index + 1} of the plan"
    if not isinstance(raw, dict):
        raise RouteError(f"{where} must be an object, got {raw!r:.60}")
    kind = raw.get("type")
    if kind == "SimpleItem":
        return [_simple(raw, index + 1, where)]
    if kind != "ComplexItem":
        raise RouteError(f"{where} must be a SimpleItem or a ComplexItem, got {kind!r:.40}")
    name = raw.get("complexItemType")
    if name in _TRANSECTS:
        return _transects(raw, index, f"{where} ({name})")
    if name in _LANDINGS:
        return _landing(raw, f"{where} ({name})")
    raise RouteError(
        f"{where} is a {name!r:.40}: only surveys, corridor scans and landing patterns are read "
        "besides waypoints, because in others the camera does not look down; remove it from the "
        "plan"
    )


def _simple(raw: dict[str, Any], item: int, where: str) -> MissionItem:
    params = raw.get("params")
    place = params[4:7] if isinstance(params, list) and len(params) >= 7 else raw.get("coordinate")
    if not isinstance(place, list) or len(place) < 3:
        raise RouteError(f"{where} must have 7 params, got {params!r:.80}")
    command, frame = (int(number(raw.get(key), f"{where}: {key}")) for key in ("command", "frame"))
    lat, lon, height = (number_or_none(value, f"{where}: params") for value in place[:3])
    if raw.get("AltitudeMode") == _ABOVE_TERRAIN_MODE:
        frame, height = _TERRAIN, number_or_none(raw.get("Altitude"), f"{where}: Altitude")
    return MissionItem(command, frame, lat, lon, height, item)


def _transects(raw: dict[str, Any], index: int, where: str) -> list[MissionItem]:
    """Flight lines of a survey or corridor scan; the corridor width is the band of its legs."""
    inner = raw.get("TransectStyleComplexItem")
    points = inner.get("VisualTransectPoints") if isinstance(inner, dict) else None
    if not isinstance(inner, dict) or not isinstance(points, list) or not points:
        raise RouteError(
            f"{where} has no VisualTransectPoints; open the plan with a later QGroundControl, let "
            "it draw the flight lines, and save it"
        )
    camera = inner.get("CameraCalc")
    frame, height_m = _survey_height(camera if isinstance(camera, dict) else {}, inner, where)
    width_m = number_or_none(raw.get("CorridorWidth"), f"{where}: CorridorWidth") or None
    items = []
    for point in points:
        lat, lon = _place(point, f"{where}: VisualTransectPoints")
        items.append(
            MissionItem(WAYPOINT, frame, lat, lon, height_m, pattern=index, band_m=width_m)
        )
    return items


def _survey_height(
    camera: dict[str, Any], inner: dict[str, Any], where: str
) -> tuple[int, float | None]:
    """MAV_FRAME and height of a survey, from its camera calculation."""
    height_m = number_or_none(camera.get("DistanceToSurface"), f"{where}: DistanceToSurface")
    mode = camera.get("DistanceMode")
    if mode in _FRAME_OF_MODE:
        return _FRAME_OF_MODE[mode], height_m
    if inner.get("FollowTerrain") is True:
        return _TERRAIN, height_m
    return (_ABOVE_HOME if camera.get("DistanceToSurfaceRelative", True) else _AMSL), height_m


def _landing(raw: dict[str, Any], where: str) -> list[MissionItem]:
    approach = raw.get("landingApproachCoordinate", raw.get("loiterCoordinate"))
    relative = raw.get("altitudesAreRelative", raw.get("landingAltitudeRelative", True))
    frame = _ABOVE_HOME if relative else _AMSL
    items = []
    ends: list[tuple[int, Any]] = [(WAYPOINT, approach), (LAND, raw.get("landCoordinate"))]
    for command, point in ends:
        lat, lon = _place(point, where)
        height = number_or_none(next(iter(point[2:]), None), where)
        items.append(MissionItem(command, frame, lat, lon, height))
    return items


def _place(point: Any, what: str) -> tuple[float, float]:
    if not isinstance(point, list) or len(point) < 2:
        raise RouteError(f"{what} must be [latitude, longitude], got {point!r:.60}")
    return number(point[0], what), number(point[1], what)
