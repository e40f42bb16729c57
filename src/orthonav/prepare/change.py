"""A picture of the ground as another year might show it."""

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_REPLACED = 0.75
"""Largest share of a view that is replaced."""
MAX_MIXED = 0.85
"""Largest share of a stranger's detail in what is left."""


def changed(
    rng: np.random.Generator,
    grey: NDArray[np.uint8],
    other: NDArray[np.uint8],
    *,
    most_replaced: float = MAX_REPLACED,
    most_mixed: float = MAX_MIXED,
) -> NDArray[np.uint8]:
    """`grey` (S, S) uint8 with what years change.

    `other` is a picture of ground that must not be found on the map itself. Parts are erased and
    replaced by it, and its detail is mixed into the rest; fields change their brightness and
    contrast, some turn it around; light, blur and noise are others. At most the share
    `most_replaced` is erased and `most_mixed` of the stranger's detail mixed into the rest.
    """
    size = grey.shape[0]
    stranger = np.asarray(cv2.resize(other, (size, size)), dtype=np.float32)
    own, own_broad = _detail(grey.astype(np.float32), size)
    strange, strange_broad = _detail(stranger, size)
    mask = _smooth(rng, size, int(rng.integers(3, 12)))
    replaced = mask < np.quantile(mask, rng.uniform(0, most_replaced))
    gain = 0.35 + 0.9 * _smooth(rng, size, 6)
    turned = _smooth(rng, size, 5) > rng.uniform(0.55, 1.1)
    mixed = rng.uniform(0, most_mixed)
    detail = (1 - mixed) * own * np.where(turned, -gain, gain)
    # The stranger's detail turned upside down is another one, so that both are not the same.
    detail = np.where(replaced, strange, detail + mixed * strange[::-1])
    light = np.where(replaced, strange_broad, own_broad) + 40 * (_smooth(rng, size, 4) - 0.5)
    tone = np.power(np.clip(light + detail, 0, 255) / 255, rng.uniform(0.6, 1.7))
    blurred = np.asarray(cv2.GaussianBlur(tone, (0, 0), float(rng.uniform(0.3, 1.4))))
    exposed = blurred * 255 * rng.uniform(0.6, 1.25)
    noisy = exposed + rng.normal(0, rng.uniform(1, 6), grey.shape)
    return np.asarray(np.clip(noisy, 0, 255), dtype=np.uint8)


def _detail(
    picture: NDArray[np.float32], size: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A picture (S, S) less its broad light, and that light."""
    broad = np.asarray(cv2.GaussianBlur(picture, (0, 0), size / 16), dtype=np.float32)
    return picture - broad, broad


def _smooth(rng: np.random.Generator, size: int, cells: int) -> NDArray[np.float32]:
    """A smooth random field (S, S) around 0.5, `cells` values across."""
    values = rng.random((cells, cells)).astype(np.float32)
    return np.asarray(cv2.resize(values, (size, size), interpolation=cv2.INTER_CUBIC), np.float32)
