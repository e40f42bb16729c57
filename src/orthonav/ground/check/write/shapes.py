"""The shapes of a check as one GeoJSON (RFC 7946): the property `layer` names the kind of each."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.check.outcome import CELL_VALUES, Along, CheckResult
from orthonav.ground.check.write.plain import Plain, lookalikes_to_plain, plain, stretches_to_plain
from orthonav.ground.check.write.risk import RISKS, risk_of

Array = NDArray[np.float64]
_STEP_M = 1000.0
"""Legs get a vertex at least this often: they are straight in the plane, not in degrees."""
_CORNERS = np.array([(0, 0), (0, 1), (1, 1), (1, 0), (0, 0)])
"""Ring of a cell as (column, row), counter-clockwise."""


def to_geojson(result: CheckResult) -> str:
    """A FeatureCollection with one feature per line, in longitude and latitude (WGS84)."""
    lines = ",\n".join(
        json.dumps(each, ensure_ascii=False, allow_nan=False) for each in features(result)
    )
    return f'{{"type": "FeatureCollection", "features": [\n{lines}\n]}}\n'


def features(result: CheckResult) -> Iterator[Plain]:
    """Features of all layers: cells, lookalikes, and with a route route, blind, legs, waypoints."""
    yield from _cells(result)
    if result.along is not None:
        yield from _route(result, result.along)
        for each, properties in zip(result.stretches, stretches_to_plain(result), strict=True):
            line = stretch_en_m(result.along, each.start_m, each.end_m)
            yield _feature(result.frame, "blind", "LineString", line, properties)
    for properties in lookalikes_to_plain(result):
        ends = [properties.pop(name) for name in ("place_latlon_deg", "other_latlon_deg")]
        geometry = {"type": "LineString", "coordinates": [[lon, lat] for lat, lon in ends]}
        yield _as_feature("lookalikes", geometry, properties)
    if result.route_en_m is not None:
        yield from _plan(result.frame, result.route_en_m)


def _cells(result: CheckResult) -> Iterator[Plain]:
    """A square for every cell of which something is known."""
    cells = result.cells
    known = np.isfinite(cells.probability) | (cells.trials > 0) | np.isfinite(cells.persistence)
    for row, col in np.argwhere(known).tolist():
        at = (_CORNERS + np.array([col, row])) * (cells.side_m, -cells.side_m)
        ring = at + np.array([cells.west_m, cells.north_m])
        properties = plain({name: getattr(cells, name)[row, col].item() for name in CELL_VALUES})
        yield _feature(
            result.frame, "cells", "Polygon", ring, {"row": row, "col": col, **properties}
        )


def _route(result: CheckResult, along: Along) -> Iterator[Plain]:
    """A line from each point to the next, with the worse values of the two."""
    speed_mps = result.conditions.speed_mps
    for i in range(len(along.distance_m) - 1):
        pair = slice(i, i + 2)
        start_m, end_m = (float(value) for value in along.distance_m[pair])
        probability = float(along.probability[pair].min())
        properties = {
            "number": i + 1,
            "distance_m": start_m,
            "end_m": end_m,
            "time_s": start_m / speed_mps,
            "probability": probability,
            "across_low": float(along.across_low[pair].min()),
            "error_m": float(along.error_m[pair].max()),
            "drift_m": float(along.drift_m[pair].max()),
            "risk": RISKS[risk_of(probability)].name,
        }
        line = along.points_en_m[pair]
        yield _feature(result.frame, "route", "LineString", line, plain(properties))


def stretch_en_m(along: Along, start_m: float, end_m: float) -> Array:
    """The route (N, 2) between two distances from its start; empty where they are equal."""
    distance = along.distance_m
    start_m, end_m = np.clip([start_m, end_m], distance[0], distance[-1])
    if not end_m > start_m:
        return np.empty((0, 2))
    inside = (distance > start_m) & (distance < end_m)
    at = np.concatenate([[start_m], distance[inside], [end_m]])
    return np.stack([np.interp(at, distance, axis) for axis in along.points_en_m.T], axis=1)


def _plan(frame: LocalFrame, waypoints: Array) -> Iterator[Plain]:
    """Legs and waypoints of the route as planned."""
    steps = np.diff(waypoints, axis=0)
    lengths_m = np.hypot(*steps.T)
    for i, (start, step, length_m) in enumerate(zip(waypoints, steps, lengths_m, strict=False)):
        at = np.linspace(0, 1, max(2, int(np.ceil(length_m / _STEP_M)) + 1))
        bearing_deg = float(np.degrees(np.arctan2(*step)) % 360)
        properties = {
            "number": i + 1,
            "length_m": round(float(length_m), 2),
            "bearing_deg": round(bearing_deg, 1),
        }
        yield _feature(frame, "legs", "LineString", start + at[:, None] * step, properties)
    for i, point in enumerate(waypoints):
        properties = {"number": i + 1, "distance_m": round(float(lengths_m[:i].sum()), 2)}
        yield _feature(frame, "waypoints", "Point", point[None], properties)


def _feature(
    frame: LocalFrame, layer: str, kind: str, points_en_m: Array, properties: Plain
) -> Plain:
    """A feature from points (N, 2); without points its geometry is null."""
    if not len(points_en_m):
        return _as_feature(layer, None, properties)
    lat, lon = frame.latlon_from_en(points_en_m)
    lon = frame.lon_deg + (lon - frame.lon_deg + 180) % 360 - 180  # no jump at the date line
    points: Any = np.round(np.stack([lon, lat], axis=-1), 7).tolist()
    coordinates = {"Point": points[0], "Polygon": [points]}.get(kind, points)
    return _as_feature(layer, {"type": kind, "coordinates": coordinates}, properties)


def _as_feature(layer: str, geometry: Plain | None, properties: Plain) -> Plain:
    named = {"layer": layer, **properties}
    return {"type": "Feature", "properties": named, "geometry": geometry}
