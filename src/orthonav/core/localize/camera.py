"""The camera of a placed view: position, height, heading, pitch and roll from the picture.

Blocks of the view are compared with the map a little aside, `resection` finds the camera that
explains them. Then the view is orthorectified one level finer, and fitted again."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera, enu_from_camera, seen_px
from orthonav.core.localize.ground import FlatTerrain, GroundModel, ViewOverGround
from orthonav.core.localize.resection import (
    Blocks,
    Expected,
    GroundErrors,
    Resection,
    lens_px,
    systematic,
    values,
)
from orthonav.core.localize.view import Orientation, is_oblique
from orthonav.core.records import DEFAULT_TILT_STD_DEG, Telemetry
from orthonav.core.register.refine import BlockScores, block_scores
from orthonav.core.register.template import BLOCKS, ViewTemplates
from orthonav.core.register.window import Pose

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CameraFitting:
    """How blocks of a view are fitted; reasons: docs/decisions/camera.md and terrain.md."""

    step_m: float = 1.0  # of numerical derivatives by points of the ground
    step_deg: float = 0.1  # and by the attitude
    min_tilt_std_deg: float = 0.05  # of a tilt that is reported as exact
    first_reach_px: int = 7
    """Pixels of the level: 10 deg of tilt at the rim of a view 65 deg wide."""
    reach_px: int = 4  # of the last comparison
    house_reaches_px: tuple[int, ...] = (16, 8)
    """The first reaches over houses and trees, at the finer level: coarser ones do not show the
    camera."""
    min_fit: float = 0.13
    """Mean correlation of the blocks of a view among houses, below which the camera is not shown.
    Over towns right cameras had 0.15 and more, wrong ones at most 0.12."""
    close_fit: float = 0.15  # a camera close to the reported one that fits so well is right
    moved_px: float = 1.0
    """A view is orthorectified again where its correction moves a block by more pixels of the final
    level."""
    variance: float = 1.6
    """Variance of the errors of blocks over what their curvature says, at a local ratio of 1,"""
    variance_power: float = -0.8  # times this power of the local ratio of the place,
    min_local_ratio: float = 0.5  # at least this


FITTING = CameraFitting()


def picture_by_ground(camera: Camera, orientation: Orientation, ground_m: Array) -> Array:
    """Pixels (N, 2, 3) by which points of the ground (N, 3) move in the picture per metre east,
    north and up; NaN where not seen."""
    steps = FITTING.step_m * np.concatenate([np.eye(3), -np.eye(3)])
    ahead, behind = orientation.seen_px(camera, ground_m + steps[:, None]).reshape(2, 3, -1, 2)
    return np.asarray(np.moveaxis(ahead - behind, 0, -1) / (2 * FITTING.step_m))


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
    steps = FITTING.step_deg * np.concatenate([np.eye(3), -np.eye(3)])
    attitudes_deg = (orientation.attitude_deg + steps).tolist()
    rotations = np.stack([enu_from_camera(*each) for each in attitudes_deg])
    ahead, behind = seen_px(camera, (ground_m - orientation.position_m) @ rotations).reshape(
        2, 3, -1, 2
    )
    turned = np.moveaxis((ahead - behind) / (2 * FITTING.step_deg), 0, -1)
    return np.concatenate([-by_ground, turned], axis=2)


@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """The camera of a view; `agl_m`: above the ground below it; `image_only`: without telemetry.

    - covariances (6, 6): m east, north, up, deg heading, pitch, roll; `WEAK` where not shown.
    - `middle_en_m`, `middle_covariance` (2, 2): ground in the middle of the picture, None: unknown.
    """

    orientation: Orientation
    agl_m: float
    covariance: Array
    image_only: Orientation
    image_only_covariance: Array
    middle_en_m: tuple[float, float]
    middle_covariance: Array | None


def approached(over_ground: ViewOverGround, pose: Pose) -> Orientation | None:
    """The camera of a view that was placed at `pose`, known to some pixels; None where too few
    blocks are seen."""
    start = over_ground.orientation(pose)
    if start is None:
        return None
    smooth = _climbed(over_ground, pose, start, FITTING.first_reach_px, finer=False)
    if over_ground.ground.surface is None:
        return smooth
    end = _among_houses(over_ground, pose, start)
    if end is None or smooth is None:
        return smooth if end is None else end.orientation
    if end.moves_px(_correction(end.orientation, smooth)) < (
        FITTING.house_reaches_px[0] * 2.0 ** (over_ground.view.levels.final - 1)
    ):
        return end.orientation
    # Over roofs the fit may end at another camera; that which fits best is right.
    other = _among_houses(over_ground, pose, smooth)
    return end.orientation if other is None or other.fit() <= end.fit() else other.orientation


def _correction(one: Orientation, other: Orientation) -> Array:
    """From one camera to the other (6,), turned by less than half a turn."""
    turn_deg = (other.attitude_deg - one.attitude_deg + 180.0) % 360.0 - 180.0
    return np.concatenate([other.position_m - one.position_m, turn_deg])


def _close(over_ground: ViewOverGround, pose: Pose) -> "_Compared | None":
    """The blocks among houses under a camera close to the reported one, where they fit."""
    start = over_ground.orientation(pose)
    if over_ground.ground.surface is None or start is None:
        return None
    end = _among_houses(over_ground, pose, start, FITTING.house_reaches_px[-1:])
    return None if end is None or end.mean_correlation() < FITTING.close_fit else end


def _among_houses(
    over_ground: ViewOverGround,
    pose: Pose,
    start: Orientation,
    reaches_px: tuple[int, ...] = FITTING.house_reaches_px,
) -> "_Compared | None":
    """The blocks under the camera where the fit ends."""
    orientation: Orientation | None = start
    for reach_px in reaches_px:
        if orientation is not None:
            orientation = _climbed(over_ground, pose, orientation, reach_px, finer=True)
    return None if orientation is None else _compared(over_ground, pose, orientation)


def _climbed(
    over_ground: ViewOverGround, pose: Pose, start: Orientation, reach_px: int, *, finer: bool
) -> Orientation | None:
    compared = _compared(over_ground, pose, start, reach_px, finer=finer)
    if compared is None or compared.blocks is None:
        return None
    return start.moved(compared.blocks.climb(compared.expected, compared.errors.slope))


def camera_of(
    over_ground: ViewOverGround,
    pose: Pose,
    local_ratio: float,
    floor_m: float,
    start: Orientation | None = None,
) -> CameraEstimate | None:
    """Position, attitude and covariance of the camera of a view that was placed at `pose`; None
    where too few blocks are seen, or the camera would be below the ground.

    `local_ratio`: of the scores of the place. `floor_m`: standard deviation with which maps of two
    dates agree. `start`: `approached`, where it is known."""
    if math.isnan(over_ground.reference_m(pose)):  # it was placed on flat ground
        level = GroundModel(FlatTerrain(), over_ground.ground.grid, land=over_ground.ground.land)
        over_ground, start = ViewOverGround(level, over_ground.view, over_ground.reference), None
    close = None if start is not None else _close(over_ground, pose)
    if close is not None:
        start = close.orientation
    start = start or approached(over_ground, pose)
    if start is None:
        return None
    ratio = max(local_ratio, FITTING.min_local_ratio)
    variance = FITTING.variance * ratio**FITTING.variance_power
    near = _fitted(close or _compared(over_ground, pose, start), variance)
    if near is not None and near.moved_px > FITTING.moved_px * 2.0**over_ground.view.levels.final:
        near = _fitted(_compared(over_ground, pose, near.orientation), variance)
    if near is None or not near.is_shown:
        return None
    found, orientation = near.found, near.orientation
    east, north, above_sea_m = orientation.position_m.tolist()
    below_m = float(over_ground.ground.terrain.at_en_m([east, north]))
    agl_m = above_sea_m - (over_ground.reference_m(pose) if math.isnan(below_m) else below_m)
    if not agl_m > 0:
        return None
    sight_en_m = over_ground.sight_en_m(orientation)
    middle = _middle_covariance(over_ground, orientation, sight_en_m, found.covariance)
    floor_m2 = np.eye(2) * floor_m**2 * variance
    return CameraEstimate(
        orientation,
        agl_m,
        _with_floor(found.covariance, floor_m2),
        near.start.moved(found.image_only),
        _with_floor(found.image_only_covariance, floor_m2),
        over_ground.middle_en_m(sight_en_m, pose),
        None if middle is None else middle + floor_m2,
    )


def _with_floor(covariance: Array, floor_m2: Array) -> Array:
    out = covariance.copy()
    out[:2, :2] += floor_m2
    return out


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


def _fitted(near: "_Compared | None", variance: float) -> _Fitted | None:
    found = None if near is None else near.resect(variance)
    if near is None or found is None:
        return None
    is_shown = not near.over_ground.ground.shows_houses(near.ground_m)
    is_shown = is_shown or near.mean_correlation(found.correction) >= FITTING.min_fit
    return _Fitted(near.orientation, found, near.moves_px(found.correction), is_shown)


@dataclass(frozen=True, eq=False)
class _Compared:
    """Blocks of a view under an orientation, beside the map.

    - `over_ground`: the view. `expected`: its camera by telemetry.
    - `finest`: blocks of the finest level, and its pixel in pixels of level 0.
    - `blocks`: of all levels, None: too few are seen.
    - `ground_m` (N, 3): in their middles, and its `errors`.
    - `moved_px` (N, 2, 6): they move by so many pixels of level 0 per unit of the camera.
    - `by_lens_px`: see `systematic`."""

    over_ground: ViewOverGround
    orientation: Orientation
    expected: Expected
    finest: tuple[BlockScores, float]
    blocks: Blocks | None
    ground_m: Array
    errors: GroundErrors
    moved_px: Array
    by_lens_px: Array | None

    def fit(self, correction: Array | None = None) -> float:
        """Sum of the correlations of the finest blocks under a correction (6,), over what chance
        makes."""
        (correlations, pixels, _), pixel = self.finest
        moved_px = np.zeros((len(pixels), 2))
        if correction is not None:
            moved_px = np.nan_to_num(self.moved_px @ correction) / pixel
        return float((values(correlations, moved_px) * np.sqrt(pixels)).sum())

    def mean_correlation(self, correction: Array | None = None) -> float:
        """Of the same blocks, weighted by the roots of their pixels."""
        return self.fit(correction) / max(float(np.sqrt(self.finest[0].pixels).sum()), 1.0)

    def moves_px(self, correction: Array) -> float:
        """How far a correction (6,) moves a block, pixels of level 0."""
        return float(np.nanmax(np.hypot(*(self.moved_px @ correction).T)))

    def resect(self, variance: float) -> Resection | None:
        if self.blocks is None:
            return None
        errors = systematic(
            self.errors,
            places_m=self.ground_m[:, :2],
            # Raised ground moves as under a camera that is lower by as much.
            by_height_px=-self.moved_px[:, :, 2],
            by_lens_px=self.by_lens_px,
            block_px=self.over_ground.view.side_px / BLOCKS,
            gsd_m=self.over_ground.ground.grid.gsd_m,
        )
        return self.blocks.resect(self.expected, errors, variance)


def _compared(
    over_ground: ViewOverGround,
    pose: Pose,
    orientation: Orientation,
    reach_px: int = FITTING.reach_px,
    *,
    finer: bool = True,
) -> _Compared | None:
    """The blocks of a view under an orientation, compared with the map, moved by up to `reach_px`
    pixels of the level; None: too few pixels. At the final level and a coarser one, or at a finer
    one too."""
    final, reference, ground_model = (
        over_ground.view.levels.final,
        over_ground.reference,
        over_ground.ground,
    )
    finest = max(final - 1, 0) if finer else final
    made = _templates(over_ground, pose, finest, orientation, first=not finer)
    if made is None:
        return None
    coarsest = min(final + 1, reference.levels - 1)
    levels = [at for at in range(finest, coarsest + 1) if min(made.shape(at)) >= BLOCKS]
    if not levels:
        return None
    scores = [(block_scores(made.at(at), reference, pose, reach_px), 2.0**at) for at in levels]
    camera = over_ground.view.picture_at(finest).camera
    ground = ground_model.ground_m(pose.map_px(scores[0][0].middles_px * scores[0][1]))
    slopes = ground_model.slopes(ground)
    window_from_en = np.linalg.inv(pose.linear) @ np.diag([1.0, -1.0]) / ground_model.grid.gsd_m
    by_ground = picture_by_ground(camera, orientation, ground)
    by_picture = window_from_en @ ground_by_picture(by_ground, slopes)
    by_lens = None
    if camera.focal_std > 0:
        by_lens = by_picture @ lens_px(camera, orientation.seen_px(camera, ground))
    moved_px = -by_picture @ picture_by_camera(camera, orientation, ground, by_ground)
    return _Compared(
        over_ground,
        orientation,
        _expected(over_ground, pose, orientation),
        scores[0],
        Blocks.of(scores, moved_px, over_ground.view.side_px / BLOCKS),
        ground,
        ground_model.errors(ground, slopes),
        moved_px,
        by_lens,
    )


def _templates(
    over_ground: ViewOverGround, pose: Pose, level: int, orientation: Orientation, *, first: bool
) -> ViewTemplates | None:
    """Rectified under an orientation; over flat ground the first is the search's."""
    if first and over_ground.is_flat_at(pose) and not is_oblique(over_ground.view.view):
        return over_ground.view.templates
    return over_ground.templates_at(pose, level, orientation, smooth=first)


def _middle_covariance(
    over_ground: ViewOverGround, orientation: Orientation, sight_en_m: Array, covariance: Array
) -> Array | None:
    """Of the ground (2, 2), m2, that the middle of a view shows; None beside unknown ground."""
    point = np.array([[*sight_en_m, float(over_ground.ground.terrain.at_en_m(sight_en_m))]])
    slopes = over_ground.ground.slopes(point)
    if not (np.isfinite(point).all() and np.isfinite(slopes).all()):
        return None
    camera = over_ground.view.picture_at(over_ground.view.levels.final).camera
    by_ground = picture_by_ground(camera, orientation, point)
    by_camera = picture_by_camera(camera, orientation, point, by_ground)
    moved = (ground_by_picture(by_ground, slopes) @ by_camera)[0]
    return np.asarray(moved @ covariance @ moved.T)


def _expected(over_ground: ViewOverGround, pose: Pose, orientation: Orientation) -> Expected:
    telemetry, prior = over_ground.view.telemetry, over_ground.view.prior
    expected, std = 0.0, prior.log_scale_std
    if prior.scale_map is not None:
        expected, std = prior.scale_map.at(pose.x_px, pose.y_px), prior.scale_map.std
    expected_m = over_ground.reference_m(pose) + telemetry.agl_m * math.exp(expected)
    up_m = expected_m - float(orientation.position_m[2])
    turn = math.degrees(prior.heading_rad or 0.0) - orientation.attitude_deg[0]
    tilt = np.array([telemetry.pitch_deg, telemetry.roll_deg]) - orientation.attitude_deg[1:]
    mean = np.array([0.0, 0.0, up_m, math.remainder(turn, 360.0), *tilt.tolist()])
    tilt_std = max(tilt_std_deg(telemetry), FITTING.min_tilt_std_deg)
    stds = np.array([1e4, 1e4, telemetry.agl_m * std, 180.0, tilt_std, tilt_std])
    if prior.heading_rad is not None:
        stds[3] = math.degrees(prior.heading_std_rad)
    else:
        mean[3] = 0.0
    return Expected(mean, np.diag(stds**-2))
