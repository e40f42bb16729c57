"""Ratios of best scores: the paper's criterion, and the same with an exclusion radius."""

import numpy as np
from numpy.typing import NDArray

MAX_RATIO = 10.0
"""Ratios are cut off here; a rival at or below zero leaves the best without any rival."""


def lowe_ratio(scores: NDArray[np.float32], best: int | None = None) -> float:
    """Best score over second best (Di Piazza et al. 2024, section 4), up to `MAX_RATIO`.

    `best` is the index of the score that counts as best, the highest where None; where another one
    is higher the ratio is below 1.

    With dense overlap the second best tile is nearly always the neighbour of the best.
    """
    if scores.size < 2:
        return MAX_RATIO
    if best is None:
        best = int(scores.argmax())
    others = max(scores[:best].max(initial=-1.0), scores[best + 1 :].max(initial=-1.0))
    return _ratio(float(scores[best]), float(others))


def rival_score(
    scores: NDArray[np.float32],
    centres_en_m: NDArray[np.float32],
    best: int,
    exclusion_m: float,
) -> float:
    """Best score among tiles farther than `exclusion_m` from the best tile.

    The best score itself where there is no such tile: without a rival nothing is known of how
    much the best stands out, and that must not appear as certainty.
    """
    offset = centres_en_m - centres_en_m[best]
    elsewhere = np.einsum("ij,ij->i", offset, offset) > exclusion_m**2
    if not elsewhere.any():
        return float(scores[best])
    return float(np.max(scores, where=elsewhere, initial=-1.0))


def peak_ratio(best_score: float, rival: float) -> float:
    """Best score over the best score elsewhere (`rival_score`), up to `MAX_RATIO`."""
    return _ratio(best_score, rival)


def _ratio(best: float, second: float) -> float:
    if best <= 0:
        return 1.0
    return min(MAX_RATIO, best / second) if second > 0 else MAX_RATIO
