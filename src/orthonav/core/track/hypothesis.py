"""The hypotheses of a track, each a Gaussian, and which of them is believed.

Similar hypotheses are merged. The best place is judged after every view: by what views showed,
where, and on how much new ground. States and transitions: docs/tracking.md, with the evidence for
the values."""

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import CONFIDENT
from orthonav.core.track.filter import (
    HEADING,
    POSITION,
    STATE,
    VELOCITY,
    Array,
    Expected,
    log_density,
)

MAX_HYPOTHESES = 40  # the least likely are dropped: the cost of a view grows with their number
MIN_SHARE = 1e-7
MERGE_SIGMAS = 1.0
"""Merging loses less (in nats, doubled) than this distance in standard deviations, squared."""
MINOR_OF_GROUP = 0.01  # share of a group of hypotheses below which one says nothing about the group
NORTH_STEP_M = 100.0  # over which the convergence of two planes is measured
COMPARED: Array = np.zeros((6, STATE))
"""Position, velocity and the whole tilt, by which hypotheses are compared."""
COMPARED[range(6), [0, 1, 2, 3, 6, 7]] = COMPARED[[4, 5], [8, 9]] = 1.0

RECOGNIZED = 0.2  # probability from which on a view shows the map
SURE = (0.1, 0.5)  # probability by a view alone up to which it does not count, from which fully
MOST_OF_ONE = 0.75  # of a single view: less than `CONFIRMED`
CONFIRMED = 1.25
"""New ground, in views, on which a place must have been shown: no single view confirms, nor further
views of its ground, nor those that fit only because they were searched there."""
MOST_LATELY = 3.0  # largest count of it
UNRECOGNIZED, UNCERTAIN = 0.5, 0.5
"""Factors on the count for new ground that does not show the map, and for every view at which the
position is less certain than `Model.wide_m`."""
LIKELY = 0.5  # confidence that a track keeps
UNCONFIRMED = 0.8  # most that is stated except while tracking
REPORTED, MOST_BELIEVED = 8.0, 24.0
"""New ground, in views, that a reported position is worth against other places, and the most that a
track is worth."""
HALVED_S = 10.0  # without odometry, in which it is halved: a reported velocity is wrong for long
EXACT_M = 7.5  # deviation per axis of a dead reckoning that is as good as tracking
REACHED = 6.0  # squared error over its covariance, exceeded with a probability of 0.05
BLIND = 0.5
"""Factor on the evidence against a followed track of a view that does not show the map, for each
such view before: clouds, water and a covered lens last."""


class State(Enum):
    SEARCHING = "searching"  # no place has been believed
    TRACKING = "tracking"  # believed, and this view shows the map there
    COASTING = "coasting"
    """Believed before; this view does not show the map, the position is dead reckoning."""
    LOST = "lost"
    """Believed before; the position is no longer likely, or that of another place."""

    @property
    def is_followed(self) -> bool:
        return self in (State.TRACKING, State.COASTING)


@dataclass(frozen=True)
class Shown:
    """What views showed at one place.

    `ground`: new ground recognized there lately, in views; `waiting`: new since the last view that
    counted; `now`: probability that the last view shows the map there. `followed`: from a believed
    track or a reported position."""

    ground: float = 0.0
    waiting: float = 0.0
    now: float = 0.0
    followed: bool = False

    @property
    def is_now(self) -> bool:
        return self.now >= RECOGNIZED

    @property
    def is_confirmed(self) -> bool:
        return self.ground >= CONFIRMED

    def confirmed(self) -> "Shown":
        """By other means than views."""
        return replace(self, ground=max(self.ground, CONFIRMED), followed=True)

    def missed(self, new: float) -> "Shown":
        """After a view that does not show the map, `new` of which the last one did not show."""
        ground = self.ground * float(UNRECOGNIZED**new)
        return replace(self, ground=ground, waiting=min(self.waiting + new, 1.0), now=0.0)

    def recognized(self, now: float, alone: float, new: float, *, competed: bool) -> "Shown":
        """After a view that shows the map here with probability `now`, by itself `alone`.

        `competed`: with all other places where the aircraft may be; others do not count."""
        if now < RECOGNIZED:
            return replace(self.missed(new), now=now)
        low, high = SURE
        waiting = min(self.waiting + new, 1.0)
        # Only of a followed track all that waits: chance has many views to agree with a new one.
        counted = (waiting if self.followed else new) * min(max((alone - low) / (high - low), 0), 1)
        if not competed or not counted:
            return replace(self, waiting=waiting, now=now)
        ground = min(self.ground + min(counted, MOST_OF_ONE), MOST_LATELY)
        return replace(self, ground=ground, waiting=0.0, now=now)


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


class Claim(NamedTuple):
    """A place that was shown, dead-reckoned since, and the new ground, in views, that showed it."""

    place: Hypothesis
    ground: float


class Trust:
    """The state of a track, the place that is believed, and the one that contradicts it.

    A place to which dead reckoning does not lead is not believed before more new ground showed it
    than the track: a camera that consistently shows another place looks the same. Mutable."""

    def __init__(self) -> None:
        self.state = State.SEARCHING
        self.believed: Claim | None = None
        self.rival: Claim | None = None
        self.unseen = 0.0  # new evidence of views in a row that did not show the map

    @property
    def most(self) -> float:
        """Largest probability of the place that may be stated."""
        return 1.0 if self.state is State.TRACKING else UNCONFIRMED

    def reported(self, place: Hypothesis | None) -> None:
        """A position by other means, None: one that does not contradict other places."""
        self.believed = None if place is None else Claim(place, REPORTED)
        self.rival = None

    def moved(self, step: Callable[[Hypothesis], Hypothesis], blind_s: float = 0.0) -> "Trust":
        """One dead-reckoned, or to another plane. `blind_s`: time that no odometry covers."""
        believed, rival = (
            None if each is None else each._replace(place=step(each.place))
            for each in (self.believed, self.rival)
        )
        if believed is not None:
            left = believed.ground * 0.5 ** (blind_s / HALVED_S)
            believed = believed._replace(ground=left)
        made = copy(self)
        made.believed, made.rival = believed, rival
        return made

    def viewed(self, newness: float, *, shown: bool) -> None:
        """After a view; `newness`: share that counts as new evidence."""
        blind = self.state is not State.SEARCHING and not shown
        self.unseen = self.unseen + newness if blind else 0.0

    def judge(self, here: Hypothesis, confidence: float, new: float, missed: float) -> None:
        """Judge the best place after a view, `new` of which the last one did not show.

        `missed`: what counts against the place that contradicts the track, unless shown here."""
        shown, was_followed = here.shown, self.state.is_followed
        stays = was_followed and shown.followed and confidence >= LIKELY
        is_shown = (stays or confidence >= CONFIDENT) and shown.is_confirmed and shown.is_now
        ground = self._ground_of(here, new) if is_shown else None
        if ground is not None:
            followed = replace(here, shown=replace(shown, followed=True))
            self.believed, self.rival = Claim(followed, min(ground, MOST_BELIEVED)), None
            self.state = State.TRACKING
            return
        if not is_shown and self.rival is not None:
            left = self.rival.ground - missed
            self.rival = self.rival._replace(ground=left) if left > 0 else None
        if stays and not is_shown:
            self.state = State.COASTING
        elif self.state is not State.SEARCHING:
            self.state = State.LOST

    def _ground_of(self, here: Hypothesis, new: float) -> float | None:
        """New ground that showed a place in total; None where it is not believed."""
        if self.believed is None:
            return here.shown.ground
        if _is_reached(here, self.believed.place):
            return self.believed.ground + new
        again = self.rival is not None and _is_reached(here, self.rival.place)
        ground = self.rival.ground + new if self.rival is not None and again else CONFIRMED
        self.rival = Claim(here, ground)
        return ground if ground > self.believed.ground else None


def _is_reached(here: Hypothesis, last: Hypothesis) -> bool:
    """Whether the aircraft can have come here by dead reckoning."""
    off, spread = (here.mean - last.mean)[POSITION], (last.covariance + here.covariance)[:2, :2]
    return bool(off @ np.linalg.solve(spread, off) < REACHED)
