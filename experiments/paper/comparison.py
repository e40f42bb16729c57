"""Tables that compare rows: the order of the paper's methods, and rows above orthonav's default."""

import math
from collections.abc import Sequence

from benchmarks.record import Table

from experiments.paper import published
from experiments.paper.labels import EDGES, best_words, by_scene, named
from experiments.paper.results import Result, percent
from experiments.paper.views import PLACEMENTS


def orders(results: Sequence[Result]) -> list[Table]:
    """Each comparison of the paper's Table 2 beside the same one here."""
    rows = []
    for scene, found in by_scene(results):
        best = {(each.family, each.edges): each for each in best_words(found)}
        for one, other in published.COMPARED:
            if scene in published.TRAJECTORIES and one in best and other in best:
                rows.append(_order_row(scene, best[one], best[other]))
    header = ("trajectory", "first", "second", "paper", "here", "same order")
    notes = (
        "accuracy at 15 m in %, first : second; here: views along the route; equal: the shares "
        "differ by less than two standard errors of their difference",
    )
    return [Table("Order of the paper's methods", header, rows, notes)] if rows else []


def _order_row(scene: str, one: Result, other: Result) -> list[str]:
    said = [float(published.accuracy(each.family, each.edges, scene)) for each in (one, other)]
    found = [each.accuracy("route") for each in (one, other)]
    counts = [len(each.plain["views"]["route"]) for each in (one, other)]
    spread = math.sqrt(sum(p * (1 - p) / n for p, n in zip(found, counts, strict=True)))
    same = "yes" if (said[0] > said[1]) == (found[0] > found[1]) else "no"
    if abs(found[0] - found[1]) <= 2 * spread:
        same = "equal"
    names = [f"{named(each)}, {EDGES[each.edges]}" for each in (one, other)]
    pairs = (f"{said[0]:.1f} : {said[1]:.1f}", f"{percent(found[0])} : {percent(found[1])}")
    return [scene, *names, *pairs, same]


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
    header = ("scene", "views", "of", "default", "method", "input", "accuracy", "difference")
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
        *(named(each), EDGES[each.edges], percent(shares[1]), size),
    ]
