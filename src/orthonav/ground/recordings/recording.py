"""A recorded flight that is read view by view, how it is read, and doubts about it."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import astuple, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError, UsageError
from orthonav.core.files import with_paths
from orthonav.core.flight.recording import LONG_GAP_NS, RecordedView, fitted
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.camera_files import read_camera_file
from orthonav.core.records import Prior, Telemetry
from orthonav.core.tilt import ASSUMED
from orthonav.ground.recordings.telemetry_track import RecordedTrack, measured

ROLES = ("image", "camera_info", "attitude", "velocity", "position", "height")
MAX_FOV_DEG = 150.0
Grey = NDArray[np.uint8]


@dataclass(frozen=True)
class SourceOptions:
    """How a recording is read. Raises `UsageError` for invalid values."""

    camera: Path | None = None  # camera file; None: the recording's own camera
    rate_hz: float = 1.0  # views per second of a video
    telemetry: Path | None = None  # log to join by time; None: the recording's own telemetry
    time_offset_s: float = 0.0  # added to the times of images to get times of the log, seconds
    mount_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Yaw, pitch, roll of the camera in the body; 0, 0, 0 looks straight down, top forward."""
    topics: Mapping[str, str] = field(default_factory=dict)
    """Topics of ROS, or messages and instances of a log such as GPS[1], by role, one of `ROLES`."""
    prior_std_m: float | None = None
    """Use the recorded position as the prior, with this standard deviation per axis."""
    sensor_width_mm: float | None = None
    """Longer side of the sensor, for the focal length of photographs."""
    ground_alt_m: float | None = None
    """Altitude of the ground, where altitudes but no heights were recorded; in their reference."""
    agl_m: float | None = None  # height above ground of all views, in place of a recorded one
    fov_deg: float | None = None
    """Field of view across the width of the image, where there is no camera file."""
    looks_down: bool = False
    """Whether the camera looked straight down where pitch and roll were not recorded."""
    over_terrain: bool = False
    """Whether a terrain turns the heights of the recording into heights above ground later on."""
    mask: Path | None = None
    """Grey image, 0 where the picture never shows ground; None: it shows ground everywhere."""
    skip_bad_images: bool = False  # whether images that a flight folder names may be missing

    def __post_init__(self) -> None:
        with_paths(self, "camera", "telemetry", "mask")
        for name in ("rate_hz", "prior_std_m", "sensor_width_mm", "agl_m", "fov_deg"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise UsageError(f"{name} must be above 0, got {value}")
        if self.fov_deg is not None and self.fov_deg > MAX_FOV_DEG:
            raise UsageError(f"fov_deg must be at most {MAX_FOV_DEG:g}, got {self.fov_deg:g}")
        if self.fov_deg is not None and self.camera is not None:
            raise UsageError("give a camera file or a field of view, not both")
        if self.agl_m is not None and self.ground_alt_m is not None:
            raise UsageError("give a height above ground or an altitude of the ground, not both")
        numbers = (self.time_offset_s, *self.mount_deg, self.ground_alt_m or 0.0)
        if not all(math.isfinite(number) for number in numbers):
            raise UsageError("give finite numbers as time offset, mount and ground altitude")
        unknown = [role for role in self.topics if role not in ROLES]
        if unknown:
            raise UsageError(f"give topics of {', '.join(ROLES)}, got '{unknown[0]}'")

    @property
    def time_offset_ns(self) -> int:
        return round(self.time_offset_s * 1e9)


@dataclass(frozen=True, eq=False)
class Recording:
    """An open recording: an `orthonav.core.flight.Flight`, with `warnings` for people."""

    kind: str
    path: Path
    camera: Camera
    note: str
    expected: int
    stream: Callable[[], Iterator[RecordedView]]
    warnings: tuple[str, ...] = ()
    choices: tuple[str, ...] = ()
    """What was used where the source has several, by `orthonav.core.flight.chosen`."""
    take_off_latlon_deg: tuple[float, float] | None = None
    """First position of its track, where heights above take-off count from; None: unknown."""

    @property
    def views(self) -> Iterator[RecordedView]:
        return self.stream()


def with_options(
    telemetry: Telemetry, truth_latlon_deg: tuple[float, float] | None, options: SourceOptions
) -> Telemetry:
    """The telemetry with the prior and the level camera that the options ask for.

    A height above ground of 0 was not measured.
    """
    agl_m = telemetry.agl_m if options.agl_m is None else options.agl_m
    telemetry = replace(telemetry, agl_m=measured(agl_m))
    if options.prior_std_m is not None and truth_latlon_deg is not None:
        prior = Prior(*truth_latlon_deg, options.prior_std_m)
        telemetry = replace(telemetry, prior=prior)
    if options.looks_down and math.isnan(telemetry.pitch_deg + telemetry.roll_deg):
        telemetry = replace(telemetry, pitch_deg=0.0, roll_deg=0.0, **ASSUMED.stated(aided=False))
    return telemetry


def rounded(telemetry: Telemetry) -> Telemetry:
    """The telemetry at the precision of a flight folder, so that import changes no result."""
    names = (each.name for each in fields(telemetry) if each.name not in ("time_ns", "below"))
    return replace(telemetry, **{name: _rounded(getattr(telemetry, name)) for name in names})


def _rounded(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(_rounded, value))
    if isinstance(value, Prior):
        return Prior(*map(_rounded, astuple(value)))
    return None if value is None else round(value, 8)


def known_at(
    track: RecordedTrack, time_ns: int, options: SourceOptions
) -> tuple[Telemetry, tuple[float, float] | None]:
    truth = track.latlon_deg(time_ns)
    telemetry = track.telemetry(time_ns, options.ground_alt_m)
    return rounded(with_options(telemetry, truth, options)), truth


def with_mean_velocities(
    views: Iterable[RecordedView], track: RecordedTrack
) -> Iterator[RecordedView]:
    """Views, in order; the velocity of each that follows another after `LONG_GAP_NS` is the mean
    since that one, by the track."""
    before_ns = None
    for view in views:
        now = view.telemetry
        if before_ns is not None and now.vel_en_mps and now.time_ns - before_ns > LONG_GAP_NS:
            mean = track.mean_velocity_en_mps(before_ns, now.time_ns)
            view = replace(view, telemetry=rounded(replace(now, vel_en_mps=mean)))
        before_ns = now.time_ns
        yield view


def time_warnings(times_ns: Iterable[int]) -> list[str]:
    counted = Counter(times_ns)
    equal = sum(count for count in counted.values() if count > 1)
    if not equal:
        return []
    return [
        f"{equal} of {counted.total()} views have the same time as another one: they are in the "
        "order of their names, and a track over them is of little use, because it needs the time "
        "of each"
    ]


def warnings_of(track: RecordedTrack, options: SourceOptions) -> list[str]:
    known = {"agl_m"} if track.heights else set[str]()
    known |= {f"{name}_m" for name in ("home", "amsl", "hae") if getattr(track, name) is not None}
    known |= {"alt_m"} if track.altitude is not None else set()
    return [*track.warnings, *height_warnings(options, known)]


def height_warnings(options: SourceOptions, known: set[str]) -> list[str]:
    """What is assumed about heights above ground where those of the names `known` were recorded."""
    over_terrain = options.over_terrain and not known <= {"alt_m"}
    if options.agl_m is not None or over_terrain:
        return []
    if "home_m" in known:
        gaps = "where none was measured " * ("agl_m" in known)
        return [
            f"height above ground {gaps}is taken from the height above take-off: level ground is "
            "assumed"
        ]
    if "agl_m" in known or "alt_m" not in known:
        return []
    if options.ground_alt_m is None:
        return [
            "no height above ground was recorded, only altitudes, which are not taken for one; "
            "give --ground-alt-m, in the same reference, or --dem to localize and calibrate"
        ]
    return [f"height above ground is the recorded altitude minus {options.ground_alt_m:g} m"]


def given_camera(
    options: SourceOptions, width_px: int, height_px: int, where: str
) -> Camera | None:
    """The camera of the options for images of this size: of a file, or of a field of view."""
    if options.camera is not None:
        return fitted(read_camera_file(options.camera), width_px, height_px, where)
    if options.fov_deg is None:
        return None
    return Camera.from_fov(options.fov_deg, width_px, height_px)


def check_overlap(track: RecordedTrack, first_ns: int, last_ns: int, path: Path) -> None:
    span = track.span_ns()
    if span is None or first_ns > span[1] or last_ns < span[0]:
        recorded = "none" if span is None else f"{span[0] / 1e9:.3f} to {span[1] / 1e9:.3f} s"
        raise FlightError(
            f"images and telemetry do not overlap: images {first_ns / 1e9:.3f} to "
            f"{last_ns / 1e9:.3f} s, telemetry {recorded}; give --time-offset-s: {path}"
        )
