"""What a view may be: the best place it was registered at and those beside it, with their odds."""

import math

from orthonav.confidence.registered import RegisteredConfidence
from orthonav.register.refine import Placed
from orthonav.register.registrar import Registered, apart_px

WORTH_LOG_ODDS = -12.0


def places_of(
    found: Registered, confidence: RegisteredConfidence, near_px: float, looked_at: float
) -> list[tuple[float, float, Placed]]:
    """Places with their log odds, and how likely each is by the view alone: the best, and those
    that were finished beside it and are farther than `near_px` from it.

    Where only a share of the map was `looked_at`, few rivals were found and chance is lower:
    the odds are those of somebody who knows only that it is there, or, if that is less, of
    somebody who looked everywhere and found elsewhere what chance makes.
    """
    best, chances = found.evidence(), confidence.chances
    least = {"rival": chances.total, "look_rival": chances.look, "fine_rival": chances.fine}
    out: list[tuple[float, float, Placed]] = []
    for score, placed in ((found.score, found.placed), *found.finalists):
        if any(apart_px(placed, other) < near_px for *_, other in out):
            continue
        evidence = dict(best)
        if out:
            share = score / max(found.score, 1e-6)
            evidence = {
                "strength": score,
                "rival": found.score,
                "look": found.look_score * share,
                "look_rival": found.look_score,
            }
        there = _log_odds(confidence(evidence)) + math.log(looked_at)
        for name in least.keys() & evidence.keys():
            evidence[name] = max(evidence[name], least[name])
        alone = confidence(evidence)
        log_odds = min(there, _log_odds(alone))
        if not out or log_odds > WORTH_LOG_ODDS:
            out.append((log_odds, alone, placed))
    return out


def _log_odds(confidence: float) -> float:
    inside = min(max(confidence, 1e-12), 1 - 1e-12)
    return math.log(inside / (1 - inside))
