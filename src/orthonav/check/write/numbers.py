"""What the script of the page is given: JSON, with grids of cells as bytes."""

import base64
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.check.outcome import Along, CheckResult, Stretch
from orthonav.check.write.figures import MOST_LOOKALIKES
from orthonav.check.write.ground import Box, Ground
from orthonav.check.write.risk import ALL_RISKS, CIVIDIS, pieces
from orthonav.check.write.said import metres_text, outcome_text, seconds_text, share_text
from orthonav.check.write.shapes import stretch_en_m
from orthonav.check.write.summary import interval_along
from orthonav.geo.frames import LocalFrame

Array = NDArray[np.float64]
Plain = dict[str, Any]
_STEPS = 250
"""A share of 0 to 1 is 0 to this in a byte, 255 is not known."""
_NO_BYTE, _NO_WORD = 255, 65535
_DEGREE = 3
"""Of the polynomials that give latitude and longitude: right to centimetres over a sheet."""
_POWERS = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]


def page_numbers(result: CheckResult, ground: Ground, box: Box) -> str:
    """JSON for a script element: it holds no `<`, so no name can end the element."""
    plain: Plain = {
        "box": [round(side, 1) for side in box],
        "ground": [round(side, 2) for side in ground.box],
        "place": place_polynomial(result.frame, box),
        "colours": list(CIVIDIS),
        "risks": [{**vars(risk), "least": _number(risk.least)} for risk in ALL_RISKS],
        "cells": _cells(result),
        "route": None if result.along is None else _route(result, result.along),
        "waypoints": [] if result.route_en_m is None else np.round(result.route_en_m, 1).tolist(),
        "band": _band(result),
        "blind": [
            _blind(result, i + 1, each) for i, each in enumerate(result.stretches) if result.along
        ],
        "lookalikes": _lookalikes(result),
        "speed_mps": result.conditions.speed_mps,
    }
    text = json.dumps(plain, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def place_polynomial(frame: LocalFrame, box: Box) -> Plain:
    """Latitude and longitude over a box in polynomials of east and north, scaled to -1..1."""
    west, south, east, north = box
    middle, half = (
        np.array([(west + east) / 2, (south + north) / 2]),
        max(east - west, north - south) / 2,
    )
    u, v = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)))
    lat, lon = frame.latlon_from_en(middle + half * np.stack([u, v], axis=1))
    lon = frame.lon_deg + (lon - frame.lon_deg + 180) % 360 - 180
    terms = np.stack([u**i * v**j for i, j in _POWERS], axis=1)
    fitted = np.linalg.lstsq(terms, np.stack([lat, lon], axis=1), rcond=None)[0]
    return {
        "middle": middle.tolist(),
        "half": half,
        "powers": _POWERS,
        "lat": fitted[:, 0].tolist(),
        "lon": fitted[:, 1].tolist(),
    }


def _cells(result: CheckResult) -> Plain:
    cells = result.cells
    rows, cols = cells.probability.shape
    shares = {
        name: _share_bytes(getattr(cells, name))
        for name in ("probability", "low", "high", "wrong", "texture")
    }
    with np.errstate(invalid="ignore"):
        error = np.where(np.isfinite(cells.error_m), np.round(cells.error_m * 10), _NO_WORD)
    words = {
        "error_m": _word_bytes(error),
        "trials": _word_bytes(cells.trials),
    }
    known_m = cells.error_m[np.isfinite(cells.error_m)]
    most_m = float(np.percentile(known_m, 98)) if len(known_m) else 1.0
    known = cells.wrong[np.isfinite(cells.wrong)]
    return {
        "west_m": cells.west_m,
        "north_m": cells.north_m,
        "side_m": cells.side_m,
        "rows": rows,
        "cols": cols,
        "steps": _STEPS,
        "shares": shares,
        "words": words,
        "most": {
            "error_m": float(f"{max(most_m, 1.0):.2g}"),
            "wrong": float(f"{max(0.05, float(known.max()) if len(known) else 0):.2g}"),
        },
    }


def _share_bytes(values: Array) -> str:
    known = np.isfinite(values)
    scaled = np.rint(np.clip(np.where(known, values, 0), 0, 1) * _STEPS)
    return _base64(np.where(known, scaled, _NO_BYTE).astype(np.uint8))


def _word_bytes(values: NDArray[Any]) -> str:
    limited = np.where(values == _NO_WORD, _NO_WORD, np.clip(values, 0, _NO_WORD - 1))
    return _base64(limited.astype("<u2"))


def _base64(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


def _route(result: CheckResult, along: Along) -> Plain:
    low, high = interval_along(result, along)
    return {
        "en": np.round(along.points_en_m, 1).tolist(),
        "distance_m": _numbers(along.distance_m, 1),
        "probability": _numbers(along.probability, 3),
        "low": _numbers(low, 3),
        "high": _numbers(high, 3),
        "across_low": _numbers(along.across_low, 3),
        "error_m": _numbers(along.error_m, 1),
        "drift_m": _numbers(along.drift_m, 1),
        "pieces": pieces(along.probability),
    }


def _band(result: CheckResult) -> list[Any]:
    """Rings of the outline of the band, in metres; none without a band."""
    if result.route_en_m is None or not result.band_m or len(result.route_en_m) < 2:
        return []
    from shapely import LineString

    outline = LineString(result.route_en_m).buffer(result.band_m / 2, quad_segs=8)
    outline = outline.simplify(result.band_m / 500)
    return [
        np.round(np.array(ring.coords), 1).tolist()
        for ring in (outline.exterior, *outline.interiors)
    ]


def _blind(result: CheckResult, number: int, stretch: Stretch) -> Plain:
    assert result.along is not None
    line = stretch_en_m(result.along, stretch.start_m, stretch.end_m)
    return {
        "number": number,
        "start_m": stretch.start_m,
        "end_m": stretch.end_m,
        "en": np.round(line, 1).tolist(),
        "bearable": bool(stretch.bearable),
        "said": f"Blind stretch {number}: {metres_text(stretch.length_m)}, "
        f"{seconds_text(stretch.end_s - stretch.start_s)}, "
        f"probability {share_text(stretch.probability)}, "
        f"off by {metres_text(stretch.drift_m)} at its end, "
        f"allowed {metres_text(stretch.allowed_m)}: "
        f"{outcome_text(stretch)}.",
    }


def _lookalikes(result: CheckResult) -> list[Plain]:
    found = []
    for number, each in enumerate(result.lookalikes[:MOST_LOOKALIKES], start=1):
        near = "within the prior" if each.within_prior else "outside the prior"
        ends = [
            result.frame.en_from_latlon(*each.place_latlon_deg),
            result.frame.en_from_latlon(*each.other_latlon_deg),
        ]
        found.append(
            {
                "number": number,
                "ends": np.round(ends, 1).tolist(),
                "within_prior": bool(each.within_prior),
                "said": f"Lookalikes {number}: {each.apart_m:.0f} m apart, likeness "
                f"{each.likeness:.2f}, {each.trials} trials, {near}.",
            }
        )
    return found


def _numbers(values: Array, digits: int) -> list[float | None]:
    return [_number(value) for value in np.round(values, digits).tolist()]


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None
