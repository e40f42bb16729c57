"""A registered view placed anew together with how its camera leans.

Autopilots and gimbals say how the camera leans to a degree or a few; where a mount is off, every
fix is off by the height times that angle. The perspective of a wide view tells the lean itself.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.geo.camera import Camera, camera_from_en
from orthonav.localizer.registration import PreparedFootprint, RegistrationLocalizer
from orthonav.records import Telemetry
from orthonav.register.lean import LeanRefiner
from orthonav.register.pose import Pose
from orthonav.register.registrar import NAT_SCORE

ROUNDS, STEPS = 8, 4
SHRINKAGE, GROWTH, MOST_GROWTH = 0.4, 1.6, 2.5
UNDERRATED = 4.0
WORST_CONDITION = 1e14
WEAK_LEAN_RAD = math.radians(20.0)
SMALL_LEAN_RAD, MOST_STEP_RAD = math.radians(0.3), math.radians(5.0)
MOST_LEAN_RAD = math.radians(25.0)
_EPSILON_RAD = 1e-4
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Levelled:
    """Where a view was taken, how it was turned and how it leans.

    `mean` (6,): metres east and north of the sheet's origin, heading (rad), log scale (of true over
    told height), pitch and roll (rad); `covariance` (6, 6) of them, of what the view itself says: a
    lean that it does not show is known to 20 deg.
    """

    mean: Array
    covariance: Array


def levelled(
    registration: RegistrationLocalizer,
    grey: NDArray[np.uint8],
    camera: Camera,
    telemetry: Telemetry,
    view: PreparedFootprint,
    pose: Pose,
    *,
    lean_rad: tuple[float, float],
    lean_std_rad: float,
) -> Levelled | None:
    """The view (H, W), prepared as `view` and registered at `pose`, placed with its lean.

    `lean_rad` is the pitch and roll to be expected, `lean_std_rad` how well that is known. None
    where the view cannot be looked at under the lean that comes out.
    """
    expected = np.array(lean_rad)
    prior = np.diag([0.0, 0, 0, 0, lean_std_rad**-2, lean_std_rad**-2])
    best = _looked(registration, grey, camera, telemetry, (view, pose), expected)
    factor = 1.0
    for _ in range(ROUNDS):
        if best is None or np.abs(best.lean_rad - expected).max() > MOST_LEAN_RAD:
            return None
        step = factor * best.step(prior, expected)
        if np.abs(step[4:]).max() < SMALL_LEAN_RAD:
            break
        # How exactly a view knows its lean is underrated while it is far off: the step is tried.
        moved = Pose(*(np.array(_numbers(best.pose)) + step[:4]).tolist())
        start = best.view, moved
        tried = _looked(registration, grey, camera, telemetry, start, best.lean_rad + step[4:])
        if tried is not None and tried.worth(prior, expected) > best.worth(prior, expected):
            best, factor = tried, min(factor * GROWTH, MOST_GROWTH)
        else:
            factor *= SHRINKAGE
    if best is None:
        return None
    # What the view itself says, less what was expected.
    weak = np.diag([0.0, 0, 0, 0, WEAK_LEAN_RAD**-2, WEAK_LEAN_RAD**-2])
    covariance = np.asarray(np.linalg.inv(best.information + weak), np.float64)
    shift = covariance @ weak @ np.concatenate([np.zeros(4), expected - best.lean_rad])
    pose = Pose(*(np.array(_numbers(best.pose)) + shift[:4]).tolist())
    lean = np.asarray(best.lean_rad + shift[4:], np.float64)
    return _on_sheet(registration, best.view, pose, lean, covariance)


@dataclass(frozen=True, eq=False)
class _Looked:
    """A view under some lean: where it was placed, how well, and what it says of both."""

    view: PreparedFootprint
    pose: Pose
    lean_rad: Array
    score: float
    towards: Array
    information: Array

    def worth(self, prior: Array, expected_rad: Array) -> float:
        """Its score less what its lean costs for being unexpected, a unit for a nat."""
        off = self.lean_rad - expected_rad
        return self.score - NAT_SCORE * float(off @ prior[4:, 4:] @ off) / 2

    def step(self, prior: Array, expected_rad: Array) -> Array:
        """From here to the best pose and lean (6,), given what is expected."""
        off = np.concatenate([np.zeros(4), expected_rad - self.lean_rad])
        known = UNDERRATED * self.information
        step = np.linalg.solve(known + prior, known @ self.towards + prior @ off)
        return np.asarray(step * min(1.0, MOST_STEP_RAD / max(np.abs(step[4:]).max(), 1e-9)))


def _looked(
    registration: RegistrationLocalizer,
    grey: NDArray[np.uint8],
    camera: Camera,
    telemetry: Telemetry,
    start: tuple[PreparedFootprint, Pose],
    lean_rad: Array,
) -> _Looked | None:
    """The view rectified with a lean, and placed from where it was before."""
    pitch, roll = np.degrees(lean_rad).tolist()
    leaning = replace(telemetry, pitch_deg=pitch, roll_deg=roll)
    view = registration.prepared(grey, camera, leaning, heading_known=True)
    if not isinstance(view, PreparedFootprint):
        return None
    before, pose = start
    # The camera stays where it is: the middle of the new window lies elsewhere.
    x, y = pose.map_px(before.camera_px - view.camera_px)
    level = view.levels.final
    template = view.templates.at(level, view.levels.recipe(level))
    fields = lean_fields(telemetry.agl_m, lean_rad, view, registration.grid.gsd_m, level)
    refiner = LeanRefiner(template, registration.registrar.reference, fields)
    placed = refiner.place(replace(pose, x_px=float(x), y_px=float(y)), STEPS)
    found = refiner.look(placed.pose)
    if not np.linalg.cond(found.covariance) < WORST_CONDITION:
        return None
    information = np.asarray(np.linalg.inv(found.covariance), np.float64)
    return _Looked(view, placed.pose, lean_rad, placed.score, found.step, information)


def lean_fields(
    agl_m: float, lean_rad: Array, view: PreparedFootprint, gsd_m: float, level: int
) -> NDArray[np.float32]:
    """How the ground of each pixel of a rectified view moves with pitch and roll, (2, 2, H, W).

    In pixels of `level` per rad, x to the right and y down the view.
    """
    pixel_m = gsd_m * 2**level
    mask = view.templates.at(level, view.levels.recipe(level)).mask
    height, width = mask.shape
    middle = -view.camera_px * gsd_m
    x = middle[0] + (np.arange(width) + 0.5 - width / 2) * pixel_m
    y = middle[1] + (np.arange(height) + 0.5 - height / 2) * pixel_m
    ground = np.stack([*np.broadcast_arrays(x[None], -y[:, None]), np.ones((height, width))])
    pitch, roll = np.degrees(lean_rad)
    rays = np.tensordot(camera_from_en(0.0, pitch, roll, agl_m), ground, axes=1)
    out = np.empty((2, 2, height, width), np.float32)
    small = math.degrees(_EPSILON_RAD)
    for number, (more_pitch, more_roll) in enumerate(((small, 0.0), (0.0, small))):
        leaning = camera_from_en(0.0, pitch + more_pitch, roll + more_roll, agl_m)
        seen = np.tensordot(np.linalg.inv(leaning), rays, axes=1)
        moved = (seen[:2] / seen[2] - ground[:2]) / (_EPSILON_RAD * pixel_m)
        out[number, 0], out[number, 1] = moved[0], -moved[1]
    return out


def _numbers(pose: Pose) -> tuple[float, float, float, float]:
    return pose.x_px, pose.y_px, pose.turn_rad, pose.log_scale


def _on_sheet(
    registration: RegistrationLocalizer,
    view: PreparedFootprint,
    pose: Pose,
    lean_rad: Array,
    covariance: Array,
) -> Levelled:
    """Of the window's middle in pixels to the camera in metres."""
    grid = registration.grid
    x, y = pose.map_px(view.camera_px)
    moved = pose.linear @ view.camera_px
    turned = np.eye(6)
    turned[0, 2:4], turned[1, 2:4] = (-moved[1], moved[0]), (moved[0], moved[1])
    turned[0] *= grid.gsd_m
    turned[1] *= -grid.gsd_m
    spread = turned @ covariance @ turned.T
    spread[:2, :2] += np.eye(2) * (registration.floor_px * grid.gsd_m) ** 2
    position = grid.west_m + x * grid.gsd_m, grid.north_m - y * grid.gsd_m
    mean = np.array([*position, pose.turn_rad, pose.log_scale, *lean_rad])
    return Levelled(mean, spread)
