"""The views of trials: cut from the map's own pictures, or from those of another date."""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.check.change import USUAL, Severity
from orthonav.check.persistence import MARGIN_PX, features, usual_model
from orthonav.geo.camera import Camera
from orthonav.localizer.registration import RegistrationLocalizer
from orthonav.records import Telemetry, View
from orthonav.register.pose import rotation
from orthonav.register.reference import GreyPyramid
from orthonav.register.registrar import Levels

EVERY_PX = 8
LEVELS_TOLD = 3
"""Persistence is told at every so many pixels, at so many levels."""
LEAST_VALID = 0.3
"""Views that see less of the map than this share are not tried: there nothing is found."""


@dataclass(frozen=True)
class TrialPlan:
    """How views are made: `camera` at `agl_m`, what is told wrongly (standard deviations), `seed`.

    `yaw_std_deg` None: heading unknown. `relief_m` is the standard deviation of the height of what
    stands on the ground and tilts in views from low. `yaw_off_deg`, to either side at random, and
    `agl_off` (a share) are added to the errors of what is told.
    """

    map_path: Path
    camera: Camera
    agl_m: float
    yaw_std_deg: float | None = 5.0
    agl_std: float = 0.05
    prior_std_m: float | None = None
    relief_m: float = 0.0
    seed: int = 1
    severity: Severity = USUAL
    other_path: Path | None = None
    yaw_off_deg: float = 0.0
    agl_off: float = 0.0

    @property
    def width_m(self) -> float:
        """Side of what is seen along the rows of the picture, in metres."""
        return self.agl_m * self.camera.width_px / self.camera.fx_px

    @property
    def height_m(self) -> float:
        """The other side."""
        return self.agl_m * self.camera.height_px / self.camera.fy_px

    @property
    def side_m(self) -> float:
        """Root of the area that is seen."""
        return math.sqrt(self.width_m * self.height_m)


def reported_persistence(
    grey: NDArray[np.uint8], gsd_m: float, first: int = 0
) -> list[NDArray[np.float32]]:
    """Persistence (H, W) of a picture at its own resolution, half of it, and a quarter.

    That at resolutions finer than that of level `first` is taken to be the same as there.
    """
    model = usual_model()
    found: list[NDArray[np.float32]] = []
    picture = grey
    height, width = grey.shape
    for level in range(LEVELS_TOLD):
        if level >= first:
            told = model(features(picture, gsd_m * 2**level, max(EVERY_PX >> level, 1)))
            large = cv2.resize(told, (width, height), interpolation=cv2.INTER_LINEAR)
            found.append(np.asarray(large, np.float32))
        half = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        picture = np.asarray(half, np.uint8)
        if min(picture.shape) < 2 * MARGIN_PX and found:
            break
    return [found[0]] * first + found


def view_levels(plan: TrialPlan, registration: RegistrationLocalizer) -> Levels:
    """The levels of the map that views are placed at."""
    levels = registration.pyramid.levels
    return Levels.of(plan.side_m / registration.grid.gsd_m, levels)


class Pictures:
    """The grey pictures of a map, in the plane of the map that is checked."""

    def __init__(self, layer: GreyPyramid, registration: RegistrationLocalizer) -> None:
        self._layer, self._grid = layer, registration.grid

    def around(
        self, en_m: NDArray[np.float64], size: int, level: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float64]] | None:
        """Grey and valid around a place, `size` pixels of the level and the margin of persistence,
        and where its middle really is; None where too little of it is on the map."""
        unit_m = self._grid.gsd_m * 2**level
        whole = size + 2 * MARGIN_PX
        col = round((en_m[0] - self._grid.west_m) / unit_m - whole / 2)
        row = round((self._grid.north_m - en_m[1]) / unit_m - whole / 2)
        grey, valid = self._layer.read(level, row, col, whole, whole)
        inner = np.s_[MARGIN_PX : MARGIN_PX + size, MARGIN_PX : MARGIN_PX + size]
        if valid[inner].mean() < LEAST_VALID:
            return None
        if not valid.all():
            grey = np.where(valid, grey, np.uint8(grey[valid].mean()))
        east = self._grid.west_m + (col + whole / 2) * unit_m
        north = self._grid.north_m - (row + whole / 2) * unit_m
        return grey, valid, np.array([east, north])

    def stranger(self, rng: np.random.Generator, size: int, level: int) -> NDArray[np.uint8]:
        """Mirrored ground (size, size) from anywhere: it must not be found where it is from."""
        rows, cols = self._layer.shape(level)
        for _ in range(12):
            row = int(rng.integers(0, max(rows - size, 1)))
            col = int(rng.integers(0, max(cols - size, 1)))
            grey, valid = self._layer.read(level, row, col, size, size)
            if valid.all():
                break
        else:
            grey = np.where(valid, grey, np.uint8(128))
        return np.ascontiguousarray(grey[:, ::-1])


def view_of(
    rng: np.random.Generator, plan: TrialPlan, picture: NDArray[np.uint8], gsd_m: float
) -> View:
    """A vertical view of the middle of a picture under any heading."""
    size = picture.shape[0]
    width = max(8, round(plan.width_m / gsd_m))
    height = max(8, round(plan.height_m / gsd_m))
    yaw_deg = float(rng.uniform(0, 360))
    linear = rotation(math.radians(yaw_deg))
    move = np.full(2, (size - 1) / 2) - linear @ [(width - 1) / 2, (height - 1) / 2]
    camera_gsd_m = plan.camera.gsd_m(plan.agl_m)
    if camera_gsd_m > gsd_m:
        picture = np.asarray(
            cv2.GaussianBlur(picture, (0, 0), 0.5 * camera_gsd_m / gsd_m), np.uint8
        )
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    view = cv2.warpAffine(
        picture,
        np.column_stack([linear, move]),
        (width, height),
        flags=flags,
        borderMode=cv2.BORDER_REFLECT,
    )
    focal = plan.agl_m / gsd_m
    yaw_std = plan.yaw_std_deg
    sign = 1.0 if rng.random() < 0.5 else -1.0
    yaw_error = sign * plan.yaw_off_deg
    if yaw_std is not None:
        yaw_error += float(rng.normal(0, yaw_std))
    reported_m = plan.agl_m * max(0.5, 1 + plan.agl_off + float(rng.normal(0, plan.agl_std)))
    telemetry = Telemetry(
        time_ns=0,
        yaw_deg=yaw_deg + yaw_error,
        pitch_deg=0.0,
        roll_deg=0.0,
        agl_m=reported_m,
        yaw_std_deg=yaw_std,
        agl_std_m=plan.agl_std * reported_m,
    )
    camera = Camera(width, height, focal, focal, width / 2, height / 2)
    return View(np.asarray(view, dtype=np.uint8), camera, telemetry)
