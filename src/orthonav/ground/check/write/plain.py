"""A check as plain values for JSON: latitude and longitude, None for unknown.

Format "orthonav-check", version 1; every field is described in `docs/check.md`.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import CONFIDENT
from orthonav.ground.check.outcome import CELL_VALUES, Cells, CheckResult

FORMAT, VERSION = "orthonav-check", 1
_DIGITS = {"m": 2, "s": 2, "deg": 7, "value": 2, "off": 4, "km2": 4}
"""Decimals by the last word of a name: a centimetre; fractions and others have `_FRACTION`."""
_FRACTION, _EXACT = 3, 6

Array = NDArray[np.float64]
Plain = dict[str, Any]


def to_json(result: CheckResult) -> str:
    """A check as strict JSON, one line per top-level field."""
    lines = ",\n".join(
        f"{json.dumps(name)}: {json.dumps(value, ensure_ascii=False, allow_nan=False)}"
        for name, value in to_plain(result).items()
    )
    return f"{{\n{lines}\n}}\n"


def to_plain(result: CheckResult) -> Plain:
    """A check as dictionaries, lists, text and finite numbers."""
    verdict = result.verdict
    return {
        "format": FORMAT,
        "version": VERSION,
        "about": plain(asdict(result.about)),
        "verdict": {
            "word": verdict.word.value,
            "exit_code": verdict.word.exit_code,
            "reasons": [
                {"code": each.code, "text": each.text, "word": each.word.value}
                for each in verdict.reasons
            ],
        },
        "conditions": plain(asdict(result.conditions), _EXACT),
        "summary": plain(summarize(result)),
        "plane": {
            "origin_lat_deg": float(result.frame.lat_deg),
            "origin_lon_deg": float(result.frame.lon_deg),
            "proj4": result.frame.proj4,
        },
        "cells": _cells(result.frame, result.cells),
        "route": _route(result),
        "stretches": stretches_to_plain(result),
        "lookalikes": lookalikes_to_plain(result),
        "envelope": None if result.envelope is None else plain(asdict(result.envelope)),
        "alternatives": [plain(asdict(each)) for each in result.alternatives],
    }


def stretches_to_plain(result: CheckResult) -> list[Plain]:
    """The gaps, numbered from 1."""
    return [
        {
            "number": number,
            **plain(asdict(each)),
            "length_m": plain(each.length_m, _DIGITS["m"]),
            "recoverable": bool(each.recoverable),
        }
        for number, each in enumerate(result.stretches, start=1)
    ]


def lookalikes_to_plain(result: CheckResult) -> list[Plain]:
    """The pairs of ambiguous places, numbered from 1."""
    return [
        {"number": number, **plain(asdict(each))}
        for number, each in enumerate(result.lookalikes, start=1)
    ]


def summarize(result: CheckResult) -> Plain:
    """The key figures of a check, which the page, the terminal and `check.json` share.

    `route_share_from_0_9`: fraction of the length with a probability of `CONFIDENT` or more.
    `error_m`: expected error of a correct fix (root mean square), along the route or over the map.
    `longest_stretch`: number of the longest gap, from 1. Without a route its figures are
    NaN, 0 or None.
    """
    along, cells, stretches = result.along, result.cells, result.stretches
    route_m = likely = math.nan
    if along is None or not len(along.distance_m):
        error_m = _rms(cells.error_m.ravel(), cells.probability.ravel())
    else:
        route_m = float(along.distance_m[-1] - along.distance_m[0])
        weights = _length_per_point_m(along.distance_m)
        known = np.isfinite(along.probability)
        confident = np.where(known, along.probability, 0.0) >= CONFIDENT
        likely = float(weights[confident].sum() / weights.sum()) if known.any() else math.nan
        error_m = _rms(along.error_m, weights * np.nan_to_num(along.probability))
    longest = max(stretches, key=lambda each: each.length_m, default=None)
    return {
        "area_km2": result.area_km2,
        "second_date": result.second_date,
        "mean_probability": result.mean,
        "error_m": error_m,
        "route_m": route_m,
        "route_s": route_m / result.conditions.speed_mps,
        "route_share_from_0_9": likely,
        "blind_stretches": len(stretches),
        "unrecoverable_stretches": sum(not each.recoverable for each in stretches),
        "longest_stretch": None if longest is None else stretches.index(longest) + 1,
    }


def _length_per_point_m(distance_m: Array) -> Array:
    """Length of the route (N,) that each of its points represents."""
    if len(distance_m) < 2:
        return np.ones(len(distance_m))
    steps = np.diff(distance_m)
    return np.asarray(np.concatenate([steps[:1], steps[1:] + steps[:-1], steps[-1:]]) / 2)


def _rms(values: Array, weights: Array) -> float:
    """Weighted root mean square of the known values; NaN for none."""
    known = np.isfinite(values) & np.isfinite(weights) & (weights > 0)
    if not known.any():
        return math.nan
    return float(np.sqrt(np.average(values[known] ** 2, weights=weights[known])))


def _cells(frame: LocalFrame, cells: Cells) -> Plain:
    rows, cols = cells.probability.shape
    east_m, south_m = cells.west_m + cols * cells.side_m, cells.north_m - rows * cells.side_m
    corners = [
        (cells.west_m, cells.north_m),
        (east_m, cells.north_m),
        (east_m, south_m),
        (cells.west_m, south_m),
    ]
    geometry = {name: plain(getattr(cells, name), 4) for name in ("side_m", "west_m", "north_m")}
    return {
        "rows": rows,
        "cols": cols,
        **geometry,
        "corners_latlon_deg": latlon_deg(frame, np.array(corners)),
        **plain({name: getattr(cells, name) for name in CELL_VALUES}),
    }


def _route(result: CheckResult) -> Plain | None:
    along = result.along
    if along is None and result.route_en_m is None:
        return None
    found: Plain = {"name": result.about.route_name, "band_m": plain(result.band_m, _DIGITS["m"])}
    if result.route_en_m is not None:
        found["waypoints_latlon_deg"] = latlon_deg(result.frame, result.route_en_m)
    if along is not None:
        lat, lon = result.frame.latlon_from_en(along.points_en_m)
        names = ("probability", "low", "high", "across_low", "error_m", "drift_m")
        found["points"] = plain(
            {
                "distance_m": along.distance_m,
                "time_s": along.distance_m / result.conditions.speed_mps,
                "lat_deg": lat,
                "lon_deg": lon,
                **{name: getattr(along, name) for name in names},
            }
        )
    return found


def latlon_deg(frame: LocalFrame, points_en_m: Array) -> list[list[float]]:
    """Latitude and longitude of points (N, 2), rounded to a centimetre."""
    lat, lon = frame.latlon_from_en(points_en_m)
    rounded: list[list[float]] = np.round(np.stack([lat, lon], axis=1), _DIGITS["deg"]).tolist()
    return rounded


def plain(value: Any, digits: int | None = None) -> Any:
    """`value` for strict JSON: NaN and infinity become None, numbers are rounded.

    Numbers have `digits` decimals, or as many as the name of their field asks for.
    """
    if isinstance(value, Mapping):
        return {
            name: plain(
                each, _DIGITS.get(name.rpartition("_")[2], _FRACTION) if digits is None else digits
            )
            for name, each in value.items()
        }
    if isinstance(value, np.ndarray):
        return plain(value.tolist(), digits)
    if isinstance(value, list | tuple):
        return [plain(each, digits) for each in value]
    if isinstance(value, float):
        return round(float(value), digits or 0) if math.isfinite(value) else None
    return value
