"""The pose of a view on the map: a similarity, position, turn and scale."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rotation(turn_rad: float, scale: float = 1.0) -> Array:
    """Matrix (2, 2) of a clockwise turn and a scale, for x to the right and y down."""
    cos, sin = scale * math.cos(turn_rad), scale * math.sin(turn_rad)
    return np.array([[cos, -sin], [sin, cos]])


@dataclass(frozen=True)
class Pose:
    """Where the middle of a view's window lies on the map, and how it is turned and scaled.

    `x_px, y_px`: columns and rows of the map at level 0, pixel-is-area, y to the south;
    `turn_rad`: heading of the top of the window, clockwise from north; `log_scale`: natural
    logarithm of the true over the assumed ground resolution (and so of true over reported height).
    """

    x_px: float
    y_px: float
    turn_rad: float
    log_scale: float

    @property
    def linear(self) -> Array:
        """Rotation and scale (2, 2) from the view's window to the map."""
        return rotation(self.turn_rad, math.exp(self.log_scale))

    def distance_px(self, other: "Pose") -> float:
        """Distance of two places, pixels of level 0."""
        return math.hypot(self.x_px - other.x_px, self.y_px - other.y_px)

    def map_px(self, from_middle_px: Array) -> Array:
        """Map coordinates (..., 2) of points given from the middle of the window, level 0 px."""
        return np.asarray(from_middle_px @ self.linear.T + [self.x_px, self.y_px])

    def stepped(self, step: Sequence[float]) -> "Pose":
        """This pose after the inverse of a small step (dx, dy, turn, log scale) of the window."""
        scale = math.exp(self.log_scale)
        cos, sin = scale * math.cos(self.turn_rad), scale * math.sin(self.turn_rad)
        return Pose(
            self.x_px - (cos * step[0] - sin * step[1]),
            self.y_px - (sin * step[0] + cos * step[1]),
            self.turn_rad - step[2],
            self.log_scale - step[3],
        )


def even_scale(log_scale: float) -> float:
    """Factor of correlation times root of pixels that makes scores of chance alike at any scale.

    A view that is magnified touches more pixels of the map, without more information; on mirrored
    views chance grows with about the root of the scale (docs/decisions/registration.md).
    """
    return math.exp(log_scale / 2)
