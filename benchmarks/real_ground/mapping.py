"""Windows of mapping photographs over mountains, on maps of the other strip.

Two photographs, orthorectified by collinearity equations, make a map; windows of the two of the
next strip are located on it. A window is a camera whose principal point lies elsewhere. Photographs
have an exterior orientation (omega, phi, kappa), good to well below a pixel of 5.6 m.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.warp import transform as transform_points
from scipy.spatial.transform import Rotation

from benchmarks.real_ground.score import Seen, Source
from benchmarks.scenes import DATA
from orthonav.core.files import replacing
from orthonav.core.geo.camera import Camera, attitude_of
from orthonav.core.localize import Localizer
from orthonav.core.records import Telemetry, View
from orthonav.ground.simulate.render import Raster, met

FOLDER = "relief_ngi"
STRIPS = ("05_0182", "05_0184"), ("06_0251", "06_0253")
FOCAL_PX, ORTHO_M, WINDOW_PX = 120.0 / (92.16 / 640), 5.6, 320
YAW_STD_DEG, AGL_STD, SEED = 5.0, 0.01, 1
PLANE = CRS.from_string("+proj=tmerc +lat_0=0 +lon_0=25 +k=1 +datum=WGS84 +units=m")
_DOWN = np.diag([1.0, -1.0, -1.0])
"""From image axes (x right, y down, z ahead) to those of photogrammetry (y up, z back)."""
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Photograph:
    """Grey levels (H, W), place of the camera (3,), and the rotation (3, 3) from camera axes to
    east, north, up of the grid."""

    grey: NDArray[np.uint8]
    position_m: Array
    grid_from_camera: Array

    @classmethod
    def of(cls, name: str) -> "Photograph":
        folder = DATA / FOLDER
        for line in (folder / "camera_pos_ori.txt").read_text().splitlines():
            words = line.split()
            if words and name in words[0]:
                numbers = [float(word) for word in words[1:]]
                with rasterio.open(folder / f"{words[0]}.tif") as data:
                    grey = cv2.cvtColor(np.moveaxis(data.read(), 0, -1), cv2.COLOR_RGB2GRAY)
                turned = Rotation.from_euler("XYZ", numbers[3:], degrees=True).as_matrix()
                return cls(np.asarray(grey, np.uint8), np.array(numbers[:3]), turned @ _DOWN)
        raise FileNotFoundError(name)

    def seen_px(self, ground_m: Array) -> Array:
        """Image points (..., 2) of ground points (..., 3) of the grid."""
        rays = (ground_m - self.position_m) @ self.grid_from_camera
        high, wide = self.grey.shape
        return np.asarray(FOCAL_PX * rays[..., :2] / rays[..., 2:] + [wide / 2, high / 2])


def terrain() -> Raster:
    """The terrain model, in the grid."""
    with rasterio.open(DATA / FOLDER / "dem.tif") as data:
        heights, step = data.read(1).astype(np.float32), data.transform
    return Raster(np.nan_to_num(heights, nan=float(np.nanmin(heights))), step.c, step.f, step.a)


def strip_ortho(strip: int, work: Path) -> Path:
    """The orthophoto of a strip: each place by the photograph that shows it nearest its middle."""
    out = work / f"strip{strip}.tif"
    if out.is_file():
        return out
    heights = terrain()
    rows, cols = heights.values.shape
    width, height = (round(side * heights.pixel_m / ORTHO_M) for side in (cols, rows))
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    east, north = heights.west_m + x * ORTHO_M, heights.north_m - y * ORTHO_M
    ground = np.stack([east, north, heights.at(east, north)], -1)
    made, nearest = np.zeros((height, width), np.uint8), np.full((height, width), np.inf)
    for each in (Photograph.of(name) for name in STRIPS[strip]):
        seen = each.seen_px(ground)
        high, wide = each.grey.shape
        inside = ((seen >= 2) & (seen <= [wide - 2, high - 2])).all(axis=-1)
        off = np.hypot(*np.moveaxis(seen - [wide / 2, high / 2], -1, 0))
        index = (seen - 0.5).astype(np.float32)
        grey = cv2.remap(each.grey, index[..., 0], index[..., 1], cv2.INTER_CUBIC)
        use = inside & (off < nearest)
        made[use], nearest[use] = np.maximum(grey[use], 1), off[use]
    about = {"driver": "GTiff", "count": 1, "dtype": "uint8", "crs": PLANE, "nodata": 0}
    step = rasterio.Affine(ORTHO_M, 0, heights.west_m, 0, -ORTHO_M, heights.north_m)
    about |= {"width": width, "height": height, "transform": step}
    with replacing(out) as part, rasterio.open(part, "w", **about) as target:
        target.write(made, 1)
    return out


@dataclass(frozen=True)
class Windows(Source):
    """Windows of the photographs of the other strip than that of the map, attitude as it is.

    `tilt_std_deg`: error of the reported pitch and roll, stated; 0: exact, and stated so.
    """

    strip: int
    tilt_std_deg: float

    def imagery(self) -> str:
        return FOLDER

    def seen(self, work: Path, base: Localizer, views: int, tracked: bool) -> Iterator[Seen]:
        heights, rng = terrain(), np.random.default_rng([SEED, self.strip])
        with rasterio.open(strip_ortho(self.strip, work)) as data:
            ortho = Raster(
                data.read(1).astype(np.float32), data.transform.c, data.transform.f, ORTHO_M
            )
        photographs = [Photograph.of(name) for name in STRIPS[1 - self.strip]]
        made = 0
        while made < views:
            photograph = photographs[rng.integers(0, len(photographs))]
            high, wide = photograph.grey.shape
            corner = rng.integers(0, wide - WINDOW_PX), rng.integers(0, high - WINDOW_PX)
            seen = self._window(photograph, int(corner[0]), int(corner[1]), heights, ortho, rng)
            if seen is not None:
                made += 1
                yield seen

    def _window(
        self,
        photograph: Photograph,
        col: int,
        row: int,
        heights: Raster,
        ortho: Raster,
        rng: np.random.Generator,
    ) -> Seen | None:
        """A window by its first column and row; None where it leaves the imagery of the map."""
        high, wide = photograph.grey.shape
        principal = wide / 2 - col, high / 2 - row
        camera = Camera(WINDOW_PX, WINDOW_PX, FOCAL_PX, FOCAL_PX, *principal, unusual=True)
        ray = np.array([WINDOW_PX / 2 - camera.cx_px, WINDOW_PX / 2 - camera.cy_px, FOCAL_PX])
        rays = (photograph.grid_from_camera @ ray)[None, None]
        middle = met(heights, rays, photograph.position_m)[0, 0]
        reach = WINDOW_PX * ORTHO_M * 0.45
        around = middle[:2] + np.array([[-1, -1], [-1, 1], [1, -1], [1, 1], [0, 0]]) * reach
        if not (np.isfinite(middle).all() and ortho.holds(around).all()):
            return None
        if not (ortho.at(around[:, 0], around[:, 1]) > 0).all():
            return None
        x, y, above_sea_m = photograph.position_m.tolist()
        lon, lat = transform_points(PLANE, "EPSG:4326", [x, x], [y, y + 1000.0])
        # The grid's north is not true north.
        turn = math.atan2((lon[1] - lon[0]) * math.cos(math.radians(lat[0])), lat[1] - lat[0])
        true_from_grid = Rotation.from_euler("z", -turn).as_matrix()
        yaw, pitch, roll = attitude_of(true_from_grid @ photograph.grid_from_camera)
        off = rng.normal(0, 1, 4) * [YAW_STD_DEG, self.tilt_std_deg, self.tilt_std_deg, AGL_STD]
        agl_m = above_sea_m - float(heights.at(np.array([x]), np.array([y]))[0])
        telemetry = Telemetry(
            0, (yaw + off[0]) % 360, pitch + off[1], roll + off[2], agl_m * (1 + off[3]),
            yaw_std_deg=YAW_STD_DEG, agl_std_m=AGL_STD * agl_m, tilt_std_deg=self.tilt_std_deg,
        )  # fmt: skip
        grey = photograph.grey[row : row + WINDOW_PX, col : col + WINDOW_PX]
        view = View(np.ascontiguousarray(grey), camera, telemetry)
        return Seen(view, (lat[0], lon[0]), agl_m)
