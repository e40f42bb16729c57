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
"""Share of the route outside the map."""
GO_WRONG, NO_GO_WRONG = 0.005, 0.02
"""Share of trials that were confident and wrong."""
MAX_CHANGED = 0.1
"""Share of the ground that changed since the map was made, beyond which a route is marginal."""
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
    interval. `calibrated`: the map carries a confidence model. `wrong`, `trials`: number of
    confident and wrong trials, and of all. `outside`: share of the route outside the map, 0 to 1.
    `changed`: share of the checked area that changed since the map was made, 0 to 1. `allowed_m`:
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
    share = wrong / max(trials, 1)
    if wrong < MIN_WRONG or share < GO_WRONG:
        return []
    text = f"{wrong} of {trials} trial views had a confident fix in a wrong place."
    return [Reason("wrong", text, Word.NO_GO if share >= NO_GO_WRONG else Word.MARGINAL)]


def _mean(mean: float, low: float, where: str) -> Reason:
    fine = low >= GO_LOW
    text = f"One view has {'' if fine else 'only '}{_article(mean)} {100 * mean:.0f} % "
    text += f"chance of a confident, correct fix {where} (mean), "
    text += f"at least {100 * low:.0f} % on nine of ten scenes."
    if fine:
        return Reason("fixes", text, Word.GO)
    return Reason("few_fixes", text, Word.NO_GO if mean < NO_GO_MEAN else Word.MARGINAL)


def _narrow(view_px: float) -> list[Reason]:
    if view_px >= NARROW_PX:
        return []
    text = f"Views {view_px:.0f} pixels of the map wide, without a prior, may be located far less "
    text += "often than predicted: fly higher, state a prior, or check with a second date."
    return [Reason("narrow_views", text, Word.MARGINAL)]


def _article(share: float) -> str:
    """The article before a spoken percentage: an 8, an 11, an 18, an 80 to 89."""
    spoken = f"{100 * share:.0f}"
    return "an" if spoken in ("11", "18") or spoken.startswith("8") else "a"


def _outside(share: float) -> list[Reason]:
    if share <= GO_OUTSIDE:
        return []
    word = Word.NO_GO if share > NO_GO_OUTSIDE else Word.MARGINAL
    return [Reason("outside_map", f"{100 * share:.0f} % of the route is outside the map.", word)]


def _changed(share: float, where: str) -> list[Reason]:
    """A warning: what changed lowers the probability, from which the verdict follows."""
    if share <= 0:
        return []
    text = f"At least {100 * share:.1f} % of the ground {where} changed since the map was made: "
    text += "fixes are rarer there; build the map from newer imagery."
    return [Reason("changed_ground", text, Word.MARGINAL if share > MAX_CHANGED else Word.GO)]


def _drift(along: Along, allowed_m: float | None) -> Reason:
    worst = int(np.argmax(along.drift_m))
    drift_m = float(along.drift_m[worst])
    text = f"The largest expected position error is {drift_m:.0f} m"
    text += f" (at {along.distance_m[worst] / 1000:.1f} km)"
    if allowed_m is None:
        return Reason("drift", f"{text}.", Word.GO)
    text += f"; {allowed_m:.0f} m are allowed."
    if drift_m <= allowed_m:
        return Reason("drift", text, Word.GO)
    return Reason("drift", text, Word.NO_GO if drift_m > TOO_FAR * allowed_m else Word.MARGINAL)


def _blind(stretches: tuple[BlindStretch, ...]) -> list[Reason]:
    if not stretches:
        return []
    longest = max(stretches, key=lambda each: each.length_m)
    which = f"{len(stretches)} blind stretches, the longest of"
    text = f"{'One blind stretch of' if len(stretches) == 1 else which} {longest.length_m:.0f} m "
    text += (
        f"({longest.end_s - longest.start_s:.0f} s), starting at {longest.start_m / 1000:.1f} km"
    )
    hard = [each for each in stretches if not each.recoverable]
    if not hard:
        return [Reason("blind", f"{text}; dead reckoning bridges it.", Word.GO)]
    worst = max(hard, key=lambda each: each.drift_m)
    if worst.drift_m > TOO_FAR * worst.allowed_m:
        end = f"dead reckoning may be off by {worst.drift_m:.0f} m after {worst.length_m:.0f} m"
        return [Reason("blind", f"{text}; {end}.", Word.NO_GO)]
    end = f"dead reckoning drifts by {worst.drift_m:.0f} m"
    end = "the route ends in one" if worst.ends_lost else end
    return [Reason("blind", f"{text}; {end}.", Word.MARGINAL)]


def _lookalikes(lookalikes: tuple[Lookalike, ...]) -> list[Reason]:
    near = [each for each in lookalikes if each.within_prior and each.trials > 1]
    if not near:
        return []
    pairs = f"{len(near)} pairs" if len(near) > 1 else "One pair"
    text = f"{pairs} of places within the prior look alike: a single view may confuse them, which "
    return [Reason("lookalikes", f"{text}costs fixes (see the list).", Word.GO)]
