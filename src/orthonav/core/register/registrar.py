"""From a view to its best place on the map, and the evidence for it.

Candidates come from a search of a window by FFT, or from tiles whose embeddings are similar. They
are refined from coarse to fine and most are dropped early. The best of the last few is the result;
its score over that of the strongest rival is the evidence.
"""

import math
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np

from orthonav.core.register.channels import COARSE, FINE, ChannelRecipe
from orthonav.core.register.kernel import KERNEL
from orthonav.core.register.pose import Pose, ScaleMap
from orthonav.core.register.refine import Placed, Refiner
from orthonav.core.register.search import PLACES_AT_ONCE, Candidate, SearchWindow, best_near
from orthonav.core.register.sharpness import Sharpness, sharpness
from orthonav.core.register.template import ViewTemplates
from orthonav.core.register.window import Reference

LOOK_PX = 72.0
"""A view is judged at the level where it is about so many pixels across
(docs/decisions/registration.md)."""
KEPT_TO_LOOK = 200
"""Candidates that pass from the coarse level to the judged one, at most
(docs/decisions/registration.md)."""
KEPT_TO_FINISH = 3
"""Places that are finished: the best and its rivals."""
KEPT_TO_FINEST = 12
"""So many of them are compared one level finer, at most, where they are in doubt."""
HOPE_AT_FIRST = 0.4
HOPE = 0.5
"""Candidates below these shares of the best score are dropped, after one step and after all steps
of a level (docs/decisions/registration.md)."""
MIN_HOPEFUL = 4
"""So many stay whatever their score, for the evidence needs rivals."""
FIRST_STEPS = 1
FULL_STEPS = 4
"""Steps of refinement before and after the first of these decisions."""
ROUGH_STEP_PX = 0.1
"""Candidates that are only compared need no smaller steps."""
EXCLUSION_SHARE = 0.25
"""A rival lies farther from the best than this share of the view's side."""
NAT_SCORE = 1.0
"""Units of the score per nat of the prior of heading and scale
(docs/decisions/registration.md)."""
MAX_KEPT_WINDOWS = 4
"""Search windows of whole sheets in the cache."""
SAME_PLACE_SHARE = 1 / 8
"""Candidates from tiles closer together than this share of the view's side are one place."""
WHOLE_WINDOW_PX = 8_000_000
"""Up to so many pixels of the coarse level their surroundings are cut out of one window of the
whole sheet (12 bytes each); of larger sheets a window is made for each."""
MAX_RATIO = 10.0
"""Limit of the ratios in the evidence."""
Given = TypeVar("Given")
Made = TypeVar("Made")


@dataclass(frozen=True)
class PosePrior:
    """Expected heading and scale: `turn_rad` (None: unknown), and standard deviations of both.

    `scale_map`: the log scale expected at each place, with a deviation of its own; None where 0 is
    expected everywhere.
    """

    turn_rad: float | None
    turn_std_rad: float
    log_scale_std: float
    scale_map: ScaleMap | None = None

    def cost(self, pose: Pose) -> float:
        """What is subtracted from the score of a pose, by the prior."""
        if self.scale_map is None:
            return NAT_SCORE * self.nats(pose.turn_rad, pose.log_scale)
        own = PosePrior(self.turn_rad, self.turn_std_rad, self.scale_map.std)
        expected = self.scale_map.at(pose.x_px, pose.y_px)
        return NAT_SCORE * own.nats(pose.turn_rad, pose.log_scale - expected)

    def nats(
        self, turn_rad: float, log_scale: float, *, within: tuple[float, float] = (0.0, 0.0)
    ) -> float:
        """Negative log density of a heading and scale, 0 at its peak.

        Where they stand for all `within` (rad, log scale) around, that of the likeliest of those.
        """
        parts = [(log_scale, self.log_scale_std, within[1])]
        if self.turn_rad is not None:
            off = math.remainder(turn_rad - self.turn_rad, 2 * math.pi)
            parts.append((off, self.turn_std_rad, within[0]))
        return sum((max(abs(o) - w, 0.0) / max(std, 0.01)) ** 2 / 2 for o, std, w in parts)


@dataclass(frozen=True)
class Levels:
    """Levels of the map at which a view is searched coarsely, judged, and finished."""

    coarse: int
    look: int
    final: int

    @classmethod
    def of(cls, view_px: float, levels: int) -> "Levels":
        """Levels for a view of `view_px` pixels of level 0 across (root of its area)."""
        look = max(0, min(round(math.log2(max(view_px, 1.0) / LOOK_PX)), levels - 1))
        return cls(min(look + 1, levels - 1), look, max(look - 1, 0))

    def recipe(self, level: int) -> ChannelRecipe:
        """Parameters of the evidence at a level."""
        return COARSE if level > self.look else FINE


class OwnRatios(NamedTuple):
    """What a place says of itself.

    `detail`: score at the final level over that at the judged level, NaN where these are the same
    level. `local`: how far it stands out from the ground around it, at the final level.
    """

    detail: float
    local: Sharpness


class Finished(NamedTuple):
    """A candidate at the final level: `total`, its scores at the final and the judged level added
    up; `placed`; the `templates` it was placed by; `look`: its score at the judged level, where
    these differ from those it was judged by."""

    total: float
    placed: Placed
    templates: ViewTemplates
    look: float | None = None


class _Finalist(NamedTuple):
    """A finished candidate: `score`, its total less the cost of its prior; `fine`: the same with
    one finer level added, NaN where it was not compared there."""

    score: float
    made: Finished
    fine: float = math.nan

    def weight(self, best: "_Finalist") -> float:
        """Its score, at most as far below that of the best one as with the finer level."""
        if math.isnan(self.fine) or best.fine <= 0:
            return self.score
        return min(self.score, best.score * self.fine / best.fine)


@dataclass(frozen=True, eq=False)
class Registered:
    """The best place of a view, with its rivals.

    `placed` is where it was finished, with its covariance. `score` adds up the scores of the levels
    it was judged and finished at, `rival` is the best such score at another place; `look_score` and
    `look_rival` compare all candidates at the level they were judged at; `fine_score` and
    `fine_rival` the finalists with one finer level added, NaN where that was not needed.
    `finalists` are the best of the finished places, with their scores, best first. `own`: what the
    place says of itself, without rivals. `cut_short`: whether searches were left out for want of
    time.
    """

    placed: Placed
    score: float
    rival: float
    look_score: float
    look_rival: float
    candidates: int
    finalists: tuple[tuple[float, Placed], ...]
    own: OwnRatios
    fine_score: float = math.nan
    fine_rival: float = math.nan
    cut_short: bool = False

    @property
    def look_ratio(self) -> float:
        """Score of the best over that of its strongest rival, at the judged level."""
        return self.look_score / max(self.look_rival, 1e-6)

    @property
    def peak_ratio(self) -> float:
        """Score of the best over that of its strongest rival, after finishing."""
        return self.score / max(self.rival, 1e-6)

    def evidence(self) -> dict[str, float]:
        """The numbers behind a fix, as `docs/reference/formats.md` lists them."""
        gradient, grey = self.placed.correlations
        found = {
            "score": self.placed.weighted,
            "strength": self.score,
            "rival": self.rival,
            "look": self.look_score,
            "look_rival": self.look_rival,
            "fine": self.fine_score,
            "fine_rival": self.fine_rival,
            "peak_ratio": min(MAX_RATIO, self.peak_ratio),
            "look_ratio": min(MAX_RATIO, self.look_ratio),
            "gradient_correlation": gradient,
            "grey_correlation": grey,
            "detail_ratio": self.own.detail,
            "local_ratio": self.own.local.ratio,
            "local_gradients": self.own.local.gradients,
            "local_phase": self.own.local.phase,
            "blocks_t": self.placed.blocks_t,
            "agreement": self.placed.agreement,
            "overlap": self.placed.overlap,
            "candidates": float(self.candidates),
        }
        return found | ({"cut_short": 1.0} if self.cut_short else {})


class Registrar:
    """Registers views on one sheet. Safe to share between threads."""

    def __init__(self, reference: Reference, pool: Executor | None = None) -> None:
        """`pool`: threads that share the candidates; None: the caller's alone."""
        self.reference = reference
        self._pool = pool
        self._windows: dict[tuple[int, ChannelRecipe, int], SearchWindow] = {}
        self._lock = threading.Lock()

    def whole_window(self, level: int, recipe: ChannelRecipe, view_px: float) -> SearchWindow:
        """The whole sheet at a level, cached: views of about the same size share it."""
        side = _rounded_side(view_px / 2**level)
        key = (level, recipe, side)
        with self._lock:
            found = self._windows.pop(key, None)
            if found is None:
                found = SearchWindow(self.reference.whole(level, recipe), level, 0, 0, side)
                while len(self._windows) >= MAX_KEPT_WINDOWS:
                    self._windows.pop(next(iter(self._windows)))
            self._windows[key] = found  # the least recently used one is the first
        return found

    def part_window(
        self,
        level: int,
        recipe: ChannelRecipe,
        view_px: float,
        centre_px: tuple[float, float],
        reach_px: float,
        half_px: int | None = None,
    ) -> SearchWindow:
        """The square whose middles of views reach `reach_px` (level 0) around a point (x, y).

        `half_px`: see `SearchWindow`.
        """
        unit = 2.0**level
        margin = math.ceil(view_px / 2 / unit)
        rows, cols = self.reference.shape(level)
        low, size = [], []
        for middle, extent in zip(centre_px, (cols, rows), strict=True):
            # Middles farther out than half a view see nothing of the sheet.
            first = math.floor(max((middle - reach_px) / unit, -margin))
            last = math.ceil(min((middle + reach_px) / unit + 2, extent + margin))
            low.append(first - margin)
            size.append(max(last - first, 1) + 2 * margin)
        made = self.reference.window(level, low[1], low[0], size[1], size[0], recipe)
        side = _rounded_side(view_px / unit)
        return SearchWindow(made, level, low[1], low[0], side, margin, half_px)

    def nearby(
        self,
        templates: ViewTemplates,
        levels: Levels,
        candidates: Sequence[Candidate],
        reach_px: float,
        log_scales: Sequence[float] = (0.0,),
    ) -> list[Candidate]:
        """Candidates at the best place within `reach_px` (level 0) of each, at the coarse level.

        Each is compared under its log scale plus each of `log_scales`, the best of which counts.
        Best first; of candidates that end at the same place the best one stays.
        """
        recipe, side_px = levels.recipe(levels.coarse), view_side_px(templates)
        template = templates.at(levels.coarse, recipe)
        whole = None
        if math.prod(self.reference.shape(levels.coarse)) <= WHOLE_WINDOW_PX:
            whole = self.whole_window(levels.coarse, recipe, side_px)
            _ = whole.channels
        if KERNEL is None:
            _ = template.interleaved  # made, like the channels, before threads ask for them

        def moved(some: Sequence[Candidate]) -> list[Candidate]:
            place = some[0].pose.x_px, some[0].pose.y_px
            around_px = reach_px + side_px
            window = whole or self.part_window(levels.coarse, recipe, side_px, place, around_px)
            made = []
            for more in log_scales:
                poses = [replace(each.pose, log_scale=each.pose.log_scale + more) for each in some]
                made.append(best_near(template, window, poses, reach_px))
            return [max(same, key=lambda each: each.score) for same in zip(*made, strict=True)]

        at_once = PLACES_AT_ONCE if whole else 1
        parts = [candidates[at : at + at_once] for at in range(0, len(candidates), at_once)]
        found = [each for some in self._shared(moved, parts) for each in some]
        found.sort(key=lambda each: -each.score)
        places = np.array([complex(each.pose.x_px, each.pose.y_px) for each in found])
        free = np.ones(len(found), np.bool_)
        kept = []
        for number, each in enumerate(found):
            if free[number]:
                kept.append(each)
                free &= abs(places - places[number]) > side_px * SAME_PLACE_SHARE
        return kept

    def judged(
        self,
        templates: ViewTemplates,
        levels: Levels,
        candidates: Sequence[Candidate],
        level: int,
        prior: PosePrior,
        known: Sequence[Placed] = (),
    ) -> list[Placed]:
        """Candidates found at `level`, refined down to the judged level, best first.

        Those far below the best are dropped; at the judged level the best `known` one counts too.
        """
        placed = [Placed.unjudged(found.pose, level) for found in candidates]
        for at in range(level, levels.look - 1, -1):
            refiner = self.refiner(templates, levels, at)
            rivals = known if at == levels.look else ()
            placed = self._compared(refiner, placed, prior, rivals)
            if at > levels.look:
                placed = _hopeful(placed, prior, HOPE)[:KEPT_TO_LOOK]
        return placed

    def direct(
        self, templates: ViewTemplates, levels: Levels, candidates: Sequence[Candidate]
    ) -> list[Placed]:
        """Candidates found at the final level, with their scores at the judged one: refined there
        they would be lost again."""
        look = self.refiner(templates, levels, levels.look)
        return [look.place(found.pose, 0) for found in candidates]

    def standing(
        self, templates: ViewTemplates, judged: Sequence[Placed], prior: PosePrior
    ) -> tuple[float, float]:
        """Score of the best judged candidate, and of its strongest rival."""
        values = [each.score - prior.cost(each.pose) for each in judged]
        best = int(np.argmax(values))
        exclusion = EXCLUSION_SHARE * view_side_px(templates)
        rivals = [
            value
            for value, each in zip(values, judged, strict=True)
            if apart_px(each, judged[best]) > exclusion
        ]
        return values[best], max(rivals, default=0.0)

    def _compared(
        self, refiner: Refiner, placed: list[Placed], prior: PosePrior, known: Sequence[Placed]
    ) -> list[Placed]:
        """Candidates refined at one level, best first; those without hope only a little."""
        first = self._placed(refiner, placed, FIRST_STEPS)
        if not first:
            return []
        ranked = _ranked(first, prior)
        least, at_least = 0.0, MIN_HOPEFUL
        if known:
            least = HOPE * max(each.score - prior.cost(each.pose) for each in known)
            at_least = 1
        hopeful = _hopeful(ranked, prior, HOPE_AT_FIRST, at_least, least)
        further = self._placed(refiner, hopeful, FULL_STEPS)
        return _ranked(further + ranked[len(hopeful) :], prior)

    def _placed(self, refiner: Refiner, found: Sequence[Placed], steps: int) -> list[Placed]:
        """Candidates after so many steps at most, in their order."""
        refiner.prepare()
        return self._shared(lambda each: refiner.place(each.pose, steps, ROUGH_STEP_PX), found)

    def _shared(self, function: Callable[[Given], Made], given: Sequence[Given]) -> list[Made]:
        """What a function makes of each, in order; by all threads, where there are some."""
        return list((self._pool.map if self._pool else map)(function, given))

    def finished(
        self,
        templates: ViewTemplates,
        levels: Levels,
        judged: Sequence[Placed],
        prior: PosePrior,
        candidates: int,
        finish: Callable[[Placed], Finished] | None = None,
        direct: Sequence[Placed] = (),
        finer: Callable[[Placed], float] | None = None,
        kept: int = KEPT_TO_FINISH,
    ) -> Registered:
        """The best of the judged candidates, of one or more searches of `candidates` in all.

        The best `kept` of them are refined at the final level, and all `direct` ones, which were
        found there; each by `finish` (None: `at_final`). With `finer`, the score of a finalist one
        level finer, the best `KEPT_TO_FINEST` of those are compared at that level as well. `judged`
        must not be empty.
        """
        judged = _ranked(judged, prior)
        exclusion = EXCLUSION_SHARE * view_side_px(templates)
        finalists = _hopeful(_distinct(judged, kept, exclusion), prior, HOPE, 2)
        totals = []
        for each in (*finalists, *direct):
            made = finish(each) if finish else self.at_final(templates, levels, each)
            totals.append(_Finalist(made.total - prior.cost(made.placed.pose), made))
        totals.sort(key=lambda each: -each.score)
        if finer:
            compared = [
                each._replace(fine=each.score + finer(each.made.placed))
                for each in totals[:KEPT_TO_FINEST]
            ]
            totals = sorted(compared, key=lambda each: -each.fine)
        first = totals[0]
        best = first.made.placed
        rivals = [each for each in totals if apart_px(each.made.placed, best) > exclusion]
        judged = [*judged, *direct]
        nearest = min(judged, key=lambda each: apart_px(each, best))
        others = [each for each in judged if apart_px(each, best) > exclusion]
        looks = [(each.score, each) for each in others]
        looks += [
            (each.made.look, each.made.placed) for each in rivals if each.made.look is not None
        ]
        look = first.made.look
        cost = prior.cost(nearest.pose) if look is None else prior.cost(best.pose)
        return Registered(
            placed=self.with_covariance(first.made.templates, levels, best),
            score=first.score,
            rival=max((each.score for each in rivals), default=0.0),
            look_score=(nearest.score if look is None else look) - cost,
            look_rival=max((score - prior.cost(each.pose) for score, each in looks), default=0.0),
            fine_score=first.fine,
            fine_rival=max((each.fine for each in rivals), default=0.0) if finer else math.nan,
            candidates=candidates,
            finalists=tuple((each.weight(first), each.made.placed) for each in totals),
            own=self._own_ratios(
                first.made.templates, levels, first.score + prior.cost(best.pose), best
            ),
        )

    def with_covariance(self, templates: ViewTemplates, levels: Levels, best: Placed) -> Placed:
        """A placed view once more, at the final level, with its covariance."""
        final = self.refiner(templates, levels, levels.final)
        return final.place(best.pose, 3, with_covariance=True)

    def _own_ratios(
        self, templates: ViewTemplates, levels: Levels, total: float, best: Placed
    ) -> OwnRatios:
        """Of a finished place, `total` its scores at the final and the judged level added up."""
        final = templates.at(levels.final, levels.recipe(levels.final))
        detail = math.nan
        if levels.final != levels.look:
            detail = max(best.score, 1e-3) / max(total - best.score, 1e-3)
        return OwnRatios(detail, sharpness(final, self.reference, best.pose))

    def at_final(self, templates: ViewTemplates, levels: Levels, judged: Placed) -> Finished:
        """A judged candidate refined at the final level, and the sum of its scores."""
        if levels.final == levels.look:
            return Finished(judged.score, judged, templates)
        placed = self.refiner(templates, levels, levels.final).place(
            judged.pose, FULL_STEPS, ROUGH_STEP_PX
        )
        again = self.refiner(templates, levels, levels.look).place(placed.pose, 0)
        return Finished(placed.score + again.score, placed, templates)

    def refiner(self, templates: ViewTemplates, levels: Levels, level: int) -> Refiner:
        """The refiner of a view at one of its levels."""
        return Refiner(templates.at(level, levels.recipe(level)), self.reference)


def view_side_px(templates: ViewTemplates) -> float:
    """Root of the area of a view, in pixels of level 0."""
    return math.sqrt(templates.at(templates.finest).pixels) * 2.0**templates.finest


def _rounded_side(side: float) -> int:
    """A side rounded up by steps of about a quarter, so that views of like size share a window."""
    return math.ceil(2 ** (math.ceil(4 * math.log2(max(side, 8.0))) / 4))


def _ranked(placed: Sequence[Placed], prior: PosePrior) -> list[Placed]:
    return sorted(placed, key=lambda each: prior.cost(each.pose) - each.score)


def _hopeful(
    ranked: list[Placed],
    prior: PosePrior,
    share: float,
    at_least: int = MIN_HOPEFUL,
    least: float = 0.0,
) -> list[Placed]:
    """The first of candidates, best first, that reach `least` and a share of the best score."""
    values = [each.score - prior.cost(each.pose) for each in ranked]
    enough = sum(value >= max(share * values[0], least) for value in values)
    return ranked[: max(enough, at_least)]


def _distinct(placed: list[Placed], count: int, apart: float) -> list[Placed]:
    """The first `count` that are farther than `apart` (pixels of level 0) from each other."""
    kept: list[Placed] = []
    for each in placed:
        if all(apart_px(each, other) > apart for other in kept):
            kept.append(each)
        if len(kept) == count:
            break
    return kept


def apart_px(one: Placed, other: Placed) -> float:
    """Distance of two places in pixels of level 0."""
    return one.pose.distance_px(other.pose)
