"""Any number of vectors similar to those of an atlas's coarse tiles, made block by block.

Measured on NAIP and on a generated landscape (tiles of 128 px, an eighth apart): the components of
whitened embeddings are normally distributed with equal variance; the first are correlated over
several tiles, the last not even between neighbours; a view of another year agrees with its tile
mostly in the first components. So each component is a field of normal noise over a grid of tiles,
smoothed accordingly, and vectors are scaled to unit length. Not modelled: repeating places
(plantations, housing estates), water, seams of imagery.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

BLOCK_SIDE = 1024
BLOCK_ROWS = BLOCK_SIDE**2
DIMS = 128
_OCTAVES = (0, 2, 3, 4, 5, 6, 7)
_SPREAD = (1.0, 0.715, 0.619, 0.511, 0.396, 0.298, 0.206)
_SMOOTH = (
    (3, 2.87, 0, 0.0),
    (16, 0.0, 3, 0.5),
    (32, 0.0, 1, 0.48),
    (48, 0.0, 1, 0.28),
    (80, 0.0, 1, 0.18),
    (112, 0.0, 1, 0.09),
    (128, 0.0, 1, 0.04),
)
"""Up to a component: a Gaussian of so many tiles, or so many passes of (share, 1, share)."""
_AGREEMENT = (0.75, 0.63, 0.54, 0.50, 0.49, 0.44, 0.42, 0.38)
QUALITY, QUALITY_STD = 1.0, 0.22
"""Views agree better or worse as a whole: so their products with the right tile have the median and
spread measured."""

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Fields:
    """Statistics of the generated vectors.

    - `dims`: components.
    - `power`: 1 for whitened vectors; below 1, component i is multiplied by its standard deviation
      before whitening to the power of 1 - `power`.
    - `seed`: seed of the field.
    """

    dims: int = 64
    power: float = 0.5
    seed: int = 0

    @property
    def weights(self) -> Array:
        """How large each component is."""
        octaves = np.log2(np.arange(DIMS) + 1)
        spread = np.exp(np.interp(octaves, _OCTAVES, np.log(_SPREAD)))
        return np.asarray(spread[: self.dims] ** (1 - self.power), dtype=np.float32)

    def blocks(self, count: int) -> Iterator[Array]:
        """Unit vectors (1024^2, dims) float32 of one block after the other, `count` in all."""
        for number in range(-(-count // BLOCK_ROWS)):
            yield _unit(self.block(number)[: count - number * BLOCK_ROWS] * self.weights)

    def sample(self, count: int, wanted: int) -> Array:
        """Vectors to learn from, of up to four blocks."""
        chosen = np.unique(np.linspace(0, math.ceil(count / BLOCK_ROWS) - 1, 4).astype(int))
        each = -(-wanted // len(chosen))
        parts = []
        for number in chosen:
            rows = min(BLOCK_ROWS, count - int(number) * BLOCK_ROWS)
            taken = np.arange(0, rows, max(1, rows // each))[:each]
            parts.append(_unit(self.block(int(number))[taken] * self.weights))
        return np.concatenate(parts)

    def block(self, number: int) -> Array:
        """Components (1024^2, dims) of a block, each of variance 1, reproducible."""
        rng = np.random.default_rng([self.seed, number])
        out = rng.standard_normal((BLOCK_ROWS, self.dims), dtype=np.float32)
        grid = out.reshape(BLOCK_SIDE, BLOCK_SIDE, self.dims)
        start = 0
        for end, sigma, passes, share in _SMOOTH:
            part = np.ascontiguousarray(grid[:, :, start:end])
            for axis in (0, 1):
                part = _smooth(part, axis, sigma, passes, share)
            if part.size:
                grid[:, :, start:end] = part / np.sqrt(np.mean(part**2, axis=(0, 1)))
            start = end
        return out

    def queries(self, number: int, ids: NDArray[np.int64]) -> Array:
        """Views (Q, dims) of another year, of tiles `ids` that lie in a block."""
        rng = np.random.default_rng([self.seed, number, 1])
        seen = self.block(number)[ids - number * BLOCK_ROWS]
        agreement = np.repeat(_AGREEMENT, DIMS // len(_AGREEMENT))[: self.dims]
        quality = rng.normal(QUALITY, QUALITY_STD, (len(ids), 1))
        agreement = np.clip(quality * agreement, 0.02, 0.97)
        noise = rng.standard_normal(seen.shape)
        made = agreement * seen + np.sqrt(1 - agreement**2) * noise
        return _unit((made * self.weights).astype(np.float32))


def drawn_ids(count: int, queries: int, seed: int) -> list[tuple[int, NDArray[np.int64]]]:
    """Ids of tiles to be looked for, in up to eight blocks: block and ids in it."""
    rng = np.random.default_rng([seed, 2])
    blocks = math.ceil(count / BLOCK_ROWS)
    chosen = np.sort(rng.choice(blocks, min(8, blocks), replace=False))
    drawn = []
    for part, number in zip(np.array_split(np.arange(queries), len(chosen)), chosen, strict=True):
        first = int(number) * BLOCK_ROWS
        ids = rng.integers(first, min(count, first + BLOCK_ROWS), len(part))
        drawn.append((int(number), ids.astype(np.int64)))
    return drawn


def _unit(vectors: Array) -> Array:
    norms = np.sqrt(np.einsum("nd,nd->n", vectors, vectors))
    return np.asarray(vectors * (1 / norms)[:, None], dtype=np.float32)


def _smooth(part: Array, axis: int, sigma: float, passes: int, share: float) -> Array:
    if sigma:
        return np.asarray(gaussian_filter1d(part, sigma, axis=axis, mode="wrap"))
    for _ in range(passes):
        part = part + np.float32(share) * (np.roll(part, 1, axis) + np.roll(part, -1, axis))
    return part
