"""Many flights along a route, simulated: what the chances of fixes mean for the position.

The ground of a flight is easier or harder than predicted as a whole: one shift of the logit for all
of it. One draw for every half side of a view decides whether views there are localized;
neighbouring draws are correlated (a Gauss-Markov process behind a threshold), because their views
show much of the same ground. Between fixes the error grows with the distance, and no position is
available. The protection level is that of a right place (core/integrity.py), as the views of a
track confirm each other; wrong places count as false fixes.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthonav.core.integrity import protection_level_m
from orthonav.ground.check.estimate import INTERVAL, Prediction, expit, logit
from orthonav.ground.check.records import Conditions, Flights, Range

Array = NDArray[np.float64]
FLIGHTS = 400
DRAWS_PER_VIEW = 2.0
"""Draws per side of a view: views that overlap by more than half are hardly independent."""
CORRELATION = 0.5
"""Of the latent normal values of neighbouring draws, whose views share half of their ground."""
ROUNDING = 1e-9
TAIL = 0.05
"""Probability of an error beyond the stated position error of 95 %."""


def level_m(error_m: Array | float, risk: float) -> Array:
    """Protection level of a right place for errors (..), root mean square, alike in all directions:
    with the default `risk` 4.7 times the error."""
    return np.asarray(error_m * protection_level_m(1.0, np.eye(2) / 2, risk))


def after_fix_m(error_m: Array, risk: float) -> Range:
    """Protection level right after a fix, over places; infinite where no fix is expected."""
    known = error_m[np.isfinite(error_m)]
    return Range.of(level_m(known if len(known) else np.array([np.inf]), risk))


def shifted(probability: Array, shifts: Array) -> Array:
    """Chances (F, N) when the logit of chances (N,) is shifted; those of 0 stay 0."""
    moved = expit(logit(probability) + np.asarray(shifts)[:, None])
    return np.asarray(np.where(probability > 0, moved, 0.0))


def scene_shifts(std: float) -> Array:
    """Shifts of the logit (F,), equally likely."""
    from scipy.special import ndtri

    return np.asarray(std * ndtri((np.arange(FLIGHTS) + 0.5) / FLIGHTS))


def simulated(
    distance_m: Array,
    found: Prediction,
    conditions: Conditions,
    shifts: Array,
    false_fixes: float,
    rng: np.random.Generator,
) -> Flights:
    """Flights past points (N,) of a route with these predictions; the first position is a fix.

    `shifts` (F,): of the logit of the chances, one a flight. `false_fixes`: number of trials that
    were false fixes, from which the uncertainty of the rate follows (gamma distribution).
    """
    from scipy.special import ndtri

    length_m = float(distance_m[-1])
    step_m = conditions.side_m / DRAWS_PER_VIEW
    stops_m = np.arange(int(length_m / step_m + ROUNDING) + 1) * step_m
    known = np.isfinite(found.error_m)
    usual_m = float(found.error_m[known].mean()) if known.any() else np.inf
    error_m = np.interp(stops_m, distance_m, np.where(known, found.error_m, usual_m))
    chances = shifted(np.interp(stops_m, distance_m, found.probability), shifts)
    fixed = _gauss_markov(rng, chances.shape) < ndtri(chances)
    fixed[:, 0] = True
    numbers = np.where(fixed, np.arange(len(stops_m)), 0)
    before = np.minimum(np.floor(distance_m / step_m + ROUNDING), len(stops_m) - 1).astype(int)
    last = np.maximum.accumulate(numbers, axis=1)[:, before]
    since_m = np.maximum(distance_m - stops_m[last] - step_m, 0.0)
    errors_m = np.hypot(error_m[last], conditions.drift * since_m)
    levels_m = level_m(errors_m, conditions.risk)
    # Past that the flight coasts: nothing confirms its place (core/track/mixture.py).
    levels_m[since_m > ROUNDING] = np.inf
    available = levels_m <= conditions.alert_limit_m
    # Each point stands for the route half-way to its neighbours.
    lengths_m = np.gradient(distance_m) if length_m > 0 else np.ones(1)
    lengths_m[[0, -1]] /= 2 if length_m > 0 else 1
    outage_m = _longest(available, lengths_m) if length_m > 0 else np.zeros(len(shifts))
    shape = false_fixes + 0.5
    wrong = np.interp(stops_m, distance_m, found.wrong).clip(0, 1)
    rates = wrong * rng.gamma(shape, 1 / shape, (len(shifts), 1))
    flights = Flights(
        count=len(shifts),
        probability=Range.of(chances.mean(axis=1)),
        availability=Range.of(available @ lengths_m / lengths_m.sum()),
        outage_m=Range.of(outage_m),
        outage_s=Range.of(outage_m / conditions.speed_mps),
        error_95_m=Range.of(level_m(errors_m.max(axis=1), TAIL)),
        false_fix=Range.of(1 - np.exp(-rates.sum(axis=1))),
        available=available.mean(axis=0),
        protection_m=np.quantile(levels_m, 0.5, axis=0, method="nearest"),
        protection_high_m=np.quantile(levels_m, INTERVAL[1], axis=0, method="nearest"),
    )
    if conditions.states_level:
        return flights
    unknown, nowhere = Range(np.nan, np.nan, np.nan), np.full(len(distance_m), np.nan)
    return replace(
        flights,
        availability=unknown,
        outage_m=unknown,
        outage_s=unknown,
        available=nowhere,
        protection_m=nowhere,
        protection_high_m=nowhere,
    )


def _gauss_markov(rng: np.random.Generator, shape: tuple[int, int]) -> Array:
    """Standard normal values (F, K), each correlated with the one before by `CORRELATION`."""
    values = rng.standard_normal(shape)
    for i in range(1, shape[1]):
        values[:, i] *= np.sqrt(1 - CORRELATION**2)
        values[:, i] += CORRELATION * values[:, i - 1]
    return values


def _longest(available: NDArray[np.bool_], lengths_m: Array) -> Array:
    """Length (F,) of the longest part of the route without an available position."""
    ends_m = np.cumsum(lengths_m)
    at_last_m = np.maximum.accumulate(np.where(available, ends_m, 0.0), axis=1)
    return np.asarray((ends_m - at_last_m).max(axis=1))
