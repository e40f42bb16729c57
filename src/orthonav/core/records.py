"""Telemetry, view, prior, fix, no fix, and how far a fix may be off."""

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import Field, dataclass, field, fields, replace
from typing import Any, ClassVar, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import ArgumentError, FlightError
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.ground import Ground
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
MAX_STD = 1e6  # of what an autopilot reports
MAX_TIME_S = 1e11  # the year 5138; since 1970 there were more milliseconds

Evidence = Mapping[str, float]
"""Named numbers behind the confidence of a fix; see `docs/reference/formats.md`."""


def has_type(name: str, value: Any, expected: type, how: str = "") -> None:
    """Raise `ArgumentError` that names the argument unless it has the type, made by `how`."""
    if not isinstance(value, expected):
        kind = f"an orthonav.{expected.__name__}{how}"
        raise ArgumentError(f"{name} must be {kind}, got {type(value).__name__}")


def number(
    name: str, value: Any, how: str = "a number", least: float = math.nan, most: float = math.inf
) -> float:
    """Raise `ArgumentError` that names the argument unless it is a number, from `least` (NaN: of
    any value, NaN too) to `most`."""
    try:
        found = None if isinstance(value, str | bytes) else float(value)
    except (TypeError, ValueError, OverflowError):
        found = None
    if found is None or not (math.isnan(least) or least <= found <= most):
        raise ArgumentError(f"{name} must be {how}, got {value!r:.40}")
    return found


def _std(name: str, value: Any) -> float | None:
    return None if value is None else number(name, value, "0 or more; None: unknown", 0, MAX_STD)


class ReadOnly(Mapping[str, float]):
    """Unlike a mapping proxy it can be pickled and copied."""

    def __init__(self, values: Mapping[str, float]) -> None:
        self._values = dict(values)

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return repr(self._values)


class ByValue:
    """Compared by fields: arrays by shape and values, NaN equal to NaN."""

    __slots__ = ()
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def _key(self) -> tuple[Any, ...]:
        return tuple(_comparable(getattr(self, each.name)) for each in fields(self))

    def __eq__(self, other: Any) -> bool:
        return type(other) is type(self) and bool(other._key() == self._key())

    def __hash__(self) -> int:
        return hash(self._key())


def _comparable(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if isinstance(value, Mapping):
        return frozenset((name, _comparable(each)) for name, each in value.items())
    if isinstance(value, tuple):
        return tuple(map(_comparable, value))
    return "nan" if value != value else value


@dataclass(frozen=True)
class Prior:
    """The position expected before a search: a round Gaussian.

    `lat_deg` (-90 to 90), `lon_deg` (-360 to 360): its mean, WGS 84. `std_m`: standard deviation
    per axis, m, 0 or more; the search ends at three of them. Raises `ArgumentError`."""

    lat_deg: float
    lon_deg: float
    std_m: float

    def __post_init__(self) -> None:
        place = "-90 to 90, before the longitude"
        numbers = {
            "lat_deg": number("lat_deg", self.lat_deg, place, -90, 90),
            "lon_deg": number("lon_deg", self.lon_deg, "-360 to 360", -360, 360),
            "std_m": number("std_m", self.std_m, "metres, 0 or more", 0),
        }
        for name, value in numbers.items():
            object.__setattr__(self, name, value)

    @classmethod
    def known(cls, *values: float) -> "Prior | None":
        """None where a value is unknown or impossible."""
        try:
            return cls(*values)
        except ArgumentError:
            return None


@dataclass(frozen=True, slots=True, eq=False)
class Telemetry(ByValue):
    """What the autopilot reported for the exposure of one view.

    NaN and None stand for unknown: an optional field that is not finite becomes None. Angles are
    degrees. A view without heading, pitch, roll or height gives a `NoFix`. Raises `ArgumentError`
    without a time and for values of another type.

    - `time_ns`: of the exposure, whole nanoseconds of any clock. `agl_m`: height above ground, m.
    - `yaw_deg`: heading of the top of the picture, clockwise from true north: `heading_deg` of
      `View.of`, which makes records of the arguments that most programs have.
    - `pitch_deg`, `roll_deg`: 0 where the camera looks straight down; ahead and left are positive.
    - `yaw_std_deg`, `agl_std_m`: standard deviations from view to view; None: 7 deg, 8 % of the
      height.
    - `prior`: expected position; None: none. `vel_en_mps`: velocity over ground since the view
      before, true east and north, m/s; `vel_std_mps`: its standard deviation per axis; None: by
      the speed.
    - `tilt_std_deg`: standard deviation of the error of pitch and of roll, mount included; 0: they
      are exact; None: 3 deg. `mount_std_deg`: its constant part, of a mount that was never
      calibrated; None: unknown.
    - `home_m`, `amsl_m`, `hae_m`: height above take-off, mean sea level and the ellipsoid, m, as
      recorded; used with a terrain only, never in place of `agl_m`.
    - `below`: the ground from which `agl_m` was computed by a height above sea, its deviation being
      part of `agl_std_m`; None: `agl_m` was measured."""

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
    mount_std_deg: float | None = None
    vel_std_mps: float | None = None
    home_m: float | None = None
    amsl_m: float | None = None
    hae_m: float | None = None
    below: Ground | None = None

    def __post_init__(self) -> None:
        number("time_ns", self.time_ns, "whole nanoseconds", -MAX_TIME_S * 1e9, MAX_TIME_S * 1e9)
        object.__setattr__(self, "time_ns", int(self.time_ns))
        for name in _NEEDED:
            value: Any = getattr(self, name)
            object.__setattr__(self, name, math.nan if value is None else number(name, value))
        for name in _OPTIONAL:
            value, least = getattr(self, name), 0.0 if "_std_" in name else -math.inf
            if value is None or (isinstance(value, float) and math.isnan(value)):
                object.__setattr__(self, name, None)
                continue
            if name in _RECORDS:
                has_type(name, value, *_RECORDS[name])
                parts = tuple(vars(value).values())
            elif name == "vel_en_mps":
                pair = value if np.shape(value) == (2,) else (str(value), "")
                parts = value = tuple(
                    math.nan if each is None else number(name, each, "a pair, east and north, m/s")
                    for each in pair
                )
            else:
                parts = (value := number(name, value),)
            known = (each is not None and math.isfinite(each) and each >= least for each in parts)
            object.__setattr__(self, name, value if all(known) else None)

    @property
    def horizon_std_deg(self) -> float | None:
        """`tilt_std_deg` without the mount's part."""
        if self.tilt_std_deg is None or self.mount_std_deg is None:
            return self.tilt_std_deg
        return math.sqrt(max(self.tilt_std_deg**2 - self.mount_std_deg**2, 0.0))

    def missing(self) -> list[str]:
        """Names of the fields without which a view cannot be rectified, empty if all are there."""
        return [name for name in _NEEDED if not math.isfinite(getattr(self, name))]


_, *_NEEDED = tuple(each.name for each in fields(Telemetry))[:5]
_OPTIONAL = tuple(each.name for each in fields(Telemetry))[5:]
_RECORDS: dict[str, tuple[type, str]] = {
    "prior": (Prior, "(lat_deg, lon_deg, std_m)"),
    "below": (Ground, ""),
}


@dataclass(frozen=True, eq=False)
class View(ByValue):
    """What the camera saw at one exposure, and the telemetry of that time.

    `grey`: grey levels (H, W), uint8, as recorded: not undistorted, not rectified; copied unless
    read-only. Images of other kinds are converted by `orthonav.core.records.grey_levels`.
    `camera`: calibration of the camera. At another size than that of `grey` it is scaled.
    `telemetry`: reported heading, tilt, height, velocity and prior position at the exposure.

    Raises `FlightError` for what is no image, `CameraError` where the aspect ratios differ."""

    grey: NDArray[np.uint8]
    camera: Camera
    telemetry: Telemetry

    def __post_init__(self) -> None:
        has_type("camera", self.camera, Camera, ", as of Camera.from_matrix(..)")
        has_type("telemetry", self.telemetry, Telemetry)
        grey = np.ascontiguousarray(grey_levels(self.grey))  # a flipped picture is a view of it
        if grey.flags.writeable:  # a caller may use its memory for the next picture
            grey = grey.copy()
            grey.flags.writeable = False
        object.__setattr__(self, "grey", grey)
        object.__setattr__(self, "camera", self.camera.fitted(grey.shape[1], grey.shape[0]))

    @classmethod
    def of(
        cls,
        image: NDArray[Any] | None,
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
        """A view of an image and of what was reported at its exposure.

        `image`: (H, W) grey, (H, W, 3) BGR, (H, W, 4) BGRA; uint8, uint16 (white is 65535) or
        floating point (0 to 1, or 0 to 255). `camera`: of its size or proportions. `agl_m`: height
        above ground, m. `heading_deg`: of the top of the image, clockwise from true north; None:
        unknown. `pitch_deg`, `roll_deg`: 0 for a camera that looks straight down, positive ahead
        and left. `time_s`: of the exposure, seconds of any clock. `prior`: used by a `Tracker`;
        None: none. `vel_en_mps`: velocity over ground since the view before, east and north, m/s.

        Standard deviations, 0 or more, of heading (None: 7 deg), height (None: 8 % of it), and of
        pitch and of roll, by their source (docs/flights.md; None: 3 deg): on a map without terrain
        3 deg place the camera to 3 % of the height, 1 deg to 1.6 %.

        Raises `ArgumentError`, `FlightError` for what is no image, `CameraError` where image and
        camera have different proportions."""
        time_s = number("time_s", time_s, "in seconds, not ms or ns", -MAX_TIME_S, MAX_TIME_S)
        telemetry = Telemetry(
            round(time_s * 1e9),
            math.nan if heading_deg is None else number("heading_deg", heading_deg),
            number("pitch_deg", pitch_deg),
            number("roll_deg", roll_deg),
            number("agl_m", agl_m),
            yaw_std_deg=_std("heading_std_deg", heading_std_deg),
            agl_std_m=_std("agl_std_m", agl_std_m),
            prior=prior,
            vel_en_mps=vel_en_mps,
            tilt_std_deg=_std("tilt_std_deg", tilt_std_deg),
        )
        made = cls(grey_levels(image), camera, telemetry)
        made.camera.plausible()
        return made

    def __repr__(self) -> str:
        reported = self.telemetry
        return (
            f"View({self.camera.width_px} x {self.camera.height_px} px, heading "
            f"{reported.yaw_deg:.1f} deg, {reported.agl_m:.1f} m above ground)"
        )


class Result(ByValue):
    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON by the keys of `fixes.jsonl` (docs/reference/formats.md), of a
        `Fix` or `NoFix` without those of the flight (name, time, ..); None: unknown."""
        from orthonav.core.flight.fixes import to_plain  # it reads and makes records

        return to_plain(self)


class Outcome(Result):
    """Its `evidence` is read-only."""

    evidence: Evidence

    def __post_init__(self) -> None:
        object.__setattr__(self, "evidence", ReadOnly(self.evidence))


class TelemetryBias(NamedTuple):
    """Constant errors of the telemetry that a fix estimates, to be added to it, and their
    standard deviations: deg, and the logarithm of the scale. NaN: unknown."""

    heading_bias_deg: float = math.nan
    log_scale_bias: float = math.nan
    pitch_bias_deg: float = math.nan
    roll_bias_deg: float = math.nan
    heading_bias_std_deg: float = math.nan
    log_scale_bias_std: float = math.nan
    pitch_bias_std_deg: float = math.nan
    roll_bias_std_deg: float = math.nan


UNKNOWN_BIAS = TelemetryBias()


@dataclass(frozen=True, eq=False)
class Fix(Outcome):
    """The position from which a view was taken, with its uncertainty.

    - `lat_deg`, `lon_deg`: WGS 84. `cov_en_m2` (2, 2): covariance of east and north, m2, of a
      correct fix.
    - `confidence`: probability that the error is below `radius_m`, 0..1; NaN where the map was not
      calibrated.
    - `heading_deg` (0..360, of the top of the image) and `agl_m` (m): estimated, or as reported
      where the method does not estimate them.
    - `evidence`: the numbers behind the confidence, for people, such as `score` and `strength` of a
      registration; all keys are in docs/reference/formats.md.
    - `ground_latlon_deg`: latitude and longitude of the ground that the middle of the picture
      shows; `ground_cov_en_m2` (2, 2): covariance of its east and north, m2; None: unknown.
    - `pitch_deg`, `roll_deg`: of the camera, estimated; as reported where `pose_cov` is None.
    - `pose_cov` (6, 6): covariance of metres east, north and up and degrees of heading, pitch and
      roll; None where the six were not estimated together.
    - `place_probability`: that the place is right, 0..1, whatever the error there; NaN where the
      method states only a confidence, which is then used for it.
    - `vel_en_mps`: velocity over ground of a track, east, north, m/s; `vel_std_mps`: its standard
      deviation along the worst direction; None and NaN: unknown.
    - `recognized`: probability that this view of a track shows the map, NaN: unknown.
    - `bias`: of the telemetry, by a track or by the camera of one view.
    - `heading_std_deg`, `log_scale_std`: standard deviations of heading and of the logarithm of the
      height by the registration of one view, NaN: unknown."""

    lat_deg: float
    lon_deg: float
    cov_en_m2: NDArray[np.float64]
    confidence: float
    radius_m: float
    heading_deg: float
    agl_m: float
    evidence: Evidence = field(default_factory=dict)
    ground_latlon_deg: tuple[float, float] | None = None
    ground_cov_en_m2: NDArray[np.float64] | None = None
    pitch_deg: float = math.nan
    roll_deg: float = math.nan
    pose_cov: NDArray[np.float64] | None = None
    place_probability: float = math.nan
    vel_en_mps: tuple[float, float] | None = None
    vel_std_mps: float = math.nan
    recognized: float = math.nan
    bias: TelemetryBias = UNKNOWN_BIAS
    heading_std_deg: float = math.nan
    log_scale_std: float = math.nan

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
        limit_m = max(number("limit_m", limit_m, "metres"), 0.0)
        return probability_within(self.right_probability, self.cov_en_m2, limit_m)

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

    @property
    def known_velocity_en_mps(self) -> tuple[float, float] | None:
        """`vel_en_mps` where both are finite."""
        velocity = self.vel_en_mps
        return velocity if velocity is not None and np.isfinite(velocity).all() else None

    def __repr__(self) -> str:
        return (
            f"Fix({self.lat_deg:.6f}, {self.lon_deg:.6f}, std {self.std_m:.1f} m, confidence "
            f"{self.confidence:.2f}, heading {self.heading_deg:.1f} deg)"
        )

    def tilt_deg(self, telemetry: Telemetry) -> tuple[float, float]:
        """Pitch and roll of the camera of a view with this telemetry: those of the fix, else the
        reported ones with the biases that the fix states."""
        pitch, roll = (
            stated if math.isfinite(stated) else reported + (bias if math.isfinite(bias) else 0.0)
            for stated, reported, bias in (
                (self.pitch_deg, telemetry.pitch_deg, self.bias.pitch_bias_deg),
                (self.roll_deg, telemetry.roll_deg, self.bias.roll_bias_deg),
            )
        )
        return pitch, roll


@dataclass(frozen=True, eq=False)
class NoFix(Outcome):
    """No position, and why. A value, not an exception.

    `reason` is a short stable word for programs (such as `blank`, `too_dark`, `outside_map`),
    `detail` one sentence for people."""

    reason: str
    detail: str
    evidence: Evidence = field(default_factory=dict)

    @property
    def is_confident(self) -> Literal[False]:
        return False

    def __repr__(self) -> str:
        return f"NoFix({self.reason}: {self.detail})"


@dataclass(frozen=True, eq=False)
class ViewResult(Result):
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
    if isinstance(image, str | os.PathLike):
        raise FlightError(f"the image is a path, read it first, as by cv2.imread; {EXPECTED}")
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


# Integrity: errors of right places have heavier tails than a Gaussian of the stated covariance.
# They follow a bivariate Student distribution (docs/decisions/integrity.md).

Array = NDArray[np.float64]
ERROR_DEGREES = 5.0
"""Degrees of freedom of the distribution of errors."""
BISECTIONS = 40  # 1e-12 of the interval
_QUADRANT = np.cos((np.arange(16) + 0.5) * np.pi / 32) ** 2


def probability_beyond(cov_en_m2: Array, limit_m: float) -> float:
    """That the error of a right place exceeds a limit; NaN for an unknown covariance."""
    if not np.isfinite(cov_en_m2).all():
        return math.nan
    return float(_beyond(_scales_m2(np.asarray(cov_en_m2)[None]), np.array([limit_m]))[0])


def probability_within(place_probability: float, cov_en_m2: Array, limit_m: float) -> float:
    """That a place is right and its error at most a limit; NaN for an unknown covariance."""
    return place_probability * (1 - probability_beyond(cov_en_m2, limit_m))


def protection_level_m(place_probability: float, cov_en_m2: Array, risk: float) -> float:
    """Smallest limit that the error exceeds with a probability of at most `risk`.

    `place_probability`: that the place is right. Infinite where a wrong place alone is likelier
    than that, and for an unknown covariance. Raises `ArgumentError` unless `risk` is 0 to 1."""
    place, covs = np.array([place_probability]), np.asarray(cov_en_m2)[None]
    return float(protection_levels_m(place, covs, risk)[0])


def protection_levels_m(place_probability: Array, covs_en_m2: Array, risk: float) -> Array:
    """The same (N,) of many: probabilities (N,) and covariances (N, 2, 2)."""
    number("risk", risk, "a probability, 0 to 1", 0, 1)
    levels = np.full(len(place_probability), math.inf)
    finite = np.isfinite(covs_en_m2).all(axis=(1, 2)) & (risk - (1 - place_probability) > 0)
    place, scales = place_probability[finite], _scales_m2(covs_en_m2[finite])
    allowed = np.minimum((risk - (1 - place)) / place, 1.0)
    deviations = np.sqrt(ERROR_DEGREES * (allowed ** (-2 / ERROR_DEGREES) - 1))
    low, high = (np.sqrt(each(axis=1)) * deviations for each in (scales.min, scales.max))
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        met = _beyond(scales, middle) <= allowed
        low, high = np.where(met, low, middle), np.where(met, middle, high)
    levels[finite] = high
    return levels


def _scales_m2(covs_en_m2: Array) -> Array:
    """Squared scales (N, 16) of errors along directions that are equally likely."""
    values = np.maximum(np.linalg.eigvalsh(covs_en_m2), 0.0)[:, :, None]
    minor, major = values[:, 0], values[:, 1]
    return np.asarray((minor + (major - minor) * _QUADRANT) * (ERROR_DEGREES - 2) / ERROR_DEGREES)


def _beyond(scales_m2: Array, limits_m: Array) -> Array:
    """Probability (N,) that errors of these scales (N, 16) exceed their limits (N,)."""
    squares = limits_m[:, None] ** 2 / (ERROR_DEGREES * np.maximum(scales_m2, 1e-12))
    return np.asarray(((1 + squares) ** (-ERROR_DEGREES / 2)).mean(axis=1))
