"""Odometry by the camera: the displacement between two views, by registering one on the other."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import axis_on_ground_en_m
from orthonav.core.localize.ground import GroundModel
from orthonav.core.localize.place import CandidateRefiner
from orthonav.core.localize.view import check_footprint, downsampled, rectify_footprint
from orthonav.core.records import Telemetry, View
from orthonav.core.register.refine import Fit
from orthonav.core.register.search import bank, search_around
from orthonav.core.register.template import FINE, ChannelRecipe, Levels, ViewTemplates
from orthonav.core.register.window import DirectionPrior, Pose, Reference

Array = NDArray[np.float64]
NO_BIAS: Array = np.zeros(4)


@dataclass(frozen=True)
class OdometryLimits:
    """How views are compared; values without a source are by the flights of docs/tracking.md."""

    view_px: int = 160  # across: half that of a fix
    levels: int = 3  # of a view that serves as the map of the next one
    heading_step_rad: float = math.radians(8.0)
    scale_step: float = 0.1
    """Of the search from a coarse level: about that of `SearchPlan`."""
    candidates: int = 8
    max_speed_mps: float = 80.0  # for which a displacement is sought
    min_score_ratio: float = 2.5
    """Over the strongest rival: at least 4 for right ones, at most 1.7 for wrong ones."""
    min_correlation: float = 0.4
    """Right ones have at least 0.56, wrong ones at most 0.11 (docs/tracking.md)."""
    expected_correlation: float = 0.6
    """An expected displacement that fits this well ends the search (docs/tracking.md)."""
    expected_steps: int = 5  # of it at each level, at most,
    small_step_px: float = 0.1  # and the step that ends them
    noise_px: float = 0.4  # per axis: in pixels,
    noise_share: float = 0.01  # and as a fraction of its length
    tilt_share: float = 0.6
    """Left of an independent error of the tilt in a sum: the next displacement cancels most."""
    same_scale: float = 0.01
    same_tilt_rad: float = math.radians(0.1)
    """Changes of log scale, and of pitch or roll, up to which a view is not rectified again."""
    lever_step_deg: float = 0.05  # of numerical derivatives by pitch and roll
    unknown_slope: float = 0.1  # of ground without a known slope,
    left_of_slope: float = 0.3  # and the fraction of it that a terrain leaves
    sight_steps: int = 4  # to the ground that a view shows: each leaves a fraction of the error
    min_scaled: float = 0.5  # height or distance over the one expected: less is an error


ODOMETRY = OdometryLimits()


def corrected_by(telemetry: Telemetry, bias: Array) -> Telemetry:
    """By (4,) of heading (rad), log scale, pitch and roll (rad)."""
    yaw_deg, pitch_deg, roll_deg = np.degrees(bias[[0, 2, 3]]).tolist()
    return replace(
        telemetry,
        yaw_deg=telemetry.yaw_deg + yaw_deg,
        agl_m=telemetry.agl_m * math.exp(bias[1]),
        pitch_deg=telemetry.pitch_deg + pitch_deg,
        roll_deg=telemetry.roll_deg + roll_deg,
    )


def tilt_lever_m(telemetry: Telemetry) -> Array:
    """Metres east and north (2, 2) per rad of pitch and roll: how the ground on the axis moves."""
    angles, columns = np.array([telemetry.yaw_deg, telemetry.pitch_deg, telemetry.roll_deg]), []
    for axis in (1, 2):
        step = np.zeros(3)
        step[axis] = ODOMETRY.lever_step_deg
        seen = []
        for sign in (1, -1):
            yaw_deg, pitch_deg, roll_deg = (angles + sign * step).tolist()
            seen.append(axis_on_ground_en_m(yaw_deg, pitch_deg, roll_deg, telemetry.agl_m))
        ahead, behind = seen
        columns.append(np.subtract(ahead, behind) / (2 * math.radians(ODOMETRY.lever_step_deg)))
    return np.stack(columns, axis=1)


class _ViewAsMap(Reference):
    """One rectified view in the role of the map, with the channels of its templates, in one thread.

    They differ by a factor for each kind, which changes no correlation."""

    def __init__(self, templates: ViewTemplates) -> None:
        self._templates = templates

    @property
    def levels(self) -> int:
        return ODOMETRY.levels

    def shape(self, level: int) -> tuple[int, int]:
        return self._templates.shape(level)

    def caches(self, level: int) -> bool:
        return True

    def whole(self, level: int, recipe: ChannelRecipe = FINE) -> NDArray[np.float32]:
        return self._templates.at(level, recipe).values


@dataclass(frozen=True, eq=False)
class OdometryView:
    """A view rectified for odometry, heading up, of `pixel_m`.

    `camera_px` (2,): the camera from its middle, right and down. `telemetry`: corrected by `bias`
    (4,) of heading (rad), log scale, pitch and roll (rad). `view`: averaged towards `pixel_m`."""

    templates: ViewTemplates
    pixel_m: float
    camera_px: Array
    telemetry: Telemetry
    bias: Array
    view: View

    @property
    def shape(self) -> tuple[int, int]:
        return self.templates.shape(0)

    @property
    def middle_px(self) -> tuple[float, float]:
        rows, cols = self.shape
        return cols / 2, rows / 2

    @property
    def en_from_px(self) -> Array:
        """(2, 2) from x, y to metres east and north, by the reported telemetry."""
        heading = math.radians(self.view.telemetry.yaw_deg)
        cos, sin = math.cos(heading), math.sin(heading)
        metres = self.pixel_m * math.exp(-self.bias[1])
        return np.array([[cos, -sin], [-sin, -cos]]) * metres

    @property
    def ahead_en_m(self) -> Array:
        """Middle of the view (2,) from the camera, by the same."""
        return np.asarray(self.en_from_px @ -self.camera_px)

    @classmethod
    def of(cls, view: View, pixel_m: float | None, bias: Array = NO_BIAS) -> "OdometryView | None":
        """None where it shows too little."""
        camera, telemetry = view.camera, corrected_by(view.telemetry, bias)
        side_m = camera.gsd_m(telemetry.agl_m) * math.sqrt(camera.width_px * camera.height_px)
        pixel_m = pixel_m or side_m / ODOMETRY.view_px
        thinned = downsampled(replace(view, telemetry=telemetry), pixel_m)
        made = rectify_footprint(thinned, gsd_m=pixel_m, multiple_px=2 ** (ODOMETRY.levels - 1))
        if check_footprint(made, 1.0, ODOMETRY.view_px / 4) is not None:
            return None
        camera_px = np.array([-made.offset_en_m[0], made.offset_en_m[1]]) / pixel_m
        templates = ViewTemplates(made.grey, made.valid, 0)
        return cls(
            templates=templates,
            pixel_m=pixel_m,
            camera_px=camera_px,
            telemetry=telemetry,
            bias=bias,
            view=replace(thinned, telemetry=view.telemetry),
        )

    def corrected(self, bias: Array) -> "OdometryView | None":
        """With the present biases: what was learnt between two views would else appear as motion
        (docs/tracking.md)."""
        change = np.abs(bias - self.bias)
        if change[1] > ODOMETRY.same_scale or (change[2:] > ODOMETRY.same_tilt_rad).any():
            return OdometryView.of(self.view, self.pixel_m, bias)
        # Rectified with its heading up, so only the heading may change without rectifying again.
        same = np.array([bias[0], *self.bias[1:]])
        return replace(self, telemetry=corrected_by(self.view.telemetry, same), bias=same)


@dataclass(frozen=True, eq=False)
class CameraDisplacement:
    """The displacement since the last view, measured by the camera.

    `moved_en_m` (2,), `covariance` (2, 2): rotated by heading and scaled by height as reported
    before, and so subject to their errors. `reach_m`: radius of the search. `turned_rad`, `scaled`:
    change of heading and log scale beyond the reported one. `levers_m` (2, 2, 2): metres east and
    north by an error of pitch and roll (rad), now and before; `corrected_rad` (2, 2): what they
    were corrected by."""

    moved_en_m: Array
    covariance: Array
    reach_m: float
    turned_rad: float = 0.0
    scaled: float = 0.0
    turned_std_rad: float = math.radians(0.4)
    scaled_std: float = 0.004
    levers_m: Array = field(default_factory=lambda: np.zeros((2, 2, 2)))
    corrected_rad: Array = field(default_factory=lambda: np.zeros((2, 2)))


@dataclass(frozen=True, eq=False)
class ViewDisplacement:
    """`overlap`: fraction of the later view that the earlier one shows too."""

    displacement: CameraDisplacement
    overlap: float


def displacement(
    before: OdometryView,
    now: OdometryView,
    tilt_noise_rad: float,
    telemetry_noise: Array,
    expected_en_m: Array | None = None,
) -> ViewDisplacement | None:
    """From one view to the next, of the same `pixel_m`; None without enough common ground.

    Rotated and scaled by the telemetry reported with the view before. `tilt_noise_rad`: of a
    reported tilt, independent at every view. `telemetry_noise` (3,): variances of heading (rad),
    log scale. `expected_en_m` (2,): tried first, which saves the search where it fits."""
    reported_turn = math.radians(now.telemetry.yaw_deg - before.telemetry.yaw_deg)
    if not math.isfinite(reported_turn):
        return None
    prior = DirectionPrior(
        math.remainder(reported_turn, 2 * math.pi),
        max(math.sqrt(2 * telemetry_noise[0]), ODOMETRY.heading_step_rad / 3),
        max(math.sqrt(2 * telemetry_noise[1]), ODOMETRY.scale_step / 3),
    )
    placed = _registered(before, now, prior, expected_en_m)
    if placed is None or placed.weighted < ODOMETRY.min_correlation:
        return None
    pose = placed.pose
    moved_en_m = before.en_from_px @ (
        pose.map_px(now.camera_px) - np.array(before.middle_px) - before.camera_px
    )
    std_m = math.hypot(
        ODOMETRY.noise_px * before.pixel_m, ODOMETRY.noise_share * float(np.hypot(*moved_en_m))
    )
    variance = std_m**2 + (ODOMETRY.tilt_share * now.telemetry.agl_m * tilt_noise_rad) ** 2
    reported_rad = math.radians(now.view.telemetry.yaw_deg - before.view.telemetry.yaw_deg)
    measured = CameraDisplacement(
        moved_en_m,
        np.eye(2) * variance,
        reach_m=_reach_px(before, now) * before.pixel_m,
        turned_rad=math.remainder(pose.heading_rad - reported_rad, 2 * math.pi),
        scaled=pose.log_scale + float(now.bias[1] - before.bias[1]),
        levers_m=np.stack([tilt_lever_m(now.telemetry), tilt_lever_m(before.telemetry)]),
        corrected_rad=np.stack([now.bias[2:], before.bias[2:]]),
    )
    return ViewDisplacement(measured, min(max(placed.overlap, 0.0), 1.0))


@dataclass(frozen=True, eq=False)
class Terrain:
    """Ground that is not level: slopes (2,), rise per metre, below the camera and ahead, where both
    views look; `rise`: of the ground there over that below, as a fraction of the height."""

    slope_below: Array
    slope_ahead: Array
    rise: float

    @classmethod
    def ahead(
        cls, ground: GroundModel, place: Array, agl_m: float, ahead_en_m: Array
    ) -> "Terrain | None":
        """Below a camera at a place (2,), `agl_m` above the ground there, and where it looks; None
        where unknown. `ahead_en_m` (2,): where it would look on flat ground."""
        place_ahead, rise = place, 0.0
        for _ in range(ODOMETRY.sight_steps):
            place_ahead = place + (1 - rise) * ahead_en_m
            ground_m = ground.terrain.at_en_m(np.stack([place, place_ahead]))
            rise = float(ground_m[1] - ground_m[0]) / agl_m
        slopes = ground.slopes(np.stack([place, place_ahead]))
        if not (np.isfinite(slopes).all() and math.isfinite(rise)):
            return None
        return cls(slopes[0], slopes[1], rise)


def over_terrain(
    measured: ViewDisplacement,
    agl_m: tuple[float, float],
    terrain: Terrain | None,
    ahead_en_m: Array,
) -> ViewDisplacement:
    """A displacement over ground that is not level.

    `agl_m`: reported with both views. `terrain`: None: unknown. `ahead_en_m` (2,): middle of a
    view.

    A slope along the displacement looks like a change of scale, one across it like a turn, each by
    half, about the middle of the views: this parallax displaces the camera. The displacement is
    seen at the distance of the ground there, and the height changes by what this rises
    (docs/terrain.md)."""
    flat, ground = measured.displacement, terrain or Terrain(np.zeros(2), np.zeros(2), 0.0)
    steep = max(1 + float(ground.slope_ahead @ ahead_en_m) / agl_m[0], ODOMETRY.min_scaled)
    share_en = flat.moved_en_m / (agl_m[0] * steep)
    scale = float(share_en @ ground.slope_ahead) / 2
    turn = float(share_en[1] * ground.slope_ahead[0] - share_en[0] * ground.slope_ahead[1]) / 2
    parallax = np.array([[scale, -turn], [turn, scale]])
    distance = max(1 - ground.rise, ODOMETRY.min_scaled)  # over the height, as on flat ground
    moved_en_m = distance * (flat.moved_en_m + parallax @ ahead_en_m)
    # What remains of the slope: all of a usual one where it is unknown.
    slope = ODOMETRY.unknown_slope * (1.0 if terrain is None else ODOMETRY.left_of_slope)
    slope *= float(np.hypot(*moved_en_m)) / agl_m[0]
    aside_m = float(np.hypot(*ahead_en_m)) * slope / 2
    reported = math.log(agl_m[1] / agl_m[0])
    height_ahead = distance * (math.exp(flat.scaled + reported) - scale)
    risen = float(moved_en_m @ ground.slope_below) / agl_m[0]
    # Of the later view, over that of the earlier one.
    height = height_ahead + (1 - distance) - risen
    over = replace(
        flat,
        moved_en_m=moved_en_m,
        covariance=flat.covariance + np.eye(2) * aside_m**2,
        turned_rad=flat.turned_rad + turn,
        turned_std_rad=math.hypot(flat.turned_std_rad, slope / 2),
        scaled=math.log(max(height, ODOMETRY.min_scaled)) - reported,
        scaled_std=math.hypot(flat.scaled_std, 1.5 * slope),
    )
    return replace(measured, displacement=over)


def _registered(
    before: OdometryView, now: OdometryView, prior: DirectionPrior, expected_en_m: Array | None
) -> Fit | None:
    """None where no place stands out."""
    templates, reference = now.templates, _ViewAsMap(before.templates)
    side_px = math.sqrt(float(templates.valid.sum()))
    refiner = CandidateRefiner(templates, Levels.of(side_px, ODOMETRY.levels), prior, reference)
    if expected_en_m is not None:
        fit = _as_expected(before, now, refiner, expected_en_m)
        if fit.weighted >= ODOMETRY.expected_correlation:
            return fit
    tried = bank(
        prior.heading_std_rad,
        prior.log_scale_std,
        heading_step_rad=ODOMETRY.heading_step_rad,
        scale_step=ODOMETRY.scale_step,
        sigmas=2.5,
    )
    directions = [((prior.heading_rad or 0.0) + turn, scale) for turn, scale in tried]
    level = refiner.levels.coarse
    template = refiner.levels.template(templates, level)
    where = before.middle_px, _reach_px(before, now) + 2.0 * 2**level
    found = search_around(template, reference, directions, *where, side_px, ODOMETRY.candidates)
    if not found:
        return None
    best = refiner.best(refiner.to_mid_level([each.pose for each in found], level))
    return best.place.fit if best.scores.peak_ratio >= ODOMETRY.min_score_ratio else None


def _as_expected(
    before: OdometryView, now: OdometryView, refiner: CandidateRefiner, expected_en_m: Array
) -> Fit:
    """From its expected place, from coarse to fine."""
    turned = Pose(0.0, 0.0, refiner.prior.heading_rad or 0.0, 0.0)
    moved_px = np.linalg.solve(before.en_from_px, expected_en_m)
    x, y = np.array(before.middle_px) + before.camera_px + moved_px - turned.map_px(now.camera_px)
    pose = replace(turned, x_px=float(x), y_px=float(y))
    for level in range(refiner.levels.mid, refiner.levels.final - 1, -1):
        steps = ODOMETRY.expected_steps, ODOMETRY.small_step_px
        fit = refiner.refiner(level).place(pose, *steps)
        pose = fit.pose
    return fit


def _reach_px(before: OdometryView, now: OdometryView) -> float:
    """How far from the earlier view the later one is sought, in pixels of both."""
    seconds = (now.telemetry.time_ns - before.telemetry.time_ns) / 1e9
    far = math.hypot(*before.shape)
    # A clock that stands still does not bound the distance.
    return min(ODOMETRY.max_speed_mps * seconds / before.pixel_m, far) if seconds > 0 else far
