"""Motion of the picture between consecutive images, as seen and as the telemetry reports it.

Both are given as the rotation about the optical axis and the displacement of the centre of the
picture, so that they can be compared. Corners are tracked (Shi and Tomasi 1994; Lucas and Kanade in
a pyramid, Bouguet 2001) in a small picture, independently of the odometry of the localizer.
"""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthonav.core.geo.camera import Camera, undistort

SIDE_PX = 240
"""Longer side of compared images: corners are found to 0.1 px, 0.03 deg for a usual lens."""
MIN_CORNERS = 20
"""Corners that must be found again, and at least half of those sought."""
LONGEST_S = 1.2
"""Images farther apart are not compared."""
TURN_STD_RAD, SHIFT_STD = 0.003, 0.004
"""Least standard deviations of differences: attitudes of autopilots jitter by about 0.1 deg, and
corners are found to 0.1 px where the focal length is 200 px."""
Array = NDArray[np.float64]
Times = NDArray[np.int64]
Grey = NDArray[np.uint8]
Corners = NDArray[np.float32]


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
        if self._before is not None and 0 <= arrived_ns - self._arrived_ns < 80_000_000:
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
        if not 0 < arrived_ns - start_ns <= LONGEST_S * 1e9:
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


class StateHistory:
    def __init__(self, gap_s: float) -> None:
        """`gap_s`: longest interval between states that is interpolated."""
        self._gap_ns = round(gap_s * 1e9)
        self._times: Times = np.zeros(0, np.int64)
        self._rows: Array = np.zeros((0, 13))

    @property
    def newest_ns(self) -> int:
        return int(self._times[-1]) if len(self._times) else -(2**62)

    def add(
        self,
        time_ns: int,
        enu_from_camera: ArrayLike | None,
        velocity_enu_mps: ArrayLike | None,
        height_m: float,
    ) -> None:
        """Add a state; None and NaN: not known. A time that is not newer is ignored."""
        if time_ns <= self.newest_ns:
            return
        row = np.full(13, math.nan)
        if enu_from_camera is not None:
            row[:9] = np.ravel(enu_from_camera)
        if velocity_enu_mps is not None:
            row[9:12] = velocity_enu_mps
        row[12] = height_m if height_m > 0 else math.nan
        first = int(np.searchsorted(self._times, time_ns - 60 * 10**9))
        self._times = np.append(self._times[first:], time_ns)
        self._rows = np.concatenate([self._rows[first:], row[None]])

    def motion(self, start_ns: Times, end_ns: Times) -> ReportedMotion:
        start, end = self._at(start_ns), self._at(end_ns)
        seconds = float(end_ns[0] - start_ns[0]) / 1e9
        velocity, height = (start[:, 9:12] + end[:, 9:12]) / 2, start[:, 12]
        before, after = (each[:, :9].reshape(-1, 3, 3) for each in (start, end))
        return reported_motion(before, after, velocity, height, seconds)

    def _at(self, times_ns: Times) -> Array:
        if len(self._times) < 2:
            return np.full((len(times_ns), 13), math.nan)
        after = np.clip(np.searchsorted(self._times, times_ns), 1, len(self._times) - 1)
        begin, until = self._times[after - 1], self._times[after]
        weight = ((times_ns - begin) / (until - begin))[:, None]
        values = (1 - weight) * self._rows[after - 1] + weight * self._rows[after]
        known = (times_ns >= begin) & (times_ns <= until) & (until - begin <= self._gap_ns)
        return np.asarray(np.where(known[:, None], values, math.nan))


def varying(values: Array, seconds: Array) -> Array:
    """Values (N, K) of durations (N,) without their median rate."""
    rates = np.median(values / seconds[:, None], axis=0)
    return np.asarray(values - rates * seconds[:, None])


def explained_part(seen: Array, off: Array, least: float) -> float:
    """Share of seen motion (N, K) that is explained, without the fifth that fits worst. `off`: seen
    less reported; NaN where neither is at least `least`."""
    seen2, off2 = np.square(seen).sum(axis=1), np.square(off).sum(axis=1)
    modelled2 = np.square(seen - off).sum(axis=1)  # reported motion that is not seen counts too
    used = np.argsort(off2)[: round(0.8 * len(off2))]
    moved = max(float(seen2[used].mean()), float(modelled2[used].mean()))
    left = float(off2[used].mean())
    return 1 - left / moved if moved > least**2 else math.nan
