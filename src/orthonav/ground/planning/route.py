"""A planned route: read from the file formats of ground stations, and its geometry.

The file name suffix selects the format."""

import csv
import io
import json
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MissingFileError, RouteError, described
from orthonav.core.files import require_file
from orthonav.core.geo.frames import distances_m
from orthonav.core.tables import MAX_LINE_CHARS, TableError, TableRows
from orthonav.ground.planning.markup import read_gpx, read_kml, read_kmz, read_wpml
from orthonav.ground.planning.mission import is_wpl, plan_route, read_wpl
from orthonav.ground.planning.record import (
    Height,
    HeightFrame,
    Route,
    decoded,
    json_object,
    listed,
    number,
    number_or_none,
    parsed,
    require_few_waypoints,
)

__all__ = ["Height", "Route", "along_polyline_en_m", "leg_lengths_m", "read_route"]

Array = NDArray[np.float64]
MAX_ROUTE_BYTES = 20_000_000  # twice 100,000 waypoints; JSON and XML take 20 times in memory
_BROKEN = (
    *(ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError),
    csv.Error,
)


def _routes_of(plain: dict[str, Any]) -> list[Route]:
    """Lines of GeoJSON (RFC 7946) with the properties `name`; `band_m`, a number or a list with one
    per leg (null: the default); `height_frame`, above what the third coordinate is (the RFC's
    ellipsoid is hardly ever meant, so without it that is unknown); `home_amsl_m`."""
    if crs := plain.get("crs"):  # of GeoJSON before RFC 7946
        properties = crs.get("properties", {}) if isinstance(crs, dict) else {}
        name = str(properties.get("name") or properties.get("href") or crs)
        if not re.search(r"(CRS84h?|WGS ?84|[:/](4326|4979|4258|4269|4283|7844))$", name):
            raise RouteError(
                f"GeoJSON is in {name:.60}: convert it to WGS 84 (ogr2ogr -t_srs EPSG:4326)"
            )
    found: list[Route] = []
    for geometry, properties in _geometries(plain):
        kind = geometry.get("type")
        if kind in ("LineString", "MultiLineString"):
            points = geometry["coordinates"]
            if kind == "MultiLineString":
                points = [point for part in points for point in part]
            found.append(_route(points, properties))
    if not found:
        raise RouteError("GeoJSON holds no LineString")
    return found


def to_geojson(routes: Sequence[Route]) -> str:
    features = [_feature(route) for route in routes]
    several = {"type": "FeatureCollection", "features": features}
    plain = features[0] if len(features) == 1 else several
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
    name, bands = properties.get("name"), properties.get("band_m")
    if not isinstance(bands, list):
        bands = [] if bands is None else [bands] * max(1, len(points) - 1)
    return Route(
        tuple((lat, lon) for lat, lon, _ in points),
        heights,
        tuple(number_or_none(each, "band_m") for each in bands),
        name if isinstance(name, str) else None,
        number_or_none(properties.get("home_amsl_m"), "home_amsl_m"),
    )


def _position(point: Any) -> tuple[float, float, float | None]:
    lon, lat, *rest = (number(value, "GeoJSON position") for value in point[:3])
    return lat, lon, rest[0] if rest else None


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


_HEIGHTS: tuple[tuple[HeightFrame | None, tuple[str, ...]], ...] = (
    ("agl", ("agl_m", "agl", "altitude_agl_m", "altitudeagl")),
    ("home", ("home_m", "height_above_home_m")),
    ("amsl", ("amsl_m", "amsl", "altitude_amsl_m", "altitudeamsl")),
    ("hae", ("hae_m",)),
    (None, ("alt_m", "alt", "altitude_m", "altitude", "height_m", "height", "ele")),
)
_UNIT = re.compile(r"(?<!\s)\s*[(\[]\s*([a-z]+)\.?\s*[)\]]$")  # as in altitude(m)
_Values = Callable[[str], list[float | None]]


def _read_delimited(data: bytes) -> list[Route]:
    stream = io.StringIO(decoded(data), newline=None)
    header = stream.readline(MAX_LINE_CHARS)
    stream.seek(0)
    delimiter = max(",;\t", key=header.count)
    try:
        table = TableRows(stream, delimiter=delimiter)
        names = {_UNIT.sub("", name.strip().lower()): name for name in table.columns}
        rows = []
        for row in table:
            rows.append(row)
            require_few_waypoints(len(rows))
    except TableError as error:
        raise RouteError(f"route table cannot be read ({error})") from error
    lat = _first(names, "lat_deg", "lat", "latitude", "latitude_deg")
    lon = _first(names, "lon_deg", "lon", "lng", "long", "longitude", "longitude_deg")
    if lat is None or lon is None:
        raise RouteError(
            "route CSV needs the columns lat_deg,lon_deg (or lat,lon or latitude,longitude), got "
            f"{','.join(names) or 'none'!s:.80}"
        )

    def values(name: str) -> list[float | None]:
        found = []
        for line, row in enumerate(rows, 2):
            text = row.get(names[name]) or ""
            if delimiter != "," and "." not in text:
                text = text.replace(",", ".")
            what = f"route table cannot be read: row {line}, {names[name]}"
            found.append(parsed(text, what) if name in (lat, lon) or text.strip() else None)
        return found

    waypoints = tuple((a or 0.0, b or 0.0) for a, b in zip(values(lat), values(lon), strict=True))
    bands = values("band_m") if "band_m" in names else []
    return [Route(waypoints, _heights(names, values), tuple(bands[:-1] if bands[1:] else bands))]


def _first(names: dict[str, str], *aliases: str) -> str | None:
    """The first alias that is a column."""
    return next((each for each in aliases if each in names), None)


def _heights(names: dict[str, str], values: _Values) -> tuple[Height | None, ...]:
    known = ((frame, name) for frame, aliases in _HEIGHTS for name in aliases if name in names)
    frame, name = next(known, (None, None))
    if name is None:
        return ()
    factor = _metres(names[name])
    heights = values(name)
    frames = [frame] * len(heights)
    mode = _first(names, "altitudemode", "altitude_mode")  # of Litchi
    if frame is None and mode is not None:
        modes = values(mode)
        if not {None, 0, 1}.issuperset(modes):
            raise RouteError(f"{names[mode]} must be 0 (above take-off) or 1 (above ground)")
        of_modes: dict[float | None, HeightFrame] = {0: "home", 1: "agl"}
        frames = [of_modes.get(each) for each in modes]
    return tuple(
        None if height is None else Height(factor * height, each)
        for height, each in zip(heights, frames, strict=True)
    )


def _metres(column: str) -> float:
    """The unit that the name of a column states, in metres; metres without one."""
    unit = _UNIT.search(column.strip().lower())
    if unit is None or unit[1] in ("m", "meter", "meters"):
        return 1.0
    if unit[1] in ("ft", "feet"):
        return 0.3048
    raise RouteError(f"heights must be in m or ft, got the column {column!r:.60}")


def _read_json(data: bytes) -> list[Route]:
    plain = json_object(data)
    return [plan_route(plain)] if plain.get("fileType") == "Plan" else _routes_of(plain)


def _read_text(data: bytes) -> list[Route]:
    return read_wpl(data) if is_wpl(data) else _read_delimited(data)


_READERS: dict[str, Callable[[bytes], list[Route]]] = {
    ".geojson": lambda data: _routes_of(json_object(data)),
    ".json": _read_json,
    ".csv": _read_text,
    ".tsv": _read_text,
    ".txt": _read_text,
    ".waypoints": read_wpl,
    ".plan": lambda data: [plan_route(json_object(data))],
    ".kml": read_kml,
    ".kmz": read_kmz,
    ".wpml": read_wpml,
    ".gpx": read_gpx,
}


def read_route(path: Path) -> Route:
    """`FILE#NAME` selects a line by its name, or else its number from 1. Raises `MissingFileError`
    or `RouteError`."""
    path, name = Path(path), ""
    if "#" in str(path) and not path.exists():
        file, _, name = str(path).partition("#")
        path = Path(file)
    require_file(path, "route file")
    if path.stat().st_size > MAX_ROUTE_BYTES:
        raise RouteError(f"route file is larger than {MAX_ROUTE_BYTES // 10**6} MB: {path}")
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        raise RouteError(f"route must be one of {', '.join(_READERS)}, got '{path.suffix}': {path}")
    try:
        route = _chosen(_READERS[suffix](path.read_bytes()), name)
    except RouteError as error:
        raise RouteError(f"{error}: {path}") from error
    except OSError as error:
        raise MissingFileError(f"route file cannot be read ({error.strerror}): {path}") from error
    except _BROKEN as error:
        raise RouteError(f"route cannot be read ({described(error)}): {path}") from error
    in_radians = all(abs(lat) < 1.6 and abs(lon) < 3.2 for lat, lon in route.waypoints)
    if in_radians or (0.0, 0.0) in route.waypoints:
        raise RouteError(
            "waypoints lie at or around 0, 0, in the sea: give degrees, not radians, and no "
            f"waypoints without a position: {path}"
        )
    return route


def _chosen(found: list[Route], name: str) -> Route:
    """The line of that name, else of that number, from 1; without a name the only one."""
    fitting = [route for route in found if name in ("", route.name)]
    if not fitting and re.fullmatch(r"0*[1-9][0-9]{,8}", name):
        fitting = found[int(name) - 1 : int(name)]
    if len(fitting) == 1:
        return fitting[0]
    problem = f"file holds {len(found)} lines"
    if name:
        problem = f"{len(fitting)} lines are named {name!r:.60}"
    named = (f"{route.name!r:.60}" if route.name else "(no name)" for route in found)
    lines = listed([f"{number} {each}" for number, each in enumerate(named, 1)], 20)
    raise RouteError(f"{problem}; give FILE#NAME or FILE#NUMBER: {lines}")


def leg_lengths_m(route: Route) -> Array:
    """Length in metres of each leg of a route, along the ellipsoid; `[0]` for one waypoint."""
    places = np.array(route.waypoints)
    return distances_m(places[:-1], places[1:]) if len(places) > 1 else np.zeros(1)


def along_polyline_en_m(line_en_m: Array, spacing_m: float) -> tuple[Array, Array]:
    """Positions `(N, 2)` every `spacing_m` along a polyline, and the course `(N,)` in degrees. The
    first position is the first vertex; a route of one vertex gives one position, course 0."""
    legs = np.diff(line_en_m, axis=0)
    lengths = np.linalg.norm(legs, axis=1)
    keep = lengths > 0
    if not keep.any():
        return line_en_m[:1].copy(), np.zeros(1)
    legs, lengths, starts = legs[keep], lengths[keep], line_en_m[:-1][keep]
    ends = np.cumsum(lengths)
    at = np.arange(0.0, ends[-1] + 1e-9, spacing_m)
    leg = np.minimum(np.searchsorted(ends, at, side="left"), len(lengths) - 1)
    share = (at - (ends[leg] - lengths[leg])) / lengths[leg]
    positions = starts[leg] + share[:, None] * legs[leg]
    course = np.degrees(np.arctan2(legs[leg, 0], legs[leg, 1])) % 360
    return positions, course
