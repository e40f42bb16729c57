"""Whether a jump of the position by the map looks like a change of the camera's delay.

Positions are compared with the reported velocity since earlier ones. Where they jump, and the
aircraft was, or will be, at the new place some seconds before or after the exposure, the exposure
is in doubt. Needs no manoeuvre, where the comparison of pictures does.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.track.motion import usual_velocity_std_mps
from orthonav.onboard.history import StateHistory

KEEP_S, LONGEST_GAP_S = 5.0, 30.0
"""Earlier positions with which one is compared: a track moves to a new place within seconds. The
last one counts for longer: a track may have been coasting or lost since."""
SIGMAS = 3.0
LONGEST_S, LEAST_S, STEP_S = 12.0, 0.5, 0.1
"""Changes of the delay that are looked for."""
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Place:
    exposed_ns: int
    en_m: Array
    std_m: float


class PositionCheck:
    """Compares positions of one camera. Mutable."""

    def __init__(self) -> None:
        self._places: deque[_Place] = deque(maxlen=100)

    def clear(self) -> None:
        """Forget all positions, as after a change of the delay."""
        self._places.clear()

    def change_s(
        self, exposed_ns: int, en_m: Array, std_m: float, history: StateHistory
    ) -> float | None:
        """Growth of the delay (s) by which the position jumped; None where it did not jump, or to a
        place that no change of the delay explains. The position counts for the next ones.

        `exposed_ns`: time of exposure by the delay in use. `en_m` (2,): metres east and north,
        `std_m` their standard deviation.
        """
        now = _Place(exposed_ns, en_m, std_m)
        while len(self._places) > 1 and self._places[0].exposed_ns < exposed_ns - KEEP_S * 1e9:
            self._places.popleft()
        found = None
        if self._places:
            ago_s, path = _path(exposed_ns, history)
            changes = (_change_s(each, now, ago_s, path) for each in self._places)
            found = next((each for each in changes if each is not None), None)
        self._places.append(now)
        return found


def _path(exposed_ns: int, history: StateHistory) -> tuple[Array, Array]:
    """Times before an exposure (N,) (s, negative: after it), and where the aircraft was then
    (N, 2), metres from where it was at the exposure; NaN where the velocity is not known."""
    after, before = round(LONGEST_S / STEP_S), round(LONGEST_GAP_S / STEP_S)
    ago_s = np.arange(-after, before + 1) * STEP_S
    times_ns = exposed_ns - np.round(ago_s * 1e9).astype(np.int64)
    velocity = history.velocity(np.minimum(times_ns, history.newest_ns))
    velocity[times_ns > history.newest_ns + round(LEAST_S * 1e9)] = np.nan
    steps = (velocity[1:] + velocity[:-1]) / 2 * STEP_S
    later = np.cumsum(steps[:after][::-1], axis=0)[::-1]
    earlier = -np.cumsum(steps[after:], axis=0)
    return np.asarray(ago_s, np.float64), np.concatenate([later, np.zeros((1, 2)), earlier])


def _change_s(before: _Place, now: _Place, ago_s: Array, path: Array) -> float | None:
    """Growth of the delay that explains a jump; None without a jump or an explanation."""
    seconds = (now.exposed_ns - before.exposed_ns) / 1e9
    if not 0 < seconds <= LONGEST_GAP_S:
        return None
    flown = -np.array([np.interp(seconds, ago_s, each) for each in path.T])
    if not np.isfinite(flown).all():
        return None
    jump = now.en_m - before.en_m - flown
    speed_std = usual_velocity_std_mps(float(np.hypot(*flown)) / seconds)
    std_m = math.hypot(before.std_m, now.std_m)
    if not np.hypot(*jump) > SIGMAS * math.hypot(std_m, speed_std * seconds):
        return None
    usual = (np.abs(ago_s) >= LEAST_S) & (np.abs(ago_s) <= LONGEST_S)
    off = np.hypot(*(jump - path).T) / np.hypot(std_m, speed_std * (seconds + np.abs(ago_s)))
    off[~usual | np.isnan(off)] = np.inf
    best = int(np.argmin(off))
    return float(ago_s[best]) if off[best] <= SIGMAS else None
