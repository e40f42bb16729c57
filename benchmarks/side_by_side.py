"""Placing views of another date when heading and height are badly known: all methods, one run."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.inputs import FLIGHT_SEED, PAST, PRESENT, WIDE_ERRORS, Workplace
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
from benchmarks.posed import LEVELS_MI, poses
from benchmarks.record import Section, Table, number
from benchmarks.verdicts import Verdict, from_placed, percent
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import CONFIDENT
from orthonav.ground.imagery.mosaic import Mosaic

SIDE_M = 2000
RADII_M = (15.0, 35.0)
HEADER = (
    *("method", "pixels m", "poses", "15 m", "35 m", "median m"),
    *("ms", "p99 ms", "peak MB", f"accepted at {CONFIDENT:g}", "wrong accepted", "ECE"),
)


@dataclass(frozen=True)
class Entrant:
    """One method: how it is called in the table, and what to run."""

    name: str
    method: str
    factor: int = 1
    telemetry_only: bool = False

    @property
    def own(self) -> bool:
        """Whether it is orthonav."""
        return self.method in OWN


KNOWN = (
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
UNKNOWN = tuple(each for each in KNOWN if not each.telemetry_only)
NOTES = (
    "all views of a scene are the same for all methods; whole map, no prior; shares count every "
    "view, whatever its confidence, and a view without an answer as wrong; median m: of all "
    "answers, right or wrong; ms: per view, one core, warm, from the decoded picture",
    "registration only: the whole map is searched by FFT, tiles propose nothing; embedding only: "
    "the map as if it had no registration layer",
    "the others get the view rectified by orthonav's code, once per pose of orthonav's bank (8 "
    "deg and 13 % apart, three standard deviations; all headings where unknown), all of it with "
    "a mask, and the whole map; the best value of any pose and place is the answer. Pixels: "
    "orthonav searches at 4 and 8 m too and finishes at 1 or 2 m; the others' banks would take "
    "at least 16 times as long at 1 m",
    "matchTemplate: TM_CCOEFF_NORMED with a mask, the same numbers by FFT with the map's spectra "
    "made once (`cv2.matchTemplate` with a mask takes several times as long)",
    f"mutual information: {LEVELS_MI} grey classes, exact joint histogram at every pixel of 8 m, "
    "by FFT; phase correlation by FFT too, the map's spectrum made once; SIFT: keypoints of the "
    "map made once",
    "peak MB: resident memory of a process that does nothing else, Python, NumPy and OpenCV "
    "(about 45 MB) included; the others hold the orthophoto decoded, orthonav opens its map",
    "wrong accepted: accepted views wrong by more than 35 m; the others state no confidence",
)


def measure(place: Workplace) -> Section:
    """Both scenes: heading off by 10 deg, heading unknown; height off by 10 %."""
    section = Section("Registration beside other methods")
    past, present = place.area(SIDE_M, 1.0, [PAST, PRESENT])
    map_path = place.map(past)
    pixels = stored(past, map_path, place.scratch)
    known, unknown = (12, 4) if place.quick else (100, 25)
    scenes = (
        ("heading off by 10 deg, height by 10 % (sd)", KNOWN, True, known),
        ("heading unknown, height off by 10 % (sd)", UNKNOWN, False, unknown),
    )
    for title, entrants, heading_known, count in scenes:
        flight = place.flown(present, count, WIDE_ERRORS)
        task = Task("", str(map_path), str(flight), heading_known, pixels=str(pixels))
        verdicts = []
        for each in entrants:
            result = placed(
                replace(
                    task, method=each.method, factor=each.factor, telemetry_only=each.telemetry_only
                )
            )
            verdicts.append((each, from_placed(result), float(result["peak_mb"])))
            print(f"        {title}: {each.name} done", file=sys.stderr, flush=True)
        section.tables.append(_table(section, title, heading_known, verdicts))
    return section


def stored(past: Path, map_path: Path, scratch: Path) -> Path:
    """The orthophoto in the map's own raster, for processes that have no GDAL."""
    localizer = Localizer(open_map(map_path), registration=False)
    grid = localizer.grid
    with Mosaic.open([past]).grid_sheet(localizer.sheet.frame, grid) as raster:
        pixels = raster.read(0, 0, grid.width_px, grid.height_px)
    mean = round(float(pixels.grey[pixels.valid].mean()))
    out = scratch / f"{map_path.stem}.npz"
    grey = np.where(pixels.valid, pixels.grey, mean).astype(np.uint8)
    np.savez(out, grey=grey, valid=pixels.valid)
    return out


def _table(
    section: Section,
    title: str,
    heading_known: bool,
    verdicts: Sequence[tuple[Entrant, Verdict, float]],
) -> Table:
    tried = len(poses(heading_known, WIDE_ERRORS.yaw_std_deg))
    data = f"generated {SIDE_M} m square, 1 m, {title}"
    rows = []
    for each, verdict, peak_mb in verdicts:
        name = f"{title}: {each.name}"
        for radius_m in RADII_M:
            hits = verdict.within(radius_m)
            section.add_share(f"{name}: within {radius_m:g} m", hits, data=data, seed=FLIGHT_SEED)
        time = section.add(f"{name}: time", "ms", verdict.times_ms, data=data, seed=FLIGHT_SEED)
        section.add(f"{name}: peak memory", "MB", [peak_mb], data=data, seed=FLIGHT_SEED)
        count = (
            "own" if each.own else "1" if each.telemetry_only or each.method == SIFT else str(tried)
        )
        rows.append(
            [
                each.name,
                "own" if each.own else str(each.factor),
                count,
                *(percent(float(verdict.within(radius_m).mean())) for radius_m in RADII_M),
                *(number(verdict.median_m), number(time.median)),
                *(number(float(np.percentile(verdict.times_ms, 99))), number(peak_mb)),
                *_stated(verdict),
            ]
        )
    views = len(verdicts[0][1].times_ms)
    first = (
        f"{views} views, generated {SIDE_M / 1000:g} x {SIDE_M / 1000:g} km at 1 m, 2016 to 2021"
    )
    notes = NOTES if not section.tables else ()
    return Table(f"Registration: {title}", HEADER, rows, (first, *notes))


def _stated(verdict: Verdict) -> list[str]:
    """Accepted, wrong among them, ECE; dashes without a stated confidence."""
    if not verdict.states_confidence:
        return ["-", "-", "-"]
    return [
        percent(float(verdict.accepted.mean())),
        str(verdict.wrong_accepted),
        f"{verdict.ece:.3f}",
    ]
