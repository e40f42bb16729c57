"""How far confidence can be trusted on ground that it was not learnt on: whole scenes left out.

`python -m benchmarks.trust --work DIR [--views 40] [--seed 1] [--workers 2] [--fit]` places views
of scenes of two dates, and views that are on no map. It prints what the shipped confidence says of
them, and what one says that was fitted to the other scenes only. `--fit` prints weights fitted to
all of these views. About an hour on two cores; rerun to resume.
"""

import argparse
import math
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.warp import transform_bounds
from scipy.optimize import minimize
from scipy.special import expit

from benchmarks.placing import views_in
from benchmarks.record import Section, Table, percent, resumed, rows_path, run, say
from benchmarks.scenes import (
    USUAL,
    Pair,
    agl_of,
    chosen,
    flight,
    gsd_of,
    leave_one_out_pairs,
    map_of,
    ortho,
    place_of,
)
from benchmarks.scenes import far_m as far_m_of
from orthonav.core.localize import Localizer
from orthonav.core.localize.confidence import (
    ALONE,
    FEATURES,
    USUAL_CHANCES,
    Chances,
    RegisteredConfidence,
    features_of,
)
from orthonav.core.localize.fix import fix_of
from orthonav.core.localize.localizer import RegistrationLocalizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import CONFIDENT, PRIOR_SIGMAS, RADIUS_SHARE, NoFix, Telemetry, View
from orthonav.ground.build.calibrate import LEAST
from orthonav.ground.evaluate.statistics import calibrate

NAME = "trust"
RIDGE = 1e-5
"""Weight of the ridge of the fit: only against weights without bound."""
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Judged:
    """Rows of views (N), their features (N, F) and whether they are right (N,)."""

    rows: list[dict[str, Any]]
    features: Array
    right: NDArray[np.bool_]

    @classmethod
    def of(cls, rows: list[dict[str, Any]]) -> "Judged":
        """From the rows of `views_of`."""
        made = [features_of(each["evidence"], Chances(**each["chances"])) for each in rows]
        return cls(rows, np.stack(made), np.array([each["right"] for each in rows]))

    def where(self, **wanted: Any) -> NDArray[np.bool_]:
        """Mask (N,) of the rows that have these values."""
        return np.array(
            [all(each[name] == value for name, value in wanted.items()) for each in self.rows]
        )

    def shipped(self) -> Array:
        """Confidence (N,) as the program states it."""
        return np.array(
            [
                RegisteredConfidence.usual(Chances(**each["chances"]))(each["evidence"])
                for each in self.rows
            ]
        )

    def fitted(self, train: NDArray[np.bool_]) -> RegisteredConfidence:
        """Fitted to the rows `train`."""
        return fit_judge(self.features[train], self.right[train])

    def left_out(self) -> Array:
        """Confidence (N,) of each row by a fit to all other scenes."""
        scenes = np.array([each["scene"] for each in self.rows])
        found = np.zeros(len(self.rows))
        for scene in np.unique(scenes):
            inside = scenes == scene
            judge = self.fitted(~inside)
            found[inside] = [judge.of(each) for each in self.features[inside]]
        return found


def fit_judge(features: Array, right: NDArray[np.bool_]) -> RegisteredConfidence:
    """Biases and weights, none negative, under which the outcome of views (N, F) is likeliest."""
    mean, std = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-6)
    scaled, count = (features - mean) / std, len(FEATURES)

    def loss(parameters: Array) -> tuple[float, Array]:
        weights = parameters[2:]
        fits = expit(parameters[0] + scaled[:, :-ALONE] @ weights[:-ALONE])
        alone = expit(parameters[1] + scaled[:, -ALONE:] @ weights[-ALONE:])
        product = fits * alone
        both = np.clip(product, LEAST, 1 - LEAST)
        value = -np.log(np.where(right, both, 1 - both)).mean()
        # A limited loss has no slope: with one, searches along a line would fail.
        slope = np.where(right, -1.0, both / (1 - both)) * (both == product) / len(right)
        first, second = slope * (1 - fits), slope * (1 - alone)
        slopes = scaled[:, :-ALONE].T @ first, scaled[:, -ALONE:].T @ second
        gradient = np.concatenate([[first.sum(), second.sum()], *slopes])
        gradient[2:] += 2 * RIDGE * weights
        return float(value + RIDGE * (weights**2).sum()), gradient

    start = np.full(2 + count, 0.3)
    bounds: Any = [(None, None)] * 2 + [(0.0, None)] * count
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds).x
    weights = found[2:] / std
    biases = (
        float(found[0] - weights[:-ALONE] @ mean[:-ALONE]),
        float(found[1] - weights[-ALONE:] @ mean[-ALONE:]),
    )
    return RegisteredConfidence(biases, tuple(float(each) for each in weights), USUAL_CHANCES)


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--views", type=int, default=40, help="views per kind (default 40)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="pairs at a time")
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="pairs whose name has this")
    parser.add_argument("--fit", action="store_true", help="print weights fitted to all scenes")


def measure(options: argparse.Namespace) -> Section:
    pairs = chosen(leave_one_out_pairs(), options.only)
    if options.quick:  # the first pair of two scenes
        pairs = list({place_of(each): each for each in reversed(pairs)}.values())[-2:]
    if len({place_of(each) for each in pairs}) < 2:
        raise SystemExit("choose two scenes or more: each is judged by a fit to the others")
    for each in pairs:  # before processes share them
        map_of(ortho(each.map, options.work), options.work)
        ortho(each.views, options.work)
    views = 1 if options.quick else options.views
    tasks = {each.name: (each, pairs, views, options.seed, options.work) for each in pairs}
    stored = rows_path(options.work, f"views-{views}-{options.seed}")
    rows: list[dict[str, Any]] = []
    for name, found in zip(tasks, resumed(stored, views_of, tasks, options.workers), strict=True):
        rows += found
        say(name)
    judged = Judged.of(rows)
    if options.fit:
        judge = judged.fitted(np.ones(len(rows), np.bool_))
        print("USUAL_BIASES =", tuple(round(each, 2) for each in judge.biases))
        print("USUAL_WEIGHTS =", tuple(round(each, 2) for each in judge.weights))
    tables = [_scenes_table(judged), _cases_table(judged)]
    return Section(f"Trust: {len(rows)} views, seed {options.seed}", tables)


def _verdict(judged: Judged, confidence: Array, inside: NDArray[np.bool_]) -> list[str]:
    """Accepted of correct, wrong of accepted, and calibration error of some rows."""
    right, accepted = judged.right & inside, (confidence >= CONFIDENT) & inside
    errors = np.where(judged.right, 0.0, 2.0)[inside]
    ece = calibrate(confidence[inside], errors, np.ones(len(errors)), 1.0).ece
    share = float(accepted[right].mean()) if right.any() else float("nan")
    return [
        percent(share, 1),
        f"{int((accepted & ~judged.right).sum())} of {int(accepted.sum())}",
        f"{ece:.3f}",
    ]


def _scenes_table(judged: Judged) -> Table:
    left_out, shipped = judged.left_out(), judged.shipped()
    nees = np.array([each["nees"] for each in judged.rows])
    rows = []
    names = sorted({each["scene"] for each in judged.rows})
    masks = [(name, judged.where(scene=name)) for name in names]
    for name, inside in [*masks, ("**all**", np.ones(len(judged.rows), np.bool_))]:
        found = inside & judged.where(kind="found")
        used = nees[inside & judged.right & (shipped >= CONFIDENT)]
        rows.append(
            [
                name,
                f"{int(found.sum())} + {int((inside & ~found).sum())}",
                percent(float(judged.right[found].mean()), 1),
                *_verdict(judged, left_out, inside),
                *_verdict(judged, shipped, inside),
                f"{used.mean() if used.size else math.nan:.2f}",
            ]
        )
    header = (
        *("scene", "views on + off the map", "correct", "accepted of correct", "wrong of accepted"),
        *("calibration error", "shipped: accepted", "wrong", "calibration error", "NEES"),
    )
    notes = (
        f"accepted: confidence of {CONFIDENT:g} or more; correct: within 35 m or 10 px, with a "
        "prior within 20 px; heading sd 10 deg, height sd 10 %, tracked: 2 deg and 3 %",
        "NEES: mean normalized error squared of correct views that the shipped weights accept, 2 "
        "is right; pitch and roll err by a mount and a horizon of 1 deg each, not reported",
        "by a fit to the other scenes; shipped: by the weights of the program, fitted to views of "
        "these scenes",
    )
    return Table("Confidence on scenes left out", header, rows, notes)


def _cases_table(judged: Judged) -> Table:
    confidence = judged.left_out()
    keys = ("kind", "width_px", "heading_known", "prior_px", "tracked")
    cases = dict.fromkeys(tuple(each[key] for key in keys) for each in judged.rows)
    rows = []
    for case in cases:
        inside = judged.where(**dict(zip(keys, case, strict=True)))
        kind, width_px, known, prior_px, tracked = case
        words = [kind, f"{width_px} px"]
        words += [] if known else ["heading unknown"]
        words += [] if prior_px is None else [f"prior {prior_px:g} px"]
        words += ["tracked"] if tracked else []
        rows.append(
            [
                ", ".join(words),
                str(int(inside.sum())),
                percent(float(judged.right[inside].mean()), 1),
                *_verdict(judged, confidence, inside),
            ]
        )
    header = (
        *("views", "n", "correct", "accepted of correct", "wrong of accepted"),
        "calibration error",
    )
    return Table("By kind of view, scenes left out", header, rows)


if __name__ == "__main__":
    sys.exit(run(NAME, __doc__, measure, add))
