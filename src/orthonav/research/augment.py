"""Reference tiles as a camera might see them: the augmentations of CAEVL (WACV 2026).

Geometry (one of rotation, displacement and magnification), then blur, contrast and brightness, in
the ranges of the authors' released configuration. Their vignetting and the mask of their camera
are left out: they are of one camera.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

GEOMETRY, LIGHT = 0.8, 0.5
"""Probability of a change of geometry, and of each of blur, contrast and brightness."""
TURN_DEG, SHIFT_PX, SHIFTED, LEAST_AREA = 30.0, 10.0, 0.75, 0.7
"""Largest rotation; largest displacement along an axis, at 256 px, and its probability; smallest
share of a tile that is magnified."""
SIDE_PX = 256.0
BLUR_PX, BLUR_KERNEL = (0.1, 2.0), 5
CONTRAST, BRIGHTNESS = (0.1, 2.0), (1.0, 2.0)


@dataclass(frozen=True, eq=False)
class Augmented:
    """`grey` (S, S) uint8, and where it shows the tile: `tile_from_view` (2, 3) maps x and y of a
    pixel coordinate in it to those in the tile (outer corner of the first pixel: 0, 0)."""

    grey: NDArray[np.uint8]
    tile_from_view: NDArray[np.float32]


def augmented(rng: np.random.Generator, grey: NDArray[np.uint8]) -> Augmented:
    """A tile (S, S) seen anew; every part of it lies within the tile."""
    size = grey.shape[0]
    matrix = _geometry(rng, size)
    half = np.full(2, 0.5)
    of_centres = matrix.copy()  # OpenCV counts from the centre of the first pixel
    of_centres[:, 2] += matrix[:, :2] @ half - half
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = cv2.warpAffine(
        grey, of_centres, (size, size), flags=flags, borderMode=cv2.BORDER_REPLICATE
    ).astype(np.float32)
    if rng.random() < LIGHT:
        blur = rng.uniform(*BLUR_PX)
        seen = cv2.GaussianBlur(seen, (BLUR_KERNEL, BLUR_KERNEL), blur).astype(np.float32)
    if rng.random() < LIGHT:
        mean = float(seen.mean())
        seen = np.clip(mean + (seen - mean) * np.float32(rng.uniform(*CONTRAST)), 0, 255)
    if rng.random() < LIGHT:
        seen = np.clip(seen * np.float32(rng.uniform(*BRIGHTNESS)), 0, 255)
    return Augmented(np.rint(seen).astype(np.uint8), matrix.astype(np.float32))


def _geometry(rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Tile from view (2, 3): rotation, displacement, magnification or nothing."""
    scale, turn, middle = np.ones(2), 0.0, np.full(2, size / 2)
    kind = rng.integers(3) if rng.random() < GEOMETRY else -1
    if kind == 0:
        turn = np.radians(rng.uniform(-TURN_DEG, TURN_DEG))
        scale /= abs(np.cos(turn)) + abs(np.sin(turn))  # the largest square within the tile
    elif kind == 1:
        shift = rng.uniform(-SHIFT_PX, SHIFT_PX, 2) * (rng.random(2) < SHIFTED) * size / SIDE_PX
        scale -= np.abs(shift) / size
        middle = middle - shift / 2
    elif kind == 2:
        scale *= np.sqrt(rng.uniform(LEAST_AREA, 1))
        middle = middle + rng.uniform(-1, 1, 2) * (1 - scale) * size / 2
    cos, sin = np.cos(turn), np.sin(turn)
    linear = np.array([[cos, -sin], [sin, cos]]) * scale
    return np.column_stack([linear, middle - linear @ np.full(2, size / 2)])
