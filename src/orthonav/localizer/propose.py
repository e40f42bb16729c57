"""Candidates for registration from the tiles whose embeddings are most like the view's."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.embed.bank import embed_poses
from orthonav.embed.contract import ViewEmbedder
from orthonav.embed.whitened import WhitenedEmbedder
from orthonav.geo.grid import TileGrid
from orthonav.localizer.rectify import RectifiedView
from orthonav.register.pose import Pose
from orthonav.register.search import Candidate
from orthonav.search.exact import ExactIndex, top_tiles
from orthonav.search.peak import TileNeighbours

CANDIDATES = 20
APART_STRIDES = 1.5
VIEW_TILES = (0.6, 2.5)
"""Sides of views, in tiles, of which a tile's embedding says enough."""
POSE_MS = 0.06
REPRESENT_MS = 4.0
SCORE_MS = 5e-8
"""Rough costs on one core: of a pose, of the view, of one number of one tile under one pose."""


@dataclass(frozen=True, eq=False)
class TileProposer:
    """Embeds a view under a bank of poses and looks for the tiles most like it."""

    grid: TileGrid
    centres_en_m: NDArray[np.float32]
    index: ExactIndex
    embedder: WhitenedEmbedder
    representation: Any
    neighbours: TileNeighbours

    @classmethod
    def of(
        cls,
        grid: TileGrid,
        centres_en_m: NDArray[np.float32],
        index: ExactIndex,
        embedder: ViewEmbedder,
        representation: Any,
        neighbours: TileNeighbours,
    ) -> "TileProposer | None":
        """A proposer for embeddings of which many poses can be made at once, None for others."""
        if not isinstance(embedder, WhitenedEmbedder):
            return None
        return cls(grid, centres_en_m, index, embedder, representation, neighbours)

    def fits(self, side_px: float) -> bool:
        """Whether views of this side (pixels of the map) can be proposed for."""
        smallest, largest = VIEW_TILES
        return smallest * self.grid.tile_px <= side_px <= largest * self.grid.tile_px

    def cost_ms(self, poses: int, tiles: int) -> float:
        """About how long it takes."""
        return REPRESENT_MS + poses * (POSE_MS + SCORE_MS * tiles * self.embedder.dims)

    def candidates(
        self, view: RectifiedView, poses: list[tuple[float, float]], rows: NDArray[np.intp] | None
    ) -> list[Candidate]:
        """Candidates for a view rectified heading-up at the map's resolution, among tiles `rows`.

        `poses` are headings (rad) and log scales; scores are those of the embeddings.
        """
        queries = embed_poses(
            self.embedder, self.representation, view.grey, view.valid, poses, self.grid.tile_px
        )
        scores = self.index.best(queries, rows)
        centres = self.centres_en_m if rows is None else self.centres_en_m[rows]
        chosen = top_tiles(scores, centres, CANDIDATES, APART_STRIDES * self.grid.stride_m)
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
