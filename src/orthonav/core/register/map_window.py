"""The part of the map under a view, sampled as the view's window shows it."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.pose import Pose
from orthonav.core.register.reference import Reference
from orthonav.core.register.template import Template

Array = NDArray[np.float32]
LARGEST_LOG_SCALE = 1.0
"""A window reaches no farther than under this log scale: more than twice what is searched. Beyond
it the map counts as missing, whatever a computed pose asks for."""


@dataclass(frozen=True, eq=False)
class MapWindow:
    """Evidence (R, C, 4) of the map at a level, for windows of `shape` (H, W) near a pose.

    (`row`, `col`) is its first pixel on that level of the sheet; `unit` pixels of level 0 are one
    of the level.
    """

    made: Array
    row: int
    col: int
    unit: float
    shape: tuple[int, int]

    @classmethod
    def of(
        cls,
        template: Template,
        reference: Reference,
        pose: Pose,
        slack_px: int,
        margins: tuple[int, int] = (0, 0),
    ) -> "MapWindow":
        """Around the window of a view at a pose, larger by `margins` (rows, columns) on each side.

        `slack_px`: how far the pose may still move, pixels of the level. The whole level where that
        is cached.
        """
        rows, cols = template.mask.shape
        height, width = rows + 2 * margins[0], cols + 2 * margins[1]
        unit = 2.0**template.level
        if reference.caches(template.level):
            whole = reference.whole(template.level, template.recipe)
            return cls(whole, 0, 0, unit, (height, width))
        scale = math.exp(min(pose.log_scale, LARGEST_LOG_SCALE)) / 2
        cos, sin = abs(scale * math.cos(pose.turn_rad)), abs(scale * math.sin(pose.turn_rad))
        x, half_x = pose.x_px / unit, cos * width + sin * height
        y, half_y = pose.y_px / unit, sin * width + cos * height
        row, col = math.floor(y - half_y) - slack_px, math.floor(x - half_x) - slack_px
        bottom, right = math.ceil(y + half_y) + slack_px, math.ceil(x + half_x) + slack_px
        made = reference.window(
            template.level, row, col, bottom - row, right - col, template.recipe
        )
        return cls(made, row, col, unit, (height, width))

    def sample(self, pose: Pose, into: Array) -> None:
        """Evidence (H, W, 4) of the map as the window shows it under a pose."""
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        matrix = np.reshape(self.matrix(pose), (2, 3))
        cv2.warpAffine(self.made, matrix, self.shape[::-1], dst=into, flags=flags)

    def matrix(self, pose: Pose) -> tuple[float, ...]:
        """Numbers (6,) of the matrix (2, 3) from the window's pixels to those of `made` under a
        pose, both counted from pixel centres, row by row."""
        height, width = self.shape
        scale = math.exp(pose.log_scale)
        cos, sin = scale * math.cos(pose.turn_rad), scale * math.sin(pose.turn_rad)
        # Pixel-is-area to pixel centres: source and target are both half a pixel off.
        x, y = (width - 1) / 2, (height - 1) / 2
        column = pose.x_px / self.unit - self.col - 0.5 - cos * x + sin * y
        row = pose.y_px / self.unit - self.row - 0.5 - sin * x - cos * y
        return cos, -sin, column, sin, cos, row
