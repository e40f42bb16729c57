"""From views beside the map to the ground that changed.

Light, exposure and haze are taken out by an affine relation of a view's tone to the map's, fitted
to the cells whose structure agrees and which did not change, and held to that of the whole flight.
What is left is measured in units of what is usual on this flight where the ground is the same, so
that seasons count less where they change everything. Scores of a cell are the median over views.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.ground.changes.record import ChangedGround, ChangeGrid
from orthonav.ground.changes.views import SeenCells

# Chosen on the scenes of `python -m benchmarks.changes` (docs/changes.md).
TONE_WEIGHT, STRUCTURE_WEIGHT, BIAS = 2.0, 2.0, 3.0
"""Logit of a score: weights of the logarithm of 1 + the tone's deviation and of the correlation."""
CHANGED_SCORE = 0.5
"""Cells count as changed from this score on."""
SEVERAL_VIEWS = 2
"""With fewer views both kinds of evidence must say that a cell changed."""
LONE_STRUCTURE, LONE_TONE = 0.15, 3.0
"""A lone view shows change where structure correlates less and tone deviates more than this."""
ROUNDS = 3
"""Fits of the tone, each without the cells that changed by the one before."""
USUAL_FLOOR = 2.0
"""Least usual deviation of the tone, grey levels: noise of 8-bit pictures."""
GAINS = (0.4, 2.5)
"""Limits of the contrast of a view over that of the map."""
FLIGHT_CELLS = 2.0
"""The relation of the whole flight counts as much as so many cells that agree fully."""
_FLIGHT_SPREAD = 200.0
"""Variance of the tones (grey levels squared) that these cells stand for."""
_STEPS = 8
_LEAST_WEIGHT = 1e-3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Tone:
    """Tone of a view as `gain` times that of the map plus `offset`."""

    gain: float
    offset: float


def changed_ground(
    views: Sequence[SeenCells], grid: ChangeGrid, *, map_name: str = "", map_sha256: str = ""
) -> ChangedGround:
    """Scores of all cells of `grid` by these views of one or several flights over one map."""
    count = grid.rows * grid.cols
    shown = np.zeros(count, np.int32)
    score, structure, tone = (np.full(count, np.nan) for _ in range(3))
    if views:
        cells = np.concatenate([each.cells for each in views])
        agreed = np.concatenate([each.structure for each in views])
        shown = np.bincount(cells, minlength=count).astype(np.int32)
        unchanged = np.ones(count)
        for _ in range(ROUNDS):
            off = _deviations(views, unchanged)
            logit = TONE_WEIGHT * np.log1p(off) - STRUCTURE_WEIGHT * agreed - BIAS
            score = 1 / (1 + np.exp(-_medians(logit, cells, count)))
            unchanged = 1 - np.nan_to_num(score)
        structure, tone = _medians(agreed, cells, count), _medians(off, cells, count)
    alone = (structure <= LONE_STRUCTURE) & (tone >= LONE_TONE)
    changed = (score >= CHANGED_SCORE) & ((shown >= SEVERAL_VIEWS) | alone)
    shape = grid.rows, grid.cols
    return ChangedGround(
        grid,
        score.reshape(shape),
        shown.reshape(shape),
        changed.reshape(shape),
        map_name,
        map_sha256,
    )


def _deviations(views: Sequence[SeenCells], unchanged: Array) -> Array:
    """How far the tone of every cell of every view is off, in units of what is usual."""
    weights = [
        np.clip(each.structure, 0, 1) * unchanged[each.cells] + _LEAST_WEIGHT for each in views
    ]
    mine = np.concatenate([each.view_tone for each in views])
    theirs = np.concatenate([each.map_tone for each in views])
    whole = np.concatenate(weights)
    usual = _relation(mine, theirs, whole, None)
    found = []
    for each, weight in zip(views, weights, strict=True):
        fitted = _relation(each.view_tone, each.map_tone, weight, usual)
        expected = fitted.gain * each.map_tone + fitted.offset
        found.append(np.abs(each.view_tone - expected) / fitted.gain)
    off = np.concatenate(found)
    return off / max(_weighted_median(off, whole), USUAL_FLOOR)


def _relation(mine: Array, theirs: Array, weights: Array, usual: _Tone | None) -> _Tone:
    """The relation of tones (N,), robust against cells that do not follow it (Cauchy weights)."""
    held = 0.0 if usual is None else FLIGHT_CELLS
    start = usual or _Tone(1.0, 0.0)
    gain, offset = start.gain, start.offset
    now = weights
    for _ in range(_STEPS):
        total = now.sum()
        at, seen = (now @ theirs) / total, (now @ mine) / total
        spread = now @ (theirs - at) ** 2 + held * _FLIGHT_SPREAD
        product = now @ ((theirs - at) * (mine - seen)) + held * _FLIGHT_SPREAD * start.gain
        gain = float(np.clip(product / max(spread, 1e-9), *GAINS)) if spread > 1e-9 else start.gain
        # What the whole flight expects at the mean tone of these cells.
        expected = start.gain * at + start.offset
        offset = float((total * seen + held * expected) / (total + held) - gain * at)
        off = np.abs(mine - gain * theirs - offset)
        scale = float(weights @ off / weights.sum()) + USUAL_FLOOR
        now = weights / (1 + (off / scale) ** 2)
    return _Tone(gain, offset)


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    upto = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(upto, upto[-1] / 2)])


def _medians(values: Array, cells: NDArray[np.intp], count: int) -> Array:
    """Median (count,) of the values (N,) of each cell; NaN for cells without values.

    Of an even number of values the lower of the two in the middle: of two views both must disagree.
    """
    order = np.lexsort((values, cells))
    found = np.full(count, np.nan)
    used, first, number = np.unique(cells[order], return_index=True, return_counts=True)
    found[used] = values[order][first + (number - 1) // 2]
    return found
