"""How alike two dates look: grey levels, Canny edges and SIFT features of a view and its tile."""

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.tiles.represent import Canny
from orthonav.core.tiles.words import WordsRecipe

Grey = NDArray[np.uint8]
BLUR_STD_PX = 1.0
"""Edges are compared smoothed by a Gaussian, so that those a pixel apart agree."""
FOUND_PX = 3.0
"""A feature is found again if the most similar one of the tile lies so near."""


def edges(grey: Grey) -> NDArray[np.float32]:
    """Canny edges (H, W), 0 or 1, with the paper's thresholds."""
    return np.asarray(Canny()(grey, np.ones(grey.shape, np.bool_))[0], np.float32)


def blurred(seen: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(seen, (0, 0), BLUR_STD_PX), np.float32)


def correlation(one: NDArray[np.generic], other: NDArray[np.generic]) -> float:
    """Correlation coefficient of two pictures (H, W); 0 where one of them is flat."""
    a, b = (np.asarray(each, np.float64).ravel() for each in (one, other))
    a, b = a - a.mean(), b - b.mean()
    power = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / power if power else 0.0


def found_again(view: Grey, tile: Grey) -> float:
    """Share of the SIFT features of a view whose most similar feature of the tile is in place."""
    sift = cv2.SIFT.create(nfeatures=WordsRecipe.max_features)
    (here, ours), (there, theirs) = (sift.detectAndCompute(each, None) for each in (view, tile))
    if not here or not there:
        return 0.0
    pairs = cv2.BFMatcher(cv2.NORM_L2).match(ours, theirs)
    away = [np.subtract(here[m.queryIdx].pt, there[m.trainIdx].pt) for m in pairs]
    return float((np.hypot(*np.array(away).T) <= FOUND_PX).mean())
