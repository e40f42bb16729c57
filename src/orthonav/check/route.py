"""What a check says along a route: probability, drift, and stretches where views are unlikely to be
placed."""

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from orthonav.check.outcome import Along, Conditions, Stretch
from orthonav.geo.area import Area
from orthonav.geo.route import along_polyline_en_m

Array = NDArray[np.float64]
BLIND = 0.5
"""Below this probability of a fix a stretch is blind."""
POINTS_PER_VIEW = 4.0
MOST_POINTS = 4000
ACROSS = 5
"""Points across the band at every point along it."""
INDEPENDENT_VIEWS = 1.0
"""Views say something new when they lie this many sides apart."""

Told = Callable[[Array], tuple[Array, Array]]
"""Probability and error (N,) at places (N, 2); 0 and NaN beyond the map."""


def predicted_along(
    area: Area,
    bands_m: Sequence[float],
    view_side_m: float,
    conditions: Conditions,
    told: Told,
) -> Along:
    """Predictions along the route of an area; `bands_m` is the width of the band of every leg."""
    assert area.route is not None
    line = area.route.points_en_m(area.frame)
    ends_m = np.cumsum(np.hypot(*np.diff(line, axis=0).T))
    length_m = float(ends_m[-1]) if len(ends_m) else 0.0
    step_m = max(view_side_m / POINTS_PER_VIEW, length_m / MOST_POINTS)
    points, course_deg = along_polyline_en_m(line, max(step_m, 1e-6))
    distance_m = np.minimum(np.arange(len(points)) * step_m, length_m)
    middle, error = told(points)
    course = np.radians(course_deg)
    across = np.stack([np.cos(course), -np.sin(course)], axis=1)
    leg = np.minimum(np.searchsorted(ends_m, distance_m), len(bands_m) - 1)
    across *= np.asarray(bands_m, np.float64)[leg, None]
    shares = np.linspace(-0.5, 0.5, ACROSS)
    lowest = np.min([told(points + share * across)[0] for share in shares], axis=0)
    drift = expected_drift(distance_m, middle, error, conditions.drift, view_side_m)
    return Along(distance_m, points, middle, np.minimum(lowest, middle), error, drift)


def expected_drift(
    distance_m: Array, probability: Array, error_m: Array, drift: float, view_side_m: float
) -> Array:
    """Position error (N,), root mean square, when fixes come as they are predicted.

    A new view every side of a view gives a fix with its probability; between fixes the error grows
    by `drift` per metre. Before the first view the position is taken as known.
    """
    length_m = float(distance_m[-1])
    stops = np.arange(0.0, length_m + view_side_m, INDEPENDENT_VIEWS * view_side_m)
    chance = np.interp(stops, distance_m, probability)
    error = np.interp(stops, distance_m, np.nan_to_num(error_m, nan=0.0))
    found = np.zeros(len(stops))
    # Chance that the last fix was k views ago, times the square of the error since then.
    since: Array = np.array([1.0])
    grown: Array = np.array([error[0] ** 2])
    for i in range(len(stops)):
        if i:
            grown = (np.sqrt(grown) + drift * view_side_m) ** 2
        since = np.concatenate([[since.sum() * chance[i]], since * (1 - chance[i])])
        grown = np.concatenate([[error[i] ** 2], grown])
        keep = since > 1e-9
        keep[-1] = True
        since, grown = since[keep], grown[keep]
        found[i] = math.sqrt(float((since * grown).sum() / since.sum()))
    return np.interp(distance_m, stops, found)


def blind_stretches(
    along: Along, conditions: Conditions, view_side_m: float
) -> tuple[Stretch, ...]:
    """Where the probability is below `BLIND` for at least one side of a view, in order."""
    blind = along.probability < BLIND
    edges = np.flatnonzero(np.diff(np.concatenate([[0], blind.astype(int), [0]])))
    found = []
    last = len(blind) - 1
    for first, end in edges.reshape(-1, 2):
        start_m = float(along.distance_m[first])
        end_m = float(along.distance_m[min(end, last)])
        if end_m - start_m < view_side_m:
            continue
        part = slice(first, end)
        found.append(_stretch(along, part, start_m, end_m, conditions, ends_lost=end > last))
    return tuple(found)


def _stretch(
    along: Along,
    part: slice,
    start_m: float,
    end_m: float,
    conditions: Conditions,
    *,
    ends_lost: bool,
) -> Stretch:
    prior_m = conditions.prior_std_m
    drift_m = conditions.drift * (end_m - start_m)
    return Stretch(
        start_m,
        end_m,
        start_m / conditions.speed_mps,
        end_m / conditions.speed_mps,
        float(along.probability[part].mean()),
        drift_m,
        math.inf if prior_m is None else prior_m,
        ends_lost=ends_lost,
    )
