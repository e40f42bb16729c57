"""The part of the map under a view, sampled as the view's window shows it."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.register.pose import Pose
from orthonav.register.reference import Reference
from orthonav.register.template import Template

Array = NDArray[np.float32]


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

        `slack_px`: how far the pose may still move, pixels of the level.
        """
        rows, cols = template.mask.shape
        height, width = rows + 2 * margins[0], cols + 2 * margins[1]
        unit = 2.0**template.level
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, height / 2]
        at = pose.map_px(corners * unit) / unit
        low, high = np.floor(at.min(axis=0)) - slack_px, np.ceil(at.max(axis=0)) + slack_px
        col, row = int(low[0]), int(low[1])
        size = (high - low).astype(int)
        made = reference.window(
            template.level, row, col, int(size[1]), int(size[0]), template.recipe
        )
        return cls(made, row, col, unit, (height, width))

    def sample(self, pose: Pose, into: Array) -> None:
        """Evidence (H, W, 4) of the map as the window shows it under a pose."""
        height, width = self.shape
        linear = pose.linear
        middle = np.array([pose.x_px, pose.y_px]) / self.unit - [self.col, self.row]
        move = middle - linear @ [width / 2, height / 2]
        # Pixel-is-area to pixel centres: source and target are both half a pixel off.
        move = move + linear @ [0.5, 0.5] - 0.5
        matrix = np.column_stack([linear, move])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        cv2.warpAffine(self.made, matrix, (width, height), dst=into, flags=flags)
