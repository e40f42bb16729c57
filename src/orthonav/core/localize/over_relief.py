"""Registering a view on the ground as it is, at candidates that were found on level ground.

The view is orthorectified on the terrain under the pose of a candidate and registered again, until
it stays where it is.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

from orthonav.core.localize.camera import CameraFound, camera_found, tilt_std_deg
from orthonav.core.localize.ground import LevelTerrain, Relief, ReliefView
from orthonav.core.localize.view import PreparedView
from orthonav.core.register.pose import Pose
from orthonav.core.register.refine import Placed, Refiner
from orthonav.core.register.registrar import (
    EXCLUSION_SHARE,
    FULL_STEPS,
    ROUGH_STEP_PX,
    Finished,
    Registered,
    Registrar,
    apart_px,
)
from orthonav.core.register.search import largest_half_px, search
from orthonav.core.register.template import ViewTemplates

RIVAL_SHARE = 0.75
"""Candidates whose score on the terrain at the judged level is below this share of the best one are
finished on level ground: what fits by chance fits as well there, and it costs half."""
AGAIN_PX = 1.0
"""A window that moved by more (pixels of the level, at its rim) is orthorectified again."""
ROUNDS = 3
"""At most so many times at the final level."""
FINER_STEPS = 2
"""Steps of refinement of a finalist one level finer."""
SETTLED = 6
"""Places whose surroundings are searched on the terrain, where no place stands out."""
NEAR_REACH = 0.2
"""They are searched so far, as a share of the view's side,"""
NEAR_TURNS_RAD, NEAR_SCALES = (-0.1, 0.0, 0.1), (-0.09, 0.0, 0.09)
"""and under these headings and log scales around those of level ground."""


@dataclass(frozen=True)
class ViewedGround:
    """What a fix says of the ground: `middle_en_m`, that of the picture's middle, metres east and
    north; `gain`, score on the terrain over that on level ground, None without a terrain."""

    middle_en_m: tuple[float, float]
    gain: float | None


class ViewOnLevelGround:
    """One view on level ground. Not to be shared between threads."""

    is_level = True
    """Whether candidates stay as they were found; else they are placed again on the terrain."""

    def __init__(self, relief: Relief, registrar: Registrar, view: PreparedView) -> None:
        self.registrar, self.view = registrar, view
        self.seen = ReliefView(relief, view)
        self._finished: dict[Placed, Finished] = {}
        self._finer_scores: dict[Placed, float] = {}

    def finish(self, judged: Placed) -> Finished:
        """A judged candidate at the final level, made once."""
        if judged not in self._finished:
            self._finished[judged] = self._finish(judged)
        return self._finished[judged]

    def finer_score(self, finalist: Placed) -> float:
        """Score of a finalist one level finer than the final one, made once."""
        if finalist not in self._finer_scores:
            made = self._finer_templates(finalist)
            refiner = Refiner(made.at(made.finest), self.registrar.reference)
            self._finer_scores[finalist] = refiner.place(finalist.pose, FINER_STEPS).score
        return self._finer_scores[finalist]

    def placed_on_terrain(self, judged: list[Placed], at_most: int) -> list[Placed]:
        """Judged candidates, at most `at_most` of them placed again, where none stands out."""
        return judged

    def by_camera(self, found: Registered) -> Registered:
        """The places found, as poses of the view on level ground below the camera."""
        return found

    def viewed(self, found: Registered) -> ViewedGround | None:
        """What the middle of the picture shows at the best of the places `by_camera`; None where
        the ground is unknown."""
        pose = _window(found.placed)
        orientation = self.seen.orientation(pose)
        if orientation is None:
            return None
        return ViewedGround(self.seen.middle_en_m(orientation, pose), self._terrain_gain(pose))

    def camera(self, placed: Placed) -> CameraFound | None:
        """The camera of a place `by_camera` with its pitch and roll; None where the reported ones
        are exact or the view does not show them."""
        if tilt_std_deg(self.view.picture_at(self.view.levels.final).telemetry) == 0:
            return None
        seen, pose = self.seen, _window(placed)
        if math.isnan(seen.reference_m(pose)):  # it was placed on level ground
            seen = ReliefView(Relief(LevelTerrain(), seen.relief.grid), self.view)
        return camera_found(seen, self.registrar.reference, pose)

    def _terrain_gain(self, pose: Pose) -> float | None:
        return None

    def _finish(self, judged: Placed) -> Finished:
        return self.registrar.at_final(self.view.templates, self.view.levels, judged)

    def _finer_templates(self, finalist: Placed) -> ViewTemplates:
        """The templates of a finalist one level finer than the final one."""
        return self._finer_on_level

    @cached_property
    def _finer_on_level(self) -> ViewTemplates:
        level = self.view.levels.final - 1
        made = self.view.rectified_at(level)
        return ViewTemplates(made.grey, made.valid, level)


class ViewOverRelief(ViewOnLevelGround):
    """One view on the ground of a sheet. Not to be shared between threads.

    What a candidate is finished on depends on the best one before it; it is finished once.
    """

    def __init__(self, relief: Relief, registrar: Registrar, view: PreparedView) -> None:
        super().__init__(relief, registrar, view)
        self.is_level = relief.is_level
        # By the pose of a finalist: score on the terrain at the judged level over that on level
        # ground; None: finished on level ground.
        self._gains: dict[Pose, float | None] = {}
        self._best_look = 0.0
        self._level_scores: dict[Pose, float] = {}
        # Candidates of level ground on the terrain, and after a search around them.
        self._judged: dict[Pose, tuple[ViewTemplates, Placed] | None] = {}
        self._searched: dict[Pose, Placed] = {}

    def _finish(self, judged: Placed) -> Finished:
        """A judged candidate at the final level: on the terrain, or on level ground where that is
        as good, or where less than half of the ground is known."""
        known = judged.pose in self._level_scores
        first = self._judged_on_terrain(judged.pose) if known else self._settled(judged.pose)
        if first is None:
            return self._on_level_ground(judged)
        if first.score < RIVAL_SHARE * self._best_look:
            return self._on_level_ground(judged)
        self._best_look = max(self._best_look, first.score)
        found = self._placed(first.pose)
        if found is None or found.look is None:
            return self._on_level_ground(judged)
        on_level = self._level_scores.get(judged.pose, judged.score)
        if found.look < on_level:
            level = self._on_level_ground(judged)
            if level.total > found.total:
                return level
        self._gains[found.placed.pose] = found.look / max(on_level, 1e-6)
        return found

    def _on_level_ground(self, judged: Placed) -> Finished:
        made = super()._finish(judged)
        self._gains[made.placed.pose] = None
        return made

    def placed_on_terrain(self, judged: list[Placed], at_most: int) -> list[Placed]:
        """The best judged candidates that lie apart, at most `at_most`, on the terrain at the
        judged level, and the others as they were.

        The surroundings of the first `SETTLED` are searched: where relief displaces much, the right
        one may be far down the list of those on level ground, and off by more than refinement
        follows.
        """
        numbers = self._best_apart(judged)[:at_most]
        before = [judged[number] for number in numbers]
        placed = [self._judged_on_terrain(each.pose) or each for each in before]
        for number in self._best_apart(placed)[:SETTLED]:
            placed[number] = self._settled(before[number].pose) or before[number]
        found = list(judged)
        for number, on_level, after in zip(numbers, before, placed, strict=True):
            if after.score > on_level.score:
                self._level_scores[after.pose] = on_level.score
                found[number] = after
        return found

    def _best_apart(self, placed: list[Placed]) -> list[int]:
        """Numbers of the best places that lie apart."""
        prior, apart = self.view.prior, EXCLUSION_SHARE * self.view.side_px
        ranked = sorted(
            range(len(placed)), key=lambda n: prior.cost(placed[n].pose) - placed[n].score
        )
        chosen: list[int] = []
        for number in ranked:
            if all(apart_px(placed[number], placed[other]) > apart for other in chosen):
                chosen.append(number)
        return chosen

    def _judged_on_terrain(self, pose: Pose) -> Placed | None:
        """A pose refined on the terrain at the judged level; None where level ground is as good."""
        if pose not in self._judged:
            made = None
            if not self.seen.is_level(pose):
                made = self.seen.templates_at(pose, self.view.levels.look)
            self._judged[pose] = None if made is None else (made, self._refined(pose, made))
        found = self._judged[pose]
        return None if found is None else found[1]

    def _refined(self, pose: Pose, made: ViewTemplates) -> Placed:
        """A pose refined at the judged level."""
        levels = self.view.levels
        return self.registrar.refiner(made, levels, levels.look).place(
            pose, FULL_STEPS, ROUGH_STEP_PX
        )

    def _settled(self, pose: Pose) -> Placed | None:
        """`_judged_on_terrain`, or a better place by a search around it at the coarse level: far
        off nadir, relief displaces a view by more than refinement follows."""
        best, found = self._judged_on_terrain(pose), self._judged[pose]
        if best is None or found is None or pose in self._searched:
            return self._searched.get(pose)
        made, levels, side_px = found[0], self.view.levels, self.view.side_px
        recipe = levels.recipe(levels.coarse)
        poses = [
            (pose.turn_rad + turn, pose.log_scale + scale)
            for turn in NEAR_TURNS_RAD
            for scale in NEAR_SCALES
        ]
        template = made.at(levels.coarse, recipe)
        place, reach_px = (pose.x_px, pose.y_px), NEAR_REACH * side_px
        half_px = largest_half_px(template, poses)
        window = self.registrar.part_window(
            levels.coarse, recipe, side_px, place, reach_px, half_px
        )
        for near in search(template, window, poses, 1, self.view.prior.scale_map):
            best = max(best, self._refined(near.pose, made), key=lambda each: each.score)
        self._searched[pose] = best
        return best

    def _placed(self, pose: Pose) -> Finished | None:
        """A candidate refined on the terrain; None where too little of it is known."""
        levels, registrar = self.view.levels, self.registrar
        for _ in range(ROUNDS):
            seen = self.seen.templates_at(pose, levels.final)
            if seen is None:
                return None
            made = seen
            refiner = registrar.refiner(made, levels, levels.final)
            placed = refiner.place(pose, FULL_STEPS, ROUGH_STEP_PX)
            if self.seen.moved_px(pose, placed.pose) < AGAIN_PX * 2**levels.final:
                break
            pose = placed.pose
        if levels.final == levels.look:
            return Finished(placed.score, placed, made, placed.score)
        look = registrar.refiner(made, levels, levels.look).place(placed.pose, 0).score
        return Finished(placed.score + look, placed, made, look)

    def _finer_templates(self, finalist: Placed) -> ViewTemplates:
        made = None
        if self._gains.get(finalist.pose) is not None:
            made = self.seen.templates_at(finalist.pose, self.view.levels.final - 1)
        return super()._finer_templates(finalist) if made is None else made

    def by_camera(self, found: Registered) -> Registered:
        """The same, of a view on the terrain: heights are counted from the ground below the camera,
        and the camera of the pose is where it is."""
        finalists = tuple((score, self._by_camera(each)) for score, each in found.finalists)
        return replace(found, placed=self._by_camera(found.placed), finalists=finalists)

    def _terrain_gain(self, pose: Pose) -> float | None:
        return None if self.seen.relief.is_level else self._gain(pose) or 1.0

    def _by_camera(self, placed: Placed) -> Placed:
        if self._gain(placed.pose) is None:
            return placed
        return replace(placed, pose=self.seen.below_camera(placed.pose), window=placed.pose)

    def _gain(self, pose: Pose) -> float | None:
        """The gain of the finalist at a pose, which may have been refined once more; None where it
        was placed on level ground."""
        near = EXCLUSION_SHARE * self.view.side_px

        def apart(other: Pose) -> float:
            return math.hypot(pose.x_px - other.x_px, pose.y_px - other.y_px)

        nearest = min(self._gains, key=apart, default=None)
        return None if nearest is None or apart(nearest) > near else self._gains[nearest]


def _window(placed: Placed) -> Pose:
    """The pose whose height is counted from the mean ground of the window."""
    return placed.window or placed.pose
