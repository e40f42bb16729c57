"""The camera of a placed view: position, height, heading, pitch and roll from the picture.

Blocks of the view are compared with the map a little aside, `resection` finds the camera that
explains them. Then the view is orthorectified one level finer, and fitted again."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera, enu_from_camera, seen_px
from orthonav.core.localize.ground import LevelTerrain, Relief, ViewOverGround
from orthonav.core.localize.rectify import Orientation, is_oblique
from orthonav.core.localize.resection import Expected, Resection, climbed, resected, values
from orthonav.core.localize.systematic import GroundErrors, lens_px, systematic
from orthonav.core.records import DEFAULT_TILT_STD_DEG, Telemetry
from orthonav.core.register.blocks import BlockScores, block_scores
from orthonav.core.register.pose import Pose
from orthonav.core.register.template import BLOCKS, ViewTemplates
from orthonav.core.register.window import Reference

STEPS = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
"""Of numerical derivatives: metres east, north, up, degrees of heading, pitch, roll."""
GROUND_STEP_M = 1.0  # of a point of the ground
MIN_TILT_STD_DEG = 0.05  # of a tilt that is reported as exact
FIRST_REACH_PX, REACH_PX = 7, 4
"""Reach, pixels of the level: 7 px are 10 deg of tilt at the rim of a view 65 deg wide."""
SURFACE_REACHES_PX = 16, 8
"""The first reaches over houses and trees, at the finer level: coarser ones do not show the camera
(docs/terrain.md)."""
LEAST_FIT, CLOSE_FIT = 0.13, 0.15
"""Mean correlation of the blocks of a view among houses: below the first the camera is not shown,
from the second on one close to the reported one is not sought any farther. Over towns right ones
had 0.15 and more, wrong ones at most 0.12 (docs/terrain.md)."""
AGAIN_PX = 1.0
"""A view is orthorectified once more where its correction moves a block by more pixels of the final
level."""
VARIANCE, VARIANCE_POWER, LEAST_RATIO = 1.6, -0.8, 0.5
"""Variance of the errors of blocks over what their curvature says: the first, times the local ratio
of the place (at least the third) to the power of the second (docs/decisions/camera.md)."""
Array = NDArray[np.float64]
STAYS: Array = np.zeros(6)
"""No correction of a camera."""


def picture_by_ground(camera: Camera, orientation: Orientation, ground_m: Array) -> Array:
    """Pixels (N, 2, 3) by which points of the ground (N, 3) move in the picture per metre east,
    north and up; NaN where not seen."""
    steps = GROUND_STEP_M * np.concatenate([np.eye(3), -np.eye(3)])
    ahead, behind = orientation.seen_px(camera, ground_m + steps[:, None]).reshape(2, 3, -1, 2)
    return np.asarray(np.moveaxis(ahead - behind, 0, -1) / (2 * GROUND_STEP_M))


def ground_by_picture(by_ground: Array, slopes: Array) -> Array:
    """Metres (N, 2, 2) along the ground per pixel of the picture; NaN where not seen. `by_ground`
    (N, 2, 3): `picture_by_ground`; `slopes` (N, 2): rise of the ground."""
    along = by_ground[:, :, :2] + by_ground[:, :, 2:] * slopes[:, None]
    known = np.isfinite(along).all(axis=(1, 2), keepdims=True)
    return np.where(known, np.linalg.inv(np.where(known, along, np.eye(2))), np.nan)


def picture_by_camera(
    camera: Camera, orientation: Orientation, ground_m: Array, by_ground: Array
) -> Array:
    """Pixels (N, 2, 6) by which points of the ground (N, 3) move in the picture per unit of the
    camera. `by_ground` (N, 2, 3): `picture_by_ground`, as of a camera that moves the other way."""
    steps = np.concatenate([np.diag(STEPS[3:]), -np.diag(STEPS[3:])])
    attitudes_deg = (orientation.attitude_deg + steps).tolist()
    rotations = np.stack([enu_from_camera(*each) for each in attitudes_deg])
    ahead, behind = seen_px(camera, (ground_m - orientation.position_m) @ rotations).reshape(
        2, 3, -1, 2
    )
    turned = np.moveaxis((ahead - behind) / (2 * STEPS[3:, None, None]), 0, -1)
    return np.concatenate([-by_ground, turned], axis=2)


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


def approached(seen: ViewOverGround, reference: Reference, pose: Pose) -> Orientation | None:
    """The camera of a view that was placed at `pose`, known to some pixels; None where too few
    blocks are seen."""
    start = seen.orientation(pose)
    if start is None:
        return None
    smooth = _climbed(seen, reference, pose, start, FIRST_REACH_PX, finer=False)
    if seen.relief.surface is None:
        return smooth
    end = _among_houses(seen, reference, pose, start)
    if end is None or smooth is None:
        return smooth if end is None else end[1]
    away = np.concatenate([smooth.position_m - end[1].position_m, _turn(end[1], smooth)])
    if end[0].moves_px(away) < SURFACE_REACHES_PX[0] * 2.0 ** (seen.view.levels.final - 1):
        return end[1]
    # Over roofs the fit may end at another camera; that which fits best is right.
    other = _among_houses(seen, reference, pose, smooth)
    return end[1] if other is None or other[0].fit() <= end[0].fit() else other[1]


def _turn(one: Orientation, other: Orientation) -> Array:
    """From one attitude to the other (3,), within half a turn."""
    return np.asarray((other.attitude_deg - one.attitude_deg + 180.0) % 360.0 - 180.0)


def _close(
    seen: ViewOverGround, reference: Reference, pose: Pose
) -> "tuple[_Compared, Orientation] | None":
    """The camera among houses, with the blocks there, where it is close to the reported one."""
    start = seen.orientation(pose)
    if seen.relief.surface is None or start is None:
        return None
    end = _among_houses(seen, reference, pose, start, SURFACE_REACHES_PX[-1:])
    return None if end is None or end[0].mean_correlation() < CLOSE_FIT else end


def _among_houses(
    seen: ViewOverGround,
    reference: Reference,
    pose: Pose,
    start: Orientation,
    reaches_px: tuple[int, ...] = SURFACE_REACHES_PX,
) -> "tuple[_Compared, Orientation] | None":
    """The camera where the fit ends, with the blocks there."""
    orientation: Orientation | None = start
    for reach_px in reaches_px:
        if orientation is not None:
            orientation = _climbed(seen, reference, pose, orientation, reach_px, finer=True)
    if orientation is None:
        return None
    end = _compared(seen, reference, pose, orientation, REACH_PX, finer=True)
    return None if end is None else (end, orientation)


def _climbed(
    seen: ViewOverGround,
    reference: Reference,
    pose: Pose,
    start: Orientation,
    reach_px: int,
    *,
    finer: bool,
) -> Orientation | None:
    compared = _compared(seen, reference, pose, start, reach_px, finer=finer)
    correction = None if compared is None else compared.climbed()
    return None if correction is None else start.moved(correction)


def camera_found(
    seen: ViewOverGround,
    reference: Reference,
    pose: Pose,
    local_ratio: float,
    start: Orientation | None = None,
) -> CameraFound | None:
    """Position, attitude and covariance of the camera of a view that was placed at `pose`; None
    where too few blocks are seen, or the camera would be below the ground.

    `local_ratio`: of the scores of the place. `start`: `approached`, where it is known."""
    if math.isnan(seen.reference_m(pose)):  # it was placed on level ground
        level = Relief(LevelTerrain(), seen.relief.grid, land=seen.relief.land)
        seen, start = ViewOverGround(level, seen.view), None
    close = None if start is not None else _close(seen, reference, pose)
    if close is not None:
        start = close[1]
    start = start or approached(seen, reference, pose)
    if start is None:
        return None
    variance = VARIANCE * max(local_ratio, LEAST_RATIO) ** VARIANCE_POWER
    near = _fitted(seen, reference, pose, start, variance, close and close[0])
    if near is not None and near.moved_px > AGAIN_PX * 2.0**seen.view.levels.final:
        near = _fitted(seen, reference, pose, near.orientation, variance)
    if near is None or not near.is_shown:
        return None
    found, orientation = near.found, near.orientation
    east, north, above_sea_m = orientation.position_m.tolist()
    below_m = float(seen.relief.terrain.at_en_m([east, north]))
    agl_m = above_sea_m - (seen.reference_m(pose) if math.isnan(below_m) else below_m)
    if not agl_m > 0:
        return None
    sight_en_m = seen.sight_en_m(orientation)
    return CameraFound(
        orientation,
        agl_m,
        found.covariance,
        near.start.moved(found.alone),
        found.alone_covariance,
        variance,
        seen.middle_en_m(sight_en_m, pose),
        _middle_covariance(seen, orientation, sight_en_m, found.covariance),
    )


def tilt_std_deg(telemetry: Telemetry) -> float:
    """Standard deviation of the reported pitch and roll, the default where none is stated."""
    stated = telemetry.tilt_std_deg
    return DEFAULT_TILT_STD_DEG if stated is None else stated


class _Fitted(NamedTuple):
    """A resection from `start`; it moved a block by up to `moved_px`, pixels of level 0.

    `is_shown`: whether the blocks fit the map there; over bare ground they are not asked."""

    start: Orientation
    found: Resection
    moved_px: float
    is_shown: bool

    @property
    def orientation(self) -> Orientation:
        return self.start.moved(self.found.correction)


def _fitted(
    seen: ViewOverGround,
    reference: Reference,
    pose: Pose,
    start: Orientation,
    variance: float,
    near: "_Compared | None" = None,
) -> _Fitted | None:
    """`near`: the blocks under `start`, None: to be compared."""
    near = near or _compared(seen, reference, pose, start, REACH_PX, finer=True)
    found = None if near is None else near.resected(variance)
    if near is None or found is None:
        return None
    is_shown = not seen.relief.shows_houses(near.ground_m)
    is_shown = is_shown or near.mean_correlation(found.correction) >= LEAST_FIT
    return _Fitted(start, found, near.moves_px(found.correction), is_shown)


@dataclass(frozen=True, eq=False)
class _Compared:
    """Blocks of a view under an orientation, beside the map.

    - `seen`: the view. `expected`: its camera by telemetry.
    - `blocks`: of each level, and its pixel in pixels of level 0.
    - `ground_m` (N, 3): in their middles, and its `errors`.
    - `moved_px` (N, 2, 6): they move by so many pixels of level 0 per unit of the camera.
    - `by_lens_px`: see `systematic`."""

    seen: ViewOverGround
    expected: Expected
    blocks: list[tuple[BlockScores, float]]
    ground_m: Array
    errors: GroundErrors
    moved_px: Array
    by_lens_px: Array | None

    @property
    def block_px(self) -> float:
        return self.seen.view.side_px / BLOCKS

    def fit(self, correction: Array = STAYS) -> float:
        """Sum of the correlations of the finest blocks under a correction (6,), over what chance
        makes."""
        (correlations, pixels, _), pixel = self.blocks[0]
        moved_px = np.nan_to_num(self.moved_px @ correction) / pixel
        return float((values(correlations, moved_px) * np.sqrt(pixels)).sum())

    def mean_correlation(self, correction: Array = STAYS) -> float:
        """Of the same blocks, weighted by the roots of their pixels."""
        return self.fit(correction) / max(float(np.sqrt(self.blocks[0][0].pixels).sum()), 1.0)

    def moves_px(self, correction: Array) -> float:
        """How far a correction (6,) moves a block, pixels of level 0."""
        return float(np.nanmax(np.hypot(*(self.moved_px @ correction).T)))

    def climbed(self) -> Array | None:
        blocks, moved_px, slope = self.blocks, self.moved_px, self.errors.slope
        return climbed(blocks, moved_px, self.expected, slope, block_px=self.block_px)

    def resected(self, variance: float) -> Resection | None:
        errors = systematic(
            self.errors,
            places_m=self.ground_m[:, :2],
            # Raised ground moves as under a camera that is lower by as much.
            by_height_px=-self.moved_px[:, :, 2],
            by_lens_px=self.by_lens_px,
            block_px=self.block_px,
            gsd_m=self.seen.relief.grid.gsd_m,
        )
        return resected(
            self.blocks,
            self.moved_px,
            self.expected,
            errors,
            variance=variance,
            block_px=self.block_px,
        )


def _compared(
    seen: ViewOverGround,
    reference: Reference,
    pose: Pose,
    orientation: Orientation,
    reach_px: int,
    *,
    finer: bool,
) -> _Compared | None:
    """The blocks of a view under an orientation, compared with the map, moved by up to `reach_px`
    pixels of the level; None: too few pixels. At the final level and a coarser one, or at a finer
    one too."""
    final = seen.view.levels.final
    finest = max(final - 1, 0) if finer else final
    made = _templates(seen, pose, finest, orientation, first=not finer)
    if made is None:
        return None
    coarsest = min(final + 1, reference.levels - 1)
    levels = [at for at in range(finest, coarsest + 1) if min(made.shape(at)) >= BLOCKS]
    if not levels:
        return None
    blocks = [(block_scores(made.at(at), reference, pose, reach_px), 2.0**at) for at in levels]
    camera = seen.view.picture_at(finest).camera
    ground = seen.relief.ground_m(pose.map_px(blocks[0][0].middles_px * blocks[0][1]))
    slopes = seen.relief.slopes(ground)
    window_from_en = np.linalg.inv(pose.linear) @ np.diag([1.0, -1.0]) / seen.relief.grid.gsd_m
    by_ground = picture_by_ground(camera, orientation, ground)
    by_picture = window_from_en @ ground_by_picture(by_ground, slopes)
    by_lens = None
    if camera.focal_std > 0:
        by_lens = by_picture @ lens_px(camera, orientation.seen_px(camera, ground))
    return _Compared(
        seen,
        _expected(seen, pose, orientation),
        blocks,
        ground,
        seen.relief.errors(ground, slopes),
        -by_picture @ picture_by_camera(camera, orientation, ground, by_ground),
        by_lens,
    )


def _templates(
    seen: ViewOverGround, pose: Pose, level: int, orientation: Orientation, *, first: bool
) -> ViewTemplates | None:
    """Rectified under an orientation; over level ground the first is the search's."""
    if first and seen.is_level(pose) and not is_oblique(seen.view.view):
        return seen.view.templates
    return seen.templates_at(pose, level, orientation, smooth=first)


def _middle_covariance(
    seen: ViewOverGround, orientation: Orientation, sight_en_m: Array, covariance: Array
) -> Array | None:
    """Of the ground (2, 2), m2, that the middle of a view shows; None beside unknown ground."""
    point = np.array([[*sight_en_m, float(seen.relief.terrain.at_en_m(sight_en_m))]])
    slopes = seen.relief.slopes(point)
    if not (np.isfinite(point).all() and np.isfinite(slopes).all()):
        return None
    camera = seen.view.picture_at(seen.view.levels.final).camera
    by_ground = picture_by_ground(camera, orientation, point)
    by_camera = picture_by_camera(camera, orientation, point, by_ground)
    moved = (ground_by_picture(by_ground, slopes) @ by_camera)[0]
    return np.asarray(moved @ covariance @ moved.T)


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
