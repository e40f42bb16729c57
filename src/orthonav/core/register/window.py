"""The pose of a view on the map, what the telemetry expects of it, and windows of the map under it.

The sums over the pixels of both are made by the compiled kernel too. OpenCV rounds positions to
1/32 px, the kernel does not."""

import math
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.template import (
    BLOCKS,
    CHANNELS,
    FINE,
    GROUPS,
    ChannelRecipe,
    Template,
    by_kind,
    channels_of,
    turned_planes,
)


def rotation(turn_rad: float, scale: float = 1.0) -> NDArray[np.float64]:
    """Matrix (2, 2) of a clockwise turn and a scale, for x to the right and y down."""
    cos, sin = scale * math.cos(turn_rad), scale * math.sin(turn_rad)
    return np.array([[cos, -sin], [sin, cos]])


@dataclass(frozen=True)
class Pose:
    """The middle of a view's window on the map, level 0, pixel-is-area, y to the south; heading,
    clockwise, and `log_scale` of true over reported height (and ground resolution)."""

    x_px: float
    y_px: float
    heading_rad: float
    log_scale: float

    @property
    def linear(self) -> NDArray[np.float64]:
        return rotation(self.heading_rad, math.exp(self.log_scale))

    def distance_px(self, other: "Pose") -> float:
        return math.hypot(self.x_px - other.x_px, self.y_px - other.y_px)

    def map_px(self, from_middle_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of points (..., 2) from the middle of the window, level 0."""
        return np.asarray(from_middle_px @ self.linear.T + [self.x_px, self.y_px])

    def stepped(self, step: Sequence[float]) -> "Pose":
        """After the inverse of a small step (dx, dy, turn, log scale) of the window."""
        scale = math.exp(self.log_scale)
        cos, sin = scale * math.cos(self.heading_rad), scale * math.sin(self.heading_rad)
        return Pose(
            self.x_px - (cos * step[0] - sin * step[1]),
            self.y_px - (sin * step[0] + cos * step[1]),
            self.heading_rad - step[2],
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
    0.13, `SearchPlan.coarse_steps`), so that the nearest of its scales is among them."""


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
class DirectionPrior:
    """Expected heading and log scale of a view. `heading_rad`: None: unknown. `scale_map`: None: 0
    is expected everywhere."""

    heading_rad: float | None
    heading_std_rad: float
    log_scale_std: float
    scale_map: ScaleMap | None = None

    def penalty_at(self, pose: Pose) -> float:
        """To be subtracted from the score, whose unit it has (docs/decisions/registration.md)."""
        if self.scale_map is None:
            return self.penalty(pose.heading_rad, pose.log_scale)
        own = DirectionPrior(self.heading_rad, self.heading_std_rad, self.scale_map.std)
        expected = self.scale_map.at(pose.x_px, pose.y_px)
        return own.penalty(pose.heading_rad, pose.log_scale - expected)

    def penalty(
        self, heading_rad: float, log_scale: float, *, within: tuple[float, float] = (0.0, 0.0)
    ) -> float:
        """Negative log density, 0 at its peak; the least `within` (rad, log scale) around."""
        parts = [(log_scale, self.log_scale_std, within[1])]
        if self.heading_rad is not None:
            off = math.remainder(heading_rad - self.heading_rad, 2 * math.pi)
            parts.append((off, self.heading_std_rad, within[0]))
        return sum((max(abs(o) - w, 0.0) / max(std, 0.01)) ** 2 / 2 for o, std, w in parts)


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
        self._shapes = [pyramid.shape(level) for level in range(pyramid.levels)]
        self._whole: OrderedDict[tuple[int, ChannelRecipe], Array] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def levels(self) -> int:
        return self.pyramid.levels

    def shape(self, level: int) -> tuple[int, int]:
        return self._shapes[level]

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
        cos, sin = abs(scale * math.cos(pose.heading_rad)), abs(scale * math.sin(pose.heading_rad))
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
        cos, sin = scale * math.cos(pose.heading_rad), scale * math.sin(pose.heading_rad)
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


def compared(template: Template, planes: Array, valid: Array, slopes: bool = True) -> Sums:
    """Sums of derivatives only with `slopes`. `planes` (3, H, W) of the map become 0 where the map
    or the view does not count."""
    made = Sums.of_row(np.zeros(SUMS))
    if not (template.whole and valid.min() > FULLY_VALID):
        counts = template.mask * (valid > FULLY_VALID)
        planes *= counts
        left = template.mask - counts
        if left.any():
            made.left_pixels[:] = template.block_sums(left)
            view = template.channels * left
            made.left_energies[:] = [float(np.sum(np.square(view[group]))) for group in GROUPS]
            if slopes:
                made.left_slopes[:] = by_kind(template, view)
    for kind, group in enumerate(GROUPS):
        mine, theirs = template.channels[group].reshape(-1), planes[group].reshape(-1)
        made.products[kind], made.energies[kind] = mine @ theirs, theirs @ theirs
    if slopes:
        made.slopes[:] = by_kind(template, planes)
    return made


def sampled_planes(window: MapWindow, pose: Pose) -> tuple[Array, Array]:
    """Channels (3, H, W) of the map as a view shows them, and validity (H, W)."""
    planes = turned_planes(window.sample(pose), -pose.heading_rad)
    return planes[:3], planes[3]
