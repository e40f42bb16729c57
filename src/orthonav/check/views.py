"""Trial views, cut from the map's own imagery or from that of a second date."""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.changes.record import ChangedGround
from orthonav.check.persistence import MARGIN_PX, default_model, features
from orthonav.geo.camera import Camera
from orthonav.geo.grid import TileGrid
from orthonav.records import Telemetry, View
from orthonav.register.pose import rotation
from orthonav.register.reference import GreyPyramid

EVERY_PX, PERSISTENCE_LEVELS = 8, 3
"""Persistence is computed every so many pixels, at so many levels: coarser detail lasts alike."""
MIN_VALID = 0.3
"""Views that see less of the map than this share are skipped: the localizer refuses them."""
_DONOR_DRAWS = 12

Grey = NDArray[np.uint8]
Points = NDArray[np.float64]


@dataclass(frozen=True)
class TrialPlan:
    """How trial views are made; standard deviations are those of `CheckRequest`.

    `map_path`, `camera`, `agl_m`: what is flown.
    `yaw_std_deg`, `agl_std`, `prior_std_m`: random errors of the reported values; None: unknown.
    `relief_m`: standard deviation of the height of objects, which cause relief displacement.
    `seed`: of all random numbers, together with the number of the trial.
    `other_path`: orthophoto of a second date to cut views from; None: the map's imagery, aged.
    `yaw_off_deg`: additional heading error, to either side at random.
    `agl_off`: additional height error, a share of the height.
    `changes`: ground that changed since the map, which views of the map's imagery do not show.
    """

    map_path: Path
    camera: Camera
    agl_m: float
    yaw_std_deg: float | None = 5.0
    agl_std: float = 0.05
    prior_std_m: float | None = None
    relief_m: float = 0.0
    seed: int = 1
    other_path: Path | None = None
    yaw_off_deg: float = 0.0
    agl_off: float = 0.0
    changes: ChangedGround | None = None

    @property
    def width_m(self) -> float:
        """Footprint along the rows of the image."""
        return self.agl_m * self.camera.width_px / self.camera.fx_px

    @property
    def height_m(self) -> float:
        """Footprint along the columns of the image."""
        return self.agl_m * self.camera.height_px / self.camera.fy_px

    @property
    def side_m(self) -> float:
        """Side of the square with the area of the footprint."""
        return math.sqrt(self.width_m * self.height_m)

    @property
    def footprint_text(self) -> str:
        """The footprint in words, for messages."""
        return f"a view from {self.agl_m:.0f} m covers {self.width_m:.0f} x {self.height_m:.0f} m"


def reported_persistence(grey: Grey, gsd_m: float, first: int = 0) -> list[NDArray[np.float32]]:
    """Persistence maps (H, W) of a picture at its own resolution, half of it, and a quarter.

    Resolutions finer than that of level `first` repeat its values.
    """
    model = default_model()
    found: list[NDArray[np.float32]] = []
    picture = grey
    height, width = grey.shape
    for level in range(PERSISTENCE_LEVELS):
        if level >= first:
            coarse = model(features(picture, gsd_m * 2**level, max(EVERY_PX >> level, 1)))
            full = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
            found.append(np.asarray(full, np.float32))
        half = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        picture = np.asarray(half, np.uint8)
        if min(picture.shape) < 2 * MARGIN_PX and found:
            break
    return [found[0]] * first + found


class MapCrops:
    """Square crops of a grey pyramid, in the plane of the checked map."""

    def __init__(self, layer: GreyPyramid, grid: TileGrid) -> None:
        self._layer, self._grid = layer, grid

    def around(
        self, en_m: NDArray[np.float64], size: int, level: int
    ) -> tuple[Grey, NDArray[np.bool_], NDArray[np.float64]] | None:
        """Grey, valid and the exact centre of a crop; None where too little of it is on the map.

        The crop is `size` pixels of the level wide, plus `MARGIN_PX` on each side.
        """
        unit_m = self._grid.gsd_m * 2**level
        whole = size + 2 * MARGIN_PX
        col = round((en_m[0] - self._grid.west_m) / unit_m - whole / 2)
        row = round((self._grid.north_m - en_m[1]) / unit_m - whole / 2)
        grey, valid = self._layer.read(level, row, col, whole, whole)
        inner = np.s_[MARGIN_PX : MARGIN_PX + size, MARGIN_PX : MARGIN_PX + size]
        if valid[inner].mean() < MIN_VALID:
            return None
        if not valid.all():
            grey = np.where(valid, grey, np.uint8(grey[valid].mean()))
        east = self._grid.west_m + (col + whole / 2) * unit_m
        north = self._grid.north_m - (row + whole / 2) * unit_m
        return grey, valid, np.array([east, north])

    def points_en_m(self, place_en_m: NDArray[np.float64], size: int, level: int) -> Points:
        """Centres (size, size, 2) of the pixels of a crop around its exact centre."""
        unit_m = self._grid.gsd_m * 2**level
        steps = (np.arange(size) + 0.5 - size / 2) * unit_m
        return np.stack(np.meshgrid(steps, -steps), axis=-1) + place_en_m

    def donor(self, rng: np.random.Generator, size: int, level: int) -> Grey:
        """Mirrored ground (size, size) of a random place, so that it matches no place."""
        rows, cols = self._layer.shape(level)
        for _ in range(_DONOR_DRAWS):
            row = int(rng.integers(0, max(rows - size, 1)))
            col = int(rng.integers(0, max(cols - size, 1)))
            grey, valid = self._layer.read(level, row, col, size, size)
            if valid.all():
                break
        else:
            grey = np.where(valid, grey, np.uint8(128))
        return np.ascontiguousarray(grey[:, ::-1])


def view_of(rng: np.random.Generator, plan: TrialPlan, picture: Grey, gsd_m: float) -> View:
    """A vertical view of the middle of a picture with a random heading."""
    size = picture.shape[0]
    width = max(8, round(plan.width_m / gsd_m))
    height = max(8, round(plan.height_m / gsd_m))
    yaw_deg = float(rng.uniform(0, 360))
    linear = rotation(math.radians(yaw_deg))
    move = np.full(2, (size - 1) / 2) - linear @ [(width - 1) / 2, (height - 1) / 2]
    camera_gsd_m = plan.camera.gsd_m(plan.agl_m)
    if camera_gsd_m > gsd_m:
        blur_px = 0.5 * camera_gsd_m / gsd_m
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), blur_px), np.uint8)
    view = cv2.warpAffine(
        picture,
        np.column_stack([linear, move]),
        (width, height),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT,
    )
    focal = plan.agl_m / gsd_m
    camera = Camera(width, height, focal, focal, width / 2, height / 2)
    return View(np.asarray(view, dtype=np.uint8), camera, _telemetry(rng, plan, yaw_deg))


def _telemetry(rng: np.random.Generator, plan: TrialPlan, yaw_deg: float) -> Telemetry:
    """Heading and height with the errors of the plan."""
    yaw_error_deg = plan.yaw_off_deg if rng.random() < 0.5 else -plan.yaw_off_deg
    if plan.yaw_std_deg is not None:
        yaw_error_deg += float(rng.normal(0, plan.yaw_std_deg))
    agl_m = plan.agl_m * max(0.5, 1 + plan.agl_off + float(rng.normal(0, plan.agl_std)))
    return Telemetry(
        time_ns=0,
        yaw_deg=yaw_deg + yaw_error_deg,
        pitch_deg=0.0,
        roll_deg=0.0,
        agl_m=agl_m,
        yaw_std_deg=plan.yaw_std_deg,
        agl_std_m=plan.agl_std * agl_m,
    )
