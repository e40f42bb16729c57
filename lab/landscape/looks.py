"""The landscape in other light: snow, flood, bare trees, near infrared, night and thermal.

Reflectances and temperatures are rough means of what such pictures show; what matters is which
edges stay, turn over and vanish."""

from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.landscape.noise import Float32, fractal_grid, key_of, noise_grid
from lab.landscape.window import PixelWindow

Mask = NDArray[np.uint8]
_TALL_M = 2.0  # objects above are trees, where they are no roofs
_SNOW = 232.0
_FLOOD_RGB = (116.0, 106.0, 86.0)
_BARE_RGB = (104.0, 96.0, 86.0)
_LAMPS_M, _GLOW_M = 32.0, 7.0  # between lamps, and their light on the ground
_COVERS = "soil", "green", "trees", "roads", "roofs", "water"
_NOON = dict(zip(_COVERS, (158.0, 104.0, 84.0, 184.0, 165.0, 52.0), strict=True))
_DAWN = dict(zip(_COVERS, (92.0, 78.0, 128.0, 150.0, 66.0, 188.0), strict=True))
"""Grey levels of a thermal camera at noon and before sunrise."""


class Look(Enum):
    """What a picture shows: colour in daylight, or the same ground otherwise.

    SNOW: roads are cleared. FLOOD: hollows are under water, roads and houses above it. BARE: trees
    without leaves. NIGHT: lamps along roads. THERMAL and DAWN: long-wave infrared at noon, and
    before sunrise, when water and roads are warmer than fields and roofs."""

    COLOUR = "colour"
    SNOW = "snow"
    FLOOD = "flood"
    BARE = "bare trees"
    NEAR_INFRARED = "near infrared"
    NIGHT = "night"
    THERMAL = "thermal"
    DAWN = "thermal before sunrise"


@dataclass(frozen=True, eq=False)
class Cover:
    """What stands where (H, W): shares 0..1 of roads, water and roofs; `height_m` of objects."""

    roads: Float32
    water: Float32
    roofs: Float32
    height_m: Float32

    @classmethod
    def of(cls, roads: Mask, water: Mask, roofs: Mask, height_m: Float32) -> "Cover":
        """From masks of 0..255."""
        shares = [np.asarray(each / np.float32(255), np.float32) for each in (roads, water, roofs)]
        return cls(shares[0], shares[1], shares[2], height_m)

    @property
    def trees(self) -> NDArray[np.bool_]:
        return np.asarray((self.height_m > _TALL_M) & (self.roofs < 0.5))


def seen(
    look: Look, rgb: Float32, light: Float32, cover: Cover, window: PixelWindow, seed: int
) -> tuple[Float32, Float32]:
    """The picture (H, W, 3) of painted colours `rgb` (H, W, 3), and direct light (H, W)."""
    if look is Look.SNOW:
        return _snow(rgb, cover, window, seed), light
    if look is Look.FLOOD:
        return _flood(rgb, cover, window, seed), light
    if look is Look.BARE:
        return np.where(cover.trees[..., None], _dimmed(rgb, _BARE_RGB), rgb), light
    if look is Look.NEAR_INFRARED:
        return _single(_near_infrared(rgb, cover)), light
    if look is Look.NIGHT:
        return _single(_night(rgb, cover, window, seed)), np.ones_like(light)
    if look is Look.THERMAL:
        heated = 0.85 + 0.15 * light
        return _single(_thermal(rgb, cover, window, seed, _NOON)), np.asarray(heated, np.float32)
    if look is Look.DAWN:
        return _single(_thermal(rgb, cover, window, seed, _DAWN)), np.ones_like(light)
    return rgb, light


def _single(plane: Float32) -> Float32:
    return np.repeat(plane[..., None].astype(np.float32), 3, axis=-1)


def _dimmed(rgb: Float32, colour: tuple[float, float, float]) -> Float32:
    """A colour with the texture of the picture."""
    tone = rgb.mean(axis=-1, keepdims=True) / 90.0
    return np.asarray(np.array(colour, np.float32) * (0.6 + 0.4 * tone), np.float32)


def _snow(rgb: Float32, cover: Cover, window: PixelWindow, seed: int) -> Float32:
    drift = fractal_grid(
        key_of(seed, "drift"), window.east_m, window.north_m, (60.0, 22.0, 7.0), 0.8
    )
    lying = 0.94 * (1.0 - np.maximum(0.9 * cover.roads, cover.water))
    lying = np.where(cover.trees, 0.35 * lying, lying)[..., None]
    bare = np.where(cover.trees[..., None], _dimmed(rgb, _BARE_RGB), rgb)
    white = (_SNOW * (1.0 + 0.03 * drift))[..., None]
    return np.asarray(bare + lying * (white - bare), np.float32)


def _flood(rgb: Float32, cover: Cover, window: PixelWindow, seed: int) -> Float32:
    lie = noise_grid(key_of(seed, "lie"), window.east_m, window.north_m, 420.0)
    deep = np.clip((-lie - 0.05) / 0.03, 0.0, 1.0) * (1.0 - cover.roads) * (1.0 - cover.roofs)
    deep = np.maximum(np.where(cover.trees, 0.0, deep), cover.water)[..., None]
    return np.asarray(rgb + deep * (np.array(_FLOOD_RGB, np.float32) - rgb), np.float32)


def _green(rgb: Float32) -> Float32:
    """How much living vegetation a colour shows, 0..1."""
    red, green, blue = np.moveaxis(rgb, -1, 0)
    share = (2.0 * green - red - blue) / np.maximum(red + green + blue, 1.0)
    return np.asarray(np.clip(5.0 * share, 0.0, 1.0), np.float32)


def _near_infrared(rgb: Float32, cover: Cover) -> Float32:
    built = np.maximum(cover.roads, cover.roofs)
    bright = 40.0 + 0.45 * rgb[..., 0] + 130.0 * _green(rgb) * (1.0 - built)
    return np.asarray(bright + cover.water * (16.0 - bright), np.float32)


def _night(rgb: Float32, cover: Cover, window: PixelWindow, seed: int) -> Float32:
    """Lamps along roads, at a distance that varies."""
    east, north = window.east_m, window.north_m
    lamps = noise_grid(key_of(seed, "lamps"), east, north, _LAMPS_M)
    lit = cover.roads * np.clip(0.35 + 0.65 * lamps, 0.05, 1.0)
    glow = cv2.GaussianBlur(lit.astype(np.float32), (0, 0), _GLOW_M / window.gsd_m)
    ground = rgb.mean(axis=-1)
    return np.asarray(5.0 + 190.0 * lit + ground * (0.02 + 0.9 * glow), np.float32)


def _thermal(
    rgb: Float32, cover: Cover, window: PixelWindow, seed: int, warmth: dict[str, float]
) -> Float32:
    """Fields by how green they are, roofs each by its own insulation."""
    east, north = window.east_m, window.north_m
    moist = fractal_grid(key_of(seed, "moisture"), east, north, (160.0, 60.0, 20.0), 0.8)
    own = noise_grid(key_of(seed, "insulation"), east, north, 22.0)
    green = _green(rgb)
    ground = warmth["soil"] + green * (warmth["green"] - warmth["soil"])
    ground = ground * (1.0 + 0.05 * moist) + 0.06 * (rgb.mean(axis=-1) - 120.0)
    ground = np.where(cover.trees, warmth["trees"], ground)
    for share, warm in (
        (cover.water, warmth["water"]),
        (cover.roads, warmth["roads"]),
        (cover.roofs, warmth["roofs"] * (1.0 + 0.15 * own)),
    ):
        ground = ground + share * (warm - ground)
    return np.asarray(ground, np.float32)
