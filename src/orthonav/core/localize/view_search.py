"""The search for one view: runs the searches of the plan until one place stands out or is proven.

`plan` decides which searches to run, `candidates` runs them, the registrar judges what they find.
"""

from collections.abc import Sequence
from dataclasses import replace

from orthonav.core.localize.candidates import ViewCandidates
from orthonav.core.localize.confidence import USUAL_CHANCES, Chances, RegisteredConfidence
from orthonav.core.localize.over_relief import ViewOnLevelGround
from orthonav.core.localize.plan import Budget, ClearMargin, Search
from orthonav.core.register.refine import Placed
from orthonav.core.register.registrar import KEPT_TO_FINISH, Registered


class ViewSearch:
    """The search for one view. To be run once."""

    def __init__(
        self,
        candidates: ViewCandidates,
        ground: ViewOnLevelGround,
        confidence: RegisteredConfidence | None,
    ) -> None:
        """`confidence`: None before it is learnt; no place is proven then."""
        self._candidates, self._ground, self._confidence = candidates, ground, confidence
        self._view, self._plan = candidates.view, candidates.plan
        self._registrar, self._levels = candidates.registrar, candidates.view.levels
        self._budget = Budget(self._plan.budget_ms)
        self._judged: list[Placed] = []
        self._direct: list[Placed] = []
        self._count = 0
        self._last: Search | None = None

    def best(self) -> Registered | None:
        """The best place after all searches that had to be run; None where nothing was found."""
        searches = self._plan.searches(
            self._levels, self._view.prior, self._candidates.fft_ms, self._candidates.tiles
        )
        for each in searches:
            if early := self._proven_before(each):
                return early
            if not self._budget.allows(each.cost_ms):
                break
            self._run(each)
            if clear := self._clear_after(each):
                return clear
        return self._concluded() if self._judged else None

    def _run(self, each: Search) -> None:
        """Run a search and judge what it finds."""
        view = self._view
        found = self._candidates.found(each)
        self._count += len(found)
        self._last = each
        if each.level < self._levels.look:
            self._direct = self._registrar.direct(view.templates, self._levels, found)
            return
        level = min(each.level, self._levels.coarse)
        self._judged += self._registrar.judged(
            view.templates, self._levels, found, level, view.prior, self._judged
        )

    def _clear_after(self, run: Search) -> Registered | None:
        """The best place so far, if it stands out so far that the search ends with it."""
        margin = self._plan.enough(run, self._levels)
        if not self._judged or not self._seems_clear(margin):
            return None
        found = self._finished(self._judged)
        # Candidates from tiles or from far above are not all places: rivals alone prove too little.
        compared_all = not run.from_tiles and run.level <= self._levels.coarse
        proven = compared_all or self._is_proven(found, self._plan.doubt)
        return found if proven and self._is_clear(found, margin) else None

    def _proven_before(self, run: Search) -> Registered | None:
        """The best place so far, if a trial before the next search, `run`, proves it.

        The best few candidates are placed on the terrain, where there is one, and finished; where
        that proves none, they are compared one level finer, if there is such a level. Where only a
        part of all places was compared, or only a few on the terrain, the best must stand out too.
        There is no trial before a search that costs less, except that of the final level.

        The final level is searched only where all poses of the judged level are cheap, after them.
        Before it, the best need only be as certain as at the end of all searches, by its candidates
        as they are finished there.
        """
        plan, ground, last, levels = self._plan, self._ground, self._last, self._levels
        if last is None or self._confidence is None or levels.final == levels.look:
            return None
        at_final = run.level < levels.look
        trial_ms = plan.trial_ms if ground.is_level else plan.terrain_trial_ms
        if not self._judged or not (at_final or run.cost_ms > trial_ms):
            return None
        # Without time for it the search goes on, and is cut short only where that has no time.
        if not (self._budget.fits(trial_ms) and self._budget.allows(trial_ms)):
            return None
        placed = ground.placed_on_terrain(self._judged, plan.trials)
        compared_all = ground.is_level and last.level == levels.look and not last.from_tiles
        doubt = plan.doubt if at_final else plan.trial_doubt
        for finer in (False, True)[: 1 if at_final or levels.final == 0 else 2]:
            found = self._finished(placed, plan.trials, finer=finer)
            if not compared_all and not self._is_clear(found, plan.trial_clear):
                return None
            if self._is_proven(found, doubt):
                return found
        return None

    def _concluded(self) -> Registered:
        """The best place after all searches, none of which ended with one that stands out.

        While it is not proven, more candidates are finished, and compared one level finer where
        there is such a level.
        """
        plan, judged = self._plan, self._judged
        if not self._ground.is_level and self._budget.allows(0.0):
            judged = self._ground.placed_on_terrain(judged, plan.terrain_candidates)
        found = self._finished(judged)
        for kept, cost_ms in plan.doubt_passes(self._levels):
            if self._is_proven(found, plan.doubt) or not self._budget.allows(cost_ms):
                break
            found = self._finished(judged, kept, finer=self._levels.final > 0)
        return replace(found, cut_short=self._budget.cut_short)

    def _finished(
        self, judged: Sequence[Placed], kept: int = KEPT_TO_FINISH, *, finer: bool = False
    ) -> Registered:
        """The best of candidates, of which `kept` are finished; see `Registrar.finished`."""
        view, ground = self._view, self._ground
        return self._registrar.finished(
            view.templates,
            self._levels,
            judged,
            view.prior,
            self._count,
            finish=ground.finish,
            direct=self._direct,
            finer=ground.finer_score if finer else None,
            kept=kept,
        )

    def _seems_clear(self, margin: ClearMargin) -> bool:
        """Whether the best candidate may end the search, before the cost of finishing it."""
        view = self._view
        best, rival = self._registrar.standing(view.templates, self._judged, view.prior)
        return best > margin.strength * self._chances.look and best > margin.look_ratio * rival

    def _is_clear(self, best: Registered, margin: ClearMargin) -> bool:
        """Whether a finished place ends the search."""
        if best.score <= margin.strength * self._chances.total:
            return False
        return best.look_ratio > margin.look_ratio and best.peak_ratio > margin.peak_ratio

    def _is_proven(self, best: Registered, doubt: float) -> bool:
        """Whether a place has a confidence above 1 - `doubt`."""
        return self._confidence is not None and self._confidence(best.evidence()) > 1 - doubt

    @property
    def _chances(self) -> Chances:
        return self._confidence.chances if self._confidence else USUAL_CHANCES
