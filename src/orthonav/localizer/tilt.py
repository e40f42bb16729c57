"""The tilt of a registered view, from perspective.

Autopilots and gimbals report pitch and roll to a degree or a few; where a mount is misaligned,
every fix is off by the height times that angle. A tilted camera sees near ground larger than far
ground: rectified with the wrong tilt, the view is distorted against the map. So the view is
rectified under a few tilts around the expected one, and the score under each is a profile of the
tilt. A parabola through the scores is the information of one view; over many views the parabolas
add up (single peaks are biased by houses and hills, mostly differently from view to view).

The derivatives of position, heading and scale with respect to the tilt are geometry: the similarity
between what the camera sees of flat ground under two tilts.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from orthonav.geo.camera import Camera, camera_rays, met_by_rays_en_m
from orthonav.localizer.prepared import PreparedView
from orthonav.localizer.registration import RegistrationLocalizer
from orthonav.records import View
from orthonav.register.refine import Placed

RIM_PX = 10.0
"""Tilts are tried at such a distance from the expected one that the corner of the view moves by so
many pixels: closer to the peak the profile is dominated by single objects."""
MAX_STEP_RAD = math.radians(6.0)
"""Largest such distance."""
NATS_PER_SCORE = 0.4
"""Information of a unit of the score about a tilt: peaks of single views scatter by more than their
curvature implies (docs/decisions/tracking.md, 3)."""
WEAK_TILT_RAD = math.radians(20.0)
"""Standard deviation of a tilt that the view does not show."""
DERIVATIVE_STEP_RAD = math.radians(0.5)
"""Step of the numerical derivatives with respect to the tilt."""
SEEN_POINTS = 5
"""Image points across and down from which these derivatives are computed."""
STEPS, SMALL_STEP_PX = 3, 0.1
"""Refinement of a view under another tilt: geometry predicts its place, so few steps suffice."""
Array = NDArray[np.float64]
BOTH: Array = np.ones(2)
BOTH.flags.writeable = False


@dataclass(frozen=True, eq=False)
class TiltedPlace:
    """The position of a view with its heading, scale and tilt.

    `mean` (6,): metres east and north of the sheet's origin, heading (rad), log scale (of true over
    reported height), pitch and roll (rad). `covariance` (6, 6): of what the view itself shows; a
    tilt that it does not show has a standard deviation of 20 deg.
    """

    mean: Array
    covariance: Array


def with_tilt(
    registration: RegistrationLocalizer,
    view: View,
    prepared: PreparedView,
    placed: Placed,
    weights: Array = BOTH,
) -> TiltedPlace | None:
    """A placed view with its tilt from perspective.

    `prepared` is made of `view`, `placed` its place at the final level. The pitch and roll of its
    telemetry are the expected ones; a tilt that differs by more than a few degrees takes several
    views, each starting from the estimate so far. `weights` (2,) multiply the information about
    pitch and roll; with 0 that angle is not examined. None where the view cannot be rectified under
    tilts around the expected one.
    """
    if placed.covariance is None:
        again = registration.registrar.with_covariance(prepared.templates, prepared.levels, placed)
        placed = again if registration.relief is None else replace(again, pose=placed.pose)
    tilt = np.radians([view.telemetry.pitch_deg, view.telemetry.roll_deg])
    mean, known = registration.seen_from(prepared, placed.pose), np.zeros(2)
    slopes = _derivatives(view, mean)
    if slopes is None:
        return None
    profile = _TiltProfile(registration, view, prepared)
    for axis in np.flatnonzero(weights).tolist():
        after, before = (profile.score(mean, slopes, tilt, axis, sign) for sign in (1, -1))
        middle: float | None = placed.score
        if registration.relief is not None:  # it may have been placed on level ground
            middle = profile.score(mean, slopes, tilt, axis, 0)
        if middle is None or after is None or before is None:
            return None
        known[axis], move = profile.fitted(middle, after, before, float(weights[axis]))
        tilt[axis] += move
        mean += slopes[:, axis] * move
    spread = np.diag(1 / (known + WEAK_TILT_RAD**-2))
    covariance = np.zeros((6, 6))
    covariance[:4, :4] = registration.covariance(prepared, placed) + slopes @ spread @ slopes.T
    covariance[:4, 4:] = slopes @ spread
    covariance[4:, :4] = covariance[:4, 4:].T
    covariance[4:, 4:] = spread
    if not np.isfinite(covariance).all():
        return None
    return TiltedPlace(np.concatenate([mean, tilt]), covariance)


def _derivatives(view: View, mean: Array) -> Array | None:
    """Derivatives (4, 2) of camera position (m), heading and log scale by pitch and roll.

    The ground seen stays at its place on the map. None where too little of the view is ground.
    """
    telemetry, rays = view.telemetry, _seen_rays(view.camera)
    tilt = np.array([telemetry.pitch_deg, telemetry.roll_deg])
    cos, sin = np.exp(mean[3]) * np.array([math.cos(mean[2]), math.sin(mean[2])])
    out = np.zeros((4, 2))
    for axis in range(2):
        seen = []
        for sign in (1, -1):
            tilts = tilt.copy()
            tilts[axis] += sign * math.degrees(DERIVATIVE_STEP_RAD)
            pitch, roll = tilts.tolist()
            seen.append(met_by_rays_en_m(rays, 0.0, pitch, roll, telemetry.agl_m))
        both = np.isfinite(seen).all(axis=(0, 2))
        if both.sum() < SEEN_POINTS:
            return None
        after, before = seen[0][both], seen[1][both]
        right, forward, turn, scale = _similarity(after, before)
        out[:, axis] = right * cos + forward * sin, forward * cos - right * sin, turn, scale
    return out / (2 * DERIVATIVE_STEP_RAD)


@lru_cache(maxsize=4)
def _seen_rays(camera: Camera) -> Array:
    """Rays (N, 3) through points all over the image. Cached: undoing a lens takes time."""
    share = (np.arange(SEEN_POINTS) + 0.5) / SEEN_POINTS
    px = np.stack(np.meshgrid(share * camera.width_px, share * camera.height_px), -1).reshape(-1, 2)
    rays = camera_rays(camera, px)
    rays.flags.writeable = False
    return rays


def _similarity(of: Array, to: Array) -> tuple[float, float, float, float]:
    """The similarity between points (N, 2) and others close by, by least squares.

    Shift right and forward (m), clockwise rotation (rad) and log scale.
    """
    x, y = of.T
    one, zero = np.ones(len(of)), np.zeros(len(of))
    rows = np.stack([np.stack([one, zero, y, x], -1), np.stack([zero, one, -x, y], -1)], axis=1)
    found, *_ = np.linalg.lstsq(rows.reshape(-1, 4), (to - of).reshape(-1), rcond=None)
    return tuple(found.tolist())


class _TiltProfile:
    """The score of one view under several tilts."""

    def __init__(
        self, registration: RegistrationLocalizer, view: View, prepared: PreparedView
    ) -> None:
        level = prepared.levels.final
        camera, telemetry = view.camera, view.telemetry
        self._registration, self._view = registration, prepared.picture_at(level)
        if not np.allclose(self._view.camera.extent, camera.extent, rtol=1e-9):
            self._view = view  # cropped, it might be judged at other levels
        corner = math.hypot(*camera.extent) / 2
        rim_m = RIM_PX * registration.grid.gsd_m * 2**level
        self.step_rad = min(rim_m / max(telemetry.agl_m * corner**2, 1e-9), MAX_STEP_RAD)

    def score(
        self, mean: Array, slopes: Array, tilt_rad: Array, axis: int, sign: int
    ) -> float | None:
        """Score with one step more of tilt about one axis, refined from the predicted place."""
        tilts = tilt_rad.copy()
        tilts[axis] += sign * self.step_rad
        pitch, roll = np.degrees(tilts).tolist()
        telemetry = replace(self._view.telemetry, pitch_deg=pitch, roll_deg=roll)
        tilted = replace(self._view, telemetry=telemetry)
        view = self._registration.prepared(tilted, heading_known=True)
        if not isinstance(view, PreparedView):
            return None
        pose = self._registration.pose_of(view, mean + sign * self.step_rad * slopes[:, axis])
        return self._registration.on_ground(view).score_near(pose, STEPS, SMALL_STEP_PX)

    def fitted(
        self, middle: float, after: float, before: float, worth: float
    ) -> tuple[float, float]:
        """Inverse variance and peak of a parabola through the scores under three tilts; the peak
        is measured from the expected tilt (rad)."""
        slope = (after - before) / (2 * self.step_rad)
        bend = 2 * middle - after - before
        # The curvature is less on a flank than at the peak: no farther than to the next tilt.
        bend = max(bend / self.step_rad**2, abs(slope) / self.step_rad)
        known = worth * NATS_PER_SCORE * bend
        return known, worth * NATS_PER_SCORE * slope / (known + WEAK_TILT_RAD**-2)
