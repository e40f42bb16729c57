"""Motion of the picture between consecutive images, as seen and as the telemetry reports it.

Both are given as the rotation about the optical axis and the displacement of the centre of the
picture, so that they can be compared, in flight by `MotionCheck`. Corners are tracked (Shi and
Tomasi 1994; Lucas and Kanade in a pyramid, Bouguet 2001) in a small picture, independently of the
odometry of the localizer.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.attitude import LOOKS_DOWN, Angles, enu_from_body_camera
from orthonav.core.geo.camera import Camera, undistort
from orthonav.core.track.filter import usual_velocity_std_mps
from orthonav.onboard.telemetry import VehicleState

SIDE_PX = 240
"""Longer side of compared images: corners are found to 0.1 px, 0.03 deg for a usual lens."""
MIN_CORNERS = 20
"""Corners that must be found again, and at least half of those sought."""
TURN_STD_RAD, SHIFT_STD = 0.003, 0.004
"""Least standard deviations of differences: attitudes of autopilots jitter by about 0.1 deg, and
corners are found to 0.1 px where the focal length is 200 px."""
WINDOW_S, MIN_PAIRS = 4.0, 12
"""Pairs of so many seconds are compared with the report, at least so many."""
MIN_EXPLAINED = 0.6
"""Fraction of the motion common to images and report from which they agree."""
SUMMED, SIGMAS = 4, 3.0
"""Successive pairs that are summed; their motion counts from so many least standard deviations."""
Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
Corners = NDArray[np.float32]


@dataclass(frozen=True)
class PairInterval:
    """Time between two images that are compared."""

    min_s: float = 0.08  # closer ones are skipped
    max_s: float = 1.2  # images farther apart are not compared


PAIR_INTERVAL = PairInterval()


@dataclass(frozen=True, eq=False)
class ImageMotion:
    """Of images that arrived at `start_ns` and `end_ns`. `turn_rad`: rotation of the picture about
    the optical axis, clockwise in the image. `shift` (2,): displacement of the centre, right and
    down, in units of the focal length."""

    start_ns: int
    end_ns: int
    turn_rad: float
    shift: Array

    @property
    def seconds(self) -> float:
        return (self.end_ns - self.start_ns) / 1e9


class PictureOdometry:
    def __init__(self) -> None:
        self._before: Grey | None = None
        self._arrived_ns = 0
        self._corners: Corners | None = None

    def motion(self, grey: Grey, camera: Camera, arrived_ns: int) -> ImageMotion | None:
        """Motion since the image before; None where it is too close, too far away, or differs."""
        min_ns = PAIR_INTERVAL.min_s * 1e9
        if self._before is not None and 0 <= arrived_ns - self._arrived_ns < min_ns:
            return None
        share = min(1.0, SIDE_PX / max(grey.shape))
        size = (max(8, round(grey.shape[1] * share)), max(8, round(grey.shape[0] * share)))
        small = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
        small = _evened(small)
        before, corners, start_ns = self._before, self._corners, self._arrived_ns
        self._before, self._arrived_ns = small, arrived_ns
        fitted = camera.resized(size[0], size[1])
        self._corners = _corners(small, fitted.mask)
        if before is None or corners is None or before.shape != small.shape:
            return None
        if not 0 < arrived_ns - start_ns <= PAIR_INTERVAL.max_s * 1e9:
            return None
        pairs = _tracked(before, small, corners)
        if pairs is None:
            return None
        return _motion(*pairs, fitted, start_ns, arrived_ns)


def _evened(grey: Grey) -> Grey:
    """Brightness and contrast evened within squares: of an exposure that varies by 5 %, 65 % of the
    pairs were found without it, 99 % with it (benchmarks.faults)."""
    square = (41, 41)
    varying = np.asarray(grey, np.float32)
    varying = varying - cv2.blur(varying, square)
    contrast = np.sqrt(cv2.blur(np.square(varying), square))
    scaled = 128 + 25 * varying / np.maximum(contrast, 2.0)
    return np.asarray(np.clip(scaled, 0, 255), np.uint8)


def _corners(grey: Grey, mask: Grey | None) -> Corners | None:
    """Where the mask of the camera shows ground; its rim is an edge that does not move."""
    if mask is not None:
        mask = np.asarray(cv2.erode(mask, np.ones((9, 9), np.uint8), borderValue=255), np.uint8)
    found: Any = cv2.goodFeaturesToTrack(grey, 90, 0.02, SIDE_PX / 30, mask=mask, blockSize=5)
    return None if found is None else np.asarray(found, np.float32)


def _tracked(before: Grey, now: Grey, corners: Corners) -> tuple[Corners, Corners] | None:
    """Corners (N, 2) in both images; None where too few are found again. Tracked forth and back,
    one must return within half a pixel (Kalal et al., 2010)."""
    options = {"winSize": (17, 17), "maxLevel": 3}
    # The stubs of OpenCV require the argument that is None.
    ahead, found, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, None, **options)  # type: ignore[call-overload]
    back, returned, _ = cv2.calcOpticalFlowPyrLK(now, before, ahead, None, **options)  # type: ignore[call-overload]
    off = np.abs(back - corners).reshape(-1, 2).max(axis=1)
    good = (found.ravel() == 1) & (returned.ravel() == 1) & (off < 0.5)
    if good.sum() < max(MIN_CORNERS, 0.5 * len(corners)):
        return None
    return corners.reshape(-1, 2)[good], ahead.reshape(-1, 2)[good]


def _motion(
    start_px: Corners, end_px: Corners, camera: Camera, start_ns: int, end_ns: int
) -> ImageMotion | None:
    focal_px = math.sqrt(camera.fx_px * camera.fy_px)
    start, end = _plane(start_px, camera), _plane(end_px, camera)
    sound = np.isfinite(start).all(axis=1) & np.isfinite(end).all(axis=1)
    if sound.sum() < MIN_CORNERS:
        return None
    cv2.setRNGSeed(0)  # the same images give the same motion
    found, inliers = cv2.findHomography(start[sound], end[sound], cv2.RANSAC, 1.0 / focal_px)
    if found is None or inliers.sum() < max(MIN_CORNERS, 0.5 * len(start_px)):
        return None
    turn, shift = centre_motion(np.asarray(found, np.float64)[None])
    if not np.isfinite(turn[0] + shift[0].sum()):
        return None
    return ImageMotion(start_ns, end_ns, float(turn[0]), shift[0])


def _plane(px: Corners, camera: Camera) -> Array:
    # OpenCV's pixels count from pixel centres.
    middle = np.array([camera.cx_px, camera.cy_px]) - 0.5
    return undistort(camera, (px - middle) / [camera.fx_px, camera.fy_px])


def centre_motion(homographies: Array) -> tuple[Array, Array]:
    """Rotation (N,) and displacement (N, 2) of the centre by homographies (N, 3, 3)."""
    below = homographies[:, 2, 2]
    shift = homographies[:, :2, 2] / below[:, None]
    jacobian = homographies[:, :2, :2] - shift[:, :, None] * homographies[:, 2:, :2]
    jacobian = jacobian / below[:, None, None]
    turn = np.arctan2(jacobian[:, 1, 0] - jacobian[:, 0, 1], jacobian[:, 0, 0] + jacobian[:, 1, 1])
    return np.asarray(turn), np.asarray(shift)


ReportedMotion = tuple[Array, Array, Array]
"""Motion of the picture by the reported state for N pairs of times; NaN where not known: its turn
(N,) in rad by the attitudes, and the velocity where known; its shift (N, 2) by the attitudes alone;
that by the velocity over flat ground."""


def reported_motion(
    start_enu: Array, end_enu: Array, velocity: Array, height_m: Array, seconds: float
) -> ReportedMotion:
    """Motion over flat ground from attitudes `start_enu` to `end_enu` (N, 3, 3), which rotate from
    camera axes to east, north, up, with the mean `velocity` (N, 3) in m/s east, north, up, from
    `height_m` (N,) above ground. NaN where a value is not known or the camera looks too far ahead.
    """
    turned = np.einsum("nji,njk->nik", end_enu, start_enu)
    down = -start_enu[:, 2, 2]
    turned = np.where((down > 0.3)[:, None, None], turned, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        turn, tilt_shift = centre_motion(turned)
        # A ground point at the ray r of the first camera lies at height / -r_up along it.
        moved = np.einsum("nji,nj->ni", end_enu, velocity) * (seconds / height_m)[:, None]
        ground_up = -start_enu[:, 2, :]
        both = turned - moved[:, :, None] * ground_up[:, None, :]
        turn_of_both, shift = centre_motion(both)
    turn = np.where(np.isfinite(turn_of_both), turn_of_both, turn)
    return turn, tilt_shift, shift - tilt_shift


def varying(values: Array, seconds: Array) -> Array:
    """Values (N, K) of durations (N,) without their median rate."""
    rates = np.median(values / seconds[:, None], axis=0)
    return np.asarray(values - rates * seconds[:, None])


def explained_part(seen: Array, off: Array, least: float, least_off: float = 0.0) -> float:
    """Share of seen motion (N, K) that is explained, without the fifth that fits worst. `off`: seen
    less reported; NaN where neither is at least `least`, or `off` is less than `least_off`."""
    seen2, off2 = np.square(seen).sum(axis=1), np.square(off).sum(axis=1)
    modelled2 = np.square(seen - off).sum(axis=1)  # reported motion that is not seen counts too
    used = np.argsort(off2)[: round(0.8 * len(off2))]
    moved = max(float(seen2[used].mean()), float(modelled2[used].mean()))
    left = float(off2[used].mean())
    return 1 - left / moved if moved > least**2 and left >= least_off**2 else math.nan


class Compared(NamedTuple):
    """Whether images move as reported, steady turns apart, and whether they move otherwise: neither
    where little moved. `is_reported`: the aircraft moved by the report."""

    agree: bool = False
    contradict: bool = False
    is_reported: bool = False


class MotionCheck:
    """Compares the motion of the images of the last seconds with the report. Mutable."""

    def __init__(
        self, delay_s: float, mount_deg: Angles = LOOKS_DOWN, *, heading_known: bool = True
    ) -> None:
        """`delay_s`: from exposure to arrival. `heading_known`: the heading gives that of the
        velocity."""
        self._delay_ns, self._mount_deg = round(delay_s * 1e9), mount_deg
        self._heading_known = heading_known
        self.clear()

    def clear(self) -> None:
        self.odometry = PictureOdometry()
        self._waiting: deque[ImageMotion] = deque(maxlen=100)
        self._rows: deque[tuple[int, Array]] = deque(maxlen=100)

    def add(
        self,
        arrived_ns: int,
        grey: Grey,
        camera: Camera,
        state_at: Callable[[int], VehicleState],
        covered_ns: int,
    ) -> None:
        """Add an image; its motion counts once states are known, to `covered_ns`, at its end."""
        motion = self.odometry.motion(grey, camera, arrived_ns)
        if motion is not None:
            self._waiting.append(motion)
        while self._waiting and self._waiting[0].end_ns - self._delay_ns <= covered_ns:
            row = self._row(self._waiting[0], state_at)
            end_ns = self._waiting.popleft().end_ns
            if np.isfinite(row[:7]).all():
                self._rows.append((end_ns, row))
        while self._rows and self._rows[0][0] < self._rows[-1][0] - WINDOW_S * 1e9:
            self._rows.popleft()

    def _row(self, seen: ImageMotion, state_at: Callable[[int], VehicleState]) -> Array:
        """Seconds; turn and shift (2) as seen; turn, shift by the attitude (2), shift by the
        velocity (2) and height (m) as reported: (10,)."""
        start, end = (state_at(each - self._delay_ns) for each in (seen.start_ns, seen.end_ns))
        velocity = (_velocity(start) + _velocity(end)) / 2
        height_m = np.array([start.height_m if start.height_m > 0 else math.nan])
        poses = self._enu_from_camera(start)[None], self._enu_from_camera(end)[None]
        reported = reported_motion(*poses, velocity[None], height_m, seen.seconds)
        turn, tilt, shift = (each[0] for each in reported)
        return np.array([seen.seconds, seen.turn_rad, *seen.shift, turn, *tilt, *shift, *height_m])

    def _enu_from_camera(self, state: VehicleState) -> Array:
        turn = state.ned_from_body
        if turn is None:
            return np.full((3, 3), math.nan)
        return enu_from_body_camera(turn, self._mount_deg)

    @property
    def is_filled(self) -> bool:
        return len(self._rows) >= MIN_PAIRS

    def compared(self) -> Compared:
        if not self.is_filled:
            return Compared()
        pairs = np.array([row for _, row in self._rows])
        unknown = ~np.isfinite(pairs).all(axis=1)  # without the velocity only turns can be compared
        pairs[np.ix_(unknown, [2, 3, 5, 6, 7, 8])] = 0.0
        pairs = _sound(pairs)
        # Sums over successive pairs: jitter of the attitudes cancels, motion adds up.
        rows = np.lib.stride_tricks.sliding_window_view(pairs, SUMMED, axis=0).sum(axis=-1)
        seconds, seen_turn, reported_turn = rows[:, 0], rows[:, 1:2], rows[:, 4:5]
        tilt, velocity = rows[:, 5:7], rows[:, 7:9]
        turn_off, by_velocity = seen_turn - reported_turn, rows[:, 2:4] - tilt
        # The constant part of the shift depends on height and heading, which may be off.
        shift = varying(rows[:, 2:4], seconds), varying(by_velocity - velocity, seconds)
        reported_shift = varying(tilt + velocity, seconds)
        min_turn, min_shift = SIGMAS * TURN_STD_RAD, SIGMAS * SHIFT_STD
        turning = varying(seen_turn, seconds), varying(turn_off, seconds)
        mps = np.median(pairs[:, 9]) / rows[:, :1]
        contradict = (
            explained_part(seen_turn, turn_off, min_turn) < 0.4
            # Errors of pitch and roll of PX4 without GNSS made up to 0.0143 (docs/closed-loop.md).
            or explained_part(*shift, min_shift, least_off=0.016) < MIN_EXPLAINED
            or self._differs(mps * by_velocity, mps * velocity)
        )
        explained = explained_part(*turning, min_turn), explained_part(*shift, min_shift)
        agree = not contradict and bool(np.fmin(*explained) >= MIN_EXPLAINED)
        turned2 = np.square(reported_turn).mean()
        shifted2 = np.square(reported_shift).sum(axis=1).mean()
        return Compared(agree, contradict, bool(turned2 > min_turn**2 or shifted2 > min_shift**2))

    def _differs(self, seen: Array, reported: Array) -> bool:
        """Whether velocities (N, 2) in m/s differ by more than errors of the reported one, and of
        height and heading, which make the speed 0.4 to 2.5 times as large."""
        seen, reported = np.median(seen, axis=0), np.median(reported, axis=0)
        speed, seen_speed = (float(np.hypot(*each)) for each in (reported, seen))
        along = float(seen @ reported) / speed if self._heading_known and speed else seen_speed
        usual = SIGMAS * usual_velocity_std_mps(speed)
        return min(speed, abs(along - speed)) > usual and not 0.4 < along / speed < 2.5


def _velocity(state: VehicleState) -> Array:
    north, east, down = state.velocity_ned_mps
    return np.array([east, north, -down])


def _sound(pairs: Array) -> Array:
    """Pairs (N, 10) without the worst, up to a tenth, beyond 6 standard deviations."""
    off = np.concatenate([pairs[:, 1:2] - pairs[:, 4:5], pairs[:, 2:4] - pairs[:, 5:7]], axis=1)
    off[:, 1:] -= pairs[:, 7:9]
    off = np.abs(off - np.median(off, axis=0))
    least = np.array([TURN_STD_RAD, SHIFT_STD, SHIFT_STD])
    worst = (off / np.maximum(least, 1.4826 * np.median(off, axis=0))).max(axis=1)
    limit = max(6.0, float(np.sort(worst)[-math.ceil(0.1 * len(pairs)) - 1]))
    return np.asarray(pairs[worst <= limit])
