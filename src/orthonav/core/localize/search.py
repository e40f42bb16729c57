"""The search for the place of one view: steps that find candidates, and when they are enough.

`policy` says what is tried and what it costs; each step finds candidates in its way, `place` judges
them. A search ends as soon as the best place stands out or is proven by its confidence."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.localize.camera import CameraFound, camera_found
from orthonav.core.localize.confidence import USUAL_CHANCES
from orthonav.core.localize.ground import SearchedSheet, ViewOverGround
from orthonav.core.localize.place import KEPT_TO_FINISH, Place, Placer
from orthonav.core.localize.policy import Budget, ClearMargin, Direction
from orthonav.core.localize.view import PreparedView
from orthonav.core.records import CONFIDENT, PRIOR_SIGMAS, NoFix, Prior
from orthonav.core.register.channels import SOUGHT_SHARE
from orthonav.core.register.pose import Pose, rotation
from orthonav.core.register.search import PLACES_AT_ONCE, Peak, best_near, largest_half_px, search
from orthonav.core.tiles.position import rows_within

SAME_PLACE_SHARE = 1 / 8  # closer candidates from tiles are one place
WHOLE_WINDOW_PX = 8_000_000
"""Up to so many pixels of the coarse level one window of the whole sheet is cut (12 bytes each)."""


@dataclass(frozen=True)
class Step(ABC):
    """One way to find candidates, at `level`; those of tiles are refined there first.

    `directions`: to try, of `whole` in all stages, which share the cost. `count`: at most."""

    search: "Search"
    level: int
    directions: list[Direction]
    count: int
    whole: int
    from_tiles = False

    @property
    def cost_ms(self) -> float:
        """Infinite where it is impossible."""
        return self.whole_cost_ms() * len(self.directions) / self.whole

    @abstractmethod
    def whole_cost_ms(self) -> float:
        """Of all stages."""

    @abstractmethod
    def run(self) -> list[Peak]:
        """Best first."""


class FftStep(Step):
    """The best places of the sheet, or of what the prior allows, at a level."""

    def whole_cost_ms(self) -> float:
        cost_ms = self.search.fft_ms(self.level, self.whole)
        if self.level > self.search.levels.coarse:
            cost_ms += self.search.costs.nearby_ms * self.count
        return cost_ms

    def run(self) -> list[Peak]:
        """The peaks of correlation; those of a far level at their best places near by."""
        made, view, level = self.search, self.search.view, self.level
        recipe = view.levels.recipe(level)
        template = made.sought.at(level, recipe)
        if made.prior is None:
            window = made.sheet.windows.whole(level, recipe, view.side_px)
        else:
            half_px = largest_half_px(template, self.directions)
            window = made.sheet.windows.part(
                level, recipe, view.side_px, made.middle_px, made.reach_px, half_px
            )
        # Every thread has memory for a whole window.
        fits = math.prod(window.size) * made.plan.threads <= made.costs.max_search_px
        pool = made.sheet.pool if fits else None
        found = search(template, window, self.directions, self.count, view.prior.scale_map, pool)
        if level > view.levels.coarse:
            return made.allowed_nearby(found, made.policy.far_reach_px * 2**level)
        return made.promising(found)


class TileStep(Step):
    """The most similar tiles, each at its best place near by."""

    from_tiles = True

    def whole_cost_ms(self) -> float:
        made = self.search
        assert made.sheet.propose is not None
        tiles, dims = made.tiles, made.sheet.propose.embedder.dims
        return made.costs.tiles_ms(self.whole, tiles, dims) + made.costs.nearby_ms * self.count

    def run(self) -> list[Peak]:
        """Those that no tile next to them exceeds."""
        made, grid = self.search, self.search.sheet.grid
        assert made.sheet.propose is not None
        # Over a terrain the telemetry predicts another scale at every place.
        expected = made.view.prior
        if expected.scale_map is not None:
            expected = replace(expected, log_scale_std=math.inf)
        nats = np.array([expected.nats(*each) for each in self.directions], np.float32)
        tiles = made.sheet.propose.candidates(
            made.view.rectified_at(0),
            self.directions,
            1 - np.float32(made.policy.tile_share_per_nat) * nats,
            made.tile_rows,
            self.count,
        )
        return made.allowed_nearby(
            tiles, made.policy.tile_reach_strides * grid.stride_m / grid.gsd_m
        )


class Search:
    """The search for one view on one sheet, to be run once."""

    def __init__(self, sheet: SearchedSheet, view: PreparedView, prior: Prior | None) -> None:
        self.sheet, self.view, self.prior = sheet, view, prior
        self.plan, self.policy, self.costs = sheet.plan, sheet.plan.policy, sheet.plan.costs
        self.levels = view.levels
        self.ground = ViewOverGround(sheet.relief, view)
        self.placer = Placer(
            view.templates,
            view.levels,
            view.prior,
            sheet.reference,
            pool=sheet.pool,
            ground=self.ground,
        )
        self.chances = sheet.confidence.chances if sheet.confidence else USUAL_CHANCES
        self.places: list[Place] = []
        self.direct: list[Place] = []
        # With a prior few candidates are sought, by both kinds; `by_gradients` seeks the others.
        share = SOUGHT_SHARE if prior is None else math.inf
        self.sought = view.templates.weighing_grey(min(share, view.templates.grey_share))
        self.found: list[tuple[Step, list[Pose]]] = []
        self.budget = Budget(self.plan.budget_ms)

    @property
    def candidates(self) -> int:
        return sum(len(poses) for _, poses in self.found)

    def run(self) -> Place | NoFix:
        """By the channels of the view alone; see `found_by`."""
        return self.outcome(self.best())

    def outcome(self, best: Place | None) -> Place | NoFix:
        """With its height counted from the ground below the camera."""
        if best is not None:
            return self.placer.below_camera(best)
        if not self.touches_map:
            return NoFix("outside_map", "the area of the prior is outside the map")
        detail = "no place of the map could be compared with the view"
        if self.prior is None:
            detail += "; a large map needs a prior, or views as large as its tiles"
        return NoFix("no_match", detail)

    def best(self) -> Place | None:
        """None where nothing was found."""
        if not self.touches_map:
            return None
        for step in self.steps():
            if early := self._proven_before(step):
                return early
            if not self.budget.allows(step.cost_ms):
                break
            self._take(step)
            if clear := self._clear_after(step):
                return clear
        return self.concluded()

    def by_gradients(self) -> "Search":
        """The same candidates and the likeliest ones without grey levels, compared without them, in
        the time that is left."""
        made = Search(self.sheet, self.view.by_gradients(), self.prior)
        made.budget = self.budget
        for each in self.found:
            made._judge(*each)
        step = made._likeliest()
        if math.isfinite(step.cost_ms) and self.budget.allows(step.cost_ms):
            made._take(step)
        return made

    def camera(self, place: Place) -> CameraFound | None:
        """None where too few blocks of the view are seen."""
        ratio = place.scores.get("local_ratio", 1.0)  # of the best place only
        return camera_found(self.ground, self.sheet.reference, place.fit.pose, ratio, place.camera)

    # What is tried

    def steps(self) -> Iterator[Step]:
        """To be run in this order until the search ends."""
        policy, levels, prior = self.policy, self.levels, self.view.prior
        judged = policy.directions(prior, policy.judged_steps)
        judged_ms, tried_all = self.fft_ms(levels.judged, len(judged)), False
        if judged_ms > policy.cheap_ms:
            # The cheaper one wherever it is possible; the other only where it can be afforded.
            affordable = 0.0 if judged_ms <= policy.last_ms else policy.last_ms
            for number, step in enumerate(
                sorted(self._coarse_steps(), key=lambda each: each.cost_ms)
            ):
                if math.isinf(step.cost_ms) or (number and step.cost_ms > affordable):
                    break
                # Over relief the expected scale is another one at every place.
                tried_all |= not step.from_tiles and prior.scale_map is None
                yield from self._likely_first(step)
        if judged_ms <= max(policy.last_ms, policy.cheap_ms):
            for least, most in pairwise(policy.stages_nats):
                stage = [each for each, nats in judged if least < nats <= most]
                if not stage:
                    continue
                step = FftStep(self, levels.judged, stage, policy.candidates, len(stage))
                is_last = most == policy.stages_nats[-1]
                if is_last and tried_all and step.cost_ms > policy.last_stage_ms:
                    break
                yield step
        final = [each for each, _ in policy.directions(prior, policy.final_steps)]
        step = FftStep(self, levels.final, final, policy.final_candidates, len(final))
        if levels.final < levels.judged and step.cost_ms <= policy.cheap_ms:
            yield step

    def _coarse_steps(self) -> list[Step]:
        """The coarse level, or one above it where that takes too long; and tiles."""
        policy, level = self.policy, self.levels.coarse
        tried = [each for each, _ in policy.directions(self.view.prior, policy.coarse_steps)]
        coarse = FftStep(self, level, tried, policy.candidates, len(tried))
        if coarse.cost_ms > policy.last_ms:
            far = replace(coarse, level=level + 1, count=policy.far_candidates)
            if not math.isinf(far.cost_ms):  # there is such a level
                coarse = far
        if not self.tiles:
            return [coarse]
        count = policy.candidates_from(self.tiles)
        return [coarse, TileStep(self, level, tried, count, len(tried))]

    def _likeliest(self) -> Step:
        """All directions at the judged level where that takes little, else the first stage of them,
        or the coarse level where even that takes too long."""
        policy = self.policy
        rated = policy.directions(self.view.prior, policy.judged_steps)
        every = [each for each, _ in rated]
        first = [each for each, nats in rated if nats <= policy.stages_nats[1]] or every[:1]
        for some, most_ms in ((every, policy.cheap_ms), (first, policy.last_ms)):
            step = FftStep(self, self.levels.judged, some, policy.candidates, len(some))
            if step.cost_ms <= most_ms:
                return step
        return self._coarse_steps()[0]

    def _likely_first(self, step: Step) -> Iterator[Step]:
        """Likely directions first; all at once where the heading is known."""
        likely = step.whole
        if self.view.prior.turn_rad is None:
            rated = self.policy.directions(self.view.prior, self.policy.coarse_steps)
            likely = sum(nats <= self.policy.likely_nats for _, nats in rated)
        for some in (step.directions[:likely], step.directions[likely:]):
            if some:
                yield replace(step, directions=some)

    # Where it is tried

    @cached_property
    def middle_px(self) -> tuple[float, float]:
        """Where the prior expects the view, x and y at level 0."""
        assert self.prior is not None
        view = self.view
        place = self.sheet.sheet.frame.en_from_latlon(self.prior.lat_deg, self.prior.lon_deg)
        x, y = self.sheet.px_of(place)
        if view.prior.turn_rad is None:
            return x, y
        moved = rotation(view.prior.turn_rad) @ view.camera_px
        return x - float(moved[0]), y - float(moved[1])

    @cached_property
    def reach_px(self) -> float:
        """In pixels of level 0; infinite without a prior."""
        if self.prior is None:
            return math.inf
        view = self.view
        tilt = float(np.hypot(*view.camera_px))
        turn = 2.0 if view.prior.turn_rad is None else 2 * view.prior.turn_std_rad
        reach = PRIOR_SIGMAS * max(self.prior.std_m, 0.0) / self.sheet.grid.gsd_m
        return float(reach + tilt * min(turn, 1.0) + 2.0 * 2**view.levels.coarse)

    @property
    def touches_map(self) -> bool:
        if self.prior is None:
            return True
        (x, y), reach = self.middle_px, self.reach_px
        rows, cols = self.sheet.reference.shape(0)
        return -reach < x < cols + reach and -reach < y < rows + reach

    def fft_ms(self, level: int, poses: int) -> float:
        """Of the sheet or what the prior allows; infinite where there is no such level."""
        if level >= self.sheet.reference.levels:
            return math.inf
        rows, cols = self.sheet.reference.shape(level)
        if self.prior is not None:
            across = 2 * self.reach_px / 2**level
            rows, cols = round(min(rows, across)), round(min(cols, across))
        side = self.view.side_px / 2**level
        if self.prior is not None or min(rows, cols) < 3 * side:
            rows, cols = round(rows + side), round(cols + side)
        return self.costs.fft_ms(poses, rows, cols)

    @cached_property
    def tiles(self) -> int:
        propose, rows = self.sheet.propose, self.tile_rows
        if propose is None or not propose.fits(self.view.side_px, self.policy.view_tiles):
            return 0
        return len(propose.centres_en_m) if rows is None else len(rows)

    @cached_property
    def tile_rows(self) -> NDArray[np.intp] | None:
        """Of the tiles that the prior allows, None for all."""
        if self.prior is None or self.sheet.propose is None:
            return None
        grid, (x, y) = self.sheet.grid, self.middle_px
        centre = np.array([grid.west_m + x * grid.gsd_m, grid.north_m - y * grid.gsd_m])
        reach_m = self.reach_px * grid.gsd_m + grid.stride_m
        return rows_within(self.sheet.propose.centres_en_m, centre, reach_m)

    # Candidates

    def nearby(self, found: Sequence[Peak], reach_px: float) -> list[Peak]:
        """At the best place within `reach_px` (level 0) of each, at the coarse level, best first.

        Of candidates that end at the same place the best one stays."""
        moved = sorted(self._moved(found, reach_px), key=lambda each: -each.score)
        places = np.array([complex(each.pose.x_px, each.pose.y_px) for each in moved])
        free, kept = np.ones(len(moved), np.bool_), []
        for number, each in enumerate(moved):
            if free[number]:
                kept.append(each)
                apart_px = abs(places - places[number])
                free &= apart_px > self.view.templates.side_px * SAME_PLACE_SHARE
        return kept

    def allowed_nearby(self, found: Sequence[Peak], reach_px: float) -> list[Peak]:
        """The promising ones within the prior."""
        kept = self.promising(self.nearby(found, reach_px))
        if self.prior is None:
            return kept
        x, y = self.middle_px
        return [
            each
            for each in kept
            if max(abs(each.pose.x_px - x), abs(each.pose.y_px - y)) <= self.reach_px
        ]

    def _moved(self, found: Sequence[Peak], reach_px: float) -> list[Peak]:
        level, windows = self.levels.coarse, self.sheet.windows
        recipe, side_px = self.levels.recipe(level), self.view.templates.side_px
        template, whole = self.sought.at(level, recipe), None
        if math.prod(self.sheet.reference.shape(level)) <= WHOLE_WINDOW_PX:
            whole = windows.whole(level, recipe, side_px)
            whole.prepare_near(template)

        def moved(some: Sequence[Peak]) -> list[Peak]:
            place = some[0].pose.x_px, some[0].pose.y_px
            around_px = reach_px + side_px
            window = whole or windows.part(level, recipe, side_px, place, around_px)
            made = []
            for more in self.policy.nearby_log_scales:
                poses = [replace(each.pose, log_scale=each.pose.log_scale + more) for each in some]
                made.append(best_near(template, window, poses, reach_px))
            return [max(same, key=lambda each: each.score) for same in zip(*made, strict=True)]

        at_once = PLACES_AT_ONCE if whole else 1
        parts = [found[at : at + at_once] for at in range(0, len(found), at_once)]
        return [each for some in self.placer.shared(moved, parts) for each in some]

    def promising(self, found: list[Peak]) -> list[Peak]:
        """Without those far weaker than the best."""
        least = self.policy.candidate_share
        enough = sum(each.score >= least * found[0].score for each in found)
        return found[: max(enough, self.policy.min_candidates)]

    # When it ends

    def _take(self, step: Step) -> None:
        self._judge(step, [each.pose for each in step.run()])

    def _judge(self, step: Step, found: list[Pose]) -> None:
        self.found.append((step, found))
        if step.level < self.levels.judged:
            self.direct = self.placer.direct(found)
        else:
            level = min(step.level, self.levels.coarse)
            self.places += self.placer.judge(found, level, self.places)

    def _clear_after(self, step: Step) -> Place | None:
        policy, levels = self.policy, self.levels
        is_fine = step.from_tiles or step.level == levels.judged
        margin = policy.clear_at_judged if is_fine else policy.clear
        if not self.places:
            return None
        best, rival = self.placer.standing(self.places)
        if best <= margin.strength * self.chances.look or best <= margin.judged_ratio * rival:
            return None  # before the cost of finishing it
        found = self._finished(self.places)
        # Candidates from tiles or from far above are not all places: rivals alone prove too little.
        compared_all = not step.from_tiles and step.level <= levels.coarse
        proven = compared_all or self._is_proven(found, policy.doubt)
        return found if proven and self._is_clear(found, margin) else None

    def _proven_before(self, step: Step) -> Place | None:
        """The best place so far, if a trial before the next step proves it.

        The best few are finished on the terrain; where that proves none, they are compared one
        level finer. Where only a part of all places was compared, the best must stand out too. No
        trial before a step that costs less, except the final level, before which all directions
        were tried."""
        policy, last, levels = self.policy, self.found[-1][0] if self.found else None, self.levels
        if last is None or self.sheet.confidence is None or levels.final == levels.judged:
            return None
        at_final, is_level = step.level < levels.judged, self.placer.is_level
        trial_ms = self.costs.trial_ms if is_level else self.costs.terrain_trial_ms
        if not self.places or not (at_final or step.cost_ms > trial_ms):
            return None
        # Without time for it the search goes on, and is cut short only where that has no time.
        if not (self.budget.fits(trial_ms) and self.budget.allows(trial_ms)):
            return None
        places = self.placer.on_terrain(self.places, policy.trials)
        compared_all = is_level and last.level == levels.judged and not last.from_tiles
        doubt = policy.doubt if at_final else policy.trial_doubt
        for closer in (False, True):
            found = self._finished(places, policy.trials, closer=closer)
            if not compared_all and not self._is_clear(found, policy.trial_clear):
                return None
            if self._is_proven(found, doubt):
                return found
            if at_final or levels.final == 0:
                return None
        return None

    def concluded(self) -> Place | None:
        """After all steps. While none is proven, more are finished and compared one level finer."""
        policy, levels, places = self.policy, self.levels, self.places
        if not places:
            return None
        if not self.placer.is_level and self.budget.allows(0.0):
            places = self.placer.on_terrain(places, policy.terrain_candidates)
        found = self._finished(places)
        passes = policy.finer if levels.final > 0 else policy.finer[-1:]
        for kept, cost_ms in passes if levels.final != levels.judged else ():
            if self._is_proven(found, policy.doubt) or not self.budget.allows(cost_ms):
                break
            found = self._finished(places, kept, closer=True)
        if self.budget.cut_short:
            found.scores["cut_short"] = 1.0
        return found

    def _finished(
        self, places: Sequence[Place], kept: int = KEPT_TO_FINISH, *, closer: bool = False
    ) -> Place:
        return self.placer.finished(places, self.candidates, self.direct, kept=kept, closer=closer)

    def _is_clear(self, best: Place, margin: ClearMargin) -> bool:
        scores = best.scores
        return (
            scores["strength"] > margin.strength * self.chances.total
            and scores["look_ratio"] > margin.judged_ratio
            and scores["peak_ratio"] > margin.peak_ratio
        )

    def _is_proven(self, best: Place, doubt: float) -> bool:
        return self.likelihood(best) > 1 - doubt

    def tentative(self) -> Place | None:
        """The best place so far, not compared one level finer."""
        return self._finished(self.places) if self.places else None

    def is_doubtful(self, best: Place) -> bool:
        """Whether it is not recognized, and there is time to compare all candidates again."""
        doubtful = self.sheet.confidence is not None and self.likelihood(best) < CONFIDENT
        again_ms = self.costs.trial_ms + self.costs.nearby_ms * self.candidates
        return doubtful and not self.budget.cut_short and self.budget.allows(again_ms)

    def likelihood(self, place: Place | None) -> float:
        """Probability that the place is right, 0 for none."""
        if place is None or self.sheet.confidence is None:
            return 0.0
        return self.sheet.confidence(place.scores)


class Found(NamedTuple):
    """A place, and the search that found it."""

    search: Search
    place: Place


def found_by(search: Search) -> Found | NoFix:
    """By both kinds of channels; where these do not recognize the place, by gradients alone, if
    that is more likely right: other light (infrared, night, snow) changes grey levels more than
    edges."""
    best = search.best()
    if best is not None and search.is_doubtful(best):
        other = search.by_gradients()
        hopeful = other.likelihood(other.tentative()) > search.likelihood(best)
        found = other.concluded() if hopeful else None
        if other.likelihood(found) > search.likelihood(best):
            search, best = other, found
    place = search.outcome(best)
    return place if isinstance(place, NoFix) else Found(search, place)
