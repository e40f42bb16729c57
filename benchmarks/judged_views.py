"""Single views of known places and of none, on maps of other dates, as rows for `integrity`."""

import contextlib
import math
import shutil
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from rasterio.warp import transform_bounds

from benchmarks.scenes import (
    USUAL,
    Pair,
    agl_of,
    flight,
    gsd_of,
    map_of,
    ortho,
    place_of,
    views_in,
)
from benchmarks.scenes import far_m as far_m_of
from orthonav.core.errors import AreaError
from orthonav.core.localize import Localizer
from orthonav.core.localize.fix import fix_of
from orthonav.core.localize.prepared import PreparedMap
from orthonav.core.localize.search import Search
from orthonav.core.mapfile import open_map
from orthonav.core.records import PRIOR_SIGMAS, RADIUS_SHARE, NoFix, Telemetry, View

Task = tuple[Pair, Sequence[Pair], int, int, Path]
"""Pair, all pairs, number of views, seed, and folder of work."""
TRACK_YAW_STD_DEG, TRACK_AGL_STD = 2.0, 0.03
"""Errors of heading and height, and what a track knows of them."""
FAR_FROM_PRIOR_PX = 20.0
"""A view with a prior is right within this: chance finds places within 35 m of it too. Maps and
views of Tours are up to 17 px apart."""
METRES_PER_DEG = 111_320.0
BESIDE_SHARE = 0.9
"""Views beside the map are farther from its border than this share of their width. One that reaches
onto it all the same, and is placed where it was taken, is right."""


@dataclass(frozen=True)
class Case:
    """Views of one kind.

    - `kind`: `found`, or those that are not on the map or not there: `mirrored`, `other scene`,
      `beside`, `other prior` (that of another view).
    - `width_px`: shorter side of the view on the ground, pixels of the map.
    - `share`: number of views, as a fraction of the requested one.
    - `heading_known`: whether the reported heading is used; `prior_px`: standard deviation of a
      prior position, pixels of the map, None without.
    - `tracked`: heading and height are known as a track knows them.
    """

    kind: str
    width_px: int
    share: float
    heading_known: bool = True
    prior_px: float | None = None
    tracked: bool = False


CASES = (
    Case("found", 256, 1.0),
    Case("found", 128, 1.0),
    Case("found", 180, 0.5),
    Case("found", 360, 0.2),
    Case("found", 256, 0.4, heading_known=False),
    Case("found", 128, 0.3, heading_known=False),
    Case("found", 128, 0.4, prior_px=40.0),
    Case("found", 90, 0.3, prior_px=40.0),
    Case("found", 64, 0.3, prior_px=40.0),
    Case("mirrored", 256, 0.4),
    Case("mirrored", 128, 0.4),
    Case("other scene", 256, 0.4),
    Case("other scene", 128, 0.4),
    Case("beside", 256, 1.0),
    Case("beside", 128, 1.0),
    Case("mirrored", 128, 0.4, prior_px=40.0),
    Case("mirrored", 64, 0.3, prior_px=40.0),
    Case("other prior", 128, 0.4, prior_px=40.0),
    Case("other prior", 64, 0.3, prior_px=40.0),
    Case("found", 256, 0.4, prior_px=12.0, tracked=True),
    Case("found", 128, 0.4, prior_px=12.0, tracked=True),
    Case("mirrored", 256, 0.4, prior_px=12.0, tracked=True),
    Case("mirrored", 128, 0.4, prior_px=12.0, tracked=True),
    Case("other prior", 256, 0.4, prior_px=12.0, tracked=True),
    Case("other prior", 128, 0.4, prior_px=12.0, tracked=True),
)


def prepare(pairs: Sequence[Pair], work: Path) -> None:
    """Make maps and generated imagery, before processes share them."""
    for each in pairs:
        past = ortho(each.map, work)
        map_of(past, work)
        with contextlib.suppress(AreaError):
            _western_half(past, work)
        ortho(each.views, work)


def _western_half(path: Path, work: Path) -> tuple[Path, float]:
    """Map of the western half of an orthophoto, and the meridian where it ends.

    Raises `AreaError` where that has less imagery than a tile.
    """
    with rasterio.open(path) as source:
        west, south, east, north = transform_bounds(source.crs, "EPSG:4326", *source.bounds)
    middle = (west + east) / 2
    return map_of(path, work, (west, south, middle, north)), middle


def views_of(task: Task) -> list[dict[str, Any]]:
    """Rows of all views of a pair."""
    cv2.setNumThreads(1)
    return list(_rows(*task))


def _rows(
    pair: Pair, others: Sequence[Pair], views: int, seed: int, work: Path
) -> Iterator[dict[str, Any]]:
    past, flown = ortho(pair.map, work), ortho(pair.views, work)
    whole = _registration(map_of(past, work))
    half, middle = None, math.nan
    with contextlib.suppress(AreaError):
        half_path, middle = _western_half(past, work)
        half = _registration(half_path)
    seed += zlib.crc32(pair.name.encode()) % 1_000_000  # pairs with the same views fly elsewhere
    flights: dict[tuple[Any, ...], Path] = {}
    other_scenes = [each for each in others if place_of(each) != place_of(pair)]
    for number, case in enumerate(CASES):
        count = max(1, round(case.share * views))
        over, gsd_m = flown, None
        if case.kind == "other scene":
            over = ortho(other_scenes[(seed + number) % len(other_scenes)].views, work)
            gsd_m = gsd_of(over)
        localizer = half if case.kind == "beside" else whole
        if localizer is None:
            continue
        # Mirrored views, and those with another prior, are the views of the map once more.
        kind = "found" if case.kind in ("mirrored", "other prior") else case.kind
        key = kind, case.width_px, case.heading_known, case.prior_px, case.tracked
        try:
            if key not in flights:
                flights[key] = _flight(over, case, count, seed + number, work)
        except AreaError:  # wider than the imagery
            continue
        taken = _flown_for(case, flights[key], gsd_of(over), middle)
        for name, view, truth in islice(taken, count):
            if gsd_m is not None:
                scale = localizer.grid.gsd_m / gsd_m
                view = replace(view, telemetry=_scaled(view.telemetry, scale))
            about = {"scene": place_of(pair), "pair": pair.name, **asdict(case), "frame": name}
            if case.kind == "found" and not is_covered(localizer, truth, case.width_px):
                about["kind"] = "beside"
            yield {**about, **_placed(localizer, case, view, truth)}
    for folder in flights.values():
        shutil.rmtree(folder)


def _flown_for(
    case: Case, folder: Path, gsd_m: float, middle_deg: float
) -> Iterator[tuple[str, View, tuple[float, float]]]:
    """The views of a flight as a case needs them: mirrored, or some left out."""
    flown = [(each.frame, each.view, each.truth_latlon_deg) for each in views_in(folder)]
    if case.kind == "other prior":
        yield from _with_other_priors(flown, case, gsd_m)
        return
    for name, view, truth in flown:
        if case.kind == "beside":
            span_deg = case.width_px * gsd_m / METRES_PER_DEG
            if truth[1] < middle_deg + BESIDE_SHARE * span_deg / math.cos(math.radians(truth[0])):
                continue
        if case.kind == "mirrored":
            yield name, replace(view, grey=np.ascontiguousarray(view.grey[:, ::-1])), truth
        else:
            yield name, view, truth


def _placed(
    localizer: PreparedMap, case: Case, view: View, truth: tuple[float, float]
) -> dict[str, Any]:
    """Evidence, error and verdict of a view; `evidence` None where it was refused."""
    prior = None if case.prior_px is None else view.telemetry.prior
    search = Search.of(localizer, view, prior, case.heading_known)
    found = search if isinstance(search, NoFix) else search.run()
    if isinstance(found, NoFix):
        return {"evidence": None, "right": False}
    gsd_m = localizer.grid.gsd_m
    assert localizer.confidence is not None
    fix, frame = fix_of(found), localizer.sheet.frame
    off_m = frame.en_from_latlon(fix.lat_deg, fix.lon_deg) - frame.en_from_latlon(*truth)
    error_m = float(np.hypot(*off_m))
    far_m = far_m_of(gsd_m) if prior is None else FAR_FROM_PRIOR_PX * gsd_m
    far_m = max(far_m, RADIUS_SHARE * fix.agl_m)
    right = case.kind in ("found", "beside") and error_m <= far_m
    return {
        "evidence": {name: float(f"{value:.5g}") for name, value in fix.evidence.items()},
        "chances": localizer.confidence.chances.to_plain(),
        "off_en_m": np.round(off_m, 3).tolist(),
        "cov_en_m2": [float(f"{each:.5g}") for each in fix.cov_en_m2[[0, 0, 1], [0, 1, 1]]],
        "agl_m": round(fix.agl_m, 2),
        "gsd_m": gsd_m,
        "radius_m": fix.radius_m,
        "right": right,
    }


def is_covered(localizer: PreparedMap, truth: tuple[float, float], width_px: float) -> bool:
    """Whether the map has imagery at the middle of a view and half way to its corners."""
    grid = localizer.grid
    east, north = localizer.sheet.frame.en_from_latlon(*truth)
    col, row = (float(east) - grid.west_m) / grid.gsd_m, (grid.north_m - float(north)) / grid.gsd_m
    steps = np.array([-0.25, 0.0, 0.25]) * width_px
    inside = [
        localizer.pyramid.read(0, int(row + dy), int(col + dx), 1, 1)[1].all()
        for dy in steps
        for dx in steps
    ]
    return all(inside)


def _with_other_priors(
    views: Sequence[tuple[str, View, tuple[float, float]]], case: Case, gsd_m: float
) -> Iterator[tuple[str, View, tuple[float, float]]]:
    """Views with the prior of the view before, where that is far from their own place."""
    assert case.prior_px is not None
    least_m = (2 * PRIOR_SIGMAS * case.prior_px + case.width_px) * gsd_m
    for number, (name, view, truth) in enumerate(views):
        prior = views[number - 1][1].telemetry.prior
        assert prior is not None
        north_m = (prior.lat_deg - truth[0]) * METRES_PER_DEG
        east_m = (prior.lon_deg - truth[1]) * METRES_PER_DEG * math.cos(math.radians(truth[0]))
        if math.hypot(north_m, east_m) > least_m:
            yield name, replace(view, telemetry=replace(view.telemetry, prior=prior)), truth


def _scaled(telemetry: Telemetry, scale: float) -> Telemetry:
    """Telemetry at a height so much greater, for imagery of another ground resolution."""
    std_m = telemetry.agl_std_m
    return replace(
        telemetry,
        agl_m=telemetry.agl_m * scale,
        agl_std_m=None if std_m is None else std_m * scale,
        prior=None,
    )


def _registration(map_path: Path) -> PreparedMap:
    found = Localizer(open_map(map_path)).registration
    assert found is not None
    return found


def _flight(path: Path, case: Case, count: int, seed: int, work: Path) -> Path:
    gsd_m = gsd_of(path)
    errors = replace(USUAL, prior_std_m=None if case.prior_px is None else case.prior_px * gsd_m)
    if case.tracked:
        errors = replace(errors, yaw_std_deg=TRACK_YAW_STD_DEG, agl_std=TRACK_AGL_STD)
    agl_m = agl_of(case.width_px, gsd_m)
    return flight(path, work, views=count, errors=errors, seed=seed, agl_m=agl_m)
