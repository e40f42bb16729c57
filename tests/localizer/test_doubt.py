"""Views in doubt are compared with more candidates, one level finer."""

import math
from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from orthonav.confidence.registered import USUAL_CONFIDENCE
from orthonav.localizer.places import places_of
from orthonav.localizer.plan import DEFAULT_PLAN, Budget
from orthonav.localizer.registration import RegistrationLocalizer
from orthonav.register.pose import Pose
from orthonav.register.refine import Placed
from orthonav.register.registrar import OwnRatios, Registered
from orthonav.register.sharpness import Sharpness


@dataclass(frozen=True)
class Found:
    """A place with a confidence."""

    confidence: float
    cut_short: bool = False

    def evidence(self):
        return {"confidence": self.confidence}


def concluded(confidences, final=1, budget_ms=math.inf):
    """How many candidates were finished and compared one level finer, and the place found, where
    one finishing after the other has these confidences."""
    localizer = RegistrationLocalizer.__new__(RegistrationLocalizer)
    localizer.plan, localizer.relief = DEFAULT_PLAN, None
    localizer.confidence = lambda evidence: evidence["confidence"]
    ground = SimpleNamespace(placed_on_terrain=lambda judged, at_most: judged)
    view = SimpleNamespace(levels=SimpleNamespace(final=final))
    kept, left = [], iter(confidences)

    def finished(judged, finer=0):
        kept.append(finer)
        return Found(next(left))

    budget = Budget(budget_ms)
    assert budget.allows(0.0)
    found = localizer._concluded(view, ground, ["a place"], None, budget, finished)
    return kept, found


@pytest.mark.parametrize(
    ("confidences", "kept"),
    [([0.995], [0]), ([0.95, 0.995], [0, 3]), ([0.0, 0.0, 0.7], [0, 3, 48])],
)
def test_more_candidates_are_compared_until_a_place_is_proven(confidences, kept):
    finished, found = concluded(confidences)
    assert finished == kept
    assert found == Found(confidences[-1])


def test_views_judged_at_the_finest_level_are_not_compared_finer():
    assert concluded([0.5], final=0)[0] == [0]


def test_a_budget_leaves_it_out():
    finished, found = concluded([0.5], budget_ms=1e-9)
    assert finished == [0] and found.cut_short


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
