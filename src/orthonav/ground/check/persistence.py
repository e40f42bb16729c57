"""Persistence: how well the structure of the ground is expected to correlate with another year.

Long lines with contrast last (roads, hedges, field borders); fine texture without direction does
not (crops, tree crowns). The regression was trained on generated landscapes of several seeds, dates
and resolutions (`python -m experiments.persistence`), never on real imagery.
"""

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import combinations_with_replacement
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.channels import FINE, channels_of

Array = NDArray[np.float32]
PATCH_PX = 24
"""Side of the window over which persistence is averaged, in pixels of its level."""
MARGIN_PX = 40
"""How far a grey level influences the features, about: patch, window and blur."""
MIN_PERSISTENCE, MAX_PERSISTENCE = 0.005, 0.95
"""Limits of predictions: the range of the training data."""
_TENSORS = ((1.0, 11), (1.0, 21), (2.0, 29))
"""Blur before the gradient (standard deviation) and window of the structure tensor, in pixels."""
_BROAD_PX, _BROADER_PX = 7, 29
"""Boxes between which medium detail lies."""
MODEL = "persistence.json"


@dataclass(frozen=True, eq=False)
class PersistenceModel:
    """Ridge regression on all products of two features.

    `mean`, `spread` (F,): mean and standard deviation of the features over the training data.
    `weights` (T,): weights of the `terms` of the standardized features.
    """

    mean: NDArray[np.float64]
    spread: NDArray[np.float64]
    weights: NDArray[np.float64]

    def __call__(self, features: Array) -> Array:
        """Expected correlation of gradients (..) with those of another year, 0 to 1."""
        predicted = terms((features - self.mean) / self.spread) @ self.weights
        return np.asarray(np.clip(predicted, MIN_PERSISTENCE, MAX_PERSISTENCE), dtype=np.float32)

    def to_plain(self) -> dict[str, Any]:
        """Plain values for a JSON file."""
        return {name: [float(f"{x:.6g}") for x in value] for name, value in vars(self).items()}


@cache
def default_model() -> PersistenceModel:
    """The model that is installed with the package."""
    text = resources.files(__package__).joinpath(MODEL).read_text(encoding="utf-8")
    return PersistenceModel(
        **{name: np.array(values, np.float64) for name, values in json.loads(text)["model"].items()}
    )


def terms(scaled: NDArray[Any]) -> NDArray[Any]:
    """1, features (.., F) and all products of two of them."""
    count = scaled.shape[-1]
    pairs = combinations_with_replacement(range(count), 2)
    products = [scaled[..., i] * scaled[..., j] for i, j in pairs]
    ones = np.ones(scaled.shape[:-1], scaled.dtype)
    return np.stack([ones, *(scaled[..., i] for i in range(count)), *products], axis=-1)


def features(grey: NDArray[np.uint8], gsd_m: float, every_px: int = 8) -> Array:
    """Features (h, w, F) of grey (H, W) every `every_px` pixels, starting at half of that.

    Each is a mean over `PATCH_PX`: coherence of gradients, their energy, fine and medium detail,
    registration evidence; the last is the resolution `gsd_m` (metres per pixel), as a logarithm.
    """
    picture = grey.astype(np.float32)
    found = []
    for blur, side_px in _TENSORS:
        agreement, energy = _structure(picture, blur, side_px)
        found += [_mean(agreement), np.log(_mean(energy) + np.float32(1e-2))]
    broad, broader = (cv2.blur(picture, (side, side)) for side in (_BROAD_PX, _BROADER_PX))
    found += [
        np.log(_mean(np.abs(a - b)) + np.float32(0.1))
        for a, b in ((picture, broad), (broad, broader))
    ]
    strength = channels_of(grey, np.ones(grey.shape, np.bool_), FINE)
    found.append(_mean(strength[..., 0] ** 2 + strength[..., 1] ** 2))
    half = every_px // 2
    thin = [each[half::every_px, half::every_px] for each in found]
    resolution = np.full_like(thin[0], np.log2(gsd_m))
    return np.stack([*thin, resolution], axis=-1)


def _structure(picture: Array, blur: float, side_px: int) -> tuple[Array, Array]:
    """Coherence (0..1) and energy (H, W) of the structure tensor."""
    smooth = cv2.GaussianBlur(picture, (0, 0), blur)
    east, south = (cv2.Sobel(smooth, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))

    def around(values: Any) -> Array:
        return np.asarray(cv2.blur(values, (side_px, side_px)), np.float32)

    xx, yy, xy = around(east * east), around(south * south), around(east * south)
    energy = xx + yy
    difference = np.sqrt((xx - yy) ** 2 + 4 * xy**2)
    return np.asarray(difference / (energy + np.float32(1e-3))), energy


def _mean(values: Any) -> Array:
    return np.asarray(cv2.blur(values, (PATCH_PX, PATCH_PX)), dtype=np.float32)
