"""Table of the auto-encoder's trainings: those that the reduced setting was chosen from, and it."""

from collections.abc import Sequence

from benchmarks.record import Table, number

from experiments.paper.labels import EDGES
from experiments.paper.results import Result, percent, share
from orthonav import embed
from orthonav.embed.network import AutoEncoderRecipe
from orthonav.variants import make_variant

_FIGURES = ("route", "on grid, product", "on grid, cosine", "anywhere", "learn s", "commit")


def trainings(results: Sequence[Result]) -> Table:
    """The auto-encoder on the trajectory that the reduced setting was chosen on, by training."""
    header = ("input", "batch", "rate", "tiles shown", *_FIGURES)
    found = [each for each in results if (each.scene, each.family) == ("B", "autoencoder")]
    rows = [_training_row(each) for each in found if each.edges in ("canny", "gray")]
    notes = (
        "accuracy at 15 m in %, on the trajectory and the views that the training was chosen on; "
        "product: the paper's rule, cosine: the same embeddings scaled to length 1",
    )
    ordered = sorted(rows, key=lambda row: (row[0], int(row[3].replace(",", "")), row[4:]))
    return Table("Auto-Encoder on B by training", header, ordered, notes)


def _training_row(each: Result) -> list[str]:
    recipe = make_variant(embed.TABLE, each.plain["method"]["recipe"])
    assert isinstance(recipe, AutoEncoderRecipe)
    shown = f"{recipe.epochs * each.plain['tiles']:,}"
    cosine = share(each.plain["rules"]["grid"]["cosine best"])
    placed = [each.accuracy("route"), each.accuracy("grid"), cosine, each.accuracy("anywhere")]
    cells = [EDGES[each.edges], str(recipe.batch), f"{recipe.learning_rate:g}", shown]
    commit = str(each.plain["provenance"]["commit"])[:10]
    return [*cells, *map(percent, placed), number(each.plain["learn_s"]), commit]
