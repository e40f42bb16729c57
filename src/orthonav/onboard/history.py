"""States of the camera that the autopilot reported in the last minute, at increasing times."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthonav.onboard.motion import ReportedMotion, reported_motion

KEEP_S = 60.0
"""Longest delay, the window of the estimate, and some more."""
GAP_S = 0.3
"""Longest interval that is interpolated, unless the history says otherwise."""
CAPACITY = 4096
Array = NDArray[np.float64]
Times = NDArray[np.int64]


class StateHistory:
    """Attitude, velocity and height of the camera over time. Mutable."""

    def __init__(self, gap_s: float = GAP_S) -> None:
        """`gap_s`: longest interval between states that is interpolated."""
        self._gap_ns = round(gap_s * 1e9)
        self._times: Times = np.zeros(CAPACITY, np.int64)
        self._rows: Array = np.zeros((CAPACITY, 13))
        self._count = 0

    @property
    def newest_ns(self) -> int:
        """Time of the newest state; a time before all where there is none."""
        return int(self._times[self._count - 1]) if self._count else -(2**62)

    def add(
        self,
        time_ns: int,
        enu_from_camera: ArrayLike | None,
        velocity_enu_mps: ArrayLike | None,
        height_m: float,
    ) -> None:
        """Add a state: rotation (3, 3) from camera axes to east, north, up, velocity (3,), height
        above ground. None and NaN: not known. A time that is not newer than the last is ignored."""
        if time_ns <= self.newest_ns:
            return
        if self._count == CAPACITY:
            self._drop(time_ns - round(KEEP_S * 1e9))
        row = np.full(13, math.nan)
        if enu_from_camera is not None:
            row[:9] = np.ravel(enu_from_camera)
        if velocity_enu_mps is not None:
            row[9:12] = velocity_enu_mps
        row[12] = height_m if height_m > 0 else math.nan
        self._times[self._count], self._rows[self._count] = time_ns, row
        self._count += 1

    def motion(self, start_ns: Times, end_ns: Times) -> ReportedMotion:
        """Motion of the picture between N pairs of times (N,), all of one duration."""
        start, end = self._at(start_ns), self._at(end_ns)
        seconds = float(end_ns[0] - start_ns[0]) / 1e9
        velocity, height = (start[:, 9:12] + end[:, 9:12]) / 2, start[:, 12]
        before, after = (each[:, :9].reshape(-1, 3, 3) for each in (start, end))
        return reported_motion(before, after, velocity, height, seconds)

    def velocity(self, times_ns: Times) -> Array:
        """Velocities (N, 2) east and north at N times; NaN where not known."""
        return self._at(times_ns)[:, 9:11]

    def speed_mps(self) -> float:
        """Newest speed over ground; NaN where not known."""
        if not self._count:
            return math.nan
        return float(np.hypot(*self._rows[self._count - 1, 9:11]))

    def _at(self, times_ns: Times) -> Array:
        """Values (N, 13), linear between states; NaN where not known."""
        if self._count < 2:
            return np.full((len(times_ns), 13), math.nan)
        times = self._times[: self._count]
        after = np.clip(np.searchsorted(times, times_ns), 1, self._count - 1)
        begin, until = times[after - 1], times[after]
        weight = ((times_ns - begin) / (until - begin))[:, None]
        values = (1 - weight) * self._rows[after - 1] + weight * self._rows[after]
        known = (times_ns >= begin) & (times_ns <= until) & (until - begin <= self._gap_ns)
        return np.asarray(np.where(known[:, None], values, math.nan))

    def _drop(self, before_ns: int) -> None:
        """Forget states before a time, at least half of them."""
        first = max(int(np.searchsorted(self._times, before_ns)), CAPACITY // 2)
        rest = self._count - first
        self._times[:rest] = self._times[first : self._count].copy()
        self._rows[:rest] = self._rows[first : self._count].copy()
        self._count = rest
