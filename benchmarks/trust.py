"""How far confidence can be trusted on ground that it was not learnt on: whole scenes left out.

`python -m benchmarks.trust --work DIR [--views 40] [--seed 1] [--workers 2] [--fit]` places views
of all scenes of two dates beside the checkout (`../shared/data`, or the folder that ORTHONAV_DATA
names) and of generated ones, and views that are on no map. It prints what the shipped confidence
says of them, and what one says that was fitted to the other scenes only. `--fit` prints weights
fitted to all of these views. DIR keeps maps, flights and the evidence of every view: a second run
takes seconds. About an hour on two cores. `DIR/worst` shows the worst views of every scene.
"""

import argparse
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

from benchmarks.inputs import file_of
from benchmarks.record import Table, provenance
from benchmarks.trust_pictures import write_worst
from benchmarks.trust_views import pairs, views_of
from benchmarks.verdicts import percent
from orthonav.core.files import write_text
from orthonav.core.localize.confidence import (
    ALONE,
    FEATURES,
    USUAL_CHANCES,
    Chances,
    RegisteredConfidence,
    features_of,
)
from orthonav.core.records import CONFIDENT
from orthonav.ground.build.fit import LEAST
from orthonav.ground.evaluate.calibration import calibrate

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

    def fitted(self, train: NDArray[np.bool_], without: int | None = None) -> RegisteredConfidence:
        """Fitted to the rows `train`, with one of the features left out or none."""
        used = [i for i in range(len(FEATURES)) if i != without]
        return fit_judge(self.features[train], self.right[train], used)

    def left_out(self, without: int | None = None) -> Array:
        """Confidence (N,) of each row by a fit to all other scenes."""
        scenes = np.array([each["scene"] for each in self.rows])
        found = np.zeros(len(self.rows))
        for scene in np.unique(scenes):
            inside = scenes == scene
            judge = self.fitted(~inside, without)
            found[inside] = [judge.of(each) for each in self.features[inside]]
        return found


def fit_judge(
    features: Array, right: NDArray[np.bool_], used: Sequence[int]
) -> RegisteredConfidence:
    """Biases and weights, none negative, under which the outcome of views (N, F) is likeliest.

    Features that are not among `used` have no weight.
    """
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
    start[2:][[i for i in range(count) if i not in used]] = 0.0
    most = [None if i in used else 0.0 for i in range(count)]
    bounds = [(None, None)] * 2 + [(0.0, each) for each in most]
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds).x
    weights = found[2:] / std
    biases = (
        float(found[0] - weights[:-ALONE] @ mean[:-ALONE]),
        float(found[1] - weights[-ALONE:] @ mean[-ALONE:]),
    )
    return RegisteredConfidence(biases, tuple(float(each) for each in weights), USUAL_CHANCES)


def main() -> None:
    """Place, fit, print; write Markdown where a file is named."""
    options = _parser().parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    about = provenance("trust")
    every = pairs()
    chosen = [each for each in every if each.is_there]
    for each in set(every) - set(chosen):
        print(f"not there, left out: {each.map}")
    for each in chosen:  # before processes share them
        file_of(each.map, options.work)
    rows: list[dict[str, Any]] = []
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        jobs = [
            pool.submit(views_of, each, chosen, options.views, options.seed, options.work)
            for each in chosen
        ]
        for pair, job in zip(chosen, jobs, strict=True):
            rows += job.result()
            print(f"{pair.scene}: {pair.map} seen by {pair.views}", flush=True)
    judged = Judged.of(rows)
    tables = [_scenes_table(judged), _features_table(judged), _cases_table(judged)]
    head = (
        f"commit {about['commit'][:10]}, sources {about['sources']}, {about['cpu']}; "
        f"{len(rows)} views, seed {options.seed}"
    )
    text = "\n".join([head, "", *(table.markdown() for table in tables)])
    print("\n" + text)
    for path in write_worst(rows, judged.right, judged.left_out(), options.work):
        print(f"worst views: {path}")
    if options.fit:
        everything = np.ones(len(rows), np.bool_)
        judge = judged.fitted(everything)
        print("USUAL_BIASES =", tuple(round(each, 2) for each in judge.biases))
        print("USUAL_WEIGHTS =", tuple(round(each, 2) for each in judge.weights))
    if options.out:
        write_text(options.out, text + "\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.trust", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--work", type=Path, required=True, help="folder for maps and flights")
    parser.add_argument("--views", type=int, default=40, help="views per kind (default 40)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="pairs at a time")
    parser.add_argument("--fit", action="store_true", help="print weights fitted to all scenes")
    parser.add_argument("--out", type=Path, help="Markdown file to write too")
    return parser


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


def _nees(judged: Judged, confidence: Array, inside: NDArray[np.bool_]) -> float:
    """Mean normalized error squared of correct accepted views; NaN without one."""
    used = judged.right & inside & (confidence >= CONFIDENT)
    values = np.array([each["nees"] for each in judged.rows])[used]
    return float(values.mean()) if len(values) else float("nan")


def _scenes_table(judged: Judged) -> Table:
    left_out, shipped = judged.left_out(), judged.shipped()
    rows = []
    names = sorted({each["scene"] for each in judged.rows})
    masks = [(name, judged.where(scene=name)) for name in names]
    for name, inside in [*masks, ("**all**", np.ones(len(judged.rows), np.bool_))]:
        found = inside & judged.where(kind="found")
        rows.append(
            [
                name,
                f"{int(found.sum())} + {int((inside & ~found).sum())}",
                percent(float(judged.right[found].mean()), 1),
                *_verdict(judged, left_out, inside),
                *_verdict(judged, shipped, inside),
                f"{_nees(judged, shipped, inside):.2f}",
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


def _features_table(judged: Judged) -> Table:
    """What each kind of evidence brings: all but one, on scenes left out."""
    rows = []
    for without in (None, *range(len(FEATURES))):
        name = "all" if without is None else f"without {FEATURES[without]}"
        confidence = judged.left_out(without)
        clipped = np.clip(confidence, 1e-9, 1 - 1e-9)
        loss = -np.mean(np.log(np.where(judged.right, clipped, 1 - clipped)))
        everything = np.ones(len(judged.rows), np.bool_)
        rows.append([name, *_verdict(judged, confidence, everything), f"{loss:.4f}"])
    header = (
        *("evidence", "accepted of correct", "wrong of accepted", "calibration error"),
        "log loss",
    )
    return Table("What each kind of evidence brings", header, rows)


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
    main()
