"""The camera of a placed view: position, height, heading, pitch and roll from the picture.

The reported pitch and roll are only a prior: mounts lean by degrees, and so does the horizon of an
autopilot. `orthonav.core.localize.resection` fits the camera to the blocks of the view; then the
view is orthorectified with what was found, one level finer, and fitted again.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.localize.orthorectify import Orientation
from orthonav.core.localize.relief_view import ReliefView
from orthonav.core.localize.resection import STEPS, Resection, moved_by_camera, resected
from orthonav.core.records import DEFAULT_TILT_STD_DEG, Telemetry
from orthonav.core.register.blocks import block_scores
from orthonav.core.register.pose import Pose
from orthonav.core.register.template import BLOCKS, ViewTemplates
from orthonav.core.register.window import Reference

FIRST_REACH_PX, REACH_PX = 7, 4
"""Blocks are moved so far, pixels of each level, by the first fit and by those after it. 7 px of
the final level are what 10 deg of tilt make at the rim of a view 65 deg wide."""
FITS = 3
"""The view is fitted at most so many times,"""
SETTLED = 0.2
"""until a correction is below this share of its standard deviations."""
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CameraFound:
    """The camera of a view.

    - `orientation`: position and attitude; `agl_m`: height above the ground below it.
    - `covariance` (6, 6): of metres east, north and up, degrees of heading, pitch and roll.
    - `alone`, `alone_covariance`: the same by the view alone, without heading, height and tilt of
      the telemetry; what the view does not show has standard deviations of `resection.WEAK`.
    - `middle_en_m`: ground that the middle of the picture shows, metres east and north;
      `middle_covariance` (2, 2) of that, m2, None beside unknown ground.
    """

    orientation: Orientation
    agl_m: float
    covariance: Array
    alone: Orientation
    alone_covariance: Array
    middle_en_m: tuple[float, float]
    middle_covariance: Array | None


def camera_found(seen: ReliefView, reference: Reference, pose: Pose) -> CameraFound | None:
    """The camera of a view whose window lies at `pose`, its height counted from the mean ground of
    that window; None where the ground is unknown or too few blocks are seen."""
    orientation, start = seen.orientation(pose), None
    if orientation is None:
        return None
    found: Resection | None = None
    for number in range(FITS):
        start = orientation
        found = _fitted(seen, reference, pose, start, first=number == 0)
        if found is None:
            return None
        orientation = start.moved(found.correction)
        small = np.abs(found.correction) < SETTLED * np.sqrt(np.diag(found.covariance))
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
        seen.middle_en_m(orientation, pose),
        _middle_covariance(seen, orientation, found.covariance),
    )


def tilt_std_deg(telemetry: Telemetry) -> float:
    """Standard deviation of reported pitch and roll, stated or usual."""
    stated = telemetry.tilt_std_deg
    return DEFAULT_TILT_STD_DEG if stated is None else stated


def _fitted(
    seen: ReliefView, reference: Reference, pose: Pose, orientation: Orientation, *, first: bool
) -> Resection | None:
    """A correction of `orientation`, under which the view is rectified: the first at the final
    level and a coarser one, others one level finer too."""
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
    camera = seen.view.picture_at(finest).camera
    ground = seen.relief.ground_m(pose.map_px(blocks[0].middles_px * 2.0**finest))
    moved_m = moved_by_camera(camera, orientation, ground, seen.relief.slopes(ground))
    window_from_en = np.linalg.inv(pose.linear) @ np.diag([1.0, -1.0]) / seen.relief.grid.gsd_m
    moved_px = window_from_en @ moved_m
    return resected(
        [(each, moved_px / 2.0**level) for each, level in zip(blocks, levels, strict=True)],
        _prior(seen, pose, orientation),
        block_px=seen.view.side_px / BLOCKS,
        close=not first,
    )


def _templates(
    seen: ReliefView, pose: Pose, level: int, orientation: Orientation, *, first: bool
) -> ViewTemplates | None:
    """The view rectified under an orientation; over level ground the first is the search's."""
    if first and seen.relief.is_level and not seen.is_oblique:
        return seen.view.templates
    return seen.templates_at(pose, level, orientation)


def _middle_covariance(
    seen: ReliefView, orientation: Orientation, covariance: Array
) -> Array | None:
    """Covariance (2, 2), m2, of the ground that the middle of a view shows; None where unknown
    ground is next to it."""
    columns = []
    for step in np.diag(STEPS):
        ahead, behind = (seen.sight_en_m(orientation.moved(sign * step)) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step.sum()))
    slopes = np.stack(columns, axis=1)
    return slopes @ covariance @ slopes.T if np.isfinite(slopes).all() else None


def _prior(seen: ReliefView, pose: Pose, orientation: Orientation) -> tuple[Array, Array]:
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
    tilt_std = max(tilt_std_deg(telemetry), 1e-3)
    stds = np.array([1e4, 1e4, telemetry.agl_m * std, 180.0, tilt_std, tilt_std])
    if prior.turn_rad is not None:
        stds[3] = math.degrees(prior.turn_std_rad)
    else:
        mean[3] = 0.0
    return mean, np.diag(stds**-2)
