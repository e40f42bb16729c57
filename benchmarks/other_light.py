"""Views in other light than the map's: infrared, night, snow, flood, thermal, other seasons.

`python -m benchmarks.other_light [--views 30] [--workers 2]` places real pairs where the optional
imagery is there, and rendered ones of generated landscapes, on whole maps without a prior.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from lab.landscape import OTHER_LIGHT
from numpy.typing import NDArray

from benchmarks.record import Section, Table, number, resumed, rows_path, run, say
from benchmarks.scenes import (
    DATA,
    PAST,
    PRESENT,
    SCENES,
    USUAL,
    agl_of,
    far_m,
    flight,
    gsd_of,
    map_of,
    ortho,
    views_in,
)
from orthonav.core.files import replacing
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.localize import Localizer
from orthonav.core.localize.fix import fix_of
from orthonav.core.localize.search import Found, Search
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix, NoFix, View

SEED, WIDTH_PX = 3, 256
FAR_SHARE = 0.05
"""A position of unreported tilt is wrong beyond this share of the height, too."""
SEEDS = 31, 32
WAYS = BOTH, GRADIENTS, DEFAULT = "both kinds", "gradients", "default"
HEADER = (
    *("views > map", "views", *(f"{way}: right, accepted" for way in WAYS)),
    *("accepted and wrong", "ms both kinds", "ms default"),
)
Grey = NDArray[np.uint8]
Place = tuple[float, float]
Case = tuple[View, Place | None, bool]
"""A view, the truth of the camera, or of the ground in the middle of the picture if the last; None:
the map shows other ground."""


@dataclass(frozen=True)
class Row:
    """Views of `views` on the map of `map`, names as of `benchmarks.scenes.ortho`; a folder of
    views, or imagery they are rendered of, of which `band` is seen (0: colour). `negative`: the
    map shows other ground. `defect`: one of `DEFECTS`, what the camera does to its pictures."""

    name: str
    map: str
    views: str
    band: int = 0
    negative: bool = False
    defect: str = ""

    def cases(self, work: Path, count: int) -> Iterator[Case]:
        """As the camera shows them."""
        damage, rng = DEFECTS.get(self.defect), np.random.default_rng(SEED)
        for view, place, of_ground in self.seen(work, count):
            seen = view if damage is None else replace(view, grey=damage(view.grey, rng))
            yield seen, place, of_ground

    def seen(self, work: Path, count: int) -> Iterator[Case]:
        if (DATA / self.views).is_dir():
            folder = DATA / self.views
            recorded = open_flight(folder)
            truth = read_truth(folder / "truth_ground.csv")
            for each in list(recorded.views)[:count]:
                place = None if self.negative else truth[each.frame]
                yield View(each.grey(), recorded.camera, each.telemetry), place, True
            return
        path = ortho(self.views, work) if self.band == 0 else _band(self.views, self.band, work)
        agl_m = agl_of(WIDTH_PX, gsd_of(path))
        for flown in views_in(
            flight(path, work, views=count, errors=USUAL, seed=SEED, agl_m=agl_m)
        ):
            yield flown.view, None if self.negative else flown.truth_latlon_deg, False


def _band(name: str, band: int, work: Path) -> Path:
    """One band of an orthophoto as a file of its own."""
    path = work / f"{Path(name).stem}-band{band}.tif"
    if not path.is_file():
        with rasterio.open(DATA / name) as source:
            profile = {
                name: source.profile[name]
                for name in ("driver", "width", "height", "crs", "transform", "dtype")
            }
            with (
                replacing(path) as part,
                rasterio.open(part, "w", count=1, **profile) as target,
            ):
                target.write(source.read(band), 1)
    return path


def _noisy(grey: Grey, rng: np.random.Generator) -> Grey:
    made = grey + rng.normal(0, 12, grey.shape)
    return np.asarray(np.clip(made, 0, 255), np.uint8)


def _moved(grey: Grey, rng: np.random.Generator) -> Grey:
    """Motion blur over 9 px of a picture 640 px wide, in any direction."""
    length = 9 * grey.shape[1] / 640
    kernel = np.zeros((31, 31), np.float32)
    angle = rng.uniform(0, math.pi)
    step = length / 2 * np.array([math.cos(angle), math.sin(angle)])
    ends = [tuple(np.rint((15.5 + sign * step) * 16).astype(int).tolist()) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0, 1, cv2.LINE_AA, 4)
    return np.asarray(cv2.filter2D(grey, -1, kernel / kernel.sum()), np.uint8)


def _dotted(grey: Grey, rng: np.random.Generator) -> Grey:
    """One pixel in a hundred is dead or hot."""
    made, share = grey.copy(), rng.uniform(size=grey.shape)
    made[share < 0.005], made[share > 0.995] = 0, 255
    return made


def _recoloured(palette: int) -> Callable[[Grey, np.random.Generator], Grey]:
    """Shown in colours, and read as grey levels again."""

    def made(grey: Grey, _: np.random.Generator) -> Grey:
        low, high = float(grey.min()), float(grey.max())
        stretched = ((grey - low) * (255 / max(high - low, 1.0))).astype(np.uint8)
        return np.asarray(cv2.cvtColor(cv2.applyColorMap(stretched, palette), cv2.COLOR_BGR2GRAY))

    return made


def _aimed(grey: Grey, _: np.random.Generator) -> Grey:
    """A reticle and two lines of text."""
    made, (rows, cols) = grey.copy(), grey.shape
    size, thick = cols / 640, max(1, cols // 320)
    cv2.drawMarker(made, (cols // 2, rows // 2), 255, cv2.MARKER_CROSS, cols // 6, thick)
    cv2.circle(made, (cols // 2, rows // 2), cols // 10, 255, thick)
    for text, row in (("ALT 0270 M  SPD 18.2", 0.07), ("48.1371 N 011.5754 E", 0.97)):
        cv2.putText(made, text, (9, int(row * rows)), 0, size, 255, thick)
    return made


DEFECTS: dict[str, Callable[[Grey, np.random.Generator], Grey]] = {
    "noise of 12 grey levels": _noisy,
    "motion blur": _moved,
    "1 % dead and hot pixels": _dotted,
    "iron palette": _recoloured(cv2.COLORMAP_INFERNO),
    "rainbow palette": _recoloured(cv2.COLORMAP_JET),
    "reticle and text": _aimed,
}


def rows() -> Iterator[Row]:
    """Those whose imagery is there."""
    light = "other_light"
    chongqing, bordeaux = (f"{light}/{each}_near_infrared" for each in ("chongqing", "bordeaux"))
    night = f"{light}/night_lights"
    naip = [SCENES["naip"].file(each) for each in ("20090818", "20120731", "20180716")]
    found = [
        Row("near infrared, town (Chongqing)", f"{chongqing}/map.tif", chongqing),
        Row("near infrared, town (Bordeaux)", f"{bordeaux}/map.tif", bordeaux),
        Row("night lights, coast", f"{night}/map.tif", f"{night}/views"),
        Row("near infrared, fields (North Dakota, 2009 > 2018)", naip[2], naip[0], 4),
        Row("near infrared, fields (North Dakota, 2018 > 2012)", naip[1], naip[2], 4),
    ]
    for scene, past, present in (
        ("atlanta", "2021_08", "2024_02"),
        ("atlanta", "2012_11", "2021_08"),
        ("garching", "2001_09", "2015_04"),
        ("garching", "2020_03", "2009_04"),
    ):
        pair = SCENES[scene].pair(past, present)
        found.append(Row(f"season: {scene} {present} > {past}", pair.map, pair.views))
    for date in (PRESENT, *(each.name for each in OTHER_LIGHT)):
        for seed in SEEDS:
            folder = f"generated:{seed}"
            name = f"rendered {date} > {PAST}, landscape {seed}"
            found.append(Row(name, f"{folder}:{PAST}", f"{folder}:{date}"))
    for date in (PRESENT, "2021-07-thermal"):
        views = f"generated:{SEEDS[0]}:{date}"
        for defect in DEFECTS:
            name = f"rendered {date}, {defect}"
            found.append(Row(name, f"generated:{SEEDS[0]}:{PAST}", views, defect=defect))
    for each in OTHER_LIGHT:
        names = f"generated:1:{PAST}", f"generated:{SEEDS[0]}:{each.name}"
        found.append(Row(f"other ground: rendered {each.name}", *names, negative=True))
    for name, where, views in (
        ("Chongqing on Bordeaux", bordeaux, chongqing),
        ("Bordeaux on Chongqing", chongqing, bordeaux),
        ("night lights on Chongqing", chongqing, f"{night}/views"),
        ("night lights on Bordeaux", bordeaux, f"{night}/views"),
        ("Chongqing on night lights' map", night, chongqing),
    ):
        found.append(Row(f"other ground: {name}", f"{where}/map.tif", views, negative=True))
    for row in found:
        if all(
            each.startswith("generated") or (DATA / each).exists() for each in (row.map, row.views)
        ):
            yield row


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--views", type=int, default=30, help="views of a row")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="rows whose name has this")


def measure(options: argparse.Namespace) -> Section:
    count = 4 if options.quick else options.views
    asked = [
        each for each in rows() if not options.only or any(t in each.name for t in options.only)
    ]
    for name in dict.fromkeys(each.map for each in asked):
        _localizer(name, options.work)
    tasks = {f"{each.name} {count}": (each.name, count, options.work) for each in asked}
    lines, total = [], {True: np.zeros(2, int), False: np.zeros(2, int)}
    stored = rows_path(options.work, "rows")
    for row, found in zip(asked, resumed(stored, measured, tasks, options.workers), strict=True):
        total[row.negative] += [found["wrong"][DEFAULT], found["views"]]
        cells = [row.name, str(found["views"])]
        for way in WAYS:
            right = "-" if row.negative else str(found["right"][way])
            cells.append(f"{right}, {found['accepted'][way]}")
        cells += [str(found["wrong"][DEFAULT])]
        lines.append([*cells, *(number(found["ms"][way]) for way in (BOTH, DEFAULT))])
        say("  ".join(lines[-1]))
    notes = (
        f"accepted and wrong, in all: {total[False][0]} of {total[False][1]} views; of other "
        f"ground {total[True][0]} of {total[True][1]}",
        "whole map, no prior; heading off by 10 deg and height by 10 % (standard deviations, "
        f"reported), tilt by {USUAL.mount_std_deg:g} deg each of mount and horizon, or 3 deg in "
        f"near infrared towns, unreported; right: within 35 m, 10 px of the map or {FAR_SHARE:.0%} "
        "of the height; of recorded views the ground in the middle counts",
        "ms: processor time, mean",
    )
    return Section("Other light", [Table("Views in other light", HEADER, lines, notes)])


def _localizer(name: str, work: Path) -> Localizer:
    """On a map of level land."""
    return Localizer(open_map(map_of(ortho(name, work), work, relief="level")))


def measured(task: tuple[str, int, Path]) -> dict[str, Any]:
    """What a row says."""
    name, count, work = task
    cv2.setNumThreads(1)
    row = next(each for each in rows() if each.name == name)
    localizer = _localizer(row.map, work)
    found: dict[str, Any] = {"views": 0, "ms": dict.fromkeys(WAYS, 0.0)}
    found |= {key: dict.fromkeys(WAYS, 0) for key in ("right", "accepted", "wrong")}
    for view, truth, of_ground in row.cases(work, count):
        found["views"] += 1
        for way, locate in _ways(localizer):
            start = time.process_time()
            fix = locate(view)
            found["ms"][way] += 1e3 * (time.process_time() - start)
            if not isinstance(fix, Fix):
                continue
            right = truth is not None and _is_right(localizer, fix, truth, view, of_ground)
            found["right"][way] += right
            found["accepted"][way] += fix.is_confident
            found["wrong"][way] += fix.is_confident and not right
    found["ms"] = {way: each / max(found["views"], 1) for way, each in found["ms"].items()}
    return found


def _is_right(localizer: Localizer, fix: Fix, truth: Place, view: View, of_ground: bool) -> bool:
    place = fix.ground_latlon_deg if of_ground else (fix.lat_deg, fix.lon_deg)
    if place is None:
        return False
    off = localizer.sheet.frame.en_from_latlon(*place) - localizer.sheet.frame.en_from_latlon(
        *truth
    )
    limit_m = far_m(localizer.grid.gsd_m)
    limit_m = max(limit_m, FAR_SHARE * view.telemetry.agl_m)
    return bool(np.hypot(*off) <= limit_m)


def _ways(localizer: Localizer) -> Iterator[tuple[str, Any]]:
    assert localizer.registration is not None
    registration = localizer.registration

    def alone(view: View, gradients: bool) -> Fix | NoFix:
        search = Search.of(registration, view)
        if isinstance(search, Search) and gradients:
            search = Search(search.map, search.view.by_gradients(), None)
        best = search.best() if isinstance(search, Search) else None
        if isinstance(search, NoFix) or best is None:
            return NoFix("no_match", "not placed")
        return fix_of(Found(search, best))

    yield BOTH, partial(alone, gradients=False)
    yield GRADIENTS, partial(alone, gradients=True)
    yield DEFAULT, localizer.locate


if __name__ == "__main__":
    sys.exit(run(measure, add))
