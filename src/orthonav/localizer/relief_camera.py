"""The camera of a view that was placed on the ground as it is, with its pitch and roll."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.localizer.orthorectify import Orientation
from orthonav.localizer.relief_view import ReliefView
from orthonav.localizer.resection import STEPS, resected
from orthonav.register.pose import Pose
from orthonav.register.refine import Placed
from orthonav.register.registrar import Registrar

RESECTIONS = 5
"""The view is orthorectified and resected at most so many times,"""
SETTLED = 0.1
"""until a correction is below this share of its standard deviations."""
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CameraFound:
    """The camera of a view by resection: `agl_m` above the ground below it, the covariance (6, 6)
    of metres east, north, up and degrees of heading, pitch and roll, what its middle shows, and the
    covariance (2, 2) of that, None beside unknown ground."""

    orientation: Orientation
    agl_m: float
    covariance: Array
    middle_en_m: tuple[float, float]
    middle_covariance: Array | None


def camera_found(seen: ReliefView, registrar: Registrar, placed: Placed) -> CameraFound | None:
    """The camera of a place with its pitch and roll; None where their deviation is not reported
    or the view does not show them."""
    levels, pose = seen.view.levels, placed.pose
    picture = seen.view.picture_at(levels.final)
    orientation = seen.orientation(pose)
    if not picture.telemetry.tilt_std_deg or orientation is None:
        return None
    found = None
    for _ in range(RESECTIONS):
        made = seen.templates_at(pose, levels.final, orientation)
        if made is None:
            return None
        template = made.at(levels.final)
        refiner = registrar.refiner(made, levels, levels.final)
        to_px = np.array([1.0, -1.0]) / seen.relief.grid.gsd_m
        gradient, curvature = refiner.pulls(pose)
        starts = zip(template.block_starts, template.mask.shape, strict=True)
        rows, cols = ((np.append(each[1:], side) + each) / 2 - side / 2 for each, side in starts)
        middles = np.stack(np.meshgrid(cols, rows), axis=-1).reshape(-1, 2) * 2.0**levels.final
        ground = seen.relief.ground_m(pose.map_px(middles))
        found = resected(
            picture.camera,
            orientation,
            ground,
            seen.relief.slopes(ground),
            (gradient * to_px, curvature * to_px[:, None] * to_px),
            _attitude_prior(seen, pose, orientation),
        )
        if found is None:
            return None
        orientation = orientation.moved(found.correction)
        if (np.abs(found.correction) < SETTLED * np.sqrt(np.diag(found.covariance))).all():
            break
    if found is None or not np.isfinite(found.covariance).all():
        return None
    east, north, above_sea_m = orientation.position_m.tolist()
    below_m = float(seen.relief.terrain.at_en_m([east, north]))
    if not above_sea_m - below_m > 0:
        return None
    middle = seen.middle_en_m(orientation, pose)
    spread = _middle_covariance(seen, orientation, found.covariance)
    return CameraFound(orientation, above_sea_m - below_m, found.covariance, middle, spread)


def _middle_covariance(
    seen: ReliefView, orientation: Orientation, covariance: Array
) -> Array | None:
    """Covariance (2, 2), m^2, of the ground that the middle of a view shows; None where unknown
    ground is next to it."""
    columns = []
    for step in np.diag(STEPS):
        ahead, behind = (seen.sight_en_m(orientation.moved(sign * step)) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step.sum()))
    slopes = np.stack(columns, axis=1)
    return slopes @ covariance @ slopes.T if np.isfinite(slopes).all() else None


def _attitude_prior(seen: ReliefView, pose: Pose, orientation: Orientation) -> tuple[Array, Array]:
    """Expected correction (6,) of an orientation by telemetry, and its information (6, 6)."""
    telemetry, prior = seen.view.picture_at(seen.view.levels.final).telemetry, seen.view.prior
    expected, std = 0.0, prior.log_scale_std
    if prior.scale_map is not None:
        expected, std = prior.scale_map.at(pose.x_px, pose.y_px), prior.scale_map.std
    expected_m = seen.reference_m(pose) + telemetry.agl_m * math.exp(expected)
    up_m = expected_m - float(orientation.position_m[2])
    turn = math.degrees(prior.turn_rad or 0.0) - orientation.attitude_deg[0]
    tilt = np.array([telemetry.pitch_deg, telemetry.roll_deg]) - orientation.attitude_deg[1:]
    mean = np.array([0.0, 0.0, up_m, math.remainder(turn, 360.0), *tilt.tolist()])
    tilt_std = max(telemetry.tilt_std_deg or 0.0, 1e-3)
    stds = np.array([1e4, 1e4, telemetry.agl_m * std, 180.0, tilt_std, tilt_std])
    if prior.turn_rad is not None:
        stds[3] = math.degrees(prior.turn_std_rad)
    return mean, np.diag(stds**-2)
