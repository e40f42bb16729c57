"""Orthophotos and heights of a generated landscape as GeoTIFF files."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from math import ceil, isfinite
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from lab.landscape.epoch import DEFAULT_DATES, Epoch
from lab.landscape.hills import hills
from lab.landscape.noise import Float32
from lab.landscape.scene import ORIGIN_M, Landscape, check_gsd
from lab.landscape.window import chunks
from orthonav.core.errors import AreaError, OutputError
from orthonav.core.extras import missing_extra
from orthonav.core.files import not_written, replacing

_BLOCK_PX = 512
_WINDOW_PX = 1024  # a whole number of blocks, so that no block is compressed twice
_LARGEST_PX = 2_000_000
PxWindow = tuple[int, int, int, int]
"""Column, row, width and height."""
Report = Callable[[float], None]
"""Takes what is done, 0..1."""
TERRAIN_POSTING_M = 5.0
"""Distance of the heights of the generated terrain."""


def generate_area(
    out_dir: Path,
    *,
    size_m: tuple[float, float] = (2000.0, 2000.0),
    gsd_m: float = 1.0,
    dates: Sequence[Epoch] = DEFAULT_DATES,
    seed: int = 1,
    progress: Callable[[float], None] | None = None,
) -> list[Path]:
    """Write one orthophoto `out_dir/<date name>.tif` per date and return their paths.

    size_m: (east, north) extent; rounded up to whole pixels. gsd_m: metres per pixel, 0.2..10.
    The lower left corner is `ORIGIN_M` in EPSG:2154. `progress` is called with 0..1. Files are
    tiled RGB uint8, written window by window, so memory does not grow with the area.
    Raises `AreaError` on impossible sizes, `MissingExtraError` without rasterio and `OutputError`
    where the files cannot be written.
    """
    width_px, height_px = _size_px(size_m, gsd_m)
    names = [date.name for date in dates]
    if not names or len(set(names)) < len(names):
        raise AreaError(f"dates must be one or more with different names, got {names}")
    landscape, size_px = Landscape(seed), (width_px, height_px)
    return _write_all(
        {
            Path(out_dir) / f"{date.name}.tif": partial(_write, landscape, date, size_px, gsd_m)
            for date in dates
        },
        progress,
    )


def generate_heights(
    out_dir: Path,
    *,
    slope: float,
    size_m: tuple[float, float] = (2000.0, 2000.0),
    gsd_m: float = 1.0,
    dates: Sequence[Epoch] = DEFAULT_DATES,
    seed: int = 1,
    progress: Callable[[float], None] | None = None,
) -> list[Path]:
    """Write the terrain `out_dir/dem.tif` under an area and, for each date, the surface model
    `out_dir/<date name>_dsm.tif`: the terrain with its buildings and trees. Returns the paths.

    slope: root mean square of the gradient of the hills, 0..1; 0 is level ground. The others are
    those of `generate_area`. Heights are metres above mean sea level, float32. If interrupted, none
    of the files is left. Raises as it does.
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

    posting_m = max(TERRAIN_POSTING_M, gsd_m)
    size = (ceil(width_px * gsd_m / posting_m), ceil(height_px * gsd_m / posting_m))

    def surface(date: Epoch, window: PxWindow) -> Float32:
        col, row, width, height = window
        corner = ORIGIN_M[0] + col * gsd_m, north_m - row * gsd_m
        objects = landscape.object_heights(date, *corner, width, height, gsd_m)
        return np.asarray(ground(window, gsd_m) + objects, np.float32)

    terrain = partial(_write_heights, partial(ground, step_m=posting_m), size, posting_m, north_m)
    writers = {Path(out_dir) / "dem.tif": terrain}
    for date in dates:
        writers[Path(out_dir) / f"{date.name}_dsm.tif"] = partial(
            _write_heights, partial(surface, date), (width_px, height_px), gsd_m, north_m
        )
    return _write_all(writers, progress)


def _write_all(
    writers: Mapping[Path, Callable[[Report, Path], None]], progress: Report | None
) -> list[Path]:
    """Write files under temporary names; all are whole before any is renamed. Returns the paths."""
    with ExitStack() as stack:
        for number, (path, write) in enumerate(writers.items()):

            def report(share: float, done: int = number) -> None:
                if progress is not None:
                    progress((done + share) / len(writers))

            report(0.0)
            temporary = stack.enter_context(replacing(path))
            try:
                write(report, temporary)
            except OSError as error:
                if isinstance(error, OutputError) or error.errno is not None:
                    raise  # GDAL's own errors carry no number
                raise not_written(error.__cause__ or error, path) from error
    return list(writers)


def _write_heights(
    heights: Callable[[PxWindow], Float32],
    size_px: tuple[int, int],
    posting_m: float,
    north_m: float,
    report: Report,
    path: Path,
) -> None:
    from orthonav.ground.imagery.terrain import DATUM_TAG

    def rounded(window: PxWindow) -> NDArray[np.float32]:
        return np.round(heights(window), 2)[None]  # centimetres are enough, and compress

    profile = {"count": 1, "dtype": "float32", "predictor": 3}
    tags = {DATUM_TAG: "msl"}
    _write_windows(path, profile, tags, rounded, size_px, posting_m, north_m, report)


def _size_px(size_m: tuple[float, float], gsd_m: float) -> tuple[int, int]:
    """Return (width, height) in pixels; raise `AreaError` for an impossible image."""
    check_gsd(gsd_m)
    if not all(isfinite(side) and side > 0.0 for side in size_m):
        raise AreaError(f"size_m must be two finite positive lengths, got {size_m}")
    width, height = (max(1, int(np.ceil(side / gsd_m - 1e-6))) for side in size_m)
    if max(width, height) > _LARGEST_PX:
        raise AreaError(f"area of {width} x {height} px is over {_LARGEST_PX} px a side: {size_m}")
    return width, height


def _write(
    landscape: Landscape,
    date: Epoch,
    size_px: tuple[int, int],
    gsd_m: float,
    report: Report,
    path: Path,
) -> None:
    west_m, north_m = ORIGIN_M[0], ORIGIN_M[1] + size_px[1] * gsd_m

    def rendered(window: PxWindow) -> NDArray[np.uint8]:
        col, row, width, height = window
        picture = landscape.render(
            date, west_m + col * gsd_m, north_m - row * gsd_m, width, height, gsd_m
        )
        return np.moveaxis(picture, 2, 0)

    profile = {"count": 3, "dtype": "uint8", "photometric": "RGB", "predictor": 2}
    tags = {"TIFFTAG_DATETIME": date.tiff_datetime}
    _write_windows(path, profile, tags, rendered, size_px, gsd_m, north_m, report)


def _write_windows(
    path: Path,
    profile: Mapping[str, Any],
    tags: Mapping[str, str],
    made: Callable[[PxWindow], NDArray[Any]],
    size_px: tuple[int, int],
    pixel_m: float,
    north_m: float,
    report: Report,
) -> None:
    """Write bands (bands, rows, columns), made window by window, and read them back."""
    try:
        import rasterio
        from rasterio import Affine
        from rasterio.windows import Window
    except ImportError as error:
        raise missing_extra("writing a generated area", "geo", "rasterio", error) from error
    width_px, height_px = size_px
    usual = {
        "driver": "GTiff",
        "width": width_px,
        "height": height_px,
        "crs": "EPSG:2154",
        "transform": Affine(pixel_m, 0.0, ORIGIN_M[0], 0.0, -pixel_m, north_m),
        "tiled": True,
        "blockxsize": _BLOCK_PX,
        "blockysize": _BLOCK_PX,
        "compress": "deflate",
        "BIGTIFF": "IF_SAFER",
    }
    done = 0
    checksums = []
    with rasterio.open(path, "w", **usual, **profile) as target:
        target.update_tags(TIFFTAG_SOFTWARE="orthonav", **tags)
        for window in chunks(width_px, height_px, _WINDOW_PX):
            bands = made(window)
            target.write(bands, window=Window(*window))
            checksums.append((Window(*window), crc32(bands.tobytes())))
            done += window[2] * window[3]
            report(done / (width_px * height_px))
    _check_written(path, checksums)


def _check_written(path: Path, checksums: list[tuple[Any, int]]) -> None:
    """Read windows back: GDAL writes its last blocks on closing, and ignores errors there."""
    import rasterio

    with rasterio.open(path) as source:
        for window, checksum in checksums:
            if crc32(source.read(window=window).tobytes()) != checksum:
                raise OSError("the written file cannot be read back; check for a full disk")
