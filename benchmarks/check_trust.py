"""How far the verdict of a check can be trusted: predicted against measured, scenes left out.

`python -m benchmarks.check_trust --work DIR [--views 20] [--conditions N] [--fit] [--out FILE]`
checks maps of all scenes of two dates beside the checkout (`../shared/data`, or the folder that
ORTHONAV_DATA names) and of generated ones, without the second date, and places simulated views of
that date. Views are 256, 160 and 112 px of the map wide, with a prior position and without: each
pair is measured under three of these six conditions, so that all occur in every scene. What is
predicted for a scene is recalibrated by the others. `--fit` prints the recalibration by all scenes.
DIR keeps maps, flights and outcomes; an interrupted run goes on where it was.
"""

import argparse
import json
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from itertools import pairwise
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from benchmarks.inputs import file_of, map_of
from benchmarks.record import Table, provenance
from benchmarks.trust_views import Pair, pairs
from orthonav.core.files import write_text
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import CONFIDENT, Fix
from orthonav.ground.check.recalibrate import LEARNT, PLAIN, Recalibration, expit, logit
from orthonav.ground.check.request import CheckRequest
from orthonav.ground.check.run import check_map
from orthonav.ground.check.verdict import GO_LOW, NARROW_PX
from orthonav.ground.simulate.flight import DEFAULT_CAMERA, Errors, SimulateRequest, simulate_flight
from orthonav.onboard.run import SingleViews, localize_flight

YAW_STD_DEG, AGL_STD = 10.0, 0.1
WIDTHS_PX = (256, 160, 112)
PRIOR_PX = 60.0
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0001)
SPREAD = 1.2816
"""Standard deviations of the logit from the middle to the ends of an 80 % interval."""
STDS = np.arange(1, 31) / 10
"""Standard deviations between scenes that are compared."""
RIDGE = Recalibration(0.1, 2.0, 0.5, 0.5, 0.0)
"""Ridge of the fit, per unit of the mean log likelihood, over 100."""
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Outcome:
    """A check and a flight: shares by trials at the places of views, and which were right.

    - `scene`, `map`: what was left out, and what was checked.
    - `width_px`, `prior`: of the views.
    - `shares`: of trials that are placed, where each view was; `right`: whether the view was
      placed, right and with confidence; `wrong`: how many were confident and wrong.
    - `error_m`, `measured_m`: expected and measured error of right views, root mean square.
    """

    scene: str
    map: str
    width_px: int
    prior: bool
    shares: list[float]
    right: list[bool]
    wrong: int
    error_m: float
    measured_m: float

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
        is_wide = self.prior or self.side_px >= NARROW_PX
        return is_wide and self.low(by) >= GO_LOW

    def low(self, by: Recalibration) -> float:
        """Lower end of the 80 % interval of the mean."""
        return float(expit(logit(self.predicted(by)) - SPREAD * by.std).mean())


def main() -> None:
    """Check, fly, compare, print; write Markdown where a file is named."""
    options = _parser().parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    about = provenance("check trust")
    chosen = _scenes_in_turn([each for each in pairs() if each.is_there])
    found: list[Outcome] = []
    for turn in range(len(WIDTHS_PX)):
        for number, pair in enumerate(chosen):
            if options.conditions and len(found) >= options.conditions:
                continue
            width_px = WIDTHS_PX[(turn + number) % len(WIDTHS_PX)]
            found.append(_outcome(pair, width_px, (turn + number // 3) % 2 == 0, options))
            print(" ".join(_row(found[-1], LEARNT)), flush=True)
    head = f"commit {about['commit'][:10]}, sources {about['sources']}, {about['cpu']}"
    text = "\n".join([head, "", *(each.markdown() for each in tables(found, options))])
    print("\n" + text)
    if options.fit:
        print("LEARNT =", fitted(found))
    if options.out:
        write_text(options.out, text + "\n")


def _scenes_in_turn(chosen: Sequence[Pair]) -> list[Pair]:
    """The first pair of every scene, then the second, so that a part of a run has all scenes."""
    turns = [
        sum(other.scene == each.scene for other in chosen[:i]) for i, each in enumerate(chosen)
    ]
    return [chosen[i] for i in sorted(range(len(chosen)), key=lambda i: turns[i])]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.check_trust", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--work", type=Path, required=True, help="folder for maps and flights")
    parser.add_argument("--views", type=int, default=20, help="views per condition (default 20)")
    parser.add_argument("--effort", type=float, default=0.05, help="of the checks (default 0.05)")
    parser.add_argument("--conditions", type=int, help="end after so many (default: all)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fit", action="store_true", help="print what all scenes say")
    parser.add_argument("--out", type=Path, help="Markdown file to write too")
    return parser


def _outcome(pair: Pair, width_px: int, prior: bool, options: argparse.Namespace) -> Outcome:
    """The outcome of a pair under one condition, stored in the folder of work."""
    name = f"{pair.map}-{pair.views}-{width_px}-{prior}-{options.views}-{options.seed}"
    stored: Path = options.work / f"check-{name.replace('/', '-').replace(':', '-')}.json"
    if not stored.is_file():
        made = _measured(pair, width_px, prior, options)
        write_text(stored, json.dumps(asdict(made)))
    return Outcome(**json.loads(stored.read_text(encoding="utf-8")))


def _measured(pair: Pair, width_px: int, prior: bool, options: argparse.Namespace) -> Outcome:
    ortho, over = (file_of(each, options.work) for each in (pair.map, pair.views))
    path = map_of(ortho, options.work)
    localizer = Localizer(open_map(path))
    gsd_m = localizer.sheet.grid.gsd_m
    agl_m = width_px * gsd_m / min(DEFAULT_CAMERA.extent)
    prior_m = PRIOR_PX * gsd_m if prior else None
    errors = Errors(yaw_std_deg=YAW_STD_DEG, agl_std=AGL_STD, prior_std_m=prior_m)
    name = f"check-{over.parent.name}-{over.stem}-{width_px}-{prior}-{options.views}"
    folder = options.work / f"{name}-{options.seed}"
    if not folder.is_dir():
        request = SimulateRequest(
            [over], folder, random=options.views, agl_m=agl_m, errors=errors, seed=options.seed
        )
        simulate_flight(request)
    asked = CheckRequest(
        path,
        camera=DEFAULT_CAMERA,
        agl_m=agl_m,
        yaw_std_deg=YAW_STD_DEG,
        agl_std=AGL_STD,
        prior_std_m=prior_m,
        relief_m=0.0,
        tilt_std_deg=0.0,
        effort=options.effort,
        extras=False,
        workers=1,
        recalibration=PLAIN,
    )
    cells = check_map(asked)[0].cells
    grid = cells.grid
    shares, right, wrong, off_m, expected_m = [], [], 0, [], []
    truth = read_truth(folder / "truth.csv")
    for result in localize_flight(SingleViews(localizer), open_flight(folder)):
        true = localizer.sheet.frame.en_from_latlon(*truth[result.frame])
        at = np.argmax(grid.counts(np.array([true])))
        inside = bool(grid.counts(np.array([true])).any())
        share = float(cells.probability.ravel()[at]) if inside else math.nan
        if not share > 0:  # beside the map
            continue
        fix, error_m, confident = result.outcome, math.inf, False
        if isinstance(fix, Fix):
            place = localizer.sheet.frame.en_from_latlon(fix.lat_deg, fix.lon_deg)
            error_m, confident = math.dist(place, true), fix.confidence >= CONFIDENT
        near = isinstance(fix, Fix) and error_m <= fix.radius_m
        shares.append(round(share, 4))
        right.append(confident and near)
        wrong += confident and not near
        if confident and near:
            off_m.append(error_m)
            expected_m.append(float(cells.error_m.ravel()[at]))
    rms = [
        math.sqrt(np.mean(np.square(each))) if each else math.nan for each in (expected_m, off_m)
    ]
    return Outcome(pair.scene, pair.map, width_px, prior, shares, right, int(wrong), *rms)


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
        return total / len(scenes) + 0.01 * float(np.array(astuple(RIDGE)[:4]) @ off**2)

    values = minimize(loss, np.array(astuple(PLAIN)[:4]), method="Nelder-Mead").x
    by = _recalibration(np.round(values, 2))
    return replace(by, std=round(_between_scenes(found, by), 2))


def _recalibration(values: Array) -> Recalibration:
    """With the four values that are fitted."""
    shift, slope, narrow, no_prior = (float(each) for each in values)
    return Recalibration(shift, slope, narrow, no_prior, 0.0)


def _between_scenes(found: Sequence[Outcome], by: Recalibration) -> float:
    """Standard deviation of the logit of measured less predicted, beyond that of few views.

    The likeliest one, if the logit of each condition differs from the predicted one by a normal
    deviate and views come out right independently.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(41)
    weights = weights / weights.sum()

    def likelihood(std: float) -> float:
        total = 0.0
        for each in found:
            if not each.right:
                continue
            middle = logit(each.predicted(by))
            share = np.clip(expit(middle + std * nodes[:, None]).mean(axis=1), 1e-4, 1 - 1e-4)
            right = sum(each.right)
            chance = share**right * (1 - share) ** (len(each.right) - right)
            total += math.log(float(weights @ chance))
        return total

    return float(max(STDS, key=likelihood))


def tables(found: Sequence[Outcome], options: argparse.Namespace) -> list[Table]:
    """Predicted and measured: by condition, and by fifths of what was predicted."""
    scenes = sorted({each.scene for each in found})
    by = {s: fitted([each for each in found if each.scene != s]) for s in scenes}
    rows = [_row(each, by[each.scene]) for each in found if each.right]
    header = (
        *("scene, map", "views", "n", "predicted", "80 % low", "measured", "verdict alone"),
        *("error m expected", "measured", "confident and wrong"),
    )
    gone = [each for each in found if each.right and each.is_go(by[each.scene])]
    bad = [each for each in gone if np.mean(each.right) < GO_LOW]
    above = [each for each in found if each.right]
    under = sum(np.mean(each.right) < each.low(by[each.scene]) for each in above)
    notes = (
        f"heading sd {YAW_STD_DEG:g} deg, height sd {AGL_STD:.0%}, prior {PRIOR_PX:g} px or none; "
        f"{options.views} views over the later date each, those beside the map left out, checks of "
        f"effort {options.effort:g} (40 trials); recalibrated by the other scenes",
        f"go by the low bound and the width: {len(gone)} of {len(above)}, of which {len(bad)} "
        f"measured below {GO_LOW:g}; measured below the low bound: {under} of {len(above)}",
    )
    return [
        Table("Checks and what came out", header, rows, notes),
        _bins_table(found, lambda each: each.predicted(by[each.scene]), "by the other scenes"),
        _bins_table(found, lambda each: each.predicted(PLAIN), "without recalibration"),
    ]


def _row(found: Outcome, by: Recalibration) -> list[str]:
    low = found.low(by)
    return [
        f"{found.scene}, {Path(found.map).stem}",
        f"{found.width_px} px{', prior' * found.prior}",
        str(len(found.right)),
        f"{float(found.predicted(by).mean()):.2f}" if found.right else "-",
        f"{low:.2f}",
        f"{float(np.mean(found.right)):.2f}" if found.right else "-",
        "go" if found.is_go(by) else "not go",
        f"{found.error_m:.1f}",
        f"{found.measured_m:.1f}",
        str(found.wrong),
    ]


def _bins_table(
    found: Sequence[Outcome], predicted_of: Callable[[Outcome], Array], name: str
) -> Table:
    predicted = np.concatenate([predicted_of(each) for each in found])
    right = np.concatenate([np.array(each.right, np.bool_) for each in found])
    rows, error = [], 0.0
    for low, high in pairwise(BINS):
        inside = (predicted >= low) & (predicted < high)
        if inside.any():
            means = float(predicted[inside].mean()), float(right[inside].mean())
            error += abs(means[0] - means[1]) * float(inside.mean())
            count = str(int(inside.sum()))
            rows.append([f"{low:.1f} to {min(high, 1):.1f}", count, *(f"{m:.2f}" for m in means)])
    notes = (f"calibration error {error:.3f} over fifths, {len(right)} views",)
    header = ("predicted", "views", "mean predicted", "measured")
    return Table(f"Predicted and measured, {name}", header, rows, notes)


if __name__ == "__main__":
    main()
