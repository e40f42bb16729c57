"""Along a route: probability, drift, blind stretches."""

import math
from dataclasses import replace

import made_trials
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.check.estimate import Prediction
from orthonav.ground.check.findings import BLIND, blind_stretches, expected_drift, predicted_along
from orthonav.ground.check.records import Along
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Route

FRAME = LocalFrame(46.0, 3.0)
SIDE_M = 100.0
CONDITIONS = replace(made_trials.CONDITIONS, width_m=SIDE_M, height_m=SIDE_M)


def area_of(points_en_m, bands_m=()):
    lat, lon = FRAME.latlon_from_en(np.array(points_en_m, float))
    route = Route(tuple(zip(lat.tolist(), lon.tolist(), strict=True)), leg_bands_m=tuple(bands_m))
    return Area(FRAME, (-5000.0, -5000.0, 5000.0, 5000.0), route, 200.0)


def of_many_flights(chances, errors_m, drift, side_m):
    """Root mean square error at every view over all flights, by the view of their last fix."""
    squares = []
    for here in range(len(chances)):
        weight, total = 1.0, 0.0  # of the flights without a fix since
        for last in range(here, 0, -1):
            error_m = errors_m[last] + (here - last) * drift * side_m
            total += weight * chances[last] * error_m**2
            weight *= 1 - chances[last]
        squares.append(total + weight * (errors_m[0] + here * drift * side_m) ** 2)
    return np.sqrt(squares)


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0, 12)), min_size=2, max_size=25))
def test_drift_is_that_of_many_flights(views):
    chances, errors = (np.array(each) for each in zip(*views, strict=True))
    distance = np.arange(len(views)) * SIDE_M
    found = expected_drift(distance, chances, errors, 0.05, SIDE_M)
    truth = of_many_flights(chances, errors, 0.05, SIDE_M)
    np.testing.assert_allclose(found, truth, rtol=1e-6, atol=1e-6)


def predicted(probability, error_m):
    """A prediction of these values, with an interval of no width."""
    nothing = np.zeros_like(probability)
    return Prediction(probability, probability, probability, error_m, nothing, nothing)


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
        area = area_of([[0, 0], [1000, 0], [1000, 800]], bands)
        along = predicted_along(area, CONDITIONS, predict)
        late = along.distance_m > 1400
        assert (along.across_low[early] == first).all() and (along.across_low[late] == last).all()
        assert (along.probability[early] == 0.9).all()


def test_the_route_ends_at_its_last_waypoint():
    along = predicted_along(area_of([[0, 0], [100, 0], [100, 60]]), CONDITIONS, even)
    assert along.distance_m == pytest.approx([0, 25, 50, 75, 100, 125, 150, 160], abs=1e-3)
    np.testing.assert_allclose(along.points_en_m[-1], [100, 60], atol=0.01)
    whole = predicted_along(area_of([[0, 0], [100, 0]]), CONDITIONS, even)
    assert along.drift_m.shape == (8,) and len(whole.distance_m) in (5, 6)


def along_of(probability, step_m=25.0):
    """A straight route to the east with these probabilities."""
    probability = np.array(probability, float)
    distance = np.arange(len(probability)) * step_m
    points = np.stack([distance, np.zeros_like(distance)], axis=1)
    error = np.full_like(distance, 3.0)
    place = predicted(probability, error)
    extra = {"across_low": probability, "drift_m": error}
    return Along(distance_m=distance, points_en_m=points, **extra, **vars(place))


GOOD, BAD = [0.9] * 8, [0.2] * 12


def test_blind_stretches():
    along = along_of(GOOD + BAD + GOOD + BAD + [0.9])
    first, second = blind_stretches(along, CONDITIONS)
    assert (first.start_m, first.end_m) == (200, 500) and (second.start_m, second.end_m) == (
        700,
        1000,
    )
    assert (first.start_s, first.end_s) == (10, 25) and first.length_m == 300
    assert first.probability == pytest.approx(0.2) and first.drift_m == pytest.approx(9)
    assert first.allowed_m == CONDITIONS.prior_std_m and first.recoverable and second.recoverable


@pytest.mark.parametrize(
    "probability, expected",
    [
        (GOOD, []),
        (GOOD + BAD[:3] + GOOD, []),
        (GOOD + BAD[:4] + GOOD, [(200.0, 300.0, False)]),
        (BAD + GOOD, [(0.0, 300.0, False)]),
        (GOOD + BAD, [(200.0, 475.0, True)]),
        (BAD, [(0.0, 275.0, True)]),
        ([BLIND] * 9, []),
    ],
    ids=["none", "shorter than a view", "a view", "at first", "at last", "all", "on the border"],
)
def test_where_stretches_begin_and_end(probability, expected):
    found = blind_stretches(along_of(probability), CONDITIONS)
    assert [(each.start_m, each.end_m, each.ends_lost) for each in found] == expected


def test_what_dead_reckoning_bears():
    far = along_of(GOOD + [0.1] * 100 + GOOD)
    (stretch,) = blind_stretches(far, CONDITIONS)
    assert stretch.drift_m == pytest.approx(75) and not stretch.recoverable
    (stretch,) = blind_stretches(far, replace(CONDITIONS, prior_std_m=80.0))
    assert stretch.recoverable
    (stretch,) = blind_stretches(far, replace(CONDITIONS, prior_std_m=None))
    assert stretch.recoverable and math.isinf(stretch.allowed_m)
    (stretch,) = blind_stretches(along_of(GOOD + BAD), CONDITIONS)
    assert not stretch.recoverable
