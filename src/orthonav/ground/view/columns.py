"""Results as columns of short numbers, so that many thousand views fit into one response.

Lengths and positions are rounded to what a screen can show; unknown values are None.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.flight.fixes import STATES
from orthonav.core.flight.gnss import fault_of, gnss_of
from orthonav.core.records import Fix, ViewResult
from orthonav.ground.evaluate.calibration import is_covariance
from orthonav.ground.evaluate.metrics import FAR_M
from orthonav.ground.view.sheet import SheetImagery

Array = NDArray[np.float64]
FAR_AWAY_PX = 1e9
"""Positions farther away are not drawn."""


def columns_of(
    results: Sequence[ViewResult],
    first_ns: int,
    truth: Mapping[str, tuple[float, float]],
    sheet: SheetImagery,
    radius_m: float,
    second: Mapping[str, ViewResult] | None = None,
) -> dict[str, list[Any]]:
    """The columns of `results`, in order; times count from `first_ns`.

    `frame`: name; `t`: time in seconds; `ms`: processing time.
    `x`, `y`, `tx`, `ty`: fix and true position in pixels of the sheet.
    `gx`, `gy`, `gerr`, `gdiff`: GNSS in pixels of the sheet, its error, and its distance from the
    fix in metres; `gfault`: reason of the GNSS monitor, "" without one.
    `err`: error in metres; `conf`, `radius`: confidence and radius (m) that the fix states.
    `a`, `b`, `turn`: axes of one standard deviation (m), and the angle of the longer one in degrees
    counter-clockwise from east.
    `head`, `agl`: heading (deg) and height (m).
    `state`: number in `STATES`, -1 without one; `reason`: "" for a fix.
    `confident`: 1 if confident, 0 for a best guess or no fix.
    `wrong`: 1 if tracking or confident, with an error above 35 m, `radius_m` and its own radius.
    `x2`, `y2`, `err2`, `confident2`: the same of the results of a second run, by frame, if given.
    """
    fixes = [r.outcome if isinstance(r.outcome, Fix) else None for r in results]
    fix_en_m = _places([None if f is None else (f.lat_deg, f.lon_deg) for f in fixes], sheet)
    truth_en_m = _places([truth.get(r.frame) for r in results], sheet)
    error_m = np.hypot(*(fix_en_m - truth_en_m).T)
    own_m = np.array([math.nan if f is None else f.radius_m for f in fixes], dtype=np.float64)
    confident = [
        f is not None and (r.is_confident or r.state == "tracking")
        for f, r in zip(fixes, results, strict=True)
    ]
    wrong = np.array(confident, dtype=bool) & (error_m > np.fmax(max(FAR_M, radius_m), own_m))
    gnss_en_m = _places([gnss_of(r.outcome.evidence) for r in results], sheet)
    gx, gy = _drawn(gnss_en_m, sheet)
    axes_m, turn_deg = _ellipses(fixes)
    x, y = _drawn(fix_en_m, sheet)
    tx, ty = _drawn(truth_en_m, sheet)
    columns: dict[str, list[Any]] = {
        "frame": [r.frame for r in results],
        "t": [round((r.time_ns - first_ns) / 1e9, 3) for r in results],
        "x": _rounded(x, 2),
        "y": _rounded(y, 2),
        "tx": _rounded(tx, 2),
        "ty": _rounded(ty, 2),
        "gx": _rounded(gx, 2),
        "gy": _rounded(gy, 2),
        "gerr": _rounded(np.hypot(*(gnss_en_m - truth_en_m).T), 2),
        "gdiff": _rounded(np.hypot(*(gnss_en_m - fix_en_m).T), 2),
        "gfault": [fault_of(r.outcome.evidence) for r in results],
        "err": _rounded(error_m, 4),
        "conf": _each(fixes, "confidence", 4),
        "radius": _rounded(own_m, 1),
        "a": _rounded(axes_m[:, 1], 2),
        "b": _rounded(axes_m[:, 0], 2),
        "turn": _rounded(turn_deg, 1),
        "head": _each(fixes, "heading_deg", 1),
        "agl": _each(fixes, "agl_m", 1),
        "ms": _rounded(np.array([r.latency_ms for r in results], dtype=np.float64), 1),
        "state": [-1 if r.state is None else STATES.index(r.state) for r in results],
        "reason": [_reason(r) for r in results],
        "confident": [int(r.is_confident) for r in results],
        "wrong": [int(each) for each in wrong],
    }
    if second is not None:
        found = [second.get(r.frame) for r in results]
        places = [
            (r.outcome.lat_deg, r.outcome.lon_deg) if r and isinstance(r.outcome, Fix) else None
            for r in found
        ]
        second_en_m = _places(places, sheet)
        x2, y2 = _drawn(second_en_m, sheet)
        columns |= {
            "x2": _rounded(x2, 2),
            "y2": _rounded(y2, 2),
            "err2": _rounded(np.hypot(*(second_en_m - truth_en_m).T), 4),
            "confident2": [int(r is not None and r.is_confident) for r in found],
        }
    return columns


def _places(latlon_deg: Sequence[tuple[float, float] | None], sheet: SheetImagery) -> Array:
    """Positions (N, 2) in the plane of the sheet, NaN where there is none."""
    en_m = np.full((len(latlon_deg), 2), math.nan)
    known = [i for i, at in enumerate(latlon_deg) if at and all(map(math.isfinite, at))]
    if known:
        lat, lon = np.array([latlon_deg[i] for i in known], dtype=np.float64).T
        en_m[known] = sheet.frame.en_from_latlon(lat, lon)
    return en_m


def _drawn(en_m: Array, sheet: SheetImagery) -> tuple[Array, Array]:
    px = sheet.px_from_en(en_m)
    px[~(np.abs(px) < FAR_AWAY_PX).all(axis=1)] = math.nan
    return px[:, 0], px[:, 1]


def _ellipses(fixes: Sequence[Fix | None]) -> tuple[Array, Array]:
    """Standard deviations (N, 2) along both axes, shorter first, and the angle of the longer."""
    cov = np.full((len(fixes), 2, 2), math.nan)
    for i, fix in enumerate(fixes):
        if fix is not None and np.shape(fix.cov_en_m2) == (2, 2):
            cov[i] = fix.cov_en_m2
    axes, turn = np.full((len(fixes), 2), math.nan), np.full(len(fixes), math.nan)
    usable = is_covariance(cov)
    if usable.any():
        sizes, vectors = np.linalg.eigh(cov[usable])
        axes[usable] = np.sqrt(np.maximum(sizes, 0.0))
        turn[usable] = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])) % 180.0
    return axes, turn


def _each(fixes: Sequence[Fix | None], name: str, decimals: int) -> list[float | None]:
    values = [math.nan if fix is None else getattr(fix, name) for fix in fixes]
    return _rounded(np.array(values, dtype=np.float64), decimals)


def _rounded(values: Array, decimals: int) -> list[float | None]:
    return [
        round(value, decimals) if math.isfinite(value) else None
        for value in np.asarray(values).tolist()
    ]


def _reason(result: ViewResult) -> str:
    if isinstance(result.outcome, Fix):
        return ""
    return result.outcome.reason or "not_said"
