"""A picture of the ground as another year might show it, changed most where least will last.

Unlike `orthonav.prepare.change`, which changes all ground alike and hard, to learn confidence from,
this one is as mild and as harsh as years are on generated landscapes: see
`orthonav.check.persistence`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
_SIDES_PX = (3, 7, 15, 55)
_WINDOWS_PX = (9, 13, 19, 33)
_LEVEL_OF_BAND = (0, 0, 1, 2)
"""Boxes (as wide as Gaussians of 1, 2, 4 and 16 pixels) between which bands of detail lie, windows
in which their strength is told, levels whose persistence they have."""
_STRENGTHS = (0.2, 5.0)
"""The stranger's detail is brought to the strength of the ground's own, by no more than this."""
MOST_KEPT = 0.95


@dataclass(frozen=True)
class Severity:
    """How places and views differ from what is expected of them, standard deviations of logarithms:
    `field` from field to field, `view` from view to view; `shift` for all."""

    field: float = 0.2
    view: float = 0.08
    shift: float = 0.0


USUAL = Severity()
"""The spreads were chosen on generated landscapes (seeds 11 to 13, views 100, 160 and 240 pixels
across). Without a shift predictions are 0.06 below what is measured there; a shift of 0.1 would
halve that, and make those of real imagery too high."""


def another_year(
    rng: np.random.Generator,
    grey: NDArray[np.uint8],
    stranger: NDArray[np.uint8],
    persistence: Sequence[Array],
    severity: Severity = USUAL,
) -> NDArray[np.uint8]:
    """`grey` (S, S) with what years change; `stranger` (S, S) is mirrored ground from elsewhere.

    `persistence` holds the correlation of gradients (S, S) that is expected at this resolution, at
    half of it, and so on. Detail of each scale is mixed with the stranger's so that this is what is
    left; fields change their contrast and some turn it around; light, blur and noise are others.
    """
    size = grey.shape[0]
    own, light = _bands(grey)
    # Turned by half, for it fills the holes of `grey` too; flipped once more it would be ground.
    strange, _ = _bands(np.ascontiguousarray(stranger[::-1, ::-1]))
    off = severity.field * _normal(rng, size, int(rng.integers(4, 10)))
    off += severity.view * rng.standard_normal() + severity.shift
    factor = np.exp(off)
    gain = 0.6 + 0.8 * _uniform(rng, size, 6)
    # About a fifth turns its contrast around, as it does on generated and on real ground.
    gain = np.where(_uniform(rng, size, 5) > rng.uniform(0.6, 0.85), -gain, gain)
    detail = np.zeros_like(light)
    bands = zip(own, strange, _WINDOWS_PX, _LEVEL_OF_BAND, strict=True)
    for mine, other, window_px, level in bands:
        expected = persistence[min(level, len(persistence) - 1)]
        # Doubled angles of mixed gradients correlate as the square of the share that is kept.
        kept = np.sqrt(np.clip(expected * factor, 0.0, MOST_KEPT))
        strength = np.clip(_strength(mine, window_px) / _strength(other, window_px), *_STRENGTHS)
        detail += gain * (kept * mine + np.sqrt(1 - kept**2) * strength * other)
    light = light + 30 * (_uniform(rng, size, 4) - 0.5)
    tone = np.power(np.clip(light + detail, 0, 255) / 255, rng.uniform(0.75, 1.35))
    blurred = np.asarray(cv2.GaussianBlur(tone, (0, 0), float(rng.uniform(0.3, 0.9))))
    exposed = blurred * 255 * rng.uniform(0.8, 1.15)
    noisy = exposed + rng.normal(0, rng.uniform(1, 4), grey.shape)
    return np.asarray(np.clip(noisy, 0, 255), dtype=np.uint8)


def tilted(
    rng: np.random.Generator, grey: NDArray[np.uint8], relief_px: float, flat: float
) -> NDArray[np.uint8]:
    """`grey` (S, S) as seen from low above its middle, where what stands on the ground tilts away.

    `relief_px` is the standard deviation of how far it tilts at the rim of the picture; heights
    change over `flat` pixels.
    """
    size = grey.shape[0]
    cells = int(np.clip(size / max(flat, 1.0), 2, 96))
    along = np.linspace(-1, 1, size, dtype=np.float32)
    tilt = relief_px * _normal(rng, size, cells)
    index = np.arange(size, dtype=np.float32)
    cols = index[None, :] - tilt * along[None, :]
    rows = index[:, None] - tilt * along[:, None]
    moved = cv2.remap(grey, cols, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(moved, dtype=np.uint8)


def _bands(grey: NDArray[np.uint8]) -> tuple[list[Array], Array]:
    """Detail of each scale (S, S), finest first, and the light that is left."""
    rest = grey.astype(np.float32)
    found = []
    for side in _SIDES_PX:
        blurred = np.asarray(cv2.blur(rest, (side, side)), np.float32)
        found.append(rest - blurred)
        rest = blurred
    return found, rest


def _strength(band: Array, window_px: int) -> Array:
    power = cv2.blur(band * band, (window_px, window_px))
    return np.asarray(np.sqrt(power + np.float32(0.25)), dtype=np.float32)


def _uniform(rng: np.random.Generator, size: int, cells: int) -> Array:
    """A smooth random field (S, S) around 0.5, `cells` values across."""
    return _enlarged(rng.random((cells, cells)), size)


def _normal(rng: np.random.Generator, size: int, cells: int) -> Array:
    """A smooth random field (S, S) around 0."""
    return _enlarged(rng.standard_normal((cells, cells)), size)


def _enlarged(values: NDArray[np.float64], size: int) -> Array:
    made = cv2.resize(values.astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC)
    return np.asarray(made, dtype=np.float32)
