"""The state of one GNSS receiver, by itself and against the map: waiting, good, alarm, returning.

By itself a receiver is lost, frozen, jumping, or its velocity contradicts its positions.
Deterministic: it is fed with values and times, and reads no clock.
"""

import math
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, replace
from enum import Enum
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from orthonav.core.flight.gnss import RETURNING, Fault, GnssSample
from orthonav.core.geo.frames import LocalFrame
from orthonav.onboard.gnss.biases import (
    FAULT_SIGMAS,
    GNSS_STD_M,
    GNSS_TAU_S,
    LARGEST_M,
    MULTIPATH_M,
    WINDOW_S,
    Array,
    Biases,
    BiasLearner,
    Difference,
    Finding,
    finding,
    rolling_std_m,
    unknown,
)

DIFFERENTIAL = 4
"""GPS_FIX_TYPE from which on corrections are used."""
_UNKNOWN_M = (math.nan, math.nan)


class GnssState(Enum):
    WAITING = "waiting"  # since the start: no fault, but no agreement with the map yet
    GOOD = "good"  # GNSS and map agree; the biases of their difference are learnt
    ALARM = "alarm"  # a fault
    RETURNING = "returning"  # no fault is seen any more; not yet in agreement for long enough


@dataclass(frozen=True, eq=False)
class MapPosition:
    """A confident position by the map."""

    time_ns: int  # exposure, by the clock of the samples
    en_m: Array  # (2,): in the plane of the map, uncorrected
    std_m: float  # along the worst axis
    vel_en_mps: Array | None = None  # (2,): of the track; None where not known
    heading_deg: float = 0.0  # of the top of the image; errors of a tilted mount turn with it
    agl_m: float = 0.0  # above ground, and these errors grow with it; 0 where not known


@dataclass(frozen=True)
class GnssStatus:
    """Status of one receiver."""

    state: GnssState = GnssState.WAITING
    fault: Fault | None = None  # of the alarm, also while returning
    since_ns: int = 0  # time at which the state began
    difference_en_m: tuple[float, float] = _UNKNOWN_M
    """Recent GNSS minus map, by which a switch from the map to GNSS would jump."""
    fault_en_m: tuple[float, float] = _UNKNOWN_M
    """Estimated change of the difference by the fault."""

    @property
    def reason(self) -> str | None:
        if self.state is GnssState.RETURNING:
            return RETURNING
        return None if self.fault is None else self.fault.value


@dataclass(frozen=True)
class MonitorLimits:
    """From where on a receiver has a fault by itself, when GNSS and map agree, and when a change is
    attributed to the map."""

    lost_std_m: float = 50.0
    """Stated standard deviation from which a position counts as none."""
    silence_s: float = 3.0
    """Time without a message after which a receiver counts as lost; streams are 1 to 10 Hz."""
    still_s: float = 3.0
    """Time with an equal position or timestamp after which a receiver counts as frozen,"""
    moving_mps: float = 3.0  # with an equal position only from this speed on
    gap_s: float = 2.0  # samples farther apart are not compared with each other
    jump_m: float = 15.0
    """Positions that leave the integrated velocity by more than this have jumped, those of the map
    by more than this and so many standard deviations: multipath makes steps of up to 10 m;"""
    map_jump_sigmas: float = 3.0
    jump_s: float = 3.0  # those of a receiver within this time
    acceleration_mps2: float = 10.0
    """Largest of an aircraft, where the receiver reports no velocity."""
    velocity_s: float = 20.0  # span over which velocity and positions are compared
    velocity_std_mps: float = 0.3
    """Of a constant error of Doppler velocities: those of receivers are 0.05 to 0.2 m/s."""
    return_s: float = 60.0  # time of agreement after which a return is announced
    clear_s: float = 2.0  # time without a fault of the receiver after which its alarm ends
    recent_s: float = 10.0
    """Differences of this time are averaged for what is reported and for agreement."""
    sigmas: float = 2.0  # GNSS agrees within this many standard deviations,
    min_m: float = 10.0  # and always within this distance
    before_s: float = 5.0
    """Values so long before the onset of a fault show what GNSS has to agree with after it."""
    map_jump_s: float = 60.0
    """A change so soon after a jump of the map is not attributed to GNSS."""


MONITOR = MonitorLimits()


class _Point(NamedTuple):
    """A good sample: position (2,) and velocity (2,), NaN where not known.

    `residual_m` (2,): sum of the distances by which positions left what the velocity predicts, or
    where one is missing, the positions before.
    """

    time_s: float
    en_m: Array
    vel_en_mps: Array
    residual_m: Array


class Receiver:
    """The samples of one receiver, which are compared with each other. Mutable."""

    def __init__(self) -> None:
        self._points: list[_Point] = []
        self._last: GnssSample | None = None
        self._usable = True
        self._moved_ns = self._stamped_ns = 0

    def add(self, sample: GnssSample, en_m: Array) -> bool:
        """Add a sample at `en_m` (2,); whether it has a usable new position."""
        before, self._last = self._last, sample
        latlon = sample.lat_deg, sample.lon_deg
        if before is None or latlon != (before.lat_deg, before.lon_deg):
            self._moved_ns = sample.arrived_ns
        if before is None or sample.stamp_ns is None or sample.stamp_ns != before.stamp_ns:
            self._stamped_ns = sample.arrived_ns
        accurate = not sample.std_m > MONITOR.lost_std_m
        self._usable = sample.has_fix and accurate and bool(np.isfinite(en_m).all())
        time_s, points = sample.time_ns / 1e9, self._points
        elapsed_s = time_s - points[-1].time_s if points else math.inf
        if self._usable and -MONITOR.gap_s < elapsed_s <= 0:
            return False  # a repeated solution
        if not self._usable or not 0 < elapsed_s <= MONITOR.gap_s:
            points.clear()
        if self._usable:
            velocity = np.array(sample.vel_en_mps or (math.nan, math.nan))
            points.append(self._point(time_s, en_m, velocity))
            if points[0].time_s < time_s - 2 * MONITOR.velocity_s:  # rarely: it moves the list
                del points[: self._since(MONITOR.velocity_s + MONITOR.gap_s)]
        return self._usable

    def fault(self, now_ns: int, speed_mps: float) -> Fault | None:
        """The worst fault at `now_ns`; `speed_mps` is that of the map's track, NaN where unknown.

        None before the first message: a receiver that was never heard is not watched.
        """
        if self._last is None:
            return None
        heard_ns = self._last.arrived_ns
        if not self._usable or (now_ns - heard_ns) / 1e9 > MONITOR.silence_s:
            return Fault.LOST
        still_ns = MONITOR.still_s * 1e9
        speed_mps = np.fmax(speed_mps, np.hypot(*self._points[-1].vel_en_mps))
        is_moving = speed_mps > MONITOR.moving_mps
        if heard_ns - self._stamped_ns >= still_ns or (
            is_moving and heard_ns - self._moved_ns >= still_ns
        ):
            return Fault.FROZEN
        return Fault.JUMP if self._has_jumped() else None

    def left_m(self, span_s: float) -> float:
        """Distance by which positions left the integrated velocity within `span_s`; NaN where a
        velocity or the beginning of that time is missing."""
        points = self._points
        if not points or points[0].time_s > points[-1].time_s - span_s:
            return math.nan
        begin = self._since(span_s)
        known = np.isfinite([each.vel_en_mps for each in points[begin:]]).all()
        return self._residual_m(begin) if known else math.nan

    def _since(self, span_s: float) -> int:
        """Index of the first sample of the last seconds."""
        return bisect_left(self._points, self._points[-1].time_s - span_s, key=_TIME_S)

    def _residual_m(self, begin: int) -> float:
        return float(np.hypot(*(self._points[-1].residual_m - self._points[begin].residual_m)))

    def _point(self, time_s: float, en_m: Array, velocity: Array) -> _Point:
        if not self._points:
            return _Point(time_s, en_m, velocity, np.zeros(2))
        before = self._points[-1]
        seconds, moved_m = time_s - before.time_s, en_m - before.en_m
        expected_m = (velocity + before.vel_en_mps) / 2 * seconds
        if not np.isfinite(expected_m).all():  # that of the positions before
            expected_m = moved_m
            if len(self._points) > 1:
                earlier = self._points[-2]
                speed = (before.en_m - earlier.en_m) / (before.time_s - earlier.time_s)
                expected_m = speed * seconds
        return _Point(time_s, en_m, velocity, before.residual_m + moved_m - expected_m)

    def _has_jumped(self) -> bool:
        points = self._points
        if len(points) < 2:
            return False
        if np.isfinite(points[-1].vel_en_mps).all():
            return self._residual_m(self._since(MONITOR.jump_s)) > MONITOR.jump_m
        free_m = MONITOR.acceleration_mps2 * (points[-1].time_s - points[-2].time_s) ** 2
        return self._residual_m(-2) > MONITOR.jump_m + free_m


_TIME_S = attrgetter("time_s")


_LEFT = {Fault.JUMP: Fault.STEP} | dict.fromkeys(
    (Fault.LOST, Fault.FROZEN, Fault.VELOCITY), Fault.OFFSET
)
"""Name of a difference that is left where a fault of the receiver itself has ended."""


class GnssMonitor:
    """The receiver, its difference from the map, and what is learnt of it. Mutable."""

    def __init__(
        self, frame: LocalFrame, start: Biases | None = None, reference: Biases | None = None
    ) -> None:
        """`frame`: plane of the map. `start`, `reference`: see `BiasLearner`."""
        self._frame = frame
        self._receiver = Receiver()
        self._window: deque[Difference] = deque()
        self._learner = BiasLearner(start or unknown(), reference)
        self._judged: deque[Difference] = deque(maxlen=3)
        self._pending: deque[MapPosition] = deque(maxlen=100)
        self._solved: deque[tuple[GnssSample, Array]] = deque(maxlen=30)  # 3 s at 10 Hz
        self._bin: list[Difference] = []
        self._map: MapPosition | None = None
        self._held: MapPosition | None = None
        self._anchor = self._learner.learnt
        self._agreed_s, self._newest_s = 0.0, -math.inf
        self._fault_ns = self._velocity_ns = self._map_jump_ns = -(10**12)
        self.status = GnssStatus()

    @property
    def learnt(self) -> Biases:
        return self._learner.learnt

    @property
    def undisturbed(self) -> Biases:
        """Estimate that no fault has touched: during one, from all values before it; else from
        those whose quarantine has ended."""
        return self._anchor if self._is_faulty else self._learner.learnt

    @property
    def reference(self) -> Biases:
        return self._learner.reference

    @property
    def _is_faulty(self) -> bool:
        return self.status.state in (GnssState.ALARM, GnssState.RETURNING)

    def sample(self, sample: GnssSample) -> None:
        en_m = np.full(2, math.nan)
        if sample.is_valid:
            en_m = np.asarray(self._frame.en_from_latlon(sample.lat_deg, sample.lon_deg))
        if self._receiver.add(sample, en_m):
            if self._solved and sample.time_ns <= self._solved[-1][0].time_ns:
                self._solved.clear()  # the clock went back
            self._solved.append((sample, en_m))
            self._pair(sample.arrived_ns)
        self.tick(sample.arrived_ns)

    def position(self, position: MapPosition) -> None:
        """Add a confident position by the map. Outliers are dropped, jumps are noted."""
        before = self._map
        if before is not None and _jumped(before, position):
            if self._held is None or _jumped(self._held, position):
                self._held = position
                return
            self._map_jump_ns = position.time_ns  # two positions agree on the new place
            self._forget()
        self._held, self._map = None, position
        self._pending.append(position)
        self._pair(position.time_ns)

    def tick(self, now_ns: int) -> GnssStatus:
        fault = self._receiver.fault(now_ns, self._speed_mps(now_ns))
        named = self.status.fault in (None, Fault.VELOCITY)  # a jump contradicts the velocity too
        if fault is None and named and (now_ns - self._velocity_ns) / 1e9 >= 1.0:
            self._velocity_ns = now_ns
            gnss_m2 = 2 * GNSS_STD_M**2 * (1 - math.exp(-MONITOR.velocity_s / GNSS_TAU_S))
            drift_m = MONITOR.velocity_std_mps * MONITOR.velocity_s
            allowed_m = MULTIPATH_M + FAULT_SIGMAS * math.hypot(math.sqrt(gnss_m2), drift_m)
            if self._receiver.left_m(MONITOR.velocity_s) > allowed_m:
                fault = Fault.VELOCITY
        if fault is not None:
            self._fault_ns = now_ns
            self._alarm(fault, Finding(fault, now_ns / 1e9, _UNKNOWN_M), now_ns)
        return self.status

    def _pair(self, now_ns: int) -> None:
        """Compare each waiting position with those of GNSS before and after it."""
        pending, solved = self._pending, self._solved
        while pending and solved and pending[0].time_ns <= solved[-1][0].time_ns:
            position = pending.popleft()
            after = bisect_left(solved, position.time_ns, key=lambda each: each[0].time_ns)
            (earlier, earlier_m), (sample, en_m) = solved[max(after - 1, 0)], solved[after]
            ahead_ns = position.time_ns - earlier.time_ns
            interval_ns = sample.time_ns - earlier.time_ns
            if ahead_ns < 0 or interval_ns / 1e9 > MONITOR.gap_s:
                continue
            weight = ahead_ns / interval_ns if interval_ns else 1.0
            at_exposure = (1 - weight) * earlier_m + weight * en_m
            self._add(position, at_exposure - position.en_m, sample, now_ns)

    def _add(self, position: MapPosition, off_en_m: Array, sample: GnssSample, now_ns: int) -> None:
        """Add a difference; the median of those of a second is judged."""
        velocity = position.vel_en_mps
        if velocity is None:
            velocity = np.array(sample.vel_en_mps or (0.0, 0.0))
        # Corrections by SBAS or a reference station (GPS_FIX_TYPE) make 1 m.
        least_m = GNSS_STD_M if sample.fix_type < DIFFERENTIAL else 1.0
        std_m = max(sample.std_m, least_m) if math.isfinite(sample.std_m) else GNSS_STD_M
        time_s = position.time_ns / 1e9
        if self._bin and math.floor(self._bin[0].time_s) != math.floor(time_s):
            second, self._bin = self._bin, []
            median = np.median([each.en_m for each in second], axis=0)
            self._judge(replace(second[len(second) // 2], en_m=median), now_ns)
        flown = math.radians(position.heading_deg), velocity, position.agl_m
        self._bin.append(Difference(time_s, off_en_m, std_m, position.std_m, *flown))

    def _judge(self, value: Difference, now_ns: int) -> None:
        """Test and learn the difference of a second."""
        window, learner = self._window, self._learner
        if value.time_s <= self._newest_s:
            window.clear()  # the clock went back
            learner.waiting.clear()
        self._newest_s = value.time_s
        self._judged.append(value)
        rolling_m = rolling_std_m(self._judged, learner.learnt)
        if rolling_m:  # headings show it a second later than the bank
            value = value.widened(rolling_m)
            for values in (window, learner.waiting):
                if values:
                    values[-1] = values[-1].widened(rolling_m)
        window.append(value)
        while window[0].time_s < value.time_s - WINDOW_S:
            window.popleft()
        recent = [each for each in window if each.time_s > value.time_s - MONITOR.recent_s]
        east, north = np.mean([each.en_m for each in recent], axis=0).tolist()
        self.status = replace(self.status, difference_en_m=(east, north))
        if (now_ns - self._fault_ns) / 1e9 < MONITOR.clear_s:
            return  # the receiver has a fault by itself
        if not self._is_faulty:
            found = finding(window, learner.learnt) or self._offset(recent, value)
            if found is not None:
                is_ours = (now_ns - self._map_jump_ns) / 1e9 <= MONITOR.map_jump_s
                self._alarm(Fault.DISAGREES if is_ours else found.fault, found, now_ns)
                return
            learner.add(value)
        self._count_agreement(recent, value, now_ns)

    def _count_agreement(self, recent: list[Difference], value: Difference, now_ns: int) -> None:
        state, fault = self.status.state, self.status.fault
        anchor = self._learner.learnt if state is GnssState.GOOD else self._anchor
        limit_m = max(MONITOR.min_m, MONITOR.sigmas * value.std_m(anchor))
        if state is GnssState.WAITING and anchor.agreed_s == 0:
            limit_m = max(limit_m, LARGEST_M)  # nothing is known of the map
        if float(np.hypot(*_residual(recent, anchor))) > limit_m:
            self._agreed_s = 0.0
            if state is GnssState.WAITING:
                self._learner.waiting.clear()
            if self._is_faulty:
                named = None if fault is None else _LEFT.get(fault, fault)
                self._enter(GnssState.ALARM, now_ns, fault=named)
            return
        self._agreed_s += 1.0
        if state is GnssState.ALARM and self._agreed_s >= MONITOR.recent_s:
            self._enter(GnssState.RETURNING, now_ns)
        if state is not GnssState.GOOD and self._agreed_s >= MONITOR.return_s:
            self._enter(GnssState.GOOD, now_ns, fault=None, fault_en_m=_UNKNOWN_M)

    def _alarm(self, fault: Fault, found: Finding, now_ns: int) -> None:
        """Raise an alarm: learning stops, and what waits to be learnt is discarded."""
        if not self._is_faulty:
            if fault is Fault.OFFSET:
                self._learner.restore()
            is_old = found.fault is Fault.OFFSET
            until_s = -math.inf if is_old else found.onset_s - MONITOR.before_s
            self._anchor = self._learner.until(until_s)
        known = (fault, Fault.STEP) if fault is Fault.JUMP else (fault,)
        if self.status.state is GnssState.ALARM and self.status.fault in known:
            return
        self._learner.waiting.clear()
        self._forget()
        self._agreed_s = 0.0
        self._enter(GnssState.ALARM, now_ns, fault=fault, fault_en_m=found.en_m)

    def _enter(self, state: GnssState, now_ns: int, **changed: Any) -> None:
        since_ns = self.status.since_ns if state is self.status.state else now_ns
        self.status = replace(self.status, state=state, since_ns=since_ns, **changed)

    def _forget(self) -> None:
        self._window.clear()
        self._bin = []

    def _offset(self, recent: list[Difference], value: Difference) -> Finding | None:
        """A difference larger than the largest displacement of a map, or a drag-off that was slow
        enough to be learnt: the biases left their reference."""
        learnt, reference = self._learner.learnt, self._learner.reference
        others = learnt.without_displacement()
        far_m = LARGEST_M + MONITOR.sigmas * value.std_m(others)
        if len(recent) < MONITOR.recent_s / 2:
            far_m = math.inf
        crept = value.design @ (learnt.mean - reference.mean)
        crept_m = MULTIPATH_M + FAULT_SIGMAS * math.sqrt(reference.variance_m2(value.design))
        for off, most_m in ((_residual(recent, others), far_m), (crept, crept_m)):
            east, north = off.tolist()
            if not math.hypot(east, north) <= most_m:  # NaN too
                return Finding(Fault.OFFSET, self._window[0].time_s, (east, north))
        return None

    def _speed_mps(self, now_ns: int) -> float:
        """Speed by the map's track; NaN where it is not known or too old."""
        last = self._map
        if last is None or last.vel_en_mps is None or now_ns - last.time_ns > MONITOR.gap_s * 1e9:
            return math.nan
        return float(np.hypot(*last.vel_en_mps))


def _jumped(before: MapPosition, now: MapPosition) -> bool:
    seconds = (now.time_ns - before.time_ns) / 1e9
    velocities = [v for v in (before.vel_en_mps, now.vel_en_mps) if v is not None]
    if not 0 < seconds <= MONITOR.gap_s or not velocities:
        return False
    moved = np.mean(velocities, axis=0) * seconds
    off_m = float(np.hypot(*(now.en_m - before.en_m - moved)))
    std_m = max(before.std_m, now.std_m)
    return off_m > MONITOR.jump_m + MONITOR.map_jump_sigmas * std_m


def _residual(values: list[Difference], known: Biases) -> Array:
    return np.asarray(np.mean([each.residual(known) for each in values], axis=0))
