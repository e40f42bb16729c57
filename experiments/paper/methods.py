"""The paper's section Methodology: which methods look at what, as orthonav names them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.paper.trajectories import LEARNABLE, REDUCED, TABLE_1, Setting, epochs

GREY, CANNY, SEGMENTS, SAM, LEARNT = "gray", "canny", "segments", "sam", "onnx"
DEFAULT = "gradient"
PER_TILE = "per=tile"
BETWEEN_DATES = Path(__file__).resolve().parent / "between_dates.onnx"
"""Edges that stay between dates: made by `python -m experiments.paper.between_dates`."""


@dataclass(frozen=True)
class Method:
    """A row of Table 2: `recipe` and `edges` as `orthonav build` takes them.

    With `registration` views are placed by orthonav's default instead of the paper's rule.
    """

    family: str
    recipe: str
    edges: str
    registration: bool = False

    @property
    def needs_dates(self) -> bool:
        """Whether it is only learnt from several dates: no positive is segmented by SAM."""
        return self.family == "triplet" and self.edges.startswith(SAM)

    @property
    def key(self) -> str:
        """Short name for files, unique within one setting."""
        words = self.recipe.partition("words=")[2].partition(",")[0]
        layer = "registration" if self.registration else ""
        singly = "tile" if PER_TILE in self.edges else ""
        parts = (self.family, self.edges.partition(":")[0], singly, words, layer)
        return "-".join(part for part in parts if part)


FLOWN = (
    (DEFAULT, DEFAULT, True),
    (DEFAULT, DEFAULT, False),
    ("autoencoder", CANNY, False),
    ("autoencoder", LEARNT, False),
    ("caevl", CANNY, False),
)
"""Rows whose maps are flown on the views of the field today: family, edges and registration."""


def flown(rows: Sequence[Method]) -> list[Method]:
    """Those of `FLOWN`, in its order."""
    found = {(each.family, each.edges.partition(":")[0], each.registration): each for each in rows}
    return [found[each] for each in FLOWN if each in found]


def tuned(family: str, recipe: str, scene: str, edges: str = "") -> bool:
    """Whether a row was tuned with imagery or views of its scene, or of the same generator.

    docs/paper.md lists what was tuned on what. The default was chosen on generated landscapes, the
    Szada pairs and NAIP; learnt edges are learnt on generated landscapes; training of the reduced
    networks was chosen by their accuracy on B; the number of words is chosen by its accuracy
    everywhere, as in the paper.
    """
    drawn = column(scene) in TABLE_1
    if family == "gradient":
        return drawn or scene.startswith(("naip-", "szada-"))
    chosen = {"triplet": LEARNABLE, "autoencoder": f"learning_rate={REDUCED.encoder_rate:g},"}
    by_training = family in chosen and chosen[family] in recipe
    return family == "bovw" or (drawn and (edges == LEARNT or by_training))


def column(scene: str) -> str:
    """Scene without its ground resolution: "B" for "B-0.75m", B at another one."""
    return scene.partition("-")[0]


REDUCED_CAEVL = ",batch=64,learning_rate=0.001,tuning_rate=0.001,projector=1024"
CAEVL_EPOCHS = 100
"""Epochs of CAEVL's fine-tuning, as released; the reduced setting shows half as many tiles in it as
to the auto-encoder."""
REDUCED_NETWORKS = {
    "autoencoder": {GREY: "ABCD", CANNY: "ABCD", SEGMENTS: "B", SAM: "B", LEARNT: "B"},
    "triplet": {GREY: "B", CANNY: "B"},
    "caevl": {CANNY: "B"},
}
"""Trajectories that the reduced setting trains a network on, by input."""


FIELD_SCENES = ("B", "naip-2018", "schiphol", "tours")
"""Scenes of the section on the field today, where CAEVL and learnt edges are run too."""
GPU_SCENES = ("B", "D")
"""Scenes of the setting "gpu": auto-encoder on Canny edges and grey levels."""


def methods(
    setting: Setting,
    scene: str,
    tiles: int,
    sam_weights: str | None = None,
    more_epochs: int | None = None,
) -> list[Method]:
    """All rows for a scene whose map has so many tiles, quick ones first.

    `more_epochs`: epochs of all networks, instead of the setting's.

    The reduced setting learns fewer networks: `REDUCED_NETWORKS`, and over imagery that no
    trajectory of the paper is flown over the auto-encoder on Canny edges, the paper's best, and on
    grey levels over NAIP and Szada; CAEVL and learnt edges on `FIELD_SCENES`.
    """
    shown, width = setting.encoder_tiles, setting.encoder_width
    encoder = (
        f"autoencoder:width={width},batch={setting.encoder_batch},"
        f"learning_rate={setting.encoder_rate:g},epochs={more_epochs or epochs(tiles, shown)}"
    )
    triplet = (
        f"triplet:width={setting.triplet_width},batch={setting.triplet_batch},"
        f"epochs={more_epochs or epochs(tiles, setting.triplet_tiles)}{setting.triplet_more}"
    )
    looked_at = [CANNY, GREY, SEGMENTS]
    if sam_weights:
        looked_at.append(f"{SAM}:weights={sam_weights}")
        if setting.name != "reduced":  # a row of the reduced setting would take days on a CPU
            looked_at.append(f"{SAM}:{PER_TILE},weights={sam_weights}")
    tuned_on = epochs(tiles, None if shown is None else shown // 2)
    small = "" if shown is None else REDUCED_CAEVL
    caevl = (
        f"caevl:width={width}{small},epochs={more_epochs or epochs(tiles, shown)},"
        f"tuning_epochs={more_epochs or min(tuned_on, CAEVL_EPOCHS)}"
    )
    rows = [Method(DEFAULT, DEFAULT, DEFAULT)]
    rows += [Method("bovw", f"bovw:words={words}", GREY) for words in setting.words]
    networks = [Method("autoencoder", encoder, edges) for edges in looked_at]
    networks += [Method("triplet", triplet, edges) for edges in looked_at]
    networks.append(Method("autoencoder", encoder, f"{LEARNT}:weights={BETWEEN_DATES}"))
    networks.append(Method("caevl", caevl, CANNY))
    ours = Method(DEFAULT, DEFAULT, DEFAULT, True)
    if setting.name == "gpu":
        return [rows[0], *(each for each in networks[:2] if column(scene) in GPU_SCENES), ours]
    rows += [each for each in networks if setting.name != "reduced" or _reduced(each, scene)]
    return [*rows, ours]


def _reduced(method: Method, scene: str) -> bool:
    """Whether the reduced setting learns this network here."""
    edges = method.edges.partition(":")[0]
    name = column(scene)
    if name not in TABLE_1:
        if method.family == "caevl" or edges == LEARNT:
            return scene in FIELD_SCENES
        wanted = (CANNY, GREY) if scene.startswith(("naip-", "szada-")) else (CANNY,)
        return method.family == "autoencoder" and edges in wanted
    return name in REDUCED_NETWORKS[method.family].get(edges, "")
