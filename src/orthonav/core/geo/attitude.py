"""Angles of various manufacturers (docs/flights.md) as rotations from camera axes to east, north,
up.

Angles are arrays (..., 3) of yaw, pitch, roll in degrees, rotations (..., 3, 3)."""

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
"""Of a gimbal: horizon errors of 1 deg after turns, mounting errors of 1 to 2 deg."""
AUTOPILOT_TILT_STD_DEG = 3.0
"""Of an autopilot with a mount never calibrated: mounts lean by 1 to 5 deg (docs/flights.md)."""
ASSUMED_TILT_STD_DEG = 6.0
"""Of an assumed nadir camera: consistent on 30 photographs of a DJI Mini (docs/flights.md)."""


def ned_from_angles(yaw_pitch_roll_deg: ArrayLike) -> Array:
    return np.asarray(Rotation.from_euler("ZYX", yaw_pitch_roll_deg, degrees=True).as_matrix())


def enu_from_gimbal_camera(yaw_pitch_roll_deg: ArrayLike) -> Array:
    """Of gimbal angles as DJI and Autel define them.

    At 0, 0, 0 the camera looks ahead; at pitch -90 down, the top of the image at yaw plus roll."""
    return np.asarray(_ENU_FROM_NED @ ned_from_angles(yaw_pitch_roll_deg) @ _GIMBAL_FROM_CAMERA)


def enu_from_body_camera(ned_from_frd: Array, mount_deg: Angles = LOOKS_DOWN) -> Array:
    """`mount_deg`: yaw, pitch, roll in the body: 0 looks down, top forward; pitch 90 ahead."""
    return np.asarray(_ENU_FROM_NED @ ned_from_frd @ _frd_from_camera(mount_deg))


def enu_from_ros_camera(enu_from_flu: Array, mount_deg: Angles) -> Array:
    """Of attitudes in ROS (REP 103): ENU from forward-left-up."""
    return np.asarray(enu_from_flu @ _FRD_FROM_FLU @ _frd_from_camera(mount_deg))


def ned_wxyz_from_ros(wxyz: ArrayLike) -> Array | None:
    """w, x, y, z (4,) from FRD to NED, of ROS's FLU to ENU (REP 103); None if no rotation."""
    rotations, _ = rotations_of_wxyz(np.asarray(wxyz, dtype=np.float64).reshape(1, 4))
    if not len(rotations):
        return None
    xyzw = Rotation.from_matrix(_ENU_FROM_NED.T @ rotations[0] @ _FRD_FROM_FLU).as_quat()
    return np.asarray(xyzw[[3, 0, 1, 2]])


def ros_xyzw_from_ned(ned_from_frd: Array) -> Array:
    """x, y, z, w from forward-left-up to east-north-up: the inverse."""
    enu_from_flu = _ENU_FROM_NED @ ned_from_frd @ _FRD_FROM_FLU
    return np.asarray(Rotation.from_matrix(enu_from_flu).as_quat())


def rotations_of_wxyz(wxyz: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Of the valid quaternions (N, 4), and which are valid: not zeros or NaN ("unknown")."""
    with np.errstate(invalid="ignore"):
        sound = np.abs(np.linalg.norm(wxyz, axis=1) - 1) < 0.1
    if not sound.any():
        return np.zeros((0, 3, 3)), sound
    return np.asarray(Rotation.from_quat(wxyz[sound][:, [1, 2, 3, 0]]).as_matrix()), sound


def _frd_from_camera(mount_deg: Angles) -> Array:
    return np.asarray(_ENU_FROM_NED.T @ enu_from_camera(*mount_deg))
