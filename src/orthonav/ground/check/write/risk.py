"""The colour scale of probabilities, and classes of risk along the route in its colours, which
differ in width and dash too."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.records import CONFIDENT

KNEE = 0.5, 0.2
"""A probability and its place on the colour scale: most of the scale is for what is likely."""


def shade(probability: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Place on the colour scale, 0 to 1, of probabilities of any shape."""
    return np.asarray(np.interp(probability, [0.0, KNEE[0], 1.0], [0.0, KNEE[1], 1.0]))


@dataclass(frozen=True)
class Risk:
    """A class of places along the route.

    `least`: lowest probability of the class; NaN where the probability is unknown.
    `colour`: that of the middle of its range on the scale of the cells (cividis: light is likely);
    `edge`: behind it, so that it stands out on the cells.
    `width`: of the line in pixels; `dash`: lengths drawn and skipped, empty for a solid line.
    `range_text`: its range of probabilities.
    """

    name: str
    least: float
    colour: str
    edge: str
    width: float
    dash: tuple[int, ...]
    range_text: str


_DARK, _LIGHT = "#1a1a1a", "#ffffff"
RISKS = (
    Risk("confident", CONFIDENT, "#ead34c", _DARK, 4.0, (), "0.9 or more"),
    Risk("likely", 0.7, "#a99f73", _DARK, 2.5, (), "0.7 to 0.9"),
    Risk("doubtful", 0.5, "#5e626e", _LIGHT, 5.0, (9, 4), "0.5 to 0.7"),
    Risk("unlikely", 0.0, "#083370", _LIGHT, 6.5, (), "below 0.5"),
    Risk("unknown", float("nan"), "#ffffff", _DARK, 4.0, (4, 6), "unknown"),
)
EDGE_PX = 3.0
"""How much wider the edge is than the line."""


def risk_of(probability: float) -> int:
    """The index in `RISKS` of a probability."""
    found = (i for i, risk in enumerate(RISKS) if probability >= risk.least)
    return next(found, len(RISKS) - 1)


def segments(probability: NDArray[np.float64]) -> list[tuple[int, int, int]]:
    """The route of points (N,) in segments of one class: (class, first point, last point).

    Between two points the worse class counts; segments share their ends.
    """
    classes = [risk_of(value) for value in probability]
    found: list[tuple[int, int, int]] = []
    for i in range(len(classes) - 1):
        here = max(classes[i], classes[i + 1])
        if found and found[-1][0] == here:
            found[-1] = (here, found[-1][1], i + 1)
        else:
            found.append((here, i, i + 1))
    return found
