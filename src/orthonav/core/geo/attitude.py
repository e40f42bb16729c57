"""Angles of various manufacturers as rotations from camera axes to east, north, up.

The convention of orthonav is in `orthonav.core.geo.camera`, those of manufacturers, with sources,
are in
`docs/flights.md`. Angles are arrays (..., 3) of yaw, pitch, roll in degrees, rotations (..., 3, 3).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from orthonav.core.geo.camera import enu_from_camera

Array = NDArray[np.float64]
Angles = tuple[float, float, float]

_ENU_FROM_NED = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
# A gimbal's axes look ahead, right, down; a camera's x, y, z are right, down, ahead.
_GIMBAL_FROM_CAMERA = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
_FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])
LOOKS_DOWN = (0.0, 0.0, 0.0)
GIMBAL_TILT_STD_DEG = 2.0
"""Standard deviation of pitch and roll that a gimbal reports: its horizon errs by about 1 deg after
turns, and cameras are mounted in it to within 1 to 2 deg."""
AUTOPILOT_TILT_STD_DEG = 3.0
"""The same of an autopilot's attitude and a mount that was never calibrated: mounts lean by 1 to
5 deg, horizons err by 0.5 to 2 deg with GNSS and by more without (docs/flights.md)."""
ASSUMED_TILT_STD_DEG = 6.0
"""Standard deviation of pitch and roll where a camera is assumed to look straight down: with it the
covariance of fixes on 30 photographs of a DJI Mini is consistent (docs/flights.md)."""


def ned_from_angles(yaw_pitch_roll_deg: ArrayLike) -> Array:
    """Rotations to north-east-down of Z-Y-X angles, as autopilots and gimbals define them."""
    return np.asarray(Rotation.from_euler("ZYX", yaw_pitch_roll_deg, degrees=True).as_matrix())


def enu_from_gimbal_camera(yaw_pitch_roll_deg: ArrayLike) -> Array:
    """Rotations from camera axes to ENU of gimbal angles as DJI and Autel define them.

    At 0, 0, 0 the camera looks ahead. Pitch -90 looks straight down; the top of the image then
    points to the gimbal's yaw (plus its roll, about the same axis).
    """
    return np.asarray(_ENU_FROM_NED @ ned_from_angles(yaw_pitch_roll_deg) @ _GIMBAL_FROM_CAMERA)


def enu_from_body_camera(ned_from_frd: Array, mount_deg: Angles = LOOKS_DOWN) -> Array:
    """Rotations from camera axes to ENU of an autopilot's attitudes and the mount.

    `mount_deg` is yaw, pitch, roll of the camera in the body: 0, 0, 0 looks straight down with
    the top of the image forward; pitch 90 looks forward.
    """
    return np.asarray(_ENU_FROM_NED @ ned_from_frd @ _frd_from_camera(mount_deg))


def enu_from_ros_camera(enu_from_flu: Array, mount_deg: Angles) -> Array:
    """The same of attitudes in ROS (REP 103): ENU from forward-left-up."""
    return np.asarray(enu_from_flu @ _FRD_FROM_FLU @ _frd_from_camera(mount_deg))


def ned_wxyz_from_ros(wxyz: ArrayLike) -> Array | None:
    """The attitude (4,) w, x, y, z from forward-right-down to north-east-down of one as ROS writes
    it (REP 103): from forward-left-up to east-north-up. None where `wxyz` is not a rotation."""
    rotations, _ = rotations_of_wxyz(np.asarray(wxyz, dtype=np.float64).reshape(1, 4))
    if not len(rotations):
        return None
    xyzw = Rotation.from_matrix(_ENU_FROM_NED.T @ rotations[0] @ _FRD_FROM_FLU).as_quat()
    return np.asarray(xyzw[[3, 0, 1, 2]])


def ros_xyzw_from_ned(ned_from_frd: Array) -> Array:
    """The inverse, of a rotation (3, 3): x, y, z, w from forward-left-up to east-north-up."""
    enu_from_flu = _ENU_FROM_NED @ ned_from_frd @ _FRD_FROM_FLU
    return np.asarray(Rotation.from_matrix(enu_from_flu).as_quat())


def rotations_of_wxyz(wxyz: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Rotations (N, 3, 3) of the valid quaternions (N, 4), and which are valid, (N,) bool.

    All zeros and NaN, which stand for "unknown", are invalid.
    """
    with np.errstate(invalid="ignore"):
        sound = np.abs(np.linalg.norm(wxyz, axis=1) - 1) < 0.1
    if not sound.any():
        return np.zeros((0, 3, 3)), sound
    return np.asarray(Rotation.from_quat(wxyz[sound][:, [1, 2, 3, 0]]).as_matrix()), sound


def _frd_from_camera(mount_deg: Angles) -> Array:
    return np.asarray(_ENU_FROM_NED.T @ enu_from_camera(*mount_deg))
