"""Error of the map's position while the aircraft rolls into a turn or out of it.

A latency of the images then takes the tilt of another moment: at 300 m, 0.3 s and 10 deg/s it
displaces the view by 16 m for seconds, which looks like a step of GNSS.
"""

import math
from collections import deque

import numpy as np

from orthonav.onboard.gnss.biases import Biases
from orthonav.onboard.gnss.difference import Difference

LARGEST_GAP_S = 2.0
"""Values farther apart do not show how the aircraft turned between them."""
LEAST_DEG_S2 = 3.0
"""Change of the turn rate per second from which the aircraft rolls; less is noise of headings."""
LATENCY_STD_S = 0.08
"""Standard deviation of the latency of the images beyond the learnt one. With more, a step of GNSS
in a turn is named after more than 5 s; with less, images that are 0.3 s late look like steps."""
GRAVITY_MPS2 = 9.81


class Rolling:
    """Recognizes rolling by the change of the turn rate. Mutable; deterministic."""

    def __init__(self) -> None:
        self._before: deque[Difference] = deque(maxlen=2)

    def std_m(self, value: Difference, known: Biases) -> float:
        """Standard deviation of the error of a value, the next after those before; 0 without.

        `known`: for the latency that it may be due to.
        """
        values = [*self._before, value]
        self._before.append(value)
        change = _change_of_rate(*values) if len(values) == 3 else 0.0
        if change <= math.radians(LEAST_DEG_S2):
            return 0.0
        # in a coordinated turn the tangent of the bank is speed times turn rate over gravity
        bank_rate = float(np.hypot(*value.vel_en_mps)) * change / GRAVITY_MPS2
        latency_s = math.hypot(known.mean[4], LATENCY_STD_S)
        return latency_s * bank_rate * value.agl_m


def _change_of_rate(first: Difference, middle: Difference, last: Difference) -> float:
    """Magnitude of the change of the turn rate per second; 0 where it is not known."""
    before_s, after_s = middle.time_s - first.time_s, last.time_s - middle.time_s
    if not (0 < before_s <= LARGEST_GAP_S and 0 < after_s <= LARGEST_GAP_S):
        return 0.0
    before = math.remainder(middle.heading_rad - first.heading_rad, math.tau) / before_s
    after = math.remainder(last.heading_rad - middle.heading_rad, math.tau) / after_s
    return 2 * abs(after - before) / (before_s + after_s)
