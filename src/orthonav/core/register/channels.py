"""Two kinds of channels, made of grey levels, whose errors lie in different places.

*Oriented gradients*: the edge direction doubled, so that contrast may flip between seasons,
weighted by a magnitude that saturates against its surroundings (as CFOG, Ye et al., IEEE TGRS 2019,
but two numbers per pixel instead of a histogram). *Grey*: without local mean and local contrast."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.kernel import KERNEL

Array = NDArray[np.float32]
CHANNELS = 4  # cosine and sine of the doubled edge direction, grey, valid
GROUPS = (slice(0, 2), slice(2, 3))
GREY_SHARE, SOUGHT_SHARE = 0.6, 0.3
"""Weight of grey beside gradients where places are compared, and where candidates are sought: less,
for in other light (infrared, night, snow) grey levels mislead (docs/decisions/evidence.md)."""


@dataclass(frozen=True)
class ChannelRecipe:
    """Windows in pixels of the level: `contrast_px` of gradients' surroundings, `mean_px`,
    `deviation_px` of grey."""

    gradient_sigma_px: float = 1.0
    contrast_px: int = 27
    mean_px: int = 11
    deviation_px: int = 21

    @property
    def margin_px(self) -> int:
        return max(self.contrast_px // 2 + 4, self.mean_px // 2 + self.deviation_px // 2 + 1)


FINE = ChannelRecipe()
COARSE = ChannelRecipe(gradient_sigma_px=0.7, contrast_px=17, mean_px=7, deviation_px=17)
"""For views of some 30 pixels across: the same channels from smaller windows."""


def channels_of(
    grey: NDArray[np.uint8], valid: NDArray[np.bool_], recipe: ChannelRecipe = FINE
) -> Array:
    """(H, W, 4), zero where not valid; the last is 1 where valid and not on its border."""
    return np.asarray(cv2.merge(list(channel_planes(grey, valid, recipe))), np.float32)


def channel_planes(
    grey: NDArray[np.uint8], valid: NDArray[np.bool_], recipe: ChannelRecipe
) -> Array:
    """The same as planes (4, H, W)."""
    whole = bool(valid.all())
    if KERNEL is None or grey.size == 0:
        return np.stack(_planes(grey, valid, recipe, whole))
    planes = np.empty((CHANNELS, *grey.shape), np.float32)
    sides = recipe.contrast_px, recipe.mean_px, recipe.deviation_px
    counted = None if whole else np.ascontiguousarray(valid)
    KERNEL.channels(np.ascontiguousarray(grey), counted, (recipe.gradient_sigma_px, *sides), planes)
    return planes


def _planes(
    grey: NDArray[np.uint8], valid: NDArray[np.bool_], recipe: ChannelRecipe, whole: bool
) -> list[Array]:
    picture = np.asarray(grey, dtype=np.float32)
    share = np.ones(grey.shape, np.float32) if whole else valid.astype(np.float32)
    local = _LocalMean(share, whole)
    if not whole:
        picture = np.where(valid, picture, local(picture * share, recipe.deviation_px))
    counts = share
    if not whole:
        reach = 2 * int(np.ceil(2 * recipe.gradient_sigma_px)) + 1
        counts = np.asarray(
            cv2.erode(share, np.ones((reach, reach), np.uint8), borderValue=1.0), np.float32
        )
    east, north = _gradients(picture, counts, local, recipe)
    return [east, north, _grey(picture, share, local, recipe) * counts, counts]


class _LocalMean:
    """Mean over the valid pixels of a square around each pixel."""

    def __init__(self, share: Array, whole: bool) -> None:
        self._share, self._whole = share, whole
        self._counts: dict[int, Array] = {}

    def __call__(self, values: Array, side_px: int) -> Array:
        mean = _box(values, side_px)
        if self._whole:
            return mean
        if side_px not in self._counts:
            self._counts[side_px] = np.maximum(_box(self._share, side_px), np.float32(1e-3))
        return np.asarray(mean / self._counts[side_px])


def _box(values: Array, side_px: int) -> Array:
    side_px = min(side_px, 2 * min(values.shape) - 1)  # reflection reaches no farther
    return np.asarray(cv2.blur(values, (side_px, side_px)), dtype=np.float32)


def _gradients(
    picture: Array, counts: Array, local: _LocalMean, recipe: ChannelRecipe
) -> tuple[Array, Array]:
    """Doubled direction times saturated magnitude: cosine and sine (H, W)."""
    smooth = cv2.GaussianBlur(picture, (0, 0), recipe.gradient_sigma_px)
    east: Array = np.asarray(cv2.Scharr(smooth, cv2.CV_32F, 1, 0, scale=1 / 32), np.float32)
    south: Array = np.asarray(cv2.Scharr(smooth, cv2.CV_32F, 0, 1, scale=1 / 32), np.float32)
    square, product = east * east, east * south
    south *= south
    power = square + south
    square -= south
    magnitude = np.sqrt(power) * counts
    # |g|^2 / (|g| + surroundings) / |g|^2: direction times |g| / (|g| + surroundings). Gradients
    # below 0.5 are noise of an 8-bit picture.
    weight = magnitude / (
        (magnitude + local(magnitude, recipe.contrast_px) + np.float32(0.5))
        * (power + np.float32(1e-6))
    )
    product *= 2
    return np.asarray(square * weight), np.asarray(product * weight)


def _grey(picture: Array, share: Array, local: _LocalMean, recipe: ChannelRecipe) -> Array:
    """Without local mean, divided by the local deviation."""
    rest = (picture - local(picture * share, recipe.mean_px)) * share
    # Running sums of a box filter may fall a little below zero.
    power = np.maximum(local(rest * rest, recipe.deviation_px), 0)
    deviation = np.sqrt(power) + np.float32(2.0)  # less is noise of an 8-bit picture
    return np.asarray(np.clip(rest / deviation, -3.0, 3.0), dtype=np.float32)
