"""A view as templates: its channels at every level of the map that registration uses.

There are two kinds of channels, made of grey levels, whose errors lie in different places.
*Oriented gradients*: the edge direction doubled, so that contrast may flip between seasons,
weighted by a magnitude that saturates against its surroundings (as CFOG, Ye et al., IEEE TGRS 2019,
but two numbers per pixel instead of a histogram). *Grey*: without local mean and local contrast."""

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.kernel import KERNEL

Array = NDArray[np.float32]
CHANNELS = 4  # cosine and sine of the doubled edge direction, grey, valid
GROUPS = (slice(0, 2), slice(2, 3))
GREY_SHARE, SOUGHT_SHARE = 0.6, 0.3
"""Weight of grey beside gradients where places are compared, and where candidates are sought: less,
for in other light (infrared, night, snow) grey levels mislead (docs/decisions/evidence.md)."""


@dataclass(frozen=True)
class ChannelRecipe:
    """Windows in pixels of the level: `contrast_px` of gradients' surroundings, `mean_px`,
    `deviation_px` of grey."""

    gradient_sigma_px: float = 1.0
    contrast_px: int = 27
    mean_px: int = 11
    deviation_px: int = 21

    @property
    def margin_px(self) -> int:
        return max(self.contrast_px // 2 + 4, self.mean_px // 2 + self.deviation_px // 2 + 1)


FINE = ChannelRecipe()
COARSE = ChannelRecipe(gradient_sigma_px=0.7, contrast_px=17, mean_px=7, deviation_px=17)
"""For views of some 30 pixels across: the same channels from smaller windows."""


def channels_of(
    grey: NDArray[np.uint8], valid: NDArray[np.bool_], recipe: ChannelRecipe = FINE
) -> Array:
    """(H, W, 4), zero where not valid; the last is 1 where valid and not on its border."""
    return np.asarray(cv2.merge(list(channel_planes(grey, valid, recipe))), np.float32)


def channel_planes(
    grey: NDArray[np.uint8], valid: NDArray[np.bool_], recipe: ChannelRecipe
) -> Array:
    """The same as planes (4, H, W)."""
    whole = bool(valid.all())
    if KERNEL is None or grey.size == 0:
        return np.stack(_planes(grey, valid, recipe, whole))
    planes = np.empty((CHANNELS, *grey.shape), np.float32)
    sides = recipe.contrast_px, recipe.mean_px, recipe.deviation_px
    counted = None if whole else np.ascontiguousarray(valid)
    KERNEL.channels(np.ascontiguousarray(grey), counted, (recipe.gradient_sigma_px, *sides), planes)
    return planes


def _planes(
    grey: NDArray[np.uint8], valid: NDArray[np.bool_], recipe: ChannelRecipe, whole: bool
) -> list[Array]:
    picture = np.asarray(grey, dtype=np.float32)
    share = np.ones(grey.shape, np.float32) if whole else valid.astype(np.float32)
    local = _LocalMean(share, whole)
    if not whole:
        picture = np.where(valid, picture, local(picture * share, recipe.deviation_px))
    counts = share
    if not whole:
        reach = 2 * int(np.ceil(2 * recipe.gradient_sigma_px)) + 1
        counts = np.asarray(
            cv2.erode(share, np.ones((reach, reach), np.uint8), borderValue=1.0), np.float32
        )
    east, north = _gradients(picture, counts, local, recipe)
    return [east, north, _grey(picture, share, local, recipe) * counts, counts]


class _LocalMean:
    """Mean over the valid pixels of a square around each pixel."""

    def __init__(self, share: Array, whole: bool) -> None:
        self._share, self._whole = share, whole
        self._counts: dict[int, Array] = {}

    def __call__(self, values: Array, side_px: int) -> Array:
        mean = _box(values, side_px)
        if self._whole:
            return mean
        if side_px not in self._counts:
            self._counts[side_px] = np.maximum(_box(self._share, side_px), np.float32(1e-3))
        return np.asarray(mean / self._counts[side_px])


def _box(values: Array, side_px: int) -> Array:
    side_px = min(side_px, 2 * min(values.shape) - 1)  # reflection reaches no farther
    return np.asarray(cv2.blur(values, (side_px, side_px)), dtype=np.float32)


def _gradients(
    picture: Array, counts: Array, local: _LocalMean, recipe: ChannelRecipe
) -> tuple[Array, Array]:
    """Doubled direction times saturated magnitude: cosine and sine (H, W)."""
    smooth = cv2.GaussianBlur(picture, (0, 0), recipe.gradient_sigma_px)
    east: Array = np.asarray(cv2.Scharr(smooth, cv2.CV_32F, 1, 0, scale=1 / 32), np.float32)
    south: Array = np.asarray(cv2.Scharr(smooth, cv2.CV_32F, 0, 1, scale=1 / 32), np.float32)
    square, product = east * east, east * south
    south *= south
    power = square + south
    square -= south
    magnitude = np.sqrt(power) * counts
    # |g|^2 / (|g| + surroundings) / |g|^2: direction times |g| / (|g| + surroundings). Gradients
    # below 0.5 are noise of an 8-bit picture.
    weight = magnitude / (
        (magnitude + local(magnitude, recipe.contrast_px) + np.float32(0.5))
        * (power + np.float32(1e-6))
    )
    product *= 2
    return np.asarray(square * weight), np.asarray(product * weight)


def _grey(picture: Array, share: Array, local: _LocalMean, recipe: ChannelRecipe) -> Array:
    """Without local mean, divided by the local deviation."""
    rest = (picture - local(picture * share, recipe.mean_px)) * share
    # Running sums of a box filter may fall a little below zero.
    power = np.maximum(local(rest * rest, recipe.deviation_px), 0)
    deviation = np.sqrt(power) + np.float32(2.0)  # less is noise of an 8-bit picture
    return np.asarray(np.clip(rest / deviation, -3.0, 3.0), dtype=np.float32)


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

    def template(self, templates: "ViewTemplates", level: int) -> Template:
        """Of a view at a level, by its recipe."""
        return templates.at(level, self.recipe(level))


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
