"""What a search tries, what that costs, and when it is enough: the numbers, as data.

Reasons are in docs/decisions/registration.md; values without one there were chosen on the real
scenes of `benchmarks.scenes`."""

import math
from dataclasses import dataclass

from orthonav.core.register.search import Steps


@dataclass(frozen=True)
class ClearMargin:
    """How far a place must stand out: over chance (`strength`) and over the strongest rival."""

    strength: float
    mid_ratio: float
    peak_ratio: float


@dataclass(frozen=True)
class SearchPlan:
    """What is tried, rough costs on one core of a desktop to choose by, and what the user allows.

    No search but the first is begun that would end later than `budget_ms`; `threads` share poses
    and candidates."""

    budget_ms: float = math.inf
    threads: int = 1

    # Headings and scales
    coarse_steps: Steps = (math.radians(8.0), 0.13)
    """Of tiles too, whose candidates are refined at the coarse level."""
    mid_steps: Steps = (math.radians(6.0), 0.09)  # 8 deg lose 2 to 6 points of views
    final_steps: Steps = (math.radians(3.0), 0.045)
    bank_sigmas: float = 3.0  # reach in standard deviations of the telemetry
    max_penalty: float = 5.5
    """Less likely directions (negative log density) are not tried: corners of the bank."""
    stage_penalties: tuple[float, ...] = (-1.0, 0.4, 2.0, math.inf)
    """Bounds of the stages at the mid level."""
    likely_penalty: float = 1.0
    """With an unknown heading those below come first: the scales of nine views in ten."""

    # Candidates
    candidates: int = 24  # of the coarse level, and of one stage at the mid level
    far_candidates: int = 400  # one level above the coarse one,
    far_reach_px: float = 1.5  # whose places are sought within so many pixels of that level
    final_candidates: int = 2  # each is refined there
    tile_candidates: tuple[int, int] = (20, 400)  # least and largest number,
    tiles_per_candidate: int = 200
    """between them one for so many: the right one ranks lower among more."""
    tile_share_per_penalty: float = 0.03
    """Fraction of its similarity that a tile loses per unit of penalty by the telemetry."""
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
    finer: tuple[tuple[int, float], ...] = ((3, 25.0), (48, 90.0))
    """Places compared at the final level and one finer until one is proven, and the cost (ms)."""
    terrain_candidates: int = 48  # placed on the terrain, at most

    # Limits of cost and memory
    cheap_ms: float = 14.0  # up to this cost the mid level is searched at once, and nothing else
    last_ms: float = 900.0
    """A second search is left out above: about a second for a view on a large area (README)."""
    last_stage_ms: float = 60.0
    """The last stage, one view in seven, is left out above after the coarse level."""
    gradients_ms: float = 300.0
    """Most of the mid level by gradients alone, above it is the coarse one: over a whole sheet the
    map's channels are made for it, ten times as long, and half a gigabyte over 100 km2."""
    nearby_ms: float = 0.2  # of one candidate from tiles or from above the coarse level
    trial_ms: float = 25.0  # on flat ground,
    terrain_trial_ms: float = 60.0  # and on a terrain
    max_search_px: int = 8_000_000  # larger windows (some 300 MB) are left to tiles or a prior
    whole_window_px: int = 8_000_000
    """Up to so many pixels of the coarse level one window of the whole sheet is cut (12 bytes)."""


DEFAULT_PLAN = SearchPlan()
