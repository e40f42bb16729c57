"""One or several orthophotos as one image, resampled into a sheet's plane and read by windows."""

import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.transform import Affine
from rasterio.warp import reproject
from rasterio.warp import transform as transform_coordinates
from rasterio.windows import Window

from orthonav.core.cores import usable_cores
from orthonav.core.errors import ImageryError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.ground.imagery.folder import sources_in
from orthonav.ground.imagery.joined import Lattice, lattices_of
from orthonav.ground.imagery.plates import at_epoch
from orthonav.ground.imagery.source import Source, open_sources, quiet, unreadable

GDAL_OPTIONS = {"GDAL_CACHEMAX": 192 * 2**20}
WHOLLY_VALID = 250
"""Interpolated mask (0..255) from which a pixel is valid: no invalid neighbour."""
_FALSE_ORIGIN_M = 1_000_000.0
"""Added to the sheet's coordinates for GDAL: it treats a raster that starts at exactly (0, 0) with
pixels of 1 m, as a window in the middle of a sheet may, as one without georeference."""
_MARGIN_PX = 4
"""Pixels read around a window: cubic interpolation needs two; the others cover rounding."""
_REACH_PX = 7
"""Width of the box whose mean fills the edge of holes: beyond the reach of cubic weights."""
SAMPLE_PX = 512
"""Side of the decimated image that percentiles are computed from."""
SAMPLED_SOURCES = 12
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ContrastStretch:
    low: float
    high: float

    def apply(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        scale = 255.0 / (self.high - self.low)
        scaled = (values.astype(np.float32) - self.low) * scale
        return np.asarray(np.clip(np.nan_to_num(scaled) + 0.5, 0, 255), dtype=np.uint8)


def sample_stretches(sources: Sequence[Source]) -> tuple[ContrastStretch | None, ...]:
    """None for 8 bit, else the 0.5 and 99.5 percentiles of all valid pixels of a product."""
    alike: dict[Any, list[int]] = {}
    for index, source in enumerate(sources):
        if source.dtype != "uint8" and not source.has_palette:
            kind = source.dtype, source.colours, round(source.gsd_m, 2), source.crs
            alike.setdefault(kind, []).append(index)
    found: list[ContrastStretch | None] = [None] * len(sources)
    for members in alike.values():
        stretch = _common([sources[index] for index in members])
        for index in members:
            found[index] = stretch
    deep = sum(len(members) for members in alike.values())
    if len(alike) > 1 or 0 < deep < len(sources):
        log.warning(
            "orthophotos have several pixel types; each kind is stretched to 8 bits separately"
        )
    return tuple(found)


def _common(sources: list[Source]) -> ContrastStretch:
    values = []
    broken: ImageryError | None = None
    for source in sources[:: max(1, -(-len(sources) // SAMPLED_SOURCES))]:
        try:
            values.append(_valid_values(source))
        except RasterioError as error:  # it may not be needed; reported where it is
            broken = broken or unreadable(source.path, error)
    if broken is not None and not values:
        raise broken
    every = np.concatenate(values)
    if every.size == 0:
        raise ImageryError("orthophotos have no valid pixel (all nodata)")
    low, high = (float(value) for value in np.percentile(every, [0.5, 99.5]))
    return ContrastStretch(low, high if high > low else low + 1.0)


def _valid_values(source: Source) -> NDArray[Any]:
    (lattice,) = lattices_of([source])
    with quiet(), lattice.open(np.ones(1, np.bool_)) as data:
        shape = (min(SAMPLE_PX, data.height), min(SAMPLE_PX, data.width))
        pixels = data.read(lattice.bands, out_shape=(source.colours, *shape))
        valid = data.dataset_mask(out_shape=shape) > 0
    sampled = pixels[:, valid].ravel()
    return np.asarray(sampled[np.isfinite(sampled)])


@dataclass(frozen=True, eq=False)
class Mosaic:
    """Orthophotos read as one; where several overlap, the first one given wins."""

    sources: tuple[Source, ...]
    stretches: tuple[ContrastStretch | None, ...]

    @classmethod
    def open(cls, paths: Sequence[Path], epoch: float | None = None) -> "Mosaic":
        """Nothing stays open. `epoch`: decimal year of positions that drift with a plate."""
        if not paths:
            raise ImageryError("no orthophoto was given")
        sources: list[Source] = []
        for are_folders, group in groupby(map(Path, paths), Path.is_dir):
            some = list(group)
            found = map(sources_in, some) if are_folders else [open_sources(some)[0]]
            sources += chain.from_iterable(found)
        if epoch is not None:
            sources = at_epoch(sources, epoch)
        with rasterio.Env(**GDAL_OPTIONS):
            return cls(tuple(sources), sample_stretches(sources))

    @property
    def stretch(self) -> ContrastStretch | None:
        """Of the first source with more than 8 bits."""
        return next((each for each in self.stretches if each is not None), None)

    @property
    def gsd_m(self) -> float:
        """The finest."""
        return min(source.gsd_m for source in self.sources)

    @property
    def outline_latlon_deg(self) -> NDArray[np.float64]:
        """Border points (N, 2) of all sources."""
        return np.concatenate([source.outline_latlon_deg for source in self.sources])

    @property
    def common_stamp(self) -> list[list[float] | None]:
        """What all pixels depend on besides their files."""
        found = {(each.low, each.high) for each in self.stretches if each is not None}
        return [list(each) for each in sorted(found)]

    def describe(self) -> tuple[dict[str, Any], ...]:
        """Entries of the map's manifest: one per file, and one per kind of files of a folder."""
        kinds: dict[Any, list[Source]] = {}
        for index, source in enumerate(self.sources):
            alike: Any = index
            if source.folder is not None:
                alike = source.folder, source.crs, round(source.gsd_m, 3), source.dtype
            kinds.setdefault(alike, []).append(source)
        return tuple(_described(members) for members in kinds.values())

    def sheet(self, frame: LocalFrame, **place: Any) -> "SheetRaster":
        return SheetRaster(self, frame, **place)

    def grid_sheet(
        self, frame: LocalFrame, grid: TileGrid, threads: int | None = None
    ) -> "SheetRaster":
        names = ("west_m", "north_m", "width_px", "height_px", "gsd_m")
        place = {name: getattr(grid, name) for name in names}
        return SheetRaster(self, frame, **place, threads=threads)

    @cached_property
    def lattices(self) -> list[Lattice]:
        return lattices_of(self.sources)


def _described(sources: Sequence[Source]) -> dict[str, Any]:
    first = sources[0]
    if first.folder is None:
        return first.describe()
    dates = sorted(source.date for source in sources if source.date is not None)
    entry = first.describe() | {
        "name": first.folder.resolve().name,
        "date": dates[-1] if dates else None,
        "files": len(sources),
    }
    del entry["width_px"], entry["height_px"]
    if dates and dates[0] != dates[-1]:
        entry["date_from"] = dates[0]
    return entry


@dataclass(frozen=True, eq=False)
class Pixels:
    """`rgb` (H, W, 3) uint8 and `valid` (H, W) bool."""

    rgb: NDArray[np.uint8]
    valid: NDArray[np.bool_]

    @cached_property
    def grey(self) -> NDArray[np.uint8]:
        """ITU-R BT.601 weights; 0 where not valid."""
        return np.asarray(cv2.cvtColor(self.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class GreyPixels:
    """`grey` (H, W) uint8, 0 where not valid, and `valid` (H, W) bool."""

    grey: NDArray[np.uint8]
    valid: NDArray[np.bool_]


class SheetRaster:
    """Belongs to the thread that enters it; start other threads than the main one in `quiet`."""

    def __init__(
        self,
        mosaic: Mosaic,
        frame: LocalFrame,
        *,
        west_m: float,
        north_m: float,
        width_px: int,
        height_px: int,
        gsd_m: float,
        threads: int | None = None,
    ) -> None:
        self._mosaic, self._frame = mosaic, frame
        self._transform = Affine(gsd_m, 0, west_m, 0, -gsd_m, north_m)
        self._gsd_m = gsd_m
        self._threads = threads or usable_cores()
        self.width_px, self.height_px = width_px, height_px
        self._boxes_px = self._boxes()
        self._open: dict[int, Any] = {}
        self._env = ExitStack()

    def __enter__(self) -> "SheetRaster":
        options = GDAL_OPTIONS | {"GDAL_NUM_THREADS": str(self._threads)}
        self._env.enter_context(quiet())
        self._env.enter_context(rasterio.Env(**options))
        return self

    def __exit__(self, *exc: object) -> None:
        for dataset in self._open.values():
            dataset.close()
        self._env.close()

    def read(self, col: int, row: int, width_px: int, height_px: int) -> Pixels:
        """Pixels of a window; outside all imagery they are 0 and invalid."""
        values, valid = self._composed(Window(col, row, width_px, height_px), 3)
        return Pixels(values, valid)

    def read_grey(self, col: int, row: int, width_px: int, height_px: int) -> GreyPixels:
        """Converted before resampling: within one level of `read`, and faster."""
        values, valid = self._composed(Window(col, row, width_px, height_px), 1)
        return GreyPixels(values[..., 0], valid)

    def _composed(
        self, window: Window, colours: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Values (H, W, colours) and valid (H, W); earlier lattices cover later ones."""
        shape = window.height, window.width
        out = np.zeros((*shape, colours), np.uint8)
        valid = np.zeros(shape, np.bool_)
        weight, total = np.zeros(shape, np.float32), np.zeros((*shape, colours), np.float32)
        for lattice, (x0, y0, x1, y1) in self._parts(window):
            part = np.s_[
                y0 - window.row_off : y1 - window.row_off, x0 - window.col_off : x1 - window.col_off
            ]
            if valid[part].all():
                continue
            values, mask = self._warped(lattice, Window(x0, y0, x1 - x0, y1 - y0), colours)
            new = (mask >= WHOLLY_VALID) & ~valid[part]
            np.copyto(out[part], values, where=new[..., None])
            valid[part] |= new
            partly = np.where(valid[part], 0, mask).astype(np.float32)
            if partly.any():
                weight[part] += partly
                total[part] += values * partly[..., None]
        # Covered only together, as along a seam: the mean.
        closed = (weight >= WHOLLY_VALID) & ~valid
        out[closed] = np.rint(total[closed] / weight[closed][:, None])
        return out, valid | closed

    def _parts(self, window: Window) -> Iterator[tuple[Lattice, tuple[int, int, int, int]]]:
        """Lattices that may overlap a window, and the overlap: left, top, right, bottom."""
        left, top = max(window.col_off, 0), max(window.row_off, 0)
        right = min(window.col_off + window.width, self.width_px)
        bottom = min(window.row_off + window.height, self.height_px)
        near = self._near(left, top, right, bottom)
        for lattice in self._mosaic.lattices:
            members = np.array(lattice.members)
            boxes = self._boxes_px[members[near[members]]]
            if len(boxes):
                low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
                yield (
                    lattice,
                    (
                        max(left, int(low[0])),
                        max(top, int(low[1])),
                        min(right, int(high[0])),
                        min(bottom, int(high[1])),
                    ),
                )

    def _near(self, left: int, top: int, right: int, bottom: int) -> NDArray[np.bool_]:
        boxes = self._boxes_px
        near = (boxes[:, 0] < right) & (boxes[:, 2] > left)
        return np.asarray(near & (boxes[:, 1] < bottom) & (boxes[:, 3] > top))

    def _warped(
        self, lattice: Lattice, window: Window, colours: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """A lattice resampled into a window of the sheet: values (H, W, C) and mask (H, W)."""
        shape = (window.height, window.width)
        target = self._transform * Affine.translation(window.col_off, window.row_off)
        needed = self._source_window(lattice, target, shape)
        if needed is None:
            return np.zeros((*shape, colours), np.uint8), np.zeros(shape, np.uint8)
        part, is_inside = needed
        try:
            values, mask, transform = lattice.read(self._dataset(lattice), part, self._gsd_m)
        except RasterioError as error:
            said = f"{error} {error.__cause__}"
            named = (each.path for each in lattice.sources if each.path.name in said)
            raise unreadable(next(named, lattice.first.path), error) from error
        stretch = self._mosaic.stretches[lattice.members[0]]
        picture = _in_colours(values if stretch is None else stretch.apply(values), colours)
        if is_inside and mask.all() and mask.min() == 255:
            return self._resampled(lattice, picture, transform, target, shape, True), np.full(
                shape, 255, np.uint8
            )
        _fill_holes(picture, mask)
        warped = self._resampled(lattice, picture, transform, target, shape, True)
        warped_mask = self._resampled(lattice, mask[None], transform, target, shape, False)
        return warped, warped_mask[..., 0]

    def _resampled(
        self,
        lattice: Lattice,
        bands: NDArray[np.uint8],
        transform: Affine,
        target: Affine,
        shape: tuple[int, int],
        is_picture: bool,
    ) -> NDArray[np.uint8]:
        """Bands (C, h, w) resampled to (H, W, C): images by cubic, masks by bilinear weights."""
        out = np.zeros((len(bands), *shape), dtype=np.uint8)
        first = lattice.first
        # Sheet pixels per source pixel. GDAL would derive it from the shapes of the two windows and
        # blur narrow windows of a rotated source.
        scale = first.gsd_m * math.sqrt(abs(transform.determinant / first.transform.determinant))
        scale = min(1.0, scale / self._gsd_m)
        reproject(
            bands,
            out,
            src_transform=transform,
            src_crs=first.system,
            dst_transform=Affine.translation(_FALSE_ORIGIN_M, _FALSE_ORIGIN_M) * target,
            dst_crs=f"{self._frame.proj4} +x_0={_FALSE_ORIGIN_M} +y_0={_FALSE_ORIGIN_M}",
            resampling=Resampling.cubic if is_picture else Resampling.bilinear,
            num_threads=self._threads,
            warp_mem_limit=64,
            XSCALE=scale,
            YSCALE=scale,
        )
        return np.ascontiguousarray(out.transpose(1, 2, 0))

    def _source_window(
        self, lattice: Lattice, target: Affine, shape: tuple[int, int]
    ) -> tuple[Window, bool] | None:
        """Pixels of a lattice that a window needs, and whether all of them exist; None for none."""
        share = np.linspace(0, 1, 9)
        zero, one = np.zeros(9), np.ones(9)
        cols = np.concatenate([share, share, zero, one]) * shape[1]
        rows = np.concatenate([zero, one, share, share]) * shape[0]
        east, north = target * (cols, rows)
        lat, lon = self._frame.latlon_from_en(np.stack([east, north], axis=1))
        x, y = transform_coordinates("EPSG:4326", lattice.first.system, lon, lat)[:2]
        col, row = ~lattice.transform * (np.asarray(x), np.asarray(y))
        if not (np.isfinite(col).all() and np.isfinite(row).all()):
            return None
        margin = _MARGIN_PX * max(1.0, self._gsd_m / lattice.first.gsd_m)
        wanted = [
            (math.floor(each.min() - margin), math.floor(each.max() + margin) + 1)
            for each in (col, row)
        ]
        had = [
            (max(0, low), min(size, high))
            for (low, high), size in zip(wanted, lattice.size_px, strict=True)
        ]
        (left, right), (top, bottom) = had
        if left >= right or top >= bottom:
            return None
        return Window(left, top, right - left, bottom - top), had == wanted

    def _dataset(self, lattice: Lattice) -> Any:
        key = lattice.members[0]
        if key not in self._open:
            near = self._near(0, 0, self.width_px, self.height_px)
            self._open[key] = lattice.open(near[list(lattice.members)])
        return self._open[key]

    def _boxes(self) -> NDArray[np.int64]:
        """Left, top, right, bottom pixel (N, 4) of the sources in this raster, with a margin."""
        outlines = np.stack([source.outline_latlon_deg for source in self._mosaic.sources])
        points = self._frame.en_from_latlon(outlines[..., 0], outlines[..., 1])
        x = (points[..., 0] - self._transform.c) / self._gsd_m
        y = (self._transform.f - points[..., 1]) / self._gsd_m
        low = np.floor([x.min(axis=1), y.min(axis=1)]) - 2
        high = np.ceil([x.max(axis=1), y.max(axis=1)]) + 2
        return np.concatenate([low, high]).T.astype(np.int64)


def _in_colours(bands: NDArray[np.uint8], colours: int) -> NDArray[np.uint8]:
    if len(bands) == colours:
        return bands
    if colours == 3:
        return np.repeat(bands, 3, axis=0)
    rgb = np.ascontiguousarray(bands.transpose(1, 2, 0))
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)[None]


def _fill_holes(bands: NDArray[np.uint8], mask: NDArray[np.uint8]) -> None:
    """Interpolation mixes neighbours, so the fill value of a hole would show next to it."""
    known = (mask > 0).astype(np.float32)
    if known.all() or not known.any():
        return
    size = (_REACH_PX, _REACH_PX)
    weight = np.asarray(cv2.blur(known, size, borderType=cv2.BORDER_CONSTANT))
    filled = (known == 0) & (weight > 0)
    for band in bands:
        total = np.asarray(cv2.blur(band * known, size, borderType=cv2.BORDER_CONSTANT))
        band[filled] = np.rint(total[filled] / weight[filled])
