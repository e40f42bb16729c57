"""Table of the rows above orthonav's default."""

import math
from collections.abc import Sequence

from benchmarks.record import Table

from experiments.paper.labels import best_words, by_scene, named
from experiments.paper.results import Result, percent
from experiments.paper.views import PLACEMENTS


def above_default(results: Sequence[Result]) -> list[Table]:
    """Every row that locates more views within 15 m than orthonav's default on its scene."""
    rows, compared = [], 0
    for scene, found in by_scene(results):
        for ours in (each for each in found if each.registration):
            for each in (other for other in best_words(found) if not other.registration):
                compared += len(PLACEMENTS)
                rows += [
                    _above_row(scene, name, ours, each)
                    for name in PLACEMENTS
                    if each.accuracy(name) > ours.accuracy(name)
                ]
    if not compared:
        return []
    header = ("scene", "views", "of", "default", "method", "accuracy", "difference")
    notes = (
        f"accuracy at 15 m in %; the default is as good or better in {compared - len(rows)} of "
        f"{compared} comparisons",
        "within the noise: less than two standard errors of the difference",
    )
    return [Table("Rows above orthonav's default", header, rows, notes)]


def _above_row(scene: str, name: str, ours: Result, each: Result) -> list[str]:
    shares = [ours.accuracy(name), each.accuracy(name)]
    count = len(each.plain["views"][name])
    spread = math.sqrt(sum(p * (1 - p) for p in shares) / count)
    size = "within the noise" if shares[1] - shares[0] <= 2 * spread else "significant"
    return [
        *(scene, name, str(count), percent(shares[0])),
        *(named(each), percent(shares[1]), size),
    ]
