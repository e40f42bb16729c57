"""Orthophotos and heights of a generated landscape as GeoTIFF files."""

from collections.abc import Callable, Sequence
from functools import cache, partial
from math import ceil, isfinite
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio import Affine
from rasterio.windows import Window
from tqdm import tqdm

from lab.landscape.epoch import DEFAULT_DATES, Epoch
from lab.landscape.noise import Float32, Float64, fractal_grid, key_of
from lab.landscape.scene import ORIGIN_M, Landscape, check_gsd
from lab.landscape.window import chunks
from orthonav.core.errors import AreaError
from orthonav.core.files import replacing
from orthonav.ground.imagery.terrain import DATUM_TAG

_BLOCK_PX = 512
_WINDOW_PX = 1024  # a whole number of blocks, so that no block is compressed twice
PxWindow = tuple[int, int, int, int]
"""Column, row, width and height."""
TERRAIN_POSTING_M = 5.0
"""Distance of the heights of the generated terrain."""
HILLS_M, HILLS_GAIN, MEAN_HEIGHT_M = (1700.0, 900.0, 500.0), 0.55, 200.0
"""Wavelengths of the hills, amplitude of each by that before, and mean height above the sea."""


def generate_area(
    out_dir: Path,
    *,
    size_m: tuple[float, float] = (2000.0, 2000.0),
    gsd_m: float = 1.0,
    dates: Sequence[Epoch] = DEFAULT_DATES,
    seed: int = 1,
) -> list[Path]:
    """Write one orthophoto `out_dir/<date name>.tif` per date and return their paths.

    size_m: (east, north) extent; rounded up to whole pixels. gsd_m: metres per pixel, 0.2..10.
    The lower left corner is `ORIGIN_M` in EPSG:2154. Files are tiled RGB uint8, written window by
    window, so memory does not grow with the area. Raises `AreaError` on impossible sizes.
    """
    landscape, (width_px, height_px) = Landscape(seed), _size_px(size_m, gsd_m)
    north_m = ORIGIN_M[1] + height_px * gsd_m

    def rendered(date: Epoch, window: PxWindow) -> NDArray[np.uint8]:
        col, row, width, height = window
        corner = ORIGIN_M[0] + col * gsd_m, north_m - row * gsd_m
        return np.moveaxis(landscape.render(date, *corner, width, height, gsd_m), 2, 0)

    profile = {"count": 3, "dtype": "uint8", "photometric": "RGB", "predictor": 2}
    paths = [Path(out_dir) / f"{date.name}.tif" for date in dates]
    for path, date in zip(paths, dates, strict=True):
        tags = {"TIFFTAG_DATETIME": date.tiff_datetime}
        size_px = width_px, height_px
        _write(path, profile, tags, partial(rendered, date), size_px, gsd_m, north_m)
    return paths


def generate_heights(
    out_dir: Path,
    *,
    slope: float,
    size_m: tuple[float, float] = (2000.0, 2000.0),
    gsd_m: float = 1.0,
    dates: Sequence[Epoch] = DEFAULT_DATES,
    seed: int = 1,
) -> list[Path]:
    """Write the terrain `out_dir/dem.tif` under an area and, for each date, the surface model
    `out_dir/<date name>_dsm.tif`: the terrain with its buildings and trees. Returns the paths.

    slope: root mean square of the gradient of the hills, 0..1; 0 is level ground. The others are
    those of `generate_area`. Heights are metres above mean sea level, float32. Raises as it does.
    """
    if not 0 <= slope <= 1:
        raise AreaError(f"the slope of hills must be 0 to 1 (0.15 is 15 %), got {slope:g}")
    width_px, height_px = _size_px(size_m, gsd_m)
    landscape, north_m = Landscape(seed), ORIGIN_M[1] + height_px * gsd_m

    def ground(window: PxWindow, step_m: float) -> Float32:
        col, row, width, height = window
        east = (col + np.arange(width, dtype=np.float64) + 0.5) * step_m
        south = (row + np.arange(height, dtype=np.float64) + 0.5) * step_m
        return hills(seed, east, north_m - ORIGIN_M[1] - south, slope)

    def surface(date: Epoch, window: PxWindow) -> Float32:
        col, row, width, height = window
        corner = ORIGIN_M[0] + col * gsd_m, north_m - row * gsd_m
        objects = landscape.object_heights(date, *corner, width, height, gsd_m)
        return np.asarray(ground(window, gsd_m) + objects, np.float32)

    def write(
        name: str, heights: Callable[[PxWindow], Float32], size_px: tuple[int, int], pixel_m: float
    ) -> Path:
        def rounded(window: PxWindow) -> Float32:
            return np.round(heights(window), 2)[None]  # centimetres are enough, and compress

        profile, path = {"count": 1, "dtype": "float32", "predictor": 3}, Path(out_dir) / name
        _write(path, profile, {DATUM_TAG: "msl"}, rounded, size_px, pixel_m, north_m)
        return path

    posting_m = max(TERRAIN_POSTING_M, gsd_m)
    size = (ceil(width_px * gsd_m / posting_m), ceil(height_px * gsd_m / posting_m))
    surfaces = [
        write(f"{date.name}_dsm.tif", partial(surface, date), (width_px, height_px), gsd_m)
        for date in dates
    ]
    return [write("dem.tif", partial(ground, step_m=posting_m), size, posting_m), *surfaces]


def _size_px(size_m: tuple[float, float], gsd_m: float) -> tuple[int, int]:
    """Return (width, height) in pixels; raise `AreaError` for an impossible image."""
    check_gsd(gsd_m)
    if not all(isfinite(side) and side > 0.0 for side in size_m):
        raise AreaError(f"size_m must be two finite positive lengths, got {size_m}")
    width, height = (max(1, int(np.ceil(side / gsd_m - 1e-6))) for side in size_m)
    return width, height


def _write(
    path: Path,
    profile: dict[str, Any],
    tags: dict[str, str],
    made: Callable[[PxWindow], NDArray[Any]],
    size_px: tuple[int, int],
    pixel_m: float,
    north_m: float,
) -> None:
    """Write bands (bands, rows, columns), made window by window, under a temporary name."""
    usual = {
        "driver": "GTiff",
        "width": size_px[0],
        "height": size_px[1],
        "crs": "EPSG:2154",
        "transform": Affine(pixel_m, 0.0, ORIGIN_M[0], 0.0, -pixel_m, north_m),
        "tiled": True,
        "blockxsize": _BLOCK_PX,
        "blockysize": _BLOCK_PX,
        "compress": "deflate",
        "BIGTIFF": "IF_SAFER",
    }
    with replacing(path) as part, rasterio.open(part, "w", **usual, **profile) as target:
        target.update_tags(TIFFTAG_SOFTWARE="orthonav", **tags)
        windows = list(chunks(*size_px, _WINDOW_PX))
        for window in tqdm(windows, path.name, disable=None, leave=False, delay=2):
            target.write(made(window), window=Window(*window))


def hills(seed: int, east_m: Float64, north_m: Float64, slope: float) -> Float32:
    """Return heights (H, W) of the bare ground on the grid of `north_m` x `east_m`.

    `slope`: root mean square of the gradient.
    """
    made = fractal_grid(key_of(seed, "hills"), east_m, north_m, HILLS_M, HILLS_GAIN)
    return np.asarray(MEAN_HEIGHT_M + made * np.float32(slope / _unit_slope()), np.float32)


@cache
def _unit_slope() -> float:
    """Root mean square of the gradient of noise of amplitude 1."""
    at = np.arange(0.0, 40_000.0, 100.0)
    made = fractal_grid(key_of("hills"), at, at, HILLS_M, HILLS_GAIN)
    return float(np.sqrt(sum(np.mean(part**2) for part in np.gradient(made, 100.0))))
