"""Candidates for one view on one sheet, by FFT or from the most similar tiles, and their cost."""

import math
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from orthonav.core.localize.plan import Search, SearchPlan
from orthonav.core.localize.tiles import TileProposer
from orthonav.core.localize.view import PreparedView
from orthonav.core.mapfile.manifest import SheetInfo
from orthonav.core.records import PRIOR_SIGMAS, Prior
from orthonav.core.register.pose import rotation
from orthonav.core.register.registrar import Registrar
from orthonav.core.register.search import Candidate, largest_half_px, search
from orthonav.core.tiles.exact import rows_within


@dataclass(frozen=True, eq=False)
class ViewCandidates:
    """Finds candidates for `view` within `prior` (None: anywhere on the sheet).

    - `sheet`, `registrar`: the sheet and its imagery.
    - `propose`: compares tiles with the view; None: searches by FFT only.
    - `plan`: parameters of the search.
    - `pool`: threads that share the poses of a search; None: the caller's alone.
    """

    view: PreparedView
    prior: Prior | None
    sheet: SheetInfo
    registrar: Registrar
    propose: TileProposer | None
    plan: SearchPlan
    pool: Executor | None

    @cached_property
    def middle_px(self) -> tuple[float, float]:
        """The middle of the view as the prior expects it, x and y at level 0."""
        assert self.prior is not None
        grid, view = self.sheet.grid, self.view
        east, north = self.sheet.frame.en_from_latlon(self.prior.lat_deg, self.prior.lon_deg)
        x = (float(east) - grid.west_m) / grid.gsd_m
        y = (grid.north_m - float(north)) / grid.gsd_m
        if view.prior.turn_rad is None:
            return x, y
        moved = rotation(view.prior.turn_rad) @ view.camera_px
        return x - float(moved[0]), y - float(moved[1])

    @cached_property
    def reach_px(self) -> float:
        """How far from there it may lie, in pixels of level 0; infinite without a prior."""
        if self.prior is None:
            return math.inf
        view = self.view
        tilt = float(np.hypot(*view.camera_px))
        turn = 2.0 if view.prior.turn_rad is None else 2 * view.prior.turn_std_rad
        reach = PRIOR_SIGMAS * max(self.prior.std_m, 0.0) / self.sheet.grid.gsd_m
        return float(reach + tilt * min(turn, 1.0) + 2.0 * 2**view.levels.coarse)

    @property
    def touches_map(self) -> bool:
        """Whether any of the map lies where the prior allows the view to be."""
        if self.prior is None:
            return True
        (x, y), reach = self.middle_px, self.reach_px
        rows, cols = self.registrar.reference.shape(0)
        return -reach < x < cols + reach and -reach < y < rows + reach

    def fft_ms(self, level: int, poses: int) -> float:
        """Estimated cost of an FFT search at a level, of the sheet or of what the prior allows;
        infinite where there is no such level."""
        if level >= self.registrar.reference.levels:
            return math.inf
        rows, cols = self.registrar.reference.shape(level)
        if self.prior is not None:
            across = 2 * self.reach_px / 2**level
            rows, cols = round(min(rows, across)), round(min(cols, across))
        side = self.view.side_px / 2**level
        if self.prior is not None or min(rows, cols) < 3 * side:
            rows, cols = round(rows + side), round(cols + side)
        return self.plan.fft_ms(poses, rows, cols)

    def tiles(self) -> tuple[int, int]:
        """Number of tiles to compare with the view, and of numbers in their embeddings."""
        propose, rows = self.propose, self._rows
        if propose is None or not propose.fits(self.view.side_px, self.plan.view_tiles):
            return 0, 0
        count = len(propose.centres_en_m) if rows is None else len(rows)
        return count, propose.embedder.dims

    @cached_property
    def _rows(self) -> NDArray[np.intp] | None:
        """Rows of the tiles that the prior allows, None for all."""
        if self.prior is None or self.propose is None:
            return None
        grid, (x, y) = self.sheet.grid, self.middle_px
        centre = np.array([grid.west_m + x * grid.gsd_m, grid.north_m - y * grid.gsd_m])
        reach_m = self.reach_px * grid.gsd_m + grid.stride_m
        return rows_within(self.propose.centres_en_m, centre, reach_m)

    def found(self, run: Search) -> list[Candidate]:
        """Candidates of one search, best first."""
        return self._from_tiles(run) if run.from_tiles else self._by_fft(run)

    def _from_tiles(self, run: Search) -> list[Candidate]:
        """The most similar tiles, each at its best place near by."""
        assert self.propose is not None
        plan, view, grid = self.plan, self.view, self.sheet.grid
        # Over a terrain the telemetry predicts another scale at every place.
        expected = view.prior
        if expected.scale_map is not None:
            expected = replace(expected, log_scale_std=math.inf)
        nats = np.array([expected.nats(*pose) for pose in run.poses], np.float32)
        tiles = self.propose.candidates(
            view.rectified_at(0),
            run.poses,
            1 - np.float32(plan.tile_share_per_nat) * nats,
            self._rows,
            run.candidates,
        )
        return self._nearby(tiles, plan.tile_reach_strides * grid.stride_m / grid.gsd_m)

    def _by_fft(self, run: Search) -> list[Candidate]:
        """The best places of the sheet, or of what the prior allows, at the level of a search."""
        view, level = self.view, run.level
        recipe = view.levels.recipe(level)
        template = view.templates.at(level, recipe)
        if self.prior is None:
            window = self.registrar.whole_window(level, recipe, view.side_px)
        else:
            half_px = largest_half_px(template, run.poses)
            window = self.registrar.part_window(
                level, recipe, view.side_px, self.middle_px, self.reach_px, half_px
            )
        # Every thread has memory for a whole window.
        fits = math.prod(window.size) * self.plan.threads <= self.plan.max_search_px
        pool = self.pool if fits else None
        found = search(template, window, run.poses, run.candidates, view.prior.scale_map, pool)
        if level > view.levels.coarse:
            return self._nearby(found, self.plan.far_reach_px * 2**level)
        return self._promising(found)

    def _nearby(self, found: list[Candidate], reach_px: float) -> list[Candidate]:
        """Candidates at the best place within `reach_px` (level 0) of each, at the coarse level;
        those that the prior allows."""
        view, scales = self.view, self.plan.nearby_log_scales
        moved = self._promising(
            self.registrar.nearby(view.templates, view.levels, found, reach_px, scales)
        )
        if self.prior is None:
            return moved
        x, y = self.middle_px
        return [
            each
            for each in moved
            if max(abs(each.pose.x_px - x), abs(each.pose.y_px - y)) <= self.reach_px
        ]

    def _promising(self, found: list[Candidate]) -> list[Candidate]:
        """The first of candidates, best first: those that are not far weaker than the best."""
        least = self.plan.candidate_share
        enough = sum(each.score >= least * found[0].score for each in found)
        return found[: max(enough, self.plan.min_candidates)]
