"""Along a route: probability, simulated flights, outages."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_check import CONDITIONS as GIVEN
from made_check import area_of, predicted, straight

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import protection_level_m
from orthonav.ground.check import flights
from orthonav.ground.check.findings import likely_outages, predicted_along
from orthonav.ground.check.flights import scene_shifts, simulated

FRAME = LocalFrame(46.0, 3.0)
SIDE_M = 100.0
CONDITIONS = replace(GIVEN, width_m=SIDE_M, height_m=SIDE_M, drift=0.03)


def even(points):
    return predicted(np.full(len(points), 0.8), np.full(len(points), 3.0))


def test_the_worst_over_the_width_of_every_leg():
    """The map is bad more than 80 m north of an eastbound leg, and east of a northbound one."""

    def predict(points):
        bad = (points[:, 1] > 80) & (points[:, 0] < 900)
        bad |= (points[:, 0] > 1080) & (points[:, 1] > 250)
        return predicted(np.where(bad, 0.1, 0.9), np.full(len(points), 3.0))

    early = slice(4, 20)
    for bands, first, last in (
        ((200, 100), 0.1, 0.9),
        ((100, 200), 0.9, 0.1),
        ((90, 90), 0.9, 0.9),
    ):
        area = area_of(FRAME, [[0, 0], [1000, 0], [1000, 800]], bands)
        along = predicted_along(area, CONDITIONS, predict)
        late = along.distance_m > 1400
        assert (along.across_low[early] == first).all() and (along.across_low[late] == last).all()
        assert (along.probability[early] == 0.9).all()


def test_the_route_ends_at_its_last_waypoint():
    along = predicted_along(area_of(FRAME, [[0, 0], [100, 0], [100, 60]]), CONDITIONS, even)
    assert along.distance_m == pytest.approx([0, 25, 50, 75, 100, 125, 150, 160], abs=1e-3)
    np.testing.assert_allclose(along.points_en_m[-1], [100, 60], atol=0.01)
    whole = predicted_along(area_of(FRAME, [[0, 0], [100, 0]]), CONDITIONS, even)
    assert len(whole.distance_m) in (5, 6)


GOOD, BAD = [1.0] * 8, [0.2] * 12


@pytest.mark.parametrize(
    "available, expected",
    [
        (GOOD, []),
        (GOOD + BAD[:1] + GOOD, []),
        (GOOD + BAD[:4] + GOOD, [(200.0, 300.0)]),
        (GOOD + BAD + GOOD + BAD + [0.9], [(200.0, 500.0), (700.0, 1000.0)]),
        (BAD + GOOD, [(0.0, 300.0)]),
        (GOOD + BAD, [(200.0, 475.0)]),
        ([0.5] * 9, []),
    ],
    ids=["none", "short", "one", "two", "at first", "at last", "on the border"],
)
def test_where_outages_begin_and_end(available, expected):
    along = straight(np.full(len(available), 0.8))
    flown = SimpleNamespace(available=np.array(available))
    found = likely_outages(along, flown, CONDITIONS)
    assert [(each.start_m, each.end_m) for each in found] == expected
    assert all(each.available == pytest.approx(0.2) for each in found)


def flights_over(probability, *, limit_m=40.0, drift=0.03, std=0.0, wrong=0.0, step_m=25.0):
    along = straight(probability, step_m)
    along = replace(along, wrong=np.full(len(along.wrong), wrong))
    conditions = replace(CONDITIONS, alert_limit_m=limit_m, drift=drift)
    rng = np.random.default_rng(7)
    return simulated(along, conditions, scene_shifts(std), 0, rng)


def test_flights_with_certain_fixes_are_always_available():
    found = flights_over([0.99] * 400)
    assert found.availability.low > 0.98 and found.outage_m.high < 2 * SIDE_M
    assert found.false_fix.high == 0
    assert found.protection_m.min() == pytest.approx(
        protection_level_m(1.0, 4.5 * np.eye(2), 1e-3)  # of a fix, whose error is 3 m
    )


@pytest.mark.parametrize("side_m", [61.3, 299.7, 2000.1])
def test_views_of_any_size_are_available_where_fixes_are_certain(side_m):
    """With a limit that is below the growth over a view of the largest size."""
    along = straight([0.99] * 200, side_m / 4)
    wide = replace(CONDITIONS, width_m=side_m, height_m=side_m, alert_limit_m=20.0, drift=0.03)
    shifts, rng = scene_shifts(0.0), np.random.default_rng(7)
    assert simulated(along, wide, shifts, 0, rng).availability.low > 0.95


HELD_M = 50.0  # a fix holds for half the side of a view


def test_without_fixes_the_flight_coasts():
    """As in flight: nothing confirms the place, whatever the drift and the alert limit."""
    found = flights_over([0.0] * 101, limit_m=1e3)
    assert np.isfinite(found.protection_m[:3]).all() and np.isinf(found.protection_m[3:]).all()
    assert found.probability == (0, 0, 0)
    assert found.availability.median == pytest.approx(HELD_M / 2500, abs=0.015)
    assert found.outage_m.median == pytest.approx(2500 - HELD_M, abs=40)
    rms_m = np.hypot(3.0, 0.03 * (2500 - HELD_M))
    assert found.error_95_m.median == pytest.approx(flights.level_m(rms_m, 0.05))


def test_a_limit_below_the_error_of_a_fix_is_never_met():
    found = flights_over([0.99] * 100, limit_m=10.0)
    assert found.availability == (0, 0, 0)
    assert found.outage_m.median == pytest.approx(99 * 25.0)


def test_scenes_widen_the_interval():
    narrow, wide = flights_over([0.5] * 400), flights_over([0.5] * 400, std=1.5)
    assert wide.probability.high - wide.probability.low > 0.5 > 0.05 > np.ptp(narrow.probability)


def test_neighbouring_views_fail_together(monkeypatch):
    alike = flights_over([0.5] * 400).outage_m.median
    monkeypatch.setattr(flights, "CORRELATION", 0.0)
    assert alike > 1.2 * flights_over([0.5] * 400).outage_m.median


def test_false_fixes_add_up_along_the_route():
    short, far = (flights_over([0.9] * n, wrong=1e-4).false_fix for n in (100, 1000))
    assert 8 * short.median < far.median < 12 * short.median
    assert flights_over([0.9] * 9, wrong=1.0).false_fix.high <= 1
