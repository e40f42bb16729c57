"""One or several orthophotos as one image, resampled into a sheet's plane and read by windows.

GDAL's VRT joins files on one pixel lattice, such as the tiles of a producer, on their own pixels
first. Resampled one by one, they would leave a line of invalid pixels between neighbours.
"""

import logging
import math
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, groupby
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.dtypes import dtype_rev, typename_fwd
from rasterio.enums import Resampling
from rasterio.transform import Affine
from rasterio.warp import reproject
from rasterio.windows import Window

from orthonav.core.cores import usable_cores
from orthonav.core.errors import ImageryError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.ground.imagery.source import (
    GDAL_ERRORS,
    Source,
    name_bands,
    open_sources,
    quiet,
    sources_in,
    unreadable,
)
from orthonav.ground.imagery.systems import at_epoch, converted, unfit
from orthonav.ground.planning.area import outline

GDAL_OPTIONS = {"GDAL_CACHEMAX": 192 * 2**20}
WHOLLY_VALID = 250
"""Interpolated mask (0..255) from which a pixel is valid: no invalid neighbour."""
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Lattice:
    """Sources on one pixel lattice; where several overlap, the first wins.

    `members`: indexes of the mosaic's sources. `boxes_px` (N, 4): left, top, right, bottom of each.
    """

    members: tuple[int, ...]
    sources: tuple[Source, ...]
    transform: Affine
    boxes_px: NDArray[np.int64]

    @property
    def first(self) -> Source:
        """All share its CRS, type and resolution."""
        return self.sources[0]

    @cached_property
    def size_px(self) -> tuple[int, int]:
        return int(self.boxes_px[:, 2].max()), int(self.boxes_px[:, 3].max())

    def open(self, near: NDArray[np.bool_]) -> Any:
        """The members that are `near` (N,) as one dataset."""
        return rasterio.open(self._vrt(np.flatnonzero(near).tolist()))

    def read(
        self, dataset: Any, window: Window, gsd_m: float
    ) -> tuple[NDArray[Any], NDArray[np.uint8], Affine]:
        """Bands (C, h, w), mask (h, w), 0 (invalid) to 255, and transform of a window.

        Averaged to about `gsd_m` where that is coarser, against aliasing, all windows alike.
        """
        factor = self._factor(max(1, round(gsd_m / self.first.gsd_m)))
        (left, top), (width, height) = (window.col_off, window.row_off), self.size_px
        left, top = left // factor * factor, top // factor * factor
        right = min(-(-(window.col_off + window.width) // factor) * factor, width)
        bottom = min(-(-(window.row_off + window.height) // factor) * factor, height)
        # GDAL reads band by band: decoded tiles must stay in its cache
        step = max(1, 4 * 2**20 // (factor * (right - left))) * factor
        strips = [
            self._read(dataset, Window(left, row, right - left, min(step, bottom - row)), factor)
            for row in range(top, bottom, step)
        ]
        values = np.concatenate([strip[0] for strip in strips], axis=1)
        mask = np.concatenate([strip[1] for strip in strips])
        if values.dtype.kind == "f":  # NaN is nodata, whether the file declares it or not
            mask = mask * np.isfinite(values).all(axis=0)
        scale = Affine.scale((right - left) / mask.shape[1], (bottom - top) / mask.shape[0])
        return values, mask, self.transform * Affine.translation(left, top) * scale

    def _read(
        self, dataset: Any, window: Window, factor: int
    ) -> tuple[NDArray[Any], NDArray[np.uint8]]:
        shape = max(1, round(window.height / factor)), max(1, round(window.width / factor))
        how: dict[str, Any] = {"window": window}
        if factor > 1:
            how["resampling"] = Resampling.average
        values = dataset.read(out_shape=(dataset.count, *shape), **how)
        return values, dataset.dataset_mask(out_shape=shape, **how)

    def _factor(self, wanted: int) -> int:
        """Pixels per side averaged: the largest with which squares end where tiles do, if any."""
        if len(self.members) > 1:
            for factor in range(wanted, max(1, (wanted + 1) // 2) - 1, -1):
                if not (self.boxes_px % factor).any():
                    return factor
        return wanted

    def _vrt(self, members: list[int]) -> str:
        """XML that joins members, the first on top, each where it is valid."""
        width, height = self.size_px
        dtype = typename_fwd[dtype_rev[self.first.dtype]]
        placed = [(self.sources[at], self._place(at, dtype)) for at in reversed(members)]
        bands = "".join(
            f'<VRTRasterBand dataType="{dtype}" band="{band + 1}">'
            + "".join(_values(*each, band) for each in placed)
            + "</VRTRasterBand>"
            for band in range(len(self.first.bands))
        )
        masks = "".join(_mask(*each) for each in placed)
        return (
            f'<VRTDataset rasterXSize="{width}" rasterYSize="{height}">'
            f"<SRS>{escape(self.first.system.to_wkt())}</SRS>"
            f"<GeoTransform>{','.join(map(repr, self.transform.to_gdal()))}</GeoTransform>{bands}"
            f'<MaskBand><VRTRasterBand dataType="Byte">{masks}</VRTRasterBand></MaskBand>'
            "</VRTDataset>"
        )

    def _place(self, member: int, dtype: str) -> str:
        """The XML of a member's file and place."""
        source, (left, top) = self.sources[member], self.boxes_px[member, :2].tolist()
        width, height = source.width_px, source.height_px
        return (
            f'<SourceFilename relativeToVRT="0">{escape(str(source.path))}</SourceFilename>'
            f'<SourceProperties RasterXSize="{width}" RasterYSize="{height}" DataType="{dtype}" '
            f'BlockXSize="256" BlockYSize="256"/>'
            f'<SrcRect xOff="0" yOff="0" xSize="{width}" ySize="{height}"/>'
            f'<DstRect xOff="{left}" yOff="{top}" xSize="{width}" ySize="{height}"/>'
        )


def _values(source: Source, place: str, band: int) -> str:
    kind, more = "SimpleSource", ""
    if source.masks:
        kind, more = "ComplexSource", "<UseMaskBand>true</UseMaskBand>"
    if source.is_indexed:
        kind, more = "ComplexSource", f"<ColorTableComponent>{band + 1}</ColorTableComponent>{more}"
    return f"<{kind}>{place}<SourceBand>{source.bands[band]}</SourceBand>{more}</{kind}>"


def _mask(source: Source, place: str) -> str:
    """255 everywhere, or the union of the masks of a file."""
    everywhere = "<ScaleOffset>255</ScaleOffset><ScaleRatio>0</ScaleRatio>"
    opaque = "<ColorTableComponent>4</ColorTableComponent>"
    zero = opaque if source.is_indexed and source.masks == ("1",) else "<NODATA>0</NODATA>"
    valid = [(mask, zero) for mask in source.masks]
    return "".join(
        f"<ComplexSource>{place}<SourceBand>{band}</SourceBand>{more}</ComplexSource>"
        for band, more in valid or [(str(source.bands[0]), everywhere)]
    )


def lattices_of(sources: Sequence[Source]) -> list[Lattice]:
    """Only consecutive sources share one, so that earlier sources still cover later ones."""
    runs: list[list[int]] = []
    for index, source in enumerate(sources):
        if runs and _offset_px(sources[runs[-1][0]], source) is not None:
            runs[-1].append(index)
        else:
            runs.append([index])
    return [_lattice(run, [sources[index] for index in run]) for run in runs]


def _lattice(members: list[int], sources: list[Source]) -> Lattice:
    offsets = np.array([_offset_px(sources[0], each) for each in sources], np.int64)
    corner = offsets.min(axis=0)
    sizes = np.array([(each.width_px, each.height_px) for each in sources], np.int64)
    boxes = np.concatenate([offsets - corner, offsets - corner + sizes], axis=1)
    transform = sources[0].transform * Affine.translation(*corner.tolist())
    return Lattice(tuple(members), tuple(sources), transform, boxes)


def _offset_px(first: Source, other: Source) -> tuple[int, int] | None:
    """Columns and rows from corner to corner; None where no lattice fits to 0.05 pixels, which is
    far below the error of orthophotos."""
    kinds = {(each.crs, len(each.bands), each.is_indexed, each.dtype) for each in (first, other)}
    if len(kinds) > 1:
        return None
    t = first.transform
    col, row = ~t * (other.transform.c, other.transform.f)
    offset = round(col), round(row)
    longest = max(other.width_px, other.height_px)
    skew = np.array(other.transform[:6]) - np.array(t[:6])
    unit = min(np.hypot(t.a, t.d), np.hypot(t.b, t.e))
    stretch_px = np.abs(skew[[0, 1, 3, 4]]).max() * longest / unit
    off_px = max(abs(col - offset[0]), abs(row - offset[1])) + stretch_px
    return offset if off_px <= 0.05 else None


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
        if source.dtype != "uint8":
            kind = source.dtype, len(source.bands), round(source.gsd_m, 2), source.crs
            alike.setdefault(kind, []).append(index)
    found: list[ContrastStretch | None] = [None] * len(sources)
    for members in alike.values():
        some = members[:: max(1, -(-len(members) // 12))]
        values = np.concatenate([_valid_values(sources[index]) for index in some])
        if values.size == 0:
            raise ImageryError("orthophotos have no valid pixel (all nodata)")
        low, quarter, three_quarters, high = np.percentile(values, [0.5, 25, 75, 99.5]).tolist()
        if three_quarters - quarter < (high - low) / 256:
            log.warning(
                "most pixels have one grey level, as values reach from %g to %g: state the value "
                "of missing pixels (gdal_edit.py -a_nodata): %s",
                *(low, high, sources[members[0]].path),
            )
        for index in members:
            found[index] = ContrastStretch(low, high if high > low else low + 1.0)
    return tuple(found)


def _valid_values(source: Source) -> NDArray[Any]:
    """Of all bands, decimated to at most 512 x 512 px."""
    (lattice,) = lattices_of([source])
    try:
        with quiet(), lattice.open(np.ones(1, np.bool_)) as data:
            shape = (min(512, data.height), min(512, data.width))
            pixels = data.read(out_shape=(data.count, *shape))
            valid = data.dataset_mask(out_shape=shape) > 0
    except GDAL_ERRORS as error:
        raise unreadable(source.path, error) from error
    sampled = pixels[:, valid].ravel()
    return np.asarray(sampled[np.isfinite(sampled)])


@dataclass(frozen=True, eq=False)
class Mosaic:
    """Orthophotos read as one; where several overlap, the first one given wins."""

    sources: tuple[Source, ...]
    stretches: tuple[ContrastStretch | None, ...]

    @classmethod
    def open(
        cls, paths: Sequence[Path], epoch: float | None = None, bands: tuple[int, ...] | None = None
    ) -> "Mosaic":
        """Nothing stays open. `epoch`: decimal year of positions that drift with a plate; `bands`:
        as of `open_sources`."""
        if not paths:
            raise ImageryError("no orthophoto was given")
        sources: list[Source] = []
        for are_folders, group in groupby(map(Path, paths), Path.is_dir):
            some = list(group)
            if are_folders:
                sources += chain(*(sources_in(each, bands) for each in some))
            else:
                sources += open_sources(some, bands=bands)
                if bands is None:
                    name_bands(sources)
        if epoch is not None:
            sources = at_epoch(sources, epoch)
        with rasterio.Env(**GDAL_OPTIONS):
            return cls(tuple(sources), sample_stretches(sources))

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
        return self.sheet(frame, **{name: getattr(grid, name) for name in names}, threads=threads)

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
    """`rgb` (H, W, 3) uint8, or (H, W, 1) of `read_grey`, and `valid` (H, W) bool."""

    rgb: NDArray[np.uint8]
    valid: NDArray[np.bool_]

    @cached_property
    def grey(self) -> NDArray[np.uint8]:
        """ITU-R BT.601 weights; 0 where not valid."""
        if self.rgb.shape[2] == 1:
            return self.rgb[..., 0]
        return np.asarray(cv2.cvtColor(self.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


class SheetRaster:
    """A mosaic in the pixels of a sheet; a context manager.

    Threads may share it, each with datasets of its own; start those in `quiet`."""

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
        self._opened: dict[tuple[int, int], Any] = {}

    def __enter__(self) -> "SheetRaster":
        return self

    def __exit__(self, *exc: object) -> None:
        for dataset in self._opened.values():
            dataset.close()
        self._opened.clear()

    def read(self, col: int, row: int, width_px: int, height_px: int) -> Pixels:
        """Pixels of a window; outside all imagery they are 0 and invalid."""
        return self._composed(Window(col, row, width_px, height_px), 3)

    def read_grey(self, col: int, row: int, width_px: int, height_px: int) -> Pixels:
        """Converted before resampling: within one level of `read`, and faster."""
        return self._composed(Window(col, row, width_px, height_px), 1)

    def _composed(self, window: Window, colours: int) -> Pixels:
        """Earlier lattices cover later ones."""
        shape, off = (window.height, window.width), (window.row_off, window.col_off)
        out = np.zeros((*shape, colours), np.uint8)
        valid = np.zeros(shape, np.bool_)
        weight, total = np.zeros(shape, np.float32), np.zeros((*shape, colours), np.float32)
        with quiet(), rasterio.Env(**GDAL_OPTIONS, GDAL_NUM_THREADS=str(self._threads)):
            for lattice, overlap in self._parts(window):
                rows, cols = overlap.toslices()
                part = np.s_[
                    rows.start - off[0] : rows.stop - off[0],
                    cols.start - off[1] : cols.stop - off[1],
                ]
                if valid[part].all():
                    continue
                values, mask = self._warped(lattice, overlap, colours)
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
        return Pixels(out, valid | closed)

    def _parts(self, window: Window) -> Iterator[tuple[Lattice, Window]]:
        """Lattices that may overlap a window, and the overlap."""
        left, top = max(window.col_off, 0), max(window.row_off, 0)
        right = min(window.col_off + window.width, self.width_px)
        bottom = min(window.row_off + window.height, self.height_px)
        near = self._near(left, top, right, bottom)
        for lattice in self._mosaic.lattices:
            members = np.array(lattice.members)
            boxes = self._boxes_px[members[near[members]]]
            if len(boxes):
                low = np.maximum(boxes[:, :2].min(axis=0), [left, top])
                high = np.minimum(boxes[:, 2:].max(axis=0), [right, bottom])
                yield lattice, Window(*low.tolist(), *(high - low).tolist())

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
        part = self._source_window(lattice, target, shape)
        if part is None:
            return np.zeros((*shape, colours), np.uint8), np.zeros(shape, np.uint8)
        try:
            values, mask, transform = lattice.read(self._dataset(lattice), part, self._gsd_m)
        except GDAL_ERRORS as error:
            said = f"{error} {error.__cause__}"
            named = (each.path for each in lattice.sources if each.path.name in said)
            raise unreadable(next(named, lattice.first.path), error) from error
        stretch = self._mosaic.stretches[lattice.members[0]]
        picture = _in_colours(values if stretch is None else stretch.apply(values), colours)
        _fill_holes(picture, mask)
        out = np.zeros((colours, *shape), np.uint8), np.zeros((1, *shape), np.uint8)
        first = lattice.first
        # Sheet pixels per source pixel. GDAL would derive it from the shapes of the two windows and
        # blur narrow windows of a rotated source.
        scale = first.gsd_m * math.sqrt(abs(transform.determinant / first.transform.determinant))
        scale = min(1.0, scale / self._gsd_m)
        # GDAL treats a raster that starts at exactly (0, 0) with pixels of 1 m, as a window in the
        # middle of a sheet may, as one without georeference.
        origin_m = 1_000_000.0
        how: dict[str, Any] = {
            "src_transform": transform,
            "src_crs": first.system,
            "dst_transform": Affine.translation(origin_m, origin_m) * target,
            "dst_crs": f"{self._frame.proj4} +x_0={origin_m} +y_0={origin_m}",
            "num_threads": self._threads,
            "warp_mem_limit": 64,
            "XSCALE": scale,
            "YSCALE": scale,
        }
        try:
            reproject(picture, out[0], **how, resampling=Resampling.cubic)
            reproject(mask[None], out[1], **how, resampling=Resampling.bilinear)
        except MemoryError:
            raise
        except Exception as error:  # rasterio exports no class of the errors of GDAL it raises here
            raise unfit(first.path) from error
        return np.ascontiguousarray(out[0].transpose(1, 2, 0)), out[1][0]

    def _source_window(
        self, lattice: Lattice, target: Affine, shape: tuple[int, int]
    ) -> Window | None:
        """Pixels of a lattice that a window needs; None for none. Raises `ImageryError`."""
        east, north = target * outline((0, 0, shape[1], shape[0]), 8).T
        lat, lon = self._frame.latlon_from_en(np.stack([east, north], axis=1))
        x, y = converted("EPSG:4326", lattice.first.system, lon, lat)
        if np.isnan(x).all():
            raise unfit(lattice.first.path)
        col, row = ~lattice.transform * (x, y)
        if not (np.isfinite(col).all() and np.isfinite(row).all()):
            return None
        # Cubic interpolation needs two pixels around the window; the others cover rounding.
        margin = 4 * max(1.0, self._gsd_m / lattice.first.gsd_m)
        low = np.floor([col.min() - margin, row.min() - margin]).astype(int)
        high = np.floor([col.max() + margin, row.max() + margin]).astype(int) + 1
        left, top = np.maximum(low, 0).tolist()
        right, bottom = np.minimum(high, lattice.size_px).tolist()
        if left >= right or top >= bottom:
            return None
        return Window(left, top, right - left, bottom - top)

    def _dataset(self, lattice: Lattice) -> Any:
        key = threading.get_ident(), lattice.members[0]
        if key not in self._opened:
            near = self._near(0, 0, self.width_px, self.height_px)
            self._opened[key] = lattice.open(near[list(lattice.members)])
        return self._opened[key]

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
    size = (7, 7)  # beyond the reach of cubic weights
    weight = np.asarray(cv2.blur(known, size, borderType=cv2.BORDER_CONSTANT))
    filled = (known == 0) & (weight > 0)
    for band in bands:
        total = np.asarray(cv2.blur(band * known, size, borderType=cv2.BORDER_CONSTANT))
        band[filled] = np.rint(total[filled] / weight[filled])
