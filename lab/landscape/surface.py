"""Colour of the ground surface: parcels with their texture, then water, roads and borders."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.landscape.crops import Appearance
from lab.landscape.epoch import Epoch, Season
from lab.landscape.lines import Line, ribbon
from lab.landscape.network import LineKind, Network
from lab.landscape.noise import Float32, fractal_grid, key_of
from lab.landscape.plan import CellPlan
from lab.landscape.window import PixelWindow, box_of

Mask = NDArray[np.uint8]
Labels = NDArray[np.int32]

_SURFACE_RGB = {
    LineKind.MAIN: (150.0, 149.0, 150.0),
    LineKind.MINOR: (164.0, 160.0, 154.0),
    LineKind.STREET: (156.0, 154.0, 153.0),
    LineKind.TRACK: (186.0, 172.0, 144.0),
}
_GRASS_RGB = {
    Season.SPRING: (100.0, 130.0, 70.0),
    Season.SUMMER: (142.0, 142.0, 92.0),
    Season.AUTUMN: (106.0, 120.0, 70.0),
}
_WATER_RGB = {
    Season.SPRING: (94.0, 104.0, 84.0),
    Season.SUMMER: (64.0, 84.0, 70.0),
    Season.AUTUMN: (62.0, 74.0, 72.0),
}
_SHORE_RGB = (150.0, 142.0, 112.0)


def label_parcels(plans: Sequence[CellPlan], window: PixelWindow) -> Labels:
    """Return the parcel number (H, W) of every pixel: 1.. in the order of `plans`, 0 for none."""
    labels = np.zeros(window.shape, np.int32)
    number = 1
    for plan in plans:
        for polygon, box in zip(plan.polygons_m, plan.boxes_m, strict=True):
            if window.touches(box):
                window.fill(labels, polygon, number, smooth=False)
            number += 1
    return labels


def paint_parcels(
    labels: Labels, appearance: Appearance, window: PixelWindow, seed: int, epoch: Epoch
) -> Float32:
    """Return the colour (H, W, 3) of the parcels with patches, grain, rows and lanes."""
    east, north = window.east_m, window.north_m
    soil = fractal_grid(key_of(seed, "soil"), east, north, (310.0, 140.0, 62.0, 28.0), 0.8)
    growth = fractal_grid(
        key_of(seed, "growth", epoch.year), east, north, (190.0, 85.0, 38.0, 17.0), 0.8
    )
    grain = fractal_grid(
        key_of(seed, "grain", epoch.name), east, north, (13.0, 6.1, 2.9, 1.4, 0.7, 0.4), 0.95
    )
    soil *= appearance.soil[labels]
    growth *= appearance.growth[labels]
    rows = _rows(labels, appearance, window, growth)
    grain *= appearance.grain[labels]
    tone = 1.0 + soil + growth + grain + rows
    rgb: Float32 = _soft_borders(appearance.rgb[labels], labels)
    rgb[..., 0] *= tone * (1.0 + 0.5 * growth + 0.3 * soil)
    rgb[..., 1] *= tone
    rgb[..., 2] *= tone * (1.0 + 0.3 * growth - 0.2 * soil)
    return rgb


def _soft_borders(rgb: Float32, labels: Labels) -> Float32:
    """Return colours (H, W, 3) with the steps of parcel borders smoothed."""
    border = np.zeros(labels.shape, np.bool_)
    across, down = labels[:, 1:] != labels[:, :-1], labels[1:] != labels[:-1]
    border[:, 1:] |= across
    border[:, :-1] |= across
    border[1:] |= down
    border[:-1] |= down
    rgb[border] = cv2.blur(rgb, (3, 3))[border]
    return rgb


def _rows(labels: Labels, appearance: Appearance, window: PixelWindow, wander: Float32) -> Float32:
    """Return the relative brightness (H, W) of rows and tractor lanes."""
    turn = appearance.row_turn[labels]
    across = turn[..., 0] * window.east_m[None, :] + turn[..., 1] * window.north_m[:, None]
    row_m, lane_m = appearance.row_m[labels], appearance.lane_m[labels]
    phase = across / row_m
    phase -= np.floor(phase)
    rows = np.cos(np.float32(2.0 * np.pi) * phase.astype(np.float32))
    visible = np.clip((row_m / window.gsd_m - 1.5) / 1.5, 0.0, 1.0)
    rows *= appearance.row[labels] * visible * (1.0 + 3.0 * wander)
    lanes = (across - lane_m * np.floor(across / lane_m) - 0.5 * lane_m).astype(np.float32)
    distance = np.abs(np.abs(lanes) - np.float32(0.95))
    half = max(0.45, 0.75 * window.gsd_m)
    rows += (
        appearance.lane[labels] * np.clip(1.0 - distance / half, 0.0, 1.0) * np.float32(0.45 / half)
    )
    return np.asarray(rows, np.float32)


class Lines(NamedTuple):
    """Cover (H, W), 0..255: ground without woods, roads, water."""

    open: Mask
    roads: Mask
    water: Mask


def paint_lines(
    rgb: Float32, plans: Sequence[CellPlan], network: Network, window: PixelWindow, epoch: Epoch
) -> Lines:
    """Draw borders, roads and water into `rgb` (H, W, 3); return what they cover."""
    seed = network.seed
    fine = fractal_grid(
        key_of(seed, "ways"), window.east_m, window.north_m, (21.0, 5.0, 2.3, 1.1, 0.5), 0.8
    )
    lines = [
        line
        for plan in plans
        for line in plan.lines
        if epoch.time_years < line.gone_year and window.touches(line.box_m)
    ]
    grass = (np.array(_GRASS_RGB[epoch.season], np.float32), 0.17 * fine)
    open_ground = np.zeros(window.shape, np.uint8)
    verge = np.zeros(window.shape, np.uint8)
    for line in lines:
        if line.kind is not LineKind.NONE:
            window.fill(verge, line.verge_m, 255 if line.kind is not LineKind.STRIP else 190)
    _blend(rgb, verge, *grass)
    _blend(rgb, _mask(window, lines, LineKind.NONE), grass[0] * 0.9, 0.17 * fine, 0.35)
    track = _mask(window, lines, LineKind.TRACK)
    _blend(rgb, track, np.array(_SURFACE_RGB[LineKind.TRACK], np.float32), 0.15 * fine, 0.85)
    street = _mask(window, lines, LineKind.STREET)
    _blend(rgb, street, np.array(_SURFACE_RGB[LineKind.STREET], np.float32), 0.08 * fine)
    np.maximum(open_ground, street, out=open_ground)
    roads = street.copy()
    shore, rivers = _rivers(network, window, epoch.water_level_m)
    _paint_water(rgb, shore, rivers, window, seed, epoch)
    np.maximum(open_ground, track, out=open_ground)
    np.maximum(open_ground, shore, out=open_ground)
    for kind in (LineKind.MINOR, LineKind.MAIN):
        road = _mask(window, lines, kind)
        _blend(rgb, road, np.array(_SURFACE_RGB[kind], np.float32), 0.08 * fine)
        np.maximum(roads, road, out=roads)
    np.maximum(open_ground, roads, out=open_ground)
    shore, water = _ponds(plans, window, epoch.water_level_m)
    _paint_water(rgb, shore, water, window, seed, epoch)
    water = np.maximum(water, np.minimum(rivers, 255 - roads))
    return Lines(np.maximum(open_ground, shore), roads, water)


def _blend(rgb: Float32, mask: Mask, colour: Float32, tone: Float32, strength: float = 1.0) -> None:
    """Lay a colour (3,), brightened by 1 + tone (H, W), over `rgb` where `mask` is set."""
    rows = np.flatnonzero(mask.any(axis=1))
    if len(rows) == 0:
        return
    where = np.nonzero(mask)
    alpha = (mask[where] * np.float32(strength / 255.0))[:, None]
    old = rgb[where]
    new = colour * (1.0 + tone[where])[:, None]
    rgb[where] = old + alpha * (new - old)


def _mask(window: PixelWindow, lines: Sequence[Line], kind: LineKind) -> Mask:
    """Return the cover (H, W), 0..255, of all surfaces of one kind."""
    mask = np.zeros(window.shape, np.uint8)
    for line in lines:
        if line.kind is kind:
            window.fill(mask, line.surface_m, 255)
    return mask


def _rivers(network: Network, window: PixelWindow, level_m: float) -> tuple[Mask, Mask]:
    """Return the cover of river banks and of river water."""
    shore, water = np.zeros(window.shape, np.uint8), np.zeros(window.shape, np.uint8)
    west, south, east, north = window.bounds_m
    for line, half_m in network.rivers_in((west - 60.0, south - 60.0, east + 60.0, north + 60.0)):
        near = window.inside(line, 120.0)
        # whole stretches of 300 m, so that the drawing is independent of the window
        drawn = np.flatnonzero(np.convolve(near, np.ones(31), mode="same") > 0.0)
        if len(drawn) < 3:
            continue
        part = slice(int(drawn[0]), int(drawn[-1]) + 1)
        window.fill(shore, ribbon(line[part], half_m[part] + 3.0), 255)
        window.fill(water, ribbon(line[part], half_m[part] + level_m), 255)
    return shore, water


def _ponds(plans: Sequence[CellPlan], window: PixelWindow, level_m: float) -> tuple[Mask, Mask]:
    """Return the cover of pond shores and of pond water."""
    shore, water = np.zeros(window.shape, np.uint8), np.zeros(window.shape, np.uint8)
    for plan in plans:
        for pond in plan.ponds:
            if window.touches(box_of(pond.shore_m, 8.0)):
                offset = pond.shore_m - pond.centre_m
                outward = offset / np.hypot(offset[:, 0], offset[:, 1])[:, None]
                window.fill(shore, pond.shore_m + 2.5 * outward, 255)
                window.fill(water, pond.shore_m + (level_m - 1.0) * outward, 255)
    return shore, water


def _paint_water(
    rgb: Float32, shore: Mask, water: Mask, window: PixelWindow, seed: int, epoch: Epoch
) -> None:
    if not shore.any():
        return
    ripple = fractal_grid(
        key_of(seed, "ripple", epoch.name),
        window.east_m,
        window.north_m,
        (120.0, 45.0, 6.0, 2.5),
        0.6,
    )
    _blend(rgb, shore, np.array(_SHORE_RGB, np.float32), 0.14 * ripple, 0.9)
    _blend(rgb, water, np.array(_WATER_RGB[epoch.season], np.float32), 0.05 * ripple)
