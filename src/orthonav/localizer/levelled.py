"""A registered view placed anew together with how its camera tilts.

Autopilots and gimbals say how the camera tilts to a degree or a few; where a mount is off, every
fix is off by the height times that angle. A camera that tilts sees near ground larger than far
ground: told too little of it, the rectified view is bent against the map. So the view is rectified
under a few tilts around the expected one, and how well it fits each says which is true. A parabola
through these scores is what one view knows; of many views together the sum of them (a single peak
is bent by houses and hills, and most of that differs from view to view).

How position, heading and scale hang on the tilt is geometry: the similarity that takes what the
camera sees of flat ground under one tilt to what it sees under another.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.geo.camera import ground_en_m
from orthonav.localizer.registration import PreparedView, RegistrationLocalizer
from orthonav.records import View
from orthonav.register.refine import Placed

RIM_PX = 10.0
"""Tilts are tried so far from the expected one that the corner of the view moves by so many pixels:
scores that near to a peak are too bent to say where the middle of it is."""
MAX_STEP_RAD = math.radians(6.0)
NATS_PER_SCORE = 0.4
"""What a unit of the score says of a tilt: peaks of single views scatter by more than their
curvature would have it."""
WEAK_TILT_RAD = math.radians(20.0)
HANG_STEP_RAD = math.radians(0.5)
SEEN_POINTS = 5
"""Points of the image across and down that say how the ground seen moves with the tilt."""
STEPS, SMALL_STEP_PX = 3, 0.1
"""A view under another tilt lies where geometry says, nearly: it needs few steps."""
Array = NDArray[np.float64]
BOTH: Array = np.ones(2)
BOTH.flags.writeable = False


@dataclass(frozen=True, eq=False)
class Levelled:
    """Where a view was taken, how it was turned and how it tilts.

    `mean` (6,): metres east and north of the sheet's origin, heading (rad), log scale (of true over
    told height), pitch and roll (rad); `covariance` (6, 6) of them, of what the view itself says: a
    tilt that it does not show is known to 20 deg.
    """

    mean: Array
    covariance: Array


def levelled(
    registration: RegistrationLocalizer,
    view: View,
    prepared: PreparedView,
    placed: Placed,
    worth: Array = BOTH,
) -> Levelled | None:
    """The view, prepared as `prepared` and `placed` at its final level, with its tilt.

    The pitch and roll of its telemetry are those to be expected; a tilt that differs by more than a
    few degrees is found in several views, each from what is known by then. What perspective says of
    the two counts `worth` (2,) times; with 0 it is not looked at, and that tilt is known to 20 deg.
    None where the view cannot be looked at under tilts around the expected one.
    """
    if placed.covariance is None:
        placed = registration.registrar.with_covariance(prepared.templates, prepared.levels, placed)
    tilt = np.radians([view.telemetry.pitch_deg, view.telemetry.roll_deg])
    mean, known = registration.seen_from(prepared, placed.pose), np.zeros(2)
    hangs = _hangs(view, mean)
    if hangs is None:
        return None
    looks = _Looks(registration, view, prepared.levels.final)
    for axis in np.flatnonzero(worth).tolist():
        after, before = (looks.score(mean, hangs, tilt, axis, sign) for sign in (1, -1))
        if after is None or before is None:
            return None
        known[axis], move = looks.judged(placed.score, after, before, float(worth[axis]))
        tilt[axis] += move
        mean += hangs[:, axis] * move
    spread = np.diag(1 / (known + WEAK_TILT_RAD**-2))
    covariance = np.zeros((6, 6))
    covariance[:4, :4] = registration.covariance(prepared, placed) + hangs @ spread @ hangs.T
    covariance[:4, 4:] = hangs @ spread
    covariance[4:, :4] = covariance[:4, 4:].T
    covariance[4:, 4:] = spread
    if not np.isfinite(covariance).all():
        return None
    return Levelled(np.concatenate([mean, tilt]), covariance)


def _hangs(view: View, mean: Array) -> Array | None:
    """How camera position (m), heading and log scale change with pitch and roll: (4, 2).

    What the view shows stays where it is on the map. None where too little of it is ground.
    """
    camera, telemetry = view.camera, view.telemetry
    share = (np.arange(SEEN_POINTS) + 0.5) / SEEN_POINTS
    px = np.stack(np.meshgrid(share * camera.width_px, share * camera.height_px), -1).reshape(-1, 2)
    tilt = np.array([telemetry.pitch_deg, telemetry.roll_deg])
    cos, sin = np.exp(mean[3]) * np.array([math.cos(mean[2]), math.sin(mean[2])])
    out = np.zeros((4, 2))
    for axis in range(2):
        seen = []
        for sign in (1, -1):
            tilts = tilt.copy()
            tilts[axis] += sign * math.degrees(HANG_STEP_RAD)
            pitch, roll = tilts.tolist()
            seen.append(ground_en_m(camera, px, 0.0, pitch, roll, telemetry.agl_m))
        both = np.isfinite(seen).all(axis=(0, 2))
        if both.sum() < SEEN_POINTS:
            return None
        after, before = seen[0][both], seen[1][both]
        right, forward, turn, scale = _similarity(after, before)
        out[:, axis] = right * cos + forward * sin, forward * cos - right * sin, turn, scale
    return out / (2 * HANG_STEP_RAD)


def _similarity(of: Array, to: Array) -> tuple[float, float, float, float]:
    """Shift right and forward (m), turn clockwise (rad) and log scale that best take points (N, 2)
    to others, for small ones."""
    x, y = of.T
    one, zero = np.ones(len(of)), np.zeros(len(of))
    rows = np.stack([np.stack([one, zero, y, x], -1), np.stack([zero, one, -x, y], -1)], axis=1)
    found, *_ = np.linalg.lstsq(rows.reshape(-1, 4), (to - of).reshape(-1), rcond=None)
    return tuple(found.tolist())


class _Looks:
    """Looks at one view under several tilts."""

    def __init__(self, registration: RegistrationLocalizer, view: View, level: int) -> None:
        self._registration, self._view = registration, view
        camera, telemetry = view.camera, view.telemetry
        corner = math.hypot(camera.width_px / camera.fx_px, camera.height_px / camera.fy_px) / 2
        rim_m = RIM_PX * registration.grid.gsd_m * 2**level
        self.step_rad = min(rim_m / max(telemetry.agl_m * corner**2, 1e-9), MAX_STEP_RAD)

    def score(
        self, mean: Array, hangs: Array, tilt_rad: Array, axis: int, sign: int
    ) -> float | None:
        """Score of the view tilted one step more about one axis, from where geometry puts it."""
        tilts = tilt_rad.copy()
        tilts[axis] += sign * self.step_rad
        pitch, roll = np.degrees(tilts).tolist()
        telemetry = replace(self._view.telemetry, pitch_deg=pitch, roll_deg=roll)
        tilted = replace(self._view, telemetry=telemetry)
        view = self._registration.prepared(tilted, heading_known=True)
        if not isinstance(view, PreparedView):
            return None
        pose = self._registration.pose_of(view, mean + sign * self.step_rad * hangs[:, axis])
        refiner = self._registration.registrar.refiner(
            view.templates, view.levels, view.levels.final
        )
        return refiner.place(pose, STEPS, SMALL_STEP_PX).score

    def judged(
        self, middle: float, after: float, before: float, worth: float
    ) -> tuple[float, float]:
        """What the scores under three tilts say: inverse variance, and by how much it tilts more
        than expected (rad)."""
        slope = (after - before) / (2 * self.step_rad)
        bend = 2 * middle - after - before
        # On a flank it bends less than at the peak: no farther than to the next tilt tried.
        bend = max(bend / self.step_rad**2, abs(slope) / self.step_rad)
        known = worth * NATS_PER_SCORE * bend
        return known, worth * NATS_PER_SCORE * slope / (known + WEAK_TILT_RAD**-2)
