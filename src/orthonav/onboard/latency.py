"""The latency of a live camera, from exposure to arrival: as stated, and whether positions fit it.

Nothing is estimated in flight. An image that is later than stated shows a place where the aircraft
was before: the displacement of the track differs from the reported motion by a part of the path.
Positions are then withheld until the reported motion at the stated latency explains the track
better than that at the other one, which only a turn or a change of speed can show.
"""

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.track.motion import usual_velocity_std_mps

UNKNOWN, MISMATCH = "latency_unknown", "motion_mismatch"
MIN_STD_S = 0.03
"""Of a stated latency: one image at 30 Hz."""
MAX_STD_S = 0.3
"""A latency that is known less well is refused: 5 m at 15 m/s."""
SIGMAS = 3.0
MAX_GAP_S = 30.0
"""Positions farther apart are not compared."""
STEP_S = 0.5
"""Resolution of changes of the latency, and interval of the positions that are stored."""
CHANGES_S = np.arange(1, 25) * STEP_S
Array = NDArray[np.float64]
MeanVelocity = Callable[[int, int], tuple[float, float] | None]
"""Reported velocity (m/s east, north), mean between two times of our clock; None: not known."""


class _Place(NamedTuple):
    exposed_ns: int
    en_m: Array
    std_m: float


class LatencyMonitor:
    def __init__(self, stated_s: float | None = None, std_s: float = MIN_STD_S) -> None:
        """`stated_s`: None: not stated."""
        self._is_stated = stated_s is not None
        self.delay_s, self.std_s = stated_s or 0.0, max(std_s, MIN_STD_S)
        self._frame: LocalFrame | None = None
        self._places: deque[_Place] = deque(maxlen=round(5.0 / STEP_S))
        self._change_s: float | None = None
        self._support = 0.0

    @property
    def is_known(self) -> bool:
        return self._is_stated and self.std_s <= MAX_STD_S

    def reasons(self, now_ns: int = 0) -> list[str]:
        """Why positions are withheld, whatever the time."""
        if not self.is_known:
            return [UNKNOWN]
        return [] if self._change_s is None else [MISMATCH]

    def detail(self) -> str:
        if not self._is_stated:
            advice = "give --camera-latency-ms, as `orthonav calibrate --latency` measures it"
            return f"camera latency not known: {advice}"
        if not self.is_known:
            return f"camera latency known to {self.std_s * 1e3:.0f} ms only: measure it again"
        if self._change_s is None:
            return ""
        jumped = f"the position jumped as by a change of the latency of {self._change_s:+.1f} s"
        return f"{jumped}: it is withheld until the track moves as reported, in turns"

    def plain(self) -> dict[str, float | str | None]:
        text = "".join(f"{reason}: {self.detail()}" for reason in self.reasons())
        return {
            "latency_ms": round(self.delay_s * 1e3, 1) if self._is_stated else None,
            "latency_std_ms": round(self.std_s * 1e3, 1) if self._is_stated else None,
            "latency": text or "stated",
        }

    def located(
        self,
        exposed_ns: int,
        latlon_deg: tuple[float, float],
        std_m: float,
        velocity: MeanVelocity,
    ) -> None:
        """Compare the position of a recognized view with those of the seconds before."""
        if self._frame is None:
            self._frame = LocalFrame(*latlon_deg)
        now = _Place(exposed_ns, np.asarray(self._frame.en_from_latlon(*latlon_deg)), std_m)
        changes = (_change_s(each, now, velocity) for each in self._places)
        jumped_s = next((each for each in changes if each is not None), None)
        if jumped_s is not None:
            total_s = (self._change_s or 0.0) + jumped_s
            self._change_s = total_s if abs(total_s) >= STEP_S else None
            self._support = 0.0
            self._places.clear()
        elif self._places and exposed_ns - self._places[-1].exposed_ns < STEP_S * 1e9:
            return
        self._places.append(now)
        if self._change_s is not None and self._is_as_stated(self._change_s, velocity):
            self._change_s = None

    def _is_as_stated(self, change_s: float, velocity: MeanVelocity) -> bool:
        """Whether the stated latency explains the displacements since the jump better than the
        changed one, by the log of their likelihood ratio."""
        places, shift_ns = list(self._places), round(change_s * 1e9)
        # After a shrunk latency the reported motion is later than the positions.
        first, last = places[0], places[-1 if change_s > 0 else len(places) // 2]
        stated = _residual_m(first, last, velocity)
        changed = _residual_m(first, last, velocity, shift_ns)
        if stated is not None and changed is not None:
            variance_m2 = first.std_m**2 + last.std_m**2
            self._support += float(changed @ changed - stated @ stated) / (2 * variance_m2)
            self._support = max(self._support, -SIGMAS)
        return self._support > SIGMAS


def _residual_m(
    before: _Place, now: _Place, velocity: MeanVelocity, shift_ns: int = 0
) -> Array | None:
    """Displacement (2,) of the track less the reported one, for exposures earlier by `shift_ns`."""
    seconds = (now.exposed_ns - before.exposed_ns) / 1e9
    if not 0 < seconds <= MAX_GAP_S:
        return None
    mean = velocity(before.exposed_ns - shift_ns, now.exposed_ns - shift_ns)
    return None if mean is None else now.en_m - before.en_m - np.array(mean) * seconds


def _change_s(before: _Place, now: _Place, velocity: MeanVelocity) -> float | None:
    """Growth of the latency by which the position jumped; None where it did not, or where no
    latency explains it."""
    residual = _residual_m(before, now, velocity)
    if residual is None:
        return None
    seconds = (now.exposed_ns - before.exposed_ns) / 1e9
    std_m = math.hypot(before.std_m, now.std_m)
    flown_m = float(np.hypot(*(now.en_m - before.en_m - residual)))
    std_mps = usual_velocity_std_mps(flown_m / seconds)
    if not float(np.hypot(*residual)) > SIGMAS * math.hypot(std_m, std_mps * seconds):
        return None
    sizes = {
        change_s: float(np.hypot(*(residual - path)))
        / math.hypot(std_m, std_mps * (seconds + abs(change_s)))
        for change_s, path in _paths(now.exposed_ns, velocity)
    }
    best = min(sizes, key=sizes.__getitem__, default=math.nan)
    return best if sizes.get(best, math.inf) <= SIGMAS else None


def _paths(exposed_ns: int, velocity: MeanVelocity) -> list[tuple[float, Array]]:
    """Changes of the latency, and where the aircraft was then (2,), from where it was at the
    exposure; after the exposure as it flies now."""
    paths = []
    now = velocity(exposed_ns - round(STEP_S * 1e9), exposed_ns)
    for change_s in CHANGES_S.tolist():
        earlier = velocity(exposed_ns - round(change_s * 1e9), exposed_ns)
        if earlier is not None:
            paths.append((change_s, -change_s * np.array(earlier)))
        if now is not None:
            paths.append((-change_s, change_s * np.array(now)))
    return paths
