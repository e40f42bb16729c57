"""Orthophotos and heights of a generated landscape as GeoTIFF files."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from math import ceil, isfinite
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from orthonav.errors import AreaError, OutputError
from orthonav.extras import missing_extra
from orthonav.files import not_written, replacing
from orthonav.simulate.landscape.epoch import DEFAULT_DATES, Epoch
from orthonav.simulate.landscape.hills import hills
from orthonav.simulate.landscape.noise import Float32
from orthonav.simulate.landscape.scene import ORIGIN_M, Landscape, check_gsd
from orthonav.simulate.landscape.window import chunks

_BLOCK_PX = 512
_WINDOW_PX = 1024  # a whole number of blocks, so that no block is compressed twice
_LARGEST_PX = 2_000_000
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
    landscape = Landscape(seed)
    paths = [Path(out_dir) / f"{name}.tif" for name in names]
    with ExitStack() as stack:  # all are written before any is renamed
        for number, (date, path) in enumerate(zip(dates, paths, strict=True)):

            def report(share: float, done: int = number) -> None:
                if progress is not None:
                    progress((done + share) / len(names))

            report(0.0)
            temporary = stack.enter_context(replacing(path))
            try:
                _write(temporary, landscape, date, (width_px, height_px), gsd_m, report)
            except OSError as error:
                if isinstance(error, OutputError) or error.errno is not None:
                    raise  # GDAL's own errors carry no number
                raise not_written(error.__cause__ or error, path) from error
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

    def ground(window: tuple[int, int, int, int], step_m: float) -> Float32:
        col, row, width, height = window
        east = (col + np.arange(width, dtype=np.float64) + 0.5) * step_m
        south = (row + np.arange(height, dtype=np.float64) + 0.5) * step_m
        return hills(seed, east, north_m - ORIGIN_M[1] - south, slope)

    posting_m = max(TERRAIN_POSTING_M, gsd_m)
    size = (ceil(width_px * gsd_m / posting_m), ceil(height_px * gsd_m / posting_m))
    paths = [Path(out_dir) / "dem.tif"]
    with replacing(paths[0]) as temporary:
        _write_heights(
            temporary, lambda window: ground(window, posting_m), size, posting_m, north_m
        )
    for date in dates:

        def surface(window: tuple[int, int, int, int], date: Epoch = date) -> Float32:
            col, row, width, height = window
            corner = ORIGIN_M[0] + col * gsd_m, north_m - row * gsd_m
            objects = landscape.object_heights(date, *corner, width, height, gsd_m)
            return np.asarray(ground(window, gsd_m) + objects, np.float32)

        paths.append(Path(out_dir) / f"{date.name}_dsm.tif")
        with replacing(paths[-1]) as temporary:
            _write_heights(temporary, surface, (width_px, height_px), gsd_m, north_m)
    return paths


def _write_heights(
    path: Path,
    heights: Callable[[tuple[int, int, int, int]], Float32],
    size_px: tuple[int, int],
    posting_m: float,
    north_m: float,
) -> None:
    """Write heights, given for windows (col, row, width, height)."""
    import rasterio
    from rasterio import Affine
    from rasterio.windows import Window

    from orthonav.imagery.terrain import DATUM_TAG

    width_px, height_px = size_px
    profile: dict[str, Any] = {
        "driver": "GTiff", "width": width_px, "height": height_px, "count": 1, "dtype": "float32",
        "crs": "EPSG:2154", "tiled": True, "blockxsize": _BLOCK_PX, "blockysize": _BLOCK_PX,
        "transform": Affine(posting_m, 0.0, ORIGIN_M[0], 0.0, -posting_m, north_m),
        "compress": "deflate", "predictor": 3, "BIGTIFF": "IF_SAFER",
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as target:
        target.update_tags(**{DATUM_TAG: "msl", "TIFFTAG_SOFTWARE": "orthonav"})
        for window in chunks(width_px, height_px, _WINDOW_PX):
            # Centimetres are enough, and compress.
            target.write(np.round(heights(window), 2), 1, window=Window(*window))


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
    path: Path,
    landscape: Landscape,
    date: Epoch,
    size_px: tuple[int, int],
    gsd_m: float,
    report: Callable[[float], None],
) -> None:
    try:
        import rasterio
        from rasterio import Affine
        from rasterio.windows import Window
    except ImportError as error:
        raise missing_extra("writing a generated area", "geo", "rasterio", error) from error
    width_px, height_px = size_px
    west_m, north_m = ORIGIN_M[0], ORIGIN_M[1] + height_px * gsd_m
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": width_px,
        "height": height_px,
        "count": 3,
        "dtype": "uint8",
        "crs": "EPSG:2154",
        "transform": Affine(gsd_m, 0.0, west_m, 0.0, -gsd_m, north_m),
        "photometric": "RGB",
        "tiled": True,
        "blockxsize": _BLOCK_PX,
        "blockysize": _BLOCK_PX,
        "compress": "deflate",
        "predictor": 2,
        "BIGTIFF": "IF_SAFER",
    }
    done = 0
    checksums = []
    with rasterio.open(path, "w", **profile) as target:
        target.update_tags(TIFFTAG_DATETIME=date.tiff_datetime, TIFFTAG_SOFTWARE="orthonav")
        for col, row, width, height in chunks(width_px, height_px, _WINDOW_PX):
            picture = landscape.render(
                date, west_m + col * gsd_m, north_m - row * gsd_m, width, height, gsd_m
            )
            window = Window(col, row, width, height)
            target.write(np.moveaxis(picture, 2, 0), window=window)
            checksums.append((window, crc32(picture.tobytes())))
            done += width * height
            report(done / (width_px * height_px))
    _check_written(path, checksums)


def _check_written(path: Path, checksums: list[tuple[Any, int]]) -> None:
    """Read windows back: GDAL writes its last blocks on closing, and ignores errors there."""
    import rasterio

    with rasterio.open(path) as source:
        for window, checksum in checksums:
            picture = np.moveaxis(source.read(window=window), 0, 2)
            if crc32(picture.tobytes()) != checksum:
                raise OSError("the written file cannot be read back; check for a full disk")
