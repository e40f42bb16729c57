"""The camera of a placed view: position, height, heading, pitch and roll from the picture.

Blocks of the view are compared with the map a little aside, `resection` finds the camera that
explains them. Then the view is orthorectified one level finer, and fitted again."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera
from orthonav.core.localize.ground import LevelTerrain, Relief, ViewOverGround
from orthonav.core.localize.rectify import Orientation, is_oblique
from orthonav.core.localize.resection import Expected, Resection, resected
from orthonav.core.localize.systematic import systematic
from orthonav.core.records import DEFAULT_TILT_STD_DEG, Telemetry
from orthonav.core.register.blocks import block_scores
from orthonav.core.register.pose import Pose
from orthonav.core.register.template import BLOCKS, ViewTemplates
from orthonav.core.register.window import Reference

STEPS = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
"""Of numerical derivatives: metres east, north, up, degrees of heading, pitch, roll."""
GROUND_STEP_M = 2.0  # of a point along the ground: the noise of a terrain model over its slope
MIN_TILT_STD_DEG = 0.05  # of a tilt that is reported as exact
Array = NDArray[np.float64]


def ground_by_picture(
    camera: Camera, orientation: Orientation, ground_m: Array, slopes: Array
) -> Array:
    """Metres (N, 2, 2) over the ground per pixel of the picture; NaN where not seen. `ground_m`
    (N, 3): east, north, above sea; `slopes` (N, 2): its rise."""
    by_ground = []
    for axis in range(2):
        step = np.zeros((len(ground_m), 3))
        step[:, axis] = GROUND_STEP_M
        step[:, 2] = slopes[:, axis] * GROUND_STEP_M
        ahead, behind = (orientation.seen_px(camera, ground_m + sign * step) for sign in (1, -1))
        by_ground.append((ahead - behind) / (2 * GROUND_STEP_M))
    on_ground = np.stack(by_ground, axis=-1)
    bad = ~np.isfinite(on_ground).all(axis=(1, 2))
    on_ground[bad] = np.eye(2)
    inverse = np.linalg.inv(on_ground)
    inverse[bad] = np.nan
    return np.asarray(inverse)


def picture_by_camera(camera: Camera, orientation: Orientation, ground_m: Array) -> Array:
    """Pixels (N, 2, 6) by which points of the ground (N, 3) move in the picture per unit of the
    camera."""
    columns = []
    for axis in range(6):
        change = np.zeros(6)
        change[axis] = STEPS[axis]
        ahead, behind = (
            orientation.moved(sign * change).seen_px(camera, ground_m) for sign in (1, -1)
        )
        columns.append((ahead - behind) / (2 * STEPS[axis]))
    return np.stack(columns, axis=-1)


FIRST_REACH_PX, REACH_PX = 7, 4
"""Reach, pixels of the level: 7 px are 10 deg of tilt at the rim of a view 65 deg wide."""
FITS = 3  # at most,
SMALL_SHARE = 0.2  # until a correction is below this fraction of its standard deviations
VARIANCE, VARIANCE_POWER, LEAST_RATIO = 1.6, -0.8, 0.5
"""Variance of the errors of blocks over what their curvature says: the first, times the local ratio
of the place (at least the third) to the power of the second (docs/decisions/camera.md)."""


@dataclass(frozen=True, eq=False)
class CameraFound:
    """The camera of a view; `agl_m`: above the ground below it; `alone`: without telemetry.

    - covariances (6, 6): m east, north, up, deg heading, pitch, roll; `WEAK` where not shown.
    - `variance`: of the errors of blocks over what their curvature says.
    - `middle_en_m`, `middle_covariance` (2, 2): ground in the middle of the picture, None: unknown.
    """

    orientation: Orientation
    agl_m: float
    covariance: Array
    alone: Orientation
    alone_covariance: Array
    variance: float
    middle_en_m: tuple[float, float]
    middle_covariance: Array | None


def camera_found(
    seen: ViewOverGround, reference: Reference, pose: Pose, local_ratio: float
) -> CameraFound | None:
    """Of a view at `pose`; None where too few blocks are seen.

    `local_ratio`: of the scores of the place."""
    if math.isnan(seen.reference_m(pose)):  # it was placed on level ground
        seen = ViewOverGround(Relief(LevelTerrain(), seen.relief.grid), seen.view)
    orientation, start = seen.orientation(pose), None
    if orientation is None:
        return None
    variance = VARIANCE * max(local_ratio, LEAST_RATIO) ** VARIANCE_POWER
    found: Resection | None = None
    for number in range(FITS):
        start = orientation
        found = _fitted(seen, reference, pose, start, variance, first=number == 0)
        if found is None:
            return None
        orientation = start.moved(found.correction)
        small = np.abs(found.correction) < SMALL_SHARE * np.sqrt(np.diag(found.covariance))
        if number > 0 and small.all():
            break
    assert found is not None and start is not None
    east, north, above_sea_m = orientation.position_m.tolist()
    agl_m = above_sea_m - float(seen.relief.terrain.at_en_m([east, north]))
    if not agl_m > 0:
        return None
    return CameraFound(
        orientation,
        agl_m,
        found.covariance,
        start.moved(found.alone),
        found.alone_covariance,
        variance,
        seen.middle_en_m(orientation, pose),
        _middle_covariance(seen, orientation, found.covariance),
    )


def tilt_std_deg(telemetry: Telemetry) -> float:
    stated = telemetry.tilt_std_deg
    return DEFAULT_TILT_STD_DEG if stated is None else stated


def _fitted(
    seen: ViewOverGround,
    reference: Reference,
    pose: Pose,
    orientation: Orientation,
    variance: float,
    *,
    first: bool,
) -> Resection | None:
    """A correction: the first at the final level and a coarser one, then one finer too."""
    final = seen.view.levels.final
    finest = final if first else max(final - 1, 0)
    made = _templates(seen, pose, finest, orientation, first=first)
    if made is None:
        return None
    reach_px = FIRST_REACH_PX if first else REACH_PX
    coarsest = min(final + 1, reference.levels - 1)
    levels = [at for at in range(finest, coarsest + 1) if min(made.shape(at)) >= BLOCKS]
    if not levels:
        return None
    blocks = [block_scores(made.at(each), reference, pose, reach_px) for each in levels]
    camera, grid = seen.view.picture_at(finest).camera, seen.relief.grid
    ground = seen.relief.ground_m(pose.map_px(blocks[0].middles_px * 2.0**finest))
    slopes = seen.relief.slopes(ground)
    window_from_en = np.linalg.inv(pose.linear) @ np.diag([1.0, -1.0]) / grid.gsd_m
    by_picture = window_from_en @ ground_by_picture(camera, orientation, ground, slopes)
    moved = -by_picture @ picture_by_camera(camera, orientation, ground)
    # Raised ground moves as under a camera that is lower by as much.
    errors = systematic(
        camera,
        seen.relief.errors(slopes),
        places_m=ground[:, :2],
        by_height_px=-moved[:, :, 2],
        by_picture_px=by_picture,
        seen_px=orientation.seen_px(camera, ground),
        block_px=seen.view.side_px / BLOCKS,
        gsd_m=grid.gsd_m,
    )
    return resected(
        [(each, 2.0**level) for each, level in zip(blocks, levels, strict=True)],
        moved,
        _expected(seen, pose, orientation),
        errors,
        variance=variance,
        block_px=seen.view.side_px / BLOCKS,
        close=not first,
    )


def _templates(
    seen: ViewOverGround, pose: Pose, level: int, orientation: Orientation, *, first: bool
) -> ViewTemplates | None:
    """Rectified under an orientation; over level ground the first is the search's."""
    if first and seen.is_level(pose) and not is_oblique(seen.view.view):
        return seen.view.templates
    return seen.templates_at(pose, level, orientation)


def _middle_covariance(
    seen: ViewOverGround, orientation: Orientation, covariance: Array
) -> Array | None:
    """Of the ground (2, 2), m2, that the middle of a view shows; None beside unknown ground."""
    columns = []
    for step in np.diag(STEPS):
        ahead, behind = (seen.sight_en_m(orientation.moved(sign * step)) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step.sum()))
    slopes = np.stack(columns, axis=1)
    return slopes @ covariance @ slopes.T if np.isfinite(slopes).all() else None


def _expected(seen: ViewOverGround, pose: Pose, orientation: Orientation) -> Expected:
    telemetry, prior = seen.view.telemetry, seen.view.prior
    expected, std = 0.0, prior.log_scale_std
    if prior.scale_map is not None:
        expected, std = prior.scale_map.at(pose.x_px, pose.y_px), prior.scale_map.std
    expected_m = seen.reference_m(pose) + telemetry.agl_m * math.exp(expected)
    up_m = expected_m - float(orientation.position_m[2])
    turn = math.degrees(prior.turn_rad or 0.0) - orientation.attitude_deg[0]
    tilt = np.array([telemetry.pitch_deg, telemetry.roll_deg]) - orientation.attitude_deg[1:]
    mean = np.array([0.0, 0.0, up_m, math.remainder(turn, 360.0), *tilt.tolist()])
    tilt_std = max(tilt_std_deg(telemetry), MIN_TILT_STD_DEG)
    stds = np.array([1e4, 1e4, telemetry.agl_m * std, 180.0, tilt_std, tilt_std])
    if prior.turn_rad is not None:
        stds[3] = math.degrees(prior.turn_std_rad)
    else:
        mean[3] = 0.0
    return Expected(mean, np.diag(stds**-2))
