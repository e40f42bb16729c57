"""Checks of a GNSS receiver by itself: lost, frozen, jumping, velocity against position."""

import math
from bisect import bisect_left
from dataclasses import dataclass

import numpy as np

from orthonav.core.flight.gnss import GnssSample
from orthonav.onboard.gnss.records import NANOSECONDS, Array, Fault

LOST_STD_M = 50.0
"""Stated standard deviation from which a position counts as none: that of `--max-std-m`."""
SILENCE_S = 3.0
"""Time without a message after which a receiver counts as lost; streams are 1 to 10 Hz."""
STILL_S = 3.0
"""Time with an equal position or timestamp after which a receiver counts as frozen."""
MOVING_MPS = 3.0
"""Speed from which an unchanged position is a fault."""
GAP_S = 2.0
"""Samples farther apart are not compared with each other."""
JUMP_S, JUMP_M = 3.0, 15.0
"""Positions that leave the integrated velocity by more than this, within this time, have jumped:
multipath makes steps of up to 10 m."""
VELOCITY_S = 20.0
"""Span over which velocity and positions are compared."""
VELOCITY_STD_MPS = 0.3
"""Standard deviation of a constant error of Doppler velocities: those of receivers are 0.05 to
0.2 m/s."""
ACCELERATION_MPS2 = 10.0
"""Largest acceleration of an aircraft, where the receiver reports no velocity."""


@dataclass(frozen=True, eq=False)
class _Point:
    """A good sample.

    `en_m` (2,): position. `integral_m` (2,): integral of the velocity since the first sample; NaN
    where a velocity is missing. `residual_m` (2,): position less that integral, or less what
    the positions before predict.
    """

    time_s: float
    en_m: Array
    integral_m: Array
    residual_m: Array
    vel_en_mps: Array | None


class Receiver:
    """Checks of one receiver. Mutable; deterministic."""

    def __init__(self) -> None:
        self._points: list[_Point] = []
        self._heard_ns: int | None = None
        self._usable = True
        self._latlon_deg = (math.nan, math.nan)
        self._moved_ns = self._stamped_ns = 0
        self._stamp_ns: int | None = None

    def add(self, sample: GnssSample, en_m: Array) -> bool:
        """Add a sample at `en_m` (2,); whether it has a usable new position."""
        self._heard_ns = sample.arrived_ns
        latlon = sample.lat_deg, sample.lon_deg
        if latlon != self._latlon_deg:
            self._latlon_deg, self._moved_ns = latlon, sample.arrived_ns
        if sample.stamp_ns is None or sample.stamp_ns != self._stamp_ns:
            self._stamp_ns, self._stamped_ns = sample.stamp_ns, sample.arrived_ns
        accurate = not sample.std_m > LOST_STD_M
        self._usable = sample.has_fix and accurate and bool(np.isfinite(en_m).all())
        time_s = sample.time_ns * NANOSECONDS
        points = self._points
        if self._usable and points and -GAP_S < time_s - points[-1].time_s <= 0:
            return False  # a repeated solution
        if not self._usable or (points and not 0 < time_s - points[-1].time_s <= GAP_S):
            points.clear()
        if self._usable:
            points.append(self._point(time_s, en_m, sample.vel_en_mps))
            if points[0].time_s < time_s - 2 * VELOCITY_S:  # rarely: deleting moves the list
                del points[: bisect_left(points, time_s - VELOCITY_S - GAP_S, key=_time_s)]
        return self._usable

    def fault(self, now_ns: int, speed_mps: float) -> Fault | None:
        """The worst fault at `now_ns`; `speed_mps` is that of the map's track, NaN where unknown.

        None before the first message: a receiver that was never heard is not watched.
        """
        if self._heard_ns is None:
            return None
        if not self._usable or (now_ns - self._heard_ns) * NANOSECONDS > SILENCE_S:
            return Fault.LOST
        if (self._heard_ns - self._stamped_ns) * NANOSECONDS >= STILL_S:
            return Fault.FROZEN
        own = self._points[-1].vel_en_mps if self._points else None
        speed_mps = np.fmax(speed_mps, math.nan if own is None else float(np.hypot(*own)))
        still_s = (self._heard_ns - self._moved_ns) * NANOSECONDS
        if still_s >= STILL_S and speed_mps > MOVING_MPS:
            return Fault.FROZEN
        return Fault.JUMP if self._has_jumped() else None

    def residual_over(self, span_s: float) -> float:
        """Distance by which positions left the integrated velocity within `span_s`; NaN unknown."""
        points = self._points
        if not points or points[0].time_s > points[-1].time_s - span_s:
            return math.nan
        last = points[-1]
        first = points[bisect_left(points, last.time_s - span_s, key=_time_s)]
        return float(np.hypot(*(last.en_m - first.en_m - last.integral_m + first.integral_m)))

    def _point(self, time_s: float, en_m: Array, velocity: tuple[float, float] | None) -> _Point:
        vel = None if velocity is None else np.array(velocity)
        if not self._points:
            return _Point(time_s, en_m, np.zeros(2), np.zeros(2), vel)
        before = self._points[-1]
        seconds = time_s - before.time_s
        moved = np.full(2, math.nan)
        if vel is not None and before.vel_en_mps is not None:
            moved = (vel + before.vel_en_mps) / 2 * seconds
        expected = moved
        if not np.isfinite(moved).all():  # that of the positions before
            expected = en_m - before.en_m
            if len(self._points) > 1:
                earlier = self._points[-2]
                speed = (before.en_m - earlier.en_m) / (before.time_s - earlier.time_s)
                expected = speed * seconds
        off = en_m - before.en_m - expected
        return _Point(time_s, en_m, before.integral_m + moved, before.residual_m + off, vel)

    def _has_jumped(self) -> bool:
        points = self._points
        if len(points) < 2:
            return False
        last = points[-1]
        if last.vel_en_mps is None:
            seconds = last.time_s - points[-2].time_s
            off_m = float(np.hypot(*(last.residual_m - points[-2].residual_m)))
            return off_m > JUMP_M + ACCELERATION_MPS2 * seconds**2
        first = points[bisect_left(points, last.time_s - JUMP_S, key=_time_s)]
        return float(np.hypot(*(last.residual_m - first.residual_m))) > JUMP_M


def _time_s(point: _Point) -> float:
    return point.time_s
