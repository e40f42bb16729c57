"""How much a place stands out from the ground around it, which tells it from texture that repeats.

Rows, lattices and single roads fit nearly as well a little aside, and so do places by chance.
Scores aside are compared with that of the place, for all channels, gradients alone, and phase
correlation (Kuglin and Hines, 1975), all from the same spectra (docs/decisions/evidence.md)."""

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.channels import GROUPS
from orthonav.core.register.kernel import KERNEL
from orthonav.core.register.pose import Pose
from orthonav.core.register.template import Template
from orthonav.core.register.window import MapWindow, Reference, sampled_planes

Array = NDArray[np.float32]
PHASE_FLOOR = 1e-3  # fraction of the mean power below which frequencies count less


class Sharpness(NamedTuple):
    """Over scores a little aside: `local_ratio` of all channels over the best, up to 10; 0 without
    correlation; `local_gradients`, `local_phase` over the mean, in standard deviations."""

    local_ratio: float
    local_gradients: float
    local_phase: float


def sharpness(template: Template, reference: Reference, pose: Pose) -> Sharpness:
    """At the heading and scale of `pose`."""
    moved = _moved_scores(template, reference, pose)
    rows, cols = (np.arange(side, dtype=np.float64) - side // 2 for side in moved.shape[1:])
    moved_px = np.hypot(rows[:, None], cols)
    # The place itself is the best near by; smaller moves than those aside belong to it too.
    near, aside = moved_px <= 3.0, moved_px > max(3.0, 0.06 * math.sqrt(template.pixels))
    return Sharpness(
        _ratio(moved[0] + moved[1], near, aside),
        _deviations(moved[0], near, aside),
        _deviations(moved[2], near, aside),
    )


def _ratio(scores: Array, near: NDArray[np.bool_], aside: NDArray[np.bool_]) -> float:
    here, rival = float(scores[near].max()), float(scores[aside].max(initial=0.0))
    return min(here / max(rival, 1e-6), 10.0) if here > 0 else 0.0


def _deviations(scores: Array, near: NDArray[np.bool_], aside: NDArray[np.bool_]) -> float:
    others = scores[aside]
    if not others.size:
        return 0.0
    return float((scores[near].max() - others.mean()) / (others.std() + 1e-9))


def _moved_scores(template: Template, reference: Reference, pose: Pose) -> Array:
    """Scores (3, 2 R + 1, 2 C + 1) of gradients, grey and phase correlation, by rows and columns.

    Not divided by the energy of the map under each move: that hardly changes."""
    height, width = template.mask.shape
    rows, cols = (max(8, int(side / 8)) for side in (height, width))
    window = MapWindow.of(template, reference, pose, 0, (rows, cols))
    # Moves of less than the margin never reach over the border: no padding.
    size = tuple(cv2.getOptimalDFTSize(side) for side in window.shape)
    if KERNEL is not None:
        moved = np.empty((3, 2 * rows + 1, 2 * cols + 1), np.float32)
        KERNEL.moved(
            *(window.made, template.values, template.weights, window.matrix(pose), pose.turn_rad),
            *((rows, cols), size, PHASE_FLOOR, moved),
        )
        return moved
    planes, _ = sampled_planes(window, pose)
    for group, weight in zip(GROUPS, template.weights, strict=True):
        energy = float(np.square(planes[group]).sum())
        planes[group] *= math.sqrt(weight / energy) if energy > 0 else 0.0
    products = np.conj(np.fft.rfft2(template.channels, s=size, axes=(1, 2)))
    products *= np.fft.rfft2(planes, s=size, axes=(1, 2))
    power = np.abs(products)
    floor = PHASE_FLOOR * power.mean(axis=(1, 2), keepdims=True) + 1e-12
    phase = (products / (power + floor)).sum(axis=0)
    parts = np.stack([*(products[group].sum(axis=0) for group in GROUPS), phase])
    surface = np.fft.irfft2(parts, s=size, axes=(1, 2))
    return np.asarray(surface[:, : 2 * rows + 1, : 2 * cols + 1], np.float32)
