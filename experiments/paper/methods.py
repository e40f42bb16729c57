"""The paper's section Methodology: which methods look at what, as orthonav names them."""

from dataclasses import dataclass

from experiments.paper.trajectories import Setting, epochs

GREY, CANNY, SEGMENTS, SAM = "gray", "canny", "segments", "sam"
DEFAULT = "gradient"


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
    def key(self) -> str:
        """Short name, for files: what is in it tells rows of one setting apart."""
        words = self.recipe.partition("words=")[2].partition(",")[0]
        layer = "registration" if self.registration else ""
        parts = (self.family, self.edges.partition(":")[0], words, layer)
        return "-".join(part for part in parts if part)


def methods(setting: Setting, tiles: int, sam_weights: str | None = None) -> list[Method]:
    """All rows for a map of so many tiles, quick ones first."""
    shown, width = setting.encoder_tiles, setting.encoder_width
    encoder = (
        f"autoencoder:width={width},learning_rate={setting.encoder_rate:g},"
        f"epochs={epochs(tiles, shown)}"
    )
    triplet = (
        f"triplet:width={setting.triplet_width},batch={setting.triplet_batch},"
        f"epochs={epochs(tiles, setting.triplet_tiles)}"
    )
    looked_at = [CANNY, GREY, SEGMENTS]
    if sam_weights:
        looked_at.append(f"{SAM}:weights={sam_weights}")
    rows = [Method(DEFAULT, DEFAULT, DEFAULT)]
    rows += [Method("bovw", f"bovw:words={words}", GREY) for words in setting.words]
    rows += [Method("autoencoder", encoder, edges) for edges in looked_at]
    rows += [Method("triplet", triplet, edges) for edges in looked_at]
    return [*rows, Method(DEFAULT, DEFAULT, DEFAULT, True)]
