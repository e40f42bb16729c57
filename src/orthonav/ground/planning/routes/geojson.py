"""Routes as GeoJSON (RFC 7946): LineStrings, and the properties that orthonav reads and writes.

Properties of a feature: `name`; `band_m`, a number or a list with one per leg (null: the default);
`height_frame`, above what the third coordinate is ("agl", "home", "amsl", "hae"; the RFC's
ellipsoid is hardly ever meant, so without it that is taken as not said); `home_amsl_m`.
"""

import json
from collections.abc import Iterator, Sequence
from typing import Any

from orthonav.core.errors import RouteError
from orthonav.ground.planning.routes.record import (
    Height,
    Route,
    json_object,
    number,
    number_or_none,
    require_few_waypoints,
)


def read_geojson(data: bytes) -> list[Route]:
    return routes_of(json_object(data))


def routes_of(plain: dict[str, Any]) -> list[Route]:
    found: list[Route] = []
    others: list[tuple[str, str, Any]] = []
    for geometry, properties in _geometries(plain):
        kind = geometry.get("type")
        if kind == "LineString":
            found.append(_route(geometry["coordinates"], properties))
        elif kind == "MultiLineString":
            joined = [point for part in geometry["coordinates"] for point in part]
            found.append(_route(joined, properties))
        elif kind not in ("Feature", "FeatureCollection", "GeometryCollection"):
            name = f"{kind!s:.40} {properties.get('name') or '(no name)'!s:.40}"
            others.append((str(kind)[:40], name, geometry.get("coordinates")))
    if not found:
        kinds = sorted({kind for kind, _, _ in others})
        held = f"it holds {', '.join(kinds)}" if kinds else "it is empty"
        raise RouteError(f"GeoJSON holds no LineString; {held}")
    points = [
        (name, place if kind == "Point" and _is_place(place) else [])
        for kind, name, place in others
        if kind in ("Point", "MultiPoint")
    ]
    return [route.leaving_out(points) for route in found]


def _is_place(place: Any) -> bool:
    return isinstance(place, list) and all(type(each) in (int, float) for each in place)


def to_geojson(routes: Sequence[Route]) -> str:
    features = [_feature(route) for route in routes]
    collection = {"type": "FeatureCollection", "features": features}
    plain = features[0] if len(features) == 1 else collection
    return json.dumps(plain, allow_nan=False) + "\n"


def _feature(route: Route) -> dict[str, Any]:
    coordinates = [[lon, lat] for lat, lon in route.waypoints]
    properties: dict[str, Any] = {}
    if route.name is not None:
        properties["name"] = route.name
    if route.leg_bands_m:
        same = len(set(route.leg_bands_m)) == 1 and route.leg_bands_m[0] is not None
        properties["band_m"] = route.leg_bands_m[0] if same else list(route.leg_bands_m)
    heights = [height for height in route.heights if height is not None]
    if heights and len(heights) == len(route.waypoints):
        coordinates = [
            [*point, height.height_m] for point, height in zip(coordinates, heights, strict=True)
        ]
        frames = [height.frame for height in heights]
        if any(frames):
            properties["height_frame"] = frames[0] if len(set(frames)) == 1 else frames
    if route.home_amsl_m is not None:
        properties["home_amsl_m"] = route.home_amsl_m
    geometry = {"type": "LineString", "coordinates": coordinates}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def _route(coordinates: Any, properties: dict[str, Any]) -> Route:
    if not isinstance(coordinates, list):
        raise RouteError(f"GeoJSON position must be in a list as numbers, got {coordinates!r:.80}")
    require_few_waypoints(len(coordinates))
    points = [_position(point) for point in coordinates]
    frames = properties.get("height_frame")
    if not isinstance(frames, list):
        frames = [frames] * len(points)
    if len(frames) != len(points):
        raise RouteError(f"height_frame has {len(frames)} entries for {len(points)} waypoints")
    heights = tuple(
        None if height is None else Height(height, frame)
        for (_, _, height), frame in zip(points, frames, strict=True)
    )
    name = properties.get("name")
    return Route(
        tuple((lat, lon) for lat, lon, _ in points),
        heights,
        _bands_m(properties.get("band_m"), max(1, len(points) - 1)),
        name if isinstance(name, str) else None,
        number_or_none(properties.get("home_amsl_m"), "home_amsl_m"),
    )


def _bands_m(band: Any, legs: int) -> tuple[float | None, ...]:
    if band is None:
        return ()
    if isinstance(band, list):
        return tuple(number_or_none(each, "band_m of a leg") for each in band)
    return (number(band, "band_m"),) * legs


def _position(point: Any) -> tuple[float, float, float | None]:
    numbers = isinstance(point, list) and all(type(value) in (int, float) for value in point[:3])
    if not numbers or len(point) < 2:
        raise RouteError(
            f"GeoJSON position must be [longitude, latitude] as numbers, got {point!r:.80}"
        )
    return float(point[1]), float(point[0]), float(point[2]) if len(point) > 2 else None


def _geometries(node: Any) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    stack: list[tuple[Any, dict[str, Any]]] = [(node, {})]
    while stack:
        item, properties = stack.pop()
        if not isinstance(item, dict):
            continue
        if item.get("type") == "Feature":
            own = item.get("properties")
            properties = own if isinstance(own, dict) else {}
            stack.append((item.get("geometry"), properties))
        within = item.get("features") or item.get("geometries") or []
        stack.extend((each, properties) for each in reversed(within))
        yield item, properties
