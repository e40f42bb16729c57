"""The state of one GNSS receiver against the map: waiting, good, alarm, returning.

Deterministic: it is fed with values and times, and reads no clock.
"""

import math
from bisect import bisect_left
from collections import deque
from dataclasses import replace

import numpy as np

from orthonav.flight.gnss import GnssSample
from orthonav.geo.frames import LocalFrame
from orthonav.onboard.gnss.difference import (
    BIN_S,
    Difference,
    DifferenceModel,
    DifferenceWindow,
    Finding,
)
from orthonav.onboard.gnss.displacement import LARGEST_M, UNKNOWN, DisplacementLearner
from orthonav.onboard.gnss.receiver import GAP_S, VELOCITY_S, VELOCITY_STD_MPS, Receiver
from orthonav.onboard.gnss.records import (
    NANOSECONDS,
    Array,
    Displacement,
    Fault,
    GnssStatus,
    MapPosition,
    State,
)

RETURN_S = 60.0
"""Time of agreement after which a return is announced."""
CLEAR_S = 2.0
"""Time without a fault of the receiver after which its alarm ends."""
RECENT_S = 10.0
"""Differences of this time are averaged for what is reported and for agreement."""
AGREE_SIGMAS, AGREE_M = 2.0, 10.0
"""GNSS agrees within this many standard deviations, at least this distance."""
MAP_JUMP_M, MAP_JUMP_SIGMAS = 15.0, 3.0
"""The map jumped where its position leaves the track's velocity by more than both together."""
MAP_JUMP_S = 60.0
"""A change so soon after a jump of the map is not attributed to GNSS."""
HISTORY_S, HISTORY = 5.0, 100
"""Interval and number of differences that are stored for the agreement after a fault."""
_LEFT = {
    Fault.JUMP: Fault.STEP,
    Fault.LOST: Fault.OFFSET,
    Fault.FROZEN: Fault.OFFSET,
    Fault.VELOCITY: Fault.OFFSET,
}
"""Name of a difference that is left where a fault of the receiver itself has ended."""
SOLVED = 30
"""Solutions that are stored for exposures before the newest: 3 s at 10 Hz."""
PENDING = 100
"""Most map positions that wait for the GNSS solution after them."""


class GnssMonitor:
    """Compares one receiver with the map. Mutable."""

    def __init__(
        self,
        frame: LocalFrame,
        start: Displacement = UNKNOWN,
        model: DifferenceModel | None = None,
    ) -> None:
        """`frame`: plane of the map. `start`: displacement known before the flight."""
        self._frame, self._model = frame, model or DifferenceModel()
        self._receiver, self._window = Receiver(), DifferenceWindow(self._model)
        self._learner = DisplacementLearner(start, self._model)
        self._pending: deque[MapPosition] = deque(maxlen=PENDING)
        self._solved: deque[tuple[GnssSample, Array]] = deque(maxlen=SOLVED)
        self._bin: list[Difference] = []
        self._map: MapPosition | None = None
        self._held: MapPosition | None = None
        self._map_jump_ns: int | None = None
        self._anchor = start
        self._agreed_s, self._newest_s = 0.0, -math.inf
        self._fault_ns = self._velocity_ns = -(10**12)
        self._history: deque[Difference] = deque(maxlen=HISTORY)
        self.status = GnssStatus(displacement=start)

    def sample(self, sample: GnssSample) -> None:
        """Add a solution of the receiver."""
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
        """Judge the receiver at a time; the status."""
        fault = self._receiver.fault(now_ns, self._speed_mps(now_ns))
        named = self.status.fault in (None, Fault.VELOCITY)  # a jump contradicts the velocity too
        if fault is None and named and (now_ns - self._velocity_ns) * NANOSECONDS >= BIN_S:
            self._velocity_ns = now_ns
            fault = self._velocity_fault()
        if fault is not None:
            self._fault_ns = now_ns
            self._alarm(fault, now_ns, None)
        return self.status

    def _pair(self, now_ns: int) -> None:
        """Differences at the exposures up to the newest sample."""
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
            if interval_ns * NANOSECONDS > GAP_S:
                continue
            ahead_ns = position.time_ns - earlier.time_ns
            weight = ahead_ns / interval_ns if interval_ns else 1.0
            at_exposure = (1 - weight) * earlier_m + weight * en_m
            self._add(position, at_exposure - position.en_m, sample, now_ns)

    def _add(self, position: MapPosition, off_en_m: Array, sample: GnssSample, now_ns: int) -> None:
        velocity = position.vel_en_mps
        if velocity is None:
            velocity = np.array(sample.vel_en_mps or (0.0, 0.0))
        std_m = sample.std_m if math.isfinite(sample.std_m) else self._model.gnss_std_m
        heading = math.radians(position.heading_deg)
        time_s = position.time_ns * NANOSECONDS
        made = Difference(time_s, off_en_m, std_m, position.std_m, heading, velocity)
        if self._bin and math.floor(self._bin[0].time_s / BIN_S) != math.floor(time_s / BIN_S):
            value, self._bin = _median(self._bin), []
            self._judge(value, now_ns)
        self._bin.append(made)

    def _judge(self, value: Difference, now_ns: int) -> None:
        """Test the window with a new value."""
        if value.time_s <= self._newest_s:
            self._window.clear()  # the clock went back
            self._history.clear()
        self._newest_s = value.time_s
        self._window.add(value)
        if self.status.state in (State.WAITING, State.GOOD) and (
            not self._history or value.time_s - self._history[-1].time_s >= HISTORY_S
        ):
            self._history.append(value)
        recent = self._window.recent(RECENT_S)
        east, north = recent.mean(axis=0).tolist()
        self.status = replace(self.status, difference_en_m=(east, north))
        if (now_ns - self._fault_ns) * NANOSECONDS < CLEAR_S:
            return  # the receiver has a fault by itself
        if self.status.state in (State.WAITING, State.GOOD):
            found = self._window.finding(self._learner.learnt) or self._too_far(recent, value)
            if found is not None:
                self._alarm(self._attributed(found, now_ns), now_ns, found)
                return
        self._count_agreement(recent, value, now_ns)
        if self.status.state is State.GOOD:
            self._learner.add(value)
            self.status = replace(self.status, displacement=self._learner.learnt)

    def _count_agreement(self, recent: Array, value: Difference, now_ns: int) -> None:
        """Count the time of agreement with the anchor, and change the state."""
        anchor = self._learner.learnt if self.status.state is State.GOOD else self._anchor
        gnss_m = max(value.gnss_std_m, self._model.gnss_std_m)
        std_m = math.sqrt(anchor.std_m**2 + gnss_m**2 + value.map_std_m**2)
        limit_m = max(AGREE_M, AGREE_SIGMAS * std_m)
        if self.status.state is State.WAITING and anchor.agreed_s == 0:
            limit_m = LARGEST_M  # nothing is known of the map
        if float(np.hypot(*(recent.mean(axis=0) - anchor.en_m))) > limit_m:
            self._agreed_s = 0.0
            if self.status.state in (State.ALARM, State.RETURNING):
                fault = self.status.fault
                named = fault if fault is None else _LEFT.get(fault, fault)
                self.status = replace(self.status, fault=named)
                self._enter(State.ALARM, now_ns)
            return
        self._agreed_s += BIN_S
        if self.status.state is State.ALARM and self._agreed_s >= RECENT_S:
            self._enter(State.RETURNING, now_ns)
        if self.status.state is not State.GOOD and self._agreed_s >= RETURN_S:
            self._enter(State.GOOD, now_ns)
            self.status = replace(self.status, fault=None, fault_en_m=(math.nan, math.nan))

    def _alarm(self, fault: Fault, now_ns: int, found: Finding | None) -> None:
        """Raise an alarm: learning stops, and what waits to be learnt is discarded."""
        if self.status.state in (State.WAITING, State.GOOD):
            begin_s = now_ns * NANOSECONDS if found is None else found.onset_s
            is_old = found is not None and found.fault is Fault.OFFSET
            self._anchor = self._learner.learnt if is_old else self._anchor_before(begin_s)
        if self.status.state is State.ALARM and (
            self.status.fault is fault or (fault is Fault.JUMP and self.status.fault is Fault.STEP)
        ):
            return
        self._learner.discard()
        self._forget()
        size = (math.nan, math.nan) if found is None else found.en_m
        self.status = replace(self.status, fault=fault, fault_en_m=size)
        self._enter(State.ALARM, now_ns)

    def _anchor_before(self, begin_s: float) -> Displacement:
        """Difference with which GNSS has to agree after a fault that began at `begin_s`.

        It joins what was learnt and the differences before the fault.
        """
        known, values = self._learner.learnt, [*self._history, *self._window.values]
        before = [each for each in values if each.time_s < begin_s - HISTORY_S] or values[:1]
        if not before:
            return known
        off = np.median([each.en_m for each in before], axis=0)
        gnss_m = max(before[-1].gnss_std_m, self._model.gnss_std_m)
        variance_m2 = gnss_m**2 + before[-1].map_std_m ** 2
        gain = known.std_m**2 / (known.std_m**2 + variance_m2)
        east, north = (known.en_m + gain * (off - known.en_m)).tolist()
        return Displacement(east, north, known.std_m * math.sqrt(1 - gain), known.agreed_s)

    def _enter(self, state: State, now_ns: int) -> None:
        if state is State.ALARM:
            self._agreed_s = 0.0
        if state is not self.status.state:
            self.status = replace(self.status, state=state, since_ns=now_ns)

    def _forget(self) -> None:
        """Begin a new window."""
        self._window.clear()
        self._bin = []

    def _attributed(self, found: Finding, now_ns: int) -> Fault:
        jumped = self._map_jump_ns
        if jumped is not None and (now_ns - jumped) * NANOSECONDS <= MAP_JUMP_S:
            return Fault.DISAGREES
        return found.fault

    def _too_far(self, recent: Array, value: Difference) -> Finding | None:
        """A difference that no displacement of a map explains."""
        east, north = recent.mean(axis=0).tolist()
        off_m = math.hypot(east, north)
        std_m = math.hypot(max(value.gnss_std_m, self._model.gnss_std_m), value.map_std_m)
        if len(recent) < RECENT_S / 2 or off_m < LARGEST_M + AGREE_SIGMAS * std_m:
            return None
        begin_s = self._window.values[0].time_s
        return Finding(Fault.OFFSET, begin_s, (east, north), std_m, (off_m - LARGEST_M) / std_m)

    def _velocity_fault(self) -> Fault | None:
        """Whether the receiver's velocity contradicts its positions."""
        model = self._model
        gnss_m2 = 2 * model.gnss_std_m**2 * (1 - math.exp(-VELOCITY_S / model.gnss_tau_s))
        drift_m2 = (VELOCITY_STD_MPS * VELOCITY_S) ** 2
        own_m = self._receiver.residual_over(VELOCITY_S)
        if own_m > model.multipath_m + model.sigmas * math.sqrt(gnss_m2 + drift_m2):
            return Fault.VELOCITY
        return None

    def _speed_mps(self, now_ns: int) -> float:
        """Speed by the map's track; NaN where it is not known or too old."""
        last = self._map
        if last is None or last.vel_en_mps is None:
            return math.nan
        if (now_ns - last.time_ns) * NANOSECONDS > GAP_S:
            return math.nan
        return float(np.hypot(*last.vel_en_mps))


def _jumped(before: MapPosition, now: MapPosition) -> bool:
    """Whether the map's position left the velocity of its track."""
    seconds = (now.time_ns - before.time_ns) * NANOSECONDS
    velocities = [v for v in (before.vel_en_mps, now.vel_en_mps) if v is not None]
    if not 0 < seconds <= GAP_S or not velocities:
        return False
    moved = np.mean(velocities, axis=0) * seconds
    off_m = float(np.hypot(*(now.en_m - before.en_m - moved)))
    return off_m > MAP_JUMP_M + MAP_JUMP_SIGMAS * max(before.std_m, now.std_m)


def _median(values: list[Difference]) -> Difference:
    """Median of the differences, other fields as in the middle."""
    middle = values[len(values) // 2]
    return replace(middle, en_m=np.median([each.en_m for each in values], axis=0))
