"""What a search tries, what that costs, and how far a place must stand out to end it.

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

Reasons are in docs/decisions/registration.md; values without one there were chosen on NAIP, Szada
and recorded flights. `search` executes them."""

import math
import time
from dataclasses import dataclass
from functools import lru_cache

from orthonav.core.register.pose import PosePrior
from orthonav.core.register.search import bank

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
    trial_ms: float = 25.0  # on level ground,
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

    def directions(self, prior: PosePrior, steps: Steps) -> list[tuple[Direction, float]]:
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
    prior = PosePrior(0.0 if known else None, turn_std_rad or 0.0, log_scale_std)
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
