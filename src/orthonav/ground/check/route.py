"""Predictions along a route: probability, drift, and gaps."""

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from orthonav.ground.check.estimate import Prediction
from orthonav.ground.check.outcome import Along, BlindStretch, Conditions
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import along_polyline_en_m

Array = NDArray[np.float64]
BLIND = 0.5
"""A gap lies below this probability: more likely no fix than a fix."""
POINTS_PER_VIEW = 4.0
"""Points along the route per side of a view, as many as cells."""
MAX_POINTS = 4000
_REACHED = 1e-6
"""A shorter rest of the route, as a fraction of the distance between points, is none."""
ACROSS = 5
"""Points across the band at every point along it."""
NEGLIGIBLE = 1e-9
"""Chances below this no longer change the expected drift."""


def predicted_along(
    area: Area,
    bands_m: Sequence[float],
    view_side_m: float,
    conditions: Conditions,
    predict: Callable[[Array], Prediction],
) -> Along:
    """Predictions along the route of an area.

    `bands_m` is the width of the band of every leg; `predict` takes places (N, 2) and returns a
    probability of 0 and an error of NaN beyond the map.
    """
    assert area.route is not None
    line = area.route.points_en_m(area.frame)
    ends_m = np.cumsum(np.hypot(*np.diff(line, axis=0).T))
    length_m = float(ends_m[-1]) if len(ends_m) else 0.0
    step_m = max(view_side_m / POINTS_PER_VIEW, length_m / MAX_POINTS)
    points, course_deg = along_polyline_en_m(line, max(step_m, 1e-6))
    distance_m = np.minimum(np.arange(len(points)) * step_m, length_m)
    if length_m - distance_m[-1] > _REACHED * step_m:  # the last waypoint
        points, distance_m = np.vstack([points, line[-1]]), np.append(distance_m, length_m)
        course_deg = np.append(course_deg, np.degrees(np.arctan2(*(line[-1] - points[-2]))) % 360)
    middle = predict(points)
    course = np.radians(course_deg)
    across = np.stack([np.cos(course), -np.sin(course)], axis=1)
    leg = np.minimum(np.searchsorted(ends_m, distance_m), len(bands_m) - 1)
    across *= np.asarray(bands_m, np.float64)[leg, None]
    shares = np.linspace(-0.5, 0.5, ACROSS)
    lowest = np.min([predict(points + share * across).probability for share in shares], axis=0)
    return Along(
        distance_m=distance_m,
        points_en_m=points,
        probability=middle.probability,
        low=middle.low,
        high=middle.high,
        across_low=np.minimum(lowest, middle.probability),
        error_m=middle.error_m,
        drift_m=expected_drift(
            distance_m, middle.probability, middle.error_m, conditions.drift, view_side_m
        ),
    )


def expected_drift(
    distance_m: Array, probability: Array, error_m: Array, drift: float, view_side_m: float
) -> Array:
    """Expected position error (N,), root mean square, when fixes arrive as predicted.

    An independent view every `view_side_m` gives a fix with its probability; between fixes the
    error grows by `drift` per metre. The position is known before the first view.
    """
    length_m = float(distance_m[-1])
    stops = np.arange(0.0, length_m + view_side_m, view_side_m)
    chance = np.interp(stops, distance_m, probability)
    error = np.interp(stops, distance_m, np.nan_to_num(error_m, nan=0.0))
    expected = np.zeros(len(stops))
    # Chance that the last fix was k views ago, and the square of the error that has grown since.
    since: Array = np.array([1.0])
    grown: Array = np.array([error[0] ** 2])
    for i in range(len(stops)):
        if i:
            grown = (np.sqrt(grown) + drift * view_side_m) ** 2
        since = np.concatenate([[since.sum() * chance[i]], since * (1 - chance[i])])
        grown = np.concatenate([[error[i] ** 2], grown])
        counts = since > NEGLIGIBLE
        counts[-1] = True
        since, grown = since[counts], grown[counts]
        expected[i] = math.sqrt(float((since * grown).sum() / since.sum()))
    return np.interp(distance_m, stops, expected)


def blind_stretches(
    along: Along, conditions: Conditions, view_side_m: float
) -> tuple[BlindStretch, ...]:
    """Gaps: stretches of at least one side of a view with a probability below `BLIND`, in order."""
    blind = along.probability < BLIND
    edges = np.flatnonzero(np.diff(np.concatenate([[0], blind.astype(int), [0]])))
    last = len(blind) - 1
    allowed_m = math.inf if conditions.prior_std_m is None else conditions.prior_std_m
    found = []
    for first, end in edges.reshape(-1, 2):
        start_m = float(along.distance_m[first])
        end_m = float(along.distance_m[min(end, last)])
        if end_m - start_m < view_side_m:
            continue
        stretch = BlindStretch(
            start_m=start_m,
            end_m=end_m,
            start_s=start_m / conditions.speed_mps,
            end_s=end_m / conditions.speed_mps,
            probability=float(along.probability[first:end].mean()),
            drift_m=conditions.drift * (end_m - start_m),
            allowed_m=allowed_m,
            ends_lost=bool(end > last),
        )
        found.append(stretch)
    return tuple(found)
