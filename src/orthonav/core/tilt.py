"""What reported pitch and roll are worth, by their source: standard deviations per axis, degrees.

Horizons: measured on the autopilots of docs/closed-loop.md, RMS per axis. With GNSS PX4's was off
by 0.7 to 1.4, without it by 1.1 to 2.3; ArduPilot's by 0.2, without GNSS by 0.5. Its accelerometers
were better than real ones. PX4's own variance (0.3 to 0.4 in a log) leaves accelerations out.
Gimbals shake by 0.01 to 0.1. Their horizon may drift (by 1 deg in 5 minutes,
https://github.com/maiermic/robot-cameraman/issues/17) and is trimmed by hand (`DJIGimbal` of DJI's
Mobile SDK). Mounts lean by 1 to 5 (docs/flights.md).
"""

import math
from dataclasses import dataclass
from typing import Any

HORIZON_STD_DEG = 1.0
UNAIDED_HORIZON_STD_DEG = 3.0
MOUNT_STD_DEG = 2.5
LEAST_STATED_DEG, MOST_STATED_DEG = 0.3, 10.0
"""A deviation that a message states counts between them: MAVROS states 57 deg by default."""


@dataclass(frozen=True)
class TiltSource:
    """Where pitch and roll come from. `aided_deg`, `unaided_deg`: standard deviation of the
    horizon, deg, with and without GNSS. `mount_deg`: of a mount that was never calibrated."""

    aided_deg: float
    unaided_deg: float
    mount_deg: float = 0.0

    def stated(self, *, aided: bool) -> dict[str, Any]:
        """Fields of `orthonav.core.records.Telemetry`. `aided`: whether by GNSS."""
        return self.with_horizon(self.aided_deg if aided else self.unaided_deg)

    def with_horizon(self, std_deg: float) -> dict[str, Any]:
        """The same where the deviation of the horizon is known; none where it is NaN."""
        if math.isnan(std_deg):
            return {}
        total_deg = math.hypot(std_deg, self.mount_deg)
        return {"tilt_std_deg": total_deg, "mount_std_deg": self.mount_deg or None}


GIMBAL = TiltSource(0.5, 0.5)
AUTOPILOT = TiltSource(HORIZON_STD_DEG, UNAIDED_HORIZON_STD_DEG, MOUNT_STD_DEG)
ARDUPILOT = TiltSource(HORIZON_STD_DEG, HORIZON_STD_DEG, MOUNT_STD_DEG)
UNSTATED = TiltSource(3.0, 3.0)
ASSUMED = TiltSource(6.0, 6.0)
"""Straight down: consistent on 30 photographs of a DJI Mini, some of which look 9 deg ahead."""

UNRECORDED = (
    "pitch and roll of the gimbal are 0 throughout, so they were not recorded: a camera that looks "
    "straight down is assumed"
)


def stated_deg(variances_rad2: tuple[float, float]) -> float | None:
    """Standard deviation of the horizon (deg) by the variances of roll and pitch that a message
    states; None for a placeholder."""
    variance = max(variances_rad2)
    std_deg = math.degrees(math.sqrt(variance)) if variance > 0 else math.nan
    return max(std_deg, LEAST_STATED_DEG) if std_deg <= MOST_STATED_DEG else None
