"""A planned route, and the search band around it.

Read from GeoJSON (first LineString found) or CSV with columns `lat_deg,lon_deg`.
"""

import csv
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import MissingFileError, RouteError
from orthonav.geo.frames import LocalFrame

MAX_ROUTE_BYTES = 50_000_000


@dataclass(frozen=True)
class Route:
    """Waypoints of the planned trajectory as `(lat_deg, lon_deg)`, at least one."""

    waypoints: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        if not self.waypoints:
            raise RouteError("route has no waypoints")
        for lat, lon in self.waypoints:
            if not (math.isfinite(lat) and math.isfinite(lon) and abs(lat) <= 90):
                raise RouteError(
                    f"waypoint is not a latitude and longitude in degrees: {lat}, {lon}"
                )

    def points_en_m(self, frame: LocalFrame) -> NDArray[np.float64]:
        """Waypoints as local `(N, 2)` metres of `frame`."""
        lat_lon = np.array(self.waypoints, dtype=np.float64)
        return frame.en_from_latlon(lat_lon[:, 0], lat_lon[:, 1])


def read_route(path: Path) -> Route:
    """Read a route from a `.geojson`/`.json` or `.csv` file.

    Raises `MissingFileError` or `RouteError` (naming what was expected).
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"route file does not exist: {path}")
    if path.stat().st_size > MAX_ROUTE_BYTES:
        raise RouteError(f"route file is larger than {MAX_ROUTE_BYTES // 10**6} MB: {path}")
    readers = {".geojson": _read_geojson, ".json": _read_geojson, ".csv": _read_csv}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise RouteError(f"route must be .geojson, .json or .csv, got '{path.suffix}': {path}")
    try:
        return Route(tuple(reader(path.read_text(encoding="utf-8-sig"))))
    except RouteError as error:
        raise RouteError(f"{error}: {path}") from error
    except (ValueError, LookupError, TypeError, OverflowError, RecursionError, csv.Error) as error:
        raise RouteError(f"route cannot be read ({error!r}): {path}") from error
    except OSError as error:
        raise MissingFileError(f"route file cannot be read ({error.strerror}): {path}") from error


def _read_geojson(text: str) -> list[tuple[float, float]]:
    for geometry in _geometries(json.loads(text)):
        if geometry.get("type") == "LineString":
            return [_lat_lon_deg(point) for point in geometry["coordinates"]]
    raise RouteError("GeoJSON holds no LineString")


def _lat_lon_deg(point: Any) -> tuple[float, float]:
    """Latitude and longitude of a GeoJSON position, which must be numbers: `"12"` is not 1, 2."""
    numbers = isinstance(point, list) and all(type(value) in (int, float) for value in point[:2])
    if not numbers or len(point) < 2:
        raise RouteError(
            f"GeoJSON position must be [longitude, latitude] as numbers, got {point!r:.80}"
        )
    return float(point[1]), float(point[0])


def _geometries(node: Any) -> Iterator[dict[str, Any]]:
    """Geometries of a GeoJSON object, depth first, without recursion."""
    stack = [node]
    while stack:
        item = stack.pop()
        if not isinstance(item, dict):
            continue
        stack.extend(reversed(item.get("features") or item.get("geometries") or []))
        if item.get("type") == "Feature":
            stack.append(item.get("geometry"))
        yield item


def _read_csv(text: str) -> list[tuple[float, float]]:
    reader = csv.DictReader(text.splitlines())
    if not {"lat_deg", "lon_deg"} <= set(reader.fieldnames or ()):
        raise RouteError("route CSV needs the columns lat_deg,lon_deg")
    return [(float(row["lat_deg"]), float(row["lon_deg"])) for row in reader]


def distance_to_polyline_m(
    points_en_m: NDArray[np.float64], line_en_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Shortest distance in metres of `(N, 2)` points to a polyline of `(M, 2)` vertices, M >= 1."""
    starts = line_en_m[:-1] if len(line_en_m) > 1 else line_en_m
    ends = line_en_m[1:] if len(line_en_m) > 1 else line_en_m
    best = np.full(len(points_en_m), np.inf)
    for start, end in zip(starts, ends, strict=True):
        leg = end - start
        length2 = float(leg @ leg)
        along = (points_en_m - start) @ leg / length2 if length2 > 0 else np.zeros(len(points_en_m))
        foot = start + np.clip(along, 0, 1)[:, None] * leg
        best = np.minimum(best, np.linalg.norm(points_en_m - foot, axis=1))
    return best


def along_polyline_en_m(
    line_en_m: NDArray[np.float64], spacing_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions `(N, 2)` every `spacing_m` along a polyline and the course `(N,)` in degrees there.

    The first position is the first vertex; a route of one vertex gives one position, course 0.
    """
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
