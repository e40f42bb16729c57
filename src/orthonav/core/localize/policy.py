"""What a search tries, what that costs, and how far a place must stand out to end it.

A view is judged at one level of the map, where it is some 72 px across (`Levels.judged`). There are
three sources of candidates:

- the *judged level* by FFT: the only one that misses nothing, and the slowest on a large area;
- the *coarse level*, one above it, by FFT: a quarter of the pixels; or, on large areas, the level
  above that one, whose candidates are compared at the coarse level near by;
- the *tiles* whose embeddings are most similar to the view.

Where the judged level is cheap (a prior, a small sheet) only that one is searched. Elsewhere the
cheaper of the other two comes first; the next one follows only while the best place does not stand
out, and only if its estimated cost is acceptable. With an unknown heading both try the likely
scales first. At the judged level headings and scales come in stages, the most likely first, so that
an ordinary view ends after the first stage. Where position, heading and scale are known so well
that the *final level*, one below, is cheap too, it comes last, unless a place is proven before:
weak texture, such as that of bare ground, is only seen there.

Reasons are in docs/decisions/registration.md; values without one there were chosen on the scenes of
`python -m benchmarks.real_imagery`. `search` executes them.
"""

import math
import time
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

from orthonav.core.register.pose import PosePrior
from orthonav.core.register.search import bank

Direction = tuple[float, float]
"""Heading (rad, clockwise from north) and natural logarithm of the scale."""
Steps = tuple[float, float]
"""Spacing of headings (rad) and of log scales."""


class ClearMargin(NamedTuple):
    """How far a place must stand out for the search to end with it.

    `strength`: score over that of chance. `judged_ratio`, `peak_ratio`: score over that of the
    strongest rival, at the judged level and after finishing.
    """

    strength: float
    judged_ratio: float
    peak_ratio: float


CLEAR = ClearMargin(2.2, 1.9, 1.9)
CLEAR_AT_JUDGED = ClearMargin(1.8, 1.5, 1.5)
CLEAR_AFTER_TRIAL = ClearMargin(1.8, 1.25, 1.25)


@dataclass(frozen=True)
class SearchPolicy:
    """What a search tries, and when it ends."""

    coarse_steps: Steps = (math.radians(8.0), 0.13)
    """At the coarse level and for tiles, whose candidates are refined there first."""
    judged_steps: Steps = (math.radians(6.0), 0.09)
    """At the judged level: 8 deg lose 2 to 6 points of views."""
    final_steps: Steps = (math.radians(3.0), 0.045)
    """At the final level, half of those at the judged one."""
    bank_sigmas: float = 3.0
    """Headings and scales reach so many standard deviations of the telemetry."""
    max_nats: float = 5.5
    """Less likely ones (negative log density, 0 at the peak) are not tried: it rounds off the
    corners of the bank, where heading and scale are both far off."""
    stages_nats: tuple[float, ...] = (-1.0, 0.4, 2.0, math.inf)
    """Bounds of the stages at the judged level, in nats: those within 0.4 nats first."""
    likely_nats: float = 1.0
    """With an unknown heading, those within so many nats come first at the coarse level and for
    tiles: their scales are those of nine views in ten."""
    candidates: int = 24
    """Candidates of a search by FFT at the coarse level, and of one stage at the judged level."""
    far_candidates: int = 400
    """Candidates of a search by FFT one level above the coarse one."""
    far_reach_px: float = 1.5
    """Their place is sought within so many pixels of that level."""
    final_candidates: int = 2
    """Candidates of a search at the final level: each is finished."""
    tile_candidates: tuple[int, int] = (20, 400)
    """Least and largest number of candidates from tiles."""
    tiles_per_candidate: int = 200
    """Between these, one candidate for so many tiles: the right one ranks lower among more."""
    tile_share_per_nat: float = 0.03
    """Share of its similarity that a tile loses with every nat by which the telemetry contradicts
    its pose."""
    tile_reach_strides: float = 1.1
    """The place of a candidate from tiles is sought within so many strides of the tile grid."""
    nearby_log_scales: tuple[float, ...] = (-0.13, 0.0, 0.13)
    """Candidates from tiles and from above the coarse level are compared there under their log
    scale plus each of these, the best of which counts: their scale is hardly known."""
    view_tiles: tuple[float, float] = (0.6, 2.5)
    """Least and largest side of a view, in tiles, for which tiles are asked: below, most of a tile
    is missing; above, most of the view is unused."""
    min_candidates: int = 6
    """So many candidates are always kept, for the scores need rivals."""
    candidate_share: float = 0.5
    """Weaker candidates than this share of the best are dropped."""
    clear: ClearMargin = CLEAR
    """The search ends with a place that stands out so far. Views of other places reach a ratio of
    1.4, rarely 1.6."""
    clear_at_judged: ClearMargin = CLEAR_AT_JUDGED
    """The same once the judged level was searched, if only in part: it misses least. Also after
    tiles, where the place is confident as well: there can be more of them than places at the judged
    level that could be searched."""
    doubt: float = 0.01
    """A place with a confidence above one minus this is proven."""
    trial_doubt: float = 0.002
    """A trial proves a place with a confidence above one minus this: its rivals were not all
    searched. Before the final level they were, and `doubt` counts."""
    trial_clear: ClearMargin = CLEAR_AFTER_TRIAL
    """Where a trial compares only a part of all places, or only a few on the terrain, the place
    must also stand out so far."""
    trials: int = 3
    """Before a search that costs more than a trial, so many of the best candidates are placed on
    the terrain and finished, and compared one level finer where that proves none. The search ends
    if one is proven."""
    finer: tuple[tuple[int, float], ...] = ((3, 25.0), (48, 90.0))
    """Until a place is proven, so many candidates are finished and the best of them compared one
    level finer, with the estimated cost (ms): matches by chance lose more in detail, so that the
    right place may be far down the list of the judged level."""
    terrain_candidates: int = 48
    """At most so many candidates are placed on the terrain, the best that lie apart."""
    cheap_ms: float = 14.0
    """Up to this cost the judged level is searched at once, and nothing else."""
    last_ms: float = 900.0
    """A second search is left out where it would cost more: the limit of about a second for a view
    on a large area (README)."""
    last_stage_ms: float = 60.0
    """The last stage, poses that one view in seven has, is left out where it would cost more and
    the coarse level has tried them."""

    def candidates_from(self, tiles: int) -> int:
        """Number of candidates to take from so many tiles."""
        least, most = self.tile_candidates
        return max(least, min(most, round(tiles / self.tiles_per_candidate)))

    def directions(self, prior: PosePrior, steps: Steps) -> list[tuple[Direction, float]]:
        """Headings and log scales to try, each with its negative log density in nats, the most
        likely first."""
        turn_std_rad = None if prior.turn_rad is None else prior.turn_std_rad
        rated = _likely_directions(turn_std_rad, prior.log_scale_std, steps, self.bank_sigmas)
        reported = prior.turn_rad or 0.0
        return [
            ((reported + turn, log_scale), nats)
            for turn, log_scale, nats in rated
            if nats <= self.max_nats
        ]


@lru_cache(64)
def _likely_directions(
    turn_std_rad: float | None, log_scale_std: float, steps: Steps, sigmas: float
) -> list[tuple[float, float, float]]:
    """Turns from the reported heading and log scales, each with its negative log density in nats,
    the most likely first. Cached: the standard deviations are mostly those of the view before."""
    made = bank(
        turn_std_rad,
        log_scale_std,
        turn_step_rad=steps[0],
        scale_step=steps[1],
        sigmas=sigmas,
    )
    known = turn_std_rad is not None
    prior = PosePrior(0.0 if known else None, turn_std_rad or 0.0, log_scale_std)
    cell = steps[0] / 2, steps[1] / 2
    rated = [(*pose, prior.nats(*pose, within=cell)) for pose in made]
    return sorted(rated, key=lambda each: each[2])


@dataclass(frozen=True)
class CostModel:
    """Rough costs, ms on one core of a desktop, and what memory allows. They only choose between
    searches."""

    fft_pose_ms: float = 0.01
    """Of one pose of an FFT search, whatever its size."""
    fft_pixel_ms: float = 2.2e-7
    """Of one pixel of the window under one pose, times the logarithm (base 2) of their number."""
    max_search_px: int = 8_000_000
    """Larger windows (some 300 MB) are not searched by FFT: on such a map views are found by
    tiles, or with a prior."""
    tile_view_ms: float = 4.0
    """Of representing a view for its embeddings."""
    tile_pose_ms: float = 0.06
    """Of embedding the view under one pose."""
    tile_score_ms: float = 5e-8
    """Of one number of one tile's embedding under one pose."""
    nearby_ms: float = 0.2
    """Of the place of one candidate from tiles or from above the coarse level."""
    trial_ms: float = 25.0
    terrain_trial_ms: float = 60.0
    """Of a trial, on level ground and on a terrain."""

    def fft_ms(self, poses: int, rows: int, cols: int) -> float:
        """Of an FFT search of a window; infinite where it is too large."""
        pixels = float(rows * cols)
        if pixels > self.max_search_px:
            return math.inf
        return poses * (self.fft_pose_ms + self.fft_pixel_ms * pixels * math.log2(pixels))

    def tiles_ms(self, poses: int, tiles: int, dims: int) -> float:
        """Of the most similar of so many tiles with embeddings of `dims` numbers."""
        return self.tile_view_ms + poses * (self.tile_pose_ms + self.tile_score_ms * tiles * dims)


@dataclass(frozen=True)
class SearchPlan:
    """A policy with its costs, and what the user allows.

    `budget_ms`: no search after the first one is begun that would end later than this after the
    first one began; the best place so far is the answer. `threads`: share the poses of a search and
    the candidates.
    """

    budget_ms: float = math.inf
    threads: int = 1
    policy: SearchPolicy = field(default_factory=SearchPolicy)
    costs: CostModel = field(default_factory=CostModel)


DEFAULT_PLAN = SearchPlan()
"""What flies."""


class Budget:
    """Time that a search may take. Estimates are corrected by what they took."""

    def __init__(self, budget_ms: float) -> None:
        self._budget_ms, self._begun_s = budget_ms, time.monotonic()
        self._estimated_ms: float | None = None
        self.cut_short = False

    def fits(self, cost_ms: float) -> bool:
        """Whether what has an estimated cost would end in time; what comes first always does."""
        if self._estimated_ms is None:
            return True
        spent_ms = 1e3 * (time.monotonic() - self._begun_s)
        pace = spent_ms / self._estimated_ms if self._estimated_ms else 0.0
        return not spent_ms + pace * cost_ms > self._budget_ms  # NaN where nothing took time yet

    def allows(self, cost_ms: float) -> bool:
        """Whether to begin what has an estimated cost; without it, the search is cut short."""
        if not self.fits(cost_ms):
            self.cut_short = True
            return False
        self._estimated_ms = (self._estimated_ms or 0.0) + cost_ms
        return True
