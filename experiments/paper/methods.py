"""The paper's Table 1, trajectories A to D, settings of the experiments, and methods as rows.

The paper, Di Piazza et al. (IGARSS 2024), does not state the ground resolution: 0.2 m is assumed
for A, 1 m for B and D, 2 m for C, so that a tile of 256 px has about the size of a view from 40,
2000 and 4000 m.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

TILE_PX = 256
STUDIED = "B"
"""Trajectory of the baselines and of the sensitivity to heading and altitude."""
VIEW_ROOM = 1.5
"""Ground around a view, in view widths: it contains the view turned by up to 45 deg."""
LARGEST_M = 49_500.0
"""A map holds at most 50 km; C's 50 km are cut to this."""
CONVERGENCE = 0.01
"""How far true north and the imagery's may part, as a share of the length."""


@dataclass(frozen=True)
class Trajectory:
    """One column of Table 1; it leaves open the ground resolution `gsd_m`, metres per pixel."""

    name: str
    agl_m: float
    length_m: float
    band_m: float
    overlap: float
    gsd_m: float

    @property
    def stride_m(self) -> float:
        """Distance between neighbouring tiles, whole pixels."""
        return max(1, round(TILE_PX * (1 - self.overlap))) * self.gsd_m

    @property
    def tiles(self) -> int:
        """Number of reference tiles that cover the search band."""
        across = (math.ceil(side / self.stride_m - 1e-9) for side in (self.length_m, self.band_m))
        return math.prod(max(1, count) for count in across)

    @property
    def margin_m(self) -> float:
        """Imagery needed beyond the search band on each side, for tiles and turned views."""
        return VIEW_ROOM * TILE_PX * self.gsd_m / 2 + self.stride_m

    @property
    def imagery_m(self) -> tuple[float, float]:
        """East and north extent of the imagery that holds all tiles and views."""
        # A band around a route ends half its width behind the last waypoint.
        slack_m = 2 * self.margin_m + 2 * CONVERGENCE * self.length_m
        if self.band_m < TILE_PX * self.gsd_m:
            slack_m += self.band_m
        return self.length_m + slack_m, self.band_m + slack_m


TABLE_1 = {
    "A": Trajectory("A", 40, 150, 10, 0.995, 0.2),
    "B": Trajectory("B", 2000, 12_000, 1000, 0.875, 1.0),
    "C": Trajectory("C", 4000, 50_000, 5000, 0.875, 2.0),
    "D": Trajectory("D", 2000, 2000, 2000, 0.875, 1.0),
}
IMPLIED_GSD_M = {"B": 0.75, "C": 1.5, "D": 0.75}
"""Ground resolution that the paper's numbers of views imply: 12 km in 500 tile steps of 32 px, and
2 km in 84; C, from twice the height, in proportion. A: 0.19 m, but landscapes end at 0.2 m."""
REDUCED_M = {"A": (150, 1), "B": (3000, 300), "C": (5000, 1000), "D": (1000, 1000)}
"""Length and search band of the reduced setting."""


@dataclass(frozen=True)
class Setting:
    """Size of the experiments.

    - `name`: "reduced"; "lengths": the paper's, methods without a network; "epochs": networks of
      the paper's size on the reduced B as they learn; "full"; "gpu": auto-encoder on B and D.
    - `encoder_width`, `triplet_width`: widths of the networks, 512 and 64 in the paper.
    - `encoder_rate`, `encoder_batch`: learning rate of the auto-encoder, 3e-4 in the paper, and its
      tiles per batch. With few tiles shown, more and larger steps.
    - `encoder_tiles`, `triplet_tiles`: tiles shown in training; None: the paper's 200 epochs.
    - `triplet_batch`: tiles per batch of the triplet network.
    - `triplet_more`: further fields of the triplet recipe. With the hardest negatives and plain
      distances, few steps collapse all embeddings to one.
    - `words`: sizes of the vocabularies.
    - `views`: views per placement.
    - `swept`: views per step of the sensitivity.
    - `dry`: two tiles of every scene and one epoch, to try every step.
    """

    name: str
    encoder_width: int
    encoder_rate: float
    encoder_batch: int
    encoder_tiles: int | None
    triplet_width: int
    triplet_tiles: int | None
    triplet_batch: int
    triplet_more: str
    words: tuple[int, ...]
    views: int
    swept: int
    dry: bool = False

    @property
    def folder(self) -> str:
        """Name of the folder of its results."""
        return f"dry-{self.name}" if self.dry else self.name

    def trajectory(self, name: str) -> Trajectory:
        """A trajectory of Table 1, cut to what this setting runs."""
        whole = TABLE_1[name]
        if self.dry:
            return two_tiles(whole)
        if self.name in ("reduced", "epochs"):
            length_m, band_m = REDUCED_M[name]
            return replace(whole, length_m=length_m, band_m=band_m)
        gsd_m = IMPLIED_GSD_M.get(name, whole.gsd_m)
        return replace(whole, length_m=min(whole.length_m, LARGEST_M), gsd_m=gsd_m)


LEARNABLE = ",mining=semihard,similarity=cosine,margin=0.2"
REDUCED = Setting("reduced", 32, 3e-3, 16, 19_200, 8, 28_800, 64, LEARNABLE, (256, 1024), 100, 40)
FULL = Setting("full", 512, 3e-4, 32, None, 64, None, 512, "", (256, 1000, 3000, 10_000), 300, 300)
LENGTHS = replace(FULL, name="lengths", swept=100)
GPU = replace(FULL, name="gpu")
EPOCHS = replace(FULL, name="epochs", views=100, swept=0)
SETTINGS = {each.name: each for each in (REDUCED, LENGTHS, EPOCHS, GPU, FULL)}
CURVE = {"autoencoder": (1, 2, 3, 5, 7, 10), "triplet": (1, 2, 3)}
"""Epochs after which the setting "epochs" looks at a network."""
PAPER_EPOCHS = 200


def dry(setting: Setting) -> Setting:
    """The same networks on two tiles of every scene, for one epoch, with two views."""
    once = replace(setting, dry=True, encoder_tiles=1, triplet_tiles=1)
    return replace(once, words=(256,), views=2, swept=1)


def two_tiles(flown: Trajectory) -> Trajectory:
    """The first two tiles of a trajectory, about."""
    stride_m = flown.stride_m
    return replace(flown, length_m=1.5 * stride_m, band_m=min(flown.band_m, stride_m / 2))


def epochs(tiles: int, shown: int | None) -> int:
    """Epochs in which about `shown` tiles are seen, the paper's where None."""
    return PAPER_EPOCHS if shown is None else max(1, round(shown / tiles))


GREY, CANNY, SEGMENTS, SAM, LEARNT = "gray", "canny", "segments", "sam", "onnx"
DEFAULT = "gradient"
PER_TILE = "per=tile"
BETWEEN_DATES = Path(__file__).resolve().parent / "between_dates.onnx"
"""Edges that stay between dates: made by `experiments.paper.between_dates` at d63ac91."""
FAMILIES = {
    "bovw": "BoVW",
    "triplet": "Triplet",
    "autoencoder": "Auto-Encoder",
    "caevl": "CAEVL",
    DEFAULT: "orthonav",
}
INPUTS = {
    GREY: "grey",
    CANNY: "Canny",
    SEGMENTS: "segments",
    SAM: "Segment Anything, sheet",
    f"{SAM}-tile": "Segment Anything, tile",
    LEARNT: "learnt edges",
    DEFAULT: "gradients",
}
"""Names of families and inputs in tables, in their order there."""


@dataclass(frozen=True)
class Method:
    """A row of Table 2: `recipe` and `edges` as `orthonav build` takes them.

    With `registration` views are placed by orthonav's default instead of the paper's rule. `curve`:
    the training goes on in the next row.
    """

    family: str
    recipe: str
    edges: str
    registration: bool = False
    curve: bool = False

    def number(self, name: str) -> int:
        """A whole number of the recipe ("epochs")."""
        return int(self.recipe.partition(f"{name}=")[2].partition(",")[0])

    @property
    def input(self) -> str:
        """What the method looks at: its edges without their options."""
        return self.edges.partition(":")[0] + ("-tile" if PER_TILE in self.edges else "")

    @property
    def label(self) -> str:
        """Name of the row in tables."""
        if self.family == DEFAULT:
            return "orthonav, default" if self.registration else "orthonav, embedding only"
        return f"{FAMILIES[self.family]}, {INPUTS[self.input]}"

    @property
    def order(self) -> tuple[int, bool, int]:
        """Methods are sorted by this in tables."""
        return (
            list(FAMILIES).index(self.family),
            self.registration,
            list(INPUTS).index(self.input),
        )

    @property
    def training(self) -> str:
        """Name of the folder of checkpoints, the same for all rows of a training."""
        return f"{self.family}-{self.edges}-{self.number('width')}" if self.curve else self.key

    @property
    def needs_dates(self) -> bool:
        """Whether it is only learnt from several dates: no positive is segmented by SAM."""
        return self.family == "triplet" and self.edges.startswith(SAM)

    @property
    def key(self) -> str:
        """Short name for files, unique within one setting."""
        if self.curve:
            return f"{self.training}-{self.number('epochs')}"
        words = self.recipe.partition("words=")[2].partition(",")[0]
        layer = "registration" if self.registration else ""
        return "-".join(part for part in (self.family, self.input, words, layer) if part)

    def tuned_on(self, scene: str) -> bool:
        """Whether it was tuned with imagery or views of a scene, or of the same generator.

        docs/paper.md lists what was tuned on what. The default was chosen on generated landscapes,
        the Szada pairs and NAIP; learnt edges are learnt on generated landscapes; training of the
        reduced networks was chosen by their accuracy on B; the number of words is chosen by its
        accuracy everywhere, as in the paper.
        """
        drawn = column(scene) in TABLE_1
        if self.family == DEFAULT:
            return drawn or scene.startswith(("naip-", "szada-"))
        chosen = {"triplet": LEARNABLE, "autoencoder": f"learning_rate={REDUCED.encoder_rate:g},"}
        by_training = self.family in chosen and chosen[self.family] in self.recipe
        return self.family == "bovw" or (drawn and (self.input == LEARNT or by_training))


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
    found = {(each.family, each.input, each.registration): each for each in rows}
    return [found[each] for each in FLOWN if each in found]


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
REAL_INPUTS = (CANNY, GREY, LEARNT)
"""Inputs of the auto-encoder of the reduced setting over real imagery of two dates."""

FIELD_SCENES = ("B", "naip-2018", "schiphol", "tours")
"""Scenes of the section on the field today, where CAEVL is run too."""
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

    The reduced setting learns fewer networks: `REDUCED_NETWORKS`, and over real imagery the
    auto-encoder on `REAL_INPUTS`; CAEVL on `FIELD_SCENES`.
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
    if setting.name == "lengths":
        return [*rows, ours]
    if setting.name == "epochs":
        return _curves()
    if setting.name == "gpu":
        return [rows[0], *(each for each in networks[:2] if column(scene) in GPU_SCENES), ours]
    rows += [each for each in networks if setting.name != "reduced" or _reduced(each, scene)]
    return [*rows, ours]


def _curves() -> list[Method]:
    """The reduced auto-encoder and the paper's networks after some epochs each."""
    small = f"autoencoder:width={REDUCED.encoder_width},batch={REDUCED.encoder_batch},"
    networks = (
        f"{small}learning_rate={REDUCED.encoder_rate:g}",
        f"autoencoder:width={FULL.encoder_width},batch={FULL.encoder_batch},"
        f"learning_rate={FULL.encoder_rate:g}",
        f"triplet:width={FULL.triplet_width},batch={FULL.triplet_batch}",
    )
    return [
        Method(family, f"{network},epochs={count}", edges, curve=True)
        for network in networks
        for family in [network.partition(":")[0]]
        for edges in (CANNY, GREY)
        for count in CURVE[family]
    ]


def _reduced(method: Method, scene: str) -> bool:
    """Whether the reduced setting learns this network here."""
    name = column(scene)
    if name not in TABLE_1:
        if method.family == "caevl":
            return scene in FIELD_SCENES
        return method.family == "autoencoder" and method.input in REAL_INPUTS
    return name in REDUCED_NETWORKS[method.family].get(method.input, "")
