"""Tables of the section on the field today, from result files alone."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from benchmarks.record import Table, number
from numpy.typing import NDArray

from experiments.paper.methods import Method
from experiments.paper.results import ACCURACY_M, FIELD, Result, numbers, percent
from orthonav.core.records import CONFIDENT

FAR_M, FAR_PX = 35.0, 10.0
"""A position beyond both is wrong; pixels, for imagery on which 35 m are less than a view shows."""


@dataclass(frozen=True, eq=False)
class Placed:
    """What a method made of the views of one or several scenes.

    - `error_m` (N,): infinite without an answer. `far_m` (N,): error above which it is wrong.
    - `evidence` (N,): -inf without an answer. `mirrored` (M,): that of mirrored views.
    """

    error_m: NDArray[np.float64]
    far_m: NDArray[np.float64]
    evidence: NDArray[np.float64]
    mirrored: NDArray[np.float64]

    @classmethod
    def of(cls, rows: Sequence[Result], name: str) -> "Placed":
        """All views of these scenes."""
        parts = [each.plain[FIELD][name] for each in rows if name in each.plain[FIELD]]
        shapes = [each.plain["trajectory"] for each in rows if name in each.plain[FIELD]]
        views = [row for part in parts for row in part["views"]]
        far = [
            max(FAR_M, FAR_PX * shape["gsd_m"])
            for part, shape in zip(parts, shapes, strict=True)
            for _ in part["views"]
        ]
        return cls(
            numbers([error for error, _ in views], math.inf),
            np.array(far),
            numbers([evidence for _, evidence in views], -math.inf),
            numbers([each for part in parts for each in part["mirrored"]], -math.inf),
        )

    @property
    def right(self) -> NDArray[np.bool_]:
        """Mask (N,) of the views that are not wrong."""
        return self.error_m <= self.far_m

    def within(self, radius_m: float = ACCURACY_M) -> float:
        """Share of all views."""
        return float((self.error_m <= radius_m).mean())

    def trusted(self) -> float:
        """Largest share of the right views that a threshold accepts with no wrong one."""
        wrong = np.concatenate([self.evidence[~self.right], self.mirrored, [-math.inf]])
        right = self.evidence[self.right]
        return float((right > wrong.max()).mean()) if right.size else math.nan

    def accepted(self, threshold: float) -> tuple[float, int]:
        """Share of the right views that a threshold accepts, and how many wrong ones."""
        accepted = self.evidence >= threshold
        right = float(accepted[self.right].mean()) if self.right.any() else math.nan
        return right, int((accepted & ~self.right).sum() + (self.mirrored >= threshold).sum())

    def median_m(self) -> float:
        """Median error of the right views."""
        return float(np.median(self.error_m[self.right])) if self.right.any() else math.nan


def field(results: Sequence[Result], label: Any) -> list[Table]:
    """Each method over all scenes, and scene by scene; `label` names the row of a `Method`."""
    rows = [each for each in results if FIELD in each.plain]
    if not rows:
        return []
    names = list(dict.fromkeys(name for each in rows for name in each.plain[FIELD]))
    flown = [Method(**plain) for each in rows for plain in each.plain["methods"]]
    shown = {each.key: label(each) for each in flown}
    return [_summary(rows, names, shown), _by_scene(rows, names, shown)]


def _summary(rows: Sequence[Result], names: Sequence[str], shown: dict[str, str]) -> Table:
    lines = []
    for name in names:
        placed = Placed.of(rows, name)
        parts = [each.plain[FIELD][name] for each in rows if name in each.plain[FIELD]]
        own = placed.accepted(CONFIDENT) if name.endswith("registration") else None
        lines.append(
            [
                shown.get(name, name),
                percent(placed.within()),
                percent(float(placed.right.mean())),
                percent(placed.trusted()),
                "-" if own is None else f"{percent(own[0])} / {own[1]}",
                number(placed.median_m()),
                number(max(part["cpu_s"] for part in parts)),
                number(max(part["peak_mb"] for part in parts)),
                number(sum(part["carried_mb"] for part in parts)),
            ]
        )
    errors = rows[0].plain["errors"]
    counts = Placed.of(rows, names[0])
    header = (
        *("method", "15 m", "35 m or 10 px", "accepted at no wrong"),
        *("accepted / wrong", "median m", "CPU s per view", "peak MB", "carried MB"),
    )
    notes = (
        f"scenes: {', '.join(each.scene for each in rows)}; "
        f"{len(counts.error_m)} views anywhere, of the later date, and {len(counts.mirrored)} "
        "mirrored; "
        f"standard deviations of the reported heading, {errors['yaw_std_deg']:g} deg, the height, "
        f"{errors['agl_std']:.0%}, and the prior, {errors['prior_std_px']:g} px: the same for all",
        "views in %; accepted at no wrong: of those correct within 35 m or 10 px, the "
        "largest fraction that one threshold over all scenes accepts without a wrong one; every "
        "answer to a mirrored view is wrong; evidence: inliers, Lowe's ratio, or the confidence",
        f"accepted / wrong: of the correct ones, and number of wrong ones, at a confidence of "
        f"{CONFIDENT:g}, where a method states one",
        "CPU s, peak MB: the largest of the scenes' medians and peaks, one core; carried: "
        "keypoints (descriptors in 16 bits) or maps with their encoders, all scenes",
    )
    return Table("The field today: all scenes", header, lines, notes)


def _by_scene(rows: Sequence[Result], names: Sequence[str], shown: dict[str, str]) -> Table:
    lines = []
    for name in names:
        cells = [shown.get(name, name)]
        for each in rows:
            placed = Placed.of([each], name) if name in each.plain[FIELD] else None
            far = None if placed is None else float(placed.right.mean())
            cells.append("-" if placed is None else f"{percent(placed.within())}/{percent(far)}")
        lines.append(cells)
    guess = ["the prior itself"]
    for each in rows:
        away = np.array(next(iter(each.plain[FIELD].values()))["prior_m"])
        far_m = max(FAR_M, FAR_PX * each.plain["trajectory"]["gsd_m"])
        shares = (float((away <= radius).mean()) for radius in (ACCURACY_M, far_m))
        guess.append("/".join(map(percent, shares)))
    header = ("method", *(each.scene for each in rows))
    notes = ("fraction of the views within 15 m / within 35 m or 10 px, in %",)
    return Table("The field today, scene by scene", header, [*lines, guess], notes)
