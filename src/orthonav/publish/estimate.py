"""What an autopilot is told: one position at one exposure, how good it is, and when it was.

The values of a `ViewResult` in the form that every message is made from. What is not known is NaN
or None here and becomes "not known" in the message, never a number that looks like a measurement.
"""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import OrthonavError
from orthonav.records import CONFIDENT, Fix, ViewResult

_ROUNDING = 1e-9
"""Share by which an eigenvalue may fall below zero before a covariance is no covariance."""


class EstimateError(OrthonavError, ValueError):
    """An estimate is impossible, or cannot be said in the message that was asked for."""


class Clock(Enum):
    """Whose time goes into a message. A link keeps to one: receivers learn its offset."""

    UTC = "utc"
    """Since 1970-01-01 UTC."""
    BOOT = "boot"
    """Since the autopilot was switched on, as it told (TIMESYNC, or the time of its messages)."""


@dataclass(frozen=True, eq=False)
class NavigationEstimate:
    """Where the aircraft was at one exposure.

    `cov_en_m2` is the (2, 2) covariance of east and north of a right fix; that the fix may be wrong
    altogether is not in it but in `confidence` (0 to 1, NaN: not known). `agl_m` is the height
    above ground, `alt_amsl_m` the altitude above mean sea level with its standard deviation
    `alt_std_m`; `heading_deg` that of the top of the image, clockwise from true north; each NaN
    where not known. `vel_en_mps` is the velocity over ground, true east and north, with its
    covariance where that is known. `state` is that of the track, None for views placed one by one.
    `utc_ns` and `boot_ns` are the time of exposure, `processing_s` what has passed from then until
    the message is handed over. `reset_counter` (0 to 255) changes whenever the position jumped.

    Raises `EstimateError` where a position, a covariance's shape, a confidence, a deviation, a
    duration or the counter is impossible, or no time is told.
    """

    lat_deg: float
    lon_deg: float
    cov_en_m2: NDArray[np.float64]
    confidence: float
    utc_ns: int | None = None
    boot_ns: int | None = None
    processing_s: float = 0.0
    agl_m: float = math.nan
    alt_amsl_m: float = math.nan
    alt_std_m: float = math.nan
    vel_en_mps: tuple[float, float] | None = None
    vel_cov_en: NDArray[np.float64] | None = None
    heading_deg: float = math.nan
    state: str | None = None
    reset_counter: int = 0

    def __post_init__(self) -> None:
        if not (abs(self.lat_deg) <= 90 and abs(self.lon_deg) <= 180):  # NaN too
            raise EstimateError(
                f"a position needs a latitude within 90 and a longitude within 180 degrees, "
                f"got {self.lat_deg}, {self.lon_deg}"
            )
        for name, cov in (("cov_en_m2", self.cov_en_m2), ("vel_cov_en", self.vel_cov_en)):
            if cov is not None and np.shape(cov) != (2, 2):
                raise EstimateError(f"{name} must be two by two, got {np.shape(cov)}")
        if not (math.isnan(self.confidence) or 0 <= self.confidence <= 1):
            raise EstimateError(f"confidence must be 0 to 1 or NaN, got {self.confidence:g}")
        if not math.isfinite(self.processing_s):
            raise EstimateError(f"processing_s must be finite, got {self.processing_s}")
        if self.alt_std_m < 0:
            raise EstimateError(f"alt_std_m must not be negative, got {self.alt_std_m:g}")
        if not 0 <= self.reset_counter <= 255:
            raise EstimateError(f"reset_counter must be 0 to 255, got {self.reset_counter}")
        if self.utc_ns is None and self.boot_ns is None:
            raise EstimateError("the time of exposure is told neither in UTC nor since boot")

    def exposed_ns(self, clock: Clock) -> int:
        """Time of exposure by `clock`; raises `EstimateError` where that one is not known."""
        time_ns = self.utc_ns if clock is Clock.UTC else self.boot_ns
        if time_ns is None:
            raise EstimateError(f"the time of exposure is not known by the clock {clock.value!r}")
        return time_ns

    def sent_ns(self, clock: Clock) -> int:
        """Time at which the message is handed over: exposure and what has passed since."""
        return self.exposed_ns(clock) + round(self.processing_s * 1e9)

    def horizontal_std_m(self, min_std_m: float = 0.0) -> float:
        """Standard deviation to tell as *the* horizontal one: that along the worst direction.

        The square root of the larger eigenvalue of the covariance, and `min_std_m` at least.
        Filters that take one number use it for both axes (PX4 squares it into the variance of
        each), so anything smaller claims too much along the long axis. NaN where the covariance is
        not known or is none.
        """
        major = error_ellipse(self.cov_en_m2)[0]
        return major if math.isnan(major) else max(major, min_std_m)

    def is_confident(self, min_confidence: float = CONFIDENT) -> bool:
        """Whether this may be told as a position.

        Confident enough (an unknown confidence is not), with a covariance, and tracking where it
        comes from a track.
        """
        return (
            self.confidence >= min_confidence  # False for NaN
            and self.state in (None, "tracking")
            and not math.isnan(self.horizontal_std_m())
        )


def estimate_from_result(
    result: ViewResult,
    *,
    clock: Clock = Clock.UTC,
    utc_minus_boot_ns: int | None = None,
    processing_s: float | None = None,
    alt_amsl_m: float = math.nan,
    alt_std_m: float = math.nan,
    reset_counter: int = 0,
) -> NavigationEstimate | None:
    """The estimate that a view's fix stands for; None where there is no fix.

    `result.time_ns` is the time of exposure by `clock`; with `utc_minus_boot_ns` the other clock's
    follows. `processing_s` is the time from exposure to handing over, by default the latency of the
    fix alone: add what reading the camera took. The altitude and its standard deviation are the
    autopilot's own, if it should hear them back; a fix has none. The velocity is that of a track.
    """
    fix = result.outcome
    if not isinstance(fix, Fix):
        return None
    if processing_s is None:
        processing_s = result.latency_ms / 1e3 if math.isfinite(result.latency_ms) else 0.0
    utc_ns, boot_ns = _both_clocks(result.time_ns, clock, utc_minus_boot_ns)
    return NavigationEstimate(
        lat_deg=fix.lat_deg,
        lon_deg=fix.lon_deg,
        cov_en_m2=fix.cov_en_m2,
        confidence=fix.confidence,
        utc_ns=utc_ns,
        boot_ns=boot_ns,
        processing_s=processing_s,
        agl_m=fix.agl_m,
        alt_amsl_m=alt_amsl_m,
        alt_std_m=alt_std_m,
        vel_en_mps=_velocity(fix) if result.state is not None else None,
        vel_cov_en=_velocity_covariance(fix) if result.state is not None else None,
        heading_deg=fix.heading_deg,
        state=result.state,
        reset_counter=reset_counter,
    )


def error_ellipse(cov_en: NDArray[np.float64]) -> tuple[float, float, float]:
    """One-sigma ellipse of a (2, 2) covariance of east and north.

    The half axes, the longer first, in the root of the covariance's unit, and the direction of the
    longer one in degrees clockwise from north, 0 to 180. All NaN where the covariance is not finite
    or has a negative eigenvalue.
    """
    cov = np.asarray(cov_en, dtype=np.float64)
    if not np.isfinite(cov).all():
        return math.nan, math.nan, math.nan
    values, vectors = np.linalg.eigh(cov / 2 + cov.T / 2)
    if values[0] < -_ROUNDING * abs(values[1]) or values[1] < 0:
        return math.nan, math.nan, math.nan
    east, north = vectors[:, 1]
    direction_deg = math.degrees(math.atan2(east, north)) % 180.0 % 180.0  # -1e-20 gives 180
    minor, major = np.sqrt(np.maximum(values, 0.0)).tolist()
    return major, minor, direction_deg


def _both_clocks(
    time_ns: int, clock: Clock, utc_minus_boot_ns: int | None
) -> tuple[int | None, int | None]:
    if clock is Clock.UTC:
        return time_ns, None if utc_minus_boot_ns is None else time_ns - utc_minus_boot_ns
    return None if utc_minus_boot_ns is None else time_ns + utc_minus_boot_ns, time_ns


def _velocity(fix: Fix) -> tuple[float, float] | None:
    east = fix.evidence.get("vel_east_mps", math.nan)
    north = fix.evidence.get("vel_north_mps", math.nan)
    return (east, north) if math.isfinite(east) and math.isfinite(north) else None


def _velocity_covariance(fix: Fix) -> NDArray[np.float64] | None:
    """Of a track, which tells the standard deviation along the worst direction."""
    std_mps = fix.evidence.get("vel_std_mps", math.nan)
    return np.eye(2) * std_mps**2 if math.isfinite(std_mps) else None
