"""How much a place stands out from the ground around it, which tells it from texture that repeats.

A view of rows, lattices or a single road fits nearly as well a little aside. Places found by chance
do so too. The view's window is moved a little aside, and what it scores there is compared with its
score at the place itself: for all channels, for gradients alone, and as phase correlation (Kuglin
and Hines, 1975), which weighs all spatial frequencies alike. All three come from the same spectra.
What they bring is in docs/decisions/evidence.md.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from orthonav.core.register.channels import CHANNELS, GROUPS
from orthonav.core.register.kernel import KERNEL
from orthonav.core.register.pose import Pose
from orthonav.core.register.template import Template, turn_planes
from orthonav.core.register.window import MapWindow, Reference

Array = NDArray[np.float32]
REACH_SHARE, MIN_REACH_PX = 0.125, 8
"""The window is moved by up to this share of its sides to either side, and by so many pixels of the
level at least."""
PEAK_SHARE = 0.06
"""Moves below this share of the view's side belong to the place itself."""
MIN_PEAK_PX = 3.0
"""The same, at least, pixels of the level."""
NEAR_PX = 3.0
"""The place itself is the best within so many pixels."""
MAX_RATIO = 10.0
PHASE_FLOOR = 1e-3
"""Frequencies of less power than this share of the mean count less in the phase correlation."""


class Sharpness(NamedTuple):
    """How far the score of a place stands out from those a little aside.

    `ratio`: of all channels, over the best one aside, up to 10; 0 where the view does not correlate
    at all. `gradients`, `phase`: of gradients alone, and by phase correlation of all channels, over
    the mean aside, in standard deviations.
    """

    ratio: float
    gradients: float
    phase: float


def sharpness(template: Template, reference: Reference, pose: Pose) -> Sharpness:
    """How far a view stands out at `pose`; heading and scale stay those of `pose`."""
    moved = _moved_scores(template, reference, pose)
    rows, cols = (np.arange(side, dtype=np.float64) - side // 2 for side in moved.shape[1:])
    moved_px = np.hypot(rows[:, None], cols)
    peak_px = max(MIN_PEAK_PX, PEAK_SHARE * math.sqrt(template.pixels))
    near, aside = moved_px <= NEAR_PX, moved_px > peak_px
    return Sharpness(
        _ratio(moved[0] + moved[1], near, aside),
        _deviations(moved[0], near, aside),
        _deviations(moved[2], near, aside),
    )


def _ratio(scores: Array, near: NDArray[np.bool_], aside: NDArray[np.bool_]) -> float:
    here, rival = float(scores[near].max()), float(scores[aside].max(initial=0.0))
    return min(here / max(rival, 1e-6), MAX_RATIO) if here > 0 else 0.0


def _deviations(scores: Array, near: NDArray[np.bool_], aside: NDArray[np.bool_]) -> float:
    others = scores[aside]
    if not others.size:
        return 0.0
    return float((scores[near].max() - others.mean()) / (others.std() + 1e-9))


def _moved_scores(template: Template, reference: Reference, pose: Pose) -> Array:
    """Scores (3, 2 R + 1, 2 C + 1) of a view's window moved by up to R rows and C columns: of
    gradients, of grey, and by phase correlation.

    Not divided by the energy of the map under each move: that hardly changes.
    """
    height, width = template.mask.shape
    rows, cols = (max(MIN_REACH_PX, int(side * REACH_SHARE)) for side in (height, width))
    window = MapWindow.of(template, reference, pose, 0, (rows, cols))
    # Moves of less than the margin never reach over the border: no padding.
    size = tuple(next_fast_len(side, real=True) for side in window.shape)
    if KERNEL is not None:
        moved = np.empty((3, 2 * rows + 1, 2 * cols + 1), np.float32)
        KERNEL.moved(
            *(window.made, template.values, template.weights, window.matrix(pose), pose.turn_rad),
            *((rows, cols), size, PHASE_FLOOR, moved),
        )
        return moved
    sampled = np.empty((*window.shape, CHANNELS), np.float32)
    window.sample(pose, sampled)
    planes, scratch = np.empty((2, CHANNELS, *window.shape), np.float32)
    turn_planes(sampled, -pose.turn_rad, planes, scratch[:2])
    for group, weight in zip(GROUPS, template.weights, strict=True):
        energy = float(np.square(planes[group]).sum())
        planes[group] *= math.sqrt(weight / energy) if energy > 0 else 0.0
    products = np.conj(rfft2(template.channels, s=size)) * rfft2(planes[:3], s=size)
    power = np.abs(products)
    floor = PHASE_FLOOR * power.mean(axis=(1, 2), keepdims=True) + 1e-12
    phase = (products / (power + floor)).sum(axis=0)
    parts = np.stack([*(products[group].sum(axis=0) for group in GROUPS), phase])
    moved = irfft2(parts, s=size)[:, : 2 * rows + 1, : 2 * cols + 1]
    return np.asarray(moved, np.float32)
