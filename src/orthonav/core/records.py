"""Telemetry, view, prior, fix, no fix."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.ground import Ground
from orthonav.core.integrity import probability_within, protection_level_m
from orthonav.core.limits import DEFAULT_RISK
from orthonav.core.tilt import UNSTATED

CONFIDENT = 0.9  # from this confidence on: the default of publishing and reports
PRIOR_SIGMAS = 3.0  # the search ends there: 1.1 % of a round Gaussian lies outside
DEFAULT_YAW_STD_DEG = 7.0
"""Magnetic compasses of the recorded flights are off by several degrees (docs/tracking.md)."""
MIN_YAW_STD_DEG = 2.0  # the least that searches allow for
TILE_YAW_STD_DEG = 5.0  # of tiles alone: three headings 6 deg apart (docs/decisions/embedding.md)
DEFAULT_AGL_STD = 0.08  # over the height
DEFAULT_TILT_STD_DEG = UNSTATED.aided_deg
RADIUS_SHARE = 0.025  # least radius of the confidence over the height: an error of 1.4 deg of tilt
MAP_STD_M = 3.0  # per axis, of a displacement of the map as a whole: it never averages out

Evidence = Mapping[str, float]
"""Named numbers behind the confidence of a fix; see `docs/reference/formats.md`."""


@dataclass(frozen=True)
class Prior:
    """The position expected before a search: a round Gaussian.

    `lat_deg`, `lon_deg`: its mean, WGS 84. `std_m`: standard deviation per axis, m, 0 or more; the
    search ends at `PRIOR_SIGMAS` of them."""

    lat_deg: float
    lon_deg: float
    std_m: float


@dataclass(frozen=True, slots=True)
class Telemetry:
    """What the autopilot reported for the exposure of one view. NaN and None stand for unknown: an
    optional field that is not finite becomes None."""

    time_ns: int  # time of exposure, ns
    yaw_deg: float  # heading of the top of the picture, clockwise from true north
    pitch_deg: float  # 0 where the optical axis points straight down; positive looks ahead
    roll_deg: float  # 0 where the optical axis points straight down; positive looks left
    agl_m: float  # height above ground, above 0
    yaw_std_deg: float | None = None
    """Standard deviation of the heading from view to view; `DEFAULT_YAW_STD_DEG` where None."""
    agl_std_m: float | None = None
    """The same of the height; `DEFAULT_AGL_STD` of the height where None."""
    prior: Prior | None = None  # expected position
    vel_en_mps: tuple[float, float] | None = None
    """Velocity over ground since the view before, true east and north."""
    tilt_std_deg: float | None = None
    """Standard deviation of the error of pitch and of roll, mount included; 0: they are exact.
    `DEFAULT_TILT_STD_DEG` where None."""
    mount_std_deg: float | None = None
    """Its part that is constant: of a mount that was never calibrated; None: not known."""
    vel_std_mps: float | None = None
    """Standard deviation of the velocity per axis; see `orthonav.core.track.tracker`."""
    home_m: float | None = None
    """Height above the place of take-off, as recorded; it is not used in place of `agl_m`."""
    amsl_m: float | None = None  # height above mean sea level, as recorded
    hae_m: float | None = None  # height above the ellipsoid of WGS 84, as recorded
    below: Ground | None = None
    """The ground from which `agl_m` was computed by a height above sea; None where it was measured.
    Its deviation is part of `agl_std_m`."""

    def __post_init__(self) -> None:
        prior, below = self.prior, self.below
        optional: dict[str, tuple[float | None, ...]] = {
            "yaw_std_deg": (self.yaw_std_deg,),
            "agl_std_m": (self.agl_std_m,),
            "prior": () if prior is None else (prior.lat_deg, prior.lon_deg, prior.std_m),
            "vel_en_mps": () if self.vel_en_mps is None else self.vel_en_mps,
            "tilt_std_deg": (self.tilt_std_deg,),
            "mount_std_deg": (self.mount_std_deg,),
            "vel_std_mps": (self.vel_std_mps,),
            "home_m": (self.home_m,),
            "amsl_m": (self.amsl_m,),
            "hae_m": (self.hae_m,),
            "below": () if below is None else (below.height_m, below.std_m, below.known),
        }
        for name, values in optional.items():
            is_std, known = "_std_" in name, [each for each in values if each is not None]
            if not all(math.isfinite(each) and not (is_std and each < 0) for each in known):
                object.__setattr__(self, name, None)

    @property
    def horizon_std_deg(self) -> float | None:
        """`tilt_std_deg` without the mount's part."""
        if self.tilt_std_deg is None or self.mount_std_deg is None:
            return self.tilt_std_deg
        return math.sqrt(max(self.tilt_std_deg**2 - self.mount_std_deg**2, 0.0))

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

    `grey`: grey levels (H, W), uint8, as recorded: not undistorted, not rectified. Images of other
    kinds are converted by `orthonav.core.records.grey_levels`.
    `camera`: calibration of the camera. At another size than that of `grey` it is scaled.
    `telemetry`: reported heading, tilt, height, velocity and prior position at the exposure.

    Raises `FlightError` for what is no image, `CameraError` where the aspect ratios differ."""

    grey: NDArray[np.uint8]
    camera: Camera
    telemetry: Telemetry

    def __post_init__(self) -> None:
        grey = np.ascontiguousarray(grey_levels(self.grey))  # a flipped picture is a view of it
        object.__setattr__(self, "grey", grey)
        object.__setattr__(self, "camera", self.camera.fitted(grey.shape[1], grey.shape[0]))

    @classmethod
    def of(
        cls,
        image: NDArray[Any],
        camera: Camera,
        *,
        agl_m: float,
        heading_deg: float | None = None,
        pitch_deg: float = 0.0,
        roll_deg: float = 0.0,
        time_s: float = 0.0,
        prior: Prior | None = None,
        heading_std_deg: float | None = None,
        agl_std_m: float | None = None,
        tilt_std_deg: float | None = None,
        vel_en_mps: tuple[float, float] | None = None,
    ) -> "View":
        """A view of an image (H, W), (H, W, 3) BGR or (H, W, 4), see
        `orthonav.core.records.grey_levels`.

        `agl_m`: height above ground. `heading_deg`: of the top of the image, clockwise from true
        north; None: unknown. `pitch_deg`, `roll_deg`: 0 for a camera that looks straight down.
        `tilt_std_deg`: their standard deviation, by the source (docs/flights.md); None: 3 deg,
        which on a map without terrain places the camera to 3 % of the height, 1 deg to 1.6 %.
        `time_s`: of the exposure. The standard deviations are those of `Telemetry`."""
        heading = math.nan if heading_deg is None else float(heading_deg)
        return cls(
            image,
            camera,
            Telemetry(
                round(time_s * 1e9),
                heading,
                float(pitch_deg),
                float(roll_deg),
                float(agl_m),
                yaw_std_deg=heading_std_deg,
                agl_std_m=agl_std_m,
                prior=prior,
                vel_en_mps=vel_en_mps,
                tilt_std_deg=tilt_std_deg,
            ),
        )

    def __repr__(self) -> str:
        reported = self.telemetry
        return (
            f"View({self.camera.width_px} x {self.camera.height_px} px, heading "
            f"{reported.yaw_deg:.1f} deg, {reported.agl_m:.1f} m above ground)"
        )


@dataclass(frozen=True, eq=False)
class Fix:
    """The position from which a view was taken, with its uncertainty.

    `lat_deg`, `lon_deg`: WGS 84. `cov_en_m2` (2, 2): covariance of east and north, m2, of a correct
    fix. `confidence`: probability that the error is below `radius_m`, 0..1, NaN where the map was
    not calibrated. `heading_deg` (0..360) and `agl_m`: estimated, or as reported where the method
    does not estimate them. `evidence`: the numbers behind the confidence."""

    lat_deg: float
    lon_deg: float
    cov_en_m2: NDArray[np.float64]
    confidence: float
    radius_m: float
    heading_deg: float
    agl_m: float
    evidence: Evidence = field(default_factory=lambda: MappingProxyType({}))
    ground_latlon_deg: tuple[float, float] | None = None
    """Ground that the middle of the picture shows."""
    ground_cov_en_m2: NDArray[np.float64] | None = None
    """Covariance (2, 2) of its east and north, m2."""
    pitch_deg: float = math.nan
    """Pitch and roll of the camera, estimated; as reported where `pose_cov` is None."""
    roll_deg: float = math.nan
    pose_cov: NDArray[np.float64] | None = None
    """Covariance (6, 6) of metres east, north and up and degrees of heading, pitch and roll; None
    where the six were not estimated together."""
    place_probability: float = math.nan
    """Probability that the place is right, whatever the error there; NaN where the method states
    only a confidence, which is then used for it."""

    @property
    def is_confident(self) -> bool:
        """Whether the position may be relied on: a confidence of `CONFIDENT` or more."""
        return self.confidence >= CONFIDENT

    @property
    def std_m(self) -> float:
        """Standard deviation of the position along the worst direction, m; NaN where unknown."""
        return error_ellipse(self.cov_en_m2)[0]

    def probability_within(self, limit_m: float) -> float:
        """Probability that the error is at most `limit_m`; NaN where the confidence is unknown."""
        return probability_within(self.right_probability, self.cov_en_m2, max(limit_m, 0.0))

    def with_covariance(self, cov_en_m2: NDArray[np.float64]) -> "Fix":
        """With another one (2, 2), m2, and the confidence that follows from it."""
        made = replace(self, cov_en_m2=cov_en_m2)
        within = made.probability_within(self.radius_m)
        known = math.isfinite(self.place_probability) and math.isfinite(within)
        return replace(made, confidence=within) if known else made

    def protection_level_m(self, risk: float = DEFAULT_RISK) -> float:
        """The smallest limit that the error exceeds with a probability of at most `risk`, m.

        Infinite where the place alone is wrong with a higher one, or nothing is known of it."""
        return protection_level_m(self.right_probability, self.cov_en_m2, risk)

    @property
    def right_probability(self) -> float:
        """`place_probability`, or the confidence where it is unknown."""
        known = math.isfinite(self.place_probability)
        return self.place_probability if known else self.confidence

    def __repr__(self) -> str:
        return (
            f"Fix({self.lat_deg:.6f}, {self.lon_deg:.6f}, std {self.std_m:.1f} m, confidence "
            f"{self.confidence:.2f}, heading {self.heading_deg:.1f} deg)"
        )

    def tilt_deg(self, telemetry: Telemetry) -> tuple[float, float]:
        """Pitch and roll of the camera of a view with this telemetry: those of the fix, else the
        reported ones with the biases that the fix states."""
        pitch, roll = (
            stated if math.isfinite(stated) else reported + _finite(self.evidence.get(bias))
            for stated, reported, bias in (
                (self.pitch_deg, telemetry.pitch_deg, "pitch_bias_deg"),
                (self.roll_deg, telemetry.roll_deg, "roll_bias_deg"),
            )
        )
        return pitch, roll


def _finite(value: float | None) -> float:
    return value if value is not None and math.isfinite(value) else 0.0


@dataclass(frozen=True, eq=False)
class NoFix:
    """No position, and why. A value, not an exception.

    `reason` is a short stable word for programs (such as `blank`, `too_dark`, `outside_map`),
    `detail` one sentence for people."""

    reason: str
    detail: str
    evidence: Evidence = field(default_factory=lambda: MappingProxyType({}))

    is_confident = False

    def __repr__(self) -> str:
        return f"NoFix({self.reason}: {self.detail})"


@dataclass(frozen=True, eq=False)
class ViewResult:
    """The result for one view of a flight: a line of `fixes.jsonl`.

    `frame`: name of the view. `time_ns`: its exposure. `outcome`: the fix, or why there is none.
    `latency_ms`: time from picture to outcome, NaN where it was not processed. `state`: of the
    track (`searching`, `tracking`, `coasting`, `lost`), None where views are localized one by one.
    `accepted`: whether a fix met the criterion of `--accept` or `--alert-limit-m`, None where none
    was given. `risk`: of the protection level that the line states."""

    frame: str
    time_ns: int
    outcome: Fix | NoFix
    latency_ms: float
    state: str | None = None
    accepted: bool | None = None
    risk: float = DEFAULT_RISK

    @property
    def is_confident(self) -> bool:
        """Whether the position may be relied on; any other fix is the best guess."""
        if not isinstance(self.outcome, Fix):
            return False
        return self.outcome.is_confident if self.accepted is None else self.accepted

    @property
    def is_recognized(self) -> bool:
        """Whether it is confident, and not of a track that searches, coasts or is lost."""
        return self.is_confident and self.state in (None, "tracking")


EXPECTED = (
    "expected (H, W) grey, (H, W, 3) BGR or (H, W, 4) BGRA; uint8, uint16 (white is 65535) or "
    "floating point (0 to 1, or 0 to 255)"
)


def grey_levels(image: Any) -> NDArray[np.uint8]:
    """Grey levels (H, W) uint8 of a grey, BGR or BGRA image; uint8 grey is returned as it is.

    uint16 counts to 65535, floating point to 1 where no value is above 1, else to 255. Pictures
    that use a small part of 16 bits, as of thermal cameras, are stretched (`stretched`). Raises
    `FlightError`."""
    if isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.ndim == 2 and image.size:
        return image
    if image is None:
        raise FlightError(f"the image is None, as of a file that could not be read; {EXPECTED}")
    array = np.asarray(image)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    colour = array.ndim == 3 and array.shape[2] in (3, 4)
    if not (array.ndim == 2 or colour) or array.size == 0:
        raise FlightError(f"the image has the shape {array.shape}; {EXPECTED}")
    if not colour:
        return _levels(array)
    levels = np.ascontiguousarray(_levels(array[:, :, :3]))
    return np.asarray(cv2.cvtColor(levels, cv2.COLOR_BGR2GRAY))


def _levels(array: NDArray[Any]) -> NDArray[np.uint8]:
    if array.dtype == np.uint8:
        return array
    if array.dtype.kind == "u" and array.dtype.itemsize == 2:
        array = array.astype(np.uint16, copy=False)  # of either byte order
        low, high = spread(array)
        if high - low < NARROW_COUNTS:
            return stretched(array, (low, high), LEAST_COUNTS)
        return (array >> 8).astype(np.uint8)
    if array.dtype.kind not in "iuf":
        raise FlightError(f"the image has values of type {array.dtype}; {EXPECTED}")
    low, high = float(array.min()), float(array.max())
    if not (low >= 0 and high <= 255):  # NaN too
        raise FlightError(f"the image has values of {low:g} to {high:g}; {EXPECTED}")
    scale = 255.0 if array.dtype.kind == "f" and high <= 1 else 1.0
    return np.rint(array * scale).astype(np.uint8)


STRETCHED_PERCENT = 0.5, 99.5  # as those of orthophotos
SAMPLED_PX = 1_000_000
NO_VALUE = 9999.0  # such values, and greater ones, stand for unknown ones in files
NARROW_COUNTS, LEAST_COUNTS = 8192.0, 512.0
"""Values of 16 bits that span less than the first are stretched: 12 and 14 bits, temperatures. As
if they spanned the second where they span less, so that noise does not look like ground."""


def spread(array: NDArray[Any]) -> tuple[float, float]:
    """Ends of measured values (H, W) or (H, W, C), but for a few; NaN where none is finite."""
    step = max(1, round(math.sqrt(array.size / SAMPLED_PX)))
    sample = array[::step, ::step]
    known = sample[np.isfinite(sample)]
    if known.size == 0:
        return math.nan, math.nan
    low, high = np.percentile(known, STRETCHED_PERCENT).tolist()
    return low, high


def stretched(array: NDArray[Any], ends: tuple[float, float], least: float) -> NDArray[np.uint8]:
    """Grey levels of values, dark to bright between the ends of their `spread`, or as if they
    spanned `least`. What is not finite counts as their middle; all is dark where nothing is."""
    if math.isnan(ends[0]):
        return np.zeros(array.shape, np.uint8)
    span, middle = max(ends[1] - ends[0], least), (ends[0] + ends[1]) / 2
    levels = (array.astype(np.float32) - np.float32(middle)) * np.float32(255 / span) + 127.5
    levels = np.nan_to_num(levels, nan=127.5, posinf=255.0, neginf=0.0)
    return np.asarray(np.rint(levels.clip(0, 255)), np.uint8)


_ROUNDING = 1e-9  # negative eigenvalues up to this fraction of the largest are rounding errors


def error_ellipse(cov_en: NDArray[np.float64]) -> tuple[float, float, float]:
    """Semi-major and semi-minor axis (1 sigma), and direction of the major one, 0..180 deg from
    north.

    NaN where the (2, 2) covariance is not finite or has a negative eigenvalue."""
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
