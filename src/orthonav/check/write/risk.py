"""Classes of risk along the route; they differ in width and dash as well as in colour."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.records import CONFIDENT


@dataclass(frozen=True)
class Risk:
    """A class of places along the route.

    `least`: lowest probability of the class; NaN where the probability is unknown.
    `width`: of the line in pixels; `dash`: lengths drawn and skipped, empty for a solid line.
    `range_text`: its range of probabilities.
    """

    name: str
    least: float
    colour: str
    width: float
    dash: tuple[int, ...]
    range_text: str


RISKS = (
    Risk("confident", CONFIDENT, "#0072b2", 4.0, (), "0.9 or more"),
    Risk("likely", 0.7, "#56b4e9", 4.0, (), "0.7 to 0.9"),
    Risk("doubtful", 0.5, "#e69f00", 5.0, (9, 4), "0.5 to 0.7"),
    Risk("unlikely", 0.0, "#d55e00", 6.5, (), "below 0.5"),
    Risk("unknown", float("nan"), "#6e6e6e", 4.0, (4, 6), "unknown"),
)


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
