"""Windows of the map, sampled under the pose of a view, and the sums over the pixels of both.

The compiled kernel makes the same sums. OpenCV rounds positions to 1/32 px, the kernel does not."""

import math
import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.channels import CHANNELS, FINE, GROUPS, ChannelRecipe, channels_of
from orthonav.core.register.pose import Pose
from orthonav.core.register.template import BLOCKS, Template, by_kind, turned_planes

Array = NDArray[np.float32]
MAX_SIDE_PX = 32768  # that the kernel and OpenCV sample


class GreyPyramid(Protocol):
    """Grey levels of one sheet, each level half as fine as the one before."""

    levels: int

    def shape(self, level: int) -> tuple[int, int]: ...

    def read(
        self, level: int, row: int, col: int, height: int, width: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Grey and valid of a window, which may reach beyond the sheet."""
        ...


class Reference:
    """Channels of one sheet; threads may share it."""

    def __init__(self, pyramid: GreyPyramid) -> None:
        self.pyramid = pyramid
        self._whole: OrderedDict[tuple[int, ChannelRecipe], Array] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def levels(self) -> int:
        return self.pyramid.levels

    def shape(self, level: int) -> tuple[int, int]:
        return self.pyramid.shape(level)

    def caches(self, level: int) -> bool:
        """Smaller levels are made ready whole, once (16 bytes each pixel)."""
        shape = self.shape(level)
        return math.prod(shape) <= 2_000_000 and max(shape) <= MAX_SIDE_PX

    def whole(self, level: int, recipe: ChannelRecipe = FINE) -> Array:
        """Once."""
        with self._lock:
            key = (level, recipe)
            if key not in self._whole:
                made = channels_of(*self.pyramid.read(level, 0, 0, *self.shape(level)), recipe)
                made.flags.writeable = False
                self._whole[key] = made
            return self._whole[key]

    def window(
        self, level: int, row: int, col: int, height: int, width: int, recipe: ChannelRecipe = FINE
    ) -> Array:
        """(height, width, 4); zero beyond the sheet."""
        rows, cols = self.shape(level)
        if self.caches(level):
            return cut(self.whole(level, recipe), row, col, height, width)
        # No more than the sheet: a window beyond it costs nothing.
        margin = recipe.margin_px
        top, left = max(row - margin, 0), max(col - margin, 0)
        bottom, right = min(row + height + margin, rows), min(col + width + margin, cols)
        if top >= bottom or left >= right:
            return np.zeros((height, width, CHANNELS), np.float32)
        grey, valid = self.pyramid.read(level, top, left, bottom - top, right - left)
        return cut(channels_of(grey, valid, recipe), row - top, col - left, height, width)


def cut(whole: Array, row: int, col: int, height: int, width: int) -> Array:
    """Zero beyond the array. A view where possible."""
    rows, cols = whole.shape[:2]
    y0, x0, y1, x1 = max(row, 0), max(col, 0), min(row + height, rows), min(col + width, cols)
    if (y0, x0, y1, x1) == (row, col, row + height, col + width):
        return whole[y0:y1, x0:x1]
    out = np.zeros((height, width, whole.shape[2]), np.float32)
    if y0 < y1 and x0 < x1:
        out[y0 - row : y1 - row, x0 - col : x1 - col] = whole[y0:y1, x0:x1]
    return out


@dataclass(frozen=True, eq=False)
class MapWindow:
    """Channels (R, C, 4) of a level, from (`row`, `col`), for windows (H, W) near a pose."""

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
        """Around the window of a view, larger by `margins` (rows, columns) on each side.

        `slack_px`: how far the pose may still move. The whole level where that is cached."""
        rows, cols = template.mask.shape
        height, width = rows + 2 * margins[0], cols + 2 * margins[1]
        unit = 2.0**template.level
        if reference.caches(template.level):
            whole = reference.whole(template.level, template.recipe)
            return cls(whole, 0, 0, unit, (height, width))
        # Beyond 1, more than twice what is searched, the map counts as missing.
        scale = math.exp(min(pose.log_scale, 1.0)) / 2
        cos, sin = abs(scale * math.cos(pose.turn_rad)), abs(scale * math.sin(pose.turn_rad))
        x, half_x = pose.x_px / unit, cos * width + sin * height
        y, half_y = pose.y_px / unit, sin * width + cos * height
        row, col = math.floor(y - half_y) - slack_px, math.floor(x - half_x) - slack_px
        bottom, right = math.ceil(y + half_y) + slack_px, math.ceil(x + half_x) + slack_px
        made = reference.window(
            template.level, row, col, bottom - row, right - col, template.recipe
        )
        return cls(made, row, col, unit, (height, width))

    def sample(self, pose: Pose) -> Array:
        """Channels (H, W, 4) of the window at a pose."""
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        matrix = np.reshape(self.matrix(pose), (2, 3))
        sampled = cv2.warpAffine(self.made, matrix, self.shape[::-1], flags=flags)
        return np.asarray(sampled, np.float32)

    def matrix(self, pose: Pose) -> tuple[float, ...]:
        """(2, 3), row by row, from pixels of the window to those of `made`, from pixel centres."""
        height, width = self.shape
        scale = math.exp(pose.log_scale)
        cos, sin = scale * math.cos(pose.turn_rad), scale * math.sin(pose.turn_rad)
        # Pixel-is-area to pixel centres: source and target are both half a pixel off.
        x, y = (width - 1) / 2, (height - 1) / 2
        column = pose.x_px / self.unit - self.col - 0.5 - cos * x + sin * y
        row = pose.y_px / self.unit - self.row - 0.5 - sin * x - cos * y
        return cos, -sin, column, sin, cos, row


FULLY_VALID = 0.99  # A pixel counts where the sampled map is valid by more


class Sums(NamedTuple):
    """Over the pixels of a view that count and see valid map, by kind of channel: view times map,
    map squared, derivatives times map; `left`: over its pixels that see no valid map, by block."""

    products: NDArray[np.float64]
    energies: NDArray[np.float64]
    left_energies: NDArray[np.float64]
    slopes: NDArray[np.float64]
    left_slopes: NDArray[np.float64]
    left_pixels: NDArray[np.float64]

    @classmethod
    def of_row(cls, row: NDArray[np.float64]) -> "Sums":
        slopes, left_slopes = row[6:14].reshape(2, 4), row[14:22].reshape(2, 4)
        return cls(row[:2], row[2:4], row[4:6], slopes, left_slopes, row[22:])


SUMS = 22 + BLOCKS**2


def compared(template: Template, seen: Array, valid: Array, slopes: bool = True) -> Sums:
    """Sums of derivatives only with `slopes`. `seen` becomes 0 where view or map does not count."""
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


def sampled_planes(window: MapWindow, pose: Pose) -> tuple[Array, Array]:
    """Channels (3, H, W) of the map as a view shows them, and validity (H, W)."""
    planes = turned_planes(window.sample(pose), -pose.turn_rad)
    return planes[:3], planes[3]
