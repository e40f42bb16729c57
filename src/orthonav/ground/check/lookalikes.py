"""Ambiguous places: pairs of places that can be mistaken for each other, as trials found them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.check.outcome import Lookalike
from orthonav.ground.check.trials import Trial

SIMILAR = 0.8
"""A rival place is ambiguous if it reaches this fraction of the best score."""
MAX_PAIRS = 40
_WRONG_CONFIDENCE = 0.5
"""One wrong trial of this confidence is enough; otherwise a second trial must agree."""


@dataclass(frozen=True)
class _Pair:
    place: tuple[float, float]
    other: tuple[float, float]
    similarity: float
    confident: bool


def found_lookalikes(
    trials: Sequence[Trial],
    frame: LocalFrame,
    *,
    view_side_m: float,
    radius_m: float,
    prior_std_m: float | None,
) -> tuple[Lookalike, ...]:
    """Pairs of places, most similar first; pairs whose ends lie within half a view are merged.

    A misplaced view pairs its true place with where it was placed; a correctly placed view pairs
    it with its best rival, if that scores high enough.
    """
    # Within a quarter of a view it is the same place, only located badly.
    far_m = max(radius_m, view_side_m / 4)
    pairs = [pair for each in trials if (pair := _pair(each, far_m)) is not None]
    pairs.sort(key=lambda pair: -pair.similarity)
    groups: list[list[_Pair]] = []
    for pair in pairs:
        group = next((g for g in groups if _same(g[0], pair, view_side_m / 2)), None)
        if group is None:
            groups.append([pair])
        else:
            group.append(pair)
    groups = [group for group in groups if len(group) > 1 or group[0].confident]
    groups.sort(key=lambda group: (-min(len(group), 3), -group[0].similarity))
    return tuple(_lookalike(group, frame, prior_std_m) for group in groups[:MAX_PAIRS])


def _pair(trial: Trial, far_m: float) -> _Pair | None:
    if not math.isfinite(trial.error_m):
        return None
    if trial.error_m > far_m:
        return _Pair(trial.en_m, trial.found_en_m, 1.0, trial.confidence >= _WRONG_CONFIDENCE)
    if math.isfinite(trial.rival_share) and trial.rival_share >= SIMILAR:
        return _Pair(trial.en_m, trial.rival_en_m, min(trial.rival_share, 1.0), False)
    return None


def _same(one: _Pair, two: _Pair, within_m: float) -> bool:
    """Whether both ends of two pairs, in either order, lie near each other."""
    straight = max(math.dist(one.place, two.place), math.dist(one.other, two.other))
    swapped = max(math.dist(one.place, two.other), math.dist(one.other, two.place))
    return min(straight, swapped) <= within_m


def _lookalike(group: Sequence[_Pair], frame: LocalFrame, prior_std_m: float | None) -> Lookalike:
    first = group[0]
    apart_m = math.dist(first.place, first.other)
    lat, lon = frame.latlon_from_en(np.array([first.place, first.other]))
    return Lookalike(
        place_latlon_deg=(float(lat[0]), float(lon[0])),
        other_latlon_deg=(float(lat[1]), float(lon[1])),
        apart_m=apart_m,
        similarity=float(np.mean([pair.similarity for pair in group])),
        trials=len(group),
        within_prior=prior_std_m is None or apart_m <= 3 * prior_std_m,
    )
