"""The search for the place of one view on a prepared map: what is tried, and when it is enough.

A view is compared first at the *mid level* of the map, where it is some 72 px across
(`Levels.mid`). There are three sources of candidates:

- the *mid level* by FFT: the only one that misses nothing, and the slowest on a large area;
- the *coarse level*, one above it, by FFT: a quarter of the pixels; on large areas the level above
  that one, whose candidates are compared at the coarse level near by;
- the *tiles* whose embeddings are most similar to the view.

On a small area (a prior, a small sheet) only the mid level is searched. On a large one the cheaper
of the other two comes first; the next follows only while no place stands out, and if its cost is
acceptable. With an unknown heading both try the likely scales first. At the mid level headings and
scales come in stages, the most likely first. Where all is known so well that the *final level*, one
below, is cheap too, it comes last: weak texture, as of bare ground, is only seen there.

A search ends as soon as the best place stands out or is proven by its confidence. `plan` has the
numbers, `place` compares candidates. Reasons are in docs/decisions/registration.md."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.localize.camera import CameraEstimate, camera_of
from orthonav.core.localize.confidence import DEFAULT_CHANCES
from orthonav.core.localize.ground import ViewOverGround
from orthonav.core.localize.place import (
    REFINEMENT,
    BestPlace,
    CandidateRefiner,
    FinalPlace,
    MidPlace,
)
from orthonav.core.localize.plan import ClearMargin
from orthonav.core.localize.prepared import PreparedMap
from orthonav.core.localize.view import PreparedView, prepare
from orthonav.core.records import CONFIDENT, PRIOR_SIGMAS, NoFix, Prior, View
from orthonav.core.register.search import (
    PLACES_AT_ONCE,
    Direction,
    Peak,
    SearchWindow,
    Steps,
    best_near,
    largest_half_px,
    rated_directions,
    search,
)
from orthonav.core.register.template import SOUGHT_SHARE
from orthonav.core.register.window import Pose, rotation
from orthonav.core.tiles.position import rows_within


class Budget:
    """Estimates are corrected by what they took."""

    def __init__(self, budget_ms: float) -> None:
        self._budget_ms, self._begun_s = budget_ms, time.monotonic()
        self._estimated_ms: float | None = None
        self.cut_short = False

    def fits(self, cost_ms: float) -> bool:
        """The first step always does."""
        if self._estimated_ms is None:
            return True
        spent_ms = 1e3 * (time.monotonic() - self._begun_s)
        pace = spent_ms / self._estimated_ms if self._estimated_ms else 0.0
        return not spent_ms + pace * cost_ms > self._budget_ms  # NaN where nothing took time yet

    def allows(self, cost_ms: float) -> bool:
        """Whether to begin; if not, the search is cut short."""
        if not self.fits(cost_ms):
            self.cut_short = True
            return False
        self._estimated_ms = (self._estimated_ms or 0.0) + cost_ms
        return True


@dataclass(frozen=True, eq=False)
class Stage:
    """One way to find candidates, `count` at most, under `directions`, the most likely first.

    By FFT at `level`, or from tiles, whose candidates are refined at `level` first. `cost_ms`:
    infinite where it is impossible."""

    level: int
    directions: list[Direction]
    count: int
    cost_ms: float
    from_tiles: bool = False

    def likely_first(self, likely: int) -> list["Stage"]:
        """The same under the first `likely` directions, then under the others."""
        parts = self.directions[:likely], self.directions[likely:]
        every = len(self.directions)
        return [
            replace(self, directions=some, cost_ms=self.cost_ms * len(some) / every)
            for some in parts
            if some
        ]


class Found(NamedTuple):
    """The best place of a view, and the search that found it."""

    search: "Search"
    best: BestPlace


class Search:
    """The search for one view on one map, to be run once."""

    def __init__(self, map: PreparedMap, view: PreparedView, prior: Prior | None) -> None:
        self.map, self.view, self.prior = map, view, prior
        self.plan, self.levels = map.plan, view.levels
        self.over_ground = ViewOverGround(map.ground, view, map.reference)
        self.refiner = CandidateRefiner(
            view.templates,
            view.levels,
            view.prior,
            map.reference,
            pool=map.pool,
            ground=self.over_ground,
        )
        self.chances = map.confidence.chances if map.confidence else DEFAULT_CHANCES
        self.places: list[MidPlace] = []
        self.from_final: list[MidPlace] = []
        # With a prior few candidates are sought, by both kinds; `_by_gradients` seeks the others.
        share = SOUGHT_SHARE if prior is None else math.inf
        self.sought = view.templates.weighing_grey(min(share, view.templates.grey_share))
        self.tried: list[tuple[Stage, list[Pose]]] = []
        self.budget = Budget(self.plan.budget_ms)

    @classmethod
    def of(
        cls, map: PreparedMap, view: View, prior: Prior | None = None, heading_known: bool = True
    ) -> "Search | NoFix":
        """`NoFix` where the view shows too little."""
        prepared = prepared_view(map, view, heading_known)
        if isinstance(prepared, NoFix):
            return prepared
        if not map.ground.is_flat:
            prepared = replace(prepared, prior=map.ground.expected(prepared))
        return cls(map, prepared, prior)

    @property
    def candidates(self) -> int:
        return sum(len(poses) for _, poses in self.tried)

    @property
    def floor_m(self) -> float:
        """Standard deviation with which maps of two dates agree at the view's final level."""
        # Coarse imagery of another date is displaced by more (docs/terrain.md).
        return self.map.floor_px * self.map.grid.gsd_m * 2.0**self.levels.final

    def run(self) -> Found | NoFix:
        """By both kinds of channels; where these do not recognize the place, by gradients alone, if
        that is more likely right: other light (infrared, night, snow) changes grey levels more than
        edges."""
        search, best = self, self.best()
        if best is not None and self._is_doubtful(best):
            other = self._by_gradients()
            tentative = other._refined(other.places) if other.places else None
            hopeful = other.likelihood(tentative) > self.likelihood(best)
            found = other._concluded() if hopeful else None
            if other.likelihood(found) > self.likelihood(best):
                search, best = other, found
        return self._nothing() if best is None else Found(search, best)

    def best(self) -> BestPlace | None:
        """By the channels of the view; None where nothing was found."""
        stages = self.stages() if self.touches_map else []
        for stage, following in zip(stages, [*stages[1:], None], strict=False):
            if not self.budget.allows(stage.cost_ms):
                break
            self._take(stage)
            if found := self._ended(stage, following):
                return found
        return self._concluded()

    def _nothing(self) -> NoFix:
        if not self.touches_map:
            return NoFix("outside_map", "the area of the prior is outside the map")
        detail = "no place of the map could be compared with the view"
        if self.prior is None:
            detail += "; a large map needs a prior, or views as large as its tiles"
        return NoFix("no_match", detail)

    def _by_gradients(self) -> "Search":
        """The same candidates and the likeliest ones without grey levels, compared without them, in
        the time that is left."""
        made = Search(self.map, self.view.by_gradients(), self.prior)
        made.budget = self.budget
        for each in self.tried:
            made._refine(*each)
        stage = made._likeliest()
        if math.isfinite(stage.cost_ms) and self.budget.allows(stage.cost_ms):
            made._take(stage)
        return made

    def camera(self, place: FinalPlace, local_ratio: float = 1.0) -> CameraEstimate | None:
        """None where too few blocks of the view are seen. `local_ratio`: of the scores."""
        start = place.camera
        return camera_of(self.over_ground, place.window_pose, local_ratio, self.floor_m, start)

    # What is tried

    def stages(self) -> list[Stage]:
        """In this order until the search ends: on a small area the mid level, on a large one coarse
        candidates first; the final level where that is cheap too."""
        plan, levels = self.plan, self.levels
        rated = self._rated(plan.mid_steps)
        mid_ms = self._fft_ms(levels.mid, len(rated))
        coarse = self._on_large_area(mid_ms) if mid_ms > plan.cheap_ms else []
        stages = [part for each in coarse for part in each.likely_first(self._likely(each))]
        if mid_ms <= max(plan.last_ms, plan.cheap_ms):
            # Over relief the expected scale is another one at every place.
            uniform = self.view.prior.scale_map is None
            tried_all = uniform and any(not each.from_tiles for each in coarse)
            stages += self._at_mid_level(rated, tried_all)
        final = [each for each, _ in self._rated(plan.final_steps)]
        stage = self._fft_stage(levels.final, final, plan.final_candidates)
        is_cheap = levels.final < levels.mid and stage.cost_ms <= plan.cheap_ms
        return [*stages, stage] if is_cheap else stages

    def _at_mid_level(
        self, rated: Sequence[tuple[Direction, float]], tried_all: bool
    ) -> list[Stage]:
        """By how likely headings and scales are; without the last stage where the coarse level
        `tried_all` and it takes long."""
        plan, stages = self.plan, []
        for least, most in pairwise(plan.stage_penalties):
            some = [each for each, penalty in rated if least < penalty <= most]
            if some:
                stages.append(self._fft_stage(self.levels.mid, some, plan.candidates))
        has_last = any(penalty > plan.stage_penalties[-2] for _, penalty in rated)
        if has_last and tried_all and stages[-1].cost_ms > plan.last_stage_ms:
            stages.pop()
        return stages

    def _rated(self, steps: Steps) -> list[tuple[Direction, float]]:
        """Directions to try and their penalties, the most likely first."""
        plan = self.plan
        return rated_directions(self.view.prior, steps, plan.bank_sigmas, plan.max_penalty)

    def _on_large_area(self, mid_ms: float) -> list[Stage]:
        """The cheaper of the coarse ones where it is possible; the other only where the mid level
        takes too long, and this one does not."""
        by_cost = sorted(self._coarse_stages(), key=lambda each: each.cost_ms)
        most_ms = 0.0 if mid_ms <= self.plan.last_ms else self.plan.last_ms
        others = [each for each in by_cost[1:] if each.cost_ms <= most_ms]
        return [*by_cost[:1], *others] if math.isfinite(by_cost[0].cost_ms) else []

    def _coarse_stages(self) -> list[Stage]:
        """The coarse level, or one above it where that takes too long; and tiles."""
        plan, level = self.plan, self.levels.coarse
        tried = [each for each, _ in self._rated(plan.coarse_steps)]
        coarse = self._fft_stage(level, tried, plan.candidates)
        if coarse.cost_ms > plan.last_ms:
            far = self._fft_stage(level + 1, tried, plan.far_candidates)
            if not math.isinf(far.cost_ms):  # there is such a level
                coarse = far
        if self.map.propose is None or not self.tiles:
            return [coarse]
        least, most = plan.tile_candidates
        count = max(least, min(most, round(self.tiles / plan.tiles_per_candidate)))
        # To represent a view, to embed and compare it under each direction, and to refine.
        compare_ms = 0.06 + 5e-8 * self.tiles * self.map.propose.embedder.dims
        cost_ms = 4.0 + len(tried) * compare_ms + plan.nearby_ms * count
        return [coarse, Stage(level, tried, count, cost_ms, from_tiles=True)]

    def _fft_stage(self, level: int, directions: list[Direction], count: int) -> Stage:
        cost_ms = self._fft_ms(level, len(directions))
        if level > self.levels.coarse:
            cost_ms += self.plan.nearby_ms * count
        return Stage(level, directions, count, cost_ms)

    def _likeliest(self) -> Stage:
        """All directions at the mid level where that takes little, else the first stage of them, or
        the coarse level where even that takes too long."""
        plan, rated = self.plan, self._rated(self.plan.mid_steps)
        every = [each for each, _ in rated]
        first = every[: max(sum(penalty <= plan.stage_penalties[1] for _, penalty in rated), 1)]
        for some, most_ms in ((every, plan.cheap_ms), (first, plan.gradients_ms)):
            stage = self._fft_stage(self.levels.mid, some, plan.candidates)
            if stage.cost_ms <= most_ms:
                return stage
        return self._coarse_stages()[0]

    def _likely(self, stage: Stage) -> int:
        """How many directions of a coarse stage come first: all where the heading is known."""
        if self.view.prior.heading_rad is not None:
            return len(stage.directions)
        rated = self._rated(self.plan.coarse_steps)
        return sum(penalty <= self.plan.likely_penalty for _, penalty in rated)

    def _fft_ms(self, level: int, directions: int) -> float:
        """Of the sheet or what the prior allows; infinite where there is no such level, or the
        window is too large."""
        if level >= self.map.reference.levels:
            return math.inf
        rows, cols = self.map.reference.shape(level)
        if self.prior is not None:
            across = 2 * self.reach_px / 2**level
            rows, cols = round(min(rows, across)), round(min(cols, across))
        side = self.view.side_px / 2**level
        if self.prior is not None or min(rows, cols) < 3 * side:
            rows, cols = round(rows + side), round(cols + side)
        pixels = float(rows * cols)
        if pixels > self.plan.max_search_px:
            return math.inf
        return directions * (0.01 + 2.2e-7 * pixels * math.log2(pixels))

    # Where it is tried

    @cached_property
    def middle_px(self) -> tuple[float, float]:
        """Where the prior expects the view, x and y at level 0."""
        assert self.prior is not None
        view = self.view
        place = self.map.sheet.frame.en_from_latlon(self.prior.lat_deg, self.prior.lon_deg)
        x, y = self.map.ground.map_px(place)
        if view.prior.heading_rad is None:
            return x, y
        moved = rotation(view.prior.heading_rad) @ view.camera_px
        return x - float(moved[0]), y - float(moved[1])

    @cached_property
    def reach_px(self) -> float:
        """In pixels of level 0; infinite without a prior."""
        if self.prior is None:
            return math.inf
        view = self.view
        tilt = float(np.hypot(*view.camera_px))
        turn = 2.0 if view.prior.heading_rad is None else 2 * view.prior.heading_std_rad
        reach = PRIOR_SIGMAS * max(self.prior.std_m, 0.0) / self.map.grid.gsd_m
        return float(reach + tilt * min(turn, 1.0) + 2.0 * 2**view.levels.coarse)

    @property
    def touches_map(self) -> bool:
        if self.prior is None:
            return True
        (x, y), reach = self.middle_px, self.reach_px
        rows, cols = self.map.reference.shape(0)
        return -reach < x < cols + reach and -reach < y < rows + reach

    @cached_property
    def tiles(self) -> int:
        propose, rows = self.map.propose, self.tile_rows
        if propose is None or not propose.fits(self.view.side_px, self.plan.view_tiles):
            return 0
        return len(propose.tiles.centres_en_m) if rows is None else len(rows)

    @cached_property
    def tile_rows(self) -> NDArray[np.intp] | None:
        """Of the tiles that the prior allows, None for all."""
        if self.prior is None or self.map.propose is None:
            return None
        grid, ground = self.map.grid, self.map.ground
        reach_m = self.reach_px * grid.gsd_m + grid.stride_m
        centre = ground.en_m(np.array(self.middle_px))
        return rows_within(self.map.propose.tiles.centres_en_m, centre, reach_m)

    # Candidates

    def _by_fft(self, stage: Stage) -> list[Peak]:
        """The peaks of correlation, of the sheet or of what the prior allows; those of a far level
        at their best places near by."""
        view, level = self.view, stage.level
        template = view.levels.template(self.sought, level)
        if self.prior is None:
            window = self.map.windows.whole(template, view.side_px)
        else:
            half_px = largest_half_px(template, stage.directions)
            where = view.side_px, self.middle_px, self.reach_px, half_px
            window = SearchWindow.around(self.map.reference, template, *where)
        # Every thread has memory for a whole window.
        fits = math.prod(window.size) * self.plan.threads <= self.plan.max_search_px
        pool = self.map.pool if fits else None
        found = search(template, window, stage.directions, stage.count, view.prior.scale_map, pool)
        if level > view.levels.coarse:
            return self._nearby(found, self.plan.far_reach_px * 2**level)
        return self._promising(found)

    def _from_tiles(self, stage: Stage) -> list[Peak]:
        """The most similar tiles that no tile next to them exceeds, each at its best place near
        by."""
        plan, grid, propose = self.plan, self.map.grid, self.map.propose
        assert propose is not None
        expected = self.view.prior
        # Over a terrain the telemetry predicts another scale at every place.
        if expected.scale_map is not None:
            expected = replace(expected, log_scale_std=math.inf)
        penalties = [expected.penalty(*each) for each in stage.directions]
        tiles = propose.candidates(
            self.view.rectified_at(0),
            stage.directions,
            1 - np.float32(plan.tile_share_per_penalty) * np.array(penalties, np.float32),
            self.tile_rows,
            stage.count,
        )
        return self._nearby(tiles, plan.tile_reach_strides * grid.stride_m / grid.gsd_m)

    def _nearby(self, found: Sequence[Peak], reach_px: float) -> list[Peak]:
        """At the best place within `reach_px` (level 0) of each, at the coarse level, best first:
        the promising ones within the prior."""
        moved = sorted(self._moved(found, reach_px), key=lambda each: -each.score)
        kept = self._promising(self._apart(moved))
        if self.prior is None:
            return kept
        x, y = self.middle_px
        return [
            each
            for each in kept
            if max(abs(each.pose.x_px - x), abs(each.pose.y_px - y)) <= self.reach_px
        ]

    def _apart(self, found: Sequence[Peak]) -> list[Peak]:
        """Of candidates that end at the same place the best one."""
        places = np.array([complex(each.pose.x_px, each.pose.y_px) for each in found])
        apart_px = self.plan.apart * self.view.templates.side_px
        free, kept = np.ones(len(found), np.bool_), []
        for number, each in enumerate(found):
            if free[number]:
                kept.append(each)
                free &= abs(places - places[number]) > apart_px
        return kept

    def _moved(self, found: Sequence[Peak], reach_px: float) -> list[Peak]:
        reference, side_px = self.map.reference, self.view.templates.side_px
        template, whole = self.levels.template(self.sought, self.levels.coarse), None
        if math.prod(reference.shape(template.level)) <= self.plan.whole_window_px:
            whole = self.map.windows.whole(template, side_px)
            whole.prepare_near(template)

        def moved(some: Sequence[Peak]) -> list[Peak]:
            place = some[0].pose.x_px, some[0].pose.y_px
            around = template, side_px, place, reach_px + side_px
            window = whole or SearchWindow.around(reference, *around)
            made = []
            for more in self.plan.nearby_log_scales:
                poses = [replace(each.pose, log_scale=each.pose.log_scale + more) for each in some]
                made.append(best_near(template, window, poses, reach_px))
            return [max(same, key=lambda each: each.score) for same in zip(*made, strict=True)]

        at_once = PLACES_AT_ONCE if whole else 1
        parts = [found[at : at + at_once] for at in range(0, len(found), at_once)]
        return [each for some in self.refiner.shared(moved, parts) for each in some]

    def _promising(self, found: list[Peak]) -> list[Peak]:
        """Without those far weaker than the best."""
        least = self.plan.candidate_share
        enough = sum(each.score >= least * found[0].score for each in found)
        return found[: max(enough, self.plan.min_candidates)]

    # When it ends

    def _take(self, stage: Stage) -> None:
        found = self._from_tiles(stage) if stage.from_tiles else self._by_fft(stage)
        self._refine(stage, [each.pose for each in found])

    def _refine(self, stage: Stage, found: list[Pose]) -> None:
        self.tried.append((stage, found))
        if stage.level < self.levels.mid:
            self.from_final = self.refiner.at_mid_level(found)
        else:
            level = min(stage.level, self.levels.coarse)
            self.places += self.refiner.to_mid_level(found, level, self.places)

    def _ended(self, stage: Stage, following: Stage | None) -> BestPlace | None:
        """The best place so far, if it ends the search before the `following` stage: it stands out,
        or a trial proves it."""
        if not self.places:
            return None
        found = self._outstanding(stage)
        return self._proven_by_trial(stage, following) if following and not found else found

    def _outstanding(self, stage: Stage) -> BestPlace | None:
        """It stands out from its rivals. Those from tiles or from far above are not all places:
        there it must be proven too."""
        plan, levels = self.plan, self.levels
        is_fine = stage.from_tiles or stage.level == levels.mid
        margin = plan.clear_at_mid if is_fine else plan.clear
        best, rival = self.refiner.best_and_rival(self.places)
        if best <= margin.strength * self.chances.mid or best <= margin.mid_ratio * rival:
            return None  # before the cost of the final level
        found = self._refined(self.places)
        compared_all = not stage.from_tiles and stage.level <= levels.coarse
        proven = compared_all or self._is_proven(found, plan.doubt)
        return found if proven and self._is_clear(found, margin) else None

    def _proven_by_trial(self, stage: Stage, following: Stage) -> BestPlace | None:
        """The best few are refined on the terrain, in a trial before a stage that costs more, or
        before the final level, as all directions were tried; where that proves none, they are
        compared one level finer. Where only a part of all places was compared, the best must stand
        out too."""
        plan, levels, is_flat = self.plan, self.levels, self.refiner.is_flat
        at_final = following.level < levels.mid
        trial_ms = plan.trial_ms if is_flat else plan.terrain_trial_ms
        if self.map.confidence is None or levels.final == levels.mid:
            return None
        # Without time for it the search goes on, and is cut short only where that has no time.
        if not (at_final or following.cost_ms > trial_ms) or not (
            self.budget.fits(trial_ms) and self.budget.allows(trial_ms)
        ):
            return None
        places = self.refiner.on_terrain(self.places, REFINEMENT.to_final_level)
        compared_all = is_flat and stage.level == levels.mid and not stage.from_tiles
        doubt = plan.doubt if at_final else plan.trial_doubt
        for closer in (False, True):
            found = self._refined(places, closer=closer)
            if not compared_all and not self._is_clear(found, plan.trial_clear):
                return None
            if self._is_proven(found, doubt):
                return found
            if at_final or levels.final == 0:
                return None
        return None

    def _concluded(self) -> BestPlace | None:
        """After all stages. While none is proven, more are refined and compared one level finer."""
        plan, levels, places = self.plan, self.levels, self.places
        if not places:
            return None
        if not self.refiner.is_flat and self.budget.allows(0.0):
            places = self.refiner.on_terrain(places, plan.terrain_candidates)
        found = self._refined(places)
        passes = plan.finer if levels.final > 0 else plan.finer[-1:]
        for count, cost_ms in passes if levels.final != levels.mid else ():
            if self._is_proven(found, plan.doubt) or not self.budget.allows(cost_ms):
                break
            found = self._refined(places, count, closer=True)
        if self.budget.cut_short:
            found = replace(found, scores=replace(found.scores, cut_short=True))
        return found

    def _refined(
        self,
        places: Sequence[MidPlace],
        count: int = REFINEMENT.to_final_level,
        *,
        closer: bool = False,
    ) -> BestPlace:
        return self.refiner.best(places, self.from_final, count=count, closer=closer)

    def _is_clear(self, best: BestPlace, margin: ClearMargin) -> bool:
        scores = best.scores
        return (
            scores.strength > margin.strength * self.chances.total
            and scores.mid_ratio > margin.mid_ratio
            and scores.peak_ratio > margin.peak_ratio
        )

    def _is_proven(self, best: BestPlace, doubt: float) -> bool:
        return self.likelihood(best) > 1 - doubt

    def _is_doubtful(self, best: BestPlace) -> bool:
        """Whether it is not recognized, and there is time to compare all candidates again."""
        doubtful = self.map.confidence is not None and self.likelihood(best) < CONFIDENT
        again_ms = self.plan.trial_ms + self.plan.nearby_ms * self.candidates
        return doubtful and not self.budget.cut_short and self.budget.allows(again_ms)

    def likelihood(self, best: BestPlace | None) -> float:
        """Probability that the best place is right, 0 for none."""
        if best is None or self.map.confidence is None:
            return 0.0
        return self.map.confidence(best.scores)


def prepared_view(map: PreparedMap, view: View, heading_known: bool) -> PreparedView | NoFix:
    levels = map.reference.levels
    return prepare(view, map.grid.gsd_m, levels, heading_known, finer=map.is_finer)
