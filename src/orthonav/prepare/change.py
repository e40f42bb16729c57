"""A picture of the ground as another year might show it."""

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_REPLACED = 0.92
ELSEWHERE_SHARE = 0.25
"""Share of changes that paste in another place as it is rather than mirrored."""


def changed(
    rng: np.random.Generator, grey: NDArray[np.uint8], other: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """`grey` (S, S) uint8 with what years change.

    Parts are erased and replaced by another place, `other`; fields change their brightness and
    contrast, some turn it around; light, blur and noise are others.
    """
    size = grey.shape[0]
    if rng.random() > ELSEWHERE_SHARE:
        other = other[:, ::-1]
    other = np.asarray(cv2.resize(other, (size, size)), dtype=np.uint8)
    cells = int(rng.integers(3, 12))
    mask = _smooth(rng, size, cells)
    replaced = mask < np.quantile(mask, rng.uniform(0, MAX_REPLACED))
    picture = np.where(replaced, other, grey).astype(np.float32)
    broad = np.asarray(cv2.GaussianBlur(picture, (0, 0), size / 16), dtype=np.float32)
    gain = 0.35 + 0.9 * _smooth(rng, size, 6)
    turned = _smooth(rng, size, 5) > rng.uniform(0.55, 1.1)
    detail = (picture - broad) * np.where(turned, -gain, gain)
    light = broad + 40 * (_smooth(rng, size, 4) - 0.5)
    tone = np.power(np.clip(light + detail, 0, 255) / 255, rng.uniform(0.6, 1.7))
    blurred = np.asarray(cv2.GaussianBlur(tone, (0, 0), float(rng.uniform(0.3, 1.4))))
    exposed = blurred * 255 * rng.uniform(0.6, 1.25)
    noisy = exposed + rng.normal(0, rng.uniform(1, 6), picture.shape)
    return np.asarray(np.clip(noisy, 0, 255), dtype=np.uint8)


def _smooth(rng: np.random.Generator, size: int, cells: int) -> NDArray[np.float32]:
    """A smooth random field (S, S) around 0.5, `cells` values across."""
    values = rng.random((cells, cells)).astype(np.float32)
    return np.asarray(cv2.resize(values, (size, size), interpolation=cv2.INTER_CUBIC), np.float32)
