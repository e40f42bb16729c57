"""How far the aircraft moved between two views, by registering one on the other."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.localizer.checks import check_footprint
from orthonav.localizer.rectify import downsampled, rectify_footprint
from orthonav.records import Telemetry, View
from orthonav.register.pose import Pose
from orthonav.register.reference import Reference
from orthonav.register.refine import Placed
from orthonav.register.registrar import Levels, PosePrior, Registrar
from orthonav.register.search import bank, search
from orthonav.register.template import ViewTemplates, halved
from orthonav.track import CameraDisplacement

VIEW_PX = 160
"""Views are compared at about so many pixels across."""
LEVELS = 3
TURN_STEP_RAD, SCALE_STEP = math.radians(8.0), 0.1
MAX_SPEED_MPS = 80.0
MIN_SCORE_RATIO = 2.5
MIN_CORRELATION = 0.4
"""Right ways have 4 and 0.56 at the least on Arroio and generated ground, wrong ones 1.7 and 0.11
at the most."""
SURE_CORRELATION = 0.6
"""A way that is as expected and fits so well is not looked for elsewhere."""
NOISE_PX, NOISE_SHARE = 0.4, 0.01
CANDIDATES = 8
EXPECTED_STEPS, SMALL_STEP_PX = 5, 0.1
TILT_SHARE = 0.6
"""How much of what a wrong tilt moves a view stays in the sum of many ways: the next way takes most
of it back."""
SAME_BIAS = np.array([math.inf, 0.01, math.radians(0.1), math.radians(0.1)])
"""Differences of heading, log scale, pitch and roll for which a view is not rectified anew. A
heading needs none: views are rectified with it up."""
Array = NDArray[np.float64]
NO_BIAS: Array = np.zeros(4)


def corrected_by(telemetry: Telemetry, bias: Array) -> Telemetry:
    """What is told, less what is known to be wrong with it (4,): heading (rad), log scale, pitch
    and roll (rad)."""
    yaw_deg, pitch_deg, roll_deg = np.degrees(bias[[0, 2, 3]]).tolist()
    return replace(
        telemetry,
        yaw_deg=telemetry.yaw_deg + yaw_deg,
        agl_m=telemetry.agl_m * math.exp(bias[1]),
        pitch_deg=telemetry.pitch_deg + pitch_deg,
        roll_deg=telemetry.roll_deg + roll_deg,
    )


class _Picture:
    """One rectified view as a map: grey and valid (H, W) at several levels."""

    levels = LEVELS

    def __init__(self, grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> None:
        self._pictures = [(grey, valid)]
        for _ in range(LEVELS - 1):
            self._pictures.append(halved(*self._pictures[-1]))

    def shape(self, level: int) -> tuple[int, int]:
        """Rows and columns of a level."""
        rows, cols = self._pictures[level][0].shape
        return rows, cols

    def read(
        self, level: int, row: int, col: int, height: int, width: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Grey and valid (height, width) of a window, which may reach beyond the view."""
        out = np.zeros((height, width), np.uint8), np.zeros((height, width), np.bool_)
        rows, cols = self.shape(level)
        y0, x0, y1, x1 = max(row, 0), max(col, 0), min(row + height, rows), min(col + width, cols)
        if y0 < y1 and x0 < x1:
            for whole, part in zip(self._pictures[level], out, strict=True):
                part[y0 - row : y1 - row, x0 - col : x1 - col] = whole[y0:y1, x0:x1]
        return out


@dataclass(frozen=True, eq=False)
class Footprint:
    """A view as odometry sees it: rectified, heading up, `pixel_m` per pixel.

    `camera_px` is where the camera is from the middle, x to the right and y down; `telemetry` what
    it was rectified with: what was told, less what was known to be wrong with it, `bias` (4,) of
    heading, log scale, pitch and roll. `view` is what it was made of.
    """

    registrar: Registrar
    grey: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    pixel_m: float
    camera_px: Array
    telemetry: Telemetry
    bias: Array
    view: View

    @property
    def middle_px(self) -> tuple[float, float]:
        """Middle of the view, x and y."""
        rows, cols = self.grey.shape
        return cols / 2, rows / 2

    @property
    def en_from_px(self) -> Array:
        """What takes pixels (x, y) to metres east and north (2, 2), by what was told."""
        heading = math.radians(self.view.telemetry.yaw_deg)
        cos, sin = math.cos(heading), math.sin(heading)
        metres = self.pixel_m * math.exp(-self.bias[1])
        return np.array([[cos, -sin], [-sin, -cos]]) * metres

    @classmethod
    def of(
        cls,
        view: View,
        pixel_m: float | None,
        bias: Array = NO_BIAS,
    ) -> "Footprint | None":
        """A view for odometry, None where it shows too little."""
        camera, telemetry = view.camera, corrected_by(view.telemetry, bias)
        side_m = camera.gsd_m(telemetry.agl_m) * math.sqrt(camera.width_px * camera.height_px)
        pixel_m = pixel_m or side_m / VIEW_PX
        made = rectify_footprint(
            downsampled(replace(view, telemetry=telemetry), pixel_m),
            gsd_m=pixel_m,
            multiple_px=2 ** (LEVELS - 1),
        )
        if check_footprint(made, 1.0, VIEW_PX / 4) is not None:
            return None
        camera_px = np.array([-made.offset_en_m[0], made.offset_en_m[1]]) / pixel_m
        registrar = Registrar(Reference(_Picture(made.grey, made.valid)))
        return cls(registrar, made.grey, made.valid, pixel_m, camera_px, telemetry, bias, view)

    def by(self, bias: Array) -> "Footprint | None":
        """The same view by what is known now to be wrong with what is told.

        Two views must be seen by the same: else what was learnt between them, a tilt most of all,
        would look like a way gone.
        """
        if (np.abs(bias - self.bias)[1:] > SAME_BIAS[1:]).any():
            return Footprint.of(self.view, self.pixel_m, bias)
        # Rectified with the heading up, so that only this need not be what it was.
        kept = np.array([bias[0], *self.bias[1:]])
        return replace(self, telemetry=corrected_by(self.view.telemetry, kept), bias=kept)


@dataclass(frozen=True, eq=False)
class Moved:
    """A displacement, and the share of the later view that the earlier one showed too."""

    way: CameraDisplacement
    overlap: float


def moved_between(
    before: Footprint,
    now: Footprint,
    tilt_noise_rad: float,
    telemetry_noise: Array,
    expected_en_m: Array | None = None,
) -> Moved | None:
    """The way from one view to the next, both with the same `pixel_m`; None where they do not
    show enough of the same ground to say.

    The displacement is turned and scaled as was told of the view before; `tilt_noise_rad` is how
    the tilt differs from what was told between views, `telemetry_noise` (2,) the variances with
    which reported heading (rad) and log scale do. A way that is `expected_en_m` (2,) is tried
    first; it saves the search where it fits, and changes nothing where it does not.
    """
    reported_turn = math.radians(now.telemetry.yaw_deg - before.telemetry.yaw_deg)
    if not math.isfinite(reported_turn):
        return None
    prior = PosePrior(
        math.remainder(reported_turn, 2 * math.pi),
        max(math.sqrt(2 * telemetry_noise[0]), TURN_STEP_RAD / 3),
        max(math.sqrt(2 * telemetry_noise[1]), SCALE_STEP / 3),
    )
    placed = _registered(before, now, prior, expected_en_m)
    if placed is None or placed.weighted < MIN_CORRELATION:
        return None
    pose = placed.pose
    way = before.en_from_px @ (
        pose.map_px(now.camera_px) - np.array(before.middle_px) - before.camera_px
    )
    std_m = math.hypot(NOISE_PX * before.pixel_m, NOISE_SHARE * float(np.hypot(*way)))
    variance = std_m**2 + (TILT_SHARE * now.telemetry.agl_m * tilt_noise_rad) ** 2
    reported_rad = math.radians(now.view.telemetry.yaw_deg - before.view.telemetry.yaw_deg)
    seen = CameraDisplacement(
        way,
        np.eye(2) * variance,
        reach_m=_reach_px(before, now) * before.pixel_m,
        turned_rad=math.remainder(pose.turn_rad - reported_rad, 2 * math.pi),
        scaled=pose.log_scale + float(now.bias[1] - before.bias[1]),
    )
    return Moved(seen, min(max(placed.overlap, 0.0), 1.0))


def _registered(
    before: Footprint, now: Footprint, prior: PosePrior, expected_en_m: Array | None
) -> Placed | None:
    """The later view registered on the earlier one, where the best place stands out."""
    templates = ViewTemplates(now.grey, now.valid, 0)
    side_px = math.sqrt(float(now.valid.sum()))
    levels = Levels.of(side_px, LEVELS)
    if expected_en_m is not None:
        placed = _as_expected(before, now, templates, levels, prior, expected_en_m)
        if placed.weighted >= SURE_CORRELATION:
            return placed
    reach = _reach_px(before, now)
    tried = bank(
        prior.turn_std_rad,
        prior.log_scale_std,
        turn_step_rad=TURN_STEP_RAD,
        scale_step=SCALE_STEP,
        sigmas=2.5,
    )
    poses = [((prior.turn_rad or 0.0) + turn, scale) for turn, scale in tried.poses]
    level = levels.coarse
    recipe = levels.recipe(level)
    registrar = before.registrar
    window = registrar.part_window(level, recipe, side_px, before.middle_px, reach + 2.0 * 2**level)
    candidates = search(templates.at(level, recipe), window, poses, CANDIDATES)
    if not candidates:
        return None
    judged = registrar.judged(templates, levels, candidates, level, prior)
    found = registrar.finished(templates, levels, judged, prior, len(candidates))
    return found.placed if found.peak_ratio >= MIN_SCORE_RATIO else None


def _as_expected(
    before: Footprint,
    now: Footprint,
    templates: ViewTemplates,
    levels: Levels,
    prior: PosePrior,
    expected_en_m: Array,
) -> Placed:
    """The later view as near as possible to where it should be, refined from coarse to fine."""
    turned = Pose(0.0, 0.0, prior.turn_rad or 0.0, 0.0)
    moved_px = np.linalg.solve(before.en_from_px, expected_en_m)
    x, y = np.array(before.middle_px) + before.camera_px + moved_px - turned.map_px(now.camera_px)
    pose = replace(turned, x_px=float(x), y_px=float(y))
    for level in range(levels.look, levels.final - 1, -1):
        refiner = before.registrar.refiner(templates, levels, level)
        placed = refiner.place(pose, EXPECTED_STEPS, SMALL_STEP_PX)
        pose = placed.pose
    return placed


def _reach_px(before: Footprint, now: Footprint) -> float:
    """How far from the earlier view the later one is looked for, in pixels of both."""
    seconds = (now.telemetry.time_ns - before.telemetry.time_ns) / 1e9
    far = math.hypot(*before.grey.shape)
    # A clock that stands still says nothing of how far it may be.
    return min(MAX_SPEED_MPS * seconds / before.pixel_m, far) if seconds > 0 else far
