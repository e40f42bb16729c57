"""Go, marginal or no-go, and why. The rules are those of docs/check.md."""

from dataclasses import dataclass

import numpy as np

from orthonav.check.outcome import (
    Along,
    Conditions,
    Lookalike,
    Reason,
    Stretch,
    Verdict,
    Word,
)

GO_MEAN, NO_GO_MEAN = 0.6, 0.2
"""Mean probability of a fix: as good as this is fine, worse than that is not."""
MOST_OUTSIDE = 0.1
"""Share of a route that may lie beyond the map, at most."""
MARGINAL_WRONG, NO_GO_WRONG = 0.005, 0.02
"""Share of trials that were confident and wrong."""
TWICE = 2.0
LEAST_WRONG = 2
"""One wrong trial alone is no rule."""
_ORDER = (Word.NO_GO, Word.MARGINAL, Word.GO)


@dataclass(frozen=True)
class Findings:
    """What the verdict is made of. `mean` probability of the route, or of the map without one."""

    conditions: Conditions
    mean: float
    calibrated: bool
    wrong: int
    trials: int
    outside: float
    along: Along | None
    stretches: tuple[Stretch, ...]
    lookalikes: tuple[Lookalike, ...]


def verdict_of(found: Findings) -> Verdict:
    """The worst of all reasons, worst first."""
    reasons = [*_trust(found), *_mean(found), *_route(found), *_alike(found)]
    reasons.sort(key=lambda reason: _ORDER.index(reason.word))
    return Verdict(reasons[0].word, tuple(reasons))


def _trust(found: Findings) -> list[Reason]:
    if not found.calibrated:
        text = "the map carries no confidence of its own (too little could be learnt from it when "
        text += "it was built), so that no fix would be believed"
        return [Reason("no_confidence", text, Word.NO_GO)]
    share = found.wrong / max(found.trials, 1)
    if found.wrong < LEAST_WRONG or share < MARGINAL_WRONG:
        return []
    word = Word.NO_GO if share >= NO_GO_WRONG else Word.MARGINAL
    text = f"{found.wrong} of {found.trials} trial views were put in a wrong place with confidence"
    return [Reason("wrong", text, word)]


def _mean(found: Findings) -> list[Reason]:
    where = "along the route" if found.along is not None else "on the map"
    if found.mean >= GO_MEAN:
        text = f"a single view gives a correct, confident fix with {found.mean:.0%} {where}"
        return [Reason("fixes", text, Word.GO)]
    text = f"a single view gives a correct, confident fix with only {found.mean:.0%} {where}"
    word = Word.NO_GO if found.mean < NO_GO_MEAN else Word.MARGINAL
    return [Reason("few_fixes", text, word)]


def _route(found: Findings) -> list[Reason]:
    if found.along is None:
        return []
    reasons = []
    if found.outside > 0.005:
        word = Word.NO_GO if found.outside > MOST_OUTSIDE else Word.MARGINAL
        reasons.append(
            Reason("outside_map", f"{found.outside:.0%} of the route lies beyond the map", word)
        )
    return reasons + _drift(found, found.along) + _blind(found.stretches)


def _drift(found: Findings, along: Along) -> list[Reason]:
    allowed_m = found.conditions.prior_std_m
    worst = int(np.argmax(along.drift_m))
    drift_m = float(along.drift_m[worst])
    text = f"the position is expected to be off by {drift_m:.0f} m at most "
    text += f"(at {along.distance_m[worst] / 1000:.1f} km)"
    if allowed_m is None:
        return [Reason("drift", text, Word.GO)]
    text += f", {allowed_m:.0f} m are allowed"
    if drift_m <= allowed_m:
        return [Reason("drift", text, Word.GO)]
    word = Word.NO_GO if drift_m > TWICE * allowed_m else Word.MARGINAL
    return [Reason("drift", text, word)]


def _blind(stretches: tuple[Stretch, ...]) -> list[Reason]:
    hard = [each for each in stretches if not each.bearable]
    if not stretches:
        return []
    longest = max(stretches, key=lambda each: each.length_m)
    text = f"{len(stretches)} blind stretches, the longest {longest.length_m:.0f} m "
    text += f"({longest.end_s - longest.start_s:.0f} s) from {longest.start_m / 1000:.1f} km on"
    if len(stretches) == 1:
        text = text.replace("1 blind stretches, the longest", "one blind stretch of")
    if not hard:
        return [Reason("blind", f"{text}: dead reckoning bridges it", Word.GO)]
    worst = max(hard, key=lambda each: each.drift_m)
    if worst.drift_m > TWICE * worst.allowed_m:
        end = f"dead reckoning may be off by {worst.drift_m:.0f} m after {worst.length_m:.0f} m"
        return [Reason("blind", f"{text}; {end}", Word.NO_GO)]
    end = (
        "the route ends in one"
        if worst.ends_lost
        else f"dead reckoning drifts {worst.drift_m:.0f} m"
    )
    return [Reason("blind", f"{text}; {end}", Word.MARGINAL)]


def _alike(found: Findings) -> list[Reason]:
    near = [each for each in found.lookalikes if each.within_prior and each.trials > 1]
    if not near:
        return []
    pairs = f"{len(near)} pairs" if len(near) > 1 else "one pair"
    text = f"{pairs} of places within the prior look alike: one view may not tell them "
    return [Reason("lookalikes", f"{text}apart (they cost fixes, see the list)", Word.GO)]
