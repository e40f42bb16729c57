"""Windows of mapping photographs over mountains, placed on other photographs of the same ground.

`python -m benchmarks.relief_photographs [--views 24] [--work DIR]` needs the optional real imagery
beside the checkout (`relief_ngi`: four photographs with exterior orientation, and a terrain model).
Two photographs, orthorectified here by collinearity equations, make the map; windows of the two of
the next strip are placed on it, and the other way around. A window is a camera whose principal
point lies elsewhere.
"""

import argparse
import math
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.transform import Affine
from rasterio.warp import transform as transform_points
from scipy.spatial.transform import Rotation

from benchmarks.inputs import DATA
from orthonav.cli.heights import map_heights
from orthonav.core.geo.camera import Camera, attitude_of
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import MapFile, open_map
from orthonav.core.records import CONFIDENT, Fix, NoFix, Telemetry, View
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.simulate.perspective import Raster, met

FOLDER = DATA / "relief_ngi"
STRIPS = (("05_0182", "05_0184"), ("06_0251", "06_0253"))
FOCAL_PX = 120.0 / (92.16 / 640)
ORTHO_M = 5.6
WINDOW_PX = 320
YAW_STD_DEG = 5.0
HEADER = (
    "ground", "reported tilt", "within 3 px", "camera within 1 %", "accepted",
    "confident and wrong", "median px", "median camera", "CPU",
)  # fmt: skip
PLANE = CRS.from_string("+proj=tmerc +lat_0=0 +lon_0=25 +k=1 +datum=WGS84 +units=m")
_DOWN = np.diag([1.0, -1.0, -1.0])
"""From image axes (x right, y down, z ahead) to those of photogrammetry (y up, z back)."""
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph: grey (H, W), where its camera was (3,), and the rotation (3, 3) from camera
    axes to east, north, up of the grid."""

    grey: NDArray[np.uint8]
    position_m: Array
    grid_from_camera: Array

    @classmethod
    def of(cls, name: str) -> "Photograph":
        """Read a photograph and its exterior orientation."""
        for line in (FOLDER / "camera_pos_ori.txt").read_text().splitlines():
            words = line.split()
            if words and name in words[0]:
                numbers = [float(word) for word in words[1:]]
                with rasterio.open(FOLDER / f"{words[0]}.tif") as data:
                    grey = cv2.cvtColor(np.moveaxis(data.read(), 0, -1), cv2.COLOR_RGB2GRAY)
                turned = Rotation.from_euler("XYZ", numbers[3:], degrees=True).as_matrix()
                return cls(np.asarray(grey, np.uint8), np.array(numbers[:3]), turned @ _DOWN)
        raise FileNotFoundError(name)

    def seen_px(self, ground_m: Array) -> Array:
        """Image points (..., 2) of ground points (..., 3) of the grid: collinearity equations."""
        rays = (ground_m - self.position_m) @ self.grid_from_camera
        high, wide = self.grey.shape
        return np.asarray(FOCAL_PX * rays[..., :2] / rays[..., 2:] + [wide / 2, high / 2])


def terrain() -> Raster:
    """The terrain model, in the grid."""
    with rasterio.open(FOLDER / "dem.tif") as data:
        heights, step = data.read(1).astype(np.float32), data.transform
    return Raster(np.nan_to_num(heights, nan=float(np.nanmin(heights))), step.c, step.f, step.a)


def ortho_of(photographs: list[Photograph], heights: Raster, path: Path) -> None:
    """A mosaic of orthorectified photographs, each where it is seen nearest to its middle."""
    rows, cols = heights.values.shape
    width, height = (round(side * heights.pixel_m / ORTHO_M) for side in (cols, rows))
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    east, north = heights.west_m + x * ORTHO_M, heights.north_m - y * ORTHO_M
    ground = np.stack([east, north, heights.at(east, north)], -1)
    out, nearest = np.zeros((height, width), np.uint8), np.full((height, width), np.inf)
    for each in photographs:
        seen = each.seen_px(ground)
        high, wide = each.grey.shape
        inside = ((seen >= 2) & (seen <= [wide - 2, high - 2])).all(axis=-1)
        off = np.hypot(*np.moveaxis(seen - [wide / 2, high / 2], -1, 0))
        index = (seen - 0.5).astype(np.float32)
        grey = cv2.remap(each.grey, index[..., 0], index[..., 1], cv2.INTER_CUBIC)
        use = inside & (off < nearest)
        out[use], nearest[use] = np.maximum(grey[use], 1), off[use]
    step = Affine(ORTHO_M, 0, heights.west_m, 0, -ORTHO_M, heights.north_m)
    with rasterio.open(
        path, "w", driver="GTiff", width=width, height=height, count=1, dtype="uint8", crs=PLANE,
        transform=step, nodata=0,
    ) as data:  # fmt: skip
        data.write(out, 1)


@dataclass(frozen=True, eq=False)
class Window:
    """A window of a photograph as a view, and the truth."""

    view: View
    photograph: Photograph
    latlon_deg: tuple[float, float]
    middle_m: Array


def window(
    photograph: Photograph, corner: tuple[int, int], heights: Raster, tilt_std_deg: float,
    rng: np.random.Generator,
) -> Window:  # fmt: skip
    """A window of a photograph by its first column and row."""
    col, row = corner
    high, wide = photograph.grey.shape
    camera = Camera(WINDOW_PX, WINDOW_PX, FOCAL_PX, FOCAL_PX, wide / 2 - col, high / 2 - row)
    grey = np.ascontiguousarray(photograph.grey[row : row + WINDOW_PX, col : col + WINDOW_PX])
    x, y = photograph.position_m[:2].tolist()
    lon, lat = transform_points(PLANE, "EPSG:4326", [x, x], [y, y + 1000.0])
    # The grid's north is not true north.
    turn = math.atan2((lon[1] - lon[0]) * math.cos(math.radians(lat[0])), lat[1] - lat[0])
    true_from_grid = Rotation.from_euler("z", -turn).as_matrix()
    yaw, pitch, roll = attitude_of(true_from_grid @ photograph.grid_from_camera)
    ray = np.array([WINDOW_PX / 2 - camera.cx_px, WINDOW_PX / 2 - camera.cy_px, FOCAL_PX])
    middle = met(heights, (photograph.grid_from_camera @ ray)[None, None], photograph.position_m)
    errors = rng.normal(0, [YAW_STD_DEG, max(tilt_std_deg, 1e-9), max(tilt_std_deg, 1e-9)])
    telemetry = Telemetry(
        0,
        (yaw + float(errors[0])) % 360,
        pitch + float(errors[1]),
        roll + float(errors[2]),
        math.nan,
        yaw_std_deg=YAW_STD_DEG,
        tilt_std_deg=tilt_std_deg or None,
        amsl_m=float(photograph.position_m[2]) * (1 + float(rng.normal(0, 0.01))),
    )
    return Window(View(grey, camera, telemetry), photograph, (lat[0], lon[0]), middle[0, 0])


def on_ortho(each: Window, ortho: Raster) -> bool:
    """Whether the window lies on the imagery of the map."""
    reach = WINDOW_PX * ORTHO_M * 0.45
    around = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1], [0, 0]]) * reach
    points = each.middle_m[:2] + around
    return bool((ortho.at(points[:, 0], points[:, 1]) > 0).all() and ortho.holds(points).all())


def main() -> None:
    """Place windows, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, help="folder that is kept (default: a temporary one)")
    parser.add_argument("--views", type=int, default=24, help="windows of each strip")
    options = parser.parse_args()
    if not FOLDER.is_dir():
        parser.exit(
            0, "relief_ngi skipped: the optional real imagery beside the checkout is absent\n"
        )
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        print("| " + " | ".join(HEADER) + " |\n|---|---|" + 7 * "--:|")
        for tilt_std_deg in (0.0, 1.0):
            for level in (True, False):
                rows = [
                    r
                    for strip in (0, 1)
                    for r in placed(work, strip, level, tilt_std_deg, options.views)
                ]
                print(line(np.array(rows), level, tilt_std_deg), flush=True)


def placed(
    work: Path, strip: int, level: bool, tilt_std_deg: float, views: int
) -> list[list[float]]:
    """Error of the ground (px) and of the camera (share of the height), confidence, time (ms)."""
    heights = terrain()
    path, ortho_path = work / f"strip{strip}.onav", work / f"strip{strip}.tif"
    if not path.is_file():
        ortho_of([Photograph.of(name) for name in STRIPS[strip]], heights, ortho_path)
        build_map(BuildRequest([ortho_path], path, dem=FOLDER / "dem.tif"))
    with rasterio.open(ortho_path) as data:
        ortho = Raster(data.read(1).astype(np.float32), data.transform.c, data.transform.f, ORTHO_M)
    rng = np.random.default_rng(strip)
    opened = open_map(path)
    localizer, flown = Localizer(opened, level_ground=level), map_heights(opened)
    assert flown is not None
    out: list[list[float]] = []
    while len(out) < views:
        photograph = Photograph.of(str(rng.choice(STRIPS[1 - strip])))
        high, wide = photograph.grey.shape
        corner = int(rng.integers(0, wide - WINDOW_PX)), int(rng.integers(0, high - WINDOW_PX))
        each = window(photograph, corner, heights, tilt_std_deg, rng)
        if not np.isfinite(each.middle_m).all() or not on_ortho(each, ortho):
            continue
        view = replace(each.view, telemetry=flown.corrected(each.view.telemetry))
        start = time.process_time()
        fix = localizer.locate(view)
        took_ms = 1e3 * (time.process_time() - start)
        out.append([*errors_of(fix, each, opened), took_ms])
    return out


def errors_of(fix: Fix | NoFix, each: Window, opened: MapFile) -> list[float]:
    """Error of the ground (px) and of the camera (share of the height), and confidence."""
    if isinstance(fix, NoFix):
        return [math.inf, math.inf, 0.0]
    frame = opened.manifest.sheets[0].frame
    camera_m = np.hypot(
        *(frame.en_from_latlon(fix.lat_deg, fix.lon_deg) - frame.en_from_latlon(*each.latlon_deg))
    )
    seen = fix.ground_latlon_deg
    lon, lat = transform_points(PLANE, "EPSG:4326", [each.middle_m[0]], [each.middle_m[1]])
    ground_m = math.nan
    if seen is not None:
        ground_m = float(
            np.hypot(*(frame.en_from_latlon(*seen) - frame.en_from_latlon(lat[0], lon[0])))
        )
    return [ground_m / ORTHO_M, float(camera_m) / fix.agl_m, fix.confidence]


def line(rows: Array, level: bool, tilt_std_deg: float) -> str:
    """A row of the table."""
    ground_px, camera, confidences, took_ms = rows.T
    confident = confidences >= CONFIDENT
    right = camera <= 0.01 if level else ground_px <= 3
    ground = "level" if level else "terrain"
    return (
        f"| {ground} | {f'off by {tilt_std_deg:g} deg' if tilt_std_deg else 'exact'} |"
        f" {(ground_px <= 3).mean():.0%} | {(camera <= 0.01).mean():.0%} |"
        f" {confident.mean():.0%} | {int((confident & ~right).sum())} |"
        f" {np.median(ground_px):.1f} | {np.median(camera):.2%} | {np.median(took_ms):.0f} ms |"
    )


if __name__ == "__main__":
    main()
