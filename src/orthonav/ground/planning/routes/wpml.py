"""Waylines of DJI's waypoint missions (WPML: waylines.wpml, by itself or in a KMZ).

https://developer.dji.com/doc/cloud-api-tutorial/en/api-reference/dji-wpml/waylines-wpml.html
"""

from collections.abc import Iterator
from xml.etree.ElementTree import Element

from orthonav.core.errors import RouteError
from orthonav.ground.planning.routes.markup import read_markup, text_of
from orthonav.ground.planning.routes.record import Height, HeightFrame, Route, require_few_waypoints
from orthonav.ground.planning.routes.values import numbers_in, parsed

_HEIGHT_FRAMES: dict[str, HeightFrame] = {
    "relativeToStartPoint": "home",
    "WGS84": "hae",
    "realTimeFollowSurface": "agl",
}
"""By `executeHeightMode`."""


def read_wpml(data: bytes) -> list[Route]:
    """The waylines of a mission, one route per folder, their waypoints by index.

    Raises `RouteError`, also for a height mode that is not known.
    """
    root = read_markup(data, "WPML")
    if root.tag != "kml":
        raise RouteError(f"WPML must begin with <kml>, got <{root.tag:.40}>")
    folders = list(root.iter("Folder"))
    found = [route for folder in folders for route in _routes(folder)]
    if not found:
        raise RouteError("WPML holds no wayline with waypoints")
    read = {mark for folder in folders for mark in _waypoints(folder)}
    lost = [mark for mark in root.iter("Placemark") if _has_point(mark) and mark not in read]
    points = [
        (f"placemark {text_of(mark, 'index') or '(no index)':.40}", _numbers(mark)) for mark in lost
    ]
    return [route.leaving_out(points) for route in found]


def _numbers(mark: Element) -> list[float]:
    return numbers_in(mark.findtext("Point/coordinates") or "")


def _has_point(mark: Element) -> bool:
    return mark.find("Point") is not None


def _waypoints(folder: Element) -> list[Element]:
    return [mark for mark in folder.iterfind("Placemark") if _has_point(mark)]


def _routes(folder: Element) -> Iterator[Route]:
    mode = text_of(folder, "executeHeightMode")
    if mode is not None and mode not in _HEIGHT_FRAMES:
        raise RouteError(
            f"WPML executeHeightMode must be {', '.join(_HEIGHT_FRAMES)}, got {mode!r:.60}"
        )
    frame = None if mode is None else _HEIGHT_FRAMES[mode]
    marks = _waypoints(folder)
    require_few_waypoints(len(marks))
    marks.sort(key=_index)
    if marks:
        heights = tuple(_height(mark, frame) for mark in marks)
        yield Route(
            tuple(map(_latlon, marks)),
            heights if any(heights) else (),
            name=text_of(folder, "waylineId"),
        )


def _index(mark: Element) -> float:
    return parsed(text_of(mark, "index") or "", "WPML index")


def _latlon(mark: Element) -> tuple[float, float]:
    point = mark.find("Point")
    values = (text_of(point, "coordinates") or "" if point is not None else "").split(",")
    if not 2 <= len(values) <= 3:
        raise RouteError(f"WPML position must be longitude,latitude, got {values!r:.60}")
    lon, lat = (parsed(value, "WPML position") for value in values[:2])
    return lat, lon


def _height(mark: Element, frame: HeightFrame | None) -> Height | None:
    """The height that is flown; the third coordinate of the point is not."""
    text = text_of(mark, "executeHeight")
    return None if text is None else Height(parsed(text, "WPML executeHeight"), frame)
