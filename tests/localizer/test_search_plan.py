"""Which searches are run for a view, in which order."""

import math

import pytest

from orthonav.core.localize import plan
from orthonav.core.localize.plan import DEFAULT_PLAN, Budget
from orthonav.core.register.registrar import Levels, PosePrior

LEVELS = Levels(2, 1, 0)
TRACKED = PosePrior(0.5, math.radians(2.0), 0.03)


def levels_of(prior, pose_ms, levels=LEVELS):
    """Levels of the searches for a view where a pose at a level costs `pose_ms[level]`."""
    searches = DEFAULT_PLAN.searches(
        levels, prior, lambda level, poses: poses * pose_ms[level], lambda: (0, 0)
    )
    return [each.level for each in searches]


def test_the_final_level_comes_last_where_it_is_cheap():
    levels = levels_of(TRACKED, (0.2, 0.1, 0.1))
    assert levels[-1] == 0 and set(levels[:-1]) == {1}


def test_the_final_level_is_left_out_where_it_is_dear():
    assert 0 not in levels_of(TRACKED, (20.0, 0.1, 0.1))
    assert 0 not in levels_of(PosePrior(None, math.pi, 0.1), (0.2, 0.1, 0.1))


def test_a_small_view_is_finished_where_it_is_judged():
    assert set(levels_of(TRACKED, (0.1, 0.1), Levels(1, 0, 0))) == {0}
    searches = list(
        DEFAULT_PLAN.searches(
            Levels(1, 0, 0), TRACKED, lambda _, poses: 0.1 * poses, lambda: (0, 0)
        )
    )
    assert {each.candidates for each in searches} == {DEFAULT_PLAN.stage_candidates}


def test_where_the_coarse_level_takes_too_long_the_level_above_is_searched():
    pose_ms = {3: 1.0, 2: 1e3, 1: 1e4, 0: 1e5}
    (search,) = DEFAULT_PLAN.searches(
        LEVELS, TRACKED, lambda level, poses: poses * pose_ms[level], lambda: (0, 0)
    )
    assert search.level == 3 and search.candidates == DEFAULT_PLAN.far_candidates
    pose_ms[3] = math.inf  # there is no such level
    (search,) = DEFAULT_PLAN.searches(
        LEVELS, TRACKED, lambda level, poses: poses * pose_ms[level], lambda: (0, 0)
    )
    assert search.level == LEVELS.coarse  # the first search is run whatever it costs


@pytest.mark.parametrize("tiles", [0, 1000])
def test_with_an_unknown_heading_the_likely_scales_come_first(tiles):
    """All poses are tried in the end, each once, at their share of the cost."""
    prior, pose_ms = PosePrior(None, math.pi, 0.1), (1e3, 20.0, math.inf if tiles else 0.1)
    searches = list(
        DEFAULT_PLAN.searches(
            LEVELS,
            prior,
            lambda level, poses: poses * (*pose_ms, math.inf)[level],
            lambda: (tiles, 128),
        )
    )
    first, rest = (each for each in searches if each.level == LEVELS.coarse)
    assert first.from_tiles == rest.from_tiles == bool(tiles)
    turns = {turn for turn, _ in first.poses}
    assert turns == {turn for turn, _ in rest.poses} and len(turns) == 45
    scales = [sorted({scale for _, scale in each.poses}) for each in (first, rest)]
    assert scales[0] == pytest.approx([-0.13, 0.0, 0.13]) and len(scales[1]) == 2
    assert len(first.poses) + len(rest.poses) == 45 * 5
    assert first.cost_ms / rest.cost_ms == pytest.approx(3 / 2)


def test_with_a_known_heading_the_coarse_level_is_searched_at_once():
    prior, pose_ms = PosePrior(0.5, math.radians(10.0), 0.1), (1e3, 20.0, 0.1)
    levels = levels_of(prior, pose_ms)
    assert levels.count(LEVELS.coarse) == 1


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
    searches = DEFAULT_PLAN.searches(
        LEVELS,
        prior,
        lambda level, poses: poses * (0.01, pose_ms, coarse_ms, math.inf)[level],
        lambda: (tiles, 128),
    )
    nats = [
        prior.nats(*pose, within=(math.radians(3.0), 0.045))
        for search in searches
        if search.level == LEVELS.look
        for pose in search.poses
    ]
    least = DEFAULT_PLAN.stages_nats[-2]
    assert (max(nats) <= least) == left_out and max(nats) > 1.5


@pytest.fixture
def clock(monkeypatch):
    """A clock that only moves when advanced, s."""
    now = [100.0]
    monkeypatch.setattr(plan.time, "monotonic", lambda: now[0])
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


def test_nothing_is_begun_after_the_budget_is_spent(clock):
    budget = Budget(100.0)
    assert budget.allows(10.0)
    clock[0] += 0.2
    assert not budget.allows(0.0)


def test_more_tiles_give_more_candidates_within_bounds():
    least, most = DEFAULT_PLAN.tile_candidates
    counts = [DEFAULT_PLAN.candidates_from(tiles) for tiles in (1, 8_000, 10**6)]
    assert counts == [least, 8_000 // DEFAULT_PLAN.tiles_per_candidate, most]


@pytest.mark.parametrize("tiles, from_tiles", [(10_000, True), (0, False)])
def test_tiles_come_first_where_they_are_the_cheaper_way(tiles, from_tiles):
    first = next(
        DEFAULT_PLAN.searches(LEVELS, TRACKED, lambda _, poses: 50.0 * poses, lambda: (tiles, 128))
    )
    assert first.from_tiles == from_tiles and first.level == LEVELS.coarse
    if from_tiles:
        assert first.candidates == DEFAULT_PLAN.candidates_from(tiles)
        assert DEFAULT_PLAN.enough(first, LEVELS) == DEFAULT_PLAN.clear_at_judged
