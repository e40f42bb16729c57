"""From the scores of tiles to a position: the rules of the literature, side by side.

*best*: the tile with the highest score (Di Piazza et al., IGARSS 2024). *weighted*: the mean of the
centres of all tiles searched, weighted by their scores (Bianchi and Barfoot, RA-L 2021); scores
below zero count as zero. *neighbours*: the mean of the best tile and those around it, weighted by
what their scores have above the lowest of them (after Couturier and Akhloufi, 2021). *peak*: the
top of a parabola through the best tile and its neighbours, orthonav's own.
"""

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import VariantError
from orthonav.core.tiles.peak import TileNeighbours

PositionRule = Literal["peak", "best", "neighbours", "weighted"]
RULES: tuple[PositionRule, ...] = get_args(PositionRule)


def check_rule(rule: str) -> PositionRule:
    """The rule of that name; raises `VariantError` if there is none."""
    for known in RULES:
        if rule == known:
            return known
    raise VariantError(f"unknown rule of position '{rule}'; known are: {', '.join(RULES)}")


def offset_en_m(
    rule: PositionRule,
    scores: NDArray[np.float32],
    best: int,
    rows: NDArray[np.intp] | None,
    centres_en_m: NDArray[np.float32],
    neighbours: TileNeighbours,
    stride_m: float,
) -> tuple[float, float]:
    """Offset (east, north) in metres of the position from the centre of the best tile.

    `scores` belong to all tiles, or to `rows` (sorted) where given; `centres_en_m` (N, 2) are those
    of all tiles, `best` is a row of them.
    """
    if rule == "best":
        return 0.0, 0.0
    if rule == "peak":
        east, north = neighbours.peak_offset(scores, best, rows)
        return east * stride_m, north * stride_m
    if rule == "weighted":
        tiles = np.arange(len(centres_en_m)) if rows is None else rows
        weights = np.maximum(scores.astype(np.float64), 0)
    else:
        tiles, near = neighbours.around(scores, best, rows)
        weights = near - near.min(initial=np.inf) if len(near) > 1 else np.ones(len(near))
    if not weights.sum() > 0:
        return 0.0, 0.0
    away = centres_en_m[tiles].astype(np.float64) - centres_en_m[best]
    east, north = weights @ away / weights.sum()
    return float(east), float(north)
