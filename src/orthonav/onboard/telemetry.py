"""Telemetry of the last seconds, interpolated to the exposure of a view.

Samples carry times of the autopilot's clock (since boot); `ClockSync` converts ours to it.
"""

import math
import time
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.attitude import (
    LOOKS_DOWN,
    Angles,
    enu_from_body_camera,
    matrices_of_wxyz,
    slerp,
)
from orthonav.core.geo.camera import angles_of_ned, attitude_of
from orthonav.core.records import Telemetry
from orthonav.core.tilt import ARDUPILOT, AUTOPILOT

HEIGHT_SOURCES = ("distance", "terrain", "amsl", "home", "relative")
"""Sources of the height above ground, best first: a rangefinder, the autopilot's terrain model, the
height above sea level (with the terrain of the map only), that above home of two messages."""
_ABOVE_HOME = ("home", "relative")
_SECOND_AMSL = "altitude"
"""Height above sea level of a second message, where the first gives none."""
_MS = 1_000_000
_NAN3 = (math.nan, math.nan, math.nan)
KEEP_NS, KEEP_LOCAL_NS = 20 * 10**9, 60 * 10**9
"""Samples are kept for so long: the longest latency of a camera, and some more; velocities for the
longest gap between views that their mean bridges."""
ATTITUDE_GAP_S, SLOW_GAP_S = 0.5, 2.0
"""Longest interval that is interpolated: of attitudes, which change fast, and of the rest."""
ATTITUDE_HOLD_S, SLOW_HOLD_S = 0.1, 1.5
"""Time for which the last sample holds."""
ATTITUDE_AHEAD_NS = 30_000_000
"""Longest extrapolation of the attitude."""
FASTEST_MPS = 300.0
"""A faster velocity is an error."""
Triple = tuple[float, float, float]
Array = NDArray[np.float64]
AIDED_VEL_STD_MPS, UNAIDED_VEL_STD_MPS = 1.0, 5.0
"""Of the velocity with GNSS and without, where PX4's was 2 to 5 m/s off in simulated flights."""
LARGEST_AIDED_MPS = 1.0
"""A filter that claims more for its velocity does not fuse GNSS, whatever the receiver has."""
STATUS_NS, FIX_NS = 5 * 10**9, 3 * 10**9
"""A status and a fix hold for so long; the autopilots send both at 1 Hz or more."""
ABSOLUTE = 16
_IN_DOUBT = 128 | 1024 | 32768
FIX_3D = 3


@dataclass(frozen=True)
class Clocks:
    mono_ns: Callable[[], int] = time.monotonic_ns
    utc_ns: Callable[[], int] = time.time_ns
    sleep: Callable[[float], None] = time.sleep


@dataclass(frozen=True, eq=False)
class VehicleState:
    """State of the aircraft that the autopilot reported for one time of its clock.

    `ned_from_body`: attitude as a rotation matrix (3, 3); None where not known. The rest is NaN
    where not known. `height_m`: above ground; it equals `home_m`, the height above the take-off,
    where only that is known: level ground is assumed. `down_m`: below the origin of the autopilot's
    local frame. `vel_std_mps`, `horizon_std_deg`: NaN: as usual.
    """

    ned_from_body: Array | None
    height_m: float = math.nan
    velocity_ned_mps: Triple = _NAN3
    down_m: float = math.nan
    home_m: float = math.nan
    amsl_m: float = math.nan
    vel_std_mps: float = math.nan
    horizon_std_deg: float = math.nan

    def attitude_rad(self) -> Triple:
        """Roll, pitch and yaw of the body in radians; NaN where not known."""
        if self.ned_from_body is None:
            return _NAN3
        yaw, pitch, roll = angles_of_ned(self.ned_from_body)
        return roll, pitch, yaw

    def telemetry(self, time_ns: int, mount_deg: Angles = LOOKS_DOWN) -> Telemetry:
        yaw = pitch = roll = math.nan
        if self.ned_from_body is not None:
            yaw, pitch, roll = attitude_of(enu_from_body_camera(self.ned_from_body, mount_deg))
        north, east, _ = self.velocity_ned_mps
        known = math.isfinite(north + east)
        return Telemetry(
            time_ns,
            yaw,
            pitch,
            roll,
            self.height_m,
            vel_en_mps=(east, north) if known else None,
            **AUTOPILOT.with_horizon(self.horizon_std_deg),
            vel_std_mps=_known(self.vel_std_mps),
            home_m=_known(self.home_m),
            amsl_m=_known(self.amsl_m),
        )


class _Samples:
    def __init__(self, gap_s: float, hold_s: float) -> None:
        self.gap_ns, self.hold_ns = round(gap_s * 1e9), round(hold_s * 1e9)
        self.times: list[int] = []
        self.values: list[Array] = []

    def add(self, time_ns: int, value: Array, keep_ns: int) -> None:
        if self.times and time_ns <= self.times[-1]:
            return  # a duplicate, or out of order
        self.times.append(time_ns)
        self.values.append(value)
        if self.times[0] < time_ns - 2 * keep_ns:  # rarely: deleting moves the whole list
            first = bisect_left(self.times, time_ns - keep_ns)
            del self.times[:first], self.values[:first]

    def around(self, time_ns: int) -> tuple[Array, Array, float] | None:
        """Values before and after a time, and the weight of the later one; None in gaps."""
        after = bisect_left(self.times, time_ns)
        if after < len(self.times) and self.times[after] == time_ns:
            return self.values[after], self.values[after], 0.0
        if after == 0:
            return None
        start = self.times[after - 1]
        if after == len(self.times):
            held = time_ns - start <= self.hold_ns
            return (self.values[-1], self.values[-1], 0.0) if held else None
        interval = self.times[after] - start
        if interval > self.gap_ns:
            return None
        return self.values[after - 1], self.values[after], (time_ns - start) / interval

    def ahead(self, time_ns: int, most_ns: int) -> tuple[Array, Array, float] | None:
        """Last two values and a weight above 1, for a time shortly after them."""
        if not self.covered_ns(most_ns) >= time_ns > self.times[-1]:
            return None
        interval = self.times[-1] - self.times[-2]
        return self.values[-2], self.values[-1], 1 + (time_ns - self.times[-1]) / interval

    def covered_ns(self, most_ns: int) -> int:
        """Time up to which values are known; extrapolated where samples are dense."""
        close = len(self.times) > 1 and self.times[-1] - self.times[-2] <= 2 * most_ns
        return self.times[-1] + (most_ns if close else 0)

    def at(self, time_ns: int) -> Array | None:
        """Linear between samples; None in gaps."""
        found = self.around(time_ns)
        if found is None:
            return None
        before, after, weight = found
        return np.asarray((1 - weight) * before + weight * after)


class TelemetryBuffer:
    def __init__(self, heights: Sequence[str] = HEIGHT_SOURCES) -> None:
        """`heights` are those of `HEIGHT_SOURCES` that may be used, the best first."""
        self._order = tuple(heights)
        self.clear()

    def clear(self) -> None:
        slow = SLOW_GAP_S, SLOW_HOLD_S
        self._attitude = _Samples(ATTITUDE_GAP_S, ATTITUDE_HOLD_S)
        self._heights = {name: _Samples(*slow) for name in self._order}
        if "amsl" in self._order:
            self._heights[_SECOND_AMSL] = _Samples(*slow)
        self._local = _Samples(*slow)

    def add_attitude(self, time_ns: int, wxyz: Sequence[float]) -> None:
        """Add a rotation from body (forward, right, down) to NED; invalid ones are dropped."""
        quaternion = np.array(wxyz, dtype=np.float64)
        norm = float(np.linalg.norm(quaternion))
        if not abs(norm - 1) < 0.1:  # NaN too
            return
        quaternion /= norm
        self._attitude.add(time_ns, quaternion, KEEP_NS)

    def add_height(self, source: str, time_ns: int, height_m: float) -> None:
        """Add a height from one of `HEIGHT_SOURCES`; `altitude` is a second one above sea level."""
        if source in self._heights and math.isfinite(height_m):
            self._heights[source].add(time_ns, np.array([height_m]), KEEP_NS)

    def add_distance(self, time_ns: int, distance_m: float) -> None:
        """Add a distance along the body's down axis, converted to a height over flat ground."""
        found = self._attitude.values[-1] if self._attitude.values else None
        if found is not None:
            down = matrices_of_wxyz(found)[2, 2]
            if down > 0.5:
                self.add_height("distance", time_ns, distance_m * float(down))

    def add_local(self, time_ns: int, velocity_ned_mps: Triple, down_m: float) -> None:
        values = np.array([*velocity_ned_mps, down_m])
        if np.isfinite(values).all() and np.abs(values[:3]).max() <= FASTEST_MPS:
            self._local.add(time_ns, values, KEEP_LOCAL_NS)

    @property
    def covered_ns(self) -> int | None:
        return self._attitude.covered_ns(ATTITUDE_AHEAD_NS) if self._attitude.times else None

    def at(self, time_ns: int) -> VehicleState:
        found = self._attitude.around(time_ns)
        if found is not None and time_ns > self._attitude.times[-1]:
            found = self._attitude.ahead(time_ns, ATTITUDE_AHEAD_NS) or found
        turn = None if found is None else matrices_of_wxyz(slerp(*found))
        above_ground = [name for name in self._order if name != "amsl"]
        state = VehicleState(
            turn,
            self._height(above_ground, time_ns),
            home_m=self._height([name for name in above_ground if name in _ABOVE_HOME], time_ns),
            amsl_m=self._height(("amsl", _SECOND_AMSL), time_ns),
        )
        local = self._local.at(time_ns)
        if local is None:
            return state
        north, east, down, below = local.tolist()
        return replace(state, velocity_ned_mps=(north, east, down), down_m=below)

    def mean_velocity(self, start_ns: int, end_ns: int) -> tuple[float, float] | None:
        """East and north (m/s); None where it is not known throughout."""
        local = self._local
        inner = slice(bisect_right(local.times, start_ns), bisect_left(local.times, end_ns))
        ends = local.at(start_ns), local.at(end_ns)
        times = np.array([start_ns, *local.times[inner], end_ns])
        if ends[0] is None or ends[1] is None or np.diff(times).max() > local.gap_ns:
            return None
        velocities = np.array([ends[0], *local.values[inner], ends[1]])[:, 1::-1]
        means, steps_ns = (velocities[1:] + velocities[:-1]) / 2, np.diff(times)[:, None]
        east, north = ((means * steps_ns).sum(axis=0) / (end_ns - start_ns)).tolist()
        return east, north

    def _height(self, names: Sequence[str], time_ns: int) -> float:
        found = (self._heights[name].at(time_ns) for name in names if name in self._heights)
        return next((float(value[0]) for value in found if value is not None), math.nan)


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


class ClockSync:
    """Converts times of our clock to the autopilot's and back. Mutable.

    Offset and rate are those of the last TIMESYNC exchanges: simulators run slower than real time.
    Without exchanges the timestamp of the message with the least delay counts. An outlier is
    ignored unless others agree with it; then a clock was set or the autopilot restarted, and the
    estimate starts again (`jumps`).
    """

    WINDOW = 32
    """Number of exchanges: half a minute at one per second."""
    LONGEST_NS = 1000 * _MS
    """Exchanges with a longer round trip are ignored."""
    OUTLIER_NS = 20 * _MS
    JUMP_NS = 1000 * _MS
    """Tolerance of the timestamps of messages, which may have waited in a queue."""
    AGREE = 4
    """Number of outliers that must agree before the clock is taken to have jumped."""
    AGREE_NS = 500 * _MS
    """Time over which they must agree."""
    FASTEST, RATE_NS = 0.05, 5000 * _MS
    """Largest difference of the rates of the clocks, allowed for until exchanges of so long show
    the true one."""

    def __init__(self) -> None:
        self.jumps = 0
        self.reset()

    def reset(self) -> None:
        self._offset_ns: int | None = None
        self._at_ns, self._rate = 0, 0.0
        self._exact: deque[_Exchange] = deque(maxlen=self.WINDOW)
        self._rough: deque[int] = deque(maxlen=100)
        self._suspects: list[tuple[int, int]] = []  # arrival, offset

    @property
    def is_exact(self) -> bool:
        return bool(self._exact)

    def boot_ns(self, mono_ns: int) -> int | None:
        if self._offset_ns is None:
            return None
        return mono_ns + self._offset_ns + round(self._rate * (mono_ns - self._at_ns))

    def mono_ns(self, boot_ns: int) -> int | None:
        if self._offset_ns is None:
            return None
        since_ns = boot_ns - self._offset_ns - self._at_ns
        return self._at_ns + round(since_ns / (1 + self._rate))

    def exchange(self, sent_ns: int, received_ns: int, reported_ns: int) -> bool:
        """Whether a clock was found to have jumped. `reported_ns`: the autopilot's time."""
        trip_ns = received_ns - sent_ns
        if not 0 <= trip_ns <= self.LONGEST_NS:
            return False
        at_ns = (sent_ns + received_ns) // 2
        if self._exact:
            span_ns = at_ns - self._exact[0].at_ns
            rate_ns = self.FASTEST * span_ns if span_ns < self.RATE_NS else 0.0
            if self._off_ns(at_ns, reported_ns) > max(self.OUTLIER_NS, trip_ns) + rate_ns:
                return self._suspect(at_ns, reported_ns - at_ns, self.OUTLIER_NS)
        self._suspects.clear()
        self._exact.append(_Exchange(trip_ns, at_ns, reported_ns - at_ns))
        self._fit()
        return False

    def heard(self, arrived_ns: int, reported_ns: int) -> bool:
        """Add a message that carries its time; whether a clock was found to have jumped."""
        offset_ns = reported_ns - arrived_ns
        if self._off_ns(arrived_ns, reported_ns) > self.JUMP_NS:
            return self._suspect(arrived_ns, offset_ns, self.OUTLIER_NS * 5)
        if not self._exact:
            self._rough.append(offset_ns)
            self._offset_ns = max(self._rough)
            self._suspects.clear()
        return False

    def _off_ns(self, mono_ns: int, reported_ns: int) -> int:
        expected_ns = self.boot_ns(mono_ns)
        return 0 if expected_ns is None else abs(reported_ns - expected_ns)

    def _fit(self) -> None:
        """Fit offset and rate: the rate by the median slope (Theil and Sen) of the quicker half."""
        trips = sorted(each.trip_ns for each in self._exact)
        self._rate = 0.0
        if len(trips) >= self.AGREE:
            longest_ns = trips[max(self.AGREE, len(trips) // 2) - 1]
            quicker = [each for each in self._exact if each.trip_ns <= longest_ns]
            pairs = combinations(quicker, 2)
            rate = median((b.offset_ns - a.offset_ns) / (b.at_ns - a.at_ns) for a, b in pairs)
            # A smaller rate may be due to unequal delays there and back.
            if abs(rate) * (quicker[-1].at_ns - quicker[0].at_ns) > longest_ns:
                self._rate = rate
        quick_ns = 1.5 * trips[0] + _MS / 5
        self._at_ns = self._exact[-1].at_ns
        self._offset_ns = round(
            median(
                each.offset_ns + self._rate * (self._at_ns - each.at_ns)
                for each in self._exact
                if each.trip_ns <= quick_ns
            )
        )

    def _suspect(self, arrived_ns: int, offset_ns: int, agree_ns: int) -> bool:
        """Note an outlier; start again from it where several agree over `AGREE_NS`."""
        near = [
            (at_ns, offset)
            for at_ns, offset in self._suspects
            if abs(offset - offset_ns) <= agree_ns + self.FASTEST * (arrived_ns - at_ns)
        ]
        self._suspects = [*near[-50:], (arrived_ns, offset_ns)]
        if len(near) + 1 < self.AGREE or arrived_ns - near[0][0] < self.AGREE_NS:
            return False  # a queue that empties delivers many at once, with different delays
        self.reset()
        self._offset_ns, self._at_ns = offset_ns, arrived_ns
        self._rough.append(offset_ns)
        self.jumps += 1
        return True


class _Exchange(NamedTuple):
    """Round trip of a TIMESYNC exchange, its time by our clock, and the offset that it shows."""

    trip_ns: int
    at_ns: int
    offset_ns: int


class Aiding:
    """What the autopilot reported about its filter and receivers, by our clock. Mutable."""

    def __init__(self) -> None:
        self._source = AUTOPILOT
        self._absolute_ns: int | None = None
        self._fixed_ns: int | None = None
        self._vel: tuple[int, float] | None = None

    def status(self, flags: int, now_ns: int, *, ardupilot: bool = False) -> None:
        """Take the flags of ESTIMATOR_STATUS or, by `ardupilot`, of EKF_STATUS_REPORT, which mean
        the same: an absolute position (16), but neither constant (128), nor a glitch or an
        uninitialized filter (1024), nor a glitch of GNSS (ArduPilot: 32768)."""
        self._source = ARDUPILOT if ardupilot else AUTOPILOT
        aided = flags & ABSOLUTE and not flags & _IN_DOUBT
        self._absolute_ns = now_ns if aided else None

    def receiver(self, fix_type: int, now_ns: int) -> None:
        """Take the fix type of a receiver other than orthonav."""
        if fix_type >= FIX_3D:
            self._fixed_ns = now_ns

    def velocity(self, std_mps: float, now_ns: int) -> None:
        self._vel = (now_ns, std_mps) if math.isfinite(std_mps) else None

    def is_aided(self, now_ns: int) -> bool:
        return (
            _is_recent(self._absolute_ns, now_ns, STATUS_NS)
            and _is_recent(self._fixed_ns, now_ns, FIX_NS)
            and not self._claimed_mps(now_ns) > LARGEST_AIDED_MPS
        )

    def stds(self, now_ns: int) -> tuple[float, float]:
        """Standard deviations of velocity (m/s) and horizon (deg)."""
        if self.is_aided(now_ns):
            return AIDED_VEL_STD_MPS, self._source.aided_deg
        return max(UNAIDED_VEL_STD_MPS, self._claimed_mps(now_ns)), self._source.unaided_deg

    def _claimed_mps(self, now_ns: int) -> float:
        """Standard deviation of the velocity by the filter; 0 where it is not known."""
        if self._vel is None or not _is_recent(self._vel[0], now_ns, STATUS_NS):
            return 0.0
        return self._vel[1]


def _is_recent(then_ns: int | None, now_ns: int, most_ns: int) -> bool:
    return then_ns is not None and now_ns - then_ns <= most_ns
