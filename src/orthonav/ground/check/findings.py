"""What trials and predictions say: ambiguous places, predictions along a route, gaps; the verdict.

docs/check.md lists the rules of the verdict.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.check.estimate import Prediction
from orthonav.ground.check.records import (
    Along,
    BlindStretch,
    Conditions,
    Lookalike,
    Reason,
    Verdict,
    Word,
)
from orthonav.ground.check.trials import Trial
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import along_polyline_en_m

Array = NDArray[np.float64]
SIMILAR = 0.8
MAX_PAIRS = 40
_WRONG_CONFIDENCE = 0.5
"""One wrong trial of this confidence is enough; otherwise a second trial must agree."""


class _Pair(NamedTuple):
    place: tuple[float, float]
    other: tuple[float, float]
    similarity: float
    confident: bool


def found_lookalikes(
    trials: Sequence[Trial], frame: LocalFrame, conditions: Conditions
) -> tuple[Lookalike, ...]:
    """Pairs of places, most similar first; pairs whose ends lie within half a view are merged.

    A misplaced view pairs its true place with where it was placed; a correctly placed view pairs
    it with its best rival, if that scores high enough.
    """
    # Within a quarter of a view it is the same place, only located badly.
    far_m = max(conditions.radius_m, conditions.side_m / 4)
    pairs = [pair for each in trials if (pair := _pair(each, far_m)) is not None]
    pairs.sort(key=lambda pair: -pair.similarity)
    groups: list[list[_Pair]] = []
    for pair in pairs:
        group = next((g for g in groups if _same(g[0], pair, conditions.side_m / 2)), None)
        if group is None:
            groups.append([pair])
        else:
            group.append(pair)
    groups = [group for group in groups if len(group) > 1 or group[0].confident]
    groups.sort(key=lambda group: (-min(len(group), 3), -group[0].similarity))
    return tuple(_lookalike(group, frame, conditions.prior_std_m) for group in groups[:MAX_PAIRS])


def _pair(trial: Trial, far_m: float) -> _Pair | None:
    if not math.isfinite(trial.error_m):
        return None
    if trial.error_m > far_m:
        return _Pair(trial.en_m, trial.found_en_m, 1.0, trial.confidence >= _WRONG_CONFIDENCE)
    if math.isfinite(trial.rival_share) and trial.rival_share >= SIMILAR:
        return _Pair(trial.en_m, trial.rival_en_m, min(trial.rival_share, 1.0), False)
    return None


def _same(one: _Pair, two: _Pair, within_m: float) -> bool:
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


BLIND = 0.5
"""A gap lies below this probability: more likely no fix than a fix."""
POINTS_PER_VIEW = 4.0
"""Points along the route per side of a view, as many as cells."""
MAX_POINTS = 4000
_REACHED = 1e-6
"""A shorter rest of the route, as a fraction of the distance between points, is none."""
ACROSS = 5
NEGLIGIBLE = 1e-9
"""Chances below this no longer change the expected drift."""


def predicted_along(
    area: Area, conditions: Conditions, predict: Callable[[Array], Prediction]
) -> Along:
    """Predictions along the route of an area.

    `predict` takes places (N, 2) and returns a probability of 0 and an error of NaN beyond the map.
    """
    assert area.route is not None
    bands_m = area.route.bands_m(area.band_m) or (area.band_m,)
    line = area.route.points_en_m(area.frame)
    ends_m = np.cumsum(np.hypot(*np.diff(line, axis=0).T))
    length_m = float(ends_m[-1]) if len(ends_m) else 0.0
    step_m = max(conditions.side_m / POINTS_PER_VIEW, length_m / MAX_POINTS)
    points, course_deg = along_polyline_en_m(line, max(step_m, 1e-6))
    distance_m = np.minimum(np.arange(len(points)) * step_m, length_m)
    if length_m - distance_m[-1] > _REACHED * step_m:  # the last waypoint
        points, distance_m = np.vstack([points, line[-1]]), np.append(distance_m, length_m)
        course_deg = np.append(course_deg, np.degrees(np.arctan2(*(line[-1] - points[-2]))) % 360)
    middle = predict(points)
    course = np.radians(course_deg)
    across = np.stack([np.cos(course), -np.sin(course)], axis=1)
    leg = np.minimum(np.searchsorted(ends_m, distance_m), len(bands_m) - 1)
    across *= np.asarray(bands_m, np.float64)[leg, None]
    shares = np.linspace(-0.5, 0.5, ACROSS)
    lowest = np.min([predict(points + share * across).probability for share in shares], axis=0)
    return Along(
        distance_m=distance_m,
        points_en_m=points,
        across_low=np.minimum(lowest, middle.probability),
        drift_m=expected_drift(
            distance_m, middle.probability, middle.error_m, conditions.drift, conditions.side_m
        ),
        **vars(middle),
    )


def expected_drift(
    distance_m: Array, probability: Array, error_m: Array, drift: float, view_side_m: float
) -> Array:
    """Expected position error (N,), root mean square, when fixes arrive as predicted.

    An independent view every `view_side_m` gives a fix with its probability; between fixes the
    error grows by `drift` per metre. The position is known before the first view.
    """
    length_m = float(distance_m[-1])
    stops = np.arange(0.0, length_m + view_side_m, view_side_m)
    chance = np.interp(stops, distance_m, probability)
    error = np.interp(stops, distance_m, np.nan_to_num(error_m, nan=0.0))
    expected = np.zeros(len(stops))
    # Chance that the last fix was k views ago, and the square of the error that has grown since.
    since: Array = np.array([1.0])
    grown: Array = np.array([error[0] ** 2])
    for i in range(len(stops)):
        if i:
            grown = (np.sqrt(grown) + drift * view_side_m) ** 2
        since = np.concatenate([[since.sum() * chance[i]], since * (1 - chance[i])])
        grown = np.concatenate([[error[i] ** 2], grown])
        counts = since > NEGLIGIBLE
        counts[-1] = True
        since, grown = since[counts], grown[counts]
        expected[i] = math.sqrt(float((since * grown).sum() / since.sum()))
    return np.interp(distance_m, stops, expected)


def blind_stretches(along: Along, conditions: Conditions) -> tuple[BlindStretch, ...]:
    """Gaps: stretches of at least one side of a view with a probability below `BLIND`, in order."""
    blind = along.probability < BLIND
    edges = np.flatnonzero(np.diff(np.concatenate([[0], blind.astype(int), [0]])))
    last = len(blind) - 1
    allowed_m = math.inf if conditions.prior_std_m is None else conditions.prior_std_m
    found = []
    for first, end in edges.reshape(-1, 2):
        start_m = float(along.distance_m[first])
        end_m = float(along.distance_m[min(end, last)])
        if end_m - start_m < conditions.side_m:
            continue
        stretch = BlindStretch(
            start_m=start_m,
            end_m=end_m,
            start_s=start_m / conditions.speed_mps,
            end_s=end_m / conditions.speed_mps,
            probability=float(along.probability[first:end].mean()),
            drift_m=conditions.drift * (end_m - start_m),
            allowed_m=allowed_m,
            ends_lost=bool(end > last),
        )
        found.append(stretch)
    return tuple(found)


# Thresholds of a planner's judgement, not of a measurement.
GO_LOW, NO_GO_MEAN = 0.6, 0.2
"""Go from this lower end of the mean probability on, no-go below this mean probability."""
GO_OUTSIDE, NO_GO_OUTSIDE = 0.005, 0.1
"""Fraction of the route outside the map."""
GO_WRONG, NO_GO_WRONG = 0.005, 0.02
"""Fraction of trials that were false fixes."""
MAX_CHANGED = 0.1
"""Fraction of the ground that changed since the map was made, beyond which a route is marginal."""
NARROW_PX = 140.0
"""Views that show fewer pixels of the map across, without a prior, were located far less often than
predicted on two of nine scenes: no go by predictions alone."""
MIN_WRONG = 2
"""A single wrong trial may be chance."""
TOO_FAR = 2.0
"""No-go where a drift is more than so many times the allowed one."""
_ORDER = (Word.NO_GO, Word.MARGINAL, Word.GO)


class Findings(NamedTuple):
    """What the verdict follows from.

    `mean`, `low`: mean probability along the route, or over the map, and the low end of its
    interval.
    `calibrated`: the map carries a confidence model.
    `wrong`: number of false fixes among `trials`.
    `outside`: fraction of the route outside the map; `changed`: of the area since the map was made.
    `allowed_m`: standard deviation of the prior, None without one.
    `predicted_px`: width of a view in pixels of the map, None if tried on a second date.
    """

    along: Along | None
    stretches: tuple[BlindStretch, ...]
    lookalikes: tuple[Lookalike, ...]
    mean: float
    low: float
    calibrated: bool
    wrong: int
    trials: int
    outside: float
    changed: float
    allowed_m: float | None
    predicted_px: float | None


def verdict_of(found: Findings) -> Verdict:
    """The worst of all reasons, worst first."""
    where = "on the map" if found.along is None else "along the route"
    reasons = [*_trust(found), _mean(found, where)]
    if found.along is not None:
        reasons += [*_outside(found.outside), _drift(found.along, found.allowed_m)]
        reasons += _blind(found.stretches)
    if found.allowed_m is None and found.predicted_px and found.predicted_px < NARROW_PX:
        text = f"Views are {found.predicted_px:.0f} map pixels wide and there is no prior: they "
        text += "may be localized far less often than predicted. Fly higher, give a prior, or "
        text += "check with a second date."
        reasons += [Reason("narrow_views", text, Word.MARGINAL)]
    if found.changed > 0:  # a warning: it lowers the probability already
        text = f"At least {100 * found.changed:.1f} % of the ground {where} changed since the map "
        text += "was made: fixes are less likely there; build the map from newer imagery."
        word = Word.MARGINAL if found.changed > MAX_CHANGED else Word.GO
        reasons += [Reason("changed_ground", text, word)]
    near = sum(each.within_prior and each.trials > 1 for each in found.lookalikes)
    if near:
        text = f"Ambiguous places within the prior, with fewer fixes (see the list): {near} pairs."
        reasons += [Reason("lookalikes", text, Word.GO)]
    reasons.sort(key=lambda reason: _ORDER.index(reason.word))
    return Verdict(reasons[0].word, tuple(reasons))


def _trust(found: Findings) -> list[Reason]:
    if not found.calibrated:
        text = "The map states no confidence, so no fix would be accepted. Build it again."
        return [Reason("no_confidence", text, Word.NO_GO)]
    fraction = found.wrong / max(found.trials, 1)
    if found.wrong < MIN_WRONG or fraction < GO_WRONG:
        return []
    text = f"False fixes: {found.wrong} of {found.trials} trial views. Limit: {100 * GO_WRONG:g} %."
    return [Reason("wrong", text, Word.NO_GO if fraction >= NO_GO_WRONG else Word.MARGINAL)]


def _mean(found: Findings, where: str) -> Reason:
    text = f"Mean probability of a confident, correct fix per image {where}: "
    text += f"{100 * found.mean:.0f} % (90 % lower bound {100 * found.low:.0f} %"
    if found.low >= GO_LOW:
        return Reason("fixes", f"{text}).", Word.GO)
    text += f"; GO requires {100 * GO_LOW:.0f} %)."
    return Reason("few_fixes", text, Word.NO_GO if found.mean < NO_GO_MEAN else Word.MARGINAL)


def _word(value: float, go: float, no_go: float) -> Word:
    if value > no_go:
        return Word.NO_GO
    return Word.MARGINAL if value > go else Word.GO


def _outside(fraction: float) -> list[Reason]:
    word = _word(fraction, GO_OUTSIDE, NO_GO_OUTSIDE)
    text = f"{100 * fraction:.0f} % of the route is outside the map. Limit: {100 * GO_OUTSIDE:g} %."
    return [] if word is Word.GO else [Reason("outside_map", text, word)]


def _drift(along: Along, allowed_m: float | None) -> Reason:
    worst = int(np.argmax(along.drift_m))
    drift_m, word = float(along.drift_m[worst]), Word.GO
    text = f"Largest predicted position error (1 sigma): {drift_m:.0f} m, "
    text += f"at km {along.distance_m[worst] / 1000:.1f}."
    if allowed_m is not None:
        text += f" Limit: {allowed_m:.0f} m (--prior-std-m)."
        word = _word(drift_m, allowed_m, TOO_FAR * allowed_m)
    return Reason("drift", text, word)


def _blind(stretches: tuple[BlindStretch, ...]) -> list[Reason]:
    if not stretches:
        return []
    longest = max(stretches, key=lambda each: each.length_m)
    hard = [each for each in stretches if not each.recoverable]
    word, end = Word.GO, "dead reckoning bridges them"
    if hard:
        worst = max(hard, key=lambda each: each.drift_m)
        word = Word.NO_GO if worst.drift_m > TOO_FAR * worst.allowed_m else Word.MARGINAL
        end = f"dead reckoning drifts by {worst.drift_m:.0f} m (limit {worst.allowed_m:.0f} m)"
        if worst.ends_lost and word is Word.MARGINAL:
            end = "the route ends in a gap"
    text = f"Gaps without fixes: {len(stretches)}, the longest {longest.length_m:.0f} m "
    text += f"({longest.end_s - longest.start_s:.0f} s), from km {longest.start_m / 1000:.1f}"
    return [Reason("blind", f"{text}; {end}.", word)]
