"""The pose of a view on the map, a similarity, and what the telemetry expects of it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
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


NAT_SCORE = 1.0
"""Units of the score per nat of the prior of heading and scale
(docs/decisions/registration.md)."""
SIGMAS = 3.0
"""A place is compared under scales within so many standard deviations of the expected one."""
HALF_STEP = 0.07
"""And half a step of the bank of scales farther."""


@dataclass(frozen=True, eq=False)
class ScaleMap:
    """Log scales (true over reported height) expected over a sheet.

    `values` (H, W): at nodes `step_px` apart, the first at (0, 0), x and y in pixels of level 0.
    `std`: their standard deviation.
    """

    values: NDArray[np.float32]
    step_px: float
    std: float

    def at(self, x_px: float, y_px: float) -> float:
        """The log scale expected at a place; beyond the sheet that of its border."""
        rows, cols = self.values.shape
        row = min(max(round(y_px / self.step_px), 0), rows - 1)
        col = min(max(round(x_px / self.step_px), 0), cols - 1)
        return float(self.values[row, col])

    def over(self, level: int, row: int, col: int, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Log scales expected at the pixels of a window (H, W) of a level."""
        unit = 2.0**level / self.step_px
        matrix = np.array([[unit, 0, col * unit], [0, unit, row * unit]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        made = cv2.warpAffine(
            self.values, matrix, shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(made, np.float32)

    def reach(self, log_scale: float) -> tuple[float, float]:
        """Least and greatest expected log scale of the places where `log_scale` is compared."""
        off = SIGMAS * self.std + HALF_STEP
        return log_scale - off, log_scale + off


@dataclass(frozen=True)
class PosePrior:
    """Expected heading and scale: `turn_rad` (None: unknown), and standard deviations of both.

    `scale_map`: the log scale expected at each place, with a deviation of its own; None where 0 is
    expected everywhere.
    """

    turn_rad: float | None
    turn_std_rad: float
    log_scale_std: float
    scale_map: ScaleMap | None = None

    def cost(self, pose: Pose) -> float:
        """What is subtracted from the score of a pose, by the prior."""
        if self.scale_map is None:
            return NAT_SCORE * self.nats(pose.turn_rad, pose.log_scale)
        own = PosePrior(self.turn_rad, self.turn_std_rad, self.scale_map.std)
        expected = self.scale_map.at(pose.x_px, pose.y_px)
        return NAT_SCORE * own.nats(pose.turn_rad, pose.log_scale - expected)

    def nats(
        self, turn_rad: float, log_scale: float, *, within: tuple[float, float] = (0.0, 0.0)
    ) -> float:
        """Negative log density of a heading and scale, 0 at its peak.

        Where they stand for all `within` (rad, log scale) around, that of the likeliest of those.
        """
        parts = [(log_scale, self.log_scale_std, within[1])]
        if self.turn_rad is not None:
            off = math.remainder(turn_rad - self.turn_rad, 2 * math.pi)
            parts.append((off, self.turn_std_rad, within[0]))
        return sum((max(abs(o) - w, 0.0) / max(std, 0.01)) ** 2 / 2 for o, std, w in parts)
