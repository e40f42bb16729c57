"""The paper's Table 1: trajectories A to D, their search bands and overlaps; and how it is cut.

The table itself, and the ground resolution taken where the paper states none, are those of the
presets (`orthonav.ground.planning.route`).
"""

import math
from dataclasses import astuple, dataclass, replace

from orthonav.ground.planning import route

TILE_PX = 256
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
        slack_m = 2 * self.margin_m + 2 * CONVERGENCE * self.length_m
        return self.length_m + slack_m, self.band_m + slack_m


TABLE_1 = {name: Trajectory(*astuple(column)) for name, column in route.TABLE_1.items()}
IMPLIED_GSD_M = {"B": 0.75, "C": 1.5, "D": 0.75}
"""Ground resolution that the paper's numbers of views imply: 12 km in 500 tile steps of 32 px, and
2 km in 84; C, from twice the height, in proportion. A: 0.19 m, but landscapes end at 0.2 m."""
REDUCED_M = {"A": (150, 1), "B": (3000, 300), "C": (5000, 1000), "D": (1000, 1000)}
"""Length and search band of the reduced setting."""


@dataclass(frozen=True)
class Setting:
    """Size of the experiments.

    - `name`: "reduced", "full", or "gpu": the full auto-encoder on B and D.
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
        if self.name == "reduced":
            length_m, band_m = REDUCED_M[name]
            return replace(whole, length_m=length_m, band_m=band_m)
        gsd_m = IMPLIED_GSD_M.get(name, whole.gsd_m)
        return replace(whole, length_m=min(whole.length_m, LARGEST_M), gsd_m=gsd_m)


LEARNABLE = ",mining=semihard,similarity=cosine,margin=0.2"
REDUCED = Setting("reduced", 32, 3e-3, 16, 19_200, 8, 28_800, 64, LEARNABLE, (256, 1024), 100, 40)
FULL = Setting("full", 512, 3e-4, 32, None, 64, None, 512, "", (256, 1000, 3000, 10_000), 300, 300)
GPU = replace(FULL, name="gpu")
SETTINGS = {each.name: each for each in (REDUCED, GPU, FULL)}
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
