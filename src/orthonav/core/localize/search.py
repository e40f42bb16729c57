"""The search for the place of one view on a prepared map: what is tried, and when it is enough.

A view is judged at the *mid level* of the map, where it is some 72 px across (`Levels.mid`). There
are three sources of candidates:

- the *mid level* by FFT: the only one that misses nothing, and the slowest on a large area;
- the *coarse level*, one above it, by FFT: a quarter of the pixels; on large areas the level above
  that one, whose candidates are compared at the coarse level near by;
- the *tiles* whose embeddings are most similar to the view.

On a small area (a prior, a small sheet) only the mid level is searched. On a large one the cheaper
of the other two comes first; the next follows only while no place stands out, and if its cost is
acceptable. With an unknown heading both try the likely scales first. At the mid level headings and
scales come in stages, the most likely first. Where all is known so well that the *final level*, one
below, is cheap too, it comes last: weak texture, as of bare ground, is only seen there.

A search ends as soon as the best place stands out or is proven by its confidence. `place` judges
candidates. Reasons are in docs/decisions/registration.md; values without one there were chosen on
the real scenes of `benchmarks.scenes`."""

import math
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.localize.camera import CameraEstimate, camera_of
from orthonav.core.localize.confidence import DEFAULT_CHANCES, RegisteredConfidence
from orthonav.core.localize.ground import SAMPLING, FlatTerrain, GroundModel, ViewOverGround
from orthonav.core.localize.place import REFINEMENT, BestPlace, CandidateRefiner, Finished, Judged
from orthonav.core.localize.tiles import TileProposer
from orthonav.core.localize.view import PreparedView
from orthonav.core.mapfile.manifest import SheetInfo
from orthonav.core.mapfile.terrain import TerrainLayer
from orthonav.core.records import CONFIDENT, PRIOR_SIGMAS, NoFix, Prior
from orthonav.core.register.search import (
    PLACES_AT_ONCE,
    Peak,
    SearchWindows,
    bank,
    best_near,
    largest_half_px,
    search,
)
from orthonav.core.register.template import SOUGHT_SHARE
from orthonav.core.register.window import DirectionPrior, GreyPyramid, Pose, Reference, rotation
from orthonav.core.tiles.position import rows_within

Direction = tuple[float, float]
"""Heading (rad, clockwise from north) and natural logarithm of the scale."""
Steps = tuple[float, float]  # of headings (rad) and log scales


@dataclass(frozen=True)
class ClearMargin:
    """How far a place must stand out: over chance (`strength`) and over the strongest rival."""

    strength: float
    mid_ratio: float
    peak_ratio: float


@dataclass(frozen=True)
class SearchPlan:
    """What is tried, rough costs on one core of a desktop to choose by, and what the user allows.

    None but the first search is begun that would end later than `budget_ms`; `threads` share poses
    and candidates."""

    budget_ms: float = math.inf
    threads: int = 1

    # Headings and scales
    coarse_steps: Steps = (math.radians(8.0), 0.13)
    """Of tiles too, whose candidates are refined at the coarse level."""
    mid_steps: Steps = (math.radians(6.0), 0.09)  # 8 deg lose 2 to 6 points of views
    final_steps: Steps = (math.radians(3.0), 0.045)
    bank_sigmas: float = 3.0  # reach in standard deviations of the telemetry
    max_nats: float = 5.5
    """Less likely directions (negative log density) are not tried: corners of the bank."""
    stages_nats: tuple[float, ...] = (-1.0, 0.4, 2.0, math.inf)
    """Bounds of the stages at the mid level."""
    likely_nats: float = 1.0
    """With an unknown heading these come first: the scales of nine views in ten."""

    # Candidates
    candidates: int = 24  # of the coarse level, and of one stage at the mid level
    far_candidates: int = 400  # one level above the coarse one,
    far_reach_px: float = 1.5  # whose places are sought within so many pixels of that level
    final_candidates: int = 2  # each is finished
    tile_candidates: tuple[int, int] = (20, 400)  # least and largest number,
    tiles_per_candidate: int = 200
    """between them one for so many: the right one ranks lower among more."""
    tile_share_per_nat: float = 0.03
    """Fraction of its similarity that a tile loses per nat against the telemetry."""
    tile_reach_strides: float = 1.1  # reach of the place near a tile
    nearby_log_scales: tuple[float, ...] = (-0.13, 0.0, 0.13)
    """Added to the log scale of candidates from tiles and above the coarse level, hardly known."""
    view_tiles: tuple[float, float] = (0.6, 2.5)
    """Side of a view, in tiles, for which tiles are asked."""
    min_candidates: int = 6  # always accepted, for the scores need rivals
    candidate_share: float = 0.5  # weaker candidates than this fraction of the best are dropped
    apart: float = 1 / 8  # closer candidates from tiles, over the side of the view, are one place

    # When it ends
    clear: ClearMargin = ClearMargin(2.2, 1.9, 1.9)
    """Ends the search. Views of other places reach a ratio of 1.4, rarely 1.6."""
    clear_at_mid: ClearMargin = ClearMargin(1.8, 1.5, 1.5)
    """The same once the mid level was searched in part; and after tiles, if confident too."""
    doubt: float = 0.01  # A place with a confidence above one minus this is proven,
    trial_doubt: float = 0.002
    """in a trial, whose rivals were not all searched, above one minus this."""
    trial_clear: ClearMargin = ClearMargin(1.8, 1.25, 1.25)
    """Where a trial compares only a part of all places, the place must also stand out so far."""
    trials: int = 3
    """Best candidates finished before a search that costs more than a trial; proven ones end it."""
    finer: tuple[tuple[int, float], ...] = ((3, 25.0), (48, 90.0))
    """Candidates finished and compared one level finer until one is proven, and the cost (ms)."""
    terrain_candidates: int = 48  # placed on the terrain, at most

    # Limits of cost and memory
    cheap_ms: float = 14.0  # up to this cost the mid level is searched at once, and nothing else
    last_ms: float = 900.0
    """A second search is left out above: about a second for a view on a large area (README)."""
    last_stage_ms: float = 60.0
    """The last stage, one view in seven, is left out above after the coarse level."""
    nearby_ms: float = 0.2  # of one candidate from tiles or from above the coarse level
    trial_ms: float = 25.0  # on flat ground,
    terrain_trial_ms: float = 60.0  # and on a terrain
    max_search_px: int = 8_000_000  # larger windows (some 300 MB) are left to tiles or a prior
    whole_window_px: int = 8_000_000
    """Up to so many pixels of the coarse level one window of the whole sheet is cut (12 bytes)."""

    def fft_ms(self, poses: int, rows: int, cols: int) -> float:
        """Infinite where the window is too large."""
        pixels = float(rows * cols)
        if pixels > self.max_search_px:
            return math.inf
        return poses * (0.01 + 2.2e-7 * pixels * math.log2(pixels))

    def tiles_ms(self, poses: int, tiles: int, dims: int) -> float:
        """To represent a view, and to embed and compare it under each pose."""
        return 4.0 + poses * (0.06 + 5e-8 * tiles * dims)

    def candidates_from(self, tiles: int) -> int:
        least, most = self.tile_candidates
        return max(least, min(most, round(tiles / self.tiles_per_candidate)))

    def directions(self, prior: DirectionPrior, steps: Steps) -> list[tuple[Direction, float]]:
        """With negative log densities in nats, the most likely first."""
        turn_std_rad = None if prior.turn_rad is None else prior.turn_std_rad
        rated = _likely_directions(turn_std_rad, prior.log_scale_std, steps, self.bank_sigmas)
        reported = prior.turn_rad or 0.0
        return [
            ((reported + turn, log_scale), nats)
            for turn, log_scale, nats in rated
            if nats <= self.max_nats
        ]


DEFAULT_PLAN = SearchPlan()


@lru_cache(64)
def _likely_directions(
    turn_std_rad: float | None, log_scale_std: float, steps: Steps, sigmas: float
) -> list[tuple[float, float, float]]:
    """Cached: the standard deviations are mostly those of the view before."""
    made = bank(
        turn_std_rad, log_scale_std, turn_step_rad=steps[0], scale_step=steps[1], sigmas=sigmas
    )
    known = turn_std_rad is not None
    prior = DirectionPrior(0.0 if known else None, turn_std_rad or 0.0, log_scale_std)
    cell = steps[0] / 2, steps[1] / 2
    rated = [(*pose, prior.negative_log_density(*pose, within=cell)) for pose in made]
    return sorted(rated, key=lambda each: each[2])


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


Array = NDArray[np.float64]


class PreparedMap:
    """A map and its imagery, made ready for all views; threads may share it."""

    def __init__(
        self,
        sheet: SheetInfo,
        layer: GreyPyramid,
        *,
        confidence: RegisteredConfidence | None,
        radius_m: float,
        floor_px: float,
        propose: TileProposer | None = None,
        plan: SearchPlan = DEFAULT_PLAN,
        terrain: TerrainLayer | None = None,
        surface: TerrainLayer | None = None,
    ) -> None:
        """`confidence`: None before it is learnt: no place is proven. `radius_m`: its error.

        `floor_px`: standard deviation with which maps of two dates agree, pixels of level 0.
        Without `propose` candidates come from FFT only; without `terrain` the ground is level."""
        self.sheet, self.grid = sheet, sheet.grid
        self.pool = ThreadPoolExecutor(plan.threads) if plan.threads > 1 else None
        self.reference = Reference(layer)
        self.windows = SearchWindows(self.reference)
        known_m2 = 0.0 if surface is None else surface.info.known_m2
        imagery_px = 0 if sheet.grey is None else sheet.grey.valid_px
        # Whether all views are compared one level finer than over bare ground.
        self.is_finer = known_m2 > SAMPLING.min_known * imagery_px * self.grid.gsd_m**2
        self.confidence, self.radius_m, self.floor_px = confidence, radius_m, floor_px
        self.propose, self.plan = propose, plan
        info = None if terrain is None else terrain.info
        self.ground = GroundModel(
            terrain or FlatTerrain(), self.grid, info, sheet.relief, surface, sheet.lean
        )

    @property
    def pyramid(self) -> GreyPyramid:
        return self.reference.pyramid

    def px_of(self, place_en_m: Array) -> tuple[float, float]:
        """The inverse of `GroundModel.en_m`."""
        (east, north), grid = place_en_m, self.grid
        return (float(east) - grid.west_m) / grid.gsd_m, (grid.north_m - float(north)) / grid.gsd_m

    def floor_m(self, view: PreparedView) -> float:
        """Agreement of maps of two dates at the view's final level."""
        # Coarse imagery of another date is displaced by more (docs/terrain.md).
        return self.floor_px * self.grid.gsd_m * 2.0**view.levels.final

    def camera_en_m(self, view: PreparedView, pose: Pose) -> Array:
        """Of the camera (2,)."""
        return self.ground.en_m(pose.map_px(view.camera_px))

    def camera_state(self, view: PreparedView, pose: Pose) -> Array:
        """Of the camera (4,): m east and north, heading (rad), log scale."""
        return np.array([*self.camera_en_m(view, pose), pose.turn_rad, pose.log_scale])

    def camera_covariance(self, view: PreparedView, pose: Pose, covariance: Array) -> Array:
        """Of `camera_state`, by the covariance of the pose."""
        moved = pose.linear @ view.camera_px
        camera_from_pose = np.eye(4)
        camera_from_pose[:2, 2:] = [[-moved[1], moved[0]], [moved[0], moved[1]]]
        spread = camera_from_pose @ covariance @ camera_from_pose.T
        spread[:2, :2] += np.eye(2) * (self.floor_m(view) / self.grid.gsd_m) ** 2
        metres = np.diag([self.grid.gsd_m, -self.grid.gsd_m, 1.0, 1.0])
        return np.asarray(metres @ spread @ metres)


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
        return [
            replace(
                self,
                directions=some,
                cost_ms=self.cost_ms * len(some) / len(self.directions),
            )
            for some in (self.directions[:likely], self.directions[likely:])
            if some
        ]


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
        self.places: list[Judged] = []
        self.direct: list[Judged] = []
        # With a prior few candidates are sought, by both kinds; `by_gradients` seeks the others.
        share = SOUGHT_SHARE if prior is None else math.inf
        self.sought = view.templates.weighing_grey(min(share, view.templates.grey_share))
        self.found: list[tuple[Stage, list[Pose]]] = []
        self.budget = Budget(self.plan.budget_ms)

    @property
    def candidates(self) -> int:
        return sum(len(poses) for _, poses in self.found)

    def run(self) -> BestPlace | NoFix:
        """By the channels of the view alone; see `found_by`."""
        return self.outcome(self.best())

    def outcome(self, best: BestPlace | None) -> BestPlace | NoFix:
        """With its height counted from the ground below the camera."""
        if best is not None:
            return self.refiner.below_camera(best)
        if not self.touches_map:
            return NoFix("outside_map", "the area of the prior is outside the map")
        detail = "no place of the map could be compared with the view"
        if self.prior is None:
            detail += "; a large map needs a prior, or views as large as its tiles"
        return NoFix("no_match", detail)

    def best(self) -> BestPlace | None:
        """None where nothing was found."""
        stages = self.stages() if self.touches_map else []
        for stage, following in zip(stages, [*stages[1:], None], strict=False):
            if not self.budget.allows(stage.cost_ms):
                break
            self._take(stage)
            if found := self._ended(stage, following):
                return found
        return self.concluded()

    def by_gradients(self) -> "Search":
        """The same candidates and the likeliest ones without grey levels, compared without them, in
        the time that is left."""
        made = Search(self.map, self.view.by_gradients(), self.prior)
        made.budget = self.budget
        for each in self.found:
            made._judge(*each)
        stage = made._likeliest()
        if math.isfinite(stage.cost_ms) and self.budget.allows(stage.cost_ms):
            made._take(stage)
        return made

    def camera(self, place: Finished) -> CameraEstimate | None:
        """None where too few blocks of the view are seen."""
        ratio = place.scores.local_ratio if isinstance(place, BestPlace) else 1.0
        floor_m = self.map.floor_m(self.view)
        return camera_of(self.over_ground, place.fit.pose, ratio, floor_m, place.camera)

    # What is tried

    def stages(self) -> list[Stage]:
        """In this order until the search ends: on a small area the mid level, on a large one coarse
        candidates first; the final level where that is cheap too."""
        plan, levels = self.plan, self.levels
        every, nats = self._directions(plan.mid_steps)
        mid_ms = self._fft_ms(levels.mid, len(every))
        coarse = self._on_large_area(mid_ms) if mid_ms > plan.cheap_ms else []
        stages = [part for each in coarse for part in each.likely_first(self._likely(each))]
        if mid_ms <= max(plan.last_ms, plan.cheap_ms):
            # Over relief the expected scale is another one at every place.
            uniform = self.view.prior.scale_map is None
            tried_all = uniform and any(not each.from_tiles for each in coarse)
            stages += self._at_mid_level(every, nats, tried_all)
        final, _ = self._directions(plan.final_steps)
        stage = self._fft_stage(levels.final, final, plan.final_candidates)
        is_cheap = levels.final < levels.mid and stage.cost_ms <= plan.cheap_ms
        return [*stages, stage] if is_cheap else stages

    def _at_mid_level(
        self, every: Sequence[Direction], nats: Sequence[float], tried_all: bool
    ) -> list[Stage]:
        """By how likely headings and scales are; without the last stage where the coarse level
        `tried_all` and it takes long."""
        plan, stages = self.plan, []
        for least, most in pairwise(plan.stages_nats):
            some = [each for each, its in zip(every, nats, strict=True) if least < its <= most]
            if some:
                stages.append(self._fft_stage(self.levels.mid, some, plan.candidates))
        has_last = any(its > plan.stages_nats[-2] for its in nats)
        if has_last and tried_all and stages[-1].cost_ms > plan.last_stage_ms:
            stages.pop()
        return stages

    def _directions(self, steps: tuple[float, float]) -> tuple[list[Direction], list[float]]:
        """Those to try, the most likely first, and their negative log densities."""
        rated = self.plan.directions(self.view.prior, steps)
        return [each for each, _ in rated], [nats for _, nats in rated]

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
        tried, _ = self._directions(plan.coarse_steps)
        coarse = self._fft_stage(level, tried, plan.candidates)
        if coarse.cost_ms > plan.last_ms:
            far = self._fft_stage(level + 1, tried, plan.far_candidates)
            if not math.isinf(far.cost_ms):  # there is such a level
                coarse = far
        if self.map.propose is None or not self.tiles:
            return [coarse]
        count = plan.candidates_from(self.tiles)
        cost_ms = plan.tiles_ms(len(tried), self.tiles, self.map.propose.embedder.dims)
        cost_ms += plan.nearby_ms * count
        return [coarse, Stage(level, tried, count, cost_ms, from_tiles=True)]

    def _fft_stage(self, level: int, directions: list[Direction], count: int) -> Stage:
        cost_ms = self._fft_ms(level, len(directions))
        if level > self.levels.coarse:
            cost_ms += self.plan.nearby_ms * count
        return Stage(level, directions, count, cost_ms)

    def _likeliest(self) -> Stage:
        """All directions at the mid level where that takes little, else the first stage of them, or
        the coarse level where even that takes too long."""
        plan = self.plan
        every, nats = self._directions(plan.mid_steps)
        first = every[: max(sum(each <= plan.stages_nats[1] for each in nats), 1)]
        for some, most_ms in ((every, plan.cheap_ms), (first, plan.last_ms)):
            stage = self._fft_stage(self.levels.mid, some, plan.candidates)
            if stage.cost_ms <= most_ms:
                return stage
        return self._coarse_stages()[0]

    def _likely(self, stage: Stage) -> int:
        """How many directions of a coarse stage come first: all where the heading is known."""
        if self.view.prior.turn_rad is not None:
            return len(stage.directions)
        _, nats = self._directions(self.plan.coarse_steps)
        return sum(each <= self.plan.likely_nats for each in nats)

    # Candidates

    def _by_fft(self, stage: Stage) -> list[Peak]:
        """The peaks of correlation, of the sheet or of what the prior allows; those of a far level
        at their best places near by."""
        view, level, windows = self.view, stage.level, self.map.windows
        recipe = view.levels.recipe(level)
        template = self.sought.at(level, recipe)
        if self.prior is None:
            window = windows.whole(level, recipe, view.side_px)
        else:
            half_px = largest_half_px(template, stage.directions)
            middle, reach = self.middle_px, self.reach_px
            window = windows.part(level, recipe, view.side_px, middle, reach, half_px)
        # Every thread has memory for a whole window.
        fits = math.prod(window.size) * self.plan.threads <= self.plan.max_search_px
        pool = self.map.pool if fits else None
        found = search(template, window, stage.directions, stage.count, view.prior.scale_map, pool)
        if level > view.levels.coarse:
            return self._allowed_nearby(found, self.plan.far_reach_px * 2**level)
        return self._promising(found)

    def _from_tiles(self, stage: Stage) -> list[Peak]:
        """The most similar tiles that no tile next to them exceeds, each at its best place near
        by."""
        grid, expected, propose = self.map.grid, self.view.prior, self.map.propose
        assert propose is not None
        # Over a terrain the telemetry predicts another scale at every place.
        if expected.scale_map is not None:
            expected = replace(expected, log_scale_std=math.inf)
        nats = [expected.negative_log_density(*each) for each in stage.directions]
        tiles = propose.candidates(
            self.view.rectified_at(0),
            stage.directions,
            1 - np.float32(self.plan.tile_share_per_nat) * np.array(nats, np.float32),
            self.tile_rows,
            stage.count,
        )
        return self._allowed_nearby(
            tiles, self.plan.tile_reach_strides * grid.stride_m / grid.gsd_m
        )

    # Where it is tried

    @cached_property
    def middle_px(self) -> tuple[float, float]:
        """Where the prior expects the view, x and y at level 0."""
        assert self.prior is not None
        view = self.view
        place = self.map.sheet.frame.en_from_latlon(self.prior.lat_deg, self.prior.lon_deg)
        x, y = self.map.px_of(place)
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
        reach = PRIOR_SIGMAS * max(self.prior.std_m, 0.0) / self.map.grid.gsd_m
        return float(reach + tilt * min(turn, 1.0) + 2.0 * 2**view.levels.coarse)

    @property
    def touches_map(self) -> bool:
        if self.prior is None:
            return True
        (x, y), reach = self.middle_px, self.reach_px
        rows, cols = self.map.reference.shape(0)
        return -reach < x < cols + reach and -reach < y < rows + reach

    def _fft_ms(self, level: int, poses: int) -> float:
        """Of the sheet or what the prior allows; infinite where there is no such level."""
        if level >= self.map.reference.levels:
            return math.inf
        rows, cols = self.map.reference.shape(level)
        if self.prior is not None:
            across = 2 * self.reach_px / 2**level
            rows, cols = round(min(rows, across)), round(min(cols, across))
        side = self.view.side_px / 2**level
        if self.prior is not None or min(rows, cols) < 3 * side:
            rows, cols = round(rows + side), round(cols + side)
        return self.plan.fft_ms(poses, rows, cols)

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
        grid, (x, y) = self.map.grid, self.middle_px
        centre = np.array([grid.west_m + x * grid.gsd_m, grid.north_m - y * grid.gsd_m])
        reach_m = self.reach_px * grid.gsd_m + grid.stride_m
        return rows_within(self.map.propose.tiles.centres_en_m, centre, reach_m)

    # Near by

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
                free &= apart_px > self.plan.apart * self.view.templates.side_px
        return kept

    def _allowed_nearby(self, found: Sequence[Peak], reach_px: float) -> list[Peak]:
        """The promising ones within the prior."""
        kept = self._promising(self.nearby(found, reach_px))
        if self.prior is None:
            return kept
        x, y = self.middle_px
        return [
            each
            for each in kept
            if max(abs(each.pose.x_px - x), abs(each.pose.y_px - y)) <= self.reach_px
        ]

    def _moved(self, found: Sequence[Peak], reach_px: float) -> list[Peak]:
        level, windows = self.levels.coarse, self.map.windows
        recipe, side_px = self.levels.recipe(level), self.view.templates.side_px
        template, whole = self.sought.at(level, recipe), None
        if math.prod(self.map.reference.shape(level)) <= self.plan.whole_window_px:
            whole = windows.whole(level, recipe, side_px)
            whole.prepare_near(template)

        def moved(some: Sequence[Peak]) -> list[Peak]:
            place = some[0].pose.x_px, some[0].pose.y_px
            around_px = reach_px + side_px
            window = whole or windows.part(level, recipe, side_px, place, around_px)
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
        self._judge(stage, [each.pose for each in found])

    def _judge(self, stage: Stage, found: list[Pose]) -> None:
        self.found.append((stage, found))
        if stage.level < self.levels.mid:
            self.direct = self.refiner.direct(found)
        else:
            level = min(stage.level, self.levels.coarse)
            self.places += self.refiner.judge(found, level, self.places)

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
        if best <= margin.strength * self.chances.look or best <= margin.mid_ratio * rival:
            return None  # before the cost of finishing it
        found = self._finished(self.places)
        compared_all = not stage.from_tiles and stage.level <= levels.coarse
        proven = compared_all or self._is_proven(found, plan.doubt)
        return found if proven and self._is_clear(found, margin) else None

    def _proven_by_trial(self, stage: Stage, following: Stage) -> BestPlace | None:
        """The best few are finished on the terrain; where that proves none, they are compared one
        level finer. Where only a part of all places was compared, the best must stand out too. No
        trial before a stage that costs less, except the final level, before which all directions
        were tried."""
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
        places = self.refiner.on_terrain(self.places, plan.trials)
        compared_all = is_flat and stage.level == levels.mid and not stage.from_tiles
        doubt = plan.doubt if at_final else plan.trial_doubt
        for closer in (False, True):
            found = self._finished(places, plan.trials, closer=closer)
            if not compared_all and not self._is_clear(found, plan.trial_clear):
                return None
            if self._is_proven(found, doubt):
                return found
            if at_final or levels.final == 0:
                return None
        return None

    def concluded(self) -> BestPlace | None:
        """After all stages. While none is proven, more are finished and compared one level
        finer."""
        plan, levels, places = self.plan, self.levels, self.places
        if not places:
            return None
        if not self.refiner.is_flat and self.budget.allows(0.0):
            places = self.refiner.on_terrain(places, plan.terrain_candidates)
        found = self._finished(places)
        passes = plan.finer if levels.final > 0 else plan.finer[-1:]
        for kept, cost_ms in passes if levels.final != levels.mid else ():
            if self._is_proven(found, plan.doubt) or not self.budget.allows(cost_ms):
                break
            found = self._finished(places, kept, closer=True)
        if self.budget.cut_short:
            found = replace(found, scores=replace(found.scores, cut_short=True))
        return found

    def _finished(
        self, places: Sequence[Judged], kept: int = REFINEMENT.to_finish, *, closer: bool = False
    ) -> BestPlace:
        return self.refiner.finished(places, self.direct, kept=kept, closer=closer)

    def _is_clear(self, best: BestPlace, margin: ClearMargin) -> bool:
        scores = best.scores
        return (
            scores.strength > margin.strength * self.chances.total
            and scores.mid_ratio > margin.mid_ratio
            and scores.peak_ratio > margin.peak_ratio
        )

    def _is_proven(self, best: BestPlace, doubt: float) -> bool:
        return self.likelihood(best) > 1 - doubt

    def tentative(self) -> BestPlace | None:
        """The best place so far, not compared one level finer."""
        return self._finished(self.places) if self.places else None

    def is_doubtful(self, best: BestPlace) -> bool:
        """Whether it is not recognized, and there is time to compare all candidates again."""
        doubtful = self.map.confidence is not None and self.likelihood(best) < CONFIDENT
        again_ms = self.plan.trial_ms + self.plan.nearby_ms * self.candidates
        return doubtful and not self.budget.cut_short and self.budget.allows(again_ms)

    def likelihood(self, place: BestPlace | None) -> float:
        """Probability that the place is right, 0 for none."""
        if place is None or self.map.confidence is None:
            return 0.0
        return self.map.confidence(place.scores)


class Found(NamedTuple):
    """A place, and the search that found it."""

    search: Search
    place: BestPlace


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
