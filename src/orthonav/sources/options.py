"""What may be said about a source on the command line."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from orthonav.errors import FlightError

KINDS = ("flight", "photos", "video", "ros", "log")
ROLES = ("image", "camera_info", "attitude", "velocity", "position", "height")


@dataclass(frozen=True)
class SourceOptions:
    """How a source is to be read.

    `kind`: one of `KINDS`, else found by content. `camera`: a camera file. `rate_hz`: views per
    second of a video. `telemetry`: a log to join by time; `time_offset_s` is added to the times
    of the pictures before. `mount_deg`: yaw, pitch, roll of the camera in the body. `topics`: by
    role, for ROS. `prior_std_m`: tell the recorded position as a prior with this deviation.
    `sensor_width_mm`: for the focal length of photographs. `ground_alt_m`: altitude of the ground,
    where altitudes were recorded and no heights. `looks_down`: the camera looked straight down
    where no pitch and roll were recorded. Raises `FlightError` on impossible values.
    """

    kind: str | None = None
    camera: Path | None = None
    rate_hz: float = 1.0
    telemetry: Path | None = None
    time_offset_s: float = 0.0
    mount_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    topics: Mapping[str, str] = field(default_factory=dict)
    prior_std_m: float | None = None
    sensor_width_mm: float | None = None
    ground_alt_m: float | None = None
    looks_down: bool = False

    def __post_init__(self) -> None:
        for name in ("rate_hz", "prior_std_m", "sensor_width_mm"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise FlightError(f"{name} must be above 0, got {value}")
        numbers = (self.time_offset_s, *self.mount_deg, self.ground_alt_m or 0.0)
        if not all(math.isfinite(number) for number in numbers):
            raise FlightError("time offset, mount and ground altitude must be finite numbers")
        if self.kind is not None and self.kind not in KINDS:
            raise FlightError(f"kind must be one of {', '.join(KINDS)}, got '{self.kind}'")
        unknown = [role for role in self.topics if role not in ROLES]
        if unknown:
            raise FlightError(f"topics are for {', '.join(ROLES)}, got '{unknown[0]}'")

    @property
    def time_offset_ns(self) -> int:
        """The offset in integer ns."""
        return round(self.time_offset_s * 1e9)
