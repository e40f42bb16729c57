"""How far the verdict of a check can be trusted: predicted against measured, scenes left out.

`python -m benchmarks.check_trust --work DIR [--views 20] [--fit]` checks maps of
scenes of two dates without the second date, and places simulated views of that date. Views are 256,
160, 112 and 80 px of the map wide, with a prior position and without: each pair is measured under
four of these eight conditions, so that all occur in every scene. What is predicted for a scene is
recalibrated by the others. `--fit` prints the recalibration by all scenes. Rerun to resume.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from benchmarks.record import Section, Table, resumed, rows_path, run, say
from benchmarks.scenes import (
    WIDE,
    Pair,
    agl_of,
    chosen,
    flight,
    leave_one_out_pairs,
    map_of,
    ortho,
    place_of,
    views_in,
)
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import CONFIDENT, Fix
from orthonav.ground.check.estimate import LEARNT, PLAIN, Recalibration
from orthonav.ground.check.findings import RULES, uncertainty
from orthonav.ground.check.flights import scene_shifts, shifted
from orthonav.ground.check.records import CheckRequest, Range
from orthonav.ground.check.run import check_map
from orthonav.ground.simulate.flight import DEFAULT_CAMERA
from orthonav.onboard.run import SingleViews, locate_view

WIDTHS_PX = (256, 160, 112, 80)
PRIOR_PX, EFFORT = 60.0, 0.05
STDS, STDS_NARROW = np.arange(4, 25, 2) / 10, np.arange(0, 15, 2) / 10
"""Standard deviations between scenes, and what a halving of the width adds, that are compared."""
RIDGE = Recalibration(0.1, 2.0, 0.5, 0.5, 0.0)
"""Ridge of the fit, per unit of the mean log likelihood, over 100."""
HOLDS, MISSED = 0.8, 100.0
"""Wanted fraction of intervals that hold, and the weight of what is missing of it."""
Array = NDArray[np.float64]


@dataclass
class Outcome:
    """A check and a flight: shares by trials at the places of views, and which were right.

    - `scene`, `map`: what was left out, and what was checked.
    - `width_px`, `prior`: of the views.
    - `shares`: of trials that are placed, where each view was; `right`: whether the view was
      placed, right and with confidence; `wrong`: how many were confident and wrong.
    """

    scene: str
    map: str
    width_px: int
    prior: bool
    shares: list[float] = field(default_factory=list)
    right: list[bool] = field(default_factory=list)
    wrong: int = 0

    @property
    def side_px(self) -> float:
        """Root of the area of a view, pixels of the map."""
        extent = DEFAULT_CAMERA.extent
        return self.width_px * math.sqrt(math.prod(extent)) / min(extent)

    def predicted(self, by: Recalibration) -> Array:
        """Predicted shares (N,)."""
        return by(np.array(self.shares), self.side_px, self.prior)

    def is_go(self, by: Recalibration) -> bool:
        """Whether a check of nothing else would say *go*."""
        mean, prior_px = self.mean(by), PRIOR_PX if self.prior else math.inf
        return mean.low >= RULES.fixes.go and not uncertainty(mean, self.side_px, prior_px)

    def mean(self, by: Recalibration) -> Range:
        """Of the predicted shares, with its interval, as a check states it."""
        shifts = scene_shifts(by.std_of(self.side_px))
        return Range.of(shifted(self.predicted(by), shifts).mean(axis=1))

    def holds(self, by: Recalibration) -> bool:
        """Whether the measured share is in the interval, to half a view."""
        mean, half = self.mean(by), 0.5 / len(self.right)
        return bool(mean.low - half <= np.mean(self.right) <= mean.high + half)


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--views", type=int, default=20, help="views per condition (default 20)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="pairs whose name has this")
    parser.add_argument("--fit", action="store_true", help="print what all scenes say")


def measure(options: argparse.Namespace) -> Section:
    pairs = _scenes_in_turn(chosen(leave_one_out_pairs(), options.only))
    views = 4 if options.quick else options.views
    tasks: dict[str, Any] = {}
    for turn in range(1 if options.quick else len(WIDTHS_PX)):
        for number, pair in enumerate(pairs):
            width_px = WIDTHS_PX[(turn + number) % len(WIDTHS_PX)]
            prior = (turn + number // 3) % 2 == 0
            name = f"{pair.name} {width_px} px{', prior' * prior}, {views} views"
            tasks[name] = (pair, width_px, prior, views, options)
    found = []
    for each in resumed(rows_path(options.work, f"conditions-{options.seed}"), _measured, tasks):
        if each["right"]:  # views on the map
            found.append(Outcome(**each))
            say(" ".join(_row(found[-1], LEARNT)))
    if options.fit:
        print("LEARNT =", fitted(found))
    return Section("Checks, scenes left out", tables(found, options))


def _scenes_in_turn(pairs: Sequence[Pair]) -> list[Pair]:
    """The first pair of every scene, then the second, so that a part of a run has all scenes."""
    turns = [
        sum(place_of(other) == place_of(each) for other in pairs[:i])
        for i, each in enumerate(pairs)
    ]
    return [pairs[i] for i in sorted(range(len(pairs)), key=lambda i: turns[i])]


def _measured(task: tuple[Pair, int, bool, int, argparse.Namespace]) -> dict[str, Any]:
    pair, width_px, prior, views, options = task
    work: Path = options.work
    path, over = map_of(ortho(pair.map, work), work), ortho(pair.views, work)
    localizer = Localizer(open_map(path))
    gsd_m = localizer.sheet.grid.gsd_m
    agl_m, prior_m = agl_of(width_px, gsd_m), PRIOR_PX * gsd_m if prior else None
    errors = replace(WIDE, prior_std_m=prior_m)
    folder = flight(over, work, views=views, errors=errors, seed=options.seed, agl_m=agl_m)
    asked = CheckRequest(
        path,
        camera=DEFAULT_CAMERA,
        agl_m=agl_m,
        yaw_std_deg=errors.yaw_std_deg,
        agl_std=errors.agl_std,
        prior_std_m=prior_m,
        relief_m=0.0,
        tilt_std_deg=0.0,
        effort=EFFORT,
        workers=1,
        recalibration=PLAIN,
    )
    cells = check_map(asked)[0].cells
    grid = cells.grid
    found = Outcome(place_of(pair), pair.map, width_px, prior)
    frame, single = localizer.sheet.frame, SingleViews(localizer)
    for each in views_in(folder):
        true = frame.en_from_latlon(*each.truth_latlon_deg)
        counts = grid.counts(np.array([true]))
        share = float(cells.probability.ravel()[np.argmax(counts)]) if counts.any() else math.nan
        if not share > 0:  # beside the map
            continue
        fix, _ = locate_view(single, each.view)
        confident = near = False
        if isinstance(fix, Fix):
            off_m = math.dist(frame.en_from_latlon(fix.lat_deg, fix.lon_deg), true)
            confident, near = fix.confidence >= CONFIDENT, off_m <= fix.radius_m
        found.shares.append(round(share, 4))
        found.right.append(confident and near)
        found.wrong += confident and not near
    return asdict(found)


def fitted(found: Sequence[Outcome]) -> Recalibration:
    """The recalibration under which the views are likeliest, each scene with the same weight."""
    scenes = sorted({each.scene for each in found})
    counts = {s: sum(len(each.right) for each in found if each.scene == s) for s in scenes}

    def loss(values: Array) -> float:
        by = _recalibration(values)
        total = 0.0
        for each in found:
            predicted = each.predicted(by)
            chance = np.where(each.right, predicted, 1 - predicted)
            total -= float(np.log(np.clip(chance, 1e-6, 1.0)).sum()) / counts[each.scene]
        off = values - np.array(astuple(PLAIN)[:4])
        return total / max(len(scenes), 1) + 0.01 * float(np.array(astuple(RIDGE)[:4]) @ off**2)

    values = minimize(loss, np.array(astuple(PLAIN)[:4]), method="Nelder-Mead").x
    by = _recalibration(np.round(values, 2))
    std, narrow = _between_scenes(found, by)
    return replace(by, std=std, std_narrow=narrow)


def _recalibration(values: Array) -> Recalibration:
    """With the four values that are fitted."""
    shift, slope, narrow, no_prior = (float(each) for each in values)
    return Recalibration(shift, slope, narrow, no_prior, 0.0)


def _between_scenes(found: Sequence[Outcome], by: Recalibration) -> tuple[float, float]:
    """Standard deviation of the logit between scenes, and what every halving of the width adds.

    Those of the narrowest intervals that hold in 80 % of the conditions of every width of views.
    """

    def width(stds: tuple[float, float]) -> float:
        spread = replace(by, std=stds[0], std_narrow=stds[1])
        held: dict[int, list[bool]] = {}
        for each in found:
            held.setdefault(each.width_px, []).append(each.holds(spread))
        missing = sum(max(0.0, HOLDS - float(np.mean(each))) for each in held.values())
        means = [each.mean(spread) for each in found]
        return missing * MISSED + float(np.mean([mean.high - mean.low for mean in means]))

    every = [(float(std), float(narrow)) for std in STDS for narrow in STDS_NARROW]
    return min(every, key=width)


def tables(found: Sequence[Outcome], options: argparse.Namespace) -> list[Table]:
    """Predicted and measured: by condition, and by the width of views."""
    scenes = sorted({each.scene for each in found})
    by = {s: fitted([each for each in found if each.scene != s]) for s in scenes}
    rows = [_row(each, by[each.scene]) for each in found]
    header = ("scene, map", "views", "n", "predicted", "interval", "measured", "holds", "false")
    go = [each for each in found if each.is_go(by[each.scene])]
    bad = [each for each in go if np.mean(each.right) < RULES.fixes.go]
    notes = (
        f"heading sd 10 deg, height sd 10 %, prior {PRIOR_PX:g} px or none; "
        f"{options.views} views over the later date each, those beside the map left out, checks of "
        f"effort {EFFORT:g} (40 to 75 trials); recalibrated by the other scenes; interval: of 80 %",
        f"go by the mean chance only: {len(go)} of {len(found)}, of which {len(bad)} measured "
        f"below {RULES.fixes.go:g}",
    )
    return [Table("Checks and what came out", header, rows, notes), _widths_table(found, by)]


def _row(found: Outcome, by: Recalibration) -> list[str]:
    views = f"{found.width_px} px{', prior' * found.prior}"
    about = [f"{found.scene}, {Path(found.map).stem}", views, str(len(found.right))]
    mean, measured = found.mean(by), f"{float(np.mean(found.right)):.2f}"
    interval = f"{mean.low:.2f} to {mean.high:.2f}"
    holds = "yes" if found.holds(by) else "no"
    return [*about, f"{mean.median:.2f}", interval, measured, holds, str(found.wrong)]


def _widths_table(found: Sequence[Outcome], by: dict[str, Recalibration]) -> Table:
    """How far predictions are off, and how often intervals hold, by the width of views."""
    rows = []
    for width_px in (*WIDTHS_PX, None):
        some = [each for each in found if width_px in (each.width_px, None)]
        if not some:
            continue
        means = [each.mean(by[each.scene]) for each in some]
        measured = [float(np.mean(each.right)) for each in some]
        pairs = zip(means, measured, strict=True)
        off = [abs(mean.median - share) for mean, share in pairs]
        held = sum(each.holds(by[each.scene]) for each in some)
        wide = float(np.mean([mean.high - mean.low for mean in means]))
        name = "all" if width_px is None else f"{width_px} px"
        rows.append([name, str(len(some)), f"{np.mean(off):.2f}", f"{wide:.2f}", f"{held}"])
    header = ("views", "conditions", "mean error", "mean width of the interval", "intervals hold")
    return Table("By the width of views", header, rows)


if __name__ == "__main__":
    sys.exit(run(measure, add))
