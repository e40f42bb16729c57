"""Registration and embedding beside other methods: the same views, each method in a process.

The others get the view rectified by orthonav's code with a mask, once per pose of orthonav's bank
or under the reported pose only, and the whole map.
"""

import argparse
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.placing import (
    BOTH,
    CANNY,
    MUTUAL,
    OWN,
    PHASE,
    REGISTRATION,
    SIFT,
    TEMPLATE,
    TILES,
    Task,
    placed,
)
from benchmarks.posed import canny_edges
from benchmarks.record import Section, Table, number, percent, run, say
from benchmarks.scenes import (
    PAST,
    PRESENT,
    SCENES,
    WIDE,
    Pair,
    agl_of,
    flight,
    gsd_of,
    localizer_of,
    map_of,
    ortho,
    store,
)
from benchmarks.verdicts import Verdict
from orthonav.core.records import CONFIDENT
from orthonav.ground.simulate.flight import Errors

NAME = "comparison"
SEED = 7
DENSER = 0.9375
USUAL_ERRORS = Errors(yaw_std_deg=5.0, agl_std=0.05)
# With this deviation only the reported heading is tried; the error is far below a pixel.
NO_ERRORS = Errors(yaw_std_deg=0.001)
HEADER = (
    *("method", "pixels m", "15 m", "35 m", "median m", "ms", "p99 ms", "peak MB", "carried MB"),
    *(f"accepted at {CONFIDENT:g}", "false", "ECE"),
)
NOTES = (
    "whole map, no prior; a view without an answer counts as wrong; ms: processor time of a view, "
    "warm, from the decoded image; peak MB: resident memory of a process that does nothing else; "
    "carried: map file; orthophoto as grey JPEG, or its edges as 1-bit PNG",
)


@dataclass(frozen=True)
class Entrant:
    """A method: name in the table, what is run, and `overlap` of the tiles of its map."""

    name: str
    method: str
    factor: int = 1
    telemetry_only: bool = False
    overlap: float = 0.875


REGISTERED = (
    Entrant("orthonav (default)", BOTH),
    Entrant("orthonav, registration only", REGISTRATION),
    Entrant("orthonav, embedding only", TILES),
    Entrant("matchTemplate, grey, reported pose", TEMPLATE, 1, True),
    Entrant("matchTemplate, grey, pose bank", TEMPLATE, 4),
    Entrant("matchTemplate, Canny, reported pose", CANNY, 1, True),
    Entrant("matchTemplate, Canny, pose bank", CANNY, 4),
    Entrant("phase correlation, reported pose", PHASE, 1, True),
    Entrant("phase correlation, pose bank", PHASE, 4),
    Entrant("mutual information, pose bank", MUTUAL, 8),
    Entrant("SIFT, ratio test, RANSAC", SIFT),
)
EMBEDDED = (
    Entrant("orthonav, embedding only", TILES),
    Entrant(f"orthonav, embedding only, overlap {DENSER:g}", TILES, overlap=DENSER),
    Entrant("matchTemplate, grey, reported pose", TEMPLATE, 1, True),
    Entrant("matchTemplate, Canny, reported pose", CANNY, 1, True),
    Entrant("SIFT, ratio test, RANSAC", SIFT),
)


@dataclass(frozen=True)
class Round:
    """Entrants on the views of one pair: `registered`, or `embedded` without registration."""

    part: str
    title: str
    pair: Pair
    errors: Errors
    heading_known: bool = True


def rounds() -> list[Round]:
    """All of them; those over imagery that is absent are left out."""
    generated = SCENES["generated_1"].pair(PAST, PRESENT)
    naip = SCENES["naip"].pair("20090818", "20180716")
    found = [
        Round("registered", "heading off by 10 deg, height by 10 %", generated, WIDE),
        Round("registered", "heading unknown, height off by 10 %", generated, WIDE, False),
    ]
    for pair in (generated, naip):
        if pair.is_there:
            off = f"{pair.name}, embedding only, heading off by 5 deg, height by 5 %"
            found.append(Round("embedded", off, pair, USUAL_ERRORS))
            exact = f"{pair.name}, embedding only, heading and height exact"
            found.append(Round("embedded", exact, pair, NO_ERRORS))
    return found


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--views", type=int, default=100, help="a quarter with unknown heading")
    parser.add_argument("--part", choices=("registered", "embedded"), help="only this part")


def measure(options: argparse.Namespace) -> Section:
    section = Section("Registration beside other methods")
    views = 12 if options.quick else options.views
    for each in rounds():
        if options.part in (None, each.part):
            count = views if each.heading_known else max(1, views // 4)
            section.tables.append(_table(each, count, options.work))
    return section


def _table(each: Round, views: int, work: Path) -> Table:
    past, present = ortho(each.pair.map, work), ortho(each.pair.views, work)
    localizer = localizer_of(each.pair.map, work)
    pixels = store(past, localizer, work / f"{past.parent.name}-{past.stem}.npz")
    agl_m = agl_of(256, gsd_of(present))
    flown = flight(present, work, views=views, errors=each.errors, seed=SEED, agl_m=agl_m)
    entrants = REGISTERED if each.part == "registered" else EMBEDDED
    rows = []
    for entrant in entrants:
        if entrant.telemetry_only and not each.heading_known:
            continue
        map_path = map_of(past, work, overlap=entrant.overlap)
        task = Task(entrant.method, str(map_path), str(flown), each.heading_known)
        task = replace(task, pixels=str(pixels), factor=entrant.factor)
        result = placed(replace(task, telemetry_only=entrant.telemetry_only))
        carried_mb = _carried_mb(entrant, map_path, pixels)
        rows.append(_row(entrant, Verdict.of(result["rows"]), result["peak_mb"], carried_mb))
        say(f"        {each.title}: {' '.join(rows[-1])}")
    return Table(f"{each.title}, {views} views", HEADER, rows, NOTES)


def _carried_mb(entrant: Entrant, map_path: Path, pixels: Path) -> float:
    """Megabytes that must be on board; NaN for keypoints."""
    if entrant.method in OWN:
        return map_path.stat().st_size / 1e6
    with np.load(pixels) as stored:
        grey, valid = stored["grey"], stored["valid"]
    if entrant.method == CANNY:
        bilevel = [int(cv2.IMWRITE_PNG_BILEVEL), 1]
        return len(cv2.imencode(".png", canny_edges(grey, valid), bilevel)[1]) / 1e6
    jpeg = [int(cv2.IMWRITE_JPEG_QUALITY), 90]
    return math.nan if entrant.method == SIFT else len(cv2.imencode(".jpg", grey, jpeg)[1]) / 1e6


def _row(entrant: Entrant, verdict: Verdict, peak_mb: float, carried_mb: float) -> list[str]:
    stated = ["-", "-", "-"]
    if np.isfinite(verdict.confidence).any():
        accepted = percent(float(verdict.accepted.mean()))
        stated = [accepted, str(verdict.wrong_accepted), f"{verdict.ece:.3f}"]
    return [
        entrant.name,
        "own" if entrant.method in OWN else str(entrant.factor),
        *(percent(float(verdict.within(radius_m).mean())) for radius_m in (15.0, 35.0)),
        *(number(v) for v in (verdict.median_m, float(np.median(verdict.times_ms)))),
        *(number(v) for v in (float(np.percentile(verdict.times_ms, 99)), peak_mb, carried_mb)),
        *stated,
    ]


if __name__ == "__main__":
    sys.exit(run(NAME, __doc__, measure, add))
