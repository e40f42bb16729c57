"""A check as JSON, GeoJSON and GeoTIFF; `docs/check.md` describes every field.

Positions are latitude and longitude; unknown values are None, NaN in the raster.
"""

import json
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.frames import LocalFrame, wrapped_deg
from orthonav.core.records import CONFIDENT
from orthonav.ground.check.records import (
    CELL_VALUES,
    Cells,
    CheckResult,
    Flights,
    Range,
    summarize,
)
from orthonav.ground.report import BY_UNIT, to_plain

FORMAT = "orthonav-check"

Array = NDArray[np.float64]
Plain = dict[str, Any]


def check_to_plain(result: CheckResult) -> Plain:
    verdict, frame = result.verdict, result.frame
    return {
        "format": FORMAT,
        "version": 1,
        "about": to_plain(result.about),
        "verdict": {**to_plain(verdict), "exit_code": verdict.word.exit_code},
        "conditions": to_plain(result.conditions, 6),
        "summary": to_plain(summarize(result), BY_UNIT),
        "flights": None if result.flights is None else to_plain(_figures(result.flights), 4),
        "plane": {
            "origin_lat_deg": float(frame.lat_deg),
            "origin_lon_deg": float(frame.lon_deg),
            "proj4": frame.proj4,
        },
        "cells": _cells_to_plain(frame, result.cells),
        "route": _route_to_plain(result),
        "stretches": _stretches(result),
    }


def _figures(flights: Flights) -> Plain:
    known = vars(flights).items()
    ranges = {name: value._asdict() for name, value in known if isinstance(value, Range)}
    return {"count": flights.count, **ranges}


def _stretches(result: CheckResult) -> list[Plain]:
    return [
        {"number": number, **to_plain({**vars(each), "length_m": each.length_m}, BY_UNIT)}
        for number, each in enumerate(result.outages, start=1)
    ]


def _cells_to_plain(frame: LocalFrame, cells: Cells) -> Plain:
    west, south, east, north = cells.grid.extent_en_m
    corners = np.array([(west, north), (east, north), (east, south), (west, south)])
    return {
        **to_plain(cells.grid, 4),
        "corners_latlon_deg": _latlon_deg(frame, corners),
        **to_plain({name: getattr(cells, name) for name in CELL_VALUES}, BY_UNIT),
    }


def _route_to_plain(result: CheckResult) -> Plain | None:
    along, flights = result.along, result.flights
    if along is None or flights is None or result.route_en_m is None:
        return None
    lat, lon = result.frame.latlon_from_en(along.points_en_m)
    names = ("probability", "low", "high", "across_low", "error_m")
    points = {
        "distance_m": along.distance_m,
        "time_s": along.distance_m / result.conditions.speed_mps,
        "lat_deg": lat,
        "lon_deg": lon,
        **{name: getattr(along, name) for name in names},
        "available": flights.available,
        "protection_m": flights.protection_m,
        "protection_high_m": flights.protection_high_m,
    }
    return {
        **to_plain({"name": result.about.route_name, "band_m": result.band_m}, BY_UNIT),
        "waypoints_latlon_deg": _latlon_deg(result.frame, result.route_en_m),
        "points": to_plain(points, BY_UNIT),
    }


def _latlon_deg(frame: LocalFrame, points_en_m: Array) -> list[list[float]]:
    found: list[list[float]] = to_plain(np.stack(frame.latlon_from_en(points_en_m), axis=1), 7)
    return found


def to_geojson(result: CheckResult) -> str:
    """A FeatureCollection (RFC 7946); `layer` names the kind of each feature."""
    collection = {"type": "FeatureCollection", "features": list(features(result))}
    return f"{json.dumps(collection, ensure_ascii=False, allow_nan=False)}\n"


def features(result: CheckResult) -> Iterator[Plain]:
    """Route, outages and waypoints; cells are in the raster."""
    frame, along, flights = result.frame, result.along, result.flights
    if along is None or flights is None or result.route_en_m is None:
        return
    risks = {"confident": CONFIDENT, "likely": 0.7, "doubtful": 0.5, "unlikely": 0.0}
    for i in range(len(along.distance_m) - 1):  # with the worse values of the two ends
        pair = slice(i, i + 2)
        start_m, end_m = along.distance_m[pair]
        probability = along.probability[pair].min()
        properties = {
            "number": i + 1,
            "distance_m": start_m,
            "end_m": end_m,
            "time_s": start_m / result.conditions.speed_mps,
            "probability": probability,
            "across_low": along.across_low[pair].min(),
            "error_m": along.error_m[pair].max(),
            "available": flights.available[pair].min(),
            "protection_m": flights.protection_m[pair].max(),
            "risk": next((name for name, p in risks.items() if probability >= p), "unknown"),
        }
        yield _feature(frame, "route", "LineString", along.points_en_m[pair], properties)
    for each, properties in zip(result.outages, _stretches(result), strict=True):
        inside = (along.distance_m >= each.start_m) & (along.distance_m <= each.end_m)
        yield _feature(frame, "blind", "LineString", along.points_en_m[inside], properties)
    legs_m = np.hypot(*np.diff(result.route_en_m, axis=0).T)
    for i, point in enumerate(result.route_en_m):
        properties = {"number": i + 1, "distance_m": legs_m[:i].sum()}
        yield _feature(frame, "waypoints", "Point", point[None], properties)


def _feature(
    frame: LocalFrame, layer: str, kind: str, points_en_m: Array, properties: Plain
) -> Plain:
    lat, lon = frame.latlon_from_en(points_en_m)
    lon = frame.lon_deg + wrapped_deg(lon - frame.lon_deg)  # no jump at the date line
    points = np.round(np.stack([lon, lat], axis=-1), 7).tolist()
    geometry = {"type": kind, "coordinates": points[0] if kind == "Point" else points}
    named = {"layer": layer, **to_plain(properties, BY_UNIT)}
    return {"type": "Feature", "properties": named, "geometry": geometry}


def tif_bytes(result: CheckResult) -> bytes:
    """The raster: float32, NaN where unknown, north up, conditions as tags.

    Made in memory (28 bytes per cell before compression), because GDAL does not report a full disk.
    """
    from rasterio import Affine
    from rasterio.io import MemoryFile

    cells, grid = result.cells, result.cells.grid
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": grid.cols,
        "height": grid.rows,
        "count": len(CELL_VALUES),
        "dtype": "float32",
        "nodata": math.nan,
        "crs": result.frame.proj4,
        "transform": Affine(grid.side_m, 0.0, grid.west_m, 0.0, -grid.side_m, grid.north_m),
        "compress": "deflate",
        "predictor": 3,
        "interleave": "band",
    }
    with MemoryFile() as memory:
        with memory.open(**profile) as target:
            for number, (name, meaning) in enumerate(CELL_VALUES.items(), start=1):
                target.write(np.asarray(getattr(cells, name), dtype=np.float32), number)
                target.set_band_description(number, name)
                target.update_tags(number, meaning=meaning)
            target.update_tags(**_tags(result))
        return bytes(memory.read())


def _tags(result: CheckResult) -> dict[str, str]:
    values = {
        "map": result.about.map_name,
        "imagery": result.about.imagery,
        "route": result.about.route_name,
        "verdict": result.verdict.word.value,
        **vars(result.conditions),
    }
    tags = {
        f"ORTHONAV_{name.upper()}": writable(each) if isinstance(each, str) else f"{each:.9g}"
        for name, each in values.items()
        if each not in (None, "")
    }
    return {"TIFFTAG_SOFTWARE": f"orthonav {result.about.version}".strip(), **tags}


def writable(text: str) -> str:
    """Text without lone surrogates, which come from file names that are not UTF-8."""
    return text.encode("utf-8", "replace").decode("utf-8")
