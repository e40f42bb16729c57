"""Views in doubt are compared with more candidates, one level finer."""

import math
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
from blots import planned

from orthonav.core.localize.confidence import USUAL_CHANCES, USUAL_CONFIDENCE
from orthonav.core.localize.place import Place
from orthonav.core.localize.policy import Budget
from orthonav.core.localize.search import Search
from orthonav.core.register.pose import Pose
from orthonav.core.register.refine import Fit
from orthonav.core.register.template import Levels
from orthonav.core.track.likelihood import places_of

JUDGED = 2
"""The judged level of all views here."""


@dataclass(frozen=True)
class Step:
    """A step that finds one candidate."""

    cost_ms: float
    level: int
    from_tiles: bool
    ran: list

    def run(self):
        self.ran.append(self.cost_ms)
        return [SimpleNamespace(pose=None)]


class Placer:
    """Finishes candidates with given confidences, one time after the other, and notes `kept`."""

    def __init__(self, confidences, ratio, levels, is_level):
        self.kept, self._left, self._ratio = [], iter(confidences), ratio
        self._levels, self.is_level = levels, is_level

    def judge(self, poses, level, known):
        assert (
            level <= self._levels.coarse
        )  # candidates from above are compared at the coarse level
        return ["a place"]

    def direct(self, poses):
        return ["a place found at the final level"]

    def standing(self, places):
        return 60.0, 60.0 / self._ratio

    def on_terrain(self, places, at_most):
        return places

    def finished(self, *_, finer, kept):
        self.kept.append((kept, finer))
        scores = {"confidence": next(self._left), "strength": 3 * USUAL_CHANCES.total}
        return Place(None, scores=scores | dict.fromkeys(("peak_ratio", "look_ratio"), self._ratio))


class Confidence:
    """What the places say, with usual scores of chance."""

    chances = USUAL_CHANCES

    def __call__(self, scores):
        return scores["confidence"]


class Doubting(Search):
    """A search of given steps and a given placer."""

    def __init__(self, steps, placer, levels, confidence, plan):
        self.sheet = SimpleNamespace(confidence=confidence)
        self.policy, self.costs, self.levels = plan.policy, plan.costs, levels
        self.placer, self.chances, self.budget = placer, USUAL_CHANCES, Budget(plan.budget_ms)
        self.places, self.direct, self.candidates, self.last = [], [], 0, None
        self.steps = lambda: iter(steps)


def searched(
    confidences, costs_ms=(50.0,), final=1, budget_ms=math.inf, *,
    level=JUDGED, from_tiles=False, learnt=True, ratio=1.0, last_level=None, is_level=True,
):  # fmt: skip
    """Steps that were run, candidates finished and whether they were compared one level finer,
    and the scores of the place found, where one finishing after the other has these confidences."""
    levels, ran = Levels(JUDGED + 1, JUDGED, final), []
    placer = Placer(confidences, ratio, levels, is_level)
    steps = [Step(cost_ms, level, from_tiles, ran) for cost_ms in costs_ms]
    if last_level is not None:
        steps[-1] = Step(costs_ms[-1], last_level, from_tiles, ran)
    confidence, plan = Confidence() if learnt else None, planned(budget_ms=budget_ms)
    found = Doubting(steps, placer, levels, confidence, plan).best()
    return ran, placer.kept, found.scores


@pytest.mark.parametrize(
    ("confidences", "kept"),
    [
        ([0.995], [(3, False)]),
        ([0.95, 0.995], [(3, False), (3, True)]),
        ([0.0, 0.0, 0.7], [(3, False), (3, True), (48, True)]),
    ],
)
def test_more_candidates_are_compared_until_a_place_is_proven(confidences, kept):
    ran, finished, found = searched(confidences)
    assert len(ran) == 1 and finished == kept
    assert found["confidence"] == confidences[-1]


def test_without_a_finer_level_more_candidates_are_finished_at_the_finest():
    assert searched([0.5, 0.5], final=0)[1] == [(3, False), (48, False)]


def test_a_budget_leaves_it_out():
    _, finished, found = searched([0.5], budget_ms=1e-9)
    assert finished == [(3, False)] and "cut_short" in found


@pytest.mark.parametrize(
    ("confidences", "kept"), [([0.999], [(3, False)]), ([0.9, 0.999], [(3, False), (3, True)])]
)
def test_a_trial_before_an_expensive_search_can_make_it_needless(confidences, kept):
    """First as candidates are finished, then compared one level finer."""
    ran, finished, found = searched(confidences, costs_ms=(50.0, 300.0))
    assert (ran, finished, found["confidence"]) == ([50.0], kept, 0.999)


@pytest.mark.parametrize("confidence", [0.5, 0.995])
def test_where_it_proves_too_little_the_search_goes_on(confidence):
    ran, finished, _ = searched([confidence] * 2 + [0.995], costs_ms=(50.0, 300.0))
    assert (ran, finished) == ([50.0, 300.0], [(3, False), (3, True), (3, False)])


@pytest.mark.parametrize(("confidence", "number"), [(0.995, 1), (0.98, 2)])
def test_the_final_level_is_searched_only_for_a_place_in_doubt(confidence, number):
    """However cheap that search is, and without a finer level."""
    costs_ms = 5.0, 2.0
    ran, finished, _ = searched([confidence, 0.995], costs_ms=costs_ms, last_level=JUDGED - 1)
    assert ran == list(costs_ms[:number])
    assert finished == [(3, False)] * number


@pytest.mark.parametrize("changes", [{"from_tiles": True}, {"level": JUDGED + 1}])
def test_where_few_places_were_compared_it_must_stand_out_too(changes):
    costs_ms = 50.0, 300.0
    ran, *_ = searched([0.999, 0.999], costs_ms=costs_ms, ratio=1.2, **changes)
    assert ran == list(costs_ms)
    ran, *_ = searched([0.999], costs_ms=costs_ms, ratio=1.3, **changes)
    assert ran == [50.0]


@pytest.mark.parametrize(("ratio", "number"), [(1.2, 2), (1.3, 1)])
def test_over_relief_it_must_stand_out_before_the_final_level_too(ratio, number):
    """Only a few places were compared on the terrain."""
    costs_ms = 5.0, 2.0
    ran, *_ = searched(
        [0.999, 0.999], costs_ms=costs_ms, last_level=JUDGED - 1, ratio=ratio,
        is_level=False,
    )  # fmt: skip
    assert ran == list(costs_ms[:number])


def test_a_trial_that_there_is_no_time_for_does_not_cut_a_search_short(monkeypatch):
    """The search of the final level costs less than the trial."""
    now = [100.0]
    monkeypatch.setattr("orthonav.core.localize.policy.time.monotonic", lambda: now[0])

    def run(step):
        now[0] += step.cost_ms / 1e3
        return ran(step)

    ran = Step.run
    monkeypatch.setattr(Step, "run", run)
    costs_ms = 20.0, 5.0
    more = {"costs_ms": costs_ms, "last_level": JUDGED - 1}
    steps, finished, found = searched([0.995], budget_ms=40.0, **more)
    assert steps == list(costs_ms) and finished == [(3, False)] and "cut_short" not in found
    now[0] = 100.0
    steps, finished, found = searched([0.5], budget_ms=22.0, **more)
    assert steps == [20.0] and "cut_short" in found


def test_a_place_that_stands_out_ends_the_search_unless_few_places_were_compared():
    costs_ms = 50.0, 10.0
    ran, *_ = searched([0.5] * 6, costs_ms=costs_ms, ratio=3.0, level=JUDGED + 1)
    assert ran == [50.0]
    for confidence, number in ((0.5, 2), (0.995, 1)):
        ran, *_ = searched([confidence] * 6, costs_ms=costs_ms, ratio=3.0, level=JUDGED + 2)
        assert ran == list(costs_ms[:number])


@pytest.mark.parametrize("changes", [{"final": JUDGED}, {"learnt": False}])
def test_where_nothing_is_finished_or_no_confidence_is_known_there_is_no_trial(changes):
    ran, finished, _ = searched([0.999] * 3, costs_ms=(50.0, 300.0), **changes)
    assert ran == [50.0, 300.0] and finished[0] == (3, False)


def test_other_places_are_less_confident_than_the_one_that_won_in_detail():
    """The coarser levels speak for another place, but the finest one against it."""
    here, there = (
        Fit(Pose(x, 100.0, 0.0, 0.0), 1, 40.0, (0.5, 0.5), 0.5, 1.0, True) for x in (100.0, 900.0)
    )
    rival = Place(there, score=53.6)
    scores = {"strength": 60.0, "rival": 75.0, "look": 25.0, "look_rival": 33.0, "fine": 140.0}
    scores |= {"fine_rival": 125.0, "detail_ratio": 1.3, "local_phase": 8.0, "local_gradients": 4.0}
    best = Place(here, score=60.0, scores=scores, rivals=(rival,))
    first, *others = places_of(best, USUAL_CONFIDENCE, 50.0, 1.0)
    assert 0.05 < first[1] < 0.5
    assert [place for *_, place in others] == [rival]
    for log_odds, alone, _ in others:
        assert log_odds <= first[0] and alone <= first[1]
