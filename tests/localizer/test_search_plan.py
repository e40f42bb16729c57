"""Which searches are run for a view, in which order."""

import math
from types import SimpleNamespace

import pytest

from orthonav.core.localize import policy
from orthonav.core.localize.policy import DEFAULT_PLAN, Budget
from orthonav.core.localize.search import Search
from orthonav.core.register.pose import PosePrior
from orthonav.core.register.template import Levels

LEVELS = Levels(2, 1, 0)
POLICY = DEFAULT_PLAN.policy
TRACKED = PosePrior(0.5, math.radians(2.0), 0.03)


class Priced(Search):
    """A search where a pose at a level costs `pose_ms[level]`."""

    def __init__(self, prior, pose_ms, tiles=0, levels=LEVELS):
        self.policy, self.costs, self.levels, self.tiles = POLICY, DEFAULT_PLAN.costs, levels, tiles
        self.view = SimpleNamespace(prior=prior)
        self.sheet = SimpleNamespace(propose=SimpleNamespace(embedder=SimpleNamespace(dims=128)))
        self._pose_ms = pose_ms

    def fft_ms(self, level, poses):
        return poses * self._pose_ms[level]


def steps(*given, **more):
    return list(Priced(*given, **more).steps())


def levels_of(*given, **more):
    return [each.level for each in steps(*given, **more)]


def test_the_final_level_comes_last_where_it_is_cheap():
    levels = levels_of(TRACKED, (0.2, 0.1, 0.1))
    assert levels[-1] == 0 and set(levels[:-1]) == {1}


def test_the_final_level_is_left_out_where_it_is_dear():
    assert 0 not in levels_of(TRACKED, (20.0, 0.1, 0.1))
    assert 0 not in levels_of(PosePrior(None, math.pi, 0.1), (0.2, 0.1, 0.1))


def test_a_small_view_is_finished_where_it_is_judged():
    made = steps(TRACKED, (0.1, 0.1), levels=Levels(1, 0, 0))
    assert {(each.level, each.count) for each in made} == {(0, POLICY.candidates)}


def test_where_the_coarse_level_takes_too_long_the_level_above_is_searched():
    pose_ms = {3: 1.0, 2: 1e3, 1: 1e4, 0: 1e5}
    (step,) = steps(TRACKED, pose_ms)
    assert step.level == 3 and step.count == POLICY.far_candidates
    pose_ms[3] = math.inf  # there is no such level
    assert levels_of(TRACKED, pose_ms) == [LEVELS.coarse]  # the first is run whatever it costs


@pytest.mark.parametrize("tiles", [0, 1000])
def test_with_an_unknown_heading_the_likely_scales_come_first(tiles):
    """All poses are tried in the end, each once, at their share of the cost."""
    pose_ms = 1e3, 20.0, math.inf if tiles else 0.1, math.inf
    made = steps(PosePrior(None, math.pi, 0.1), pose_ms, tiles)
    first, rest = (each for each in made if each.level == LEVELS.coarse)
    assert first.from_tiles == rest.from_tiles == bool(tiles)
    turns = {turn for turn, _ in first.directions}
    all_around = math.ceil(2 * math.pi / POLICY.coarse_steps[0])
    assert turns == {turn for turn, _ in rest.directions} and len(turns) == all_around
    scales = [sorted({scale for _, scale in each.directions}) for each in (first, rest)]
    assert scales[0] == pytest.approx([-0.13, 0.0, 0.13]) and len(scales[1]) == 2
    assert len(first.directions) + len(rest.directions) == 5 * all_around
    assert first.cost_ms / rest.cost_ms == pytest.approx(3 / 2)


@pytest.mark.parametrize(
    ("pose_ms", "tiles", "coarse_ms", "left_out"),
    [
        (0.5, 0, 0.01, False),
        (8.0, 0, 0.01, True),
        (8.0, 1000, 5.0, False),  # only tiles were compared
        (8.0, 0, math.inf, False),  # there is no coarse level
    ],
)
def test_the_last_stage_is_left_out_where_it_is_dear_and_was_tried_at_the_coarse_level(
    pose_ms, tiles, coarse_ms, left_out
):
    prior = PosePrior(0.5, math.radians(10.0), 0.1)
    nats = [
        prior.nats(*direction, within=(math.radians(3.0), 0.045))
        for step in steps(prior, (0.01, pose_ms, coarse_ms, math.inf), tiles)
        if step.level == LEVELS.judged
        for direction in step.directions
    ]
    assert (max(nats) <= POLICY.stages_nats[-2]) == left_out and max(nats) > 1.5


@pytest.fixture
def clock(monkeypatch):
    """A clock that only moves when advanced, s."""
    now = [100.0]
    monkeypatch.setattr(policy.time, "monotonic", lambda: now[0])
    return now


def test_the_first_search_is_never_left_out(clock):
    budget = Budget(5.0)
    clock[0] += 1
    assert budget.allows(1e6) and not budget.allows(1.0)


def test_a_search_that_would_end_too_late_is_left_out(clock):
    budget = Budget(100.0)
    assert budget.allows(10.0)
    clock[0] += 0.03  # three times as slow as estimated
    assert not budget.allows(25.0)
    assert budget.allows(20.0)


@pytest.mark.parametrize("tiles, from_tiles", [(10_000, True), (0, False)])
def test_tiles_come_first_where_they_are_the_cheaper_way(tiles, from_tiles):
    first = steps(TRACKED, (50.0,) * 4, tiles)[0]
    assert first.from_tiles == from_tiles and first.level == LEVELS.coarse
    if from_tiles:
        assert first.count == POLICY.candidates_from(tiles)
