"""The constant displacement of the map, learnt from long agreement with GNSS.

A spoofed receiver must not move the map: only blocks of agreement count, each waits in quarantine,
an alarm discards those that wait, and the displacement is bounded.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from orthonav.onboard.gnss.difference import Difference, DifferenceModel
from orthonav.onboard.gnss.records import Array, Displacement

UNKNOWN = Displacement()
"""What is assumed of a map without a learnt displacement: 30 m per axis, so 60 m are 2 sigma."""
LARGEST_M = 100.0
"""Largest displacement; a larger difference is a fault."""
BLOCK_S = 120.0
"""Length of a block of agreement."""
QUARANTINE_S = 180.0
"""Time that a block waits before it counts: longer than a drift of 0.25 m/s needs to be named."""
MIN_VALUES = 30
"""Least number of values in a block."""
LEAST_STD_M = 1.0
"""Lower bound of the learnt standard deviation: maps are not displaced by one vector to better
than this."""


@dataclass(frozen=True, eq=False)
class _Block:
    end_s: float
    en_m: Array
    variance_m2: float
    seconds: float


class DisplacementLearner:
    """Learns the displacement of one map. Mutable; deterministic."""

    def __init__(self, start: Displacement, model: DifferenceModel) -> None:
        """`start` is what is known before the flight."""
        self.learnt, self._model = start, model
        self._values: list[Difference] = []
        self._waiting: deque[_Block] = deque()

    def add(self, value: Difference) -> None:
        """Add a value during agreement."""
        if self._values and value.time_s - self._values[0].time_s >= BLOCK_S:
            if len(self._values) >= MIN_VALUES:
                self._waiting.append(self._block())
            self._values = []
        self._values.append(value)
        while self._waiting and self._waiting[0].end_s <= value.time_s - QUARANTINE_S:
            self._commit(self._waiting.popleft())

    def discard(self) -> None:
        """Drop everything that is not committed, as at an alarm."""
        self._values = []
        self._waiting.clear()

    def _block(self) -> _Block:
        model, values = self._model, self._values
        gnss = max(model.gnss_std_m, float(np.median([each.gnss_std_m for each in values])))
        map_std = float(np.median([each.map_std_m for each in values]))
        # variance of the mean of a Gauss-Markov process: 2 tau / T of its variance
        gnss_m2 = gnss**2 * max(1.0, 2 * model.gnss_tau_s / BLOCK_S)
        map_m2 = map_std**2 * max(1.0, 2 * model.map_tau_s / BLOCK_S)
        mean = np.mean([each.en_m for each in values], axis=0)
        seconds = values[-1].time_s - values[0].time_s
        return _Block(values[-1].time_s, mean, gnss_m2 + map_m2, seconds)

    def _commit(self, block: _Block) -> None:
        """Precision-weighted mean of what was known and a block."""
        before = self.learnt
        gain = before.std_m**2 / (before.std_m**2 + block.variance_m2)
        moved = before.en_m + gain * (block.en_m - before.en_m)
        length = float(np.hypot(*moved))
        if length > LARGEST_M:
            moved *= LARGEST_M / length
        std = max(LEAST_STD_M, before.std_m * math.sqrt(1 - gain))
        east, north = moved.tolist()
        self.learnt = Displacement(east, north, std, before.agreed_s + block.seconds)
