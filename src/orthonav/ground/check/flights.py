"""Many flights along a route, simulated: what the chances of fixes mean for the position.

The ground of a flight is easier or harder than predicted as a whole: one shift of the logit for all
of it. One draw for every half side of a view decides whether views there are localized;
neighbouring draws are correlated (a Gauss-Markov process behind a threshold), because their views
show much of the same ground. Between fixes the error grows with the distance, and no position is
available. The protection level is that of a right place (core/integrity.py), as the views of a
track confirm each other; wrong places count as false fixes.
"""

import numpy as np
from numpy.typing import NDArray

from orthonav.core.integrity import protection_level_m
from orthonav.ground.check.estimate import INTERVAL, expit, logit
from orthonav.ground.check.records import Along, Conditions, Flights, Range

Array = NDArray[np.float64]
CORRELATION = 0.5
"""Of the latent normal values of neighbouring draws, whose views share half of their ground."""


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
    """Shifts of the logit (F,), equally likely, one a flight."""
    from scipy.special import ndtri

    return np.asarray(std * ndtri((np.arange(400) + 0.5) / 400))


def simulated(
    along: Along,
    conditions: Conditions,
    shifts: Array,
    false_fixes: float,
    rng: np.random.Generator,
) -> Flights:
    """Flights along a route; the first position is a fix.

    `shifts` (F,): of the logit of the chances, one a flight. `false_fixes`: number of trials that
    were false fixes, from which the uncertainty of the rate follows (gamma distribution).
    """
    from scipy.special import ndtri

    distance_m, rounding = along.distance_m, 1e-9
    step_m = conditions.side_m / 2  # views that overlap by more are hardly independent
    stops_m = np.arange(int(distance_m[-1] / step_m + rounding) + 1) * step_m
    stated = np.isfinite(along.error_m)
    usual_m = float(along.error_m[stated].mean()) if stated.any() else np.inf
    error_m = np.interp(stops_m, distance_m, np.where(stated, along.error_m, usual_m))
    chances = shifted(np.interp(stops_m, distance_m, along.probability), shifts)
    fixed = _gauss_markov(rng, chances.shape) < ndtri(chances)
    fixed[:, 0] = True
    numbers = np.where(fixed, np.arange(len(stops_m)), 0)
    before = np.minimum(np.floor(distance_m / step_m + rounding), len(stops_m) - 1).astype(int)
    last = np.maximum.accumulate(numbers, axis=1)[:, before]
    since_m = np.maximum(distance_m - stops_m[last] - step_m, 0.0)
    errors_m = np.hypot(error_m[last], conditions.drift * since_m)
    levels_m = level_m(errors_m, conditions.risk)
    # Past that the flight coasts: nothing confirms its place (core/track/mixture.py).
    levels_m[since_m > rounding] = np.inf
    available = levels_m <= conditions.alert_limit_m
    lengths_m = along.lengths_m
    outage_m = _longest(available, lengths_m) if distance_m[-1] > 0 else np.zeros(len(shifts))
    shape = false_fixes + 0.5
    wrong = np.interp(stops_m, distance_m, along.wrong).clip(0, 1)
    rates = wrong * rng.gamma(shape, 1 / shape, (len(shifts), 1))
    known = 1.0 if conditions.states_level else np.nan  # times what follows from the levels
    median_m, high_m = np.quantile(levels_m, (0.5, INTERVAL[1]), axis=0, method="nearest")
    return Flights(
        count=len(shifts),
        probability=Range.of(chances.mean(axis=1)),
        availability=Range.of(known * (available @ lengths_m) / lengths_m.sum()),
        outage_m=Range.of(known * outage_m),
        outage_s=Range.of(known * outage_m / conditions.speed_mps),
        error_95_m=Range.of(level_m(errors_m.max(axis=1), 0.05)),
        false_fix=Range.of(1 - np.exp(-rates.sum(axis=1))),
        available=known * available.mean(axis=0),
        protection_m=known * median_m,
        protection_high_m=known * high_m,
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
