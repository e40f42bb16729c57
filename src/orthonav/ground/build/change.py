"""Simulated ageing of an image of the ground."""

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_REPLACED = 0.75
"""Largest replaced share of a view."""
MAX_MIXED = 0.85
"""Largest share of detail mixed in from the other image."""


def changed(
    rng: np.random.Generator,
    grey: NDArray[np.uint8],
    other: NDArray[np.uint8],
    *,
    most_replaced: float = MAX_REPLACED,
    most_mixed: float = MAX_MIXED,
) -> NDArray[np.uint8]:
    """`grey` (S, S) uint8 with the changes of years.

    `other` is an image that must not occur on the map. Parts are replaced by it, and its detail is
    mixed into the rest; brightness and contrast of fields change, some invert their contrast;
    light, blur and noise differ. `most_replaced`: largest replaced share (0..1). `most_mixed`:
    largest weight of the detail of `other` in the rest (0..1).
    """
    size = grey.shape[0]
    resized = np.asarray(cv2.resize(other, (size, size)), dtype=np.float32)
    own, own_broad = _detail(grey.astype(np.float32), size)
    foreign, foreign_broad = _detail(resized, size)
    mask = _smooth(rng, size, int(rng.integers(3, 12)))
    replaced = mask < np.quantile(mask, rng.uniform(0, most_replaced))
    gain = 0.35 + 0.9 * _smooth(rng, size, 6)
    turned = _smooth(rng, size, 5) > rng.uniform(0.55, 1.1)
    mixed = rng.uniform(0, most_mixed)
    detail = (1 - mixed) * own * np.where(turned, -gain, gain)
    # Flipped, so that replaced and mixed parts show different detail.
    detail = np.where(replaced, foreign, detail + mixed * foreign[::-1])
    light = np.where(replaced, foreign_broad, own_broad) + 40 * (_smooth(rng, size, 4) - 0.5)
    tone = np.power(np.clip(light + detail, 0, 255) / 255, rng.uniform(0.6, 1.7))
    blurred = np.asarray(cv2.GaussianBlur(tone, (0, 0), float(rng.uniform(0.3, 1.4))))
    exposed = blurred * 255 * rng.uniform(0.6, 1.25)
    noisy = exposed + rng.normal(0, rng.uniform(1, 6), grey.shape)
    return np.asarray(np.clip(noisy, 0, 255), dtype=np.uint8)


def _detail(
    picture: NDArray[np.float32], size: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """High-pass and low-pass part of an image (S, S)."""
    broad = np.asarray(cv2.GaussianBlur(picture, (0, 0), size / 16), dtype=np.float32)
    return picture - broad, broad


def _smooth(rng: np.random.Generator, size: int, cells: int) -> NDArray[np.float32]:
    """A smooth random field (S, S) around 0.5, `cells` values across."""
    values = rng.random((cells, cells)).astype(np.float32)
    return np.asarray(cv2.resize(values, (size, size), interpolation=cv2.INTER_CUBIC), np.float32)
