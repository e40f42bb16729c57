"""One or several orthophotos as one picture, resampled into a sheet's plane by windows."""

import math
import os
import warnings
from collections import OrderedDict
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.transform import Affine
from rasterio.warp import reproject
from rasterio.warp import transform as transform_coordinates
from rasterio.windows import Window

from orthonav.errors import ImageryError
from orthonav.geo.frames import LocalFrame
from orthonav.geo.grid import TileGrid
from orthonav.imagery.source import Source, open_source, unreadable
from orthonav.imagery.stretch import Stretch, sample_stretch
from orthonav.imagery.thin import read_thinned

GDAL_OPTIONS = {"GDAL_CACHEMAX": 128 * 2**20, "GDAL_NUM_THREADS": "ALL_CPUS"}
MAX_OPEN = 24
WHOLLY_VALID = 250
"""A pixel counts as valid where the interpolated mask (0..255) is at least this."""
_MASK_RESAMPLING = Resampling.bilinear
_FALSE_ORIGIN_M = 1_000_000.0
"""Added to the sheet's coordinates for GDAL, which takes a raster that starts at exactly (0, 0)
with pixels of 1 m, as a window in the middle of a sheet does, for one without georeference."""


@dataclass(frozen=True, eq=False)
class Pixels:
    """A window of a sheet: `rgb` (H, W, 3) uint8 and `valid` (H, W) bool."""

    rgb: NDArray[np.uint8]
    valid: NDArray[np.bool_]

    @cached_property
    def grey(self) -> NDArray[np.uint8]:
        """Grey levels (H, W) uint8 (ITU-R BT.601 weights); 0 where not valid."""
        return np.asarray(cv2.cvtColor(self.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class Mosaic:
    """Orthophotos read as one; where several cover a place, the first named wins."""

    sources: tuple[Source, ...]
    stretch: Stretch | None

    @classmethod
    def open(cls, paths: Sequence[Path]) -> "Mosaic":
        """Inspect the files; nothing stays open. Raises as `open_source` does."""
        if not paths:
            raise ImageryError("no orthophoto was named")
        sources = [open_source(Path(path)) for path in paths]
        with rasterio.Env(**GDAL_OPTIONS):
            return cls(tuple(sources), sample_stretch(sources))

    @property
    def gsd_m(self) -> float:
        """Finest ground resolution of the sources in metres."""
        return min(source.gsd_m for source in self.sources)

    @property
    def outline_latlon_deg(self) -> NDArray[np.float64]:
        """Border points (N, 2) of all sources, latitude and longitude in degrees."""
        return np.concatenate([source.outline_latlon_deg for source in self.sources])

    def sheet(
        self,
        frame: LocalFrame,
        *,
        west_m: float,
        north_m: float,
        width_px: int,
        height_px: int,
        gsd_m: float,
    ) -> "SheetRaster":
        """The mosaic resampled into `frame`, as a raster to be read by windows (use `with`)."""
        return SheetRaster(self, frame, west_m, north_m, width_px, height_px, gsd_m)

    def grid_sheet(self, frame: LocalFrame, grid: TileGrid) -> "SheetRaster":
        """The raster that all tiles of a grid together cover (use `with`)."""
        return self.sheet(
            frame,
            west_m=grid.west_m,
            north_m=grid.north_m,
            width_px=grid.width_px,
            height_px=grid.height_px,
            gsd_m=grid.gsd_m,
        )


class SheetRaster:
    """A north-up raster in a sheet's plane over a mosaic; a context manager."""

    def __init__(
        self,
        mosaic: Mosaic,
        frame: LocalFrame,
        west_m: float,
        north_m: float,
        width_px: int,
        height_px: int,
        gsd_m: float,
    ) -> None:
        self._mosaic = mosaic
        self._frame = frame
        self._transform = Affine(gsd_m, 0, west_m, 0, -gsd_m, north_m)
        self._gsd_m = gsd_m
        self.width_px, self.height_px = width_px, height_px
        self._boxes_px = [self._box_px(source) for source in mosaic.sources]
        self._open: OrderedDict[int, Any] = OrderedDict()
        self._env = ExitStack()

    def __enter__(self) -> "SheetRaster":
        self._env.enter_context(rasterio.Env(**GDAL_OPTIONS))
        return self

    def __exit__(self, *exc: object) -> None:
        while self._open:
            self._open.popitem()[1].close()
        self._env.close()

    def read(self, col: int, row: int, width_px: int, height_px: int) -> Pixels:
        """Pixels of a window; what lies outside all imagery is not valid and 0.

        Raises `ImageryError` where a file breaks while it is read.
        """
        rgb = np.zeros((height_px, width_px, 3), dtype=np.uint8)
        valid = np.zeros((height_px, width_px), dtype=bool)
        for index, (left, top, right, bottom) in enumerate(self._boxes_px):
            x0, x1 = max(col, left, 0), min(col + width_px, right, self.width_px)
            y0, y1 = max(row, top, 0), min(row + height_px, bottom, self.height_px)
            if x0 >= x1 or y0 >= y1:
                continue
            part = np.s_[y0 - row : y1 - row, x0 - col : x1 - col]
            if valid[part].all():
                continue
            new_rgb, new_valid = self._read_source(index, Window(x0, y0, x1 - x0, y1 - y0))
            if valid[part].any():
                new_valid &= ~valid[part]
            np.copyto(rgb[part], new_rgb, where=new_valid[..., None])
            valid[part] |= new_valid
        return Pixels(rgb, valid)

    def _read_source(
        self, index: int, window: Window
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Resample one source into a window of the sheet: RGB (H, W, 3) and valid (H, W)."""
        source = self._mosaic.sources[index]
        shape = (window.height, window.width)
        target = self._transform * Affine.translation(window.col_off, window.row_off)
        shifted = Affine.translation(_FALSE_ORIGIN_M, _FALSE_ORIGIN_M) * target
        try:
            dataset = self._dataset(index)
            part = self._source_window(dataset, source, target, shape)
            if part is None:
                return np.zeros((*shape, 3), np.uint8), np.zeros(shape, bool)
            values, mask, transform = read_thinned(dataset, source, part, self._gsd_m)
        except RasterioError as error:
            raise unreadable(source.path, error) from error
        if self._mosaic.stretch is not None and source.palette is None:
            values = self._mosaic.stretch.apply(values)
        warped = np.zeros((values.shape[0], *shape), dtype=np.uint8)
        valid = np.zeros(shape, dtype=np.uint8)
        # Sheet pixels per source pixel. GDAL would guess it from the shapes of the two windows and
        # blur narrow windows of a turned source.
        scale = source.gsd_m * math.sqrt(abs(transform.determinant / dataset.transform.determinant))
        scale = min(1.0, scale / self._gsd_m)
        for pixels, out, how in (
            (values, warped, Resampling.cubic),
            (mask, valid, _MASK_RESAMPLING),
        ):
            reproject(
                pixels,
                out,
                src_transform=transform,
                src_crs=dataset.crs,
                dst_transform=shifted,
                dst_crs=f"{self._frame.proj4} +x_0={_FALSE_ORIGIN_M} +y_0={_FALSE_ORIGIN_M}",
                resampling=how,
                num_threads=os.cpu_count() or 1,
                warp_mem_limit=64,
                XSCALE=scale,
                YSCALE=scale,
            )
        bands = np.repeat(warped, 3, axis=0) if len(warped) == 1 else warped
        usable = valid >= WHOLLY_VALID
        return np.ascontiguousarray(bands.transpose(1, 2, 0)), usable

    def _source_window(
        self, dataset: Any, source: Source, target: Affine, shape: tuple[int, int]
    ) -> Window | None:
        """Pixels of the source that a window of the sheet needs, None where it has none."""
        share = np.linspace(0, 1, 9)
        zero, one = np.zeros(9), np.ones(9)
        cols = np.concatenate([share, share, zero, one]) * shape[1]
        rows = np.concatenate([zero, one, share, share]) * shape[0]
        east, north = target * (cols, rows)
        lat, lon = self._frame.latlon_from_en(np.stack([east, north], axis=1))
        x, y = transform_coordinates("EPSG:4326", dataset.crs, lon, lat)[:2]
        col, row = ~dataset.transform * (np.asarray(x), np.asarray(y))
        if not (np.isfinite(col).all() and np.isfinite(row).all()):
            return None
        margin = 4 * max(1.0, self._gsd_m / source.gsd_m)
        left, right = (
            max(0, int(col.min() - margin)),
            min(dataset.width, int(col.max() + margin) + 1),
        )
        top, bottom = (
            max(0, int(row.min() - margin)),
            min(dataset.height, int(row.max() + margin) + 1),
        )
        if left >= right or top >= bottom:
            return None
        return Window(left, top, right - left, bottom - top)

    def _dataset(self, index: int) -> Any:
        """The opened source; at most `MAX_OPEN` are open at a time."""
        if index in self._open:
            self._open.move_to_end(index)
            return self._open[index]
        if len(self._open) >= MAX_OPEN:
            self._open.popitem(last=False)[1].close()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            self._open[index] = rasterio.open(self._mosaic.sources[index].path)
        return self._open[index]

    def _box_px(self, source: Source) -> tuple[int, int, int, int]:
        """Left, top, right, bottom pixel of the source in this raster, with a margin."""
        outline = source.outline_latlon_deg
        points = self._frame.en_from_latlon(outline[:, 0], outline[:, 1])
        x = (points[:, 0] - self._transform.c) / self._gsd_m
        y = (self._transform.f - points[:, 1]) / self._gsd_m
        low, high = np.floor([x.min(), y.min()]) - 2, np.ceil([x.max(), y.max()]) + 2
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])
