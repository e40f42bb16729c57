"""Hypotheses of a track: one Kalman state each, and how several are merged."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.track.model import HEADING, POSITION, STATE, VELOCITY, Array
from orthonav.core.track.motion import Expected

MAX_HYPOTHESES = 40
"""The least likely are dropped: the cost of a view grows with their number."""
MIN_SHARE = 1e-7
MERGE_SIGMAS = 1.0
"""Merging loses less (in nats, doubled) than this distance in standard deviations, squared."""
MINOR_OF_GROUP = 0.01
"""Share of a group of hypotheses below which one says nothing about the group."""
NORTH_STEP_M = 100.0
"""Over which the convergence of two planes is measured."""
COMPARED: Array = np.zeros((6, STATE))
"""Position, velocity and the whole tilt, by which hypotheses are compared."""
COMPARED[range(6), [0, 1, 2, 3, 6, 7]] = COMPARED[[4, 5], [8, 9]] = 1.0


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One hypothesis of the track, with probability `share`, `mean` (10,), `covariance` (10, 10).

    `sighted`: new ground that it recognized, in views; `uncounted`: since the last view that
    counted. `number`: unique in the flight. `parent`, `expected`: that of the last view and its
    prediction; -1, None where it was born now. `recognized`: probability, by the last view and its
    agreement with the prediction, that it showed the map here. `followed`: from a confirmed track
    or reported position."""

    share: float
    mean: Array
    covariance: Array
    sighted: float
    number: int
    parent: int = -1
    expected: Expected | None = None
    recognized: float = 0.0
    followed: bool = False
    uncounted: float = 0.0


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
        sighted = sum(each.share * each.sighted for each in group) / share
        out.append(
            replace(
                first,
                share=share,
                mean=mean,
                covariance=covariance,
                sighted=sighted,
                recognized=recognized(group),
            )
        )
    return out


def recognized(group: Sequence[Hypothesis]) -> float:
    """Largest probability of having recognized the map, by the `major` ones."""
    return max(each.recognized for each in major(group))


def major(group: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Those with at least `MINOR_OF_GROUP` of the probability of the group."""
    least = MINOR_OF_GROUP * sum(each.share for each in group)
    return [each for each in group if each.share >= least]


def _divergence(means: Array, covariances: Array) -> Array:
    """Kullback-Leibler divergence (nats) of each of several Gaussians from the first, (N,).

    `means` (N, 6), `covariances` (N, 6, 6): of `COMPARED`. A well-known place must not vanish in a
    wide hypothesis around it (docs/decisions/tracking.md)."""
    inverse = np.linalg.inv(covariances[0])
    off = means - means[0]
    turned = inverse @ covariances
    _, log_det = np.linalg.slogdet(turned)
    distance = np.einsum("ni,ij,nj->n", off, inverse, off)
    spread = np.trace(turned, axis1=1, axis2=2)
    return np.asarray((distance + spread - means.shape[1] - log_det) / 2)


def moments(group: Sequence[Hypothesis]) -> tuple[Array, Array]:
    """As one Gaussian, (10,) and (10, 10); not to be changed."""
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


def distance(one: Hypothesis, other: Hypothesis) -> float:
    return math.dist(one.mean[POSITION], other.mean[POSITION])
