"""What the autopilot told over the last seconds, and what that was at the exposure of a view.

Two clocks: ours (monotonic) and the autopilot's (since it was switched on). Samples are kept by the
autopilot's, `ClockSync` takes the exposure there. Nothing here reads a clock or a port.
"""

import math
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from orthonav.geo.camera import attitude_of
from orthonav.records import Telemetry
from orthonav.sources.attitude import LOOKS_DOWN, Angles, enu_from_body_camera

HEIGHT_SOURCES = ("distance", "terrain", "home", "relative")
"""Heights above ground, the better first: a rangefinder that looks down; the autopilot's terrain
model; above home (right over flat ground only) of two messages."""
_MS = 1_000_000
_NAN3 = (math.nan, math.nan, math.nan)
Triple = tuple[float, float, float]
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Clocks:
    """Where the time comes from; tests bring their own."""

    mono_ns: Callable[[], int] = time.monotonic_ns
    utc_ns: Callable[[], int] = time.time_ns
    sleep: Callable[[float], None] = time.sleep


@dataclass(frozen=True)
class Limits:
    """How long samples are kept, how far apart two may lie that are interpolated between, and how
    long the last one holds. Attitude changes fast, heights and velocities do not."""

    keep_s: float = 10.0
    attitude_gap_s: float = 0.5
    attitude_hold_s: float = 0.1
    attitude_ahead_s: float = 0.03
    slow_gap_s: float = 2.0
    slow_hold_s: float = 1.5


@dataclass(frozen=True, eq=False)
class Told:
    """What the autopilot said of one moment of its clock.

    `ned_from_body` is its attitude (3, 3), None where not known; `height_m` above ground and which
    of `HEIGHT_SOURCES` told it; `velocity_ned_mps` and `down_m` of its local frame; NaN where not
    known.
    """

    ned_from_body: Array | None
    height_m: float = math.nan
    height_source: str = ""
    velocity_ned_mps: Triple = _NAN3
    down_m: float = math.nan

    def attitude_rad(self) -> Triple:
        """Roll, pitch and yaw; NaN where not known."""
        if self.ned_from_body is None:
            return _NAN3
        yaw, pitch, roll = Rotation.from_matrix(self.ned_from_body).as_euler("ZYX").tolist()
        return roll, pitch, yaw

    def telemetry(self, time_ns: int, mount_deg: Angles = LOOKS_DOWN) -> Telemetry:
        """Heading, tilt and height of the camera in its mount, `time_ns` being what is written."""
        yaw = pitch = roll = math.nan
        if self.ned_from_body is not None:
            yaw, pitch, roll = attitude_of(enu_from_body_camera(self.ned_from_body, mount_deg))
        north, east, _ = self.velocity_ned_mps
        known = math.isfinite(north + east)
        return Telemetry(
            time_ns, yaw, pitch, roll, self.height_m, vel_en_mps=(east, north) if known else None
        )


class _Line:
    """Samples of one kind at increasing times."""

    def __init__(self, gap_s: float, hold_s: float) -> None:
        self.gap_ns, self.hold_ns = round(gap_s * 1e9), round(hold_s * 1e9)
        self.times: list[int] = []
        self.values: list[Array] = []

    def add(self, time_ns: int, value: Array, keep_ns: int) -> None:
        if self.times and time_ns <= self.times[-1]:
            return  # came twice, or overtook the one before
        self.times.append(time_ns)
        self.values.append(value)
        if self.times[0] < time_ns - 2 * keep_ns:  # now and then, not at every sample
            first = bisect_left(self.times, time_ns - keep_ns)
            del self.times[:first], self.values[:first]

    def around(self, time_ns: int) -> tuple[Array, Array, float] | None:
        """The values before and after a moment and the weight of the later one, None in gaps."""
        after = bisect_left(self.times, time_ns)
        if after < len(self.times) and self.times[after] == time_ns:
            return self.values[after], self.values[after], 0.0
        if after == 0:
            return None
        start = self.times[after - 1]
        if after == len(self.times):
            held = time_ns - start <= self.hold_ns
            return (self.values[-1], self.values[-1], 0.0) if held else None
        way = self.times[after] - start
        if way > self.gap_ns:
            return None
        return self.values[after - 1], self.values[after], (time_ns - start) / way

    def ahead(self, time_ns: int, most_ns: int) -> tuple[Array, Array, float] | None:
        """The last two values and a weight above 1 for a moment a little after them."""
        if not self.covered_ns(most_ns) >= time_ns > self.times[-1]:
            return None
        way = self.times[-1] - self.times[-2]
        return self.values[-2], self.values[-1], 1 + (time_ns - self.times[-1]) / way

    def covered_ns(self, most_ns: int) -> int:
        """Up to when values are known: a little longer than told where they come closely."""
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
    """Samples of the last seconds by the autopilot's clock. Mutable; not to be shared."""

    def __init__(
        self, limits: Limits | None = None, heights: Sequence[str] = HEIGHT_SOURCES
    ) -> None:
        """`heights` are those of `HEIGHT_SOURCES` that may be used, the best first."""
        self.limits = limits or Limits()
        self._order = tuple(heights)
        self.clear()

    def clear(self) -> None:
        """Forget everything: the autopilot was switched on anew."""
        told = self.limits
        slow = told.slow_gap_s, told.slow_hold_s
        self._attitude = _Line(told.attitude_gap_s, told.attitude_hold_s)
        self._heights = {name: _Line(*slow) for name in self._order}
        self._local = _Line(*slow)

    def add_attitude(self, time_ns: int, wxyz: Sequence[float]) -> None:
        """A rotation from body (forward, right, down) to north, east, down; others are dropped."""
        quaternion = np.array(wxyz, dtype=np.float64)
        norm = float(np.linalg.norm(quaternion))
        if not abs(norm - 1) < 0.1:  # NaN too
            return
        quaternion /= norm
        before = self._attitude.values
        if before and float(before[-1] @ quaternion) < 0:
            quaternion = -quaternion  # the same attitude, on the near side
        self._attitude.add(time_ns, quaternion, self._keep_ns)

    def add_height(self, source: str, time_ns: int, height_m: float) -> None:
        """A height of one of `HEIGHT_SOURCES`; what is no number is dropped."""
        if source in self._heights and math.isfinite(height_m):
            self._heights[source].add(time_ns, np.array([height_m]), self._keep_ns)

    def add_distance(self, time_ns: int, distance_m: float) -> None:
        """A distance along the axis of the body down to flat ground, as a height."""
        found = self._attitude.values[-1] if self._attitude.values else None
        if found is not None:
            down = _matrix(found)[2, 2]
            if down > 0.5:
                self.add_height("distance", time_ns, distance_m * float(down))

    def add_local(self, time_ns: int, velocity_ned_mps: Triple, down_m: float) -> None:
        """Velocity and height in the autopilot's local frame."""
        values = np.array([*velocity_ned_mps, down_m])
        if np.isfinite(values).all():
            self._local.add(time_ns, values, self._keep_ns)

    @property
    def newest_ns(self) -> int | None:
        """Time of the last attitude, None where there is none."""
        return self._attitude.times[-1] if self._attitude.times else None

    @property
    def covered_ns(self) -> int | None:
        """Up to when the attitude is known: a little longer than told, None where there is none."""
        return self._attitude.covered_ns(self._ahead_ns) if self._attitude.times else None

    def at(self, time_ns: int) -> Told:
        """What was told of a moment, between samples by the shortest turn and a straight line."""
        found = self._attitude.around(time_ns)
        if found is not None and time_ns > self._attitude.times[-1]:
            found = self._attitude.ahead(time_ns, self._ahead_ns) or found
        turn = None
        if found is not None:
            before, after, weight = found
            turn = _matrix(_slerp(before, after, weight))
        height, source = math.nan, ""
        for name in self._order:
            value = self._heights[name].at(time_ns)
            if value is not None:
                height, source = float(value[0]), name
                break
        local = self._local.at(time_ns)
        if local is None:
            return Told(turn, height, source)
        north, east, down, below = local.tolist()
        return Told(turn, height, source, (north, east, down), below)

    @property
    def _ahead_ns(self) -> int:
        return round(self.limits.attitude_ahead_s * 1e9)

    @property
    def _keep_ns(self) -> int:
        return round(self.limits.keep_s * 1e9)


def wxyz_of_angles(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """The quaternion w, x, y, z of an autopilot's angles (turned in the order yaw, pitch, roll)."""
    xyzw = Rotation.from_euler("ZYX", [yaw_rad, pitch_rad, roll_rad]).as_quat()
    return np.asarray(xyzw[[3, 0, 1, 2]])


def _slerp(before: Array, after: Array, weight: float) -> Array:
    """Between two quaternions on the near side of each other, along the shortest turn."""
    angle = math.acos(min(1.0, float(before @ after)))
    if weight == 0.0 or angle < 1e-6:
        return before
    mixed = math.sin((1 - weight) * angle) * before + math.sin(weight * angle) * after
    return np.asarray(mixed / math.sin(angle))


def _matrix(wxyz: Array) -> Array:
    return np.asarray(Rotation.from_quat(wxyz[[1, 2, 3, 0]]).as_matrix())


class ClockSync:
    """How far the autopilot's clock is ahead of ours, in ns: its time = ours + `offset_ns`.

    From TIMESYNC exchanges, the quick ones of the last `WINDOW`; without any, from the times that
    messages carry, of which the one that came soonest counts. A sample that is far off is left
    out, unless others agree with it: then a clock was set, or the autopilot started anew, and all
    begins again (`jumps`). Mutable.
    """

    WINDOW = 32
    LONGEST_NS = 1000 * _MS
    """A longer round trip tells nothing."""
    OUTLIER_NS = 20 * _MS
    JUMP_NS = 1000 * _MS
    """What messages carry may be off by this much: they may have waited in a queue."""
    AGREE = 4
    AGREE_NS = 500 * _MS

    def __init__(self) -> None:
        self.jumps = self.rejected = 0
        self.exchanged_ns: int | None = None
        """When (our clock) the last exchange was good."""
        self.reset()

    def reset(self) -> None:
        """Begin again."""
        self.offset_ns: int | None = None
        self._exact: deque[tuple[int, int]] = deque(maxlen=self.WINDOW)  # round trip, offset
        self._rough: deque[int] = deque(maxlen=100)
        self._suspects: list[tuple[int, int]] = []  # when it came, offset
        self.exchanged_ns = None

    @property
    def is_exact(self) -> bool:
        """Whether the offset rests on exchanges and not on arrival alone."""
        return bool(self._exact)

    def exchange(self, sent_ns: int, received_ns: int, reported_ns: int) -> bool:
        """One exchange: sent and answered by our clock, what the autopilot's said between.

        Whether the clocks were found to have jumped.
        """
        trip_ns = received_ns - sent_ns
        if not 0 <= trip_ns <= self.LONGEST_NS:
            self.rejected += 1
            return False
        offset_ns = reported_ns - (sent_ns + received_ns) // 2
        if self._exact and abs(offset_ns - self._now()) > max(self.OUTLIER_NS, trip_ns):
            self.rejected += 1
            return self._suspect(received_ns, offset_ns, self.OUTLIER_NS)
        self._suspects.clear()
        self._exact.append((trip_ns, offset_ns))
        quick_ns = 1.5 * min(trip for trip, _ in self._exact) + _MS / 5
        self.offset_ns = round(median(offset for trip, offset in self._exact if trip <= quick_ns))
        self.exchanged_ns = received_ns
        return False

    def heard(self, arrived_ns: int, reported_ns: int) -> bool:
        """A message that carries its time. Whether the clocks were found to have jumped."""
        offset_ns = reported_ns - arrived_ns
        if self.offset_ns is not None and abs(offset_ns - self._now()) > self.JUMP_NS:
            return self._suspect(arrived_ns, offset_ns, self.OUTLIER_NS * 5)
        if not self._exact:
            self._rough.append(offset_ns)
            self.offset_ns = max(self._rough)
            self._suspects.clear()
        return False

    def _now(self) -> int:
        return self.offset_ns or 0

    def _suspect(self, arrived_ns: int, offset_ns: int, agree_ns: int) -> bool:
        """Note an offset that is far off; begin again there where several agree for a while."""
        near = [one for one in self._suspects if abs(one[1] - offset_ns) <= agree_ns]
        self._suspects = [*near[-50:], (arrived_ns, offset_ns)]
        if len(near) + 1 < self.AGREE or arrived_ns - near[0][0] < self.AGREE_NS:
            return False  # a queue that empties brings many at once, and each with another delay
        self.reset()
        self.offset_ns = offset_ns
        self._rough.append(offset_ns)
        self.jumps += 1
        return True
