"""Hypotheses of a track: what one is, when two have become one, and what several are together."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from orthonav.track.model import POSITION, Array
from orthonav.track.motion import Expected

MAX_HYPOTHESES = 40
MIN_SHARE = 1e-7
MERGE_SIGMAS = 1.0
WHAT_DIFFERS = np.ix_([0, 1, 2, 3, 6, 7], [0, 1, 2, 3, 6, 7])
"""Of the covariances of two hypotheses: position, velocity and tilt."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One way things may be.

    Its share of belief, mean (8,), covariance (8, 8), how much new ground was sighted (in views),
    and its number; the number of what it came from, and what that was expected to become by now:
    None where it came from nowhere.
    """

    share: float
    mean: Array
    covariance: Array
    sighted: float
    number: int
    parent: int = -1
    expected: Expected | None = None


def merged(ordered: list[Hypothesis]) -> list[Hypothesis]:
    """Hypotheses, heaviest first, with those that have become one put together, few kept."""
    likely = [each for each in ordered[: 4 * MAX_HYPOTHESES] if each.share > MIN_SHARE]
    left = likely or ordered[:1]  # the last one stays, however unlikely
    kept: list[Hypothesis] = []
    while left and len(kept) < MAX_HYPOTHESES:
        first, rest = left[0], left[1:]
        inverse = np.asarray(np.linalg.inv(first.covariance[WHAT_DIFFERS]), np.float64)
        group, left = [first], []
        for each in rest:
            alike = _divergence(each, first, inverse) < 2 * MERGE_SIGMAS**2
            (group if alike else left).append(each)
        mean, covariance = moments(group)
        share = sum(each.share for each in group)
        sighted = sum(each.share * each.sighted for each in group) / share
        kept.append(replace(first, share=share, mean=mean, covariance=covariance, sighted=sighted))
    return kept


def _divergence(one: Hypothesis, heavier: Hypothesis, inverse: Array) -> float:
    """How much is lost (nats, Kullback and Leibler) where a hypothesis becomes part of a heavier
    one, in position, velocity and tilt; `inverse` (6, 6) is that of the heavier one's covariance.

    A place that is known well is not the same as a wide guess around it.
    """
    off = (one.mean - heavier.mean)[[0, 1, 2, 3, 6, 7]]
    turned = inverse @ one.covariance[WHAT_DIFFERS]
    _, log_det = np.linalg.slogdet(turned)
    return float(off @ inverse @ off + np.trace(turned) - 6 - log_det) / 2


def moments(group: Sequence[Hypothesis]) -> tuple[Array, Array]:
    """Mean and covariance of several hypotheses taken as one."""
    shares = np.array([each.share for each in group])
    shares = shares / shares.sum()
    means = np.stack([each.mean for each in group])
    mean = shares @ means
    off = means - mean
    covariance = sum(s * each.covariance for s, each in zip(shares, group, strict=True))
    return mean, np.asarray(covariance + (off * shares[:, None]).T @ off)


def distance(one: Hypothesis, other: Hypothesis) -> float:
    """Metres between the positions of two hypotheses."""
    return float(np.hypot(*(one.mean[POSITION] - other.mean[POSITION])))


def within(mean: Array, covariance: Array, radius_m: float, middle: Array | None = None) -> float:
    """About how much of a state lies within a radius of `middle` (2,), its own mean where None.

    Exact for a round Gaussian around the middle; distance counts as so much more spread.
    """
    variance = float(np.trace(covariance[POSITION, POSITION])) / 2
    away = 0.0 if middle is None else float(np.hypot(*(mean[POSITION] - middle)))
    if away > radius_m + 3 * math.sqrt(variance):
        return 0.0
    return 1 - math.exp(-(radius_m**2) / (2 * variance + away**2 + 1e-9))
