"""Options for reading a recording."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from orthonav.core.errors import FlightError
from orthonav.core.files import with_paths

KINDS = ("flight", "photos", "video", "ros", "log")
ROLES = ("image", "camera_info", "attitude", "velocity", "position", "height")


MAX_FOV_DEG = 150.0


@dataclass(frozen=True)
class SourceOptions:
    """How a recording is read. Raises `FlightError` for invalid values."""

    kind: str | None = None
    """One of `KINDS`; None: detected by content."""
    camera: Path | None = None
    """Camera file; None: the recording's own camera."""
    rate_hz: float = 1.0
    """Views per second of a video."""
    telemetry: Path | None = None
    """Log to join by time; None: the recording's own telemetry."""
    time_offset_s: float = 0.0
    """Added to the times of images to get times of the log, seconds."""
    mount_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Yaw, pitch, roll of the camera in the body; 0, 0, 0 looks straight down, top forward."""
    topics: Mapping[str, str] = field(default_factory=dict)
    """ROS topics by role, one of `ROLES`."""
    prior_std_m: float | None = None
    """Use the recorded position as the prior, with this standard deviation per axis."""
    sensor_width_mm: float | None = None
    """Longer side of the sensor, for the focal length of photographs."""
    ground_alt_m: float | None = None
    """Altitude of the ground, where altitudes but no heights were recorded; in their reference."""
    agl_m: float | None = None
    """Height above ground of all views, in place of a recorded one."""
    fov_deg: float | None = None
    """Field of view across the width of the image, where there is no camera file."""
    looks_down: bool = False
    """Whether the camera looked straight down where pitch and roll were not recorded."""
    over_terrain: bool = False
    """Whether a terrain turns the heights of the recording into heights above ground later on."""
    skip_bad_images: bool = False
    """Whether images that a flight folder names may be missing."""

    def __post_init__(self) -> None:
        with_paths(self, "camera", "telemetry")
        for name in ("rate_hz", "prior_std_m", "sensor_width_mm", "agl_m", "fov_deg"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise FlightError(f"{name} must be above 0, got {value}")
        if self.fov_deg is not None and self.fov_deg > MAX_FOV_DEG:
            raise FlightError(f"fov_deg must be at most {MAX_FOV_DEG:g}, got {self.fov_deg:g}")
        if self.fov_deg is not None and self.camera is not None:
            raise FlightError("give a camera file or a field of view, not both")
        if self.agl_m is not None and self.ground_alt_m is not None:
            raise FlightError("give a height above ground or an altitude of the ground, not both")
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
        """The offset in nanoseconds."""
        return round(self.time_offset_s * 1e9)
