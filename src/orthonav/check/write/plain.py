"""A check as plain values for JSON: positions as latitude and longitude, None for not known.

Format "orthonav-check", version 1; every field is described in `docs/check.md`.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.check.outcome import Cells, CheckResult, Stretch
from orthonav.check.write.summary import interval_along, summarize

FORMAT = "orthonav-check"
VERSION = 1
_SHARE, _METRES, _DEGREES = 3, 2, 7
"""Decimals: of shares, of metres and seconds, of latitudes and longitudes (a centimetre)."""

Plain = dict[str, Any]


def to_json(result: CheckResult) -> str:
    """A check as strict JSON, with a field of the first level per line."""
    lines = ",\n".join(
        f"{json.dumps(name)}: {json.dumps(value, ensure_ascii=False, allow_nan=False)}"
        for name, value in to_plain(result).items()
    )
    return f"{{\n{lines}\n}}\n"


def to_plain(result: CheckResult) -> Plain:
    """A check as dictionaries, lists, text and finite numbers."""
    about = asdict(result.about)
    return {
        "format": FORMAT,
        "version": VERSION,
        "about": {**about, "terms": list(about["terms"])},
        "verdict": _verdict(result),
        "conditions": {
            name: _rounded(value, 6) for name, value in asdict(result.conditions).items()
        },
        "summary": _summary(result),
        "plane": {
            "origin_lat_deg": float(result.frame.lat_deg),
            "origin_lon_deg": float(result.frame.lon_deg),
            "proj4": result.frame.proj4,
        },
        "cells": _cells(result, result.cells),
        "route": _route(result),
        "stretches": [_stretch(i + 1, each) for i, each in enumerate(result.stretches)],
        "lookalikes": [
            {
                "number": i + 1,
                "place_latlon_deg": [_rounded(x, _DEGREES) for x in each.place_latlon_deg],
                "other_latlon_deg": [_rounded(x, _DEGREES) for x in each.other_latlon_deg],
                "apart_m": _rounded(each.apart_m, _METRES),
                "likeness": _rounded(each.likeness, _SHARE),
                "trials": int(each.trials),
                "within_prior": bool(each.within_prior),
            }
            for i, each in enumerate(result.lookalikes)
        ],
        "envelope": _envelope(result),
        "alternatives": [
            {
                "what": each.what,
                "value": _rounded(each.value, _METRES),
                "probability": _rounded(each.probability, _SHARE),
                "chosen": bool(each.chosen),
            }
            for each in result.alternatives
        ],
    }


def _verdict(result: CheckResult) -> Plain:
    return {
        "word": result.verdict.word.value,
        "exit_code": result.verdict.word.exit_code,
        "reasons": [
            {"code": each.code, "text": each.text, "word": each.word.value}
            for each in result.verdict.reasons
        ],
    }


def _summary(result: CheckResult) -> Plain:
    summary = summarize(result)
    longest = result.stretches.index(summary.longest) + 1 if summary.longest else None
    return {
        "area_km2": _rounded(result.area_km2, 4),
        "mean_probability": _rounded(result.mean, _SHARE),
        "error_m": _rounded(summary.error_m, _METRES),
        "second_date": bool(result.second_date),
        "route_m": _rounded(summary.route_m, _METRES),
        "route_s": _rounded(summary.route_s, _METRES),
        "route_share_from_0_9": _rounded(summary.confident_share, _SHARE),
        "blind_stretches": len(result.stretches),
        "unbearable_stretches": summary.unbearable,
        "longest_stretch": longest,
    }


def _cells(result: CheckResult, cells: Cells) -> Plain:
    rows, cols = cells.probability.shape
    east_m, south_m = cells.west_m + cols * cells.side_m, cells.north_m - rows * cells.side_m
    corners = np.array(
        [
            (cells.west_m, cells.north_m),
            (east_m, cells.north_m),
            (east_m, south_m),
            (cells.west_m, south_m),
        ]
    )
    lat, lon = result.frame.latlon_from_en(corners)
    return {
        "rows": rows,
        "cols": cols,
        "side_m": _rounded(cells.side_m, 4),
        "west_m": _rounded(cells.west_m, 4),
        "north_m": _rounded(cells.north_m, 4),
        "corners_latlon_deg": np.round(np.stack([lat, lon], axis=1), _DEGREES).tolist(),
        "probability": _listed(cells.probability, _SHARE),
        "low": _listed(cells.low, _SHARE),
        "high": _listed(cells.high, _SHARE),
        "error_m": _listed(cells.error_m, _METRES),
        "wrong": _listed(cells.wrong, _SHARE),
        "trials": np.asarray(cells.trials, dtype=int).tolist(),
        "texture": _listed(cells.texture, _SHARE),
    }


def _route(result: CheckResult) -> Plain | None:
    along, frame = result.along, result.frame
    if along is None and result.route_en_m is None:
        return None
    plain: Plain = {"name": result.about.route_name, "band_m": _rounded(result.band_m, _METRES)}
    if result.route_en_m is not None:
        lat, lon = frame.latlon_from_en(result.route_en_m)
        plain["waypoints_latlon_deg"] = np.round(np.stack([lat, lon], 1), _DEGREES).tolist()
    if along is not None:
        lat, lon = frame.latlon_from_en(along.points_en_m)
        low, high = interval_along(result, along)
        plain["points"] = {
            "distance_m": _listed(along.distance_m, _METRES),
            "time_s": _listed(along.distance_m / result.conditions.speed_mps, _METRES),
            "lat_deg": _listed(lat, _DEGREES),
            "lon_deg": _listed(lon, _DEGREES),
            "probability": _listed(along.probability, _SHARE),
            "low": _listed(low, _SHARE),
            "high": _listed(high, _SHARE),
            "across_low": _listed(along.across_low, _SHARE),
            "error_m": _listed(along.error_m, _METRES),
            "drift_m": _listed(along.drift_m, _METRES),
        }
    return plain


def _stretch(number: int, stretch: Stretch) -> Plain:
    return {
        "number": number,
        **{
            name: _rounded(getattr(stretch, name), _METRES)
            for name in ("start_m", "end_m", "length_m", "start_s", "end_s")
        },
        "probability": _rounded(stretch.probability, _SHARE),
        "drift_m": _rounded(stretch.drift_m, _METRES),
        "allowed_m": _rounded(stretch.allowed_m, _METRES),
        "ends_lost": bool(stretch.ends_lost),
        "bearable": bool(stretch.bearable),
    }


def _envelope(result: CheckResult) -> Plain | None:
    envelope = result.envelope
    if envelope is None:
        return None
    return {
        "yaw_off_deg": _listed(envelope.yaw_off_deg, _METRES),
        "agl_off": _listed(envelope.agl_off, 4),
        "share": _listed(envelope.share, _SHARE),
        "fine_yaw_deg": _rounded(envelope.fine_yaw_deg, _METRES),
        "fine_agl_low": _rounded(envelope.fine_agl_low, 4),
        "fine_agl_high": _rounded(envelope.fine_agl_high, 4),
    }


def _rounded(value: float | None, digits: int) -> float | None:
    """A number to be written; None where it is not known or endless."""
    return round(float(value), digits) if value is not None and math.isfinite(value) else None


def _listed(values: NDArray[Any], digits: int) -> list[Any]:
    """An array (N,) or (N, M) as lists, None where not finite."""
    if values.ndim > 1:
        return [_listed(row, digits) for row in values]
    rounded = np.round(np.asarray(values, dtype=np.float64), digits)
    return [value if math.isfinite(value) else None for value in rounded.tolist()]


def is_check(plain: object) -> bool:
    """Whether what was read from a JSON file is a check of any version."""
    return isinstance(plain, Mapping) and plain.get("format") == FORMAT
