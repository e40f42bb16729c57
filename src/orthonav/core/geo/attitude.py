"""Angles of various manufacturers (docs/flights.md) as rotations from camera axes to east, north,
up.

Angles are arrays (..., 3) of yaw, pitch, roll in degrees, rotations (..., 3, 3), quaternions
(..., 4) w, x, y, z."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthonav.core.geo.camera import ENU_FROM_NED, enu_from_camera

Array = NDArray[np.float64]
Angles = tuple[float, float, float]

_FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])
LOOKS_DOWN = (0.0, 0.0, 0.0)


def ned_from_angles(yaw_pitch_roll_deg: ArrayLike) -> Array:
    """Tait-Bryan angles in the order Z-Y-X."""
    return matrices_of_wxyz(wxyz_of_angles(np.radians(yaw_pitch_roll_deg)))


def wxyz_of_angles(yaw_pitch_roll_rad: ArrayLike) -> Array:
    half = np.asarray(yaw_pitch_roll_rad, np.float64) / 2
    (cy, cp, cr), (sy, sp, sr) = (np.moveaxis(turn(half), -1, 0) for turn in (np.cos, np.sin))
    return np.stack(
        [
            cy * cp * cr + sy * sp * sr,
            cy * cp * sr - sy * sp * cr,
            cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr,
        ],
        axis=-1,
    )


def matrices_of_wxyz(wxyz: ArrayLike) -> Array:
    """Rotations of quaternions of any length above 0."""
    quaternions = np.asarray(wxyz, np.float64)
    unit = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
    w, vector = unit[..., :1, None], unit[..., 1:]
    cross = np.cross(vector[..., None, :], np.eye(3)).swapaxes(-1, -2)
    outer = vector[..., :, None] * vector[..., None, :]
    return np.asarray((2 * w * w - 1) * np.eye(3) + 2 * (outer + w * cross))


def wxyz_of_matrices(rotations: ArrayLike) -> Array:
    """Unit quaternions: the row of 4 q q^T that has the largest entry on its diagonal (Shepperd,
    1978)."""
    m = np.moveaxis(np.asarray(rotations, np.float64), (-2, -1), (0, 1))
    (a, b, c), (d, e, f), (g, h, i) = m
    products = np.moveaxis(
        np.array(
            [
                [1 + a + e + i, h - f, c - g, d - b],
                [h - f, 1 + a - e - i, b + d, c + g],
                [c - g, b + d, 1 - a + e - i, f + h],
                [d - b, c + g, f + h, 1 - a - e + i],
            ]
        ),
        (0, 1),
        (-2, -1),
    )
    largest = np.diagonal(products, axis1=-2, axis2=-1).argmax(axis=-1)
    row = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    return np.asarray(row / np.linalg.norm(row, axis=-1, keepdims=True))


def slerp(before: Array, after: Array, weight: float) -> Array:
    """Between two unit quaternions (4,) on the shorter way; beyond them with a `weight` above 1."""
    cosine = float(before @ after)
    if cosine < 0:
        after, cosine = -after, -cosine
    angle = math.acos(min(1.0, cosine))
    if angle < 1e-9:
        return before
    mixed = math.sin((1 - weight) * angle) * before + math.sin(weight * angle) * after
    return np.asarray(mixed / math.sin(angle))


def enu_from_gimbal_camera(yaw_pitch_roll_deg: ArrayLike) -> Array:
    """Of gimbal angles as DJI and Autel define them.

    At 0, 0, 0 the camera looks ahead; at pitch -90 down, the top of the image at yaw plus roll."""
    # A gimbal's axes look ahead, right, down; a camera's x, y, z are right, down, ahead.
    gimbal_from_camera = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    return np.asarray(ENU_FROM_NED @ ned_from_angles(yaw_pitch_roll_deg) @ gimbal_from_camera)


def enu_from_body_camera(ned_from_frd: Array, mount_deg: Angles = LOOKS_DOWN) -> Array:
    """`mount_deg`: yaw, pitch, roll in the body: 0 looks down, top forward; pitch 90 ahead."""
    return np.asarray(ENU_FROM_NED @ ned_from_frd @ _frd_from_camera(mount_deg))


def enu_from_ros_camera(enu_from_flu: Array, mount_deg: Angles) -> Array:
    """Of attitudes in ROS (REP 103): ENU from forward-left-up."""
    return np.asarray(enu_from_flu @ _FRD_FROM_FLU @ _frd_from_camera(mount_deg))


def ned_wxyz_from_ros(wxyz: ArrayLike) -> Array | None:
    """w, x, y, z (4,) from FRD to NED, of ROS's FLU to ENU (REP 103); None if no rotation."""
    rotations, _ = rotations_of_wxyz(np.asarray(wxyz, dtype=np.float64).reshape(1, 4))
    if not len(rotations):
        return None
    return wxyz_of_matrices(ENU_FROM_NED.T @ rotations[0] @ _FRD_FROM_FLU)


def ros_xyzw_from_ned(ned_from_frd: Array) -> Array:
    """x, y, z, w from forward-left-up to east-north-up: the inverse."""
    enu_from_flu = ENU_FROM_NED @ ned_from_frd @ _FRD_FROM_FLU
    return np.roll(wxyz_of_matrices(enu_from_flu), -1)


def rotations_of_wxyz(wxyz: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Of the valid quaternions (N, 4), and which are valid: not zeros or NaN ("unknown")."""
    with np.errstate(invalid="ignore"):
        sound = np.abs(np.linalg.norm(wxyz, axis=1) - 1) < 0.1
    if not sound.any():
        return np.zeros((0, 3, 3)), sound
    return matrices_of_wxyz(wxyz[sound]), sound


def _frd_from_camera(mount_deg: Angles) -> Array:
    return np.asarray(ENU_FROM_NED.T @ enu_from_camera(*mount_deg))
