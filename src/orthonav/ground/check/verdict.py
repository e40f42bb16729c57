"""Go, marginal or no-go, and why. The rules are documented in docs/check.md."""

import numpy as np

from orthonav.ground.check.outcome import (
    Along,
    BlindStretch,
    Lookalike,
    Reason,
    Verdict,
    Word,
)

# Thresholds of a planner's judgement, not of a measurement; docs/check.md lists them.
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
predicted on two of nine scenes (docs/check.md): no go by predictions alone."""
MIN_WRONG = 2
"""A single wrong trial may be chance."""
TOO_FAR = 2.0
"""No-go where a drift is more than so many times the allowed one."""
_ORDER = (Word.NO_GO, Word.MARGINAL, Word.GO)


def verdict_of(
    along: Along | None,
    stretches: tuple[BlindStretch, ...],
    lookalikes: tuple[Lookalike, ...],
    *,
    mean: float,
    low: float,
    calibrated: bool,
    wrong: int,
    trials: int,
    outside: float,
    changed: float,
    allowed_m: float | None,
    predicted_px: float | None,
) -> Verdict:
    """The worst of all reasons, worst first.

    `mean`, `low`: mean probability along the route, or over the map, and the lower end of its 80 %
    interval. `calibrated`: the map carries a confidence model. `wrong`, `trials`: number of false
    fixes among the trials, and of trials. `outside`: fraction of the route outside the map.
    `changed`: fraction of the checked area that changed since the map was made. `allowed_m`:
    standard deviation of the prior, None without one. `predicted_px`: width of a view in pixels of
    the map, None where it was tried on imagery of a second date.
    """
    where = "on the map" if along is None else "along the route"
    reasons = [*_trust(calibrated, wrong, trials), _mean(mean, low, where)]
    if along is not None:
        reasons += [*_outside(outside), _drift(along, allowed_m), *_blind(stretches)]
    if allowed_m is None and predicted_px is not None:
        reasons += _narrow(predicted_px)
    reasons += [*_changed(changed, where), *_lookalikes(lookalikes)]
    reasons.sort(key=lambda reason: _ORDER.index(reason.word))
    return Verdict(reasons[0].word, tuple(reasons))


def _trust(calibrated: bool, wrong: int, trials: int) -> list[Reason]:
    if not calibrated:
        text = "The map states no confidence, so no fix would be accepted. Build it again."
        return [Reason("no_confidence", text, Word.NO_GO)]
    fraction = wrong / max(trials, 1)
    if wrong < MIN_WRONG or fraction < GO_WRONG:
        return []
    text = f"False fixes: {wrong} of {trials} trial views. Limit: {100 * GO_WRONG:g} %."
    return [Reason("wrong", text, Word.NO_GO if fraction >= NO_GO_WRONG else Word.MARGINAL)]


def _mean(mean: float, low: float, where: str) -> Reason:
    text = f"Mean probability of a confident, correct fix per image {where}: {100 * mean:.0f} % "
    text += f"(90 % lower bound {100 * low:.0f} %"
    if low >= GO_LOW:
        return Reason("fixes", f"{text}).", Word.GO)
    text += f"; GO requires {100 * GO_LOW:.0f} %)."
    return Reason("few_fixes", text, Word.NO_GO if mean < NO_GO_MEAN else Word.MARGINAL)


def _narrow(view_px: float) -> list[Reason]:
    if view_px >= NARROW_PX:
        return []
    text = f"Views are {view_px:.0f} map pixels wide and there is no prior: they may be localized "
    text += "far less often than predicted. Fly higher, give a prior, or check with a second date."
    return [Reason("narrow_views", text, Word.MARGINAL)]


def _outside(fraction: float) -> list[Reason]:
    if fraction <= GO_OUTSIDE:
        return []
    word = Word.NO_GO if fraction > NO_GO_OUTSIDE else Word.MARGINAL
    text = f"{100 * fraction:.0f} % of the route is outside the map. Limit: {100 * GO_OUTSIDE:g} %."
    return [Reason("outside_map", text, word)]


def _changed(fraction: float, where: str) -> list[Reason]:
    """A warning: what changed lowers the probability, from which the verdict follows."""
    if fraction <= 0:
        return []
    text = f"At least {100 * fraction:.1f} % of the ground {where} changed since the map was made: "
    text += "fixes are less likely there; build the map from newer imagery."
    return [Reason("changed_ground", text, Word.MARGINAL if fraction > MAX_CHANGED else Word.GO)]


def _drift(along: Along, allowed_m: float | None) -> Reason:
    worst = int(np.argmax(along.drift_m))
    drift_m = float(along.drift_m[worst])
    text = f"Largest predicted position error (1 sigma): {drift_m:.0f} m, "
    text += f"at km {along.distance_m[worst] / 1000:.1f}."
    if allowed_m is None:
        return Reason("drift", text, Word.GO)
    text += f" Limit: {allowed_m:.0f} m (--prior-std-m)."
    if drift_m <= allowed_m:
        return Reason("drift", text, Word.GO)
    return Reason("drift", text, Word.NO_GO if drift_m > TOO_FAR * allowed_m else Word.MARGINAL)


def _blind(stretches: tuple[BlindStretch, ...]) -> list[Reason]:
    if not stretches:
        return []
    longest = max(stretches, key=lambda each: each.length_m)
    gaps = "One gap" if len(stretches) == 1 else f"{len(stretches)} gaps, the longest"
    text = f"{gaps} of {longest.length_m:.0f} m without fixes "
    text += f"({longest.end_s - longest.start_s:.0f} s), from km {longest.start_m / 1000:.1f}"
    hard = [each for each in stretches if not each.recoverable]
    if not hard:
        return [Reason("blind", f"{text}; dead reckoning bridges it.", Word.GO)]
    worst = max(hard, key=lambda each: each.drift_m)
    if worst.drift_m > TOO_FAR * worst.allowed_m:
        end = f"dead reckoning drifts by {worst.drift_m:.0f} m in {worst.length_m:.0f} m"
        end += f" (limit {worst.allowed_m:.0f} m)"
        return [Reason("blind", f"{text}; {end}.", Word.NO_GO)]
    end = f"dead reckoning drifts by {worst.drift_m:.0f} m (limit {worst.allowed_m:.0f} m)"
    end = "the route ends in a gap" if worst.ends_lost else end
    return [Reason("blind", f"{text}; {end}.", Word.MARGINAL)]


def _lookalikes(lookalikes: tuple[Lookalike, ...]) -> list[Reason]:
    near = [each for each in lookalikes if each.within_prior and each.trials > 1]
    if not near:
        return []
    pairs = f"{len(near)} pairs" if len(near) > 1 else "One pair"
    text = f"{pairs} of ambiguous places within the prior: fewer fixes there (see the list)."
    return [Reason("lookalikes", text, Word.GO)]
