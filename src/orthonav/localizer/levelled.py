"""A registered view placed anew together with how its camera leans.

Autopilots and gimbals say how the camera leans to a degree or a few; where a mount is off, every
fix is off by the height times that angle. A camera that leans sees near ground larger than far
ground: told too little of it, the rectified view is bent against the map. So the view is rectified
under a few leans around the expected one, and how well it fits each says which is true. A parabola
through these scores is what one view knows; of many views together the sum of them (a single peak
is bent by houses and hills, and most of that differs from view to view).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.geo.camera import Camera
from orthonav.localizer.registration import PreparedFootprint, RegistrationLocalizer
from orthonav.records import Telemetry
from orthonav.register.pose import Pose
from orthonav.register.refine import Placed

RIM_PX = 10.0
"""Leans are tried so far from the expected one that the corner of the view moves by so many pixels:
scores that near to a peak are too bent to say where the middle of it is."""
MAX_STEP_RAD = math.radians(6.0)
NATS_PER_SCORE = 0.4
"""What a unit of the score says of a lean: peaks of single views scatter by more than their
curvature would have it."""
WEAK_LEAN_RAD = math.radians(20.0)
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
) -> Levelled | None:
    """The view (H, W), prepared as `view` and registered at `pose`, placed with its lean.

    The pitch and roll of `telemetry` are those to be expected; a lean that differs by more than a
    few degrees is found in several views, each from what is known by then. None where the view
    cannot be looked at under leans around the expected one.
    """
    looks = _Looks(registration, grey, camera, telemetry, view.levels.final)
    middle = looks.placed(view, pose)
    lean = np.radians([telemetry.pitch_deg, telemetry.roll_deg])
    mean, known, hangs = middle.mean.copy(), np.zeros(2), np.zeros((4, 2))
    for axis in range(2):
        after, before = (looks.at(middle, lean, axis, sign * looks.step_rad) for sign in (1, -1))
        if after is None or before is None:
            return None
        ahead = after.mean - before.mean
        ahead[2] = math.remainder(ahead[2], 2 * math.pi)
        hangs[:, axis] = ahead / (2 * looks.step_rad)
        slope = (after.score - before.score) / (2 * looks.step_rad)
        bend = 2 * middle.score - after.score - before.score
        # On a flank it bends less than at the peak: no farther than to the next lean tried.
        bend = max(bend / looks.step_rad**2, abs(slope) / looks.step_rad)
        known[axis] = NATS_PER_SCORE * bend
        move = NATS_PER_SCORE * slope / (known[axis] + WEAK_LEAN_RAD**-2)
        lean[axis] += move
        mean += hangs[:, axis] * move
    spread = np.diag(1 / (known + WEAK_LEAN_RAD**-2))
    covariance = np.zeros((6, 6))
    covariance[:4, :4] = looks.covariance(middle) + hangs @ spread @ hangs.T
    covariance[:4, 4:] = hangs @ spread
    covariance[4:, :4] = covariance[:4, 4:].T
    covariance[4:, 4:] = spread
    if not np.isfinite(covariance).all():
        return None
    return Levelled(np.concatenate([mean, lean]), covariance)


@dataclass(frozen=True, eq=False)
class _Look:
    """A view under some lean: how it was prepared, where placed, and `mean` (4,), the position of
    the camera (m), heading and log scale."""

    view: PreparedFootprint
    placed: Placed
    mean: Array

    @property
    def score(self) -> float:
        return self.placed.score


class _Looks:
    """Looks at one view under several leans."""

    def __init__(
        self,
        registration: RegistrationLocalizer,
        grey: NDArray[np.uint8],
        camera: Camera,
        telemetry: Telemetry,
        level: int,
    ) -> None:
        self._registration, self._grey, self._camera = registration, grey, camera
        self._telemetry = telemetry
        corner = math.hypot(camera.width_px / camera.fx_px, camera.height_px / camera.fy_px) / 2
        rim_m = RIM_PX * registration.grid.gsd_m * 2**level
        self.step_rad = min(rim_m / max(telemetry.agl_m * corner**2, 1e-9), MAX_STEP_RAD)

    def at(self, known: _Look, lean_rad: Array, axis: int, more_rad: float) -> _Look | None:
        """The view leaning more about one axis, its middle starting where it is known to be."""
        leans = lean_rad.copy()
        leans[axis] += more_rad
        pitch, roll = np.degrees(leans).tolist()
        leaning = replace(self._telemetry, pitch_deg=pitch, roll_deg=roll)
        view = self._registration.prepared(self._grey, self._camera, leaning, heading_known=True)
        if not isinstance(view, PreparedFootprint):
            return None
        return self.placed(view, known.placed.pose)

    def placed(self, view: PreparedFootprint, pose: Pose) -> _Look:
        """A prepared view at the best pose near `pose`."""
        refiner = self._registration.registrar.refiner(
            view.templates, view.levels, view.levels.final
        )
        placed = refiner.place(pose)
        place = self._registration.camera_en_m(view, placed.pose)
        mean = np.array([*place, placed.pose.turn_rad, placed.pose.log_scale])
        return _Look(view, placed, mean)

    def covariance(self, look: _Look) -> Array:
        """Covariance (4, 4) of camera position (m), heading and log scale for a given lean."""
        view, registrar = look.view, self._registration.registrar
        placed = registrar.with_covariance(view.templates, view.levels, look.placed)
        return self._registration.covariance(view, placed)
