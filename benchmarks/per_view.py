"""One view on one core: the stages of `Localizer.locate` and the whole, warm."""

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import numpy as np

from benchmarks.flights import FlownView
from benchmarks.inputs import FLIGHT_SEED, PAST, PRESENT, USUAL_ERRORS, Workplace
from benchmarks.machine import timed
from benchmarks.record import Section, Table, timing_cells
from orthonav.core.flight.folder import read_image
from orthonav.core.localize import Localizer
from orthonav.core.localize.rectify import downsampled
from orthonav.core.localize.tiles import UNKNOWN_HEADING_STEP_DEG
from orthonav.core.mapfile import open_map

REPEATS = 3
Made = TypeVar("Made")
STAGES = {
    "decode": "decode JPEG (not part of locate)",
    "thin": "thin the view to the map's resolution",
    "rectify": "rectify, per heading",
    "represent": "represent, per heading",
    "embed": "embed, per heading",
    "search": "search, 3 queries",
    "match": "match: search and evidence, 3 queries",
    "locate": "**whole `locate`, embedding only, 3 headings**",
    "unknown": "**whole `locate`, embedding only, heading unknown**",
    "default": "**whole `locate`, default**",
    "default unknown": "**whole `locate`, default, heading unknown**",
}


def measure(place: Workplace) -> Section:
    """Time every stage on views of another date."""
    section = Section("One view on one core")
    side_m = 2000 if place.quick else 4000
    present = place.area(2000, 1.0, [PRESENT])[0]
    map_path = place.map(place.area(side_m, 1.0, [PAST])[0])
    localizer = Localizer(open_map(map_path), registration=False)
    whole = Localizer(open_map(map_path))
    flight = place.fly(present, place.views, USUAL_ERRORS)
    times_s: dict[str, list[float]] = defaultdict(list)
    for view in flight.views[:3]:  # warm-up
        _once(localizer, whole, view, defaultdict(list))
    for view in flight.views:
        for _ in range(REPEATS):
            _once(localizer, whole, view, times_s)
    tiles = len(localizer.tiles.centres_en_m)
    data = f"generated {side_m / 1000:g} x {side_m / 1000:g} km, {tiles} tiles"
    rows = []
    for key, text in STAGES.items():
        values_ms = np.array(times_s[key]) * 1e3
        timing = section.add(key, "ms", values_ms, data=data, seed=FLIGHT_SEED)
        rows.append([text, *timing_cells(timing), str(timing.n)])
    section.facts["view_ms"] = float(np.median(times_s["locate"])) * 1e3
    camera = flight.camera
    notes = (
        f"{camera.width_px} x {camera.height_px} px views on a map of {tiles:,} tiles at 1 m, "
        f"{len(flight.views)} views, each {REPEATS} times, warm; ms",
        f"embedding only: without the registration layer; heading unknown: "
        f"{360 / UNKNOWN_HEADING_STEP_DEG:.0f} headings; unknown and default: one round per view",
    )
    header = ("stage", "median", "p10", "p90", "p99", "n")
    section.tables = [Table("Stages of a view, ms", header, rows, notes)]
    return section


def _once(
    localizer: Localizer,
    whole: Localizer,
    flown: FlownView,
    times_s: dict[str, list[float]],
) -> None:
    """Run one view through every stage, then whole by tiles only, then by the default."""

    def stage(name: str, run: Callable[..., Made], *arguments: Any) -> Made:
        made, took_s = timed(run, *arguments)
        times_s[name].append(took_s)
        return made

    view = flown.view
    stage("decode", read_image, flown.path)
    smaller = stage("thin", downsampled, view, localizer.grid.gsd_m)
    queries = []
    for turn_deg in (-6.0, 0.0, 6.0):
        seen = stage(
            "rectify", localizer.tiles.rectified, smaller, view.telemetry.yaw_deg + turn_deg
        )
        maps = stage("represent", localizer.tiles.representation, seen.grey, seen.valid)
        queries.append(stage("embed", localizer.tiles.embedder.view, maps, seen.valid))
    stacked = np.stack(queries)
    stage("search", localizer.tiles.matcher.index.scores, stacked)
    stage("match", localizer.tiles.matcher.match, stacked)
    stage("locate", localizer.locate, view)
    if len(times_s["unknown"]) * REPEATS < len(times_s["locate"]):
        unknown = partial(localizer.locate, heading_known=False)
        stage("unknown", unknown, view)
        stage("default", whole.locate, view)
        unknown = partial(whole.locate, heading_known=False)
        stage("default unknown", unknown, view)
