"""The track: a mixture of hypotheses, each a Kalman filter, and the belief "elsewhere".

A view's true place may be the second best, or none of those found. So every hypothesis is split,
one for each place and one for none, weighted by likelihood (multiple hypothesis tracking, Reid
1979; a Gaussian sum filter, Sorenson and Alspach 1971). Unlikely ones are dropped, similar ones
merged. The rest is "elsewhere": 1 at the start, new hypotheses are born from it, and some returns
to it with every view, so that no error is permanent (docs/tracking.md)."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize.confidence import within
from orthonav.core.localize.odometry import CameraDisplacement
from orthonav.core.localize.sighting import Sighting
from orthonav.core.track.filter import (
    OBSERVES,
    POSITION,
    STATE,
    Array,
    Expected,
    Measurement,
    Model,
    Motion,
    ReportedAttitude,
    ReportedVelocity,
    after_bias_jump,
    by_camera,
    held_to_map,
    is_plausible,
    log_densities,
    log_density,
    observed,
    predicted,
    recognition,
    tempered,
    updated,
    velocity_forgotten,
)
from orthonav.core.track.hypothesis import (
    BLIND,
    EXACT_M,
    MINOR_OF_GROUP,
    UNCERTAIN,
    UNCONFIRMED,
    UNRECOGNIZED,
    Hypothesis,
    Shown,
    State,
    Trust,
    at_position,
    distance,
    major,
    merged,
    moments,
    moved,
)

MIN_SPLIT = 1e-5
"""Least share to be followed. Values without a source: by the flights of docs/tracking.md."""
MINOR_SHARE = 1e-4  # less likely hypotheses are not split for rare events,
MAJOR_SHARE = 0.05  # nor these without odometry, where hypotheses are not merged between views
START_SHARE = 0.9  # of a reported start position
SHOWN_SIGMAS = 1.5  # farther from the estimate, per axis, a view does not show the map there
SHOWN_SHARE = 0.1  # hypotheses with less of their cluster do not show where it is
GATE = 36.0  # largest squared innovation of the position over the trace of its covariance


@dataclass(frozen=True, eq=False)
class Estimate:
    """The best cluster of hypotheses. Its arrays are not to be changed.

    `confidence`: probability of being within the radius asked for; `place_probability`: however
    wide the cluster, and so no less. Both are limited except while tracking; `belief` is not.
    `shown`: what views showed there."""

    mean: Array
    covariance: Array
    confidence: float
    place_probability: float
    state: State
    belief: float
    shown: Shown


class _Cluster(NamedTuple):
    """Hypotheses near the best one, as one Gaussian. `inside`: probability within the radius."""

    near: list[Hypothesis]
    mean: Array
    covariance: Array
    shown: Shown
    inside: float


class Mixture:
    """The belief about one flight. Mutable; not to be shared between threads."""

    def __init__(
        self,
        model: Model,
        extent_en_m: tuple[float, float, float, float],
        area_m2: float = 0.0,
    ) -> None:
        """`extent_en_m`: west, south, east, north of the map. `area_m2`: where the aircraft may be,
        if that is more than the map."""
        self.model, self._least_m2 = model, area_m2
        self._set_extent(extent_en_m)
        self.hypotheses: list[Hypothesis] = []  # the likeliest first, unless split
        self._is_split = False  # by a prediction, and not merged since
        self.elsewhere = 1.0
        self.trust = Trust()
        self._numbers = 0
        self._new = 1.0  # fraction of this view that the last one did not show
        self._is_rival_searched = False  # for the place that contradicts the track
        self._measured: tuple[Array, Array] | None = None  # position since the last prediction

    def _set_extent(self, extent_en_m: tuple[float, float, float, float]) -> None:
        self._extent = np.array(extent_en_m)
        self.map_m2 = float(np.prod(self._extent[2:] - self._extent[:2]))
        self.area_m2 = max(self.map_m2, self._least_m2)

    def move(
        self, plane: LocalFrame, other: LocalFrame, extent_en_m: tuple[float, float, float, float]
    ) -> None:
        """Continue between two views in another plane, on a map of this extent there."""
        self.hypotheses = [moved(each, plane, other) for each in self.hypotheses]
        self.trust = self.trust.moved(lambda each: moved(each, plane, other))
        self._set_extent(extent_en_m)

    def start(self, mean_en_m: Array, std_m: float) -> None:
        """At a reported position (2,), `std_m` per axis."""
        self.hypotheses = list(self._born_at(mean_en_m, std_m, START_SHARE))
        self.elsewhere = 1 - START_SHARE
        self.trust.reported(self.hypotheses[0])

    def _born_at(self, mean_en_m: Array, std_m: float, share: float) -> Iterator[Hypothesis]:
        for mount, mean, covariance in self._mounts():
            mean[POSITION] = mean_en_m
            covariance[POSITION, POSITION] = np.eye(2) * std_m**2
            self._numbers += 1
            yield Hypothesis(share * mount, mean, covariance, Shown(followed=True), self._numbers)

    def measure_position(self, mean_en_m: Array, std_m: float) -> None:
        """By other means, such as GNSS, (2,), `std_m` per axis: they confirm what views show."""
        if not self.hypotheses:
            self.start(mean_en_m, std_m)
            return
        self._measured = mean_en_m, np.eye(2) * std_m**2
        made = [at_position(each, *self._measured) for each in self.hypotheses]
        # Belief elsewhere is spread over the map, or over a wider measurement: its density remains.
        elsewhere = self.elsewhere / max(self.area_m2, 2 * math.pi * std_m**2)
        made += self._born_at(mean_en_m, std_m, START_SHARE * elsewhere)
        made = [replace(each, shown=each.shown.confirmed()) for each in made]
        self._merge(made, elsewhere * (1 - START_SHARE))
        self.trust.reported(None)

    def unrecognize(self) -> None:
        """As if the last view had not shown the map anywhere."""
        self.hypotheses = [
            replace(each, shown=replace(each.shown, now=0.0)) for each in self.hypotheses
        ]

    def predict(
        self,
        seconds: float,
        velocity: ReportedVelocity | None = None,
        camera: CameraDisplacement | None = None,
        telemetry_noise: Array | None = None,
        overlap: float = 0.0,
    ) -> None:
        """By the reported velocity and odometry; `telemetry_noise` (3,): variances of heading
        (rad), log scale, horizon (rad), None: the model's. `overlap`: see `Motion`. An error leaves
        all as it was."""
        noise = self.model.telemetry_noise if telemetry_noise is None else telemetry_noise
        stays, motion = 1 - self.model.lost, Motion(seconds, velocity, camera, noise, overlap)
        made = [one for each in self.hypotheses for one in self._split(each, motion)]
        blind_s = seconds if camera is None else 0.0
        trust = self.trust.moved(lambda each: self._dead_reckoned(each, motion), blind_s)
        elsewhere = self.elsewhere
        if trust.rival is not None and trust.believed is not None:
            total = sum(each.share for each in made) + elsewhere
            followed = sum(each.share for each in made if each.shown.followed)
            added = max(1 - UNCONFIRMED - followed / total, 0.0)
            made = [replace(each, share=each.share * (1 - added)) for each in made]
            elsewhere *= 1 - added
            made.append(replace(trust.believed.place, share=total * added))
        made = [replace(each, share=each.share * stays) for each in made]
        self.hypotheses, self.trust, self._measured = made, trust, None
        self.elsewhere = elsewhere + (1 - stays) * (1 - elsewhere)
        self._new, self._is_rival_searched, self._is_split = 1 - overlap, False, True

    def _split(self, each: Hypothesis, motion: Motion) -> Iterator[Hypothesis]:
        for share, expected in self._predictions(each, motion):
            on_map = held_to_map(self.model, expected, self.area_m2)
            yield self._from(each, on_map, each.share * share)

    def _dead_reckoned(self, each: Hypothesis, motion: Motion) -> Hypothesis:
        """As one Gaussian: odometry that may be an outlier makes it less certain. What was shown
        there is forgotten as at any view, unless the dead reckoning is exact."""
        splits = list(self._split(replace(each, share=1.0), motion))
        mean, covariance = moments(splits)
        best = max(splits, key=lambda split: split.share)
        exact = float(np.trace(covariance[POSITION, POSITION])) <= 2 * EXACT_M**2
        shown = best.shown if exact else best.shown.missed(1 - motion.overlap)
        return replace(best, share=1.0, mean=mean, covariance=covariance, shown=shown)

    def _predictions(self, each: Hypothesis, motion: Motion) -> Iterator[tuple[float, Expected]]:
        """With their probabilities: with odometry, which may be an outlier, and without.

        Where no velocity is reported, the aircraft may also have made an unexpected turn."""
        model, likely = self.model, 1 - self.model.odometry_outlier
        camera, velocity, unseen = motion.camera, motion.velocity, motion._replace(camera=None)
        dead_reckoned = predicted(model, each.mean, each.covariance, unseen)
        turns, splits = [(likely, each.covariance)], []
        if each.share >= MINOR_SHARE and velocity is None:
            turns = [
                (likely * (1 - model.turn), each.covariance),
                (likely * model.turn, velocity_forgotten(model, each.covariance)),
            ]
        if camera is not None:
            for share, covariance in turns:
                turned = predicted(model, each.mean, covariance, motion)
                corrected, log_fit = by_camera(turned, camera)
                if is_plausible(model, corrected.mean, velocity):
                    splits.append((math.log(share) + log_fit, corrected))
        if camera is None or not splits:
            chance = 0.0
            if velocity is None and each.share >= MAJOR_SHARE:  # nothing measures the displacement
                chance = 1 - (1 - model.turn) ** motion.seconds
                free = velocity_forgotten(model, each.covariance)
                yield chance, predicted(model, each.mean, free, unseen)
            yield 1.0 - chance, dead_reckoned
            return
        # An outlier lies anywhere within the radius of the search.
        outlier = math.log(model.odometry_outlier / (math.pi * camera.reach_m**2))
        splits.append((outlier, dead_reckoned))
        best, _ = max(splits, key=lambda split: split[0])
        shares = [math.exp(max(log_share - best, -700.0)) for log_share, _ in splits]
        least = MIN_SPLIT * sum(shares) if each.share >= MINOR_SHARE else max(shares)
        for share, (_, expected) in zip(shares, splits, strict=True):
            if share >= least:
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
        new = newness if new_ground is None else new_ground
        made = [self._missed(each, newness, new, searched) for each in self.hypotheses]
        split = [one for each in self.hypotheses for one in self._with_bias_jump(each)]
        found = (1 - self.model.miss) ** newness
        searched_m2 = self.area_m2 if searched is None else math.pi * searched[1] ** 2
        mounts = [(share, covariance) for share, _, covariance in self._mounts()]
        for each in sightings:
            areas_m2 = self.area_m2, searched_m2
            measured = tempered(self.model, mounts, areas_m2, reported, each, newness)
            made += self._updated(split, measured, found, new, confirms)
            made += self._born(measured, confirms)
        self._merge(made, self.elsewhere)
        rival = self.trust.rival
        self._is_rival_searched = rival is not None and self._is_searched(rival.place, searched)
        self.trust.viewed(newness, shown=bool(self.hypotheses) and self.hypotheses[0].shown.is_now)

    def _missed(
        self, each: Hypothesis, newness: float, new: float, searched: tuple[Array, float] | None
    ) -> Hypothesis:
        """For which the view was taken at none of the places found; see `update`."""
        share = each.share
        if self._is_searched(each, searched):
            blind = BLIND**self.trust.unseen if each.shown.followed else 1.0
            share *= self.model.miss ** (newness * blind)
        return replace(each, share=share, shown=each.shown.missed(new))

    def _is_searched(self, each: Hypothesis, searched: tuple[Array, float] | None) -> bool:
        near = searched is None or math.dist(each.mean[POSITION], searched[0]) < searched[1]
        return near and self._on_map(each.mean)

    def estimate(self, radius_m: float) -> Estimate | None:
        """The best cluster, None without hypotheses. Changes nothing."""
        cluster = self._cluster(radius_m)
        return None if cluster is None else self._stated(cluster)

    def conclude(self, radius_m: float) -> Estimate | None:
        """End a view, with or without an update: judge the best cluster, and return it."""
        if self._is_split:  # no update has followed the prediction
            self._merge(self.hypotheses, self.elsewhere)
        cluster = self._cluster(radius_m)
        if cluster is None:
            return None
        here = Hypothesis(1.0, cluster.mean, cluster.covariance, cluster.shown, 0)
        self.trust.judge(here, cluster.inside, self._new, self._missed_by_rival(radius_m))
        if self.trust.state is State.TRACKING:
            self._follow(cluster.near)
            cluster = cluster._replace(shown=replace(cluster.shown, followed=True))
        return self._stated(cluster)

    def _cluster(self, radius_m: float) -> _Cluster | None:
        if not self.hypotheses:
            return None
        best = self._best(radius_m)
        near = [each for each in self.hypotheses if distance(each, best) <= radius_m]
        mean, covariance = moments(near)
        shown = replace(
            best.shown,
            ground=max(each.shown.ground for each in major(near)),
            now=self._shown_at(mean, covariance, near),
        )
        inside = min(self._inside(radius_m, mean[POSITION]), 1.0)
        return _Cluster(near, mean, covariance, shown, inside)

    def _stated(self, cluster: _Cluster) -> Estimate:
        """As far as the track is believed."""
        near, mean, covariance, shown, inside = cluster
        belief = sum(each.share for each in near)
        place, state = min(belief, self.trust.most), self.trust.state
        return Estimate(mean, covariance, min(inside, place), place, state, belief, shown)

    def _missed_by_rival(self, radius_m: float) -> float:
        """New ground of this view that counts against the rival: less where it shows nothing than
        where it shows the map farther away than `radius_m`."""
        rival = self.trust.rival
        if rival is None or not self._is_rival_searched:
            return 0.0
        shown = [each for each in major(self.hypotheses) if each.shown.is_now]
        another = any(distance(each, rival.place) > radius_m for each in shown)
        return self._new * (1.0 if another else UNRECOGNIZED)

    def _shown_at(self, mean: Array, covariance: Array, near: list[Hypothesis]) -> float:
        """Largest probability of having recognized the map, of hypotheses no farther away than it
        is certain and that contribute."""
        reach_m = SHOWN_SIGMAS * math.sqrt(float(np.trace(covariance[POSITION, POSITION])) / 2)
        least = SHOWN_SHARE * sum(each.share for each in near)
        return max(
            (
                each.shown.now
                for each in near
                if each.share >= least and float(np.hypot(*(each.mean - mean)[POSITION])) <= reach_m
            ),
            default=0.0,
        )

    def _follow(self, near: list[Hypothesis]) -> None:
        numbers = {each.number for each in near}
        self.hypotheses = [
            replace(each, shown=replace(each.shown, followed=True))
            if each.number in numbers
            else each
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
            return np.zeros(4), observed(covariance)[2:, 2:]
        mean, covariance = moments(self.hypotheses)
        return (OBSERVES @ mean)[2:], observed(covariance)[2:, 2:]

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
        measured: Measurement,
        found: float,
        new: float,
        confirms: bool,
    ) -> Iterator[Hypothesis]:
        """After a measurement, without those for which it lies outside the gate. `found`:
        probability that a view is found. `new`: fraction that the last view did not show."""
        near = [each for each in starts if self._is_near(each, measured)]
        if not near:
            return
        # All at once: each is small, and calls of NumPy take longer than what they compute.
        before = np.array([each.covariance for each in near])
        innovations = measured.mean - np.array([each.mean for each in near]) @ OBSERVES.T
        expected = observed(before)
        spreads = expected + measured.noise
        log_weights = (measured.log_odds + log_densities(innovations, spreads)).tolist()
        means, covariances = updated(np.array([each.mean for each in near]), before, measured)
        shown = recognition(measured, expected, innovations, self.model.most_agreement).tolist()
        for number, each in enumerate(near):
            self._numbers += 1
            yield replace(
                each,
                share=each.share * math.exp(min(log_weights[number], 60.0)) * found,
                mean=means[number].copy(),  # a history of views must not keep them all
                covariance=covariances[number].copy(),
                shown=each.shown.recognized(
                    shown[number], measured.single_view_probability, new, competed=confirms
                ),
                number=self._numbers,
            )

    @staticmethod
    def _is_near(each: Hypothesis, measured: Measurement) -> bool:
        variances = each.covariance[0, 0] + each.covariance[1, 1]
        reach = variances + measured.noise[0, 0] + measured.noise[1, 1]
        return bool(math.dist(measured.mean[:2], each.mean[:2]) ** 2 <= GATE * reach)

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

    def _born(self, measured: Measurement, confirms: bool) -> Iterator[Hypothesis]:
        """From the belief elsewhere, at a measurement."""
        for share, mean, covariance in self._mounts():
            spread = observed(covariance) + measured.noise
            log_weight = measured.log_odds - math.log(self.area_m2)
            log_weight += log_density(measured.mean[2:], spread[2:, 2:])
            mean, covariance = updated(mean, covariance, measured)
            share *= self.elsewhere * math.exp(min(log_weight, 60.0))
            self._numbers += 1
            alone = measured.single_view_probability
            shown = Shown().recognized(alone, alone, 1.0, competed=confirms)
            yield Hypothesis(share, mean, covariance, shown, self._numbers)

    def _from(self, each: Hypothesis, expected: Expected, share: float) -> Hypothesis:
        self._numbers += 1
        mean, covariance = expected.mean, expected.covariance
        uncertain = float(np.trace(covariance[POSITION, POSITION])) > 2 * self.model.wide_m**2
        ground = each.shown.ground * (UNCERTAIN if uncertain else 1.0)
        return replace(
            each,
            share=share,
            mean=mean,
            covariance=covariance,
            shown=replace(each.shown, ground=ground, now=0.0),
            number=self._numbers,
            parent=each.number,
            expected=expected,
        )

    def _merge(self, made: list[Hypothesis], elsewhere: float) -> None:
        left, elsewhere = _normalized(made, elsewhere)
        left = merged(sorted(left, key=lambda each: -each.share))
        self.hypotheses, self.elsewhere = _normalized(left, elsewhere)
        self._is_split = False


def _normalized(made: list[Hypothesis], elsewhere: float) -> tuple[list[Hypothesis], float]:
    total = sum(each.share for each in made) + elsewhere
    return [replace(each, share=each.share / total) for each in made], elsewhere / total
