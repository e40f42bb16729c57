"""Sensor model: light, haze, contrast, blur and noise."""

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.landscape.epoch import Epoch
from lab.landscape.noise import Float32, key_of, noise_grid, white_grid
from lab.landscape.window import PixelWindow

_SKY = np.array([0.40, 0.43, 0.48], np.float32)  # share of diffuse light, which shadows receive too
_HAZE_RGB = np.array([196.0, 204.0, 214.0], np.float32)
_MIDDLE = 120.0
_FADE = 0.15  # colours are less saturated from the air


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
