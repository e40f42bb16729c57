"""The places where a registered view may have been taken, with their odds."""

import math

from orthonav.core.localize.logistic import logit
from orthonav.core.localize.registered import RegisteredConfidence
from orthonav.core.register.refine import Placed
from orthonav.core.register.registrar import Registered, apart_px

WORTH_LOG_ODDS = -12.0
"""Less likely places are left out."""
LEAST = 1e-12
"""Least and greatest (1 - LEAST) probability of a place, for finite odds."""


def places_of(
    found: Registered, confidence: RegisteredConfidence, near_px: float, searched_share: float
) -> list[tuple[float, float, Placed]]:
    """Log odds, probability by the view alone, and place: of the best place and of the other
    finished ones that are farther than `near_px` from it.

    A search of only a share of the map finds fewer rivals, and chance is lower: the log odds are
    those within the area searched times `searched_share`, or, if less, those of a search of the
    whole map whose rivals are what chance makes (docs/decisions/tracking.md).
    """
    best, chances = found.evidence(), confidence.chances
    least = {
        "rival": chances.of_strength(best),
        "look_rival": chances.look,
        "fine_rival": chances.fine,
    }
    out: list[tuple[float, float, Placed]] = []
    for score, placed in ((found.score, found.placed), *found.finalists):
        if any(apart_px(placed, other) < near_px for *_, other in out):
            continue
        evidence = dict(best)
        if out:
            share = score / max(found.score, 1e-6)
            evidence |= {
                "strength": score,
                "rival": found.score,
                "look": found.look_score * share,
                "look_rival": found.look_score,
                "fine": math.nan,
                "fine_rival": math.nan,
            }
        there = logit(confidence(evidence), LEAST) + math.log(searched_share)
        for name, value in least.items():
            if not math.isnan(evidence[name]):
                evidence[name] = max(evidence[name], value)
        alone = confidence(evidence)
        log_odds = min(there, logit(alone, LEAST))
        if out:  # the best place may have won in detail, against stronger scores elsewhere
            log_odds, alone = min(log_odds, out[0][0]), min(alone, out[0][1])
        if not out or log_odds > WORTH_LOG_ODDS:
            out.append((log_odds, alone, placed))
    return out
