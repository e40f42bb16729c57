"""The camera: pinhole with Brown distortion, its attitude, and where it looks on flat ground.

Camera axes: x to the right of the image, y down the image, z along the optical axis.
Attitude: with heading, pitch and roll 0 the optical axis points straight down and the top of the
image to the north. Heading turns clockwise from above; then, as for an aircraft (yaw, pitch, roll,
Tait-Bryan Z-Y-X in the forward-right-down body), positive pitch makes the camera look ahead and
positive roll makes it look left.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import CameraError

Array = NDArray[np.float64]
MAX_DIMENSION_PX = 65_535
_HALF_PIXEL = np.array([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])


@dataclass(frozen=True)
class Camera:
    """Pinhole camera with Brown distortion.

    Focal lengths and principal point in pixels, measured from the outer corner of the first pixel
    (pixel-is-area: its centre is 0.5, 0.5). `distortion` is empty or k1, k2, p1, p2[, k3], as in
    OpenCV. Raises `CameraError` on values no camera has.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.distortion and not any(self.distortion):
            object.__setattr__(self, "distortion", ())  # none at all, and faster
        for name in ("width_px", "height_px"):
            if not 1 <= getattr(self, name) <= MAX_DIMENSION_PX:
                raise CameraError(f"camera {name} must be 1 to {MAX_DIMENSION_PX}: {self}")
        numbers = (self.fx_px, self.fy_px, self.cx_px, self.cy_px, *self.distortion)
        if not all(math.isfinite(number) for number in numbers):
            raise CameraError(f"camera has a value that is not finite: {self}")
        if self.fx_px <= 0 or self.fy_px <= 0:
            raise CameraError(f"camera focal length must be above 0 px: {self}")
        if len(self.distortion) not in (0, 4, 5):
            raise CameraError(
                f"camera distortion must be empty or k1,k2,p1,p2[,k3], got {self.distortion}"
            )

    @property
    def matrix(self) -> Array:
        """`px_from_camera`, (3, 3): pixel-is-area coordinates from camera axes, no distortion."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    def gsd_m(self, agl_m: float) -> float:
        """Ground resolution in metres per pixel of a vertical view from `agl_m`."""
        return agl_m / math.sqrt(self.fx_px * self.fy_px)

    def resized(self, width_px: int, height_px: int) -> "Camera":
        """The camera of the same picture resampled to another size."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        return replace(
            self,
            width_px=width_px,
            height_px=height_px,
            fx_px=self.fx_px * sx,
            fy_px=self.fy_px * sy,
            cx_px=self.cx_px * sx,
            cy_px=self.cy_px * sy,
        )


def enu_from_camera(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Array:
    """Rotation (3, 3) from camera axes to east, north, up."""
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    ned_from_body = _rotation(2, yaw) @ _rotation(1, pitch) @ _rotation(0, roll)
    body_from_camera = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    enu_from_ned = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return np.asarray(enu_from_ned @ ned_from_body @ body_from_camera)


def _rotation(axis: int, angle_rad: float) -> Array:
    """Right-handed rotation (3, 3) about coordinate axis 0, 1 or 2."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    first, second = [i for i in range(3) if i != axis]
    rotation = np.eye(3)
    rotation[first, first] = rotation[second, second] = cos
    sign = -1.0 if axis == 1 else 1.0
    rotation[first, second], rotation[second, first] = -sign * sin, sign * sin
    return rotation


def camera_from_en(yaw_deg: float, pitch_deg: float, roll_deg: float, agl_m: float) -> Array:
    """Homography (3, 3) from flat ground to camera axes.

    Takes ground points (east, north, 1) in metres from the point below the camera; gives camera
    axes up to scale, the third positive in front of the camera.
    """
    ground = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -agl_m]])
    return np.asarray(enu_from_camera(yaw_deg, pitch_deg, roll_deg).T @ ground)


def counted_from_centres(homography: Array) -> Array:
    """A homography (3, 3) between pixel-is-area pictures, as OpenCV wants it.

    Ours counts from the outer corner of the first pixel, OpenCV from its centre.
    """
    return np.asarray(np.linalg.inv(_HALF_PIXEL) @ homography @ _HALF_PIXEL)


def axis_on_ground_en_m(
    yaw_deg: float, pitch_deg: float, roll_deg: float, agl_m: float
) -> tuple[float, float]:
    """Where the optical axis meets flat ground, metres east and north of the camera.

    Infinite where the axis points at or above the horizon.
    """
    axis = enu_from_camera(yaw_deg, pitch_deg, roll_deg)[:, 2]
    if axis[2] >= -1e-9:
        return math.inf, math.inf
    reach = agl_m / -axis[2]
    return float(axis[0] * reach), float(axis[1] * reach)


def distort(camera: Camera, xy: Array) -> Array:
    """Distorted camera-plane coordinates `(..., 2)` of ideal ones (Brown's model, as OpenCV's).

    Points beyond the radius where the model stops growing (it folds back there) become NaN.
    """
    if not camera.distortion:
        return xy
    k1, k2, p1, p2, k3 = (*camera.distortion, 0.0)[:5]
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    out = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )
    out[r2 >= _fold_r2(k1, k2, k3)] = np.nan
    return out


def _fold_r2(k1: float, k2: float, k3: float) -> float:
    """Squared radius at which the radial model stops growing; infinite where it never does."""
    inverse = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3])  # of 1 / r2: the leading 1 keeps it sound
    largest = inverse.real[np.abs(inverse.imag) < 1e-9].max(initial=0.0)
    return float(1 / largest) if largest > 1e-12 else math.inf


def footprint_en_m(
    camera: Camera, yaw_deg: float, pitch_deg: float, roll_deg: float, agl_m: float
) -> Array:
    """Ground positions (4, 2) of the image corners, metres from the point below the camera.

    Order: top left, top right, bottom right, bottom left; distortion is left out. Raises
    `CameraError` where a corner looks at or above the horizon.
    """
    corners = np.array(
        [
            [0, 0, 1.0],
            [camera.width_px, 0, 1],
            [camera.width_px, camera.height_px, 1],
            [0, camera.height_px, 1],
        ]
    )
    rays = corners @ np.linalg.inv(camera.matrix).T
    enu = rays @ enu_from_camera(yaw_deg, pitch_deg, roll_deg).T
    if (enu[:, 2] >= -1e-9).any():
        raise CameraError("the horizon is in the view: it has no footprint on flat ground")
    return np.asarray(enu[:, :2] * (agl_m / -enu[:, 2:3]))
