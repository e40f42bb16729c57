"""Boundaries of a classical graph-based segmentation: a light substitute for Segment Anything.

It is not in Di Piazza et al. 2024: Segment Anything, in their section Methodology, needs weights
and is too expensive for an aircraft. This one finds region boundaries with the method of
Felzenszwalb and Huttenlocher (IJCV 2004): pixels are merged into regions in the order of increasing
difference, as long as a difference is small compared with those inside the two regions.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.extras import needed
from orthonav.core.tiles.represent import filled, inner
from orthonav.core.variants import Checked, within

MARGIN_PX = 32
"""Most changes by cropping end there, see `Segments`."""


@dataclass(frozen=True)
class Segments(Checked):
    """Binary boundaries between the regions of a graph-based segmentation of the grey levels.

    `scale`: k of Felzenszwalb and Huttenlocher for grey levels 0..255; larger means larger regions.
    `sigma`: Gaussian smoothing in pixels. `min_size`: area in pixels below which a region is merged
    with its neighbour. The defaults give about as many boundary pixels as Canny with the thresholds
    of Di Piazza et al., on aerial imagery of 1.5 m. A blurred edge can become a thin region.

    Segmentation is not local: a difference anywhere in a region can move its far boundary. The
    image border matters most. On the same imagery, half of the boundary pixels of a crop differ
    from those of the whole image within 16 px of its border, a quarter 32 to 48 px inside, and a
    fifth at any depth.
    """

    scale: float = within(100.0, 0, 1e6, above=True)
    sigma: float = within(1.5, 0, 16)
    min_size: int = within(30, 1, 1_000_000)

    channels = 1

    @property
    def margin_px(self) -> int:
        """Width of the rim in which cropping changes most; some changes go deeper."""
        return MARGIN_PX + math.ceil(4 * self.sigma)

    def __call__(self, grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Boundaries (1, H, W): 1 on both sides of one, else 0; none along the border of `valid`.

        Values of pixels that are not valid have no influence. Raises `MissingExtraError`
        without scikit-image.
        """
        if not valid.any():
            return np.zeros((1, *grey.shape), dtype=np.float32)
        library = needed("skimage.segmentation", "segments", "graph-based segmentation")
        labels = library.felzenszwalb(
            filled(grey, valid), scale=self.scale, sigma=self.sigma, min_size=self.min_size
        )
        edges = boundaries(labels)
        if not valid.all():
            edges &= inner(valid, 2 * (math.ceil(2 * self.sigma) + 2) + 1)
        return edges.astype(np.float32)[None]


def boundaries(labels: NDArray[np.integer[Any]]) -> NDArray[np.bool_]:
    """Pixels (H, W) of labels (H, W) with another label above, below, left or right of them."""
    edges = np.zeros(labels.shape, dtype=bool)
    below = labels[1:] != labels[:-1]
    edges[1:] |= below
    edges[:-1] |= below
    right = labels[:, 1:] != labels[:, :-1]
    edges[:, 1:] |= right
    edges[:, :-1] |= right
    return edges
