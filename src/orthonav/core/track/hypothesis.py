"""The hypotheses of a track: each is a Gaussian, similar ones are merged."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.track.likelihood import log_density
from orthonav.core.track.model import HEADING, POSITION, STATE, VELOCITY, Array
from orthonav.core.track.motion import Expected
from orthonav.core.track.trust import Shown

MAX_HYPOTHESES = 40  # the least likely are dropped: the cost of a view grows with their number
MIN_SHARE = 1e-7
MERGE_SIGMAS = 1.0
"""Merging loses less (in nats, doubled) than this distance in standard deviations, squared."""
MINOR_OF_GROUP = 0.01  # share of a group of hypotheses below which one says nothing about the group
NORTH_STEP_M = 100.0  # over which the convergence of two planes is measured
COMPARED: Array = np.zeros((6, STATE))
"""Position, velocity and the whole tilt, by which hypotheses are compared."""
COMPARED[range(6), [0, 1, 2, 3, 6, 7]] = COMPARED[[4, 5], [8, 9]] = 1.0


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One hypothesis of the track, with probability `share`, `mean` (16,), `covariance` (16, 16).

    `shown`: what views showed there. `parent`, `expected`: of the last view; -1, None where it was
    born now."""

    share: float
    mean: Array
    covariance: Array
    shown: Shown
    number: int
    parent: int = -1
    expected: Expected | None = None


def merged(ordered: list[Hypothesis]) -> list[Hypothesis]:
    """Most likely first; similar ones merged, unlikely ones dropped."""
    likely = [each for each in ordered[: 4 * MAX_HYPOTHESES] if each.share > MIN_SHARE]
    left = likely or ordered[:1]  # the last one stays, however unlikely
    if not left:
        return []
    means = np.array([each.mean for each in left]) @ COMPARED.T
    covariances = COMPARED @ np.array([each.covariance for each in left]) @ COMPARED.T
    numbers = np.arange(len(left))
    out: list[Hypothesis] = []
    while len(numbers) and len(out) < MAX_HYPOTHESES:
        first = left[numbers[0]]
        alike = _divergence(means[numbers], covariances[numbers]) < 2 * MERGE_SIGMAS**2
        alike[0] = True
        group = [left[number] for number in numbers[alike]]
        numbers = numbers[~alike]
        mean, covariance = moments(group)
        share = sum(each.share for each in group)
        shown = replace(
            first.shown,
            ground=sum(each.share * each.shown.ground for each in group) / share,
            now=max(each.shown.now for each in major(group)),
        )
        out.append(replace(first, share=share, mean=mean, covariance=covariance, shown=shown))
    return out


def major(group: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Those with at least `MINOR_OF_GROUP` of the probability of the group."""
    least = MINOR_OF_GROUP * sum(each.share for each in group)
    return [each for each in group if each.share >= least]


def _divergence(means: Array, covariances: Array) -> Array:
    """Kullback-Leibler divergence (nats, (N,)) of Gaussians (N, 6) of `COMPARED` from the first: a
    well-known place must not vanish in a wide hypothesis (docs/tracking.md)."""
    inverse = np.linalg.inv(covariances[0])
    off = means - means[0]
    turned = inverse @ covariances
    _, log_det = np.linalg.slogdet(turned)
    distance = np.einsum("ni,ij,nj->n", off, inverse, off)
    spread = np.trace(turned, axis1=1, axis2=2)
    return np.asarray((distance + spread - means.shape[1] - log_det) / 2)


def moments(group: Sequence[Hypothesis]) -> tuple[Array, Array]:
    """As one Gaussian, (16,) and (16, 16); not to be changed."""
    if len(group) == 1:
        return group[0].mean, group[0].covariance
    shares = np.array([each.share for each in group])
    shares = shares / shares.sum()
    means = np.array([each.mean for each in group])
    mean = shares @ means
    off = means - mean
    covariance = np.tensordot(shares, np.array([each.covariance for each in group]), axes=1)
    return mean, np.asarray(covariance + (off * shares[:, None]).T @ off)


def moved(each: Hypothesis, plane: LocalFrame, other: LocalFrame) -> Hypothesis:
    """In another plane, turned by the convergence of north."""
    two = each.mean[POSITION] + np.array([[0.0, 0.0], [0.0, NORTH_STEP_M]])
    place, to_north = other.en_from_latlon(*plane.latlon_from_en(two))
    east, north = (to_north - place).tolist()
    turn = math.atan2(east, north)
    turned = np.eye(len(each.mean))
    turned[POSITION, POSITION] = turned[VELOCITY, VELOCITY] = [
        [math.cos(turn), math.sin(turn)],
        [-math.sin(turn), math.cos(turn)],
    ]
    mean = turned @ each.mean
    mean[POSITION] = place
    mean[HEADING] += turn
    return replace(each, mean=mean, covariance=turned @ each.covariance @ turned.T)


def at_position(each: Hypothesis, mean_en_m: Array, noise: Array) -> Hypothesis:
    """After a measurement of the position (2,) with `noise` (2, 2)."""
    spread = each.covariance[POSITION, POSITION] + noise
    innovation = mean_en_m - each.mean[POSITION]
    gain = np.linalg.solve(spread, each.covariance[POSITION]).T
    after = each.covariance - gain @ spread @ gain.T
    return replace(
        each,
        share=each.share * math.exp(max(log_density(innovation, spread), -700.0)),
        mean=each.mean + gain @ innovation,
        covariance=(after + after.T) / 2,
    )


def distance(one: Hypothesis, other: Hypothesis) -> float:
    return math.dist(one.mean[POSITION], other.mean[POSITION])
