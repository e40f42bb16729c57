"""A view as templates: its channels at every level of the map that registration uses."""

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.channels import (
    CHANNELS,
    COARSE,
    FINE,
    GREY_SHARE,
    GROUPS,
    ChannelRecipe,
    channel_planes,
)
from orthonav.core.register.kernel import KERNEL

Array = NDArray[np.float32]
BLOCKS = 6  # along one side of a view, in which residuals are taken as one (see `refine`)


@dataclass(frozen=True, eq=False)
class Template:
    """`planes` (4, H, W): channels scaled to the energy of their weight, and 1 where it counts."""

    level: int
    planes: Array
    weights: tuple[float, ...]
    recipe: ChannelRecipe

    @classmethod
    def of(
        cls,
        grey: NDArray[np.uint8],
        valid: NDArray[np.bool_],
        level: int,
        recipe: ChannelRecipe,
        grey_share: float,
    ) -> "Template":
        planes, weights = channel_planes(grey, valid, recipe), (1.0, grey_share)
        for group, weight in zip(GROUPS, weights, strict=True):
            energy = energy_of(planes[group])
            planes[group] *= math.sqrt(weight / energy) if energy > 0 else 0.0
        return cls(level, planes, weights, recipe)

    @property
    def channels(self) -> Array:
        return self.planes[:3]

    @property
    def mask(self) -> Array:
        return np.asarray(self.planes[3], np.float32)

    @cached_property
    def values(self) -> Array:
        return np.asarray(cv2.merge(list(self.planes)), np.float32)

    @cached_property
    def pixels(self) -> float:
        return float(self.mask.sum())

    @cached_property
    def whole(self) -> bool:
        return bool(self.mask.min() > 0)

    @cached_property
    def interleaved(self) -> Array:
        return np.ascontiguousarray(self.values[..., :3])

    @cached_property
    def energies(self) -> NDArray[np.float64]:
        """Sums of squares (G,) of the kinds."""
        return np.array([energy_of(self.channels[group]) for group in GROUPS])

    @cached_property
    def slopes(self) -> Array:
        """Derivatives along x and y (H, W, 8), each of four numbers, the last 0; kernel only."""
        return self._derived[0]

    @cached_property
    def _derived(self) -> tuple[Array, NDArray[np.float64]]:
        """`slopes`, and all numbers of `block_hessians` and `self_slopes`."""
        slopes = np.empty((*self.values.shape[:2], 2 * CHANNELS), np.float32)
        out = np.empty(BLOCKS**2 * len(GROUPS) * 16 + len(GROUPS) * 4)
        KERNEL.derive(self.values, slopes, out)
        return slopes, out

    @cached_property
    def gradients(self) -> Array:
        """Along x and y, per pixel: (3, 2, H, W)."""
        return gradients(self.channels, self.mask)

    @cached_property
    def jacobian(self) -> Array:
        """(3, 4, H, W) by steps x, y (pixels of the level), turn (rad), log scale."""
        return by_steps(self.gradients.swapaxes(0, 1)).swapaxes(0, 1)

    @cached_property
    def hessians(self) -> NDArray[np.float64]:
        """(G, 4, 4)."""
        return np.asarray(self.block_hessians.sum(axis=0))

    @cached_property
    def block_hessians(self) -> NDArray[np.float64]:
        """Of each block, row by row: (B * B, G, 4, 4)."""
        if KERNEL is not None:
            return self._derived[1][: -4 * len(GROUPS)].reshape(BLOCKS**2, len(GROUPS), 4, 4)
        starts = zip(self.block_starts, self.mask.shape, strict=True)
        rows, cols = (np.append(first, side) for first, side in starts)
        return np.stack(
            [
                _products(self.jacobian[:, :, rows[i] : rows[i + 1], cols[j] : cols[j + 1]])
                for i, j in np.ndindex(BLOCKS, BLOCKS)
            ]
        )

    @cached_property
    def self_slopes(self) -> NDArray[np.float64]:
        """Derivatives by the steps times the view itself (G, 4)."""
        if KERNEL is not None:
            return self._derived[1][-4 * len(GROUPS) :].reshape(len(GROUPS), 4)
        return by_kind(self, self.channels)

    @cached_property
    def numbers(self) -> NDArray[np.float64]:
        """For the kernel (`numbers_t` in `_kernel.c`)."""
        parts = (self.pixels, self.energies, self.weights, self.self_slopes, self.hessians)
        blocks = self.block_pixels, self.block_hessians
        return np.concatenate([np.ravel(each).astype(np.float64) for each in (*parts, *blocks)])

    @cached_property
    def block_pixels(self) -> NDArray[np.float64]:
        return self.block_sums(self.mask).astype(np.float64)

    def block_sums(self, values: Array) -> Array:
        """Of values (..., H, W), row by row: (..., B * B)."""
        rows, cols = self.block_starts
        sums = np.add.reduceat(np.add.reduceat(values, rows, axis=-2), cols, axis=-1)
        return np.asarray(sums.reshape(*values.shape[:-2], BLOCKS * BLOCKS))

    @cached_property
    def block_starts(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        return block_starts(self.mask.shape)


def block_starts(shape: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First rows and columns of the blocks of a view (H, W)."""
    rows, cols = ((np.arange(BLOCKS) * side) // BLOCKS for side in shape)
    return rows.astype(np.intp), cols.astype(np.intp)


def by_kind(template: Template, channels: Array) -> NDArray[np.float64]:
    """Derivatives by the steps times channels (3, H, W), summed by kind (G, 4)."""
    parts = zip(template.jacobian, channels, strict=True)
    each = np.array([rows.reshape(4, -1) @ part.reshape(-1) for rows, part in parts])
    return np.array([each[group].sum(axis=0) for group in GROUPS], np.float64)


def _products(jacobian: Array) -> NDArray[np.float64]:
    """(G, 4, 4) of derivatives (3, 4, H, W)."""
    out = np.zeros((len(GROUPS), 4, 4))
    for number, group in enumerate(GROUPS):
        for each in jacobian[group]:
            rows = each.reshape(4, each[0].size)
            out[number] += rows @ rows.T
    return out


def gradients(channels: Array, mask: Array) -> Array:
    """(C, 2, H, W) by x and y, per pixel, 0 beyond the mask."""
    out = np.empty((len(channels), 2, *mask.shape), dtype=np.float32)
    for channel, into in zip(channels, out, strict=True):
        cv2.Sobel(channel, cv2.CV_32F, 1, 0, dst=into[0], scale=1 / 8)
        cv2.Sobel(channel, cv2.CV_32F, 0, 1, dst=into[1], scale=1 / 8)
    out *= mask
    return out


def by_steps(along: Array) -> Array:
    """Of steps along x and y (2, .., H, W): of x, y, turn and log scale (4, .., H, W)."""
    x, y = from_middle(*along.shape[-2:])
    out = np.empty((4, *along.shape[1:]), np.float32)
    out[:2] = along
    np.subtract(along[1] * x, along[0] * y, out=out[2])
    np.add(along[0] * x, along[1] * y, out=out[3])
    return out


def from_middle(height: int, width: int) -> tuple[Array, Array]:
    """x (1, W) and y (H, 1)."""
    x = (np.arange(width, dtype=np.float32) + np.float32(0.5 - width / 2))[None]
    y = (np.arange(height, dtype=np.float32) + np.float32(0.5 - height / 2))[:, None]
    return x, y


def turned_planes(made: Array, turn_rad: float) -> Array:
    """Planes (C, H, W) of channels (H, W, C), edge directions turned clockwise."""
    east, north, *others = cv2.split(made)
    cos, sin = math.cos(2 * turn_rad), math.sin(2 * turn_rad)
    turned = (
        cv2.addWeighted(east, cos, north, -sin, 0),
        cv2.addWeighted(east, sin, north, cos, 0),
    )
    return np.asarray(np.stack([*turned, *others]), np.float32)


def energy_of(values: Array) -> float:
    flat = values.reshape(-1)
    return float(flat @ flat)


@dataclass(frozen=True)
class Levels:
    """Levels of the map at which a view is compared, each half as fine as the next one."""

    coarse: int
    mid: int
    final: int

    @classmethod
    def of(cls, view_px: float, levels: int, *, finer: bool = False) -> "Levels":
        """For a view of `view_px` pixels of level 0 across (root of its area); `finer`: by one
        level, among houses and trees."""
        # At the mid level it is 72 px across (docs/decisions/registration.md).
        mid = max(0, min(round(math.log2(max(view_px, 1.0) / 72.0)) - finer, levels - 1))
        return cls(min(mid + 1, levels - 1), mid, max(mid - 1, 0))

    def recipe(self, level: int) -> ChannelRecipe:
        return COARSE if level > self.mid else FINE


class ViewTemplates:
    """Templates at the levels of a map, made when asked for, of a view at level `finest`."""

    def __init__(
        self,
        grey: NDArray[np.uint8],
        valid: NDArray[np.bool_],
        finest: int,
        grey_share: float = GREY_SHARE,
    ) -> None:
        self.finest, self.grey_share = finest, grey_share
        self._pictures = [(grey, valid)]
        self._made: dict[tuple[int, ChannelRecipe], Template] = {}

    @property
    def valid(self) -> NDArray[np.bool_]:
        return self._pictures[0][1]

    @cached_property
    def side_px(self) -> float:
        """Root of the area, level 0."""
        return math.sqrt(self.at(self.finest).pixels) * 2.0**self.finest

    def at(self, level: int, recipe: ChannelRecipe = FINE) -> Template:
        key = (level, recipe)
        if key not in self._made:
            self._made[key] = Template.of(*self.picture(level), level, recipe, self.grey_share)
        return self._made[key]

    def weighing_grey(self, share: float) -> "ViewTemplates":
        """The same view with another weight of grey beside gradients."""
        if share == self.grey_share:
            return self
        made = ViewTemplates(*self._pictures[0], self.finest, share)
        made._pictures = self._pictures
        return made

    def shape(self, level: int) -> tuple[int, int]:
        rows, cols = self.picture(level)[0].shape
        return rows, cols

    def picture(self, level: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        while len(self._pictures) <= level - self.finest:
            self._pictures.append(halved(*self._pictures[-1]))
        return self._pictures[level - self.finest]


def halved(
    grey: NDArray[np.uint8], valid: NDArray[np.bool_]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The last row or column of an odd number is left out, half a pixel of the finer picture.

    Only above the coarse level, where places are known to more than that."""
    size = grey.shape[1] // 2, grey.shape[0] // 2
    grey, valid = grey[: 2 * size[1], : 2 * size[0]], valid[: 2 * size[1], : 2 * size[0]]
    smaller = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    if valid.all():
        return smaller, np.ones(smaller.shape, np.bool_)
    inside = cv2.resize(valid.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA)
    whole = np.asarray(inside) > 252
    return np.where(whole, smaller, 0).astype(np.uint8), whole
