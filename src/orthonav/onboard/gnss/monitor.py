"""The state of one GNSS receiver, by itself and against the map: waiting, good, alarm, returning.

By itself a receiver is lost, frozen, jumping, or its velocity contradicts its positions.
Deterministic: it is fed with values and times, and reads no clock.
"""

import math
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from orthonav.core.flight.gnss import FAULTS, RETURNING, Fault, GnssSample
from orthonav.core.geo.frames import LocalFrame
from orthonav.onboard.gnss.biases import (
    FAULT_SIGMAS,
    GNSS_STD_M,
    GNSS_TAU_S,
    LARGEST_M,
    MULTIPATH_M,
    Array,
    Biases,
    BiasLearner,
    Difference,
    DifferenceWindow,
    Finding,
    rolling_std_m,
    unknown,
    widen_last,
)

DIFFERENTIAL = 4
"""GPS_FIX_TYPE from which on corrections are used."""


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
    difference_en_m: tuple[float, float] = (math.nan, math.nan)
    """Recent GNSS minus map, by which a switch from the map to GNSS would jump."""
    fault_en_m: tuple[float, float] = (math.nan, math.nan)
    """Estimated change of the difference by the fault."""

    @property
    def reason(self) -> str | None:
        if self.state is GnssState.RETURNING:
            return RETURNING
        return self.fault.value if self.state is GnssState.ALARM and self.fault else None

    @property
    def code(self) -> int:
        """Number of the reason in `FAULTS`, from 1; 0 without one."""
        return 0 if self.reason is None else FAULTS.index(self.reason) + 1


@dataclass(frozen=True)
class ReceiverLimits:
    """From where on a receiver has a fault by itself."""

    lost_std_m: float = 50.0
    """Stated standard deviation from which a position counts as none."""
    silence_s: float = 3.0
    """Time without a message after which a receiver counts as lost; streams are 1 to 10 Hz."""
    still_s: float = 3.0
    """Time with an equal position or timestamp after which a receiver counts as frozen,"""
    moving_mps: float = 3.0  # with an equal position only from this speed on
    gap_s: float = 2.0  # samples farther apart are not compared with each other
    jump_m: float = 15.0
    """Positions that leave the integrated velocity by more than this have jumped: multipath makes
    steps of up to 10 m;"""
    jump_s: float = 3.0  # within this time
    acceleration_mps2: float = 10.0
    """Largest of an aircraft, where the receiver reports no velocity."""
    velocity_s: float = 20.0  # span over which velocity and positions are compared
    velocity_std_mps: float = 0.3
    """Of a constant error of Doppler velocities: those of receivers are 0.05 to 0.2 m/s."""


RECEIVER = ReceiverLimits()


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
        accurate = not sample.std_m > RECEIVER.lost_std_m
        self._usable = sample.has_fix and accurate and bool(np.isfinite(en_m).all())
        time_s = sample.time_ns / 1e9
        points = self._points
        if self._usable and points and -RECEIVER.gap_s < time_s - points[-1].time_s <= 0:
            return False  # a repeated solution
        if not self._usable or (points and not 0 < time_s - points[-1].time_s <= RECEIVER.gap_s):
            points.clear()
        if self._usable:
            velocity = np.array(sample.vel_en_mps or (math.nan, math.nan))
            points.append(self._point(time_s, en_m, velocity))
            span_s = RECEIVER.velocity_s
            if points[0].time_s < time_s - 2 * span_s:  # rarely: deleting moves the list
                del points[: bisect_left(points, time_s - span_s - RECEIVER.gap_s, key=_time_s)]
        return self._usable

    def fault(self, now_ns: int, speed_mps: float) -> Fault | None:
        """The worst fault at `now_ns`; `speed_mps` is that of the map's track, NaN where unknown.

        None before the first message: a receiver that was never heard is not watched.
        """
        if self._heard_ns is None:
            return None
        if not self._usable or (now_ns - self._heard_ns) / 1e9 > RECEIVER.silence_s:
            return Fault.LOST
        if (self._heard_ns - self._stamped_ns) / 1e9 >= RECEIVER.still_s:
            return Fault.FROZEN
        own_mps = float(np.hypot(*self._points[-1].vel_en_mps)) if self._points else math.nan
        speed_mps = np.fmax(speed_mps, own_mps)
        still_s = (self._heard_ns - self._moved_ns) / 1e9
        if still_s >= RECEIVER.still_s and speed_mps > RECEIVER.moving_mps:
            return Fault.FROZEN
        return Fault.JUMP if self._has_jumped() else None

    def left_m(self, span_s: float) -> float:
        """Distance by which positions left the integrated velocity within `span_s`, at the most;
        NaN where a velocity is missing."""
        begin_s = self._points[-1].time_s - span_s
        points = self._points[bisect_left(self._points, begin_s, key=_time_s) :]
        times_s, places_m, velocities, _ = map(np.array, zip(*points, strict=True))
        steps_m = (velocities[1:] + velocities[:-1]) / 2 * np.diff(times_s)[:, None]
        return float(np.hypot(*(places_m[-1] - places_m[0] - steps_m.sum(axis=0))))

    def is_known_for(self, span_s: float) -> bool:
        points = self._points
        return bool(points) and points[0].time_s <= points[-1].time_s - span_s

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
        last = points[-1]
        first, allowed_m = points[-2], RECEIVER.jump_m
        if np.isfinite(last.vel_en_mps).all():
            first = points[bisect_left(points, last.time_s - RECEIVER.jump_s, key=_time_s)]
        else:
            allowed_m += RECEIVER.acceleration_mps2 * (last.time_s - first.time_s) ** 2
        return float(np.hypot(*(last.residual_m - first.residual_m))) > allowed_m


def _time_s(point: _Point) -> float:
    return point.time_s


@dataclass(frozen=True)
class AgreementLimits:
    """When GNSS and map agree, and when a change is attributed to the map."""

    return_s: float = 60.0  # time of agreement after which a return is announced
    clear_s: float = 2.0  # time without a fault of the receiver after which its alarm ends
    recent_s: float = 10.0
    """Differences of this time are averaged for what is reported and for agreement."""
    sigmas: float = 2.0  # GNSS agrees within this many standard deviations,
    min_m: float = 10.0  # and always within this distance
    before_s: float = 5.0
    """Values so long before the onset of a fault show what GNSS has to agree with after it."""
    map_jump_m: float = 15.0
    """The map jumped where its position leaves the track's velocity by more than this distance"""
    map_jump_sigmas: float = 3.0  # and this many standard deviations together
    map_jump_s: float = 60.0
    """A change so soon after a jump of the map is not attributed to GNSS."""


AGREEMENT = AgreementLimits()
_LEFT = {
    Fault.JUMP: Fault.STEP,
    Fault.LOST: Fault.OFFSET,
    Fault.FROZEN: Fault.OFFSET,
    Fault.VELOCITY: Fault.OFFSET,
}
"""Name of a difference that is left where a fault of the receiver itself has ended."""


class GnssMonitor:
    def __init__(
        self, frame: LocalFrame, start: Biases | None = None, reference: Biases | None = None
    ) -> None:
        """`frame`: plane of the map. `start`, `reference`: see `BiasLearner`."""
        self._frame = frame
        self._receiver, self._window = Receiver(), DifferenceWindow()
        self._learner = BiasLearner(start or unknown(), reference)
        self._judged: deque[Difference] = deque(maxlen=3)
        self._pending: deque[MapPosition] = deque(maxlen=100)
        self._solved: deque[tuple[GnssSample, Array]] = deque(maxlen=30)  # 3 s at 10 Hz
        self._bin: list[Difference] = []
        self._map: MapPosition | None = None
        self._held: MapPosition | None = None
        self._map_jump_ns: int | None = None
        self._anchor = self._learner.learnt
        self._agreed_s, self._newest_s = 0.0, -math.inf
        self._fault_ns = self._velocity_ns = -(10**12)
        self.status = GnssStatus()

    @property
    def learnt(self) -> Biases:
        return self._learner.learnt

    @property
    def undisturbed(self) -> Biases:
        """Estimate that no fault has touched: during one, from all values before it; else from
        those whose quarantine has ended."""
        faulty = self.status.state in (GnssState.ALARM, GnssState.RETURNING)
        return self._anchor if faulty else self._learner.learnt

    @property
    def reference(self) -> Biases:
        return self._learner.reference

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
            fault = self._velocity_fault()
        if fault is not None:
            self._fault_ns = now_ns
            self._alarm(fault, now_ns, None)
        return self.status

    def _pair(self, now_ns: int) -> None:
        while self._solved and self._pending:
            position = self._pending[0]
            if position.time_ns > self._solved[-1][0].time_ns:
                return
            self._pending.popleft()
            after = bisect_left(self._solved, position.time_ns, key=lambda each: each[0].time_ns)
            sample, en_m = self._solved[after]
            if after == 0 and sample.time_ns > position.time_ns:
                continue
            earlier, earlier_m = self._solved[max(after - 1, 0)]
            interval_ns = sample.time_ns - earlier.time_ns
            if interval_ns / 1e9 > RECEIVER.gap_s:
                continue
            ahead_ns = position.time_ns - earlier.time_ns
            weight = ahead_ns / interval_ns if interval_ns else 1.0
            at_exposure = (1 - weight) * earlier_m + weight * en_m
            self._add(position, at_exposure - position.en_m, sample, now_ns)

    def _add(self, position: MapPosition, off_en_m: Array, sample: GnssSample, now_ns: int) -> None:
        velocity = position.vel_en_mps
        if velocity is None:
            velocity = np.array(sample.vel_en_mps or (0.0, 0.0))
        # Corrections by SBAS or a reference station (GPS_FIX_TYPE) make 1 m.
        least_m = GNSS_STD_M if sample.fix_type < DIFFERENTIAL else 1.0
        std_m = max(sample.std_m, least_m) if math.isfinite(sample.std_m) else GNSS_STD_M
        time_s = position.time_ns / 1e9
        flown = math.radians(position.heading_deg), velocity, position.agl_m
        made = Difference(time_s, off_en_m, std_m, position.std_m, *flown)
        if self._bin and math.floor(self._bin[0].time_s) != math.floor(time_s):
            value, self._bin = _median(self._bin), []
            self._judge(value, now_ns)
        self._bin.append(made)

    def _judge(self, value: Difference, now_ns: int) -> None:
        if value.time_s <= self._newest_s:
            self._window.values.clear()  # the clock went back
            self._learner.waiting.clear()
        self._newest_s = value.time_s
        self._judged.append(value)
        rolling_m = rolling_std_m(self._judged, self._learner.learnt)
        if rolling_m:  # headings show it a second later than the bank
            value = replace(value, rolling_std_m=rolling_m)
            widen_last(self._window.values, rolling_m)
            widen_last(self._learner.waiting, rolling_m)
        self._window.add(value)
        recent = self._window.recent(AGREEMENT.recent_s)
        east, north = np.mean([each.en_m for each in recent], axis=0).tolist()
        self.status = replace(self.status, difference_en_m=(east, north))
        if (now_ns - self._fault_ns) / 1e9 < AGREEMENT.clear_s:
            return  # the receiver has a fault by itself
        if self.status.state in (GnssState.WAITING, GnssState.GOOD):
            found = (
                self._window.finding(self._learner.learnt)
                or self._too_far(recent, value)
                or self._crept(value)
            )
            if found is not None:
                self._alarm(self._attributed(found, now_ns), now_ns, found)
                return
        if self.status.state in (GnssState.WAITING, GnssState.GOOD):
            self._learner.add(value)
        self._count_agreement(recent, value, now_ns)

    def _count_agreement(self, recent: list[Difference], value: Difference, now_ns: int) -> None:
        anchor = self._learner.learnt if self.status.state is GnssState.GOOD else self._anchor
        limit_m = max(AGREEMENT.min_m, AGREEMENT.sigmas * self._std_m(value, anchor))
        if self.status.state is GnssState.WAITING and anchor.agreed_s == 0:
            limit_m = max(limit_m, LARGEST_M)  # nothing is known of the map
        if float(np.hypot(*_residual(recent, anchor))) > limit_m:
            self._agreed_s = 0.0
            if self.status.state is GnssState.WAITING:
                self._learner.waiting.clear()
            if self.status.state in (GnssState.ALARM, GnssState.RETURNING):
                fault = self.status.fault
                named = fault if fault is None else _LEFT.get(fault, fault)
                self.status = replace(self.status, fault=named)
                self._enter(GnssState.ALARM, now_ns)
            return
        self._agreed_s += 1.0
        if self.status.state is GnssState.ALARM and self._agreed_s >= AGREEMENT.recent_s:
            self._enter(GnssState.RETURNING, now_ns)
        if self.status.state is not GnssState.GOOD and self._agreed_s >= AGREEMENT.return_s:
            self._enter(GnssState.GOOD, now_ns)
            self.status = replace(self.status, fault=None, fault_en_m=(math.nan, math.nan))

    def _alarm(self, fault: Fault, now_ns: int, found: Finding | None) -> None:
        """Raise an alarm: learning stops, and what waits to be learnt is discarded."""
        if self.status.state in (GnssState.WAITING, GnssState.GOOD):
            begin_s = now_ns / 1e9 if found is None else found.onset_s
            if fault is Fault.OFFSET:
                self._learner.restore()
            is_old = found is not None and found.fault is Fault.OFFSET
            until_s = -math.inf if is_old else begin_s - AGREEMENT.before_s
            self._anchor = self._learner.until(until_s)
        if self.status.state is GnssState.ALARM and (
            self.status.fault is fault or (fault is Fault.JUMP and self.status.fault is Fault.STEP)
        ):
            return
        self._learner.waiting.clear()
        self._forget()
        size = (math.nan, math.nan) if found is None else found.en_m
        self.status = replace(self.status, fault=fault, fault_en_m=size)
        self._enter(GnssState.ALARM, now_ns)

    def _enter(self, state: GnssState, now_ns: int) -> None:
        if state is GnssState.ALARM:
            self._agreed_s = 0.0
        if state is not self.status.state:
            self.status = replace(self.status, state=state, since_ns=now_ns)

    def _forget(self) -> None:
        self._window.values.clear()
        self._bin = []

    def _attributed(self, found: Finding, now_ns: int) -> Fault:
        jumped = self._map_jump_ns
        if jumped is not None and (now_ns - jumped) / 1e9 <= AGREEMENT.map_jump_s:
            return Fault.DISAGREES
        return found.fault

    def _too_far(self, recent: list[Difference], value: Difference) -> Finding | None:
        others = self._learner.learnt.without_displacement()
        east, north = _residual(recent, others).tolist()
        off_m, std_m = math.hypot(east, north), self._std_m(value, others)
        if len(recent) < AGREEMENT.recent_s / 2 or off_m < LARGEST_M + AGREEMENT.sigmas * std_m:
            return None
        begin_s = self._window.values[0].time_s
        return Finding(Fault.OFFSET, begin_s, (east, north))

    def _crept(self, value: Difference) -> Finding | None:
        """A drag-off that was slow enough to be learnt: the biases left their reference."""
        reference = self._learner.reference
        moved = value.design @ (self._learner.learnt.mean - reference.mean)
        east, north = moved.tolist()
        std_m = math.sqrt(reference.variance_m2(value.design))
        if math.hypot(east, north) <= MULTIPATH_M + FAULT_SIGMAS * std_m:
            return None
        return Finding(Fault.OFFSET, self._window.values[0].time_s, (east, north))

    def _std_m(self, value: Difference, known: Biases) -> float:
        """Standard deviation of a difference from the known biases, along the worst axis."""
        gnss_m = max(value.gnss_std_m, GNSS_STD_M)
        return math.sqrt(known.variance_m2(value.design) + gnss_m**2 + value.map_std_m**2)

    def _velocity_fault(self) -> Fault | None:
        gnss_m2 = 2 * GNSS_STD_M**2 * (1 - math.exp(-RECEIVER.velocity_s / GNSS_TAU_S))
        drift_m2 = (RECEIVER.velocity_std_mps * RECEIVER.velocity_s) ** 2
        if not self._receiver.is_known_for(RECEIVER.velocity_s):
            return None
        own_m = self._receiver.left_m(RECEIVER.velocity_s)
        if own_m > MULTIPATH_M + FAULT_SIGMAS * math.sqrt(gnss_m2 + drift_m2):
            return Fault.VELOCITY
        return None

    def _speed_mps(self, now_ns: int) -> float:
        """Speed by the map's track; NaN where it is not known or too old."""
        last = self._map
        if last is None or last.vel_en_mps is None:
            return math.nan
        if (now_ns - last.time_ns) / 1e9 > RECEIVER.gap_s:
            return math.nan
        return float(np.hypot(*last.vel_en_mps))


def _jumped(before: MapPosition, now: MapPosition) -> bool:
    seconds = (now.time_ns - before.time_ns) / 1e9
    velocities = [v for v in (before.vel_en_mps, now.vel_en_mps) if v is not None]
    if not 0 < seconds <= RECEIVER.gap_s or not velocities:
        return False
    moved = np.mean(velocities, axis=0) * seconds
    off_m = float(np.hypot(*(now.en_m - before.en_m - moved)))
    std_m = max(before.std_m, now.std_m)
    return off_m > AGREEMENT.map_jump_m + AGREEMENT.map_jump_sigmas * std_m


def _residual(values: list[Difference], known: Biases) -> Array:
    return np.asarray(np.mean([each.residual(known) for each in values], axis=0))


def _median(values: list[Difference]) -> Difference:
    """Median of the differences, other fields as in the middle."""
    middle = values[len(values) // 2]
    return replace(middle, en_m=np.median([each.en_m for each in values], axis=0))
