"""Trial views, cut from the map's own imagery or from that of a second date."""

import math
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.grid import TileGrid
from orthonav.core.mapfile.layer import level_shape
from orthonav.core.mapfile.manifest import SheetInfo
from orthonav.core.records import Telemetry, View
from orthonav.core.register.pose import rotation
from orthonav.core.register.window import GreyPyramid
from orthonav.ground.check.persistence import MARGIN_PX, default_model, features
from orthonav.ground.check.request import CheckRequest
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.imagery.raster import SheetRaster

EVERY_PX, PERSISTENCE_LEVELS = 8, 3
"""Persistence is computed every so many pixels, at so many levels: coarser detail lasts alike."""
MIN_VALID = 0.3
"""Views that see less of the map than this fraction are skipped: the localizer refuses them."""
_DONOR_DRAWS = 12

Grey = NDArray[np.uint8]
Points = NDArray[np.float64]


@dataclass(frozen=True)
class TrialPlan:
    """How trial views are made.

    `request`: map, camera, accuracy of the telemetry, and the seed of all random numbers together
    with the number of the trial.
    `agl_m`: height above ground.
    `second_date`: views are cut from the orthophoto of a second date, not from the map's imagery
    with simulated ageing.
    `yaw_off_deg`: additional heading error, to either side at random.
    `agl_off`: additional height error, a fraction of the height.
    """

    request: CheckRequest
    agl_m: float
    second_date: bool = False
    yaw_off_deg: float = 0.0
    agl_off: float = 0.0

    @property
    def width_m(self) -> float:
        """Footprint along the rows of the image."""
        return self.agl_m * self.request.camera.width_px / self.request.camera.fx_px

    @property
    def height_m(self) -> float:
        """Footprint along the columns of the image."""
        return self.agl_m * self.request.camera.height_px / self.request.camera.fy_px

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


def crop_around(
    layer: GreyPyramid, grid: TileGrid, en_m: Points, size: int, level: int
) -> tuple[Grey, NDArray[np.bool_], Points] | None:
    """Grey, valid and the exact centre of a square crop; None where too little of it has imagery.

    The crop is `size` pixels of the level wide, plus `MARGIN_PX` on each side. `layer` is in the
    plane of the checked map, whose tile grid is `grid`.
    """
    unit_m = grid.gsd_m * 2**level
    whole = size + 2 * MARGIN_PX
    col = round((en_m[0] - grid.west_m) / unit_m - whole / 2)
    row = round((grid.north_m - en_m[1]) / unit_m - whole / 2)
    grey, valid = layer.read(level, row, col, whole, whole)
    if valid[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX].mean() < MIN_VALID:
        return None
    if not valid.all():
        grey = np.where(valid, grey, np.uint8(grey[valid].mean()))
    east = grid.west_m + (col + whole / 2) * unit_m
    north = grid.north_m - (row + whole / 2) * unit_m
    return grey, valid, np.array([east, north])


def mirrored_donor(rng: np.random.Generator, layer: GreyPyramid, size: int, level: int) -> Grey:
    """Mirrored ground (size, size) of a random place, so that it matches no place."""
    rows, cols = layer.shape(level)
    for _ in range(_DONOR_DRAWS):
        row = int(rng.integers(0, max(rows - size, 1)))
        col = int(rng.integers(0, max(cols - size, 1)))
        grey, valid = layer.read(level, row, col, size, size)
        if valid.all():
            break
    else:
        grey = np.where(valid, grey, np.uint8(128))
    return np.ascontiguousarray(grey[:, ::-1])


class OrthoPyramid:
    """Grey levels of an orthophoto in the plane and at the resolutions of a map's sheet.

    Files stay open until `close`. Not safe to share between threads.
    """

    def __init__(self, path: Path, sheet: SheetInfo, levels: int) -> None:
        """Open the file; raises `ImageryError` where it is not an orthophoto."""
        self.levels = levels
        self._sheet, self._mosaic = sheet, Mosaic.open([path])
        self._opened: dict[int, SheetRaster] = {}
        self._stack = ExitStack()

    def close(self) -> None:
        """Close the files."""
        self._stack.close()
        self._opened.clear()

    def shape(self, level: int) -> tuple[int, int]:
        """Rows and columns of a level: those of the map."""
        return level_shape(self._sheet.grid.height_px, self._sheet.grid.width_px, level)

    def read(
        self, level: int, row: int, col: int, height: int, width: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Grey and valid (height, width) of a window, which may reach beyond the sheet."""
        pixels = self._raster(level).read_grey(col, row, width, height)
        return pixels.grey, pixels.valid

    def _raster(self, level: int) -> SheetRaster:
        if level not in self._opened:
            grid = self._sheet.grid
            rows, cols = self.shape(level)
            raster = self._mosaic.sheet(
                self._sheet.frame,
                west_m=grid.west_m,
                north_m=grid.north_m,
                width_px=cols,
                height_px=rows,
                gsd_m=grid.gsd_m * 2**level,
                threads=1,  # trials run in several processes
            )
            self._opened[level] = self._stack.enter_context(raster)
        return self._opened[level]


def require_overlap(path: Path, sheet: SheetInfo) -> None:
    """Raise `AreaError` where an orthophoto does not overlap a sheet."""
    lat_lon = Mosaic.open([path]).outline_latlon_deg
    points = sheet.frame.en_from_latlon(lat_lon[:, 0], lat_lon[:, 1])
    west_m, south_m, east_m, north_m = sheet.grid.extent_en_m
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    if east < west_m or west > east_m or north < south_m or south > north_m:
        raise AreaError(f"the orthophoto of the other date does not overlap the map: {path}")


def view_of(rng: np.random.Generator, plan: TrialPlan, picture: Grey, gsd_m: float) -> View:
    """A vertical view of the middle of a picture with a random heading."""
    size = picture.shape[0]
    width = max(8, round(plan.width_m / gsd_m))
    height = max(8, round(plan.height_m / gsd_m))
    yaw_deg = float(rng.uniform(0, 360))
    linear = rotation(math.radians(yaw_deg))
    move = np.full(2, (size - 1) / 2) - linear @ [(width - 1) / 2, (height - 1) / 2]
    camera_gsd_m = plan.request.camera.gsd_m(plan.agl_m)
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
    if plan.request.yaw_std_deg is not None:
        yaw_error_deg += float(rng.normal(0, plan.request.yaw_std_deg))
    agl_m = plan.agl_m * max(0.5, 1 + plan.agl_off + float(rng.normal(0, plan.request.agl_std)))
    return Telemetry(
        time_ns=0,
        yaw_deg=yaw_deg + yaw_error_deg,
        pitch_deg=0.0,
        roll_deg=0.0,
        agl_m=agl_m,
        yaw_std_deg=plan.request.yaw_std_deg,
        agl_std_m=plan.request.agl_std * agl_m,
        tilt_std_deg=plan.request.tilt_std_deg,
    )
