"""Routes as GPX 1.0 and 1.1 (topografix.com/GPX/1/1): routes, else tracks."""

from collections.abc import Iterable
from xml.etree.ElementTree import Element

from orthonav.core.errors import RouteError
from orthonav.ground.planning.routes.markup import read_markup, text_of
from orthonav.ground.planning.routes.record import Height, Route
from orthonav.ground.planning.routes.values import numbers_in, parsed


def read_gpx(data: bytes) -> list[Route]:
    """All routes (`rte`), and after them all tracks (`trk`), the segments of each joined.

    Heights are above mean sea level. Raises `RouteError` where there are only waypoints.
    """
    root = read_markup(data, "GPX")
    if root.tag != "gpx":
        raise RouteError(f"GPX must begin with <gpx>, got <{root.tag:.40}>")
    routes = [_route(each, each.iterfind("rtept")) for each in root.iterfind("rte")]
    tracks = [_route(each, each.iterfind("trkseg/trkpt")) for each in root.iterfind("trk")]
    found = [route for route in routes + tracks if route is not None]
    if not found:
        waypoints = len(root.findall("wpt"))
        held = f"only {waypoints} waypoints (wpt) without an order" if waypoints else "nothing else"
        raise RouteError(f"GPX holds no route (rte) and no track (trk); it holds {held}")
    # Planned routes take precedence over recorded tracks.
    planned = [route for route in routes if route is not None]
    points = [
        (f"waypoint {_name(each)}", numbers_in(f"{each.get('lon')},{each.get('lat')}"))
        for each in root.iterfind("wpt")
    ]
    points += [(f"track {_name(each)}", []) for each in root.iterfind("trk") if planned]
    return [route.leaving_out(points) for route in planned or found]


def _name(element: Element) -> str:
    return f"{text_of(element, 'name') or '(no name)':.40}"


def _route(element: Element, points: Iterable[Element]) -> Route | None:
    waypoints, heights = [], []
    for point in points:
        lat, lon = (_degrees(point, name) for name in ("lat", "lon"))
        waypoints.append((lat, lon))
        height = text_of(point, "ele")
        heights.append(None if height is None else Height(parsed(height, "GPX ele"), "amsl"))
    if not waypoints:
        return None
    return Route(
        tuple(waypoints), tuple(heights) if any(heights) else (), name=text_of(element, "name")
    )


def _degrees(point: Element, name: str) -> float:
    value = point.get(name)
    if value is None:
        raise RouteError(f"GPX point has no {name}")
    return parsed(value, f"GPX {name}")
