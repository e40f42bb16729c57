"""Objects with height (woods, trees, buildings), and the shadows they cast."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.landscape.crops import Appearance
from lab.landscape.epoch import Epoch, Season
from lab.landscape.noise import (
    Float32,
    Float64,
    fractal_grid,
    hash_u32,
    key_of,
    noise_grid,
    uniform,
)
from lab.landscape.parcels import LandCover
from lab.landscape.plan import CellPlan
from lab.landscape.plants import Trees, join
from lab.landscape.roofs import FLAT, Buildings
from lab.landscape.surface import Labels, Mask
from lab.landscape.window import PixelWindow

_LEVELS_PER_M = 8.0  # heights are drawn into bytes
TALLEST_M = 26.0
"""Upper limit of all heights; sets the reach of shadows."""

_CROWN_M = 6.5
_FRUIT_M = (6.5, 5.0)  # between rows of fruit trees, and within a row
_LEAF_RGB: dict[Season, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    Season.SPRING: ((84.0, 112.0, 58.0), (112.0, 134.0, 70.0)),
    Season.SUMMER: ((64.0, 88.0, 48.0), (88.0, 108.0, 60.0)),
    Season.AUTUMN: ((86.0, 96.0, 54.0), (140.0, 114.0, 64.0)),
}
_NEEDLE_RGB = (58.0, 78.0, 52.0)


def paint_wood(
    rgb: Float32,
    labels: Labels,
    appearance: Appearance,
    closed: Mask,
    window: PixelWindow,
    seed: int,
    epoch: Epoch,
) -> Float32:
    """Draw the canopy of woods into `rgb` (H, W, 3); return its height (H, W) in metres.

    Crowns stand on a jittered lattice, so a wood has the same trees at all dates.
    """
    height = np.zeros(window.shape, np.float32)
    wood = ((appearance.cover == LandCover.FOREST)[labels]) & (closed < 100)
    rows, cols = np.nonzero(wood)
    if len(rows) == 0:
        return height
    x, y = window.east_m[cols], window.north_m[rows]
    best, tone = _crowns(key_of(seed, "crown"), x, y)
    stand = noise_grid(key_of(seed, "stand"), window.east_m, window.north_m, 170.0)[rows, cols]
    top = (15.0 + 4.0 * stand) * best
    height[rows, cols] = top
    needles = noise_grid(key_of(seed, "needles"), window.east_m, window.north_m, 420.0)[rows, cols]
    low, high = (np.array(colour, np.float32) for colour in _LEAF_RGB[epoch.season])
    year_tone = (tone * 97.0 + key_of(epoch.name) % 89 / 89.0) % 1.0
    mix = (0.6 * tone + 0.4 * year_tone)[:, None] ** 1.5
    leaves = low + mix * (high - low)
    colour = np.where((needles > 0.35)[:, None], np.array(_NEEDLE_RGB, np.float32), leaves)
    colour *= (0.62 + 0.42 * best)[:, None]
    rgb[rows, cols] = colour
    return height


def paint_orchards(
    rgb: Float32,
    height: Float32,
    labels: Labels,
    appearance: Appearance,
    closed: Mask,
    window: PixelWindow,
    epoch: Epoch,
) -> None:
    """Draw fruit trees in straight rows into colour (H, W, 3) and height (H, W)."""
    rows, cols = np.nonzero((appearance.cover == LandCover.ORCHARD)[labels] & (closed < 100))
    if len(rows) == 0:
        return
    parcel = labels[rows, cols]
    turn = appearance.row_turn[parcel]
    x, y = window.east_m[cols], window.north_m[rows]
    across = (turn[:, 0] * x + turn[:, 1] * y) / _FRUIT_M[0]
    along = (turn[:, 0] * y - turn[:, 1] * x) / _FRUIT_M[1]
    i, j = np.floor(across), np.floor(along)
    size = 0.7 + 0.3 * uniform(key_of("fruit"), i.astype(np.int64), j.astype(np.int64))
    dx, dy = (across - i - 0.5) * _FRUIT_M[0], (along - j - 0.5) * _FRUIT_M[1]
    dome = 1.0 - (dx * dx + dy * dy) / (2.3 * size) ** 2
    tree = dome > 0.0
    rows, cols, dome = rows[tree], cols[tree], np.sqrt(dome[tree]).astype(np.float32)
    low, high = (np.array(colour, np.float32) for colour in _LEAF_RGB[epoch.season])
    alpha = np.minimum(2.0 * dome, 1.0)[:, None]
    old = rgb[rows, cols]
    rgb[rows, cols] = old + alpha * (0.6 * low + 0.4 * high - old)
    height[rows, cols] = 3.6 * dome


def _crowns(key: int, x: Float64, y: Float64) -> tuple[Float32, Float32]:
    """Return height (N,) of the highest crown over points, 0..1, and that tree's own number."""
    i, j = np.floor(x / _CROWN_M).astype(np.int64), np.floor(y / _CROWN_M).astype(np.int64)
    fx, fy = (x / _CROWN_M - i).astype(np.float32), (y / _CROWN_M - j).astype(np.float32)
    best, tone = np.zeros(len(x), np.float32), np.zeros(len(x), np.float32)
    byte = np.float32(1.0 / 255.0)
    for b in (-1, 0, 1):
        for a in (-1, 0, 1):
            h = hash_u32(key, i + a, j + b)
            dx = (h & np.uint32(255)).astype(np.float32) * byte + np.float32(a) - fx
            dy = ((h >> np.uint32(8)) & np.uint32(255)).astype(np.float32) * byte + b - fy
            size = ((h >> np.uint32(16)) & np.uint32(255)).astype(np.float32) * byte
            reach = np.float32(0.45) + np.float32(0.6) * size
            crown = (0.6 + 0.4 * size) * (1.0 - (dx * dx + dy * dy) / (reach * reach))
            higher = crown > best
            best[higher] = crown[higher]
            tone[higher] = (h[higher] >> np.uint32(24)).astype(np.float32) * byte
    return np.sqrt(np.maximum(best, 0.0)), tone


def paint_trees(
    rgb: Float32, height: Float32, plans: Sequence[CellPlan], window: PixelWindow, epoch: Epoch
) -> None:
    """Draw single trees and hedges into colour (H, W, 3) and height (H, W)."""
    near = [plan.trees.at(epoch.time_years) for plan in plans]
    trees = join([group.where(window.inside(group.centre_m, 8.0)) for group in near])
    if len(trees.radius_m) == 0:
        return
    crown, leaf = _draw_crowns(trees, window, epoch)
    dome = crown.astype(np.float32) * np.float32(1.0 / _LEVELS_PER_M)
    if window.gsd_m < 0.7:  # the steps of the discs would show
        dome = np.asarray(cv2.GaussianBlur(dome, (0, 0), 0.45 / window.gsd_m), np.float32)
    cover = np.clip(dome * np.float32(1.0 / 1.6), 0.0, 1.0)
    rows, cols = np.nonzero(crown)
    low, high = (np.array(colour, np.float32) for colour in _LEAF_RGB[epoch.season])
    texture = fractal_grid(
        key_of("leaves", epoch.name), window.east_m, window.north_m, (2.7, 1.3, 0.6), 0.9
    )
    mix = leaf[rows, cols].astype(np.float32)[:, None] * np.float32(1.0 / 255.0)
    colour = (low + mix * (high - low)) * (0.95 + 0.15 * texture[rows, cols])[:, None]
    alpha = cover[rows, cols][:, None]
    old = rgb[rows, cols]
    rgb[rows, cols] = old + alpha * (colour - old)
    dome *= 0.95 + 0.12 * texture
    np.maximum(height, dome, out=height)


def _draw_crowns(trees: Trees, window: PixelWindow, epoch: Epoch) -> tuple[Mask, Mask]:
    """Return heights (1/8 m) and leaf colour numbers (H, W) of crowns drawn as domes."""
    crown, leaf = np.zeros(window.shape, np.uint8), np.zeros(window.shape, np.uint8)
    level = np.clip(trees.height_m * _LEVELS_PER_M, 0, 255)
    place = np.rint(trees.centre_m * 100.0).astype(np.int64)
    own = hash_u32(key_of("leaf"), place[:, 0], place[:, 1]) & np.uint32(0xFF)
    now = hash_u32(key_of("leaf", epoch.year), place[:, 0], place[:, 1]) & np.uint32(0xFF)
    number = ((own.astype(np.int64) + now) // 2).astype(np.uint8)
    for share, drop in ((1.0, 0.55), (0.78, 0.8), (0.45, 1.0)):
        values = (level * drop).astype(np.uint8)
        window.discs(crown, trees.centre_m, trees.radius_m * share, values)
    window.discs(leaf, trees.centre_m, trees.radius_m * 1.1, number)
    return crown, leaf


def paint_buildings(
    image: NDArray[np.uint8],
    height: Float32,
    plans: Sequence[CellPlan],
    window: PixelWindow,
    epoch: Epoch,
) -> Mask:
    """Draw roofs into 8-bit colour (H, W, 3) and height (H, W); return their cover (H, W)."""
    cover = np.zeros(window.shape, np.uint8)
    tall = np.zeros(window.shape, np.uint8)
    sun = sun_vector(epoch)
    for plan in plans:
        standing = plan.buildings.at(epoch.time_years)
        standing = standing.where(window.inside(standing.centre_m, 50.0))
        if len(standing.length_m):
            _draw_buildings(standing, image, cover, tall, window, sun)
    np.maximum(height, tall * np.float32(1.0 / _LEVELS_PER_M), out=height)
    return cover


def _draw_buildings(
    buildings: Buildings,
    image: NDArray[np.uint8],
    cover: Mask,
    tall: Mask,
    window: PixelWindow,
    sun: Float64,
) -> None:
    corners, ridges = window.fixed(buildings.corners()), window.fixed(buildings.ridges())
    shade = np.maximum(buildings.face_normals() @ sun, 0.0) / sun[2]
    shade = 0.5 + 0.5 * np.clip(shade, 0.0, 1.5)
    colours = np.clip(buildings.rgb[:, None, :] * shade[:, :, None], 0, 255)
    rise = np.where(buildings.shape == FLAT, 0.0, buildings.pitch * buildings.width_m / 4.0)
    levels = np.clip((buildings.height_m + rise) * _LEVELS_PER_M, 1, 255).astype(int)
    for k in range(len(levels)):
        c, r = corners[k], ridges[k]
        window.fill_face(cover, c, 255)
        window.fill_face(tall, c, int(levels[k]))
        if buildings.shape[k] == FLAT:
            window.fill_face(image, c, tuple(colours[k, 0].tolist()))
            continue
        faces = (
            (0, (c[0], c[1], r[1], r[0])),
            (2, (c[2], c[3], r[0], r[1])),
            (1, (c[1], c[2], r[1])),
            (3, (c[3], c[0], r[0])),
        )
        for side, face in faces:
            window.fill_face(image, np.stack(face), tuple(colours[k, side].tolist()))


def sun_vector(epoch: Epoch) -> Float64:
    """Return the unit vector (3,) towards the sun: east, north, up."""
    azimuth, elevation = np.deg2rad([epoch.sun_azimuth_deg, epoch.sun_elevation_deg])
    flat = np.cos(elevation)
    return np.array([np.sin(azimuth) * flat, np.cos(azimuth) * flat, np.sin(elevation)])


def shadow_reach_m(epoch: Epoch) -> float:
    """Return the largest length of a shadow."""
    return float(TALLEST_M / np.tan(np.deg2rad(epoch.sun_elevation_deg)))


def lighting(height: Float32, roofs: Mask, window: PixelWindow, epoch: Epoch) -> Float32:
    """Return direct light (H, W) relative to open level ground: 0 in shadow, above 1 facing it."""
    sun = sun_vector(epoch)
    slope = float(sun[2] / max(np.hypot(sun[0], sun[1]), 1e-3))
    step_m = max(window.gsd_m, 0.6)
    occluder = np.zeros_like(height)
    for k in range(1, int(np.ceil(shadow_reach_m(epoch) / step_m)) + 1):
        reach_px = k * step_m / window.gsd_m
        azimuth = np.deg2rad(epoch.sun_azimuth_deg)
        shift = round(-reach_px * np.cos(azimuth)), round(reach_px * np.sin(azimuth))
        _raise(occluder, height, shift, np.float32(k * step_m * slope))
    lit = np.clip(1.0 - (occluder - height - 0.25) * np.float32(0.8), 0.0, 1.0)
    facing = np.zeros_like(height)
    gain = np.float32(0.5 / (2.0 * window.gsd_m) / slope)
    facing[:, 1:-1] -= (height[:, 2:] - height[:, :-2]) * (gain * np.float32(sun[0]))
    facing[1:-1] += (height[2:] - height[:-2]) * (gain * np.float32(sun[1]))
    facing *= (height > 0.3) & (roofs < 128)
    return np.asarray(lit * (1.0 + np.clip(facing, -0.55, 0.55)), np.float32)


def _raise(occluder: Float32, height: Float32, shift: tuple[int, int], drop: np.float32) -> None:
    """Raise `occluder` to the height found at (row, col) + shift, less `drop`."""
    rows, cols = height.shape
    down, right = shift
    if abs(down) >= rows or abs(right) >= cols:
        return
    to = occluder[max(0, -down) : rows - max(0, down), max(0, -right) : cols - max(0, right)]
    source = height[max(0, down) : rows + min(0, down), max(0, right) : cols + min(0, right)]
    np.maximum(to, source - drop, out=to)
