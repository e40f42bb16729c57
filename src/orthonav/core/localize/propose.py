"""Candidates for registration: the tiles whose embeddings are most similar to the view's."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.match import TileMatcher
from orthonav.core.localize.rectify import RectifiedView
from orthonav.core.register.pose import Pose
from orthonav.core.register.search import Candidate
from orthonav.core.tiles.bank import Representation, embed_poses
from orthonav.core.tiles.embed import ViewEmbedder
from orthonav.core.tiles.exact import ExactIndex
from orthonav.core.tiles.position import TileNeighbours, parabola_peak
from orthonav.core.tiles.whitened import WhitenedEmbedder


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
    representation: Representation
    neighbours: TileNeighbours

    @classmethod
    def of(
        cls, tiles: TileMatcher, embedder: ViewEmbedder, representation: Representation
    ) -> "TileProposer | None":
        """A proposer for whitened embeddings, None for others: those cannot embed a view under
        many poses at once."""
        if not isinstance(embedder, WhitenedEmbedder):
            return None
        return cls(
            tiles.grid, tiles.centres_en_m, tiles.index, embedder, representation, tiles.neighbours
        )

    def fits(self, side_px: float, view_tiles: tuple[float, float]) -> bool:
        """Whether a view of this side (pixels of the map) is from the least to the largest of
        `view_tiles` tiles wide."""
        smallest, largest = view_tiles
        return smallest * self.grid.tile_px <= side_px <= largest * self.grid.tile_px

    def candidates(
        self,
        view: RectifiedView,
        poses: list[tuple[float, float]],
        weights: NDArray[np.float32],
        rows: NDArray[np.intp] | None,
        count: int,
    ) -> list[Candidate]:
        """Candidates for a view rectified heading-up at the map's resolution, among tiles `rows`.

        `poses` are headings (rad) and log scales; scores are those of the embeddings, times the
        `weights` (Q,) of the poses. Up to `count` tiles, the best of those that no tile next to
        them exceeds: neighbours show the same ground.
        """
        queries = embed_poses(
            self.embedder, self.representation, view.grey, view.valid, poses, self.grid.tile_px
        )
        scores = self.index.best(queries * weights[:, None], rows)
        chosen = self.neighbours.maxima(scores, count, rows)
        tiles = chosen if rows is None else rows[chosen]
        by_pose = self.index.scores(queries, tiles)
        peaks = peak_poses(np.array(poses), by_pose, weights)
        found = []
        for place, tile, (turn_rad, log_scale) in zip(chosen, tiles, peaks.tolist(), strict=True):
            shift = self.neighbours.peak_offset(scores, int(tile), rows)
            east, north = self.centres_en_m[tile] + np.array(shift) * self.grid.stride_m
            x_px = (float(east) - self.grid.west_m) / self.grid.gsd_m
            y_px = (self.grid.north_m - float(north)) / self.grid.gsd_m
            pose = Pose(x_px, y_px, turn_rad, log_scale)
            found.append(Candidate(float(scores[place]), pose))
        return found


def peak_poses(
    poses: NDArray[np.float64], scores: NDArray[np.float32], weights: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Headings and log scales (N, 2) where the scores (N, Q) of poses (Q, 2) on a grid have their
    peak.

    By a parabola along each, or those of the best pose where one of its neighbours is missing. The
    best one has the highest score times its weight (Q,); weights do not move the parabola.
    """
    off = poses - poses[:, None]
    off[..., 0] = np.remainder(off[..., 0] + np.pi, 2 * np.pi) - np.pi
    best, tiles = (scores * weights).argmax(axis=1), np.arange(len(scores))
    peaks: NDArray[np.float64] = poses[best]
    for axis in (0, 1):
        other = np.isclose(off[..., 1 - axis], 0.0)
        beside = []
        for sign in (-1, 1):
            along = sign * off[..., axis]
            away = np.where(other & (along > 1e-9), along, np.inf)
            nearest = away.argmin(axis=1)[best]
            beside.append((nearest, away[best, nearest]))
        (before, back), (after, ahead) = beside
        has_both = np.isfinite(back + ahead)
        around = scores[tiles[:, None], np.stack([before, best, after], axis=1)]
        moved = np.array([parabola_peak(*each) for each in around.tolist()])
        step = np.where(has_both, (back + ahead) / 2, 0.0)
        peaks[:, axis] += np.where(has_both, moved, 0.0) * step
    return peaks
