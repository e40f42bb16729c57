"""Candidates for registration: the tiles whose embeddings are most similar to the view's."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.embed.bank import embed_poses
from orthonav.embed.contract import ViewEmbedder
from orthonav.embed.whitened import WhitenedEmbedder
from orthonav.geo.grid import TileGrid
from orthonav.localizer.match import TileMatcher
from orthonav.localizer.plan import SearchPlan
from orthonav.localizer.rectify import RectifiedView
from orthonav.register.pose import Pose
from orthonav.register.search import Candidate
from orthonav.search.exact import ExactIndex, top_tiles
from orthonav.search.peak import TileNeighbours


@dataclass(frozen=True, eq=False)
class TileProposer:
    """Embeds a view under many poses and finds the most similar tiles.

    `grid`, `centres_en_m` (N, 2) and `index` are those of the sheet's tiles, `neighbours` the tiles
    next to each; `representation` and `embedder` made the embeddings.
    """

    grid: TileGrid
    centres_en_m: NDArray[np.float32]
    index: ExactIndex
    embedder: WhitenedEmbedder
    representation: Any
    neighbours: TileNeighbours

    @classmethod
    def of(
        cls, tiles: TileMatcher, embedder: ViewEmbedder, representation: Any
    ) -> "TileProposer | None":
        """A proposer for whitened embeddings, None for others: those cannot embed a view under
        many poses at once."""
        if not isinstance(embedder, WhitenedEmbedder):
            return None
        return cls(
            tiles.grid, tiles.centres_en_m, tiles.index, embedder, representation, tiles.neighbours
        )

    def fits(self, side_px: float, plan: SearchPlan) -> bool:
        """Whether candidates are of use for views of this side (pixels of the map)."""
        smallest, largest = plan.view_tiles
        return smallest * self.grid.tile_px <= side_px <= largest * self.grid.tile_px

    def candidates(
        self,
        view: RectifiedView,
        poses: list[tuple[float, float]],
        rows: NDArray[np.intp] | None,
        plan: SearchPlan,
    ) -> list[Candidate]:
        """Candidates for a view rectified heading-up at the map's resolution, among tiles `rows`.

        `poses` are headings (rad) and log scales; scores are those of the embeddings.
        """
        queries = embed_poses(
            self.embedder, self.representation, view.grey, view.valid, poses, self.grid.tile_px
        )
        scores = self.index.best(queries, rows)
        centres = self.centres_en_m if rows is None else self.centres_en_m[rows]
        apart_m = plan.tile_apart_strides * self.grid.stride_m
        chosen = top_tiles(scores, centres, plan.tile_candidates, apart_m)
        tiles = chosen if rows is None else rows[chosen]
        which = self.index.which(queries, tiles)
        found = []
        for place, tile, query in zip(chosen, tiles, which, strict=True):
            shift = self.neighbours.peak_offset(scores, int(tile), rows)
            east, north = self.centres_en_m[tile] + np.array(shift) * self.grid.stride_m
            x_px = (float(east) - self.grid.west_m) / self.grid.gsd_m
            y_px = (self.grid.north_m - float(north)) / self.grid.gsd_m
            pose = Pose(x_px, y_px, *poses[int(query)])
            found.append(Candidate(float(scores[place]), pose))
        return found
