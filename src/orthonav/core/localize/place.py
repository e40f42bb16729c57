"""The places of a view: judged, placed on the terrain, finished, and compared with their rivals.

Candidates are refined from coarse to fine, most are dropped early. The best few are finished: the
view is orthorectified on the terrain under each pose and registered again until it stays, or on
level ground where that is as good. Scores over those of the strongest rival say how far it stands
out."""

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from orthonav.core.localize.camera import approached
from orthonav.core.localize.ground import ViewOverGround
from orthonav.core.localize.rectify import Orientation
from orthonav.core.register.pose import Pose, PosePrior
from orthonav.core.register.refine import Fit, Refiner
from orthonav.core.register.search import SearchWindows, largest_half_px, search
from orthonav.core.register.sharpness import sharpness
from orthonav.core.register.template import Levels, ViewTemplates
from orthonav.core.register.window import Reference

KEPT_TO_JUDGED = 200
"""From the coarse level to the judged one, at most (docs/decisions/registration.md)."""
KEPT_TO_FINISH = 3  # the best and its rivals
KEPT_TO_FINEST = 12  # compared one level finer, at most, where they are in doubt
HOPE_AT_FIRST = 0.4
HOPE = 0.5
"""Fractions of the best score to stay, after one step and all (docs/decisions/registration.md)."""
MIN_HOPEFUL = 4  # so many stay anyway: the scores need rivals
FIRST_STEPS = 1
FULL_STEPS = 4  # before and after the first of these decisions
COVARIANCE_STEPS = 3  # of the best place once more, with its covariance
FINER_STEPS = 2
ROUGH_STEP_PX = 0.1
EXCLUSION_SHARE = 0.25  # A rival lies farther from the best than this fraction of the view's side
MAX_RATIO = 10.0
RIVAL_SHARE = 0.75
"""Weaker ones are finished on level ground: chance fits as well there, at half the cost."""
AGAIN_PX = 1.0  # A window moved by more (pixels of the level, at its rim) is orthorectified again,
ROUNDS = 3  # at most so often
AROUND = 6  # places whose surroundings are searched on the terrain, where none stands out,
NEAR_REACH = 0.2  # as a fraction of the view's side,
NEAR_TURNS_RAD, NEAR_SCALES = (-0.1, 0.0, 0.1), (-0.09, 0.0, 0.09)
"""and with these added to heading and log scale."""
Given = TypeVar("Given")
Made = TypeVar("Made")


@dataclass(eq=False)
class Place:
    """A place where a view may have been taken, and what is known of it so far.

    - `judged`: its fit at the judged level; `level_score`: on level ground, where `judged` is on
      the terrain; `terrain`: the view orthorectified there.
    - `twin`: the same on the terrain, `around`: the best around it there; None: level ground is as
      good, or not asked for (`tried`, `searched`).
    - `final`: its fit at the final level, by `templates`; with covariance for the best.
    - `total`: scores of both levels added. `again`: the judged one after finishing on the terrain,
      `gain`: over the one on level ground; None: finished there.
    - `score`: `total` less the cost of its prior. `finer`: one level finer, NaN: not needed;
      `fine`: sum.
    - `camera`: under which it fits better there, None: that of the telemetry; `seen`: sought.
    - `scores`: of the best place, see `docs/reference/formats.md`. `rivals`: other finished places,
      best first, near ones too.
    - `below_camera`: the pose with the height counted from the ground below the camera."""

    judged: Fit
    level_score: float | None = None
    terrain: ViewTemplates | None = None
    twin: "Place | None" = None
    around: "Place | None" = None
    tried: bool = False
    searched: bool = False
    final: Fit | None = None
    templates: ViewTemplates | None = None
    total: float = math.nan
    again: float | None = None
    gain: float | None = None
    score: float = math.nan
    finer: float = math.nan
    fine: float = math.nan
    camera: Orientation | None = None
    seen: bool = False
    scores: dict[str, float] = field(default_factory=dict)
    rivals: tuple["Place", ...] = ()
    below_camera: Pose | None = None

    @property
    def fit(self) -> Fit:
        return self.final or self.judged

    @property
    def pose(self) -> Pose:
        """With the height counted from the ground below the camera."""
        return self.below_camera or self.fit.pose

    def apart_px(self, other: "Place") -> float:
        """In pixels of level 0."""
        return self.fit.pose.distance_px(other.fit.pose)


class Placer:
    """Judges and finishes the places of one view, in one thread."""

    def __init__(
        self,
        templates: ViewTemplates,
        levels: Levels,
        prior: PosePrior,
        reference: Reference,
        *,
        pool: Executor | None = None,
        ground: ViewOverGround | None = None,
    ) -> None:
        """`pool` shares candidates; without `ground` it is level, and no level is finer."""
        self.templates, self.levels, self.prior = templates, levels, prior
        self.reference, self._pool, self._view_over_ground = reference, pool, ground
        self.is_level = ground is None or ground.relief.is_level
        self._best_on_terrain = 0.0

    @property
    def _ground(self) -> ViewOverGround:
        assert self._view_over_ground is not None
        return self._view_over_ground

    @property
    def _has_houses(self) -> bool:
        return not self.is_level and self._ground.relief.surface is not None

    @property
    def _exclusion_px(self) -> float:
        return EXCLUSION_SHARE * self.templates.side_px

    def _value(self, fit: Fit) -> float:
        """Less the cost of its prior."""
        return fit.score - self.prior.cost(fit.pose)

    def refiner(self, level: int, templates: ViewTemplates | None = None) -> Refiner:
        made = (templates or self.templates).at(level, self.levels.recipe(level))
        return Refiner(made, self.reference)

    def shared(self, function: Callable[[Given], Made], given: Sequence[Given]) -> list[Made]:
        """In order; by all threads, where there are some."""
        return list((self._pool.map if self._pool else map)(function, given))

    # Judging

    def judge(self, poses: Sequence[Pose], level: int, known: Sequence[Place] = ()) -> list[Place]:
        """Refined down to the judged level, best first; the best `known` place counts too."""
        fits: list[Fit] = []
        for at in range(level, self.levels.judged - 1, -1):
            is_last = at == self.levels.judged
            fits = self._compared(self.refiner(at), poses, known if is_last else ())
            if not is_last:
                fits = fits[: min(self._hopeful(fits, HOPE), KEPT_TO_JUDGED)]
            poses = [each.pose for each in fits]
        return [Place(each) for each in fits]

    def direct(self, poses: Sequence[Pose]) -> list[Place]:
        """Found at the final level, scored at the judged one: refined there they would be lost."""
        refiner = self.refiner(self.levels.judged)
        return [Place(refiner.place(each, 0)) for each in poses]

    def standing(self, places: Sequence[Place]) -> tuple[float, float]:
        """Of the best judged place, and of its strongest rival."""
        values = [self._value(each.judged) for each in places]
        best = max(range(len(places)), key=lambda number: values[number])
        middle = places[best].judged.pose
        rivals = [
            value
            for value, each in zip(values, places, strict=True)
            if each.judged.pose.distance_px(middle) > self._exclusion_px
        ]
        return values[best], max(rivals, default=0.0)

    def _compared(
        self, refiner: Refiner, poses: Sequence[Pose], known: Sequence[Place]
    ) -> list[Fit]:
        """Best first; those without hope are refined only a little."""
        ranked = self._ranked(self._refined_all(refiner, poses, FIRST_STEPS))
        least, at_least = 0.0, MIN_HOPEFUL
        if known:
            least, at_least = HOPE * max(self._value(each.judged) for each in known), 1
        count = self._hopeful(ranked, HOPE_AT_FIRST, at_least, least)
        hopeful = [each.pose for each in ranked[:count]]
        return self._ranked(self._refined_all(refiner, hopeful, FULL_STEPS) + ranked[count:])

    def _refined_all(self, refiner: Refiner, poses: Sequence[Pose], steps: int) -> list[Fit]:
        refiner.prepare()
        return self.shared(lambda pose: refiner.place(pose, steps, ROUGH_STEP_PX), poses)

    def _ranked(self, fits: Sequence[Fit]) -> list[Fit]:
        return sorted(fits, key=lambda each: -self._value(each))

    def _hopeful(
        self, ranked: Sequence[Fit], share: float, at_least: int = MIN_HOPEFUL, least: float = 0.0
    ) -> int:
        """How many fits, best first, reach `least` and a fraction of the best score."""
        values = [self._value(each) for each in ranked]
        enough = sum(value >= max(share * values[0], least) for value in values)
        return min(max(enough, at_least), len(ranked))

    def _apart(self, ranked: Sequence[Fit], apart_px: float, count: int) -> list[int]:
        """Numbers of the first `count` fits that are farther apart."""
        chosen: list[int] = []
        for number, each in enumerate(ranked):
            if len(chosen) == count:
                break
            if all(each.pose.distance_px(ranked[other].pose) > apart_px for other in chosen):
                chosen.append(number)
        return chosen

    # On the terrain

    def on_terrain(self, places: Sequence[Place], at_most: int) -> list[Place]:
        """The best judged places that lie apart, on the terrain where they are better there; the
        first `AROUND` with their surroundings, for relief displaces more than refinement follows.
        """
        if self.is_level:
            return list(places)
        chosen = self._best_apart(places, at_most)
        moved = [self._twin(places[number]) or places[number] for number in chosen]
        for number in self._best_apart(moved, AROUND):
            before = places[chosen[number]]
            moved[number] = self._best_around(before) or before
        found = list(places)
        for number, after in zip(chosen, moved, strict=True):
            if after.judged.score > places[number].judged.score:
                found[number] = after
        return found

    def _best_apart(self, places: Sequence[Place], count: int) -> list[int]:
        order = sorted(range(len(places)), key=lambda number: -self._value(places[number].judged))
        ranked = [places[number].judged for number in order]
        apart_px = EXCLUSION_SHARE * self._ground.view.side_px
        return [order[number] for number in self._apart(ranked, apart_px, count)]

    def _twin(self, place: Place) -> Place | None:
        """A place refined on the terrain, once; None where level ground is as good."""
        if not place.tried:
            place.tried, pose = True, place.judged.pose
            if not self._ground.is_level(pose):
                made = self._ground.templates_at(pose, self.levels.judged)
                if made is not None:
                    place.twin = Place(self._rejudged(pose, made), place.judged.score, made)
        return place.twin

    def _rejudged(self, pose: Pose, templates: ViewTemplates) -> Fit:
        refiner = self.refiner(self.levels.judged, templates)
        return refiner.place(pose, FULL_STEPS, ROUGH_STEP_PX)

    def _best_around(self, place: Place) -> Place | None:
        """`_twin`, or a better place by a search around it at the coarse level."""
        twin = self._twin(place)
        if twin is None or place.searched:
            return place.around
        assert twin.terrain is not None
        place.searched, pose = True, place.judged.pose
        starts, scales = [(pose, twin.terrain)], self.prior.scale_map
        expected = scales.at(pose.x_px, pose.y_px) if scales else pose.log_scale
        if abs(expected - pose.log_scale) > max(NEAR_SCALES):  # level ground may fit at another
            raised = replace(pose, log_scale=expected)
            made = self._ground.templates_at(raised, self.levels.judged)
            starts += [] if made is None else [(raised, made)]
        found = [
            Place(fit, place.judged.score, made)
            for start, made in starts
            for fit in self._around(start, made)
        ]
        place.around = max([twin, *found], key=lambda each: each.judged.score)
        return place.around

    def _around(self, pose: Pose, templates: ViewTemplates) -> Iterator[Fit]:
        """By a search around a pose at the coarse level."""
        level, side_px = self.levels.coarse, self._ground.view.side_px
        poses = [
            (pose.turn_rad + turn, pose.log_scale + scale)
            for turn in NEAR_TURNS_RAD
            for scale in NEAR_SCALES
        ]
        recipe = self.levels.recipe(level)
        template = templates.at(level, recipe)
        middle, half_px = (pose.x_px, pose.y_px), largest_half_px(template, poses)
        windows, reach_px = SearchWindows(self.reference), NEAR_REACH * side_px
        window = windows.part(level, recipe, side_px, middle, reach_px, half_px)
        for near in search(template, window, poses, 1, self.prior.scale_map):
            yield self._rejudged(near.pose, templates)

    # Finishing

    def finished(
        self,
        places: Sequence[Place],
        candidates: int,
        direct: Sequence[Place] = (),
        *,
        kept: int = KEPT_TO_FINISH,
        closer: bool = False,
    ) -> Place:
        """The best of judged places, found by searches of `candidates` in all: the best `kept` and
        all `direct` ones at the final level, with `closer` the best `KEPT_TO_FINEST` one level
        finer, where there is one, and as their houses show them."""
        ranked = sorted(places, key=lambda each: -self._value(each.judged))
        chosen = self._apart([each.judged for each in ranked], self._exclusion_px, kept)
        apart = [ranked[number] for number in chosen]
        finalists = apart[: self._hopeful([each.judged for each in apart], HOPE, 2)]
        finalists += direct
        for each in finalists:
            self._finish(each)
        finalists.sort(key=lambda each: -each.score)
        if closer and self._has_houses:
            for each in finalists[:KEPT_TO_FINEST]:
                self._see_houses(each)
            finalists.sort(key=lambda each: -each.score)
        if closer and self.levels.final > 0:
            finalists = [
                replace(each, fine=each.score + self._finer_score(each))
                for each in finalists[:KEPT_TO_FINEST]
            ]
            finalists.sort(key=lambda each: -each.fine)
        best = finalists[0]
        final = self._with_covariance(best.fit.pose, best.templates)
        scores = self._scores(finalists, [*ranked, *direct], final)
        return replace(
            best,
            final=final,
            scores=scores | {"candidates": float(candidates)},
            rivals=tuple(replace(each, score=_weight(each, best)) for each in finalists[1:]),
        )

    def _finish(self, place: Place) -> None:
        """At the final level, once: on the terrain, unless level ground is as good, too little is
        known, or it is far below the best one before."""
        if place.final is not None:
            return
        first = None
        if not self.is_level:
            is_twin = place.level_score is not None
            first = self._twin(place) if is_twin else self._best_around(place)
        if first is None or first.judged.score < RIVAL_SHARE * self._best_on_terrain:
            self._finish_on_level(place)
        else:
            self._best_on_terrain = max(self._best_on_terrain, first.judged.score)
            self._finish_on_terrain(place, first.judged.pose)
        place.score = place.total - self.prior.cost(place.fit.pose)

    def _finish_on_level(self, place: Place) -> None:
        place.final, place.templates, place.total = place.judged, self.templates, place.judged.score
        place.again = place.gain = None
        if self.levels.final != self.levels.judged:
            place.final = self.refiner(self.levels.final).place(
                place.judged.pose, FULL_STEPS, ROUGH_STEP_PX
            )
            again = self.refiner(self.levels.judged).place(place.final.pose, 0)
            place.total = place.final.score + again.score

    def _finish_on_terrain(self, place: Place, pose: Pose) -> None:
        levels = self.levels
        for _ in range(ROUNDS):
            made = self._ground.templates_at(pose, levels.final)
            if made is None:
                self._finish_on_level(place)
                return
            final = self.refiner(levels.final, made).place(pose, FULL_STEPS, ROUGH_STEP_PX)
            if self._ground.moved_px(pose, final.pose) < AGAIN_PX * 2**levels.final:
                break
            pose = final.pose
        again, total = self._again(final, made)
        on_level = _on_level(place)
        if again < on_level:
            self._finish_on_level(place)
            if place.total > total:
                return
        place.final, place.templates, place.total, place.again = final, made, total, again
        place.gain = again / max(on_level, 1e-6)

    def _again(self, final: Fit, templates: ViewTemplates | None) -> tuple[float, float]:
        """Score at the judged level of a fit at the final one, and both added."""
        levels = self.levels
        if levels.final == levels.judged:
            return final.score, final.score
        again = self.refiner(levels.judged, templates).place(final.pose, 0).score
        return again, final.score + again

    def _see_houses(self, place: Place) -> None:
        """Once, under the camera that the picture shows there, not the reported one: among houses
        and trees that is the difference between the right place and chance."""
        if place.seen:
            return
        place.seen, pose, levels = True, place.fit.pose, self.levels
        camera = approached(self._ground, self.reference, pose)
        if camera is None:
            return
        made = self._ground.templates_at(pose, levels.final, camera)
        if made is None:
            return
        final = self.refiner(levels.final, made).place(pose, FULL_STEPS, ROUGH_STEP_PX)
        again, total = self._again(final, made)
        if total > place.total or levels.final > 0:
            place.camera = camera  # one level finer it may fit even so
        if total > place.total:
            place.final, place.templates, place.total, place.again = final, made, total, again
            place.score = total - self.prior.cost(final.pose)
            place.gain = again / max(_on_level(place), 1e-6)

    def _finer_score(self, place: Place) -> float:
        """One level finer than the final one, once."""
        if math.isnan(place.finer):
            place.finer = self._finer_under(place, None)
            if place.camera is not None:
                score = self._finer_under(place, place.camera)
                if score > place.finer:
                    place.finer = score
                else:
                    place.camera = None
        return place.finer

    def _finer_under(self, place: Place, camera: Orientation | None) -> float:
        level, made = self.levels.final - 1, None
        if place.gain is not None or camera is not None:
            made = self._ground.templates_at(place.fit.pose, level, camera)
        refiner = Refiner((made or self._finer_on_level).at(level), self.reference)
        return refiner.place(place.fit.pose, FINER_STEPS).score

    @cached_property
    def _finer_on_level(self) -> ViewTemplates:
        level = self.levels.final - 1
        made = self._ground.view.rectified_at(level)
        return ViewTemplates(made.grey, made.valid, level, self.templates.grey_share)

    def _with_covariance(self, pose: Pose, templates: ViewTemplates | None = None) -> Fit:
        """At the final level, once more."""
        refiner = self.refiner(self.levels.final, templates)
        return refiner.place(pose, COVARIANCE_STEPS, with_covariance=True)

    def covariance_at(self, pose: Pose) -> NDArray[np.float64]:
        """Of the fit (4, 4) near a pose, on level ground."""
        found = self._with_covariance(pose).covariance
        assert found is not None
        return found

    def below_camera(self, best: Place) -> Place:
        """With heights, of its rivals too, counted from the ground below the camera."""
        for each in (best, *best.rivals):
            if each.gain is not None:
                each.below_camera = self._ground.below_camera(each.fit.pose)
        return best

    def _scores(
        self, finalists: Sequence[Place], judged: Sequence[Place], final: Fit
    ) -> dict[str, float]:
        """The numbers behind the first finished place, `final` with its covariance."""
        best, cost, fit = finalists[0], self.prior.cost, finalists[0].fit
        far = [each for each in finalists if each.apart_px(best) > self._exclusion_px]
        others = [
            self._value(each.judged)
            for each in judged
            if each.judged.pose.distance_px(fit.pose) > self._exclusion_px
        ]
        others += [each.again - cost(each.fit.pose) for each in far if each.again is not None]
        if best.again is None:
            # Of what was judged there: refined at the final level, it may be another candidate.
            nearest = min(judged, key=lambda each: each.judged.pose.distance_px(fit.pose))
            look = self._value(nearest.judged)
        else:
            look = best.again - cost(fit.pose)
        rival, look_rival = max((each.score for each in far), default=0.0), max(others, default=0.0)
        is_fine = not math.isnan(best.fine)
        detail = math.nan
        if self.levels.final != self.levels.judged:
            detail = max(fit.score, 1e-3) / max(best.total - fit.score, 1e-3)
        templates = best.templates or self.templates
        template = templates.at(self.levels.final, self.levels.recipe(self.levels.final))
        local = sharpness(template, self.reference, fit.pose)
        gradient, grey = final.correlations
        return {
            "score": final.weighted,
            "strength": best.score,
            "rival": rival,
            "look": look,
            "look_rival": look_rival,
            "fine": best.fine,
            "fine_rival": max((each.fine for each in far), default=0.0) if is_fine else math.nan,
            "peak_ratio": min(MAX_RATIO, best.score / max(rival, 1e-6)),
            "look_ratio": min(MAX_RATIO, look / max(look_rival, 1e-6)),
            "gradient_correlation": gradient,
            "grey_correlation": grey,
            "detail_ratio": detail,
            "local_ratio": local.ratio,
            "local_gradients": local.gradients,
            "local_phase": local.phase,
            "blocks_t": final.blocks_t,
            "agreement": final.agreement,
            "overlap": final.overlap,
        }


def _on_level(place: Place) -> float:
    """Its judged score on level ground."""
    return place.judged.score if place.level_score is None else place.level_score


def _weight(place: Place, best: Place) -> float:
    """At most as far below that of the best as with the finer level."""
    if math.isnan(place.fine) or best.fine <= 0:
        return place.score
    return min(place.score, best.score * place.fine / best.fine)
