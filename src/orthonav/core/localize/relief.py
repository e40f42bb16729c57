"""The ground of a sheet as it is: its heights, and the scale at which each place would be seen."""

import math
from dataclasses import replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.prepared import MIN_AGL_STD, PreparedView
from orthonav.core.records import DEFAULT_AGL_STD
from orthonav.core.register.pose import SIGMAS, ScaleMap
from orthonav.core.register.registrar import PosePrior

MAP_NODES = 256
"""Nodes across the map of expected scales, at most."""
SLOPE_M = 10.0
"""Slopes are those over twice this distance."""
LARGEST_STD = 0.3
"""Largest standard deviation of the scales searched: three are scales of 0.41 to 2.46."""
Array = NDArray[np.float64]


class Terrain(Protocol):
    """Heights of the ground."""

    def at_en_m(self, points_en_m: ArrayLike) -> Array:
        """Heights (...) above sea level at points (..., 2), metres east and north; NaN where
        unknown."""


class LevelTerrain:
    """Ground of one height, 0: that of maps without a terrain."""

    def at_en_m(self, points_en_m: ArrayLike) -> Array:
        """Zeros (...) at points (..., 2)."""
        return np.zeros(np.shape(points_en_m)[:-1])


class Relief:
    """The ground of a sheet, for all views. Safe to share between threads."""

    def __init__(self, terrain: Terrain, grid: TileGrid) -> None:
        self.terrain, self.grid = terrain, grid
        self._means: dict[int, tuple[NDArray[np.float32], float]] = {}

    @property
    def is_level(self) -> bool:
        """Whether the ground is level, as without a terrain."""
        return isinstance(self.terrain, LevelTerrain)

    def en_m(self, map_px: Array) -> Array:
        """Metres east and north (..., 2) of map coordinates at level 0."""
        corner = np.array([self.grid.west_m, self.grid.north_m])
        return np.asarray(corner + map_px * [self.grid.gsd_m, -self.grid.gsd_m])

    def ground_m(self, map_px: Array) -> Array:
        """Ground points (..., 3) east, north, above sea at map coordinates; NaN where unknown."""
        points = self.en_m(map_px)
        return np.concatenate([points, self.terrain.at_en_m(points)[..., None]], axis=-1)

    def slopes(self, ground_m: Array) -> Array:
        """Rise (N, 2) per metre east and north at ground points (N, 3)."""
        out = np.empty((len(ground_m), 2))
        for axis in range(2):
            step = np.zeros(2)
            step[axis] = SLOPE_M
            ahead, behind = (
                self.terrain.at_en_m(ground_m[:, :2] + sign * step) for sign in (1, -1)
            )
            out[:, axis] = (ahead - behind) / (2 * SLOPE_M)
        return out

    def expected(self, view: PreparedView) -> PosePrior:
        """The prior of a view with the scale expected at each place, by its height above sea."""
        telemetry, prior = view.picture_at(view.levels.final).telemetry, view.prior
        below, agl_m = telemetry.below, telemetry.agl_m
        if below is None:
            return prior
        own_m = DEFAULT_AGL_STD * agl_m
        if telemetry.agl_std_m is not None:
            own_m = math.sqrt(max(telemetry.agl_std_m**2 - below.std_m**2, 0.0))
        means, step_px = self._mean_heights(view.side_px)
        over = np.maximum(1 + (below.height_m - means) / agl_m, 0.05)
        values = np.log(np.where(np.isfinite(over), over, 1.0)).astype(np.float32)
        focal_std = view.picture_at(view.levels.final).camera.focal_std
        std = max(math.hypot(own_m / agl_m, focal_std), MIN_AGL_STD)
        reach = min(float(np.abs(values).max()) + SIGMAS * std, SIGMAS * prior.log_scale_std)
        if below.std_m / agl_m > std:
            reach = float(np.abs(values).max()) + SIGMAS * std
        widest = min(reach / SIGMAS, LARGEST_STD)
        return replace(
            prior,
            log_scale_std=max(widest, MIN_AGL_STD),
            scale_map=ScaleMap(values, step_px, min(std, prior.log_scale_std)),
        )

    def _mean_heights(self, side_px: float) -> tuple[NDArray[np.float32], float]:
        """Mean heights of the ground under windows of about a side at nodes over the sheet, and
        the distance of these in pixels of level 0."""
        key = round(math.log2(max(side_px, 1.0)))
        if key not in self._means:
            size = self.grid.width_px, self.grid.height_px
            step = max(max(size) / MAP_NODES, 2.0**key / 4)
            x, y = (np.arange(0.0, side + step, step) for side in size)
            heights = self.ground_m(np.stack(np.meshgrid(x, y), -1))[..., 2]
            known = np.isfinite(heights).astype(np.float32)
            box = (max(round(2.0**key / step), 1),) * 2
            border = cv2.BORDER_REPLICATE
            share = cv2.blur(known, box, borderType=border)
            total = cv2.blur(
                np.nan_to_num(heights).astype(np.float32) * known, box, borderType=border
            )
            with np.errstate(invalid="ignore", divide="ignore"):
                self._means[key] = np.asarray(total / share, np.float32), step
        return self._means[key]
