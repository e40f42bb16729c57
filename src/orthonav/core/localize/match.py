"""The tile most similar to a view, and the evidence for it.

Shared by the localizer and the calibration of a map, so that the confidence is learnt on the same
numbers that it judges in flight.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.ratios import lowe_ratio, peak_ratio, rival_score
from orthonav.core.tiles.exact import ExactIndex
from orthonav.core.tiles.position import PositionRule, TileNeighbours, offset_en_m

BACKGROUND_TILES = 20_000
"""Rivals are taken from about so many tiles of the whole map, evenly spread: enough for the best
rival, and the search of a narrow prior stays fast."""


@dataclass(frozen=True, eq=False)
class Match:
    """The best tile for one view.

    `tile`: its row. `shift_en_m`: offset of the position from the centre of that tile, east and
    north (m). `query`: index of the best of the headings tried. `evidence`: that of
    `TileMatcher.match`.
    """

    tile: int
    shift_en_m: tuple[float, float]
    query: int
    evidence: dict[str, float]


class TileMatcher:
    """The tiles of a sheet: centres (N, 2) float32 and embeddings (N, D) float16."""

    def __init__(
        self,
        grid: TileGrid,
        centres_en_m: NDArray[np.float32],
        embeddings: NDArray[np.float16],
        position: PositionRule = "peak",
    ) -> None:
        """`position` says how scores become a position between the tiles.

        Raises `MapFileError` where the centres are not those of the grid.
        """
        self._position: PositionRule = position
        self.index = ExactIndex(embeddings)
        self.grid = grid
        self.centres_en_m = centres_en_m
        self.neighbours = TileNeighbours(grid, centres_en_m)
        step = -(-len(embeddings) // BACKGROUND_TILES)
        self._background = np.arange(0, len(embeddings), step, dtype=np.intp)

    def match(self, queries: NDArray[np.float32], rows: NDArray[np.intp] | None = None) -> Match:
        """Best tile for queries (Q, D), one per heading, among `rows` (all where None).

        Evidence: `score` (best scalar product), `margin` (its lead over the best score farther
        than half a tile away), `lowe_ratio`, `peak_ratio` (the same with that exclusion). Rivals
        are sought beyond `rows` too, on up to `BACKGROUND_TILES` tiles of the whole map: a
        narrow prior leaves no rival of its own, and that must not appear as certainty.
        """
        searched = None
        if rows is not None:
            searched = np.union1d(rows, self._background)
        scores = self.index.scores(queries, searched)
        best_heading = scores.argmax(axis=1)
        per_tile = np.take_along_axis(scores, best_heading[:, None], axis=1)[:, 0]
        if searched is None or rows is None:
            centres, best = self.centres_en_m, int(per_tile.argmax())
            tile = best
        else:
            centres, allowed = self.centres_en_m[searched], np.searchsorted(searched, rows)
            best = int(allowed[per_tile[allowed].argmax()])
            tile = int(searched[best])
        score = float(per_tile[best])
        rival = rival_score(per_tile, centres, best, self.grid.tile_m / 2)
        evidence = {
            "score": score,
            "margin": score - rival,
            "lowe_ratio": lowe_ratio(per_tile, best),
            "peak_ratio": peak_ratio(score, rival),
            "tiles_searched": float(len(per_tile) if rows is None else len(rows)),
        }
        # The background serves as rivals only: a mean of all is one of those that are allowed.
        used, used_rows = per_tile, searched
        if self._position == "weighted" and searched is not None and rows is not None:
            used, used_rows = per_tile[np.searchsorted(searched, rows)], rows
        shift = offset_en_m(
            self._position,
            used,
            tile,
            used_rows,
            self.centres_en_m,
            self.neighbours,
            self.grid.stride_m,
        )
        return Match(tile, shift, int(best_heading[best]), evidence)
