"""Learning the biases of GNSS minus map, by a Kalman filter over values in agreement.

The state is the biases and the slowly varying errors of the difference (`DifferenceModel`): with
these in the state the differences are correlated, and the covariance of the biases is honest. A
combination of biases that a flight does not show stays as uncertain as before.

A spoofed receiver must not move the map: only values in agreement count, each waits in quarantine,
an alarm discards those that wait, an offset discards all that was learnt since the reference,
outliers are left out, and the biases are bounded.
"""

import copy
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthonav.onboard.gnss.biases import LIMITS, NAMES, Biases, biases_from_plain
from orthonav.onboard.gnss.difference import Difference, DifferenceModel
from orthonav.onboard.gnss.records import Array

QUARANTINE_S = 180.0
"""Time that a value waits before it counts: longer than a drift of 0.25 m/s needs to be named."""
SETTLED_S = 1800.0
"""Time of agreement after which biases count as known."""
OUTLIER = 13.8
"""Squared Mahalanobis distance of an outlier: chi-square of two axes, 99.9 %."""
LARGEST_STEP_S = 2.0
"""Most time of agreement that one value counts."""
_WALK = np.array([0.02, 0.02, math.radians(0.003), math.radians(0.003), 5e-4])
"""Random walk of the biases, per root second, so that old values are forgotten over an hour: the
displacement of a map is not the same everywhere, the track corrects part of the tilt."""
_BIAS, _GNSS, _LOCAL, _BODY = slice(0, 5), slice(5, 7), slice(7, 9), slice(9, 11)
_STATES = 11


@dataclass(frozen=True, eq=False)
class Resumed:
    """What a flight had learnt before its process was restarted.

    `learnt`, `reference`: see `BiasLearner`.
    """

    learnt: Biases
    reference: Biases

    def to_plain(self, before: Biases | None) -> dict[str, Any]:
        """Values for strict JSON. `before`: what was known of the map before the flight, if it was
        known at all."""
        flight = {"reference": self.reference.to_plain()}
        if before is not None:
            flight["before"] = before.to_plain()
        return {**self.learnt.to_plain(), "flight": flight}


def before_flight(plain: Mapping[str, Any]) -> tuple[Biases | None, Resumed | None]:
    """Inverse of `Resumed.to_plain`: what was known before the flight, and what it had learnt.

    Values without a flight were known before it. Raises as `biases_from_plain`.
    """
    learnt, flight = biases_from_plain(plain), plain.get("flight")
    if flight is None:
        return learnt, None
    before = biases_from_plain(flight["before"]) if "before" in flight else None
    return before, Resumed(learnt, biases_from_plain(flight["reference"]))


class BiasLearner:
    """Learns the biases of one receiver over one map. Mutable; deterministic."""

    def __init__(
        self, start: Biases, model: DifferenceModel, resumed: Resumed | None = None
    ) -> None:
        """`start` is what is known before the flight; a `resumed` flight continues to learn with
        the reference that it had."""
        resumed = resumed or Resumed(start, start)
        self._model, self._filter = model, _Filter(resumed.learnt, model)
        self._reference = resumed.reference
        self._waiting: deque[Difference] = deque()

    @property
    def learnt(self) -> Biases:
        """Estimate from all values whose quarantine has ended."""
        return self._filter.biases

    @property
    def reference(self) -> Biases:
        """What a slow drag-off of this flight has not moved: the biases before the flight, or,
        where they were not known, after the first `SETTLED_S` of agreement."""
        return self._reference

    def add(self, value: Difference) -> None:
        """Add a value during agreement."""
        self._waiting.append(value)
        while self._waiting and self._waiting[0].time_s <= value.time_s - QUARANTINE_S:
            self._filter.update(self._waiting.popleft())
        if self._reference.agreed_s < SETTLED_S <= self.learnt.agreed_s:
            self._reference = self.learnt

    def widen(self, rolling_std_m: float) -> None:
        """Give the newest value at least this error by rolling."""
        if self._waiting:
            self._waiting[-1] = self._waiting[-1].rolling(rolling_std_m)

    def discard(self) -> None:
        """Drop everything in quarantine, as at an alarm."""
        self._waiting.clear()

    def restore(self) -> None:
        """Go back to the reference, if there is one: a drag-off may have been learnt since."""
        self.discard()
        if self._reference.agreed_s >= SETTLED_S:
            self._filter = _Filter(self._reference, self._model)

    def until(self, time_s: float) -> Biases:
        """Estimate with the values before a time as well, though they are in quarantine."""
        ahead = copy.copy(self._filter)
        for value in self._waiting:
            if value.time_s < time_s:
                ahead.update(value)
        return ahead.biases


class _Filter:
    """The filter; its arrays are replaced, never changed, so a shallow copy is independent."""

    def __init__(self, start: Biases, model: DifferenceModel) -> None:
        self.biases, self._model = start, model
        self._taus = np.repeat([model.gnss_tau_s, model.map_tau_s, model.mount_tau_s], 2)
        self._mean = np.concatenate([start.mean, np.zeros(_STATES - len(NAMES))])
        self._cov = np.eye(_STATES)
        self._cov[_BIAS, _BIAS] = start.cov
        self._time_s: float | None = None

    def update(self, value: Difference) -> None:
        """Update with a value, unless it is an outlier."""
        elapsed_s = 0.0 if self._time_s is None else value.time_s - self._time_s
        mean, cov = self._predicted(elapsed_s)
        shown = self._design(value)
        noise_m2 = self._model.white_share * value.map_std_m**2 + value.rolling_std_m**2
        spread = shown @ cov @ shown.T + noise_m2 * np.eye(2)
        off = value.en_m - shown @ mean
        gain = np.linalg.solve(spread, shown @ cov).T
        self._mean, self._cov, self._time_s = mean, cov, value.time_s
        if off @ np.linalg.solve(spread, off) <= OUTLIER:
            self._mean, cov = mean + gain @ off, cov - gain @ spread @ gain.T
            self._cov = (cov + cov.T) / 2
            agreed_s = self.biases.agreed_s + min(max(elapsed_s, 0.0), LARGEST_STEP_S)
            self.biases = replace(self.biases, agreed_s=agreed_s)
        bounded = np.clip(self._mean[_BIAS], -LIMITS, LIMITS)
        length = float(np.hypot(*bounded[:2]))
        bounded[:2] *= min(1.0, LIMITS[0] / max(length, 1.0))
        self._mean = np.concatenate([bounded, self._mean[len(NAMES) :]])
        self.biases = replace(self.biases, mean=bounded, cov=self._cov[_BIAS, _BIAS])

    def _predicted(self, elapsed_s: float) -> tuple[Array, Array]:
        """State and covariance after a time; a clock that went back begins new slow errors."""
        elapsed_s = elapsed_s if elapsed_s >= 0 else math.inf
        kept = np.concatenate([np.ones(len(NAMES)), np.exp(-elapsed_s / self._taus)])
        walked_s = elapsed_s if math.isfinite(elapsed_s) else 0.0
        grown = np.concatenate([_WALK**2 * walked_s, 1 - kept[len(NAMES) :] ** 2])
        return kept * self._mean, np.multiply.outer(kept, kept) * self._cov + np.diag(grown)

    def _design(self, value: Difference) -> Array:
        """Derivatives (2, 11) of a value by the state; slow errors have unit variance."""
        model = self._model
        made = np.zeros((2, _STATES))
        made[:, _BIAS] = value.design
        made[:, _GNSS] = max(value.gnss_std_m, model.gnss_std_m) * np.eye(2)
        local_share = 1 - model.mount_share - model.white_share
        made[:, _LOCAL] = math.sqrt(local_share) * value.map_std_m * np.eye(2)
        sin, cos = math.sin(value.heading_rad), math.cos(value.heading_rad)
        turned = np.array([[cos, sin], [-sin, cos]])
        made[:, _BODY] = math.sqrt(model.mount_share) * value.map_std_m * turned
        return made
