"""Whether the ground contradicts the start position of a flight."""

import math

import numpy as np

from orthonav.geo.frames import LocalFrame
from orthonav.onboard.state import SPEED_MPS
from orthonav.records import Fix, Prior, Telemetry
from orthonav.track.motion import usual_velocity_std_mps

SIGMAS = 3.0
"""A place farther from the start than this many deviations contradicts it."""
SHOWN_S = 30.0
"""Time for which a contradiction is reported after the position was found."""


class StartCheck:
    """Compares the first recognized place of a flight with its start. Mutable."""

    def __init__(self, start: Prior, time_ns: int) -> None:
        """`time_ns`: time of the first view, for which the start holds."""
        self._start, self._time_ns = start, time_ns
        self._moved_en_m, self._free_m = np.zeros(2), 0.0
        self._found: tuple[int, float] | None = None

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

    def off_m(self, fix: Fix, age_s: float = 0.0) -> float:
        """Distance of the start from that which a confident fix implies, metres; 0 where it is
        within the deviations. `age_s`: age of the fix."""
        frame = LocalFrame(fix.lat_deg, fix.lon_deg)
        start_en_m = frame.en_from_latlon(self._start.lat_deg, self._start.lon_deg)
        off_m = float(np.hypot(*(start_en_m + self._moved_en_m)))
        std_m = math.hypot(self._start.std_m, fix.radius_m)
        return off_m if off_m > SIGMAS * std_m + self._free_m + SPEED_MPS * age_s else 0.0

    def confirmed(self, fix: Fix, now_ns: int) -> None:
        """Pass the confident fixes of the track; the first one decides."""
        if self._found is None:
            self._found = now_ns, self.off_m(fix)

    def found_off_m(self, now_ns: int) -> float | None:
        """`off_m` of the first fix for a while after it, then 0; None before it."""
        if self._found is None:
            return None
        return self._found[1] if now_ns - self._found[0] < SHOWN_S * 1e9 else 0.0
