"""Blocks of a view beside the map: how well each fits when it is moved a little aside.

Under wrong tilt, relief or lens they fit at different displacements, which show the camera."""

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.channels import CHANNELS
from orthonav.core.register.kernel import KERNEL
from orthonav.core.register.pose import Pose
from orthonav.core.register.template import BLOCKS, Template
from orthonav.core.register.window import MapWindow, Reference

GREY_SHARE = 0.25
"""Grey over gradients: less than in the search, seasons mislead (docs/decisions/camera.md)."""
MIN_SEEN = 0.4  # blocks of which less is seen on valid map do not count
MIN_ENERGY = 0.1
"""Nor those below this fraction of the median energy: edges brought in would count too much."""
Array = NDArray[np.float32]


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
    seen = _sampled(template, reference, pose, reach_px)
    rows, cols = template.mask.shape
    count = BLOCKS * BLOCKS
    products = _products(template, template.values, seen, reach_px)
    here = np.ascontiguousarray(seen[reach_px : reach_px + rows, reach_px : reach_px + cols])
    weights, energies = zip(
        *(_energies(template, each) for each in (template.values, here)), strict=True
    )
    pixels = products[:, reach_px, reach_px, 3].astype(np.float64)
    used = pixels >= MIN_SEEN * rows * cols / count
    for each in energies:
        used &= each > MIN_ENERGY * np.median(each)
    scale = np.sqrt(np.where(used, energies[0] * energies[1], 1.0))
    correlations = products @ np.sqrt(weights[0] * weights[1]) / scale[:, None, None]
    starts = zip(template.block_starts, template.mask.shape, strict=True)
    y, x = ((np.append(each[1:], size) + each) / 2 - size / 2 for each, size in starts)
    middles = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return BlockScores(
        np.where(used[:, None, None], np.clip(correlations, -1.0, 1.0), 0.0),
        np.where(used, pixels, 0.0),
        middles,
    )


def _sampled(template: Template, reference: Reference, pose: Pose, margin_px: int) -> Array:
    """(H + 2 R, W + 2 R, 4): the window and `margin_px` around it, turned; 0 where not valid."""
    window = MapWindow.of(template, reference, pose, 1, (margin_px, margin_px))
    sampled = np.empty((*window.shape, CHANNELS), np.float32)
    window.sample(pose, sampled)
    cos, sin = math.cos(2 * pose.turn_rad), math.sin(2 * pose.turn_rad)
    turn = np.eye(CHANNELS, dtype=np.float32)
    turn[:2, :2] = [[cos, sin], [-sin, cos]]
    turned = np.asarray(cv2.transform(sampled, turn), np.float32)
    turned[sampled[..., 3] < 0.99] = 0.0
    return turned


def _energies(template: Template, values: Array) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights (4,) of the squares of channels (H, W, 4), and the weighted energy of each block."""
    blocks = _products(template, values, values, 0)[:, 0, 0].astype(np.float64)
    gradients, grey = float(blocks[:, :2].sum()), float(blocks[:, 2].sum())
    weights = np.array([1.0, 1.0, GREY_SHARE * gradients / grey if grey > 0 else 0.0, 0.0])
    return weights, blocks @ weights


def _products(template: Template, values: Array, seen: Array, reach_px: int) -> Array:
    """Sums (B * B, 2 R + 1, 2 R + 1, 4) over blocks of channels (H, W, 4) times the map, moved."""
    side = 2 * reach_px + 1
    products = np.empty((BLOCKS * BLOCKS, side, side, CHANNELS), np.float32)
    if KERNEL is not None:
        KERNEL.blocks(values, seen, reach_px, products)
        return products
    rows, cols = values.shape[:2]
    planes = np.moveaxis(values, 2, 0)
    for down, right in np.ndindex(side, side):
        moved = np.moveaxis(seen[down : down + rows, right : right + cols], 2, 0)
        products[:, down, right] = template.block_sums(planes * moved).T
    return products
