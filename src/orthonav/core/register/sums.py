"""Sums over the pixels of a view beside the map, all that one step of refinement needs.

The compiled kernel makes the same sums. OpenCV rounds positions to 1/32 px, the kernel does not.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.evidence import GROUPS
from orthonav.core.register.map_window import MapWindow
from orthonav.core.register.memory import thread_memory
from orthonav.core.register.pose import Pose
from orthonav.core.register.template import BLOCKS, Template, by_kind, turn_planes

Array = NDArray[np.float32]
FULLY_VALID = 0.99
"""A pixel counts where the sampled map is valid by more than this."""


class Sums(NamedTuple):
    """Sums over the pixels of a view that count, and that see valid map.

    - `products`, `energies` (2,): view times map, and map squared, by kind of evidence.
    - `left_energies` (2,): view squared over its pixels that see no valid map.
    - `slopes` (2, 4): derivatives by the steps times map.
    - `left_slopes` (2, 4): derivatives times view over its pixels that see no valid map.
    - `left_pixels` (B * B,): number of these by block.
    """

    products: NDArray[np.float64]
    energies: NDArray[np.float64]
    left_energies: NDArray[np.float64]
    slopes: NDArray[np.float64]
    left_slopes: NDArray[np.float64]
    left_pixels: NDArray[np.float64]

    @classmethod
    def of_row(cls, row: NDArray[np.float64]) -> "Sums":
        """Views of one row of `SUMS` numbers."""
        slopes, left_slopes = row[6:14].reshape(2, 4), row[14:22].reshape(2, 4)
        return cls(row[:2], row[2:4], row[4:6], slopes, left_slopes, row[22:])


SUMS = 22 + BLOCKS**2


def compared(template: Template, seen: Array, valid: Array, slopes: bool = True) -> Sums:
    """The sums of a view beside `sampled_planes`; those of derivatives are 0 unless `slopes`.

    `seen` becomes 0 where the view or the map does not count.
    """
    made = Sums.of_row(np.zeros(SUMS))
    if not (template.whole and valid.min() > FULLY_VALID):
        counts = template.mask * (valid > FULLY_VALID)
        seen *= counts
        left = template.mask - counts
        if left.any():
            made.left_pixels[:] = template.block_sums(left)
            view = template.channels * left
            made.left_energies[:] = [float(np.sum(np.square(view[group]))) for group in GROUPS]
            if slopes:
                made.left_slopes[:] = by_kind(template, view)
    for kind, group in enumerate(GROUPS):
        mine, theirs = template.channels[group].reshape(-1), seen[group].reshape(-1)
        made.products[kind], made.energies[kind] = mine @ theirs, theirs @ theirs
    if slopes:
        made.slopes[:] = by_kind(template, seen)
    return made


def sampled_planes(template: Template, window: MapWindow, pose: Pose) -> tuple[Array, Array]:
    """The map as the view's window shows it: evidence (3, H, W), and how far it is valid (H, W).

    Memory of the thread, overwritten by the next call.
    """
    shape = template.mask.shape
    planes = thread_memory("sampled", 10 * template.mask.size).reshape(10, *shape)
    interleaved = planes[:4].reshape(*shape, 4)
    window.sample(pose, interleaved)
    turn_planes(interleaved, -pose.turn_rad, planes[4:8], planes[8:10])
    return planes[4:7], planes[7]
