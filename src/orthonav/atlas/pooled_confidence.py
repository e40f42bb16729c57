"""The confidence of a map cut from several sheets: pooled from theirs, not learnt again.

Where on the cut map a view was taken is not known, so the confidence of a fix is the mean of the
sheets' confidences, weighted by their shares of the map. A logistic regression cannot represent
that mean exactly. The pooled one has the mean weights, and a bias so low that it nowhere exceeds
the mean in the range of evidence that decides.
"""

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from orthonav.confidence.logistic import LogisticConfidence
from orthonav.confidence.registered import (
    CHANCES,
    Chances,
    RegisteredConfidence,
)

DECIDING = 0.5, 0.99
"""Thresholds of acceptance lie in this range of probabilities."""
SCORES = np.linspace(0.05, 1.0, 20)
MARGINS = np.linspace(0.0, 0.6, 13)
"""Evidence at which the pooled confidence is compared with the sheets': scores and margins of
tiles."""
Evidence = Mapping[str, float]


def pooled_tiles(
    confidences: Sequence[LogisticConfidence], shares: Sequence[float], more_tiles: float
) -> LogisticConfidence | None:
    """Confidence of tile search on a map made of sheets in these shares; None without sheets.

    `more_tiles`: tiles of the map over tiles of a sheet. As many times more tiles resemble a view
    by chance, and the odds of the best tile are lower by that factor.
    """
    if not confidences:
        return None
    evidence = [{"score": s, "margin": m} for s, m in itertools.product(SCORES, MARGINS) if m <= s]
    mean = LogisticConfidence(*_mean(confidences, shares))
    bias = mean.bias - _excess(mean, confidences, shares, evidence)
    return LogisticConfidence(bias - math.log(max(more_tiles, 1.0)), mean.weights)


def pooled_registered(confidences: Sequence[RegisteredConfidence]) -> RegisteredConfidence | None:
    """Confidence of registered views on a map made of sheets; None without sheets.

    It is the usual one, with the scores of chance of the sheet where they are highest.
    """
    if not confidences:
        return None
    chances = Chances(
        **{name: max(getattr(each.chances, name) for each in confidences) for name in CHANCES}
    )
    return RegisteredConfidence.usual(chances)


def _mean(
    confidences: Sequence[LogisticConfidence], shares: Sequence[float]
) -> tuple[float, tuple[float, ...]]:
    bias = np.average([each.bias for each in confidences], weights=shares)
    weights = np.average([each.weights for each in confidences], axis=0, weights=shares)
    return float(bias), tuple(float(weight) for weight in weights)


def _excess(
    pooled: LogisticConfidence,
    confidences: Sequence[LogisticConfidence],
    shares: Sequence[float],
    evidence: Sequence[Evidence],
) -> float:
    """Greatest excess of one confidence over the mean of others, as a logit; at least 0."""
    own = np.array([pooled(each) for each in evidence])
    theirs = np.array([[single(each) for each in evidence] for single in confidences])
    mean = np.average(theirs, axis=0, weights=shares)
    deciding = (own > DECIDING[0]) & (mean < DECIDING[1])
    if not deciding.any():
        return 0.0
    own, mean = (np.clip(each[deciding], 1e-9, 1 - 1e-9) for each in (own, mean))
    return max(0.0, float(np.max(np.log(own / (1 - own)) - np.log(mean / (1 - mean)))))
