"""Names of scenes, methods and inputs in tables, and which rows are shown."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from experiments.paper.methods import Method, tuned
from experiments.paper.results import Result

TUNED = "*: tuned on this scene or on imagery of the same generator (docs/paper.md)"
FAMILIES = {
    "bovw": "Bag of Words",
    "triplet": "Triplet",
    "autoencoder": "Auto-Encoder",
    "caevl": "CAEVL",
    "gradient": "orthonav",
}
EDGES = {
    "gray": "grey",
    "canny": "Canny",
    "segments": "segments",
    "sam": "Segment Anything, sheet",
    "sam-tile": "Segment Anything, tile",
    "onnx": "learnt",
    "gradient": "gradients",
}


def best_words(found: Sequence[Result]) -> list[Result]:
    """All but the worse ones of several vocabularies: "the best performances will be displayed"."""
    words = [each for each in found if each.family == "bovw"]
    best = max(words, key=lambda each: each.accuracy("grid"), default=None)
    shown = [each for each in found if each.family != "bovw" or each is best]
    return sorted(shown, key=row_of)


class Row(NamedTuple):
    """A method and its input, as a row of a table; sorted as the tables list them."""

    order: tuple[int, bool, int]
    family: str
    edges: str
    registration: bool


def row_of(each: Result) -> Row:
    """The row of a result."""
    order = (list(FAMILIES).index(each.family), each.registration, list(EDGES).index(each.edges))
    return Row(order, each.family, each.edges, each.registration)


def row_label(row: Row) -> str:
    """Name of a method and its input."""
    if row.family == "gradient":
        return "orthonav, default" if row.registration else "orthonav, embedding only"
    return f"{FAMILIES[row.family]}, {EDGES[row.edges]}"


def named(each: Result) -> str:
    """Name of a method and its input, with a star if it was tuned on its scene."""
    return row_label(row_of(each)) + ("*" if is_tuned(each) else "")


def is_tuned(each: Result) -> bool:
    """Whether a row was tuned on its scene."""
    return tuned(each.family, each.plain["method"]["recipe"], each.scene, each.edges)


def label(method: Method) -> str:
    """The same of a `Method`."""
    edges = method.edges.partition(":")[0]
    return row_label(Row((0, False, 0), method.family, edges, method.registration))


def by_scene(results: Iterable[Result]) -> list[tuple[str, list[Result]]]:
    """Results of each scene, by its name."""
    scenes: dict[str, list[Result]] = {}
    for each in results:
        scenes.setdefault(each.scene, []).append(each)
    return sorted(scenes.items())
