"""What a check found as shapes in longitude and latitude, one layer per kind."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthonav.check.outcome import Along, CheckResult
from orthonav.check.write.risk import ALL_RISKS, risk_of
from orthonav.extras import needed
from orthonav.geo.frames import LocalFrame

Array = NDArray[np.float64]
_STEP_M = 1000.0
"""Legs get a vertex at least this often: they are straight in the plane, not in degrees."""


@dataclass(frozen=True, eq=False)
class Layer:
    """Features of one kind: a shape (shapely, None where it has none) and a column per attribute.

    `kind` is the type of its shapes as OGR calls it.
    """

    name: str
    kind: str
    shapes: Sequence[Any]
    columns: Mapping[str, NDArray[Any]]


def layers(result: CheckResult) -> list[Layer]:
    """All layers, those of the route only where there is one.

    Raises `MissingExtraError` without shapely.
    """
    needed("shapely", "geo", "writing a check")
    found = [_cells(result)]
    if result.along is not None:
        found += [_route(result, result.along), _blind(result, result.along)]
    found.append(_lookalikes(result))
    if result.route_en_m is not None:
        found += [_legs(result, result.route_en_m), _waypoints(result, result.route_en_m)]
    return found


def _cells(result: CheckResult) -> Layer:
    """A square for every cell of which something is known."""
    import shapely

    cells = result.cells
    known = np.isfinite(cells.probability) | (cells.trials > 0) | np.isfinite(cells.texture)
    rows, cols = np.nonzero(known)
    around = np.array([(0, 0), (0, 1), (1, 1), (1, 0), (0, 0)])  # (column, row), anticlockwise
    east = cells.west_m + (cols[:, None] + around[:, 0]) * cells.side_m
    north = cells.north_m - (rows[:, None] + around[:, 1]) * cells.side_m
    rings = _lonlat(result.frame, np.stack([east, north], axis=-1))
    columns: dict[str, NDArray[Any]] = {"row": rows.astype(np.int32), "col": cols.astype(np.int32)}
    for name in ("probability", "low", "high", "error_m", "wrong", "trials", "texture"):
        values = getattr(cells, name)[known]
        columns[name] = values.astype(np.int32) if name == "trials" else _decimals(values)
    return Layer("cells", "Polygon", shapely.polygons(rings) if len(rings) else [], columns)


def _route(result: CheckResult, along: Along) -> Layer:
    """A line from each point to the next, with the worse figures of the two."""
    from shapely import linestrings

    start = np.arange(len(along.distance_m) - 1)
    pairs = np.stack([along.points_en_m[:-1], along.points_en_m[1:]], axis=1)
    probability = np.minimum(along.probability[:-1], along.probability[1:])
    speed = result.conditions.speed_mps
    columns: dict[str, NDArray[Any]] = {
        "number": (start + 1).astype(np.int32),
        "distance_m": _decimals(along.distance_m[:-1], 1),
        "end_m": _decimals(along.distance_m[1:], 1),
        "time_s": _decimals(along.distance_m[:-1] / speed, 1),
        "probability": _decimals(probability),
        "across_low": _decimals(np.minimum(along.across_low[:-1], along.across_low[1:])),
        "error_m": _decimals(np.maximum(along.error_m[:-1], along.error_m[1:])),
        "drift_m": _decimals(np.maximum(along.drift_m[:-1], along.drift_m[1:])),
        "risk": np.array([ALL_RISKS[risk_of(each)].name for each in probability], dtype=object),
    }
    lines = linestrings(_lonlat(result.frame, pairs)) if len(pairs) else []
    return Layer("route", "LineString", lines, columns)


def _blind(result: CheckResult, along: Along) -> Layer:
    from shapely import LineString

    found = result.stretches
    shapes: list[Any] = []
    for each in found:
        line = stretch_en_m(along, each.start_m, each.end_m)
        shapes.append(LineString(_lonlat(result.frame, line)) if len(line) > 1 else None)
    names = ("start_m", "end_m", "length_m", "start_s", "end_s")
    columns: dict[str, NDArray[Any]] = {"number": np.arange(1, len(found) + 1, dtype=np.int32)}
    for name in (*names, "probability", "drift_m", "allowed_m"):
        columns[name] = _decimals([getattr(each, name) for each in found])
    columns["bearable"] = np.array([each.bearable for each in found], dtype=bool)
    columns["ends_lost"] = np.array([each.ends_lost for each in found], dtype=bool)
    return Layer("blind", "LineString", shapes, columns)


def stretch_en_m(along: Along, start_m: float, end_m: float) -> Array:
    """The route (N, 2) between two distances from its start; no points where these are one."""
    distance = along.distance_m
    start_m, end_m = np.clip([start_m, end_m], distance[0], distance[-1])
    if not end_m > start_m:
        return np.empty((0, 2))
    inside = (distance > start_m) & (distance < end_m)
    at = np.concatenate([[start_m], distance[inside], [end_m]])
    return np.stack([np.interp(at, distance, axis) for axis in along.points_en_m.T], axis=1)


def _lookalikes(result: CheckResult) -> Layer:
    from shapely import LineString

    found = result.lookalikes
    shapes = [
        LineString([each.place_latlon_deg[::-1], each.other_latlon_deg[::-1]]) for each in found
    ]
    columns: dict[str, NDArray[Any]] = {
        "number": np.arange(1, len(found) + 1, dtype=np.int32),
        "apart_m": _decimals([each.apart_m for each in found], 1),
        "likeness": _decimals([each.likeness for each in found]),
        "trials": np.array([each.trials for each in found], dtype=np.int32),
        "within_prior": np.array([each.within_prior for each in found], dtype=bool),
    }
    return Layer("lookalikes", "LineString", shapes, columns)


def _legs(result: CheckResult, waypoints: Array) -> Layer:
    from shapely import LineString

    frame = result.frame
    steps = np.diff(waypoints, axis=0)
    lengths = np.hypot(*steps.T)
    shapes = []
    for start, step, length in zip(waypoints, steps, lengths, strict=False):
        at = np.linspace(0, 1, max(2, int(np.ceil(length / _STEP_M)) + 1))
        shapes.append(LineString(_lonlat(frame, start + at[:, None] * step)))
    columns: dict[str, NDArray[Any]] = {
        "number": np.arange(1, len(steps) + 1, dtype=np.int32),
        "length_m": _decimals(lengths, 1),
        "bearing_deg": _decimals(np.degrees(np.arctan2(steps[:, 0], steps[:, 1])) % 360, 1),
    }
    return Layer("legs", "LineString", shapes, columns)


def _waypoints(result: CheckResult, waypoints: Array) -> Layer:
    from shapely import points

    lengths = np.hypot(*np.diff(waypoints, axis=0).T)
    columns: dict[str, NDArray[Any]] = {
        "number": np.arange(1, len(waypoints) + 1, dtype=np.int32),
        "distance_m": _decimals(np.concatenate([[0.0], np.cumsum(lengths)]), 1),
    }
    return Layer("waypoints", "Point", points(_lonlat(result.frame, waypoints)), columns)


def _lonlat(frame: LocalFrame, positions_en_m: ArrayLike) -> Array:
    """Longitude and latitude (..., 2) in degrees, without a jump at the date line."""
    lat, lon = frame.latlon_from_en(positions_en_m)
    lon = frame.lon_deg + (lon - frame.lon_deg + 180) % 360 - 180
    return np.asarray(np.round(np.stack([lon, lat], axis=-1), 8), dtype=np.float64)


def _decimals(values: ArrayLike, digits: int = 3) -> Array:
    return np.asarray(np.round(np.asarray(values, dtype=np.float64), digits), dtype=np.float64)
