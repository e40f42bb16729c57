"""What predictions say: a route with its outages, the verdict.

docs/check.md lists the rules of the verdict.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.ground.check.estimate import Prediction
from orthonav.ground.check.records import (
    MIN_RISK,
    OBJECT_M,
    Along,
    Conditions,
    Flights,
    Outage,
    Range,
    Reason,
    Verdict,
    Word,
)
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import along_polyline_en_m
from orthonav.ground.report import metres_text, percent_text, probability_text, seconds_text

Array = NDArray[np.float64]


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
    step_m = max(conditions.side_m / 4, length_m / 4000, 1e-6)  # as many points as cells
    points, course_deg = along_polyline_en_m(line, step_m)
    distance_m = np.minimum(np.arange(len(points)) * step_m, length_m)
    if length_m - distance_m[-1] > 1e-6 * step_m:  # the last waypoint
        points, distance_m = np.vstack([points, line[-1]]), np.append(distance_m, length_m)
        course_deg = np.append(course_deg, np.degrees(np.arctan2(*(line[-1] - points[-2]))) % 360)
    middle = predict(points)
    course = np.radians(course_deg)
    across = np.stack([np.cos(course), -np.sin(course)], axis=1)
    leg = np.minimum(np.searchsorted(ends_m, distance_m), len(bands_m) - 1)
    across *= np.asarray(bands_m, np.float64)[leg, None]
    shares = np.linspace(-0.5, 0.5, 5)
    lowest = np.min([predict(points + share * across).probability for share in shares], axis=0)
    return Along(
        distance_m=distance_m,
        points_en_m=points,
        across_low=np.minimum(lowest, middle.probability),
        **vars(middle),
    )


def likely_outages(along: Along, flights: Flights, conditions: Conditions) -> tuple[Outage, ...]:
    """Stretches of at least half a side of a view where most flights have no available position."""
    available = flights.available
    out = np.concatenate([[False], available < 0.5, [False]]).astype(int)
    last = len(available) - 1
    found = []
    for first, end in np.flatnonzero(np.diff(out)).reshape(-1, 2):
        start_m, end_m = (float(along.distance_m[min(i, last)]) for i in (first, end))
        if end_m - start_m < conditions.side_m / 2:
            continue
        found.append(
            Outage(
                start_m=start_m,
                end_m=end_m,
                start_s=start_m / conditions.speed_mps,
                end_s=end_m / conditions.speed_mps,
                probability=float(along.probability[first:end].mean()),
                available=float(available[first:end].mean()),
            )
        )
    return tuple(found)


@dataclass(frozen=True)
class Threshold:
    """GO up to `go`, NO-GO beyond `no_go`, both at the cautious end of the interval.

    Where more is better `go` is the larger one.
    """

    go: float
    no_go: float

    def word(self, figure: Range) -> Word:
        more = self.go > self.no_go
        cautious, sign = (figure.low, 1) if more else (figure.high, -1)
        if sign * (cautious - self.no_go) < 0:
            return Word.NO_GO
        return Word.GO if sign * (cautious - self.go) >= 0 else Word.MARGINAL

    def text(self, as_text: Callable[[float], str]) -> str:
        more = self.go > self.no_go
        good, bad, end = ("from", "below", "lower") if more else ("up to", "above", "upper")
        go, no_go = as_text(self.go), as_text(self.no_go)
        return f"; GO {good} {go}, NO-GO {bad} {no_go}, at the {end} end"


@dataclass(frozen=True)
class Rules:
    """Thresholds of the verdict: a planner's judgement, not a measurement."""

    fixes: Threshold = Threshold(0.6, 0.2)  # mean chance of a fix per view
    availability: Threshold = Threshold(0.8, 0.5)
    """Fraction of the route with a protection level within the alert limit."""
    outage_s: Threshold = Threshold(60.0, 600.0)  # longest outage
    false_fix: Threshold = Threshold(0.01, 0.1)  # probability of a false fix on the route
    wrong: Threshold = Threshold(0.005, 0.02)
    """Fraction of trials that were false fixes, without a route; at least `min_wrong`."""
    min_wrong: int = 2
    outside: Threshold = Threshold(0.005, 0.1)  # fraction of the route outside the map
    max_uncertain: float = 0.5
    """Width of the interval of the mean chance beyond which the map alone cannot tell."""
    narrow_px: float = 140.0
    """Views narrower than this (root of their area), searched for more widely than in a prior of
    `wide_prior_px` (standard deviation): a second date has to show that they are found
    (docs/check.md)."""
    wide_prior_px: float = 100.0
    many_places: float = 0.1  # fraction of the places from which houses and trees count
    displaced: float = 0.03
    """Displacement of houses and trees, a fraction of a view, from which it is named: a view is
    registered at about as many pixels from any height. At 4 % (from 120 m, 65 deg wide) a surface
    made positions over ten times as accurate (docs/benchmarks.md); 3 % is 155 m, and 470 m 30 deg
    ahead."""
    narrow_m: float = 110.0
    """Narrower views (root of their area) were confident over generated towns as often as the
    finding says: at 45 deg less often than GO asks for (docs/benchmarks.md)."""
    oblique_deg: float = 15.0


RULES = Rules()


class Findings(NamedTuple):
    """What the verdict follows from.

    `mean`: chance of a fix along the route, or over the map; `flights`: along the route.
    `calibrated`: the map carries a confidence model.
    `wrong`: number of false fixes among `trials`.
    `outside`: fraction of the route outside the map.
    `after_fix_m`: protection level right after a fix, over the cells or points of the route.
    `view_px`: root of the area of a view in pixels of the map; `prior_px`: standard deviation of
    the prior position, infinite without one; `second_date`: tried on one.
    `objects`: fraction of the places whose view shows many houses and trees, as the map knows;
    `unknown`: where the map does not know, 1 without a surface.
    """

    mean: Range
    flights: Flights | None
    conditions: Conditions
    calibrated: bool
    wrong: int
    trials: int
    outside: float
    after_fix_m: Range
    view_px: float
    prior_px: float
    second_date: bool
    objects: float = 0.0
    unknown: float = 0.0


def verdict_of(found: Findings) -> Verdict:
    """The worst of all reasons, worst first."""
    where = "on the map" if found.flights is None else "along the route"
    reasons = [*_trust(found), _mean(found.mean, where), *_available(found)]
    if found.flights is not None:
        reasons += [*_outside(found.outside), _false_fix(found.flights, found.conditions)]
    why = uncertainty(found.mean, found.view_px, found.prior_px)
    if why and not found.second_date:
        text = f"The map alone cannot tell how often views of {found.view_px:.0f} map pixels are "
        text += f"localized: {why}. A second date (--other-date) would help."
        reasons += [Reason("uncertain", text, Word.MARGINAL)]
    reasons += [_objects(found), *_camera(found.conditions)]
    reasons.sort(key=lambda reason: -reason.word.exit_code)
    return Verdict(reasons[0].word, tuple(reasons))


def uncertainty(mean: Range, view_px: float, prior_px: float) -> str:
    """Why the map alone does not support a GO; empty where it does."""
    if mean.high - mean.low > RULES.max_uncertain:
        return "the interval is too wide"
    if view_px < RULES.narrow_px and prior_px > RULES.wide_prior_px:
        return f"they are narrow, and no prior is within {RULES.wide_prior_px:.0f} pixels"
    return ""


def _exact(value: float) -> Range:
    return Range(value, value, value)


def interval_text(figure: Range, as_text: Callable[[float], str]) -> str:
    return f"({as_text(figure.low)} to {as_text(figure.high)})"


def range_text(figure: Range, as_text: Callable[[float], str]) -> str:
    """Median and interval, as `62 % (41 % to 78 %)`."""
    return f"{as_text(figure.median)} {interval_text(figure, as_text)}"


def _objects(found: Findings) -> Reason:
    """What the map knows of houses and trees, and what that means for these views."""
    conditions, unknown = found.conditions, found.unknown
    code, text = "surface", "The map has no surface here: it does not know houses and trees."
    if unknown < 1:
        text = "The map knows houses and trees (its surface), which cover a tenth of a view or "
        text += f"more at {percent_text(found.objects)} of the places"
        text += f"; it does not know them at {percent_text(unknown)}." if unknown > 0 else "."
    if conditions.relief_m == 0:  # said to be none
        unknown = 0.0
    share = conditions.displaced_share
    if unknown > RULES.many_places and share > RULES.displaced:
        code = "no_surface"
        text += f" One of {OBJECT_M:g} m is displaced by up to {percent_text(share)} of a view, "
        text += "and positions among them are less accurate: build the map with --surface "
        text += "(docs/terrain.md)."
    if conditions.side_m < RULES.narrow_m and found.objects + unknown > RULES.many_places:
        code, towns = "houses", ("92, 83 and 83 %", "")
        if conditions.camera_pitch_deg >= RULES.oblique_deg:
            towns = ("92, 67 and 50 %", ", 45 deg ahead")
        text += f" Views are narrower than {RULES.narrow_m:g} m: over generated towns, with a "
        text += f"surface, {towns[0]} of views 132, 88 and 55 m wide were confident{towns[1]} "
        text += "(docs/benchmarks.md); among houses the prediction may be too high."
    return Reason(code, text, Word.MARGINAL if code == "houses" else Word.GO)


def _camera(conditions: Conditions) -> list[Reason]:
    """What trial views do not show of the camera."""
    reasons, ahead_deg = [], conditions.camera_pitch_deg
    if ahead_deg >= RULES.oblique_deg:
        text = f"Trial views look straight down, this camera looks {ahead_deg:g} deg ahead: how "
        text += "often its views are localized is not predicted; try simulate --camera-pitch-deg."
        reasons.append(Reason("oblique", text, Word.MARGINAL))
    if conditions.camera_kind == "thermal":
        text = "No flight with a thermal camera over a map was seen: the prediction rests on "
        text += "rendered views."
        reasons.append(Reason("thermal", text, Word.MARGINAL))
    return reasons


def _trust(found: Findings) -> list[Reason]:
    if not found.calibrated:
        text = "The map states no confidence, so no fix would be accepted. Build it again."
        return [Reason("no_confidence", text, Word.NO_GO)]
    if found.flights is not None:
        return []
    fraction = found.wrong / max(found.trials, 1)
    word = RULES.wrong.word(_exact(fraction))
    if word is Word.GO or found.wrong < RULES.min_wrong:
        return []
    text = f"Confident fixes beyond {metres_text(found.conditions.radius_m)}: {found.wrong} of "
    text += f"{found.trials} trial views. {_limits(RULES.wrong)}"
    return [Reason("wrong", text, word)]


def _limits(threshold: Threshold) -> str:
    return f"Limits: {100 * threshold.go:g} %, NO-GO above {100 * threshold.no_go:g} %."


def _mean(mean: Range, where: str) -> Reason:
    word = RULES.fixes.word(mean)
    text = f"Mean probability of a confident, correct fix per view {where}: "
    text += range_text(mean, probability_text) + RULES.fixes.text(probability_text)
    return Reason("fixes" if word is Word.GO else "few_fixes", f"{text}.", word)


def _outside(fraction: float) -> list[Reason]:
    word = RULES.outside.word(_exact(fraction))
    text = f"{percent_text(fraction)} of the route is outside the map. {_limits(RULES.outside)}"
    return [] if word is Word.GO else [Reason("outside_map", text, word)]


def _available(found: Findings) -> list[Reason]:
    """Positions with a protection level within the alert limit."""
    conditions, after_m, flights = found.conditions, found.after_fix_m, found.flights
    if not conditions.states_level:
        text = f"At a risk of {conditions.risk:g} too few positions have a protection level: the "
        text += "probability that their place is wrong is often higher. Availability is predicted "
        return [Reason("risk", f"{text}for risks from {MIN_RISK:g} on.", Word.MARGINAL)]
    limit_m, limit = conditions.alert_limit_m, conditions.limit_text
    level = "unknown: no trial view was localized"
    if math.isfinite(after_m.median):
        level = range_text(after_m, metres_text)
    if flights is None:
        text = f"Protection level right after a fix: {level}; alert limit: {limit}: GO within it "
        text += "at the upper end, NO-GO beyond it at the lower end, of places of the map."
        word = Word.GO if after_m.high <= limit_m else Word.MARGINAL
        return [Reason("availability", text, Word.NO_GO if after_m.low > limit_m else word)]
    text = f"Availability, the fraction of the route with a protection level within {limit}: "
    text += range_text(flights.availability, probability_text)
    text += RULES.availability.text(probability_text)
    word = RULES.availability.word(flights.availability)
    if word is not Word.GO and after_m.median > limit_m:
        text += f". Protection level right after a fix: {level}"
    reasons = [Reason("availability", f"{text}.", word)]
    text = f"Longest outage: {range_text(flights.outage_s, seconds_text)}, "
    text += f"{range_text(flights.outage_m, metres_text)}{RULES.outage_s.text(seconds_text)}."
    return [*reasons, Reason("outage", text, RULES.outage_s.word(flights.outage_s))]


def _false_fix(flights: Flights, conditions: Conditions) -> Reason:
    figure, limits = flights.false_fix, RULES.false_fix.text(percent_text)
    text = f"Probability of a confident fix beyond {metres_text(conditions.radius_m)} on this "
    text += f"route: {range_text(figure, percent_text)}{limits}."
    return Reason("wrong", text, RULES.false_fix.word(figure))
