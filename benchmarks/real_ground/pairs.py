"""A track against the single views of the same flight: it may not be worse.

The two rows may rate different views, and a track is confident at views where a single view is not,
which are the harder ones. So errors are compared at views where both are confident.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.real_ground.score import Placed
from benchmarks.record import Table, number

SINGLE, TRACKED = ", single", ", tracked"
MIN_SHARED = 10
"""With fewer views where both are confident, all confident views of each row are compared."""
PERCENTS = {"median": 50, "95 %": 95}
CHANCE = 2 * 0.73
"""Two standard errors of the median, and of the 95 % error, of n independent errors (Rayleigh), as
a share of it and times the root of n. A track may be worse by as much: the difference to single
views of the same places varies by one standard error where errors correlate by 0.5."""
LEAST_M = 0.2
"""And by this distance, which counts where errors are below a metre."""
HEADER = (
    *("flight", "views"),
    *(f"{name} m: {row}" for name in PERCENTS for row in ("single", "track")),
)
NOTES = (
    f"errors at views where both are confident; where these are fewer than {MIN_SHARED}, at all "
    "confident views of each, whose numbers are given with a slash",
    f"failed: a track whose median or 95 % error is worse by {CHANCE:.0%} / sqrt(views), two "
    f"standard errors, and {LEAST_M:g} m",
)
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pair:
    """Fixes of a flight by single views and by a track."""

    single: list[Placed]
    track: list[Placed]

    def errors_m(self) -> tuple[Array, Array]:
        """Errors of single views and of the track at the views that are compared."""
        single, track = (
            {each.time_s: each.error_m for each in fixes if each.confident}
            for fixes in (self.single, self.track)
        )
        both = [time_s for time_s in single if time_s in track]
        if len(both) < MIN_SHARED:
            return np.array(list(single.values())), np.array(list(track.values()))
        return np.array([single[each] for each in both]), np.array([track[each] for each in both])


def paired(values: dict[str, dict[str, Any]]) -> dict[str, Pair]:
    """Pairs by flight, of the values of rows; a row without its counterpart has none."""
    made = {}
    for name in (each.removesuffix(TRACKED) for each in values if each.endswith(TRACKED)):
        if name + SINGLE in values:
            rows = (values[name + kind]["fixes"] for kind in (SINGLE, TRACKED))
            made[name] = Pair(*([Placed(**fix) for fix in row] for row in rows))
    return made


def failures(pairs: dict[str, Pair]) -> list[list[str]]:
    """Row, figure, value and what is allowed, of tracks that are worse than their single views."""
    return [line for name, pair in pairs.items() for line in _worse(name + TRACKED, pair)]


def _worse(name: str, pair: Pair) -> list[list[str]]:
    single, track = pair.errors_m()
    if not single.size:
        return []
    if not track.size:
        return [[name, "confident fixes", "none", "some, as single views"]]
    share = CHANCE / math.sqrt(min(single.size, track.size))
    made = []
    for figure, percent in PERCENTS.items():
        alone_m, tracked_m = (float(np.percentile(each, percent)) for each in (single, track))
        limit_m = LEAST_M + (1 + share) * alone_m
        if tracked_m > limit_m:
            allowed = f"to {number(limit_m)}, single views {number(alone_m)}"
            made.append([name, f"{figure} m", number(tracked_m), allowed])
    return made


def table(pairs: dict[str, Pair]) -> Table:
    rows = []
    for name, pair in pairs.items():
        errors = pair.errors_m()
        views = " / ".join(dict.fromkeys(str(each.size) for each in errors))
        cells = [
            number(float(np.percentile(each, percent))) if each.size else "-"
            for percent in PERCENTS.values()
            for each in errors
        ]
        rows.append([name, views, *cells])
    return Table("Tracks against single views", HEADER, rows, NOTES)
