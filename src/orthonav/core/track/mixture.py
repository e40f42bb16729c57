"""The track: a mixture of hypotheses, each a Kalman filter, and the belief "elsewhere".

A view's true place may be the second best, or none of those found. So every hypothesis is split,
one for each place and one for none, weighted by likelihood (multiple hypothesis tracking, Reid
1979; a Gaussian sum filter, Sorenson and Alspach 1971). Unlikely ones are dropped, similar ones
merged. The rest is "elsewhere": 1 at the start, new hypotheses are born from it, and some returns
to it with every view, so that no error is permanent (docs/decisions/tracking.md)."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial

import numpy as np

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize.confidence import within
from orthonav.core.records import CONFIDENT
from orthonav.core.track.likelihood import (
    Measurement,
    confirmed_ground,
    log_densities,
    log_density,
    recognition,
    tempered,
    updated,
)
from orthonav.core.track.model import (
    HEADING,
    POSITION,
    SEEN,
    STATE,
    VELOCITY,
    Array,
    Model,
    ReportedAttitude,
    Sighting,
)
from orthonav.core.track.motion import (
    CameraDisplacement,
    Expected,
    ReportedVelocity,
    after_bias_jump,
    by_camera,
    held_to_map,
    predicted,
    velocity_forgotten,
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


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One hypothesis of the track, with probability `share`, `mean` (16,), `covariance` (16, 16).

    `sighted`: new ground that it recognized, in views; `uncounted`: since the last view that
    counted. `parent`, `expected`: of the last view; -1, None where it was born now. `recognized`:
    probability that the last view showed the map here. `followed`: from a confirmed track or
    reported position."""

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
    """Kullback-Leibler divergence (nats, (N,)) of Gaussians (N, 6) of `COMPARED` from the first: a
    well-known place must not vanish in a wide hypothesis (docs/decisions/tracking.md)."""
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


MIN_SPLIT = 1e-5
"""Least share to be followed. Values without a source: by the flights of docs/tracking.md."""
MINOR_SHARE = 1e-4  # less likely hypotheses are not split for rare events,
MAJOR_SHARE = 0.05  # nor these without odometry, where hypotheses are not merged between views
START_SHARE = 0.9  # of a reported start position
LIKELY = 0.5  # A track with less confidence is lost
CONFIRMED = 1.25
"""New ground, in views, to be recognized before a track is confirmed, each by its own probability:
no single view confirms, nor further views of its ground, nor those that fit only because they were
searched there (docs/decisions/tracking.md)."""
UNCONFIRMED = 0.8  # most that is stated before a track is confirmed (docs/decisions/tracking.md)
RECOGNIZED = 0.2
"""From which on a view shows the map. Without, a track is coasting (docs/decisions/tracking.md)."""
RECOGNIZED_SIGMAS = 1.5  # farther from the estimate, per axis, a view does not show the map there
RECOGNIZED_SHARE = 0.1
"""Hypotheses with less of their cluster do not show where it is (docs/decisions/tracking.md)."""
UNRECOGNIZED = 0.5
"""Factor on the count of recognized ground for a view of new ground that does not show the map."""
BLIND = 0.5
"""Factor on the evidence against a confirmed track of a view that does not show the map, for each
such view before: clouds, water and a covered lens last (docs/decisions/tracking.md)."""
MOST_SIGHTED = 3.0  # highest count, in views
FORGOTTEN = 0.5
"""Factor on the count with every view at which the position is less certain than `Model.wide_m`."""
GATE = 36.0  # largest squared innovation of the position over the trace of its covariance
REACHED = 6.0  # squared error over its covariance, exceeded with a probability of 0.05
RESTORED = 8.0  # new ground, in views, recognized at a place before dead reckoning must be wrong


class State(Enum):
    SEARCHING = "searching"  # no place has been confirmed
    TRACKING = "tracking"  # Confirmed, and this view shows the map where the track is
    COASTING = "coasting"
    """Confirmed before; this view does not show the map, the position is dead reckoning."""
    LOST = "lost"
    """Confirmed before; the position is no longer likely, or that of another, unconfirmed place."""

    @property
    def is_followed(self) -> bool:
        return self in (State.TRACKING, State.COASTING)


@dataclass(frozen=True, eq=False)
class Estimate:
    """The best cluster of hypotheses. Its arrays are not to be changed.

    `confidence`: probability of being within the radius asked for; `place_probability`: however
    wide the cluster, and so no less. Both are limited until the track is confirmed; `belief` is
    not. `recognized`: probability that the last view showed the map there. `confirmed`: enough
    ground was recognized lately. `followed`: from a confirmed track or a reported position."""

    mean: Array
    covariance: Array
    confidence: float
    place_probability: float
    state: State
    belief: float
    recognized: float
    confirmed: bool
    followed: bool


class Mixture:
    """The belief about one flight. Mutable; not to be shared between threads."""

    def __init__(self, model: Model, extent_en_m: tuple[float, float, float, float]) -> None:
        """`extent_en_m`: west, south, east, north of the map, on which the aircraft is."""
        self.model = model
        self._set_extent(extent_en_m)
        self.hypotheses: list[Hypothesis] = []  # the likeliest first, unless split
        self._is_split = False  # by a prediction, and not merged since
        self.elsewhere = 1.0
        self._state = State.SEARCHING
        self._blind = 0.0
        self._numbers = 0
        self._last: Hypothesis | None = None  # of the track, dead-reckoned since
        self._against: Hypothesis | None = None  # the place that contradicts it, dead-reckoned too
        self._ground = self._restored = 0.0  # new in this view; recognized there
        self._measured: tuple[Array, Array] | None = None  # position since the last prediction

    def _set_extent(self, extent_en_m: tuple[float, float, float, float]) -> None:
        self._extent = np.array(extent_en_m)
        self.area_m2 = float(np.prod(self._extent[2:] - self._extent[:2]))

    def move(
        self, plane: LocalFrame, other: LocalFrame, extent_en_m: tuple[float, float, float, float]
    ) -> None:
        """Continue between two views in another plane, on a map of this extent there."""
        self.hypotheses = [moved(each, plane, other) for each in self.hypotheses]
        self._last = None if self._last is None else moved(self._last, plane, other)
        self._against = None if self._against is None else moved(self._against, plane, other)
        self._set_extent(extent_en_m)

    def start(self, mean_en_m: Array, std_m: float) -> None:
        """At a reported position (2,), `std_m` per axis."""
        self.hypotheses = list(self._born_at(mean_en_m, std_m, START_SHARE))
        self.elsewhere = 1 - START_SHARE

    def _born_at(self, mean_en_m: Array, std_m: float, share: float) -> Iterator[Hypothesis]:
        for mount, mean, covariance in self._mounts():
            mean[POSITION] = mean_en_m
            covariance[POSITION, POSITION] = np.eye(2) * std_m**2
            self._numbers += 1
            yield Hypothesis(share * mount, mean, covariance, 0.0, self._numbers, followed=True)

    def measure_position(self, mean_en_m: Array, std_m: float) -> None:
        """By other means, such as GNSS, (2,), `std_m` per axis."""
        if not self.hypotheses:
            self.start(mean_en_m, std_m)
            return
        self._measured = mean_en_m, np.eye(2) * std_m**2
        made = [at_position(each, *self._measured) for each in self.hypotheses]
        # Belief elsewhere is spread over the map: its density at this position remains.
        elsewhere = self.elsewhere / self.area_m2
        made += self._born_at(mean_en_m, std_m, START_SHARE * elsewhere)
        self._merge(made, elsewhere * (1 - START_SHARE))
        self._last = self._against = None  # what dead reckoning contradicts, other means confirm

    def unrecognize(self) -> None:
        """As if the last view had not shown the map anywhere."""
        self.hypotheses = [replace(each, recognized=0.0) for each in self.hypotheses]

    def predict(
        self,
        seconds: float,
        velocity: ReportedVelocity | None = None,
        camera: CameraDisplacement | None = None,
        telemetry_noise: Array | None = None,
        overlap: float = 0.0,
    ) -> None:
        """By the reported velocity and odometry; `telemetry_noise` (3,): variances of heading
        (rad), log scale, horizon (rad), None: the model's. `overlap`: see `predicted`."""
        noise = self.model.telemetry_noise if telemetry_noise is None else telemetry_noise
        self._measured = None
        stays, moves = 1 - self.model.lost, (seconds, velocity, camera, noise, overlap)
        made = []
        for each in self.hypotheses:
            for share, expected in self._predictions(each, *moves):
                on_map = held_to_map(self.model, expected, self.area_m2)
                made.append(self._from(each, on_map, each.share * share * stays))
        singles = []
        for one in (self._last, self._against):
            if one is not None:
                _, expected = max(self._predictions(one, *moves), key=lambda split: split[0])
                one = self._from(one, held_to_map(self.model, expected, self.area_m2), 1)
            singles.append(one)
        self.hypotheses, (self._last, self._against), self._ground = made, singles, 1 - overlap
        self._is_split = True
        self.elsewhere += (1 - stays) * (1 - self.elsewhere)

    def _predictions(
        self,
        each: Hypothesis,
        seconds: float,
        velocity: ReportedVelocity | None,
        camera: CameraDisplacement | None,
        telemetry_noise: Array,
        overlap: float,
    ) -> Iterator[tuple[float, Expected]]:
        """With their probabilities: with odometry, which may be an outlier, and without.

        Where no velocity is reported, the aircraft may also have made an unexpected turn."""
        model, likely = self.model, 1 - self.model.odometry_outlier
        coasting = self._state in (State.COASTING, State.LOST)
        step = partial(predicted, model, each.mean, coasting=coasting, overlap=overlap)
        dead_reckoned = step(each.covariance, seconds, velocity, telemetry_noise)
        if camera is None:
            chance = 0.0
            if velocity is None and each.share >= MAJOR_SHARE:  # nothing measures the displacement
                chance = 1 - (1 - model.turn) ** seconds
                free = velocity_forgotten(model, each.covariance)
                yield chance, step(free, seconds, velocity, telemetry_noise)
            yield 1.0 - chance, dead_reckoned
            return
        # An outlier lies anywhere within the radius of the search.
        outlier = math.log(model.odometry_outlier / (math.pi * camera.reach_m**2))
        splits = [(outlier, dead_reckoned)]
        turns = [(likely, each.covariance)]
        if each.share < MINOR_SHARE:
            splits = []
        elif velocity is None:
            turns = [
                (likely * (1 - model.turn), each.covariance),
                (likely * model.turn, velocity_forgotten(model, each.covariance)),
            ]
        for share, covariance in turns:
            turned = step(covariance, seconds, velocity, telemetry_noise, camera)
            seen, log_fit = by_camera(turned, camera)
            splits.append((math.log(share) + log_fit, seen))
        best = max(log_share for log_share, _ in splits)
        shares = [math.exp(max(log_share - best, -700.0)) for log_share, _ in splits]
        for share, (_, expected) in zip(shares, splits, strict=True):
            if share > MIN_SPLIT * sum(shares):
                yield share / sum(shares), expected

    def update(
        self,
        reported: ReportedAttitude,
        sightings: Sequence[Sighting],
        newness: float = 1.0,
        searched: tuple[Array, float] | None = None,
        new_ground: float | None = None,
        *,
        confirms: bool = True,
    ) -> None:
        """Update with the places where a view may have been taken; all of them may be wrong.

        `searched`: middle (2,) and radius in metres; None: all of the map. `newness`: share that
        counts as new evidence, for views of the same ground have the same errors. `new_ground`:
        share that the last view did not show, which alone confirms a track; None: `newness`.
        `confirms`: whether these places competed with all others where the aircraft may be."""
        ground = newness if new_ground is None else new_ground
        starts = [
            replace(each, uncounted=min(each.uncounted + ground, 1.0)) for each in self.hypotheses
        ]
        made = [self._missed(each, newness, ground, searched) for each in starts]
        split = [one for each in starts for one in self._with_bias_jump(each)]
        found = (1 - self.model.miss) ** newness
        searched_m2 = self.area_m2 if searched is None else math.pi * searched[1] ** 2
        mounts = [(share, covariance) for share, _, covariance in self._mounts()]
        for each in sightings:
            areas_m2 = self.area_m2, searched_m2
            seen = tempered(self.model, mounts, areas_m2, reported, each, newness)
            made += self._updated(split, seen, found, ground, confirms)
            made += self._born(seen, confirms)
        self._merge(made, self.elsewhere)
        shown = bool(self.hypotheses) and self.hypotheses[0].recognized >= RECOGNIZED
        confirmed = self._state is not State.SEARCHING
        self._blind = self._blind + newness if confirmed and not shown else 0.0

    def _missed(
        self, each: Hypothesis, newness: float, ground: float, searched: tuple[Array, float] | None
    ) -> Hypothesis:
        """For which the view was taken at none of the places found; see `update`."""
        in_search = self._on_map(each.mean)
        if searched is not None:
            in_search &= math.dist(each.mean[:2], searched[0]) < searched[1]
        share = each.share
        if in_search:
            share *= self.model.miss ** (newness * (BLIND**self._blind if each.followed else 1.0))
        return replace(each, share=share, sighted=_forgotten(each.sighted, ground))

    def estimate(self, radius_m: float, *, between_views: bool = False) -> Estimate | None:
        """The best cluster, None without hypotheses. Updates the state, except `between_views`."""
        if not self.hypotheses:
            return None
        if self._is_split and not between_views:  # no update has followed the prediction
            self._merge(self.hypotheses, self.elsewhere)
        best = self._best(radius_m)
        near = [each for each in self.hypotheses if distance(each, best) <= radius_m]
        mean, covariance = moments(near)
        confidence = min(self._inside(radius_m, mean[POSITION]), 1.0)
        confirmed = max(each.sighted for each in major(near)) >= CONFIRMED
        seen, follows = self._recognized_at(mean, covariance, near), best.followed
        if not between_views:
            shown = confirmed and seen >= RECOGNIZED
            self._state = self._next_state(confidence, shown, best.followed)
            if self._state is State.TRACKING:
                self._follow(near)
                follows = True
                self._last = self._reached(mean, covariance)
            elif self._state is not State.COASTING:
                self._against = None
            elif self._shows_another(best, radius_m):
                self._restored = max(self._restored - self._ground, 0.0)
        belief = sum(each.share for each in near)
        most = 1.0 if self._state is State.TRACKING else UNCONFIRMED
        contradicted = self._last is not None and not self._last.followed
        place = min(belief, UNCONFIRMED if contradicted else most, 1.0)
        return Estimate(
            mean,
            covariance,
            min(confidence, place),
            place,
            self._state,
            belief,
            seen,
            confirmed,
            follows,
        )

    def _reached(self, mean: Array, covariance: Array) -> Hypothesis:
        """The state of the track, or, where its dead reckoning contradicts it, the dead-reckoned
        one with `followed=False`: until enough new ground is recognized in one place (`RESTORED`),
        without a loss of the track."""
        here = Hypothesis(1.0, mean, covariance, 0.0, 0, followed=True)
        last, against = self._last or here, self._against
        known = against is not None and _is_reached(here, against)
        self._restored = self._restored + self._ground if known else 0.0
        if _is_reached(here, last) or self._restored >= RESTORED:
            self._against = None
            return here
        self._against = here
        return replace(last, followed=False)

    def _shows_another(self, best: Hypothesis, radius_m: float) -> bool:
        """Whether this view shows the map farther away than `radius_m`."""
        shown = [each for each in major(self.hypotheses) if each.recognized >= RECOGNIZED]
        return any(distance(each, best) > radius_m for each in shown)

    def _recognized_at(self, mean: Array, covariance: Array, near: list[Hypothesis]) -> float:
        """Largest probability of having recognized the map, of hypotheses no farther away than it
        is certain and that contribute."""
        reach_m = RECOGNIZED_SIGMAS * math.sqrt(float(np.trace(covariance[POSITION, POSITION])) / 2)
        least = RECOGNIZED_SHARE * sum(each.share for each in near)
        return max(
            (
                each.recognized
                for each in near
                if each.share >= least and float(np.hypot(*(each.mean - mean)[POSITION])) <= reach_m
            ),
            default=0.0,
        )

    def _follow(self, near: list[Hypothesis]) -> None:
        numbers = {each.number for each in near}
        self.hypotheses = [
            replace(each, followed=True) if each.number in numbers else each
            for each in self.hypotheses
        ]

    @property
    def likeliest(self) -> Hypothesis | None:
        return self.hypotheses[0] if self.hypotheses else None

    def _best(self, radius_m: float) -> Hypothesis:
        """With the highest probability around it, of the eight most likely that count."""
        least = MINOR_OF_GROUP * self.hypotheses[0].share
        heaviest = [each for each in self.hypotheses[:8] if each.share >= least]
        return max(heaviest, key=lambda one: self._inside(radius_m, one.mean[POSITION]))

    def _inside(self, radius_m: float, middle: Array) -> float:
        """Of a place (2,)."""
        return sum(
            each.share * within(each.mean, each.covariance, radius_m, middle)
            for each in self.hypotheses
        )

    def bias(self) -> tuple[Array, Array]:
        """Errors of heading (rad), log scale, pitch and roll (rad) as reported: (4,) and (4, 4)."""
        if not self.hypotheses:
            _, covariance = self._nowhere()
            return np.zeros(4), (SEEN @ covariance @ SEEN.T)[2:, 2:]
        mean, covariance = moments(self.hypotheses)
        return (SEEN @ mean)[2:], (SEEN @ covariance @ SEEN.T)[2:, 2:]

    def _next_state(self, confidence: float, confirmed: bool, follows: bool) -> State:
        """`confirmed`: by this view and enough ground before. `follows`: the likeliest place
        descends from a confirmed track or a reported position; another one is no dead reckoning."""
        followed = self._state.is_followed
        if confirmed and confidence >= (LIKELY if followed and follows else CONFIDENT):
            return State.TRACKING
        if followed:
            return State.COASTING if follows and confidence >= LIKELY else State.LOST
        return self._state

    def _on_map(self, mean: Array) -> bool:
        inside = (mean[:2] >= self._extent[:2]) & (mean[:2] <= self._extent[2:])
        return bool(inside.all())

    def _with_bias_jump(self, each: Hypothesis) -> list[Hypothesis]:
        """Without and with a bias jump since the last view."""
        rare = self.model.bias_jump
        if each.expected is None or each.share < MINOR_SHARE:
            return [each]
        expected = after_bias_jump(self.model, each.expected)
        jumped = replace(
            each, mean=expected.mean, covariance=expected.covariance, expected=expected
        )
        if self._measured is not None:
            jumped = at_position(jumped, *self._measured)  # its likelihood is in the share already
        other = replace(jumped, share=each.share * rare)
        return [replace(each, share=each.share * (1 - rare)), other]

    def _updated(
        self,
        starts: Sequence[Hypothesis],
        seen: Measurement,
        found: float,
        ground: float,
        confirms: bool,
    ) -> Iterator[Hypothesis]:
        """After a measurement, without those for which it lies outside the gate. `found`:
        probability that a view is found. `ground`: share that the last view did not show."""
        near = [each for each in starts if self._is_near(each, seen)]
        if not near:
            return
        # All at once: each is small, and calls of NumPy take longer than what they compute.
        before = np.array([each.covariance for each in near])
        innovations = seen.mean - np.array([each.mean for each in near]) @ SEEN.T
        expected = SEEN @ before @ SEEN.T
        spreads = expected + seen.noise
        log_weights = (seen.log_odds + log_densities(innovations, spreads)).tolist()
        means, covariances = updated(np.array([each.mean for each in near]), before, seen)
        shown = recognition(seen, expected, innovations, self.model.most_agreement).tolist()
        for number, each in enumerate(near):
            sighted, uncounted = _forgotten(each.sighted, ground), each.uncounted
            if shown[number] >= RECOGNIZED:
                # Only of a track that was confirmed: chance has many views to agree with a new one.
                shown_anew = uncounted if each.followed else ground
                counted = confirmed_ground(seen.alone, shown_anew) if confirms else 0.0
                sighted = min(each.sighted + counted, MOST_SIGHTED)
                uncounted = 0.0 if counted else uncounted
            self._numbers += 1
            yield replace(
                each,
                share=each.share * math.exp(min(log_weights[number], 60.0)) * found,
                mean=means[number].copy(),  # a history of views must not keep them all
                covariance=covariances[number].copy(),
                sighted=sighted,
                uncounted=uncounted,
                number=self._numbers,
                recognized=shown[number],
            )

    @staticmethod
    def _is_near(each: Hypothesis, seen: Measurement) -> bool:
        variances = each.covariance[0, 0] + each.covariance[1, 1]
        reach = variances + seen.noise[0, 0] + seen.noise[1, 1]
        return bool(math.dist(seen.mean[:2], each.mean[:2]) ** 2 <= GATE * reach)

    def _nowhere(self, tilt_rad: float | None = None) -> tuple[Array, Array]:
        """Mean (16,) and covariance (16, 16), anywhere on the map."""
        place, speed, horizon = self.area_m2, self.model.speed_mps**2, self.model.horizon_rad**2
        values = [place, speed, *self.model.initial_bias(tilt_rad), horizon, 1.0]
        return np.zeros(STATE), np.diag(np.repeat(values, [2, 2, 1, 1, 1, 1, 2, 6]))

    def _mounts(self) -> Iterator[tuple[float, Array, Array]]:
        """Good and bad mount: probability, and a state anywhere on the map."""
        off = self.model.off_mount
        yield 1 - off, *self._nowhere()
        if off > 0:
            yield off, *self._nowhere(self.model.off_tilt_rad)

    def _born(self, seen: Measurement, confirms: bool) -> Iterator[Hypothesis]:
        """From the belief elsewhere, at a measurement."""
        for share, mean, covariance in self._mounts():
            spread = SEEN @ covariance @ SEEN.T + seen.noise
            log_weight = seen.log_odds - math.log(self.area_m2)
            log_weight += log_density(seen.mean[2:], spread[2:, 2:])
            mean, covariance = updated(mean, covariance, seen)
            share *= self.elsewhere * math.exp(min(log_weight, 60.0))
            self._numbers += 1
            yield Hypothesis(
                share,
                mean,
                covariance,
                sighted=confirmed_ground(seen.alone, 1.0) if confirms else 0.0,
                number=self._numbers,
                recognized=seen.alone,
                uncounted=0.0 if confirms else 1.0,
            )

    def _from(self, each: Hypothesis, expected: Expected, share: float) -> Hypothesis:
        self._numbers += 1
        mean, covariance = expected.mean, expected.covariance
        sighted = each.sighted
        if float(np.trace(covariance[POSITION, POSITION])) > 2 * self.model.wide_m**2:
            sighted *= FORGOTTEN
        return replace(
            each,
            share=share,
            mean=mean,
            covariance=covariance,
            sighted=sighted,
            number=self._numbers,
            parent=each.number,
            expected=expected,
            recognized=0.0,
        )

    def _merge(self, made: list[Hypothesis], elsewhere: float) -> None:
        left, elsewhere = _normalized(made, elsewhere)
        left = merged(sorted(left, key=lambda each: -each.share))
        self.hypotheses, self.elsewhere = _normalized(left, elsewhere)
        self._is_split = False


def _is_reached(here: Hypothesis, last: Hypothesis) -> bool:
    """Whether the aircraft can have come here by dead reckoning."""
    off, spread = (here.mean - last.mean)[POSITION], (last.covariance + here.covariance)[:2, :2]
    return bool(off @ np.linalg.solve(spread, off) < REACHED)


def _normalized(made: list[Hypothesis], elsewhere: float) -> tuple[list[Hypothesis], float]:
    total = sum(each.share for each in made) + elsewhere
    return [replace(each, share=each.share / total) for each in made], elsewhere / total


def _forgotten(sighted: float, ground: float) -> float:
    """After a view that does not show the map; `ground`: share that the last view did not show."""
    return sighted * float(UNRECOGNIZED**ground)
