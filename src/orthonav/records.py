"""The values that cross borders between parts: telemetry, prior, fix, no fix."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from orthonav.geo.camera import Camera

CONFIDENT = 0.9
"""A fix of at least this confidence counts as confident: the default of publishing and reports."""

PRIOR_SIGMAS = 3.0
"""A prior position limits the search to so many of its standard deviations: 1.1 % of a round
Gaussian lies outside."""
DEFAULT_YAW_STD_DEG = 7.0
"""Standard deviation of a reported heading that comes without one: magnetic compasses of the
recorded flights are off by several degrees (docs/tracking.md)."""
MIN_YAW_STD_DEG = 2.0
"""Least deviation of a reported heading that searches allow for."""
TILE_YAW_STD_DEG = 5.0
"""The same default where views are placed by their tiles alone. It differs on purpose: 5 deg make
three headings 6 deg apart, which is what docs/decisions/embedding.md measured; 7 deg would make
five, and change every figure of the embedding alone."""
DEFAULT_AGL_STD = 0.08
"""Standard deviation of a reported height that comes without one, over the height."""

Evidence = Mapping[str, float]
"""Named numbers that say why a fix should be believed or not; see `docs/reference/formats.md`."""


@dataclass(frozen=True)
class Prior:
    """What is known of the position before looking: a round Gaussian.

    `std_m` is the standard deviation per axis in metres; search is cut off at three of them.
    """

    lat_deg: float
    lon_deg: float
    std_m: float


@dataclass(frozen=True)
class Telemetry:
    """What the autopilot knew at the exposure of one view.

    `time_ns` is the time of exposure; `yaw_deg` the heading of the top of the image, clockwise from
    true north; `pitch_deg` and `roll_deg` are 0, 0 where the optical axis points straight down
    (positive pitch looks ahead, positive roll looks left); `agl_m` is the height above ground.
    NaN stands for "not known". Velocities are over ground, true east and north.
    The `_std` ones are standard deviations of what is told, from view to view, None where not
    known: `tilt_std_deg` of pitch and of roll, `vel_std_mps` per axis.
    """

    time_ns: int
    yaw_deg: float
    pitch_deg: float
    roll_deg: float
    agl_m: float
    yaw_std_deg: float | None = None
    agl_std_m: float | None = None
    prior: Prior | None = None
    vel_en_mps: tuple[float, float] | None = None
    tilt_std_deg: float | None = None
    vel_std_mps: float | None = None

    def missing(self) -> list[str]:
        """Names of the fields without which a view cannot be rectified, empty if all are there."""
        named = {
            "yaw_deg": self.yaw_deg,
            "pitch_deg": self.pitch_deg,
            "roll_deg": self.roll_deg,
            "agl_m": self.agl_m,
        }
        return [name for name, value in named.items() if not math.isfinite(value)]


@dataclass(frozen=True, eq=False)
class View:
    """What the camera saw at one exposure, and the telemetry of that time.

    `grey`: grey levels (H, W), uint8, as recorded: not undistorted, not rectified.
    `camera`: calibration of the camera at the size of `grey`.
    `telemetry`: reported heading, tilt, height, velocity and prior position at the exposure.
    """

    grey: NDArray[np.uint8]
    camera: Camera
    telemetry: Telemetry


@dataclass(frozen=True, eq=False)
class Fix:
    """Where a view was taken, and how sure that is.

    `cov_en_m2` is the (2, 2) covariance of east and north in m2; `confidence` the probability that
    the error is below `radius_m`; `heading_deg` and `agl_m` are the values the position rests on.
    """

    lat_deg: float
    lon_deg: float
    cov_en_m2: NDArray[np.float64]
    confidence: float
    radius_m: float
    heading_deg: float
    agl_m: float
    evidence: Evidence = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, eq=False)
class NoFix:
    """No position, and why. A value, not an exception.

    `reason` is a short stable word for programs (such as `blank`, `too_dark`, `outside_map`),
    `detail` one sentence for people.
    """

    reason: str
    detail: str
    evidence: Evidence = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, eq=False)
class ViewResult:
    """What came out for one view of a flight: a line of `fixes.jsonl`.

    `state` is that of the track (`searching`, `tracking`, `lost`), None where views are placed one
    by one.
    """

    frame: str
    time_ns: int
    outcome: Fix | NoFix
    latency_ms: float
    state: str | None = None
