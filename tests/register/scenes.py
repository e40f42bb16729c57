"""A ground known at every point, maps of it, and views cut from it without any warping."""

import math

import numpy as np

from orthonav.core.register.template import ViewTemplates
from orthonav.core.register.window import Pose, Reference


class Ground:
    """Grey levels of a ground that is smooth, random and unlike itself everywhere.

    `x` and `y` are pixels of level 0 of the map, `y` to the south. It is a sum of waves, so no
    picture has to be resampled to see it from anywhere. The waves run within `spread_rad` of x.
    """

    def __init__(self, seed=0, waves=90, px=(7.0, 70.0), contrast=24.0, spread_rad=math.pi):
        rng = np.random.default_rng(seed)
        length_px = np.exp(rng.uniform(math.log(px[0]), math.log(px[1]), waves))
        direction = rng.uniform(-spread_rad, spread_rad, waves)
        self._kx = (2 * np.pi / length_px * np.cos(direction)).astype(np.float32)
        self._ky = (2 * np.pi / length_px * np.sin(direction)).astype(np.float32)
        self._phase = rng.uniform(0, 2 * np.pi, waves).astype(np.float32)
        self._size = contrast * math.sqrt(2 / waves)

    def __call__(self, x, y):
        x, y = np.broadcast_arrays(np.float32(x), np.float32(y))
        total = np.zeros(x.shape, np.float32)
        for kx, ky, phase in zip(self._kx, self._ky, self._phase, strict=True):
            total += np.sin(kx * x + ky * y + phase)
        return 128 + self._size * total


def as_grey(values):
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8)


def pixel_centres(shape):
    """x and y of the pixel centres of a picture (H, W), pixel-is-area."""
    return np.arange(shape[1])[None] + 0.5, np.arange(shape[0])[:, None] + 0.5


def seen(ground, pose, shape):
    """Values (H, W) of the ground under a window at a pose, one pixel of level 0 to a pixel.

    Written out independently: the top of the window points to `heading_rad`, clockwise from north.
    """
    x, y = pixel_centres(shape)
    scale = math.exp(pose.log_scale)
    right, down = (x - shape[1] / 2) * scale, (y - shape[0] / 2) * scale
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    return ground(pose.x_px + cos * right - sin * down, pose.y_px + sin * right + cos * down)


class Sheet:
    """A grey pyramid in memory. Sides are whole multiples of the coarsest pixel."""

    def __init__(self, grey, valid=None, levels=3):
        valid = np.ones(grey.shape, bool) if valid is None else valid
        self.levels = levels
        self._pictures = [(np.where(valid, grey, 0).astype(np.uint8), valid)]
        for _ in range(levels - 1):
            grey, valid = self._pictures[-1]
            fours = grey.reshape(grey.shape[0] // 2, 2, grey.shape[1] // 2, 2)
            whole = valid.reshape(fours.shape).all(axis=(1, 3))
            mean = np.rint(fours.mean(axis=(1, 3))).astype(np.uint8)
            self._pictures.append((np.where(whole, mean, 0).astype(np.uint8), whole))

    def shape(self, level):
        return self._pictures[level][0].shape

    def read(self, level, row, col, height, width):
        grey, valid = self._pictures[level]
        out, inside = np.zeros((height, width), np.uint8), np.zeros((height, width), bool)
        rows, cols = grey.shape
        top, bottom = max(row, 0), min(row + height, rows)
        left, right = max(col, 0), min(col + width, cols)
        if top < bottom and left < right:
            target = np.s_[top - row : bottom - row, left - col : right - col]
            out[target] = grey[top:bottom, left:right]
            inside[target] = valid[top:bottom, left:right]
        return out, inside


def sheet_of(ground, shape=(384, 448), valid=None, levels=3):
    return Sheet(as_grey(ground(*pixel_centres(shape))), valid, levels)


def reference_of(ground, shape=(384, 448), valid=None, levels=3):
    return Reference(sheet_of(ground, shape, valid, levels))


def templates_of(ground, pose, shape=(96, 128), valid=None):
    """The view of a ground at a pose, made ready."""
    valid = np.ones(shape, bool) if valid is None else valid
    return ViewTemplates(np.where(valid, as_grey(seen(ground, pose, shape)), 0), valid, 0)


def random_poses(count, shape, reach_px, seed=0, log_scale=0.0):
    """Poses anywhere on a map at least `reach_px` from its border, under any heading."""
    rng = np.random.default_rng(seed)
    return [
        Pose(
            rng.uniform(reach_px, shape[1] - reach_px),
            rng.uniform(reach_px, shape[0] - reach_px),
            rng.uniform(-math.pi, math.pi),
            rng.uniform(-log_scale, log_scale),
        )
        for _ in range(count)
    ]


def apart_px(one, other):
    return math.hypot(one.x_px - other.x_px, one.y_px - other.y_px)


def turned_rad(one, other):
    """How much further one pose is turned than another, -pi to pi."""
    return math.remainder(one.heading_rad - other.heading_rad, 2 * math.pi)
