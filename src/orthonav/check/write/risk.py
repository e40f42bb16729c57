"""Colours: of probabilities on the map, and of the few classes of risk along the route.

Cells take cividis (Nunez et al. 2018, doi 10.1371/journal.pone.0199239), which is read alike with
and without colour blindness; classes take colours of Okabe and Ito and differ by width and dash
too.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CIVIDIS = (
    *("#00224e", "#123570", "#3b496c", "#575d6d", "#707173", "#8a8678"),
    *("#a59c74", "#c3b369", "#e1cc55", "#fee838"),
)
"""The map of colours at equal steps from 0 to 1; between them it is interpolated."""


@dataclass(frozen=True)
class Risk:
    """A class of places along the route: from this probability on.

    `dash` is lengths drawn and left out in pixels, empty for a whole line.
    """

    name: str
    least: float
    colour: str
    width: float
    dash: tuple[int, ...]
    said: str


RISKS = (
    Risk("sure", 0.9, "#0072b2", 4.0, (), "0.9 or more"),
    Risk("likely", 0.7, "#56b4e9", 4.0, (), "0.7 to 0.9"),
    Risk("doubtful", 0.5, "#e69f00", 5.0, (9, 4), "0.5 to 0.7"),
    Risk("unlikely", 0.0, "#d55e00", 6.5, (), "below 0.5"),
)
UNKNOWN = Risk("unknown", float("nan"), "#6e6e6e", 4.0, (4, 6), "not known")
ALL_RISKS = (*RISKS, UNKNOWN)


def risk_of(probability: float) -> int:
    """Which of `ALL_RISKS` a probability belongs to."""
    found = (i for i, risk in enumerate(RISKS) if probability >= risk.least)
    return next(found, len(RISKS))


def pieces(probability: NDArray[np.float64]) -> list[tuple[int, int, int]]:
    """The route of points (N,) in pieces of one class: (class, first point, last point).

    Between two points the worse of their classes counts; pieces share their ends.
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


def colour_at(share: float) -> str:
    """The colour of cividis at 0 to 1, as `#rrggbb`."""
    stops = np.array([[int(each[k : k + 2], 16) for k in (1, 3, 5)] for each in CIVIDIS])
    at = np.clip(share, 0.0, 1.0) * (len(CIVIDIS) - 1)
    low = min(int(at), len(CIVIDIS) - 2)
    red, green, blue = np.rint(stops[low] + (at - low) * (stops[low + 1] - stops[low])).astype(int)
    return f"#{red:02x}{green:02x}{blue:02x}"
