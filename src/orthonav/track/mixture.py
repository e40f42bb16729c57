"""The track: a mixture of hypotheses, each a Kalman filter, and "somewhere else".

A view seldom says one thing only: the true place may be its second best, or none of those that
were found. So every hypothesis is split, one for each place where the view may have been taken and
one for none of them, weighed by how well each fits (multiple hypothesis tracking, Reid 1979; a
Gaussian sum filter, Sorenson and Alspach 1971); the unlikely ones are dropped, those that have
become one are merged. Beside them stands what is left: that the aircraft is somewhere else. All of
it was there at the start; some comes back with every view, so that no mistake is for ever.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from orthonav.records import CONFIDENT
from orthonav.track.hypotheses import Hypothesis, distance, merged, moments, within
from orthonav.track.model import (
    POSITION,
    SEEN,
    STATE,
    TILT,
    Array,
    Model,
    Sighting,
    Told,
    log_density,
    reading,
    updated,
)
from orthonav.track.motion import (
    CameraDisplacement,
    Expected,
    ReportedVelocity,
    after_bias_jump,
    by_camera,
    held_to_map,
    predicted,
    velocity_forgotten,
)

MIN_WAY = 1e-5
"""Less likely ways are not followed."""
MINOR_SHARE = 1e-4
"""Hypotheses with less belief are not split for what is rare."""
MAJOR_SHARE = 0.05
"""The same where views show nothing, for there hypotheses are not merged."""
TOLD_SHARE = 0.9
"""Belief in a position that was told before anything was seen."""
LIKELY = 0.5
CONFIRMED = 0.8
"""Views' worth of new ground that must have been recognized before a track is one, each counted by
how likely its view alone was placed rightly: no single view makes a track, and views that fit only
because they were looked for there do not either."""
TRUSTED = (0.1, 0.5)
"""Views whose own probability is below the first do not count, above the second fully."""
MOST_OF_ONE = 0.75
UNCONFIRMED = 0.8
"""More confidence is not stated before."""
MOST_SIGHTED = 3.0
WIDE_M, FORGOTTEN = 50.0, 0.5
"""More is not remembered, and half of it is forgotten with every view at which the position is
known less well than this: after a while a track must be confirmed anew."""
GATE = 36.0
POSE = slice(2, 4)
"""Heading and scale in what a sighting says."""
SEARCHED_SIGMAS = 6.0
"""How wide headings and scales are looked for, in standard deviations, from end to end."""
MAX_LOG_ODDS = 7.0
"""No single view is believed more than this."""


class State(Enum):
    """What the track is doing."""

    SEARCHING = "searching"
    TRACKING = "tracking"
    LOST = "lost"


@dataclass(frozen=True, eq=False)
class Estimate:
    """Where the aircraft is: mean (8,) and covariance (8, 8) of the best cluster of hypotheses,
    the probability that it is within the radius asked for, the state of the track, and the belief
    in all of the cluster, however wide."""

    mean: Array
    covariance: Array
    confidence: float
    state: State
    belief: float


@dataclass(frozen=True, eq=False)
class _Reading:
    """What a view says of the state (6,), its covariance (6, 6), and the log of what it is worth:
    odds over the density of places, headings and scales that are only alike; `recognized`: how
    much new ground that is, in views."""

    seen: Array
    noise: Array
    log_odds: float
    recognized: float


class Mixture:
    """The belief about one flight. Mutable; not to be shared between threads."""

    def __init__(self, model: Model, extent_en_m: tuple[float, float, float, float]) -> None:
        """`extent_en_m` (west, south, east, north) is that of the map: the aircraft may be
        anywhere on it."""
        self.model, self._extent = model, np.array(extent_en_m)
        self.area_m2 = float(np.prod(self._extent[2:] - self._extent[:2]))
        self.hypotheses: list[Hypothesis] = []
        self.elsewhere = 1.0
        self._state = State.SEARCHING
        self._numbers = 0

    def start(self, mean_en_m: Array, std_m: float) -> None:
        """Begin with a position (2,) that was told, good to `std_m` per axis."""
        self.hypotheses = list(self._told(mean_en_m, std_m, TOLD_SHARE))
        self.elsewhere = 1 - TOLD_SHARE

    def _told(self, mean_en_m: Array, std_m: float, share: float) -> Iterator[Hypothesis]:
        """Hypotheses, together of belief `share`, of an aircraft that is where it was told."""
        for mount, mean, covariance in self._mounts():
            mean[POSITION] = mean_en_m
            covariance[POSITION, POSITION] = np.eye(2) * std_m**2
            self._numbers += 1
            yield Hypothesis(share * mount, mean, covariance, 0.0, self._numbers)

    def told_position(self, mean_en_m: Array, std_m: float) -> None:
        """Take in a position (2,) that was measured otherwise, good to `std_m` per axis."""
        if not self.hypotheses:
            self.start(mean_en_m, std_m)
            return
        made, noise = [], np.eye(2) * std_m**2
        for each in self.hypotheses:
            spread = each.covariance[POSITION, POSITION] + noise
            off = mean_en_m - each.mean[POSITION]
            gain = np.linalg.solve(spread, each.covariance[POSITION]).T
            after = each.covariance - gain @ spread @ gain.T
            share = each.share * math.exp(max(log_density(off, spread), -700.0))
            made.append(
                replace(
                    each, share=share, mean=each.mean + gain @ off, covariance=(after + after.T) / 2
                )
            )
        # If it was anywhere else on the map, it is here too.
        self.elsewhere /= self.area_m2
        made += self._told(mean_en_m, std_m, TOLD_SHARE * self.elsewhere)
        self.elsewhere *= 1 - TOLD_SHARE
        self.hypotheses = made
        self._settle()
        self.hypotheses = merged(sorted(self.hypotheses, key=lambda each: -each.share))
        self._settle()

    def predict(
        self,
        seconds: float,
        told: ReportedVelocity | None = None,
        camera: CameraDisplacement | None = None,
        telemetry_noise: Array | None = None,
    ) -> None:
        """Let time pass; `told` is what instruments say of the way gone, `camera` what views say.

        `telemetry_noise` (2,): variances with which reported heading (rad) and log scale scatter
        from view to view, those of the model where None.
        """
        noise = self.model.telemetry_noise if telemetry_noise is None else telemetry_noise
        kept = 1 - self.model.lost
        made = []
        for each in self.hypotheses:
            for share, expected in self._ways(each, seconds, told, camera, noise):
                on_map = held_to_map(self.model, expected, self.area_m2)
                made.append(self._from(each, on_map, each.share * share * kept))
        self.hypotheses = made
        self.elsewhere += (1 - kept) * (1 - self.elsewhere)

    def _ways(
        self,
        each: Hypothesis,
        seconds: float,
        told: ReportedVelocity | None,
        camera: CameraDisplacement | None,
        telemetry_noise: Array,
    ) -> Iterator[tuple[float, Expected]]:
        """Where a hypothesis may be next, and how likely: as the camera saw it, or not so.

        What the camera saw is weighed by what was expected: of a way that nothing else tells, it
        may also be that the aircraft turned as nobody expected.
        """
        model, likely = self.model, 1 - self.model.odometry_outlier
        slipped = predicted(model, each.mean, each.covariance, seconds, told, telemetry_noise)
        if camera is None:
            chance = 0.0
            if told is None and each.share >= MAJOR_SHARE:  # nobody saw it, nobody told it
                chance = 1 - (1 - model.turn) ** seconds
                free = velocity_forgotten(model, each.covariance)
                yield chance, predicted(model, each.mean, free, seconds, told, telemetry_noise)
            yield 1.0 - chance, slipped
            return
        # A wrong way lies anywhere that it was looked for.
        wrong = math.log(model.odometry_outlier / (math.pi * camera.reach_m**2))
        ways = [(wrong, slipped)]
        turns = [(likely, each.covariance)]
        if each.share < MINOR_SHARE:
            ways = []
        elif told is None:
            turns = [
                (likely * (1 - model.turn), each.covariance),
                (likely * model.turn, velocity_forgotten(model, each.covariance)),
            ]
        for share, covariance in turns:
            turned = predicted(model, each.mean, covariance, seconds, told, telemetry_noise, camera)
            seen, log_fit = by_camera(turned, camera)
            ways.append((math.log(share) + log_fit, seen))
        best = max(log_share for log_share, _ in ways)
        shares = [math.exp(max(log_share - best, -700.0)) for log_share, _ in ways]
        for share, (_, expected) in zip(shares, ways, strict=True):
            if share > MIN_WAY * sum(shares):
                yield share / sum(shares), expected

    def update(
        self,
        told: Told,
        sightings: Sequence[Sighting],
        newness: float = 1.0,
        searched: tuple[Array, float] | None = None,
    ) -> None:
        """Take in where a view may have been taken; none of it may be true.

        `searched` is the circle of the map that was looked at, middle (2,) and radius in metres;
        None for all of it. `newness` is the share of the view that the last one did not show:
        views of the same ground err alike, so that many of them are not more than one.
        """
        made = []
        missed = self.model.miss**newness
        found = (1 - self.model.miss) ** newness
        readings = [self._reading(told, each, newness) for each in sightings]
        for each in self.hypotheses:
            looked_at = self._on_map(each.mean)
            if searched is not None:
                looked_at &= bool(np.hypot(*(each.mean[:2] - searched[0])) < searched[1])
            made.append(replace(each, share=each.share * (missed if looked_at else 1.0)))
            for start in self._with_bias_jump(each):
                for seen in readings:
                    split = self._seen(start, seen)
                    if split is not None:
                        made.append(replace(split, share=split.share * found))
        made += [born for each in readings for born in self._born(each)]
        total = sum(each.share for each in made) + self.elsewhere
        self.elsewhere /= total
        made = [replace(each, share=each.share / total) for each in made]
        self.hypotheses = merged(sorted(made, key=lambda each: -each.share))
        self._settle()

    def estimate(self, radius_m: float, *, between_views: bool = False) -> Estimate | None:
        """The best cluster, None where there is no hypothesis at all.

        The state changes with it, unless it is asked for `between_views`: before the view that
        has just come was looked for.
        """
        if not self.hypotheses:
            return None
        best = self._best(radius_m)
        near = [each for each in self.hypotheses if distance(each, best) <= radius_m]
        mean, covariance = moments(near)
        confidence = min(self._inside(radius_m, mean[POSITION]), 1.0)
        sighted = max(each.sighted for each in near)
        if not between_views:
            self._state = self._next_state(confidence, sighted)
        if self._state is not State.TRACKING:
            confidence = min(confidence, UNCONFIRMED)
        belief = sum(each.share for each in near)
        return Estimate(mean, covariance, confidence, self._state, belief)

    @property
    def likeliest(self) -> Hypothesis | None:
        """The single hypothesis with most belief."""
        return self.hypotheses[0] if self.hypotheses else None

    def _best(self, radius_m: float) -> Hypothesis:
        """The hypothesis with most belief around it."""
        heaviest = self.hypotheses[:8]
        return max(heaviest, key=lambda one: self._inside(radius_m, one.mean[POSITION]))

    def _inside(self, radius_m: float, middle: Array) -> float:
        """How much of the belief lies within a radius of a place (2,)."""
        return sum(
            each.share * within(each.mean, each.covariance, radius_m, middle)
            for each in self.hypotheses
        )

    def bias(self) -> tuple[Array, Array]:
        """What is believed to be wrong with what is told, by all hypotheses: mean (4,) and
        covariance (4, 4) of heading, log scale, pitch and roll."""
        if not self.hypotheses:
            return np.zeros(4), np.diag(self.model.initial_bias())
        mean, covariance = moments(self.hypotheses)
        return mean[4:], covariance[4:, 4:]

    def _next_state(self, confidence: float, sighted: float) -> State:
        if confidence >= CONFIDENT and sighted >= CONFIRMED:
            return State.TRACKING
        if self._state is State.TRACKING and confidence < LIKELY:
            return State.LOST
        return self._state

    def _on_map(self, mean: Array) -> bool:
        inside = (mean[:2] >= self._extent[:2]) & (mean[:2] <= self._extent[2:])
        return bool(inside.all())

    def _with_bias_jump(self, each: Hypothesis) -> list[Hypothesis]:
        """A hypothesis as it is, and as it is if the camera was knocked since the last view."""
        rare = self.model.bias_jump
        if each.expected is None or each.share < MINOR_SHARE:
            return [each]
        expected = after_bias_jump(self.model, each.expected)
        other = replace(
            each,
            share=each.share * rare,
            mean=expected.mean,
            covariance=expected.covariance,
            expected=expected,
        )
        return [replace(each, share=each.share * (1 - rare)), other]

    def _reading(self, told: Told, sighting: Sighting, newness: float) -> "_Reading":
        """A sighting, of which only a part is new, as it is weighed.

        A likelihood taken to the power `newness` is not only lower: its peak becomes broader, and
        stands out less from all the places, headings and scales that there are. What is told anew
        with every view is not part of that.
        """
        seen, noise, anew = reading(self.model, told, sighting)
        own = np.diag(noise)[POSE] + self.model.initial_bias()[:2]
        wide = math.log(self.area_m2) + float(np.log(SEARCHED_SIGMAS * np.sqrt(own)).sum())
        # A view tilts as mounts do wherever it is put: that is no evidence for a place.
        tilts = noise[4:, 4:] + anew[4:, 4:]
        wide -= math.log(
            sum(
                share * math.exp(log_density(seen[4:], tilts + covariance[TILT, TILT]))
                for share, _, covariance in self._mounts()
            )
        )
        _, log_det = np.linalg.slogdet(2 * math.pi * noise)
        odds = newness * (min(sighting.log_odds, MAX_LOG_ODDS) + wide)
        odds += (1 - newness) * float(log_det) / 2 - len(SEEN) / 2 * math.log(newness)
        return _Reading(
            seen, noise / newness + anew, odds, min(newness * _trust(sighting.alone), MOST_OF_ONE)
        )

    def _seen(self, each: Hypothesis, seen: "_Reading") -> Hypothesis | None:
        """The hypothesis after a sighting, weighed; None where they have nothing in common."""
        off = seen.seen - each.mean[SEEN]
        reach = np.trace(each.covariance[:2, :2]) + np.trace(seen.noise[:2, :2])
        if off[:2] @ off[:2] > GATE * reach:
            return None
        spread = each.covariance[np.ix_(SEEN, SEEN)] + seen.noise
        log_weight = seen.log_odds + log_density(off, spread)
        mean, covariance = updated(each.mean, each.covariance, off, spread)
        self._numbers += 1
        return replace(
            each,
            share=each.share * math.exp(min(log_weight, 60.0)),
            mean=mean,
            covariance=covariance,
            sighted=min(each.sighted + seen.recognized, MOST_SIGHTED),
            number=self._numbers,
        )

    def _nowhere(self, tilt_rad: float | None = None) -> tuple[Array, Array]:
        """Mean (8,) and covariance (8, 8) of an aircraft that may be anywhere on the map."""
        place, speed = self.area_m2, self.model.speed_mps**2
        variances = [place, place, speed, speed, *self.model.initial_bias(tilt_rad)]
        return np.zeros(STATE), np.diag(np.array(variances))

    def _mounts(self) -> Iterator[tuple[float, Array, Array]]:
        """How likely a mount is good, or off; mean and covariance of somebody anywhere with it."""
        off = self.model.off_mount
        yield 1 - off, *self._nowhere()
        if off > 0:
            yield off, *self._nowhere(self.model.off_tilt_rad)

    def _born(self, seen: "_Reading") -> Iterator[Hypothesis]:
        """The hypotheses that the aircraft was elsewhere, and is here."""
        for share, mean, covariance in self._mounts():
            spread = covariance[np.ix_(SEEN, SEEN)] + seen.noise
            log_weight = seen.log_odds - math.log(self.area_m2)
            log_weight += log_density(seen.seen[2:], spread[2:, 2:])
            mean, covariance = updated(mean, covariance, seen.seen, spread)
            share *= self.elsewhere * math.exp(min(log_weight, 60.0))
            self._numbers += 1
            yield Hypothesis(share, mean, covariance, seen.recognized, self._numbers)

    def _from(self, each: Hypothesis, expected: Expected, share: float) -> Hypothesis:
        self._numbers += 1
        mean, covariance = expected.mean, expected.covariance
        sighted = each.sighted
        if float(np.trace(covariance[POSITION, POSITION])) > 2 * WIDE_M**2:
            sighted *= FORGOTTEN
        return Hypothesis(share, mean, covariance, sighted, self._numbers, each.number, expected)

    def _settle(self) -> None:
        """Shares that add up to one with what is elsewhere."""
        total = sum(each.share for each in self.hypotheses) + self.elsewhere
        self.hypotheses = [replace(e, share=e.share / total) for e in self.hypotheses]
        self.elsewhere /= total


def _trust(alone: float) -> float:
    low, high = TRUSTED
    return min(max((alone - low) / (high - low), 0.0), 1.0)
