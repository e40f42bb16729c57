"""Whether the ground contradicts the start position of a flight."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, Prior, Telemetry
from orthonav.core.track.motion import usual_velocity_std_mps
from orthonav.onboard.state import SPEED_MPS

SIGMAS = 3.0
"""A place farther from the start than this many deviations contradicts it."""
SHOWN_S = 30.0
"""Time for which a contradiction is reported."""


class StartCheck:
    """Compares the places where a flight was recognized with its start. Mutable."""

    def __init__(self, start: Prior, time_ns: int) -> None:
        """`time_ns`: time of the first view, for which the start holds."""
        self._start, self._time_ns = start, time_ns
        self._moved_en_m, self._free_m = np.zeros(2), 0.0
        self._diagnosed: _Place | None = None
        self._confirmed: _Place | None = None

    def moved(self, telemetry: Telemetry) -> None:
        """Pass the telemetry of every view."""
        seconds = max(telemetry.time_ns - self._time_ns, 0) / 1e9
        self._time_ns = max(telemetry.time_ns, self._time_ns)
        velocity = telemetry.vel_en_mps
        if velocity is None or not np.isfinite(velocity).all():
            self._free_m += SPEED_MPS * seconds
            return
        std_mps = telemetry.vel_std_mps or usual_velocity_std_mps(math.hypot(*velocity))
        self._moved_en_m += np.array(velocity) * seconds
        self._free_m += SIGMAS * std_mps * seconds

    def diagnosed(self, fix: Fix, seen_ns: int, now_ns: int) -> None:
        """Pass the last place that the diagnosis found, in a view taken at `seen_ns`."""
        if self._diagnosed is None or self._diagnosed.fix is not fix:
            self._diagnosed = self._place(fix, seen_ns, now_ns)

    def confirmed(self, fix: Fix, now_ns: int) -> None:
        """Pass the confident fixes of the track; the first one decides."""
        if self._confirmed is None:
            self._confirmed = self._place(fix, now_ns, now_ns)

    def off_m(self, now_ns: int) -> float:
        """Distance of the start from that which the last place implies, metres; 0 where it is
        within the deviations, and `SHOWN_S` after that place."""
        last = self._confirmed or self._diagnosed
        return last.off_m if last is not None and now_ns - last.seen_ns < SHOWN_S * 1e9 else 0.0

    def _place(self, fix: Fix, seen_ns: int, now_ns: int) -> "_Place":
        """A place and what it says of the start. With time an aircraft may have come to any place
        from the start: where it may have come from the last place, that one decides."""
        off_m = float(np.hypot(*(_from(fix, self._start) + self._moved_en_m)))
        std_m = math.hypot(self._start.std_m, fix.radius_m)
        free_m = self._free_m + SPEED_MPS * (now_ns - seen_ns) / 1e9
        if off_m <= SIGMAS * std_m + free_m:
            before = self._diagnosed
            off_m = before.off_m if before is not None and before.reaches(fix, seen_ns) else 0.0
        return _Place(seen_ns, fix, off_m)


@dataclass(frozen=True, eq=False)
class _Place:
    """A confident fix, and the distance by which it contradicts the start, 0 if it does not."""

    seen_ns: int
    fix: Fix
    off_m: float

    def reaches(self, fix: Fix, seen_ns: int) -> bool:
        """Whether the aircraft can have flown from here to a later fix."""
        free_m = SPEED_MPS * (seen_ns - self.seen_ns) / 1e9
        return float(np.hypot(*_from(fix, self.fix))) <= free_m + self.fix.radius_m + fix.radius_m


def _from(fix: Fix, other: Fix | Prior) -> NDArray[np.float64]:
    """Metres east and north (2,) of another place from a fix."""
    return LocalFrame(fix.lat_deg, fix.lon_deg).en_from_latlon(other.lat_deg, other.lon_deg)
