"""The landscape: renders any window at any date and resolution."""

from collections.abc import Iterator
from functools import lru_cache, partial
from math import ceil

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.landscape.crops import appearance_of
from lab.landscape.epoch import Epoch
from lab.landscape.looks import Cover, Look, seen
from lab.landscape.network import Network
from lab.landscape.noise import Float32, key_of, noise_grid, white_grid
from lab.landscape.plan import CellPlan, make_plan, outline_box
from lab.landscape.relief import (
    lighting,
    paint_buildings,
    paint_orchards,
    paint_trees,
    paint_wood,
    shadow_reach_m,
)
from lab.landscape.surface import label_parcels, paint_lines, paint_parcels
from lab.landscape.window import PixelWindow, chunks
from orthonav.core.errors import AreaError

ORIGIN_M = (652000.0, 6862000.0)
"""Lambert-93 (EPSG:2154) east and north of the landscape's origin."""

GSD_RANGE_M = (0.2, 10.0)
"""Finest and coarsest ground resolution that can be rendered."""

_CHUNK_PX = 1024
_CACHED_CELLS = 96  # enough for one row of chunks
_SKY = np.array([0.40, 0.43, 0.48], np.float32)  # share of diffuse light, which shadows receive too
_HAZE_RGB = np.array([196.0, 204.0, 214.0], np.float32)
_MIDDLE = 120.0
_FADE = 0.15  # colours are less saturated from the air


class Landscape:
    """An unbounded generated landscape; a pure function of its seed."""

    def __init__(self, seed: int = 1) -> None:
        if seed < 0:
            raise AreaError(f"the seed of a landscape must not be negative, got {seed}")
        self.seed = seed
        self._network = network = Network(seed)
        self._plan = lru_cache(_CACHED_CELLS)(partial(make_plan, network))
        self._box = lru_cache(64 * _CACHED_CELLS)(partial(outline_box, network))

    def render(
        self,
        date: Epoch,
        west_m: float,
        north_m: float,
        width_px: int,
        height_px: int,
        gsd_m: float,
    ) -> NDArray[np.uint8]:
        """Return the image (H, W, 3) RGB of the window whose upper left corner is given.

        west_m, north_m: outer corner of the first pixel in EPSG:2154, metres.
        gsd_m: metres on the ground per pixel, 0.2..10. Windows on the same pixel grid agree where
        they overlap. Raises `AreaError` on impossible sizes.
        """
        out = np.empty((height_px, width_px, 3), np.uint8)
        for part, inside, factor in _parts(west_m, north_m, width_px, height_px, gsd_m):
            picture, _ = self._picture(part.finer(factor), date)
            out[inside] = develop(_averaged(picture, factor), part, self.seed, date)
        return out

    def object_heights(
        self,
        date: Epoch,
        west_m: float,
        north_m: float,
        width_px: int,
        height_px: int,
        gsd_m: float,
    ) -> Float32:
        """Return heights (H, W) of buildings, trees and woods above the ground, as `render`."""
        out = np.empty((height_px, width_px), np.float32)
        for part, inside, factor in _parts(west_m, north_m, width_px, height_px, gsd_m):
            _, heights = self._picture(part.finer(factor), date)
            out[inside] = _averaged(heights[..., None], factor)[..., 0]
        return out

    def _picture(self, window: PixelWindow, date: Epoch) -> tuple[Float32, Float32]:
        """Return the picture (H, W, 3) float of a window and the heights (H, W) of its objects,
        drawn with a margin and cropped."""
        margin = ceil(max(shadow_reach_m(date), 24.0) / window.gsd_m) + 4
        wide = window.part(
            -margin, -margin, window.width_px + 2 * margin, window.height_px + 2 * margin
        )
        plans = self._plans_in(wide)
        labels = label_parcels(plans, wide)
        appearance = appearance_of(plans, date)
        rgb = paint_parcels(labels, appearance, wide, self.seed, date)
        lines = paint_lines(rgb, plans, self._network, wide, date)
        height = paint_wood(rgb, labels, appearance, lines.open, wide, self.seed, date)
        paint_orchards(rgb, height, labels, appearance, lines.open, wide, date)
        paint_trees(rgb, height, plans, wide, date)
        image = np.clip(rgb, 0.0, 255.0).astype(np.uint8)
        roofs = paint_buildings(image, height, plans, wide, date)
        light = lighting(height, roofs, wide, date)
        if date.look is not Look.COLOUR:
            cover = Cover.of(lines.roads, lines.water, roofs, height)
            rgb, light = seen(date.look, image.astype(np.float32), light, cover, wide, self.seed)
            image = np.clip(rgb, 0.0, 255.0).astype(np.uint8)
        inner = np.s_[margin:-margin, margin:-margin]
        return expose(image, light, wide, date)[inner], height[inner]

    def _plans_in(self, window: PixelWindow) -> list[CellPlan]:
        """Return the plans of the macro-cells that reach into a window, in a fixed order."""
        cells = self._network.cells_near(window.bounds_m)
        return [self._plan(*cell) for cell in cells if window.touches(self._box(*cell))]


def _parts(
    west_m: float, north_m: float, width_px: int, height_px: int, gsd_m: float
) -> Iterator[tuple[PixelWindow, tuple[slice, slice], int]]:
    """Yield the pieces of a window by its corner in EPSG:2154: each as a window, where it lies in
    the picture, and how much finer it is drawn. Raises `AreaError` for impossible sizes."""
    if width_px < 1 or height_px < 1:
        raise AreaError(f"an image needs at least one pixel, got {width_px} x {height_px}")
    check_gsd(gsd_m)
    if not (np.isfinite(west_m) and np.isfinite(north_m)):
        raise AreaError(f"the corner of an image must be finite, got {west_m}, {north_m}")
    corner_m = west_m - ORIGIN_M[0], north_m - ORIGIN_M[1]
    whole = PixelWindow.at(*corner_m, width_px, height_px, gsd_m)
    factor = ceil(gsd_m / 1.25)
    for col, row, width, height in chunks(width_px, height_px, _CHUNK_PX // factor):
        part = whole.part(col, row, width, height)
        yield part, (slice(row, row + height), slice(col, col + width)), factor


def _averaged(picture: Float32, factor: int) -> Float32:
    """Return the picture with `factor` x `factor` pixels averaged into one."""
    rows, cols, channels = picture.shape
    blocks = picture.reshape(rows // factor, factor, cols // factor, factor, channels)
    return np.asarray(blocks.mean(axis=(1, 3)), np.float32)


def check_gsd(gsd_m: float) -> None:
    """Raise `AreaError` if a ground resolution cannot be rendered."""
    low, high = GSD_RANGE_M
    if not (low <= gsd_m <= high):
        raise AreaError(f"gsd_m must be between {low} and {high} m per pixel, got {gsd_m}")


def expose(rgb: NDArray[np.uint8], light: Float32, window: PixelWindow, epoch: Epoch) -> Float32:
    """Return the picture (H, W, 3) float before noise: colours (H, W, 3) under `light` (H, W)."""
    out = rgb.astype(np.float32)
    drift = noise_grid(key_of("drift", epoch.name), window.east_m, window.north_m, 2600.0)
    gain = np.float32(epoch.exposure) * (1.0 + 0.05 * drift)
    balance = np.array(epoch.white_balance, np.float32)
    grey = out.mean(axis=2) * np.float32(_FADE)
    out *= np.float32(1.0 - _FADE)
    for channel in range(3):
        plane = out[..., channel]
        plane += grey
        plane *= gain * (_SKY[channel] + (1.0 - _SKY[channel]) * light)
        plane *= np.float32((1.0 - epoch.haze) * epoch.contrast) * balance[channel]
        plane += np.float32(
            epoch.haze * _HAZE_RGB[channel] * epoch.contrast + _MIDDLE * (1.0 - epoch.contrast)
        )
    return np.asarray(cv2.GaussianBlur(out, (0, 0), 0.55), np.float32)


def develop(picture: Float32, window: PixelWindow, seed: int, epoch: Epoch) -> NDArray[np.uint8]:
    """Return the 8-bit picture (H, W, 3) with sensor noise, one number per pixel and channel."""
    out = picture.copy()
    shared = white_grid(key_of(seed, "noise", epoch.name), window.columns, window.rows)
    for channel in range(3):
        own = white_grid(key_of(seed, "noise", epoch.name, channel), window.columns, window.rows)
        out[..., channel] += np.float32(0.75 * epoch.noise) * shared
        out[..., channel] += np.float32(0.65 * epoch.noise) * own
    np.rint(out, out=out)
    return np.clip(out, 0.0, 255.0).astype(np.uint8)
