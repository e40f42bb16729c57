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
    """The middle of a view's window on the map, level 0, pixel-is-area, y to the south; heading,
    clockwise, and `log_scale` of true over reported height (and ground resolution)."""

    x_px: float
    y_px: float
    turn_rad: float
    log_scale: float

    @property
    def linear(self) -> Array:
        return rotation(self.turn_rad, math.exp(self.log_scale))

    def distance_px(self, other: "Pose") -> float:
        return math.hypot(self.x_px - other.x_px, self.y_px - other.y_px)

    def map_px(self, from_middle_px: Array) -> Array:
        """Of points (..., 2) from the middle of the window, level 0."""
        return np.asarray(from_middle_px @ self.linear.T + [self.x_px, self.y_px])

    def stepped(self, step: Sequence[float]) -> "Pose":
        """After the inverse of a small step (dx, dy, turn, log scale) of the window."""
        scale = math.exp(self.log_scale)
        cos, sin = scale * math.cos(self.turn_rad), scale * math.sin(self.turn_rad)
        return Pose(
            self.x_px - (cos * step[0] - sin * step[1]),
            self.y_px - (sin * step[0] + cos * step[1]),
            self.turn_rad - step[2],
            self.log_scale - step[3],
        )


def even_scale(log_scale: float) -> float:
    """Makes scores of chance alike at any scale: a magnified view touches more pixels without more
    information, and chance grows with about the root of the scale (docs/decisions/registration.md).
    """
    return math.exp(log_scale / 2)


@dataclass(frozen=True)
class ComparedScales:
    """Which scales of a bank are compared at a place: those near the scale expected there."""

    sigmas: float = 3.0  # in standard deviations of the expected log scale,
    step: float = 0.14
    """and half of this farther: rounded up from the largest step of a bank on terrain (log scale
    0.13, `policy.SearchPlan.coarse_steps`), so that the nearest of its scales is among them."""


COMPARED = ComparedScales()


@dataclass(frozen=True, eq=False)
class ScaleMap:
    """Log scales (true over reported height) at nodes (H, W), `step_px` of level 0 apart."""

    values: NDArray[np.float32]
    step_px: float
    std: float

    def at(self, x_px: float, y_px: float) -> float:
        """Beyond the sheet that of its border."""
        rows, cols = self.values.shape
        row = min(max(round(y_px / self.step_px), 0), rows - 1)
        col = min(max(round(x_px / self.step_px), 0), cols - 1)
        return float(self.values[row, col])

    def over(self, level: int, row: int, col: int, shape: tuple[int, int]) -> NDArray[np.float32]:
        unit = 2.0**level / self.step_px
        matrix = np.array([[unit, 0, col * unit], [0, unit, row * unit]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        made = cv2.warpAffine(
            self.values, matrix, shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(made, np.float32)

    def reach(self, log_scale: float) -> tuple[float, float]:
        """Least and greatest expected log scale of the places where `log_scale` is compared."""
        off = COMPARED.sigmas * self.std + COMPARED.step / 2
        return log_scale - off, log_scale + off


@dataclass(frozen=True)
class PosePrior:
    """`turn_rad`: None: unknown. `scale_map`: None: 0 is expected everywhere."""

    turn_rad: float | None
    turn_std_rad: float
    log_scale_std: float
    scale_map: ScaleMap | None = None

    def cost(self, pose: Pose) -> float:
        """Units of the score: one per nat (docs/decisions/registration.md)."""
        if self.scale_map is None:
            return self.negative_log_density(pose.turn_rad, pose.log_scale)
        own = PosePrior(self.turn_rad, self.turn_std_rad, self.scale_map.std)
        expected = self.scale_map.at(pose.x_px, pose.y_px)
        return own.negative_log_density(pose.turn_rad, pose.log_scale - expected)

    def negative_log_density(
        self, turn_rad: float, log_scale: float, *, within: tuple[float, float] = (0.0, 0.0)
    ) -> float:
        """In nats, 0 at its peak; the least `within` (rad, log scale) around."""
        parts = [(log_scale, self.log_scale_std, within[1])]
        if self.turn_rad is not None:
            off = math.remainder(turn_rad - self.turn_rad, 2 * math.pi)
            parts.append((off, self.turn_std_rad, within[0]))
        return sum((max(abs(o) - w, 0.0) / max(std, 0.01)) ** 2 / 2 for o, std, w in parts)
