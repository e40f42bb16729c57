"""Views in doubt are compared with more candidates, one level finer."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest

from orthonav.core.localize.confidence import USUAL_CHANCES, USUAL_CONFIDENCE, places_of
from orthonav.core.localize.plan import DEFAULT_PLAN, Search, SearchPlan
from orthonav.core.localize.view_search import ViewSearch
from orthonav.core.register.pose import Pose
from orthonav.core.register.refine import Placed
from orthonav.core.register.registrar import Levels, OwnRatios, PosePrior, Registered
from orthonav.core.register.sharpness import Sharpness

LOOK = 2
"""The judged level of all views here."""


@dataclass(frozen=True)
class Found:
    """A place with a confidence, which stands out by a ratio."""

    confidence: float
    cut_short: bool = False
    look_ratio: float = 1.0
    score: float = 3 * USUAL_CHANCES.total

    @property
    def peak_ratio(self):
        return self.look_ratio

    def evidence(self):
        return {"confidence": self.confidence}


class Registrar:
    """Finishes candidates with given confidences, one time after the other, and notes `kept`."""

    def __init__(self, confidences, ratio):
        self.kept, self._left, self._ratio = [], iter(confidences), ratio

    def judged(self, templates, levels, candidates, level, *_):
        assert level <= levels.coarse  # candidates from above are compared at the coarse level
        return ["a place"]

    def direct(self, *_):
        return ["a place found at the final level"]

    def standing(self, *_):
        return 60.0, 60.0 / self._ratio

    def finished(self, *_, finer, kept, **__):
        self.kept.append((kept, finer is not None))
        return Found(next(self._left), look_ratio=self._ratio)


class Confidence:
    """What the places say, with usual scores of chance."""

    chances = USUAL_CHANCES

    def __call__(self, evidence):
        return evidence["confidence"]


def searched(
    monkeypatch, confidences, costs_ms=(50.0,), final=1, budget_ms=math.inf, *,
    level=LOOK, from_tiles=False, learnt=True, ratio=1.0, last_level=None, is_level=True,
):  # fmt: skip
    """Searches that were run, candidates finished and whether they were compared one level finer,
    and the place found, where one finishing after the other has these confidences."""
    registrar, ran = Registrar(confidences, ratio), []
    searches = [Search(level, [(0.0, 0.0)], from_tiles, 8, cost_ms) for cost_ms in costs_ms]
    if last_level is not None:
        searches[-1] = replace(searches[-1], level=last_level)
    monkeypatch.setattr(SearchPlan, "searches", lambda *_: iter(searches))
    view = SimpleNamespace(
        levels=Levels(LOOK + 1, LOOK, final), prior=PosePrior(0.0, 0.1, 0.1), templates=None
    )
    candidates = SimpleNamespace(
        view=view, registrar=registrar, plan=replace(DEFAULT_PLAN, budget_ms=budget_ms),
        fft_ms=None, tiles=None, found=lambda run: ran.append(run.cost_ms) or ["a candidate"],
    )  # fmt: skip
    ground = SimpleNamespace(
        is_level=is_level, finish=None, finer_score=lambda finalist: 0.0,
        placed_on_terrain=lambda judged, at_most: judged,
    )  # fmt: skip
    found = ViewSearch(candidates, ground, Confidence() if learnt else None).best()
    return ran, registrar.kept, found


@pytest.mark.parametrize(
    ("confidences", "kept"),
    [
        ([0.995], [(3, False)]),
        ([0.95, 0.995], [(3, False), (3, True)]),
        ([0.0, 0.0, 0.7], [(3, False), (3, True), (48, True)]),
    ],
)
def test_more_candidates_are_compared_until_a_place_is_proven(monkeypatch, confidences, kept):
    ran, finished, found = searched(monkeypatch, confidences)
    assert len(ran) == 1 and finished == kept
    assert found == Found(confidences[-1])


def test_without_a_finer_level_more_candidates_are_finished_at_the_finest(monkeypatch):
    assert searched(monkeypatch, [0.5, 0.5], final=0)[1] == [(3, False), (48, False)]


def test_views_judged_at_the_level_they_are_finished_at_have_no_further_pass(monkeypatch):
    assert searched(monkeypatch, [0.5], final=LOOK)[1] == [(3, False)]


def test_a_budget_leaves_it_out(monkeypatch):
    _, finished, found = searched(monkeypatch, [0.5], budget_ms=1e-9)
    assert finished == [(3, False)] and found.cut_short


@pytest.mark.parametrize(
    ("confidences", "kept"), [([0.999], [(3, False)]), ([0.9, 0.999], [(3, False), (3, True)])]
)
def test_a_trial_before_an_expensive_search_can_make_it_needless(monkeypatch, confidences, kept):
    """First as candidates are finished, then compared one level finer."""
    ran, finished, found = searched(monkeypatch, confidences, costs_ms=(50.0, 300.0))
    assert (ran, finished, found) == ([50.0], kept, Found(0.999))


@pytest.mark.parametrize("confidence", [0.5, 0.995])
def test_where_it_proves_too_little_the_search_goes_on(monkeypatch, confidence):
    ran, finished, _ = searched(monkeypatch, [confidence] * 2 + [0.995], costs_ms=(50.0, 300.0))
    assert (ran, finished) == ([50.0, 300.0], [(3, False), (3, True), (3, False)])


@pytest.mark.parametrize(("confidence", "number"), [(0.995, 1), (0.98, 2)])
def test_the_final_level_is_searched_only_for_a_place_in_doubt(monkeypatch, confidence, number):
    """However cheap that search is, and without a finer level."""
    costs_ms = 5.0, 2.0
    ran, finished, _ = searched(
        monkeypatch, [confidence, 0.995], costs_ms=costs_ms, last_level=LOOK - 1
    )
    assert ran == list(costs_ms[:number])
    assert finished == [(3, False)] * number


@pytest.mark.parametrize("changes", [{"from_tiles": True}, {"level": LOOK + 1}])
def test_where_few_places_were_compared_it_must_stand_out_too(monkeypatch, changes):
    costs_ms = 50.0, 300.0
    ran, *_ = searched(monkeypatch, [0.999, 0.999], costs_ms=costs_ms, ratio=1.2, **changes)
    assert ran == list(costs_ms)
    ran, *_ = searched(monkeypatch, [0.999], costs_ms=costs_ms, ratio=1.3, **changes)
    assert ran == [50.0]


@pytest.mark.parametrize(("ratio", "number"), [(1.2, 2), (1.3, 1)])
def test_over_relief_it_must_stand_out_before_the_final_level_too(monkeypatch, ratio, number):
    """Only a few places were compared on the terrain."""
    costs_ms = 5.0, 2.0
    ran, *_ = searched(
        monkeypatch, [0.999, 0.999], costs_ms=costs_ms, last_level=LOOK - 1, ratio=ratio,
        is_level=False,
    )  # fmt: skip
    assert ran == list(costs_ms[:number])


def test_a_trial_that_there_is_no_time_for_does_not_cut_a_search_short(monkeypatch):
    """The search of the final level costs less than the trial."""
    now = [100.0]
    monkeypatch.setattr("orthonav.core.localize.plan.time.monotonic", lambda: now[0])

    def run(view_search, each):
        now[0] += each.cost_ms / 1e3
        return ran(view_search, each)

    ran = ViewSearch._run
    monkeypatch.setattr(ViewSearch, "_run", run)
    costs_ms = 20.0, 5.0
    searches, finished, found = searched(
        monkeypatch, [0.995], costs_ms=costs_ms, budget_ms=40.0, last_level=LOOK - 1
    )
    assert searches == list(costs_ms) and finished == [(3, False)] and not found.cut_short
    now[0] = 100.0
    searches, finished, found = searched(
        monkeypatch, [0.5], costs_ms=costs_ms, budget_ms=22.0, last_level=LOOK - 1
    )
    assert searches == [20.0] and found.cut_short


def test_a_place_that_does_not_stand_out_is_not_compared_one_level_finer(monkeypatch):
    _, finished, _ = searched(
        monkeypatch, [0.999, 0.999], costs_ms=(50.0, 300.0), ratio=1.2, from_tiles=True
    )
    assert finished == [(3, False)] * 2


def test_a_place_that_stands_out_ends_the_search_unless_few_places_were_compared(monkeypatch):
    costs_ms = 50.0, 10.0
    ran, *_ = searched(monkeypatch, [0.5] * 6, costs_ms=costs_ms, ratio=3.0, level=LOOK + 1)
    assert ran == [50.0]
    for confidence, number in ((0.5, 2), (0.995, 1)):
        ran, *_ = searched(
            monkeypatch, [confidence] * 6, costs_ms=costs_ms, ratio=3.0, level=LOOK + 2
        )
        assert ran == list(costs_ms[:number])


def test_before_a_cheap_search_there_is_no_trial(monkeypatch):
    ran, finished, _ = searched(monkeypatch, [0.995], costs_ms=(50.0, 10.0))
    assert (ran, finished) == ([50.0, 10.0], [(3, False)])


@pytest.mark.parametrize("changes", [{"final": LOOK}, {"learnt": False}])
def test_where_nothing_is_finished_or_no_confidence_is_known_there_is_no_trial(
    monkeypatch, changes
):
    ran, finished, _ = searched(monkeypatch, [0.999] * 3, costs_ms=(50.0, 300.0), **changes)
    assert ran == [50.0, 300.0] and finished[0] == (3, False)


def test_a_trial_without_a_finer_level_finishes_the_best_candidates(monkeypatch):
    ran, finished, found = searched(monkeypatch, [0.999], costs_ms=(50.0, 300.0), final=0)
    assert (ran, finished, found) == ([50.0], [(3, False)], Found(0.999))


def test_other_places_are_less_confident_than_the_one_that_won_in_detail():
    """The coarser levels speak for another place, but the finest one against it."""
    here, there = (
        Placed(Pose(x, 100.0, 0.0, 0.0), 1, 40.0, (0.5, 0.5), 0.5, 1.0, True)
        for x in (100.0, 900.0)
    )
    found = Registered(
        here, 60.0, 75.0, 25.0, 33.0, 48, ((60.0, here), (53.6, there)),
        OwnRatios(1.3, Sharpness(2.0, 4.0, 8.0)), fine_score=140.0, fine_rival=125.0,
    )  # fmt: skip
    first, *others = places_of(found, USUAL_CONFIDENCE, 50.0, 1.0)
    assert 0.05 < first[1] < 0.5
    assert [placed for *_, placed in others] == [there]
    for log_odds, alone, _ in others:
        assert log_odds <= first[0] and alone <= first[1]
