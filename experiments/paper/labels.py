"""Names of scenes, methods and inputs in tables, and which rows are shown."""

from collections.abc import Iterable, Sequence

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
    order = list(FAMILIES)
    edges = list(EDGES)
    return sorted(
        shown, key=lambda r: (order.index(r.family), r.registration, edges.index(r.edges))
    )


def named(each: Result) -> str:
    """Name of the method, with a star if it was tuned on its scene."""
    return _plain_name(each) + ("*" if is_tuned(each) else "")


def is_tuned(each: Result) -> bool:
    """Whether a row was tuned on its scene."""
    return tuned(each.family, each.plain["method"]["recipe"], each.scene, each.edges)


def _plain_name(each: Result) -> str:
    name = FAMILIES[each.family]
    if each.family == "bovw":
        return f"{name}, k = {each.plain['dims']}"
    if each.family == "gradient":
        return f"{name}, default" if each.registration else f"{name}, embedding only"
    return name


def label(method: Method) -> str:
    """Name of a method and its input."""
    edges = method.edges.partition(":")[0]
    if method.family == "gradient":
        return "orthonav, default" if method.registration else "orthonav, embedding only"
    return f"{FAMILIES[method.family]}, {EDGES[edges]}"


def by_scene(results: Iterable[Result]) -> list[tuple[str, list[Result]]]:
    """Results of each scene, by its name."""
    scenes: dict[str, list[Result]] = {}
    for each in results:
        scenes.setdefault(each.scene, []).append(each)
    return sorted(scenes.items())
