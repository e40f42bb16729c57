"""The camera: lens, attitude, and where it looks on flat ground.

Camera axes: x to the right of the image, y down the image, z along the optical axis.
Attitude: with heading, pitch and roll 0 the optical axis points straight down and the top of the
image to the north. Heading turns clockwise from above; then, as for an aircraft (yaw, pitch, roll,
Tait-Bryan Z-Y-X in the forward-right-down body), positive pitch makes the camera look ahead and
positive roll makes it look left.

Lenses in the camera plane, as OpenCV writes them. Brown (1966), "Decentering distortion of lenses":
three radial and two tangential numbers. Fisheye: Kannala and Brandt (2006), "A generic camera model
and calibration method", with four numbers of the angle off the optical axis."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError
from orthonav.core.files import StrPath, path_of

Array = NDArray[np.float64]
FOV_STD = 0.05  # of the focal length by a stated field of view, relative
ENU_FROM_NED = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])


@dataclass(frozen=True)
class Camera:
    """A camera: pinhole with Brown distortion, or fisheye.

    Focal lengths and principal point in pixels, measured from the outer corner of the first pixel
    (pixel-is-area: its centre is 0.5, 0.5). With `model` "brown", `distortion` is empty or
    k1, k2, p1, p2[, k3]; with "fisheye" (equidistant) it is empty or k1, k2, k3, k4; both as in
    OpenCV. `focal_std` is the standard deviation of the focal length as a share of it, 0 to 0.5; 0
    for a calibrated camera. `mask` (H, W), see `masked`, is no part of comparisons. `unusual`: a
    principal point more than a tenth of a side from the middle (a crop, a shifted lens), pixels
    that are not square, or a focal length below 0.3 or above 20 widths are meant; without it files
    and views with them are refused. Raises `CameraError` on values no camera has."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()
    model: str = "brown"
    focal_std: float = 0.0
    mask: NDArray[np.uint8] | None = field(default=None, compare=False, repr=False)
    unusual: bool = False

    def __post_init__(self) -> None:
        try:
            lens = tuple(map(float, () if self.distortion is None else self.distortion))
        except (TypeError, ValueError) as error:
            raise CameraError(f"camera distortion must be numbers: {self}") from error
        object.__setattr__(self, "distortion", lens if any(lens) else ())  # none is faster
        if wrong := self._impossible():
            raise CameraError(f"camera {wrong}: {self}")
        for name in ("width_px", "height_px"):
            object.__setattr__(self, name, int(getattr(self, name)))
        for name in ("fx_px", "fy_px", "cx_px", "cy_px", "focal_std"):  # those of NumPy are no JSON
            object.__setattr__(self, name, float(getattr(self, name)))

    def _impossible(self) -> str:
        mask, size = self.mask, (self.width_px, self.height_px)
        is_fisheye = self.model == "fisheye"
        names = "k1,k2,k3,k4" if is_fisheye else "k1,k2,p1,p2[,k3]"
        if not all(_is_finite(side) and side == int(side) and 1 <= side < 2**16 for side in size):
            return "width_px and height_px must be whole, 1 to 65535"
        if mask is not None and (mask.dtype != np.uint8 or mask.shape != size[::-1]):
            got = f"got {mask.dtype} of {mask.shape[::-1]}"
            return f"mask must be uint8 of {size}, as Camera.masked makes it, {got}"
        for name in ("fx_px", "fy_px", "cx_px", "cy_px", "focal_std"):
            if not _is_finite(getattr(self, name)):
                return f"{name} is not finite"
        if not all(map(_is_finite, self.distortion)):
            return "distortion is not finite"
        if self.fx_px <= 0 or self.fy_px <= 0:
            return "focal length must be above 0 px"
        if not 0 <= self.focal_std <= 0.5:
            return "focal_std must be a fraction, 0 to 0.5"
        if self.model not in ("brown", "fisheye"):
            return f"model must be brown or fisheye, got '{self.model}'"
        known = len(self.distortion) in ((0, 4) if is_fisheye else (0, 4, 5))
        return "" if known else f"distortion of a {self.model} lens must be empty or {names}"

    def plausible(self) -> "Camera":
        """The camera itself. Raises `CameraError` where it is of a wrong file or unit, by shares of
        sides, which remain where a picture is scaled."""
        if wrong := self._implausible():
            raise CameraError(f"camera {wrong}: {self}")
        return self

    def _implausible(self) -> str:
        fx, fy, wide, high = self.fx_px, self.fy_px, self.width_px, self.height_px
        off = max(abs(self.cx_px / wide - 0.5), abs(self.cy_px / high - 0.5))
        apart = abs(fx / fy - 1)
        if self.unusual:
            return ""
        if max(fx / wide, fy / high) < 0.3 or min(fx / wide, fy / high) > 20:
            far = f"focal length {fx:g} px is {fx / wide:.2g} widths, expected 0.3 to 20 "
            return far + '("unusual": true states another one)'
        if off > 0.1:
            middle = f"principal point {self.cx_px:g}, {self.cy_px:g} px is {off:.0%} of a side "
            return middle + 'from the middle ("unusual": true states a crop or a shifted lens)'
        if apart > 0.05 + 2 / min(wide, high):  # sides are rounded
            differ = f"focal lengths {fx:g} and {fy:g} px differ by {apart:.0%} "
            return differ + '("unusual": true states pixels that are not square)'
        return ""

    @classmethod
    def from_fov(
        cls, fov_deg: float, width_px: int, height_px: int, *, diagonal: bool = False
    ) -> "Camera":
        """A camera without distortion by its field of view in degrees, 2.9 to about 125.

        It is that across the width of the picture; with `diagonal` that from corner to corner, as
        makers of cameras often state it. Stated fields of view are often those of the lens or of
        another mode: good to 5 %. Raises `CameraError`."""
        # 2.9 deg is that of a focal length of 20 widths; 2.9 radians are 166 deg.
        if not all(map(_is_finite, (width_px, height_px))):
            raise CameraError(f"size must be numbers, got {width_px!r:.40}, {height_px!r:.40}")
        if not (_is_finite(fov_deg) and 2.9 <= fov_deg < 180):
            is_angle = _is_finite(fov_deg) and fov_deg > 0
            turned = f"; {math.degrees(fov_deg):.1f} if these are radians" if is_angle else ""
            raise CameraError(f"field of view must be 2.9 to 180 deg, got {fov_deg!r:.40}{turned}")
        across_px = math.hypot(width_px, height_px) if diagonal else width_px
        focal_px = across_px / 2 / math.tan(math.radians(fov_deg) / 2)
        middle_px = width_px / 2, height_px / 2
        made = cls(width_px, height_px, focal_px, focal_px, *middle_px, focal_std=FOV_STD)
        return made.plausible()

    @classmethod
    def from_matrix(
        cls,
        matrix: Array,
        distortion: Sequence[float] | None,
        size_px: tuple[int, int],
        model: str = "brown",
        *,
        unusual: bool = False,
    ) -> "Camera":
        """A camera by the matrix (3, 3) in pixels and the distortion of OpenCV's calibration.

        OpenCV counts cx and cy from the centre of the first pixel; 0.5 is added, because `cx_px`
        and `cy_px` count from its corner. `distortion`: k1, k2, p1, p2[, k3], of a "fisheye"
        `model` k1 to k4; None: none. `size_px`: width and height of the images that it was
        calibrated with. `unusual`: see `Camera`. Raises `CameraError`."""
        try:
            k = np.asarray(matrix, np.float64)
            more = () if distortion is None else np.ravel(np.asarray(distortion, np.float64))
        except (TypeError, ValueError) as error:
            raise CameraError(f"camera matrix and distortion must be numbers: {error}") from error
        if k.shape != (3, 3):
            raise CameraError(f"camera matrix must be (3, 3), got {k.shape}")
        if np.shape(size_px) != (2,):
            raise CameraError(f"size_px must be width and height, got {size_px!r:.40}")
        if k[0, 2] == k[1, 2] == 0 and k[2, :2].any():
            raise CameraError(
                "camera matrix is transposed (its last row is "
                f"{k[2, 0]:g}, {k[2, 1]:g}, {k[2, 2]:g}), as MATLAB writes it; transpose it, and "
                "subtract 1 from cx and cy if they are MATLAB's, which counts pixels from 1"
            )
        if abs(k[0, 1]) > 1e-3 * abs(k[0, 0]) or k[1, 0] or k[2].tolist() != [0, 0, 1]:
            raise CameraError(
                f"camera matrix must be fx 0 cx, 0 fy cy, 0 0 1, without skew, got {k.tolist()}"
            )
        # OpenCV counts from the centre of the first pixel.
        numbers = (float(k[0, 0]), float(k[1, 1]), float(k[0, 2]) + 0.5, float(k[1, 2]) + 0.5)
        return cls(*size_px, *numbers, tuple(more), model, unusual=unusual).plausible()

    @classmethod
    def from_file(cls, path: StrPath) -> "Camera":
        """The camera of a `flight.json`, or of a calibration of OpenCV (YAML, XML, JSON), ROS or
        Kalibr (YAML; `FILE#cam1` is one of several).

        Raises `MissingFileError`, `CameraError` or `MissingExtraError`."""
        from orthonav.core.geo.camera_files import read_camera_file  # the readers make cameras

        return read_camera_file(path_of(path, "camera file"))

    def masked(self, mask: NDArray[Any]) -> "Camera":
        """The camera whose pixels never show ground where `mask` (H, W) is 0, as behind landing
        gear or text in the picture. A mask of another size is scaled."""
        shown = np.asarray(np.where(np.asarray(mask) > 0, 255, 0), np.uint8)
        if shown.ndim != 2 or not shown.any():
            raise CameraError(
                f"mask must be grey (H, W), 0 where no ground is seen, got {shown.shape}, "
                f"{np.count_nonzero(shown)} pixels above 0"
            )
        fitted = replace(self.fitted(shown.shape[1], shown.shape[0]), mask=shown)
        return fitted.resized(self.width_px, self.height_px)

    def numbers(self) -> dict[str, Any]:
        """All but the mask, as in `flight.json`."""
        left_out = ("mask",) if self.unusual else ("mask", "unusual")
        return {name: each for name, each in vars(self).items() if name not in left_out}

    @property
    def is_pinhole(self) -> bool:
        return self.model == "brown" and not self.distortion

    @property
    def matrix(self) -> Array:
        """`px_from_camera`, (3, 3), without distortion."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    @property
    def extent(self) -> tuple[float, float]:
        """Width and height seen straight ahead, per metre of distance."""
        return self.width_px / self.fx_px, self.height_px / self.fy_px

    def gsd_m(self, agl_m: float) -> float:
        """Ground resolution in metres per pixel of a vertical view from `agl_m`."""
        return agl_m / math.sqrt(self.fx_px * self.fy_px)

    def fitted(self, width_px: int, height_px: int) -> "Camera":
        """The camera for images of this size.

        Raises `CameraError` where the aspect ratio differs: then the image is an unknown crop, not
        a scaled version of the same view."""
        if (self.width_px, self.height_px) == (width_px, height_px):
            return self
        apart = abs(self.height_px * width_px - height_px * self.width_px)
        if apart > max(self.width_px, width_px):
            raise CameraError(
                f"camera is {self.width_px} x {self.height_px} px, the image is {width_px} x "
                f"{height_px} px, a size with another aspect ratio; calibrate in that mode"
            )
        return self.resized(width_px, height_px)

    def resized(self, width_px: int, height_px: int) -> "Camera":
        """The camera of the same picture resampled to another size."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        mask = self.mask
        if mask is not None and mask.shape != (height_px, width_px):
            size = width_px, height_px
            scaled = cv2.resize(mask, size, interpolation=cv2.INTER_AREA)
            mask = np.asarray(np.where(scaled == 255, 255, 0), np.uint8)  # wholly of ground
        return replace(
            self,
            mask=mask,
            width_px=width_px,
            height_px=height_px,
            fx_px=self.fx_px * sx,
            fy_px=self.fy_px * sy,
            cx_px=self.cx_px * sx,
            cy_px=self.cy_px * sy,
        )


def _is_finite(value: Any) -> bool:
    try:
        return math.isfinite(value)
    except TypeError:
        return False


@lru_cache(maxsize=64)
def enu_from_camera(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Array:
    """Rotation (3, 3), shared: not to be written to."""
    yaw, pitch, roll = (math.radians(each) for each in (yaw_deg, pitch_deg, roll_deg))
    sin_y, cos_y, sin_p, cos_p = math.sin(yaw), math.cos(yaw), math.sin(pitch), math.cos(pitch)
    sin_r, cos_r = math.sin(roll), math.cos(roll)
    # Forward, right and down of the body (Tait-Bryan Z-Y-X) are up, right and ahead of the camera.
    right_e, right_n = sin_y * sin_p * sin_r + cos_y * cos_r, cos_y * sin_p * sin_r - sin_y * cos_r
    down_e, down_n = sin_y * sin_p * cos_r - cos_y * sin_r, cos_y * sin_p * cos_r + sin_y * sin_r
    rotation = np.array(
        [
            [right_e, -sin_y * cos_p, down_e],
            [right_n, -cos_y * cos_p, down_n],
            [-cos_p * sin_r, -sin_p, -cos_p * cos_r],
        ]
    )
    rotation.flags.writeable = False
    return rotation


def attitude_of(enu_from_camera: Array) -> tuple[float, float, float]:
    """Heading (0..360), pitch and roll in degrees: the inverse of `enu_from_camera`.

    At a pitch of +-90 only heading plus or minus roll is determined; the roll is then 0."""
    body_from_camera = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    yaw, pitch, roll = angles_of_ned(ENU_FROM_NED.T @ enu_from_camera @ body_from_camera.T)
    return math.degrees(yaw) % 360 % 360, math.degrees(pitch), math.degrees(roll)


def angles_of_ned(ned_from_body: Array) -> tuple[float, float, float]:
    """Yaw, pitch and roll (Tait-Bryan Z-Y-X) of a rotation (3, 3) in radians."""
    pitch = math.asin(min(1.0, max(-1.0, -ned_from_body[2, 0])))
    if math.hypot(ned_from_body[0, 0], ned_from_body[1, 0]) < 1e-9:
        yaw, roll = math.atan2(-ned_from_body[0, 1], ned_from_body[1, 1]), 0.0
    else:
        yaw = math.atan2(ned_from_body[1, 0], ned_from_body[0, 0])
        roll = math.atan2(ned_from_body[2, 1], ned_from_body[2, 2])
    return yaw, pitch, roll


def camera_from_en(yaw_deg: float, pitch_deg: float, roll_deg: float, agl_m: float) -> Array:
    """Homography (3, 3) to camera axes from flat ground (east, north, 1), m from below it."""
    ground = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -agl_m]])
    return np.asarray(enu_from_camera(yaw_deg, pitch_deg, roll_deg).T @ ground)


def counted_from_centres(homography: Array) -> Array:
    """A pixel-is-area homography (3, 3) for OpenCV, which counts from the first pixel's centre."""
    half_pixel = np.array([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    return np.asarray(np.linalg.inv(half_pixel) @ homography @ half_pixel)


def axis_on_ground_en_m(
    yaw_deg: float, pitch_deg: float, roll_deg: float, agl_m: float
) -> tuple[float, float]:
    """Where the optical axis meets flat ground, m from below; infinite at or above the horizon."""
    axis = enu_from_camera(yaw_deg, pitch_deg, roll_deg)[:, 2]
    if axis[2] >= -1e-9:
        return math.inf, math.inf
    reach = agl_m / -axis[2]
    return float(axis[0] * reach), float(axis[1] * reach)


def distort(camera: Camera, xy: Array) -> Array:
    """Distorted camera-plane coordinates `(..., 2)`; NaN where the model folds back."""
    if camera.is_pinhole:
        return xy
    if camera.model == "fisheye":
        return _fisheye_distort(camera.distortion, xy)
    out = _brown(camera.distortion, xy)
    out[(xy**2).sum(axis=-1) >= _fold_r2(camera.distortion)] = np.nan
    return out


def undistort(camera: Camera, xy: Array) -> Array:
    """The inverse of `distort`; NaN where there is none."""
    if camera.is_pinhole:
        return xy
    if camera.model == "fisheye":
        return _fisheye_undistort(camera.distortion, xy)
    return _brown_undistort(camera.distortion, xy)


def seen_px(camera: Camera, rays: Array) -> Array:
    """Image points (..., 2) of rays (..., 3) in camera axes; NaN behind the camera or the lens."""
    ahead = rays[..., 2] > 1e-9
    plane = rays[..., :2] / np.where(ahead, rays[..., 2], np.nan)[..., None]
    seen = distort(camera, plane) * [camera.fx_px, camera.fy_px] + [camera.cx_px, camera.cy_px]
    return np.asarray(seen)


def footprint_en_m(
    camera: Camera, yaw_deg: float, pitch_deg: float, roll_deg: float, agl_m: float
) -> Array:
    """Ground positions (4, 2), m from below the camera, of the corners clockwise from top left.

    Without distortion. Raises `CameraError` where a corner looks at or above the horizon."""
    wide, high = camera.width_px, camera.height_px
    corners = np.array([[0, 0, 1.0], [wide, 0, 1], [wide, high, 1], [0, high, 1]])
    rays = corners @ np.linalg.inv(camera.matrix).T
    enu = rays @ enu_from_camera(yaw_deg, pitch_deg, roll_deg).T
    if (enu[:, 2] >= -1e-9).any():
        raise CameraError("the horizon is in the view: it has no footprint on flat ground")
    return np.asarray(enu[:, :2] * (agl_m / -enu[:, 2:3]))


def ground_en_m(
    camera: Camera, px: Array, yaw_deg: float, pitch_deg: float, roll_deg: float, agl_m: float
) -> Array:
    """Flat ground (N, 2), m from below the camera, at image points (N, 2); NaN at or above the
    horizon and beyond the lens model."""
    enu = camera_rays(camera, px) @ enu_from_camera(yaw_deg, pitch_deg, roll_deg).T
    down = np.where(enu[:, 2:3] < -1e-9, -enu[:, 2:3], np.nan)
    return np.asarray(enu[:, :2] * (agl_m / down))


def camera_rays(camera: Camera, px: Array) -> Array:
    """Rays (N, 3), 1 along the optical axis, of image points (N, 2); NaN beyond the lens model."""
    plane = (px - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]
    return np.concatenate([undistort(camera, plane), np.ones((len(px), 1))], axis=1)


def _brown_undistort(distortion: tuple[float, ...], xy: Array) -> Array:
    """By Newton's method; NaN if there is none."""
    k1, k2, p1, p2, k3 = (*distortion, 0.0)[:5]
    ideal = np.array(xy, dtype=np.float64)
    with np.errstate(all="ignore"):
        for _ in range(50):
            x, y = ideal[..., 0], ideal[..., 1]
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)
            dxx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
            dxy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
            dyy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
            error = _brown(distortion, ideal) - xy
            if np.abs(error).max(initial=0.0) < 1e-14:
                break  # NaN never converges: points beyond the lens take all steps
            off_x, off_y = error[..., 0], error[..., 1]
            step = np.stack([dyy * off_x - dxy * off_y, dxx * off_y - dxy * off_x], axis=-1)
            ideal = ideal - step / (dxx * dyy - dxy * dxy)[..., None]
        found = np.abs(_brown(distortion, ideal) - xy).max(axis=-1) < 1e-9
        found &= (ideal**2).sum(axis=-1) < _fold_r2(distortion)
    ideal[~found] = np.nan
    return ideal


def _fisheye_distort(distortion: tuple[float, ...], xy: Array) -> Array:
    radius = np.hypot(xy[..., 0], xy[..., 1])
    angle = np.arctan(radius)
    polynomial = _angles(distortion)
    with np.errstate(invalid="ignore"):
        grown = np.where(angle < _fold_angle(polynomial), polynomial(angle), np.nan)
    scale = np.where(radius > 1e-12, grown / np.maximum(radius, 1e-12), 1.0)
    return np.asarray(xy * scale[..., None])


def _fisheye_undistort(distortion: tuple[float, ...], xy: Array) -> Array:
    radius = np.hypot(xy[..., 0], xy[..., 1])
    polynomial = _angles(distortion)
    slope, end = polynomial.deriv(), min(_fold_angle(polynomial), math.pi / 2)
    low, high = np.zeros_like(radius), np.full_like(radius, end)
    angle = np.clip(radius, 0.0, 0.9 * end)
    with np.errstate(all="ignore"):
        for _ in range(50):  # Newton's method inside a bracket: far out the slope may vanish
            error = polynomial(angle) - radius
            if np.abs(error).max(initial=0.0) < 1e-14:
                break
            low, high = np.where(error < 0, angle, low), np.where(error >= 0, angle, high)
            newton = angle - error / slope(angle)
            angle = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
        found = (np.abs(polynomial(angle) - radius) < 1e-9) & (angle < end)
        scale = np.where(radius > 1e-12, np.tan(angle) / np.maximum(radius, 1e-12), 1.0)
    return np.asarray(xy * np.where(found, scale, np.nan)[..., None])


def _brown(distortion: tuple[float, ...], xy: Array) -> Array:
    k1, k2, p1, p2, k3 = (*distortion, 0.0)[:5]
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    seen_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    seen_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([seen_x, seen_y], axis=-1)


@lru_cache(maxsize=16)
def _fold_r2(distortion: tuple[float, ...]) -> float:
    """Squared radius at which the radial model stops growing, or infinity."""
    k1, k2, _, _, k3 = (*distortion, 0.0)[:5]
    inverse = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3])  # of 1 / r2: the leading 1 keeps it sound
    largest = inverse.real[np.abs(inverse.imag) < 1e-9].max(initial=0.0)
    return float(1 / largest) if largest > 1e-12 else math.inf


def _angles(distortion: tuple[float, ...]) -> np.polynomial.Polynomial:
    """Image radius as a polynomial of the angle from the optical axis."""
    k1, k2, k3, k4 = distortion or (0.0,) * 4
    return np.polynomial.Polynomial([0, 1, 0, k1, 0, k2, 0, k3, 0, k4])


def _fold_angle(polynomial: np.polynomial.Polynomial) -> float:
    _, k1, k2, k3, k4 = polynomial.coef[1::2]
    inverse = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4])  # of 1 / angle squared, as above
    largest = inverse.real[np.abs(inverse.imag) < 1e-9].max(initial=0.0)
    return float(1 / math.sqrt(largest)) if largest > 1e-12 else math.inf
