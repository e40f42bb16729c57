"""The places of a view: refined from coarse to fine, and the best compared with its rivals.

Candidates are refined down to the mid level, most are dropped early. The best few are refined at
the final level: the view is orthorectified on the terrain under each pose and registered again
until it stays, or on flat ground where that is as good. Scores over those of the strongest rival
say how far the best place stands out."""

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, wraps
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthonav.core.localize.camera import approached
from orthonav.core.localize.confidence import Scores
from orthonav.core.localize.ground import ViewOverGround
from orthonav.core.localize.view import Orientation
from orthonav.core.register.refine import Fit, Refiner, sharpness
from orthonav.core.register.search import Peak, search_around
from orthonav.core.register.template import Levels, ViewTemplates
from orthonav.core.register.window import DirectionPrior, Pose, Reference

Given = TypeVar("Given")
Made = TypeVar("Made")
Step = Callable[["CandidateRefiner", Given], Made]


@dataclass(frozen=True)
class Refinement:
    """How many candidates go on, how far they are refined, and what is a rival.

    Sources: docs/decisions/registration.md, for places on a terrain docs/terrain.md."""

    to_mid_level: int = 200  # candidates that go on from the coarse level, at most,
    to_final_level: int = 3  # from the mid level: the best place and its rivals,
    to_finest: int = 12  # and, where they are in doubt, one level finer
    hope_at_first: float = 0.4
    hope: float = 0.5
    """Fractions of the best score to stay, after `first_steps` and after all steps."""
    min_hopeful: int = 4  # so many stay anyway: the scores need rivals
    first_steps: int = 1
    full_steps: int = 4
    covariance_steps: int = 3  # of the best place once more, with its covariance
    finer_steps: int = 2  # one level finer
    small_step_px: float = 0.1  # ends a refinement
    apart: float = 0.25  # least distance of a rival from the best, over the side of the view
    rival_on_terrain: float = 0.75
    """Rivals with less than this fraction of the best score are refined on flat ground: chance
    fits as well there, at half the cost."""
    moved_px: float = 1.0  # a window moved by more (px of the level) is orthorectified again,
    rounds: int = 3  # at most so often
    searched_around: int = 6  # places whose surroundings are searched on the terrain,
    reach_around: float = 0.2  # as far as this fraction of the side of the view,
    turns_around_rad: tuple[float, ...] = (-0.1, 0.0, 0.1)  # with these added to the heading
    scales_around: tuple[float, ...] = (-0.09, 0.0, 0.09)  # and to the log scale


REFINEMENT = Refinement()


@dataclass(frozen=True, eq=False)
class MidPlace:
    """A place where a view may have been taken, refined at the mid level.

    `flat_score`: on flat ground. `terrain`: the view orthorectified there, None: `fit` is on flat
    ground."""

    fit: Fit
    flat_score: float
    terrain: ViewTemplates | None = None

    @property
    def pose(self) -> Pose:
        return self.fit.pose


@dataclass(frozen=True, eq=False)
class FinalPlace:
    """A place refined at the final level.

    - `mid`: from which it was refined.
    - `fit`: by `templates`, those of flat ground or of the terrain.
    - `camera_pose`: that of `fit`, but with the height above the ground below the camera, not above
      that in the window.
    - `total`: scores of the mid and the final level. `score`: less the penalty of the prior.
    - `mid_score`: at the mid level on the terrain, `gain`: over that on flat ground; None: refined
      on flat ground.
    - `fine`: `score` and that one level finer, NaN: not compared there.
    - `camera`: under which the view fits better there, None: that of the telemetry."""

    mid: MidPlace
    fit: Fit
    camera_pose: Pose
    templates: ViewTemplates
    total: float
    score: float
    mid_score: float | None = None
    gain: float | None = None
    fine: float = math.nan
    camera: Orientation | None = None

    @property
    def window_pose(self) -> Pose:
        """With the height above the ground in the window."""
        return self.fit.pose


@dataclass(frozen=True, eq=False)
class BestPlace:
    """The best place, its fit with a covariance, and how far it stands out. `rivals`: the others,
    best first, near ones too, as strong as they are with the finer level where both were compared
    there."""

    place: FinalPlace
    scores: Scores
    rivals: tuple[FinalPlace, ...]


def once(step: "Step[Given, Made]") -> "Step[Given, Made]":
    """A step that depends on the place alone: its result is remembered for every place."""

    @wraps(step)
    def remembered(refiner: "CandidateRefiner", place: Given) -> Made:
        key = step.__name__, place
        if key not in refiner.remembered:
            refiner.remembered[key] = step(refiner, place)
        made: Made = refiner.remembered[key]
        return made

    return remembered


class CandidateRefiner:
    """Refines the places of one view, in one thread.

    Steps from a place to another one are marked `once`: what they find does not depend on which
    other places there are, or on what was asked before."""

    def __init__(
        self,
        templates: ViewTemplates,
        levels: Levels,
        prior: DirectionPrior,
        reference: Reference,
        *,
        pool: Executor | None = None,
        ground: ViewOverGround | None = None,
    ) -> None:
        """`pool` shares candidates; without `ground` it is flat, and no level is finer."""
        self.templates, self.levels, self.prior = templates, levels, prior
        self.reference, self._pool, self._ground = reference, pool, ground
        self.is_flat = ground is None or ground.ground.is_flat
        self.remembered: dict[tuple[str, Any], Any] = {}

    @property
    def _over_ground(self) -> ViewOverGround:
        assert self._ground is not None
        return self._ground

    @property
    def _exclusion_px(self) -> float:
        return REFINEMENT.apart * self.templates.side_px

    def _value(self, fit: Fit) -> float:
        """Score less the penalty of the prior."""
        return fit.score - self.prior.penalty_at(fit.pose)

    def refiner(self, level: int, templates: ViewTemplates | None = None) -> Refiner:
        made = self.levels.template(templates or self.templates, level)
        return Refiner(made, self.reference)

    def refined(self, pose: Pose, level: int, templates: ViewTemplates | None = None) -> Fit:
        refiner = self.refiner(level, templates)
        return refiner.place(pose, REFINEMENT.full_steps, REFINEMENT.small_step_px)

    def shared(self, function: Callable[[Given], Made], given: Sequence[Given]) -> list[Made]:
        """In order; by all threads, where there are some."""
        return list((self._pool.map if self._pool else map)(function, given))

    # At the mid level

    def to_mid_level(
        self, poses: Sequence[Pose], level: int, known: Sequence[MidPlace] = ()
    ) -> list[MidPlace]:
        """Candidates of a level refined down to the mid level, best first; the best `known` place
        counts too."""
        fits: list[Fit] = []
        for at in range(level, self.levels.mid - 1, -1):
            is_last = at == self.levels.mid
            fits = self._compared(self.refiner(at), poses, known if is_last else ())
            if not is_last:
                fits = fits[: min(self._hopeful(fits, REFINEMENT.hope), REFINEMENT.to_mid_level)]
            poses = [each.pose for each in fits]
        return [MidPlace(each, each.score) for each in fits]

    def at_mid_level(self, poses: Sequence[Pose]) -> list[MidPlace]:
        """Candidates of the final level, scored at the mid one, where refining would lose them."""
        refiner = self.refiner(self.levels.mid)
        fits = [refiner.place(each, 0) for each in poses]
        return [MidPlace(each, each.score) for each in fits]

    def best_and_rival(self, places: Sequence[MidPlace]) -> tuple[float, float]:
        """Scores of the best place and of its strongest rival, 0 for none."""
        values = [self._value(each.fit) for each in places]
        best = max(range(len(places)), key=lambda number: values[number])
        rivals = [
            value
            for value, each in zip(values, places, strict=True)
            if each.pose.distance_px(places[best].pose) > self._exclusion_px
        ]
        return values[best], max(rivals, default=0.0)

    def _compared(
        self, refiner: Refiner, poses: Sequence[Pose], known: Sequence[MidPlace]
    ) -> list[Fit]:
        """Best first; those without hope are refined only a little."""
        ranked = self._ranked(self._refined_all(refiner, poses, REFINEMENT.first_steps))
        least, at_least = 0.0, REFINEMENT.min_hopeful
        if known:
            least, at_least = REFINEMENT.hope * max(self._value(each.fit) for each in known), 1
        count = self._hopeful(ranked, REFINEMENT.hope_at_first, at_least, least)
        hopeful = self._refined_all(
            refiner, [each.pose for each in ranked[:count]], REFINEMENT.full_steps
        )
        return self._ranked(hopeful + ranked[count:])

    def _refined_all(self, refiner: Refiner, poses: Sequence[Pose], steps: int) -> list[Fit]:
        refiner.prepare()
        small_px = REFINEMENT.small_step_px
        return self.shared(lambda pose: refiner.place(pose, steps, small_px), poses)

    def _ranked(self, fits: Sequence[Fit]) -> list[Fit]:
        return sorted(fits, key=lambda each: -self._value(each))

    def _hopeful(
        self,
        ranked: Sequence[Fit],
        share: float,
        at_least: int = REFINEMENT.min_hopeful,
        least: float = 0.0,
    ) -> int:
        """How many fits, best first, reach `least` and a fraction of the best score."""
        values = [self._value(each) for each in ranked]
        enough = sum(value >= max(share * values[0], least) for value in values)
        return min(max(enough, at_least), len(ranked))

    def _best_apart(
        self, places: Sequence[MidPlace], count: int, apart_px: float
    ) -> list[MidPlace]:
        """The best `count` places, best first, farther apart than `apart_px`."""
        chosen: list[MidPlace] = []
        for each in sorted(places, key=lambda each: -self._value(each.fit)):
            if len(chosen) == count:
                break
            if all(each.pose.distance_px(other.pose) > apart_px for other in chosen):
                chosen.append(each)
        return chosen

    # On the terrain

    def on_terrain(self, places: Sequence[MidPlace], at_most: int) -> list[MidPlace]:
        """The best places that lie apart, on the terrain where they are better there; the first
        with their surroundings, for relief displaces more than refinement follows."""
        if self.is_flat:
            return list(places)
        apart_px = REFINEMENT.apart * self._over_ground.view.side_px
        moved = {
            each: self._twin(each) or each for each in self._best_apart(places, at_most, apart_px)
        }
        before = {after: each for each, after in moved.items()}
        for after in self._best_apart(list(before), REFINEMENT.searched_around, apart_px):
            moved[before[after]] = self._best_around(before[after]) or before[after]
        better = {a: b for a, b in moved.items() if b.fit.score > a.fit.score}
        return [better.get(each, each) for each in places]

    @once
    def _twin(self, place: MidPlace) -> MidPlace | None:
        """A place refined on the terrain; None where flat ground is as good."""
        pose = place.pose
        if self._over_ground.is_flat_at(pose):
            return None
        made = self._over_ground.templates_at(pose, self.levels.mid)
        if made is None:
            return None
        return MidPlace(self.refined(pose, self.levels.mid, made), place.fit.score, made)

    @once
    def _best_around(self, place: MidPlace) -> MidPlace | None:
        """`_twin`, or a better place by a search around it at the coarse level."""
        twin = self._twin(place)
        found = [] if twin is None else [twin, *self._found_around(place, twin)]
        return max(found, key=lambda each: each.fit.score, default=None)

    def _found_around(self, place: MidPlace, twin: MidPlace) -> Iterator[MidPlace]:
        assert twin.terrain is not None
        pose, scales = place.pose, self.prior.scale_map
        starts = [(pose, twin.terrain)]
        expected = scales.at(pose.x_px, pose.y_px) if scales else pose.log_scale
        # Flat ground may fit at another scale.
        if abs(expected - pose.log_scale) > max(REFINEMENT.scales_around):
            raised = replace(pose, log_scale=expected)
            made = self._over_ground.templates_at(raised, self.levels.mid)
            starts += [] if made is None else [(raised, made)]
        for start, templates in starts:
            for near in self._searched_around(start, templates):
                fit = self.refined(near.pose, self.levels.mid, templates)
                yield MidPlace(fit, place.fit.score, templates)

    def _searched_around(self, pose: Pose, templates: ViewTemplates) -> list[Peak]:
        """The best pose around another one at the coarse level."""
        side_px = self._over_ground.view.side_px
        directions = [
            (pose.heading_rad + turn, pose.log_scale + scale)
            for turn in REFINEMENT.turns_around_rad
            for scale in REFINEMENT.scales_around
        ]
        template = self.levels.template(templates, self.levels.coarse)
        where = (pose.x_px, pose.y_px), REFINEMENT.reach_around * side_px
        return search_around(
            template, self.reference, directions, *where, side_px, 1, self.prior.scale_map
        )

    # At the final level

    def best(
        self,
        places: Sequence[MidPlace],
        from_final: Sequence[MidPlace] = (),
        *,
        count: int = REFINEMENT.to_final_level,
        closer: bool = False,
    ) -> BestPlace:
        """Of the best `count` places, and all that were found at the final level, refined there;
        with `closer` the best of these as their houses show them and one level finer, where there
        is one."""
        apart = self._best_apart(places, count, self._exclusion_px)
        chosen = apart[: self._hopeful([each.fit for each in apart], REFINEMENT.hope, 2)]
        finalists = _best_first(self._to_final_level([*chosen, *from_final]))
        few = REFINEMENT.to_finest
        if closer and not self.is_flat and self._over_ground.ground.surface is not None:
            shown = [self._with_houses(each) for each in finalists[:few]]
            finalists = _best_first([*shown, *finalists[few:]])
        if closer and self.levels.final > 0:
            finalists = [self._compared_finer(each) for each in finalists[:few]]
            finalists.sort(key=lambda each: -each.fine)
        best, *others = finalists
        fit = self._with_covariance(best.window_pose, best.templates)
        pose = fit.pose if best.gain is None else self._over_ground.below_camera(fit.pose)
        return BestPlace(
            replace(best, fit=fit, camera_pose=pose),
            self._scores(finalists, [*places, *from_final]),
            tuple(replace(each, score=_weight(each, best)) for each in others),
        )

    def _to_final_level(self, places: Sequence[MidPlace]) -> list[FinalPlace]:
        """On the terrain, unless flat ground is as good, too little is known, or a place is far
        below the best one."""
        starts = [self._start(each) for each in places]
        best = max((start.fit.score for start in starts if start is not None), default=0.0)
        return [
            self._on_flat(place)
            if start is None or start.fit.score < REFINEMENT.rival_on_terrain * best
            else self._on_terrain(place)
            for place, start in zip(places, starts, strict=True)
        ]

    def _start(self, place: MidPlace) -> MidPlace | None:
        """Where a place is refined on the terrain; None: on flat ground."""
        if self.is_flat:
            return None
        return self._best_around(place) if place.terrain is None else self._twin(place)

    @once
    def _on_flat(self, place: MidPlace) -> FinalPlace:
        fit, total = place.fit, place.fit.score
        if self.levels.final != self.levels.mid:
            fit = self.refined(place.pose, self.levels.final)
            total = fit.score + self.refiner(self.levels.mid).place(fit.pose, 0).score
        score = total - self.prior.penalty_at(fit.pose)
        return FinalPlace(place, fit, fit.pose, self.templates, total, score)

    @once
    def _on_terrain(self, place: MidPlace) -> FinalPlace:
        final, start = self.levels.final, self._start(place)
        assert start is not None
        pose = start.pose
        for _ in range(REFINEMENT.rounds):
            made = self._over_ground.templates_at(pose, final)
            if made is None:
                return self._on_flat(place)
            fit = self.refined(pose, final, made)
            if self._over_ground.moved_px(pose, fit.pose) < REFINEMENT.moved_px * 2**final:
                break
            pose = fit.pose
        assert made is not None
        found = self._by_templates(place, fit, made)
        assert found.mid_score is not None
        if found.mid_score < place.flat_score:
            flat = self._on_flat(place)
            if flat.total > found.total:
                return flat
        return found

    def _by_templates(self, place: MidPlace, fit: Fit, templates: ViewTemplates) -> FinalPlace:
        """Refined by orthorectified templates."""
        mid_score = total = fit.score
        if self.levels.final != self.levels.mid:
            mid_score = self.refiner(self.levels.mid, templates).place(fit.pose, 0).score
            total += mid_score
        score, gain = (
            total - self.prior.penalty_at(fit.pose),
            mid_score / max(place.flat_score, 1e-6),
        )
        pose = self._over_ground.below_camera(fit.pose)
        return FinalPlace(place, fit, pose, templates, total, score, mid_score, gain)

    @once
    def _with_houses(self, place: FinalPlace) -> FinalPlace:
        """Under the camera that the picture shows there, not the reported one: among houses and
        trees that is the difference between the right place and chance."""
        pose, final = place.window_pose, self.levels.final
        camera = approached(self._over_ground, pose)
        made = None if camera is None else self._over_ground.templates_at(pose, final, camera)
        if made is None:
            return place
        under = self._by_templates(place.mid, self.refined(pose, final, made), made)
        if under.total > place.total:
            return replace(under, camera=camera)
        return replace(place, camera=camera) if final > 0 else place  # it may fit one level finer

    @once
    def _compared_finer(self, place: FinalPlace) -> FinalPlace:
        """One level finer than the final one."""
        finer, camera = self._finer_score(place, None), None
        if place.camera is not None:
            score = self._finer_score(place, place.camera)
            if score > finer:
                finer, camera = score, place.camera
        return replace(place, fine=place.score + finer, camera=camera)

    def _finer_score(self, place: FinalPlace, camera: Orientation | None) -> float:
        level, made = self.levels.final - 1, None
        if place.gain is not None or camera is not None:
            made = self._over_ground.templates_at(place.window_pose, level, camera)
        refiner = Refiner((made or self._finer_on_flat).at(level), self.reference)
        return refiner.place(place.window_pose, REFINEMENT.finer_steps).score

    @cached_property
    def _finer_on_flat(self) -> ViewTemplates:
        level = self.levels.final - 1
        made = self._over_ground.view.rectified_at(level)
        return ViewTemplates(made.grey, made.valid, level, self.templates.grey_share)

    def _with_covariance(self, pose: Pose, templates: ViewTemplates | None = None) -> Fit:
        """At the final level, once more."""
        refiner = self.refiner(self.levels.final, templates)
        return refiner.place(pose, REFINEMENT.covariance_steps, with_covariance=True)

    def covariance_at(self, pose: Pose) -> NDArray[np.float64]:
        """Of the fit (4, 4) near a pose, on flat ground."""
        found = self._with_covariance(pose).covariance
        assert found is not None
        return found

    def _scores(self, finalists: Sequence[FinalPlace], places: Sequence[MidPlace]) -> Scores:
        """Of the first finalist, among all places."""
        best, pose, penalty = finalists[0], finalists[0].window_pose, self.prior.penalty_at

        def is_far(other: Pose) -> bool:
            return other.distance_px(pose) > self._exclusion_px

        far = [each for each in finalists if is_far(each.window_pose)]
        others = [self._value(each.fit) for each in places if is_far(each.pose)]
        others += [
            each.mid_score - penalty(each.window_pose) for each in far if each.mid_score is not None
        ]
        if best.mid_score is None:
            # Of the place there: refined at the final level, it may be another candidate.
            nearest = min(places, key=lambda each: each.pose.distance_px(pose))
            mid_score = self._value(nearest.fit)
        else:
            mid_score = best.mid_score - penalty(pose)
        is_fine = not math.isnan(best.fine)
        detail = math.nan
        if self.levels.final != self.levels.mid:
            detail = max(best.fit.score, 1e-3) / max(best.total - best.fit.score, 1e-3)
        template = self.levels.template(best.templates, self.levels.final)
        return Scores(
            strength=best.score,
            rival=max((each.score for each in far), default=0.0),
            mid_score=mid_score,
            mid_rival=max(others, default=0.0),
            fine=best.fine,
            fine_rival=max((each.fine for each in far), default=0.0) if is_fine else math.nan,
            detail_ratio=detail,
            **sharpness(template, self.reference, pose)._asdict(),
        )


def _best_first(places: Sequence[FinalPlace]) -> list[FinalPlace]:
    return sorted(places, key=lambda each: -each.score)


def _weight(place: FinalPlace, best: FinalPlace) -> float:
    """At most as far below that of the best as with the finer level."""
    if math.isnan(place.fine) or best.fine <= 0:
        return place.score
    return min(place.score, best.score * place.fine / best.fine)
