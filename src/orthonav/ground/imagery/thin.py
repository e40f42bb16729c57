"""Windows of one orthophoto file, averaged to about a given resolution."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.enums import MaskFlags, Resampling
from rasterio.transform import Affine
from rasterio.windows import Window

from orthonav.ground.imagery.source import Source

STRIP_BYTES = 64 * 2**20
_STRIP_PIXEL_BYTES = 48
"""Largest memory per full-resolution pixel while it is averaged: values, colours, sums, mask."""


def read_thinned(
    dataset: Any, source: Source, window: Window, gsd_m: float
) -> tuple[NDArray[Any], NDArray[np.uint8], Affine]:
    """Bands (C, h, w), mask (h, w) 0..255 and transform of a source window.

    Averaged to about `gsd_m` where the source is finer, which avoids aliasing and uses overviews
    where the file has them. A palette is expanded to its colours.
    """
    factor = max(1, round(gsd_m / source.gsd_m))
    window = _aligned(window, factor, dataset)
    # GDAL averages palette indexes, and drops pixels that a false alpha band marks as transparent.
    if factor > 1 and (source.palette is not None or source.false_alpha):
        values, share = _averaged_in_strips(dataset, source, window, factor)
        mask = np.rint(share * 255).astype(np.uint8)
        scale = Affine.scale(factor)
    else:
        shape = (max(1, round(window.height / factor)), max(1, round(window.width / factor)))
        how = Resampling.nearest if factor == 1 else Resampling.average
        values, mask = _read(dataset, source, window, shape, how)
        scale = Affine.scale(window.width / shape[1], window.height / shape[0])
    return (
        values,
        mask,
        source.transform * Affine.translation(window.col_off, window.row_off) * scale,
    )


def cells_of(
    dataset: Any, source: Source, at: tuple[int, int], shape: tuple[int, int], factor: int
) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Means (C, h, w) of squares of `factor` pixels, and the share (h, w) of each that is valid.

    The first begins at column and row `at`, which may lie outside; pixels outside are invalid.
    """
    (col, row), (rows, cols) = at, shape
    left, top = max(col, 0), max(row, 0)
    right, bottom = (
        min(col + cols * factor, source.width_px),
        min(row + rows * factor, source.height_px),
    )
    window = Window(left, top, right - left, bottom - top)
    whole = (right - left, bottom - top) == (cols * factor, rows * factor)
    plain = source.palette is None and not source.false_alpha
    if factor == 1 or (whole and plain):
        how = Resampling.nearest if factor == 1 else Resampling.average
        values, mask = _read(dataset, source, window, shape, how)
        return values, np.asarray(mask / np.float32(255), dtype=np.float32)
    return _averaged_in_strips(dataset, source, window, factor, (left - col, top - row))


def _read(
    dataset: Any,
    source: Source,
    window: Window,
    shape: tuple[int, int],
    how: Resampling = Resampling.nearest,
) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """Bands (C, h, w), palette expanded, and mask (h, w) of a window read as `shape`."""
    bands = list(source.bands)
    values = dataset.read(bands, window=window, out_shape=(len(bands), *shape), resampling=how)
    mask = read_mask(dataset, source, window=window, out_shape=shape, resampling=how)
    if values.dtype.kind == "f":  # NaN is nodata, whether the file declares it or not
        mask = mask * np.isfinite(values).all(axis=0)
    if source.palette is not None:
        values = np.ascontiguousarray(source.palette[values[0]].transpose(2, 0, 1))
    return values, mask


def read_mask(dataset: Any, source: Source, **how: Any) -> NDArray[np.uint8]:
    """Mask (h, w), 0 for nodata to 255; `how` is passed to rasterio (`out_shape` is needed)."""
    if not source.false_alpha:
        return np.asarray(dataset.dataset_mask(**how), dtype=np.uint8)
    if MaskFlags.alpha in dataset.mask_flag_enums[source.bands[0] - 1]:
        return np.full(how["out_shape"], 255, dtype=np.uint8)
    bands = list(source.bands)
    masks = dataset.read_masks(bands, **how | {"out_shape": (len(bands), *how["out_shape"])})
    return np.asarray(masks.max(axis=0), dtype=np.uint8)


def _averaged_in_strips(
    dataset: Any, source: Source, window: Window, factor: int, lead_px: tuple[int, int] = (0, 0)
) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Means of the valid pixels of squares of `factor` pixels, and the valid share, 0 to 1.

    The first squares begin `lead_px` columns and rows before the window.
    """
    ahead, above = lead_px
    rows, cols = -(-(above + window.height) // factor), -(-(ahead + window.width) // factor)
    strip_rows = max(1, STRIP_BYTES // (_STRIP_PIXEL_BYTES * cols * factor**2))
    values: list[NDArray[Any]] = []
    shares: list[NDArray[np.float32]] = []
    for row in range(0, rows, strip_rows):
        top = max(0, row * factor - above)
        height = min((row + strip_rows) * factor - above, window.height) - top
        strip = Window(window.col_off, window.row_off + top, window.width, height)
        pixels, mask = _read(dataset, source, strip, (height, window.width))
        lead = (ahead, above if row == 0 else 0)
        share = _square_means((mask > 0).astype(np.float32), factor, lead)
        means = [
            _square_means(np.where(mask > 0, band, 0).astype(np.float32), factor, lead)
            for band in pixels
        ]
        whole = pixels.dtype.kind in "iu"
        mean = np.stack(means) / np.maximum(share, 1e-6)
        values.append((np.rint(mean) if whole else mean).astype(pixels.dtype))
        shares.append(share)
    return np.concatenate(values, axis=1), np.concatenate(shares)


def _square_means(
    band: NDArray[np.float32], factor: int, lead_px: tuple[int, int]
) -> NDArray[np.float32]:
    """Means over squares of `factor` pixels; missing pixels of the outer ones count as 0."""
    left, top = lead_px
    bottom, right = -(top + band.shape[0]) % factor, -(left + band.shape[1]) % factor
    if left or top or bottom or right:
        band = np.pad(band, ((top, bottom), (left, right)))
    size = (band.shape[1] // factor, band.shape[0] // factor)
    return np.asarray(cv2.resize(band, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _aligned(window: Window, factor: int, dataset: Any) -> Window:
    """The window extended to multiples of `factor` pixels, so that all windows average alike."""
    left, top = window.col_off // factor * factor, window.row_off // factor * factor
    right = min(-(-(window.col_off + window.width) // factor) * factor, dataset.width)
    bottom = min(-(-(window.row_off + window.height) // factor) * factor, dataset.height)
    return Window(left, top, right - left, bottom - top)
