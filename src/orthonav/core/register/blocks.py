"""Blocks of a view beside the map: how well each fits when it is moved a little aside.

Under wrong tilt, relief or lens they fit at different displacements, which show the camera."""

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.channels import CHANNELS
from orthonav.core.register.kernel import KERNEL
from orthonav.core.register.pose import Pose
from orthonav.core.register.template import BLOCKS, Template, block_starts
from orthonav.core.register.window import MapWindow, Reference

GREY_SHARE = 0.25
"""Grey over gradients: less than in the search, seasons mislead (docs/decisions/camera.md)."""
MIN_SEEN = 0.4  # blocks of which less is seen on valid map do not count
MIN_ENERGY = 0.1
"""Nor those below this fraction of the median energy: edges brought in would count too much."""
Array = NDArray[np.float32]
Sums = NDArray[np.float64]


class BlockScores(NamedTuple):
    """Correlation of each block of a view with the map under small displacements.

    - `correlations` (B * B, 2 R + 1, 2 R + 1): by pixels down and right on the map.
    - `pixels` (B * B,): that count, 0 where too few of a block are seen.
    - `middles_px` (B * B, 2): x and y from the middle of the window."""

    correlations: NDArray[np.float64]
    pixels: NDArray[np.float64]
    middles_px: NDArray[np.float64]


def block_scores(
    template: Template, reference: Reference, pose: Pose, reach_px: int
) -> BlockScores:
    """Of a view whose window lies at `pose`, moved by up to `reach_px` pixels of the level."""
    rows, cols = template.mask.shape
    window = MapWindow.of(template, reference, pose, 1, (reach_px, reach_px))
    if KERNEL is None:
        found, pixels = _correlated(*_compared(template, window, pose, reach_px), rows * cols)
    else:
        count, side = BLOCKS * BLOCKS, 2 * reach_px + 1
        found, pixels = np.empty((count, side, side)), np.empty(count)
        at = window.matrix(pose), pose.turn_rad
        shares = GREY_SHARE * (template.weights[1] > 0), MIN_SEEN, MIN_ENERGY
        KERNEL.blocks(window.made, template.planes, *at, reach_px, shares, found, pixels)
    return BlockScores(found, pixels, _middles_px(rows, cols))


def _correlated(products: Array, sums: Sums, view_px: int) -> tuple[Sums, Sums]:
    """Correlations (B * B, 2 R + 1, 2 R + 1) and pixels (B * B,) that count, by `_compared`."""
    used = sums[2] >= MIN_SEEN * view_px / len(products)
    for each in sums[:2]:
        used &= each > MIN_ENERGY * np.median(each)
    scale = np.where(used, 1 / np.sqrt(np.where(used, sums[0] * sums[1], 1.0)), 0.0)
    return (products * scale[:, None, None]).clip(-1.0, 1.0), np.where(used, sums[2], 0.0)


@lru_cache(maxsize=64)
def _middles_px(rows: int, cols: int) -> Sums:
    """Of the blocks (B * B, 2), shared: not to be written to."""
    y, x = (
        (np.append(each[1:], size) + each) / 2 - size / 2
        for each, size in zip(block_starts((rows, cols)), (rows, cols), strict=True)
    )
    middles = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    middles.flags.writeable = False
    return middles


def _compared(
    template: Template, window: MapWindow, pose: Pose, reach_px: int
) -> tuple[Array, Sums]:
    """Products (B * B, 2 R + 1, 2 R + 1) of blocks with the map, moved; of each block the energy in
    the view and on the map, and the pixels that count (3, B * B)."""
    rows, cols = template.mask.shape
    seen = _sampled(window, pose)
    here = seen[reach_px : reach_px + rows, reach_px : reach_px + cols]
    own_weights, own = _energies(template, template.values)
    weights, energies = _energies(template, here)
    used = template.planes * np.sqrt(own_weights * weights)[:, None, None].astype(np.float32)
    side = 2 * reach_px + 1
    products = np.empty((BLOCKS * BLOCKS, side, side), np.float32)
    for down, right in np.ndindex(side, side):
        moved = np.moveaxis(seen[down : down + rows, right : right + cols, :3], 2, 0)
        products[:, down, right] = template.block_sums((used[:3] * moved).sum(axis=0))
    pixels = template.block_sums(template.mask * here[..., 3])
    return products, np.stack([own, energies, pixels])


def _sampled(window: MapWindow, pose: Pose) -> Array:
    """The window (H, W, 4), edge directions turned; 0 where not valid."""
    sampled = window.sample(pose)
    cos, sin = math.cos(2 * pose.turn_rad), math.sin(2 * pose.turn_rad)
    turn = np.eye(CHANNELS, dtype=np.float32)
    turn[:2, :2] = [[cos, sin], [-sin, cos]]
    turned = np.asarray(cv2.transform(sampled, turn), np.float32)
    turned[sampled[..., 3] < 0.99] = 0.0
    return turned


def _energies(template: Template, values: Array) -> tuple[Sums, Sums]:
    """Weights (4,) of the squares of channels (H, W, 4), and the weighted energy of each block."""
    squares = np.moveaxis(np.square(values, dtype=np.float64), 2, 0)
    blocks = template.block_sums(squares)
    gradients, grey = float(blocks[:2].sum()), float(blocks[2].sum())
    counts = grey > 0 and template.weights[1] > 0  # else the view is compared without grey
    weights = np.array([1.0, 1.0, GREY_SHARE * gradients / grey if counts else 0.0, 0.0])
    return weights, weights @ blocks
