"""Reading windows of one orthophoto file, thinned to about a wanted resolution."""

import warnings
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.enums import MaskFlags, Resampling
from rasterio.errors import NodataShadowWarning
from rasterio.transform import Affine
from rasterio.windows import Window

from orthonav.imagery.source import Source

STRIP_BYTES = 64 * 2**20
_STRIP_PIXEL_BYTES = 48
"""Most that a full-resolution pixel takes while it is averaged: values, colours, sums, mask."""


def read_thinned(
    dataset: Any, source: Source, window: Window, gsd_m: float
) -> tuple[NDArray[Any], NDArray[np.uint8], Affine]:
    """Bands (C, h, w), mask (h, w) 0..255 and transform of a source window.

    Averaged to about the ground resolution wanted where the source is finer than that, so that
    nothing aliases and overviews are used where the file has them. A palette becomes its colours.
    """
    factor = max(1, round(gsd_m / source.gsd_m))
    window = _aligned(window, factor, dataset)
    # GDAL averages the numbers of a palette, and leaves out what the alpha band says is missing.
    if factor > 1 and (source.palette is not None or source.false_alpha):
        values, mask = _averaged_in_strips(dataset, source, window, factor)
        scale = Affine.scale(factor)
    else:
        shape = (max(1, round(window.height / factor)), max(1, round(window.width / factor)))
        how = Resampling.nearest if factor == 1 else Resampling.average
        values, mask = _read(dataset, source, window, shape, how)
        scale = Affine.scale(window.width / shape[1], window.height / shape[0])
    return (
        values,
        mask,
        dataset.transform * Affine.translation(window.col_off, window.row_off) * scale,
    )


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
    if values.dtype.kind == "f":  # not a number is no data, whether the file says so or not
        mask = mask * np.isfinite(values).all(axis=0)
    if source.palette is not None:
        values = np.ascontiguousarray(source.palette[values[0]].transpose(2, 0, 1))
    return values, mask


def read_mask(dataset: Any, source: Source, **how: Any) -> NDArray[np.uint8]:
    """Mask (h, w), 0 for nodata to 255; `how` is passed to rasterio (`out_shape` is needed)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NodataShadowWarning)
        if not source.false_alpha:
            return np.asarray(dataset.dataset_mask(**how), dtype=np.uint8)
        if MaskFlags.alpha in dataset.mask_flag_enums[source.bands[0] - 1]:
            return np.full(how["out_shape"], 255, dtype=np.uint8)
        bands = list(source.bands)
        masks = dataset.read_masks(bands, **how | {"out_shape": (len(bands), *how["out_shape"])})
    return np.asarray(masks.max(axis=0), dtype=np.uint8)


def _averaged_in_strips(
    dataset: Any, source: Source, window: Window, factor: int
) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """Means over squares of `factor` pixels of what is valid, and the valid share as 0..255."""
    rows, cols = -(-window.height // factor), -(-window.width // factor)
    strip_rows = max(1, STRIP_BYTES // (_STRIP_PIXEL_BYTES * cols * factor**2))
    values: list[NDArray[Any]] = []
    masks: list[NDArray[np.uint8]] = []
    for row in range(0, rows, strip_rows):
        top = row * factor
        height = min(strip_rows * factor, window.height - top)
        strip = Window(window.col_off, window.row_off + top, window.width, height)
        pixels, mask = _read(dataset, source, strip, (height, window.width))
        share = _square_means((mask > 0).astype(np.float32), factor)
        means = [
            _square_means(np.where(mask > 0, band, 0).astype(np.float32), factor) for band in pixels
        ]
        whole = pixels.dtype.kind in "iu"
        mean = np.stack(means) / np.maximum(share, 1e-6)
        values.append((np.rint(mean) if whole else mean).astype(pixels.dtype))
        masks.append(np.rint(share * 255).astype(np.uint8))
    return np.concatenate(values, axis=1), np.concatenate(masks)


def _square_means(band: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Means over squares of `factor` pixels; what is missing of the last ones counts as 0."""
    bottom, right = -band.shape[0] % factor, -band.shape[1] % factor
    if bottom or right:
        band = np.pad(band, ((0, bottom), (0, right)))
    size = (band.shape[1] // factor, band.shape[0] // factor)
    return np.asarray(cv2.resize(band, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _aligned(window: Window, factor: int, dataset: Any) -> Window:
    """The window grown to multiples of `factor` pixels, so that every window averages alike."""
    left, top = window.col_off // factor * factor, window.row_off // factor * factor
    right = min(-(-(window.col_off + window.width) // factor) * factor, dataset.width)
    bottom = min(-(-(window.row_off + window.height) // factor) * factor, dataset.height)
    return Window(left, top, right - left, bottom - top)
