"""How wrong positions can be: false fixes and protection levels of 100,000 single views.

`python -m benchmarks.integrity --work DIR [--rounds 7] [--views 8] [--workers 2] [--fit]` places
views of all pairs of dates, and views that are on no map. Every scene is judged by a confidence
that was fitted to the other scenes only. A round takes about 14,000 views, an hour on two cores;
rows are kept in DIR, rerun to resume. `--fit` prints weights fitted to all views.
"""

import argparse
import math
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

from benchmarks.judged_views import prepare, views_of
from benchmarks.record import Section, Table, percent, resumed, rows_path, run, say
from benchmarks.scenes import all_pairs, chosen, place_of
from orthonav.core.limits import DEFAULT_RISK
from orthonav.core.localize.confidence import (
    DEFAULT_CHANCES,
    FEATURES,
    NEARBY,
    Chances,
    RegisteredConfidence,
    Scores,
    features_of,
)
from orthonav.core.records import CONFIDENT, protection_levels_m
from orthonav.ground.evaluate.statistics import calibrate, upper_bound

RIDGE = 1e-5
"""Weight of the ridge of the fit: only against weights without bound."""
LIMIT_M, LIMIT_PX = 35.0, 10.0
"""Alert limit of the tables: the larger one, coarse imagery cannot do better."""
TAIL = (1.0, 0.1, 1e-2, 1e-3, 1e-4, 0.0)
"""Bounds of the stated probability of a wrong place."""
Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Judged:
    """Rows of fixes (N), their features (N, F), whether their places are right (N,), the
    probabilities (N,) of that by a fit to other scenes, errors (N,) and protection levels (N,)."""

    rows: list[dict[str, Any]]
    features: Array
    right: Mask
    place: Array
    error_m: Array
    level_m: Array

    @classmethod
    def of(cls, rows: list[dict[str, Any]]) -> "Judged":
        """From the rows of `views_of` that have a fix."""
        made = [
            features_of(Scores.of(each["evidence"]), Chances.from_plain(each["chances"]))
            for each in rows
        ]
        features, right = np.stack(made), np.array([each["right"] for each in rows])
        scenes, place = np.array([each["scene"] for each in rows]), np.zeros(len(rows))
        for scene in np.unique(scenes):
            inside = scenes == scene
            judge = fit_judge(features[~inside], right[~inside])
            place[inside] = [judge.of(each) for each in features[inside]]
        levels = protection_levels_m(place, _covariances(rows), DEFAULT_RISK)
        errors = np.array([math.hypot(*row["off_en_m"]) for row in rows])
        return cls(rows, features, right, place, errors, levels)

    def where(self, **wanted: Any) -> Mask:
        """Mask (N,) of the rows that have these values."""
        return np.array(
            [all(each[name] == value for name, value in wanted.items()) for each in self.rows]
        )

    @property
    def found(self) -> Mask:
        """Views that the map shows."""
        return self.where(kind="found")

    @property
    def limit_m(self) -> Array:
        """Alert limits (N,)."""
        return np.array([max(LIMIT_M, LIMIT_PX * each["gsd_m"]) for each in self.rows])

    @property
    def nees(self) -> Array:
        """Normalized errors squared (N,): 2 is right."""
        off = np.array([each["off_en_m"] for each in self.rows])
        inverse = np.linalg.inv(_covariances(self.rows))
        return np.asarray(np.einsum("ni,nij,nj->n", off, inverse, off))


def _covariances(rows: Sequence[dict[str, Any]]) -> Array:
    east, both, north = np.array([each["cov_en_m2"] for each in rows]).T
    return np.stack([east, both, both, north], axis=1).reshape(-1, 2, 2)


def fit_judge(features: Array, right: Mask) -> RegisteredConfidence:
    """Biases and weights, none negative, under which the outcome of views (N, F) is likeliest."""
    mean, std = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-6)
    scaled, count = (features - mean) / std, len(FEATURES)

    def loss(parameters: Array) -> tuple[float, Array]:
        weights = parameters[2:]
        fits = expit(parameters[0] + scaled[:, :-NEARBY] @ weights[:-NEARBY])
        alone = expit(parameters[1] + scaled[:, -NEARBY:] @ weights[-NEARBY:])
        product = fits * alone
        both = np.clip(product, 1e-9, 1 - 1e-9)
        value = -np.log(np.where(right, both, 1 - both)).mean()
        # A limited loss has no slope: with one, searches along a line would fail.
        slope = np.where(right, -1.0, both / (1 - both)) * (both == product) / len(right)
        first, second = slope * (1 - fits), slope * (1 - alone)
        slopes = scaled[:, :-NEARBY].T @ first, scaled[:, -NEARBY:].T @ second
        gradient = np.concatenate([[first.sum(), second.sum()], *slopes])
        gradient[2:] += 2 * RIDGE * weights
        return float(value + RIDGE * (weights**2).sum()), gradient

    start = np.full(2 + count, 0.3)
    bounds: Any = [(None, None)] * 2 + [(0.0, None)] * count
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds).x
    weights = found[2:] / std
    biases = (
        float(found[0] - weights[:-NEARBY] @ mean[:-NEARBY]),
        float(found[1] - weights[-NEARBY:] @ mean[-NEARBY:]),
    )
    return RegisteredConfidence(biases, tuple(float(each) for each in weights), DEFAULT_CHANCES)


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--views", type=int, default=8, help="views per kind and round (default 8)")
    parser.add_argument("--rounds", type=int, default=7, help="over all pairs (default 7)")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="pairs at a time")
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="pairs whose name has this")
    parser.add_argument("--fit", action="store_true", help="print weights fitted to all scenes")


def measure(options: argparse.Namespace) -> Section:
    pairs = chosen(all_pairs(), options.only)
    if options.quick:  # the first pair of two scenes
        pairs = list({place_of(each): each for each in reversed(pairs)}.values())[-2:]
    if len({place_of(each) for each in pairs}) < 2:
        raise SystemExit("choose two scenes or more: each is judged by a fit to the others")
    views, rounds = (1, 1) if options.quick else (options.views, options.rounds)
    prepare(pairs, options.work)
    tasks = {
        f"{each.name} {number}": (each, pairs, views, 1000 * number + 1, options.work)
        for number in range(rounds)
        for each in pairs
    }
    stored = rows_path(options.work, f"views-{views}")
    rows: list[dict[str, Any]] = []
    begun_s = time.monotonic()
    made = resumed(stored, views_of, tasks, options.workers)
    for done, (name, found) in enumerate(zip(tasks, made, strict=True), start=1):
        rows += found
        left_s = (time.monotonic() - begun_s) * (len(tasks) - done) / done
        say(f"{name}: {len(rows)} views, {left_s / 60:.0f} min left")
    judged = Judged.of([each for each in rows if each["evidence"] is not None])
    if options.fit:
        judge = fit_judge(judged.features, judged.right)
        print("biases =", tuple(round(each, 2) for each in judge.biases))
        print("weights =", tuple(round(each, 2) for each in judge.weights))
    tables = [
        _groups_table(judged, "By scene, left out", _scenes(judged)),
        _groups_table(judged, "By kind of view", _kinds(judged)),
        _tail_table(judged),
    ]
    return Section(f"Integrity of {len(rows)} single views", tables)


def _scenes(judged: Judged) -> list[tuple[str, Mask]]:
    names = sorted({each["scene"] for each in judged.rows})
    groups = [(name, judged.where(scene=name)) for name in names]
    return [*groups, ("**all**", np.ones(len(judged.rows), np.bool_))]


def _kinds(judged: Judged) -> list[tuple[str, Mask]]:
    """Views on the map by their width and what is known of them, the others by their kind."""
    keys = ("width_px", "heading_known", "prior_px", "tracked")
    found = [each for each in judged.rows if each["kind"] == "found"]
    cases = dict.fromkeys(tuple(each[key] for key in keys) for each in found)
    groups = [
        (_name(*case), judged.where(kind="found", **dict(zip(keys, case, strict=True))))
        for case in cases
    ]
    kinds = sorted({each["kind"] for each in judged.rows} - {"found"})
    return groups + [(kind, judged.where(kind=kind)) for kind in kinds]


def _name(width_px: int, known: bool, prior_px: float | None, tracked: bool) -> str:
    words = [f"{width_px} px"]
    words += [] if known else ["heading unknown"]
    words += [] if prior_px is None else [f"prior {prior_px:g} px"]
    words += ["tracked"] if tracked else []
    return ", ".join(words)


def _groups_table(judged: Judged, name: str, groups: Sequence[tuple[str, Mask]]) -> Table:
    """Acceptance, false fixes, calibration and protection levels of groups of views."""
    accepted, available = judged.place >= CONFIDENT, judged.level_m <= judged.limit_m
    beyond = judged.error_m > judged.level_m
    false = available & (judged.error_m > judged.limit_m)
    used, nees, rows = judged.right & accepted, judged.nees, []
    for group, inside in groups:
        found = inside & judged.found
        right, protected = judged.right & inside, inside & np.isfinite(judged.level_m)
        wrong = int((accepted & inside & ~judged.right).sum())
        errors = np.where(judged.right, 0.0, 2.0)[inside]
        ece = calibrate(judged.place[inside], errors, np.ones(len(errors)), 1.0).ece
        exceeded, levels = int((beyond & protected).sum()), int(protected.sum())
        rows.append(
            [
                group,
                f"{int(found.sum())} + {int((inside & ~judged.found).sum())}",
                percent(float(judged.right[found].mean()) if found.any() else math.nan, 1),
                percent(float(accepted[right].mean()) if right.any() else math.nan, 1),
                f"{wrong} of {int((accepted & inside).sum())}",
                f"{ece:.3f}",
                f"{nees[used & inside].mean() if (used & inside).any() else math.nan:.2f}",
                percent(float(available[right].mean()) if right.any() else math.nan, 1),
                f"{int((false & inside).sum())} of {int(inside.sum())}",
                f"{exceeded} of {levels}",
                f"{1e3 * upper_bound(exceeded, levels):.2g}",
            ]
        )
    header = (
        *("views", "on + off the map", "correct", "accepted of correct", "wrong of accepted"),
        *("ECE", "NEES", "available of correct", "false, available of all"),
        *("beyond the protection level", "bound, per 1,000"),
    )
    notes = (
        f"accepted: probability of the place from {CONFIDENT:g}; correct: within 35 m, 10 px or "
        "2.5 % of the height, with a prior within 20 px; NEES: of accepted correct fixes",
        f"available: protection level at a risk of {DEFAULT_RISK:g} up to the alert limit of "
        f"{LIMIT_M:g} m or {LIMIT_PX:g} px; false: available and beyond the limit",
        "bound: one-sided, 95 % (Clopper and Pearson), for independent views",
    )
    return Table(name, header, rows, notes)


def _tail_table(judged: Judged) -> Table:
    """Wrong places among fixes that state a small probability of one."""
    rows, doubt = [], 1 - judged.place
    for most, least in pairwise(TAIL):
        inside = (doubt < most) & (doubt >= least)
        count, wrong = int(inside.sum()), int((inside & ~judged.right).sum())
        stated = f"{doubt[inside].sum():.3g}"
        bound = f"{upper_bound(wrong, count):.2g}"
        rows.append([f"{least:g} to {most:g}", str(count), stated, str(wrong), bound])
    header = ("stated probability of a wrong place", "views", "wrong as stated", "wrong", "bound")
    return Table("Tail of the place probability, scenes left out", header, rows)


if __name__ == "__main__":
    sys.exit(run(measure, add))
