"""Input of all messages: one position at one exposure. Unknown values, NaN or None, never become a
number that looks like a measurement."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import OrthonavError
from orthonav.core.records import CONFIDENT, Fix, ViewResult, error_ellipse


class EstimateError(OrthonavError, ValueError):
    """An estimate is invalid, or the requested message cannot represent it."""


@dataclass(frozen=True, eq=False)
class NavigationEstimate:
    """Position of the aircraft at one exposure."""

    lat_deg: float
    lon_deg: float
    cov_en_m2: NDArray[np.float64]  # (2, 2) of east and north, given that the fix is correct
    confidence: float  # 0 to 1; NaN: not known
    time_ns: int  # of exposure, by a steady clock
    utc_ns: int | None = None  # of exposure; None: not known
    processing_s: float = 0.0  # from exposure until the message is sent
    alt_amsl_m: float = math.nan  # above mean sea level; NaN: not known
    alt_std_m: float = math.nan
    vel_en_mps: tuple[float, float] | None = None  # over ground, true east and north
    vel_cov_en: NDArray[np.float64] | None = None  # (2, 2)
    state: str | None = None  # of the track; None for views that are located one by one
    reset_counter: int = 0  # 0 to 255; changes when the position jumped
    protection_level_m: float = math.inf
    """The error exceeds it with the risk of the result; infinite: not known."""
    accepted: bool = True  # whether it met a criterion beside the rules of the gate
    min_confidence: float = CONFIDENT
    """From which on it is confident, by the rules of the gate that admitted it."""

    def __post_init__(self) -> None:
        if not (abs(self.lat_deg) <= 90 and abs(self.lon_deg) <= 180):  # NaN too
            raise EstimateError(
                f"a position needs a latitude within 90 and a longitude within 180 degrees, "
                f"got {self.lat_deg}, {self.lon_deg}"
            )
        invalid = {
            "covariance": np.shape(self.cov_en_m2) != (2, 2),
            "covariance of the velocity": self.vel_cov_en is not None
            and np.shape(self.vel_cov_en) != (2, 2),
            "confidence": self.confidence < 0 or self.confidence > 1,  # NaN: not known
            "processing time": not math.isfinite(self.processing_s),
            "standard deviation of the altitude": self.alt_std_m < 0,
            "reset counter": not 0 <= self.reset_counter <= 255,
        }
        for name, applies in invalid.items():
            if applies:
                raise EstimateError(f"the {name} of an estimate is out of range")

    @property
    def stamp_ns(self) -> int:
        """UTC of exposure, which messages state; raises `EstimateError` where it is not known."""
        if self.utc_ns is None:
            raise EstimateError("the UTC time of exposure is not known")
        return self.utc_ns

    @property
    def sent_ns(self) -> int:
        """UTC of sending; raises as `stamp_ns`."""
        return self.stamp_ns + round(self.processing_s * 1e9)

    def horizontal_std_m(self) -> float:
        """Standard deviation along the worst direction; NaN where the covariance is invalid.

        Filters that take one number use it for both axes (PX4 squares it into both variances), so a
        smaller one would be too optimistic along the long axis.
        """
        return error_ellipse(self.cov_en_m2)[0]

    @property
    def is_confident(self) -> bool:
        """Whether it is confident, with a valid covariance, and of no track or one that tracks."""
        return (
            self.confidence >= self.min_confidence  # False for NaN
            and self.state in (None, "tracking")
            and not math.isnan(self.horizontal_std_m())
        )

    def require_confident(self, message: str) -> None:
        """Raise `EstimateError` unless it is confident, as `message` cannot mark it."""
        if not self.is_confident:
            raise EstimateError(
                f"{message} cannot mark a position of low confidence (confidence "
                f"{self.confidence:.3g}, state {self.state}, standard deviation "
                f"{self.horizontal_std_m():.3g} m): do not send it"
            )


def estimate_from_result(
    result: ViewResult, *, utc_ahead_ns: int = 0, processing_s: float | None = None
) -> NavigationEstimate | None:
    """Estimate of the fix of a view; None where there is no fix.

    `utc_ahead_ns`: UTC minus the clock of `result.time_ns`.
    `processing_s`: time from exposure to sending; by default the latency of the fix, without the
    latency of the camera.
    """
    fix = result.outcome
    if not isinstance(fix, Fix):
        return None
    if processing_s is None:
        processing_s = result.latency_ms / 1e3 if math.isfinite(result.latency_ms) else 0.0
    velocity, velocity_cov = None, None
    if result.state is not None:  # of a track, which reports the deviation of the worst direction
        velocity = fix.known_velocity_en_mps
        velocity_cov = np.eye(2) * fix.vel_std_mps**2 if math.isfinite(fix.vel_std_mps) else None
    return NavigationEstimate(
        lat_deg=fix.lat_deg,
        lon_deg=fix.lon_deg,
        cov_en_m2=fix.cov_en_m2,
        confidence=fix.confidence,
        time_ns=result.time_ns,
        utc_ns=result.time_ns + utc_ahead_ns,
        processing_s=processing_s,
        vel_en_mps=velocity,
        vel_cov_en=velocity_cov,
        state=result.state,
        protection_level_m=fix.protection_level_m(result.risk),
        accepted=result.accepted is not False,
    )


def floored(cov: NDArray[np.float64], min_std: float) -> NDArray[np.float64]:
    """Symmetric covariance (N, N) with a standard deviation of at least `min_std` everywhere."""
    values, vectors = np.linalg.eigh(cov / 2 + cov.T / 2)
    return np.asarray((vectors * np.maximum(values, min_std**2)) @ vectors.T)


def messages_averaged(interval_s: float, averaging_s: float = 3.0) -> float:
    """Number of messages, 1 or more, that a receiver averages.

    Errors of consecutive fixes (of the map, the tilt, the track) last longer than the filters of
    autopilots average (docs/decisions/correlated-errors.md): a receiver that takes n of them as
    independent claims n times too small a variance.

    `interval_s`: since the message before; infinite for the first. After a clock was set back it
    counts as infinite.
    """
    return max(averaging_s / interval_s, 1.0) if interval_s > 0 else 1.0


def for_filter(
    estimate: NavigationEstimate, interval_s: float, min_std_m: float = 0.0
) -> NavigationEstimate:
    """The estimate with the covariance that makes the claim of a receiving filter right.

    `min_std_m`: lower bound of the standard deviation. An invalid covariance stays as it is.
    """
    if math.isnan(estimate.horizontal_std_m()):
        return estimate
    cov = floored(estimate.cov_en_m2, min_std_m)
    return replace(estimate, cov_en_m2=cov * messages_averaged(interval_s))


@dataclass
class FilterCovariance:
    """Prepares the estimates of several messages, each by its own rate. Mutable."""

    min_std_m: float = 0.0
    _sent_ns: dict[str, int] = field(default_factory=dict)

    def interval_s(self, message: str, exposed_ns: int) -> float:
        before = self._sent_ns.get(message)
        return math.inf if before is None else (exposed_ns - before) / 1e9

    def prepare(
        self, message: str, estimate: NavigationEstimate, exposed_ns: int
    ) -> NavigationEstimate:
        """The estimate for a `message` with an exposure at `exposed_ns` of a steady clock."""
        return for_filter(estimate, self.interval_s(message, exposed_ns), self.min_std_m)

    def sent(self, message: str, exposed_ns: int) -> None:
        self._sent_ns[message] = exposed_ns
