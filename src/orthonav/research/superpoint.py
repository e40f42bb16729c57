"""SuperPoint (DeTone et al., CVPRW 2018): the second detector of the bag of visual words.

Di Piazza et al. 2024, section Methodology, Considered methods, try it beside SIFT. The network is
that of the `transformers` library. Its weights are not part of orthonav and it never downloads
them: their licence forbids commercial use. They are published as `magic-leap-community/superpoint`
on the Hugging Face hub. No row of `experiments/paper` uses it. This module needs PyTorch and never
flies.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import VariantError
from orthonav.core.extras import missing_extra
from orthonav.core.variants import Checked, choice, within
from orthonav.research.pretrained import chosen_device, pretrained, weights_stamp

try:
    import torch
except ImportError as error:
    raise missing_extra("a neural network", "train", "torch", error) from error

CELL_PX = 8  # of the network; a feature sees its own cell and the neighbouring ones
WHERE = (
    "the folder of magic-leap-community/superpoint (config.json and model.safetensors) from the "
    "Hugging Face hub; mind its licence, which forbids commercial use"
)

Array = NDArray[np.float32]


@dataclass(frozen=True)
class SuperPoint(Checked):
    """Keypoints and descriptors of grey pictures, by the thresholds of the folder's config.json."""

    weights: str = ""  # path of a Hugging Face folder
    max_points: int = within(0, 0)  # most points per picture, the strongest first; 0 for all
    device: str = choice("auto", "cpu", "cuda")  # "auto": a GPU if there is one

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.weights:
            raise VariantError(f"superpoint needs weights=PATH: {WHERE}")

    def __call__(self, grey: NDArray[np.uint8]) -> tuple[Array, Array, Array]:
        """Points (N, 2), radii (N,) and unit descriptors (N, 256) of a picture (H, W), strongest
        first.

        A point is (x, y) in pixels from the outer corner of the first pixel, whose centre is
        (0.5, 0.5). A picture without keypoints gives N = 0. Raises `MissingFileError` or
        `VariantError` where the weights are missing or not SuperPoint's.
        """
        device = chosen_device(self.device)
        model = _model(self.weights, weights_stamp(self.weights, WHERE), str(device))
        height, width = grey.shape
        padded = np.pad(grey, ((0, _padding(height)), (0, _padding(width))), mode="edge")
        pixels = torch.from_numpy(padded.astype(np.float32) / np.float32(255)).to(device)
        with torch.inference_mode():
            found = model(pixels[None, None].expand(1, 3, -1, -1))
        size = torch.tensor([padded.shape[1], padded.shape[0]], device=device)
        points = (found.keypoints[0] * size).round().cpu().numpy()
        # The library clears its border on the left and at the top only.
        border = model.config.border_removal_distance
        inside = (points[:, 0] < width - border) & (points[:, 1] < height - border)
        inside &= found.mask[0].cpu().numpy() > 0
        order = np.flatnonzero(inside)
        scores = found.scores[0].cpu().numpy()[order]
        order = order[np.argsort(-scores, kind="stable")][: self.max_points or None]
        descriptors = found.descriptors[0].cpu().numpy()[order]
        radii = np.full(len(order), CELL_PX, np.float32)
        return (points[order] + 0.5).astype(np.float32), radii, descriptors.astype(np.float32)


def _padding(size: int) -> int:
    """Padding in pixels up to a multiple of the network's cell, and to two cells at least."""
    return max(-size % CELL_PX, 2 * CELL_PX - size)


@lru_cache(maxsize=1)
def _model(weights: str, stamp: tuple[int, ...], device: str) -> Any:
    del stamp  # part of the key only: files may change
    return pretrained(weights, "superpoint", "SuperPointForKeypointDetection").to(device)
