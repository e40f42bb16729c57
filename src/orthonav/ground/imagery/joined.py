"""Orthophotos on one pixel lattice, such as the tiles of a producer, read as one virtual raster.

Resampled one by one, neighbouring tiles would leave a line of invalid pixels between them. GDAL's
VRT joins them on their own pixels first, so they are resampled across the seam.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from xml.sax.saxutils import escape

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.dtypes import dtype_rev, typename_fwd
from rasterio.enums import Resampling
from rasterio.transform import Affine
from rasterio.windows import Window

from orthonav.ground.imagery.source import Source

STRIP_PX = 4 * 2**20
MAX_OFF_PX = 0.05
"""Largest deviation of a tile from the lattice: far below the error of orthophotos."""


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
        """Columns and rows."""
        return int(self.boxes_px[:, 2].max()), int(self.boxes_px[:, 3].max())

    def open(self, near: NDArray[np.bool_]) -> Any:
        """The members that are `near` (N,) as one dataset."""
        if self._is_plain:
            return rasterio.open(self.first.name)
        return rasterio.open(self._vrt(np.flatnonzero(near).tolist()))

    @property
    def bands(self) -> list[int]:
        return list(self.first.bands if self._is_plain else range(1, self.first.colours + 1))

    @property
    def _is_plain(self) -> bool:
        """One file, whose bands and mask are used as GDAL gives them."""
        first = self.first
        has_false_alpha = first.marked_alpha and first.masks == first.other_masks
        return len(self.members) == 1 and not (first.has_palette or has_false_alpha)

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
        step = bottom - top
        if not self._is_plain:  # GDAL reads band by band: decoded tiles must stay in its cache
            step = max(1, STRIP_PX // (factor * (right - left))) * factor
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
        """Averaged over squares of `factor` pixels."""
        shape = max(1, round(window.height / factor)), max(1, round(window.width / factor))
        how: dict[str, Any] = {"window": window}
        if factor > 1 and not self.first.has_palette:
            how["resampling"] = Resampling.average
        elif factor > 1:  # GDAL would average the indexes of one file
            values, mask = dataset.read(**how), dataset.dataset_mask(**how)
            known = (mask > 0).astype(np.float32)
            share = cv2.resize(known, shape[::-1], interpolation=cv2.INTER_AREA)
            means = [
                cv2.resize(band * known, shape[::-1], interpolation=cv2.INTER_AREA)
                / np.maximum(share, 1e-6)
                for band in values
            ]
            return np.rint(means).astype(np.uint8), np.rint(share * 255).astype(np.uint8)
        values = dataset.read(self.bands, out_shape=(self.first.colours, *shape), **how)
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
        t = self.transform
        dtype = _gdal_type("uint8" if self.first.has_palette else self.first.dtype)
        bands = "".join(
            f'<VRTRasterBand dataType="{dtype}" band="{band + 1}">'
            + "".join(_values(*member, band) for member in self._placed(members))
            + "</VRTRasterBand>"
            for band in range(self.first.colours)
        )
        masks = "".join(_mask(*member) for member in self._placed(members))
        return (
            f'<VRTDataset rasterXSize="{width}" rasterYSize="{height}">'
            f"<SRS>{escape(self.first.system.to_wkt())}</SRS>"
            f"<GeoTransform>{t.c!r},{t.a!r},{t.b!r},{t.f!r},{t.d!r},{t.e!r}</GeoTransform>{bands}"
            f'<MaskBand><VRTRasterBand dataType="Byte">{masks}</VRTRasterBand></MaskBand>'
            "</VRTDataset>"
        )

    def _placed(self, members: list[int]) -> Iterator[tuple[Source, str]]:
        """Members not covered by others, the last first, with the XML of file and place."""
        shown, covered = [], set[tuple[int, ...]]()
        for index in members:
            box = tuple(self.boxes_px[index].tolist())
            if box not in covered:
                shown.append(index)
            if not self.sources[index].masks:
                covered.add(box)
        for index in reversed(shown):
            source, (left, top) = self.sources[index], self.boxes_px[index, :2].tolist()
            size = f'xSize="{source.width_px}" ySize="{source.height_px}"'
            dtype = _gdal_type(source.dtype)
            yield (
                source,
                f'<SourceFilename relativeToVRT="0">{escape(source.name)}</SourceFilename>'
                f'<SourceProperties RasterXSize="{source.width_px}" '
                f'RasterYSize="{source.height_px}" DataType="{dtype}" BlockXSize="256" '
                f'BlockYSize="256"/><SrcRect xOff="0" yOff="0" {size}/>'
                f'<DstRect xOff="{left}" yOff="{top}" {size}/>',
            )


def _gdal_type(dtype: str) -> str:
    return str(typename_fwd[dtype_rev[dtype]])


def _values(source: Source, place: str, band: int) -> str:
    number, more = source.bands[0 if source.has_palette else band], ""
    if source.has_palette:
        more = f"<ColorTableComponent>{band + 1}</ColorTableComponent>"
    if source.masks:
        more += "<UseMaskBand>true</UseMaskBand>"
    kind = "ComplexSource" if more else "SimpleSource"
    return f"<{kind}>{place}<SourceBand>{number}</SourceBand>{more}</{kind}>"


def _mask(source: Source, place: str) -> str:
    """255 everywhere, or the union of the masks of a file."""
    everywhere = "<ScaleOffset>255</ScaleOffset><ScaleRatio>0</ScaleRatio>"
    valid = [(mask, "<NODATA>0</NODATA>") for mask in source.masks]
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
    transform = sources[0].transform * Affine.translation(int(corner[0]), int(corner[1]))
    return Lattice(tuple(members), tuple(sources), transform, boxes)


def _offset_px(first: Source, other: Source) -> tuple[int, int] | None:
    """Columns and rows from corner to corner; None where no lattice fits."""
    alike = (
        first.crs == other.crs
        and first.colours == other.colours
        and first.has_palette == other.has_palette
        and first.dtype == other.dtype
    )
    if not alike:
        return None
    col, row = ~first.transform * (other.transform.c, other.transform.f)
    offset = round(col), round(row)
    longest = max(other.width_px, other.height_px)
    skew = np.array(other.transform[:6]) - np.array(first.transform[:6])
    unit = min(
        np.hypot(first.transform.a, first.transform.d),
        np.hypot(first.transform.b, first.transform.e),
    )
    stretch_px = np.abs(skew[[0, 1, 3, 4]]).max() * longest / unit
    off_px = max(abs(col - offset[0]), abs(row - offset[1])) + stretch_px
    return offset if off_px <= MAX_OFF_PX else None
