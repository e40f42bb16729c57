"""Table of the auto-encoder's trainings: those that the reduced setting was chosen from, and it."""

from collections.abc import Sequence

from benchmarks.record import Table, number

from experiments.paper.labels import EDGES
from experiments.paper.results import Result, percent, share
from orthonav.core.tiles import embed
from orthonav.core.tiles.network import AutoEncoderRecipe
from orthonav.core.variants import make_variant

_FIGURES = ("route", "on grid, product", "on grid, cosine", "anywhere", "learn s", "commit")


def trainings(others: Sequence[Result], rows: Sequence[Result]) -> Table:
    """The auto-encoder by training, on scenes where there is another than the reduced setting's."""
    header = ("scene", "input", "batch", "rate", "tiles shown", *_FIGURES)
    compared = {(each.scene, each.edges) for each in others}
    found = [each for each in rows if each.family == "autoencoder"]
    known = [*others, *(each for each in found if (each.scene, each.edges) in compared)]
    made = {tuple(_training_row(each)): None for each in known}
    ordered = sorted(map(list, made), key=lambda row: (row[:2], float(row[3]), -int(row[2])))
    notes = (
        "accuracy at 15 m in %; the training of the reduced setting was chosen on B; product: the "
        "paper's rule, cosine: the same embeddings scaled to length 1",
    )
    return Table("Auto-Encoder by training", header, ordered, notes)


def _training_row(each: Result) -> list[str]:
    recipe = make_variant(embed.TABLE, each.plain["method"]["recipe"])
    assert isinstance(recipe, AutoEncoderRecipe)
    shown = f"{recipe.epochs * each.plain['tiles']:,}"
    cosine = share(each.plain["rules"]["grid"]["cosine best"])
    placed = [each.accuracy("route"), each.accuracy("grid"), cosine, each.accuracy("anywhere")]
    cells = [EDGES[each.edges], str(recipe.batch), f"{recipe.learning_rate:g}", shown]
    commit = str(each.plain["provenance"]["commit"])[:10]
    return [each.scene, *cells, *map(percent, placed), number(each.plain["learn_s"]), commit]
