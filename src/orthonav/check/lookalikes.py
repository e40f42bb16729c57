"""Places of a map that views of one may be put at the other, as trials found them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthonav.check.outcome import Lookalike
from orthonav.check.trials import Trial
from orthonav.geo.frames import LocalFrame

LIKE = 0.8
"""A place elsewhere is alike where its score reaches this share of that of the right one."""
MOST = 40
_WRONG_CONFIDENCE = 0.5
"""One trial is enough where it was put elsewhere with this confidence; else it may be chance, and
another must say the same."""


@dataclass(frozen=True)
class _Pair:
    here: tuple[float, float]
    there: tuple[float, float]
    likeness: float
    sure: bool


def found_lookalikes(
    trials: Sequence[Trial],
    frame: LocalFrame,
    *,
    view_side_m: float,
    radius_m: float,
    prior_std_m: float | None,
) -> tuple[Lookalike, ...]:
    """Pairs of places, the likest first. Pairs whose ends lie within half a view are one.

    A view that was put elsewhere makes a pair with where it was put; one that was put right with
    its best rival, where that comes close.
    """
    # Nearer than a quarter of a view is the same place, if not well placed.
    far_m = max(radius_m, view_side_m / 4)
    pairs = [pair for each in trials if (pair := _pair(each, far_m)) is not None]
    pairs.sort(key=lambda pair: -pair.likeness)
    groups: list[list[_Pair]] = []
    for pair in pairs:
        for group in groups:
            if _alike(group[0], pair, view_side_m / 2):
                group.append(pair)
                break
        else:
            groups.append([pair])
    groups = [group for group in groups if len(group) > 1 or group[0].sure]
    groups.sort(key=lambda group: (-min(len(group), 3), -group[0].likeness))
    return tuple(_told(group, frame, prior_std_m) for group in groups[:MOST])


def _pair(trial: Trial, far_m: float) -> _Pair | None:
    if not math.isfinite(trial.error_m):
        return None
    if trial.error_m > far_m:
        return _Pair(trial.en_m, trial.found_en_m, 1.0, trial.confidence >= _WRONG_CONFIDENCE)
    if math.isfinite(trial.rival_share) and trial.rival_share >= LIKE:
        return _Pair(trial.en_m, trial.rival_en_m, min(trial.rival_share, 1.0), False)
    return None


def _alike(one: _Pair, other: _Pair, within_m: float) -> bool:
    """Whether both ends of two pairs, in either order, lie near each other."""
    same = max(math.dist(one.here, other.here), math.dist(one.there, other.there))
    turned = max(math.dist(one.here, other.there), math.dist(one.there, other.here))
    return min(same, turned) <= within_m


def _told(group: Sequence[_Pair], frame: LocalFrame, prior_std_m: float | None) -> Lookalike:
    first = group[0]
    apart_m = math.dist(first.here, first.there)
    places = []
    for place in (first.here, first.there):
        lat, lon = frame.latlon_from_en(np.array(place))
        places.append((float(lat), float(lon)))
    return Lookalike(
        places[0],
        places[1],
        apart_m,
        float(np.mean([pair.likeness for pair in group])),
        len(group),
        prior_std_m is None or apart_m <= 3 * prior_std_m,
    )
