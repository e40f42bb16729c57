"""Registering a view on the ground as it is, at candidates that were found on level ground.

The pose of a candidate says where the middle of the view's window lies, its heading, and that the
camera is `agl_m * exp(log_scale)` above the mean ground of that window. The view is orthorectified
on the terrain under that pose and registered again, until it stays where it is.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.geo.grid import TileGrid
from orthonav.localizer.orthorectify import Orientation, node_px, orthorectified
from orthonav.localizer.prepared import MIN_AGL_STD, PreparedView
from orthonav.mapfile.terrain import TerrainLayer
from orthonav.records import DEFAULT_AGL_STD
from orthonav.register.pose import Pose
from orthonav.register.refine import Placed
from orthonav.register.registrar import (
    EXCLUSION_SHARE,
    FULL_STEPS,
    ROUGH_STEP_PX,
    Finished,
    PosePrior,
    Registered,
    Registrar,
)
from orthonav.register.scale_map import SIGMAS, ScaleMap
from orthonav.register.template import ViewTemplates

REFERENCE_NODES = 9
"""Nodes across and down a window whose mean height is its reference."""
MIN_KNOWN = 0.5
"""Windows of which less is known are registered on level ground."""
LEVEL_PX = 0.2
"""Relief that displaces no ground of a window by more (pixels of the final level) is left out."""
RIVAL_SHARE = 0.75
"""Candidates whose score on the terrain at the judged level is below this share of the best one are
finished on level ground: what fits by chance fits as well there, and it costs half."""
AGAIN_PX = 1.0
"""A window that moved by more (pixels of the level, at its rim) is orthorectified again."""
ROUNDS = 3
"""At most so many times at the final level."""
MAP_NODES = 256
"""Nodes across the map of expected scales, at most."""
LARGEST_STD = 0.3
"""Largest standard deviation of the scales searched: three are scales of 0.41 to 2.46."""
Array = NDArray[np.float64]


class Relief:
    """The ground of a sheet, for all views. Safe to share between threads."""

    def __init__(self, terrain: TerrainLayer, grid: TileGrid) -> None:
        self.terrain, self.grid = terrain, grid
        self._means: dict[int, tuple[NDArray[np.float32], float]] = {}

    def en_m(self, map_px: Array) -> Array:
        """Metres east and north (..., 2) of map coordinates at level 0."""
        corner = np.array([self.grid.west_m, self.grid.north_m])
        return np.asarray(corner + map_px * [self.grid.gsd_m, -self.grid.gsd_m])

    def ground_m(self, map_px: Array) -> Array:
        """Ground points (..., 3) east, north, above sea at map coordinates; NaN where unknown."""
        points = self.en_m(map_px)
        return np.concatenate([points, self.terrain.at_en_m(points)[..., None]], axis=-1)

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
        std = max(own_m / agl_m, MIN_AGL_STD)
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


@dataclass(frozen=True, eq=False)
class _Placed:
    """A candidate on the terrain: its `templates`, and the score at the judged level over that on
    level ground."""

    made: Finished
    gain: float


@dataclass(frozen=True)
class GroundSeen:
    """What a fix says of the ground: `middle_en_m`, that of the ground seen, metres east and north;
    `gain`, score on the terrain over that on level ground, 1 where it was placed on level ground.
    """

    middle_en_m: tuple[float, float]
    gain: float


class ViewOnLevelGround:
    """One view on level ground."""

    def __init__(self, registrar: Registrar, view: PreparedView) -> None:
        self.registrar, self.view = registrar, view
        self._finer: ViewTemplates | None = None

    def finish(self, judged: Placed) -> Finished:
        """A judged candidate at the final level."""
        return self.registrar.at_final(self.view.templates, self.view.levels, judged)

    def looked_again(self, judged: list[Placed]) -> list[Placed]:
        """Judged candidates after all searches, where none of them stands out."""
        return judged

    def templates_of(self, placed: Placed) -> ViewTemplates:
        """The templates by which a finalist was placed."""
        return self.view.templates

    def finer(self, placed: Placed) -> ViewTemplates:
        """The templates of a finalist one level finer than the final one."""
        if self._finer is None:
            level = self.view.levels.final - 1
            made = self.view.rectified_at(level)
            self._finer = ViewTemplates(made.grey, made.valid, level)
        return self._finer

    def by_camera(self, found: Registered) -> tuple[Registered, GroundSeen | None]:
        """The places found, as poses of the view on level ground below the camera."""
        return found, None


class ViewOverRelief(ViewOnLevelGround):
    """One view on the ground of a sheet. Not to be shared between threads."""

    def __init__(self, relief: Relief, registrar: Registrar, view: PreparedView) -> None:
        super().__init__(registrar, view)
        self.relief = relief
        self._found: dict[Pose, _Placed] = {}
        self._best_look = 0.0
        self._level_scores: dict[Pose, float] = {}
        valid = view.templates.valid
        rows, cols = (
            (np.arange(REFERENCE_NODES) + 0.5) * side / REFERENCE_NODES for side in valid.shape
        )
        used = valid[np.ix_(rows.astype(int), cols.astype(int))]
        x, y = np.meshgrid(cols - valid.shape[1] / 2, rows - valid.shape[0] / 2)
        nodes = np.stack([x, y], axis=-1) * 2.0**view.levels.final
        self._reference_px = nodes[used] if used.any() else nodes.reshape(-1, 2)

    def finish(self, judged: Placed) -> Finished:
        """A judged candidate at the final level: on the terrain, or on level ground where that is
        as good, or where less than half of the ground is known."""
        levels = self.view.levels
        made = None
        if not self._is_level(judged.pose):
            made = self.templates_at(judged.pose, levels.look)
        if made is None:
            return super().finish(judged)
        refiner = self.registrar.refiner(made, levels, levels.look)
        first = refiner.place(judged.pose, FULL_STEPS, ROUGH_STEP_PX)
        if first.score < RIVAL_SHARE * self._best_look:
            return super().finish(judged)
        self._best_look = max(self._best_look, first.score)
        found = self._placed(first.pose)
        if found is None or found.look is None:
            return super().finish(judged)
        on_level = self._level_scores.get(judged.pose, judged.score)
        if found.look < on_level:
            level = super().finish(judged)
            if level.total > found.total:
                return level
        self._found[found.placed.pose] = _Placed(found, found.look / max(on_level, 1e-6))
        return found

    def looked_again(self, judged: list[Placed]) -> list[Placed]:
        """All judged candidates on the terrain, at the judged level: where relief displaces much,
        the right one may be far down the list of those on level ground."""
        levels, out = self.view.levels, []
        for each in judged:
            made = None if self._is_level(each.pose) else self.templates_at(each.pose, levels.look)
            if made is None:
                out.append(each)
                continue
            refiner = self.registrar.refiner(made, levels, levels.look)
            placed = refiner.place(each.pose, FULL_STEPS, ROUGH_STEP_PX)
            if placed.score <= each.score:
                out.append(each)
                continue
            self._level_scores[placed.pose] = each.score
            out.append(placed)
        return out

    def _is_level(self, pose: Pose) -> bool:
        """Whether relief displaces no ground of the window by a visible amount."""
        ground = self.relief.ground_m(pose.map_px(self._reference_px))
        orientation = self.orientation(pose)
        if orientation is None or not np.isfinite(ground).all():
            return False
        offset = ground - orientation.position_m
        rise = np.abs(ground[:, 2] - ground[:, 2].mean())
        shift_m = rise * np.hypot(offset[:, 0], offset[:, 1]) / np.maximum(-offset[:, 2], 1.0)
        pixel_m = self.relief.grid.gsd_m * 2.0**self.view.levels.final
        return bool(shift_m.max() < LEVEL_PX * pixel_m)

    def _placed(self, pose: Pose) -> Finished | None:
        """A candidate refined on the terrain; None where too little of it is known."""
        levels, registrar = self.view.levels, self.registrar
        for _ in range(ROUNDS):
            seen = self.templates_at(pose, levels.final)
            if seen is None:
                return None
            made = seen
            refiner = registrar.refiner(made, levels, levels.final)
            placed = refiner.place(pose, FULL_STEPS, ROUGH_STEP_PX)
            if self._moved_px(pose, placed.pose) < AGAIN_PX * 2**levels.final:
                break
            pose = placed.pose
        if levels.final == levels.look:
            return Finished(placed.score, placed, made, placed.score)
        look = registrar.refiner(made, levels, levels.look).place(placed.pose, 0).score
        return Finished(placed.score + look, placed, made, look)

    def _moved_px(self, one: Pose, other: Pose) -> float:
        """How far a window moved at its rim, pixels of level 0."""
        half = self.view.side_px / 2
        corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        moved = one.map_px(corners) - other.map_px(corners)
        return float(np.hypot(*moved.T).max())

    def templates_of(self, placed: Placed) -> ViewTemplates:
        """The templates by which a finalist was placed."""
        found = self._found.get(placed.pose)
        return super().templates_of(placed) if found is None else found.made.templates

    def finer(self, placed: Placed) -> ViewTemplates:
        """The templates of a finalist one level finer than the final one."""
        made = None
        if placed.pose in self._found:
            made = self.templates_at(placed.pose, self.view.levels.final - 1)
        return super().finer(placed) if made is None else made

    def by_camera(self, found: Registered) -> tuple[Registered, GroundSeen | None]:
        """The same, of a view on the terrain: heights are counted from the ground below the camera,
        and the camera of the pose is where it is."""
        finalists = tuple((score, self._by_camera(each)) for score, each in found.finalists)
        pose = found.placed.pose
        orientation = self.orientation(pose)
        if orientation is None:
            return found, None
        on_terrain = self._on_terrain(pose)
        east, north = self.relief.en_m(np.array([pose.x_px, pose.y_px])).tolist()
        seen = GroundSeen((east, north), 1.0 if on_terrain is None else on_terrain.gain)
        return replace(found, placed=self._by_camera(found.placed), finalists=finalists), seen

    def _by_camera(self, placed: Placed) -> Placed:
        pose, camera_px = placed.pose, self.view.camera_px
        orientation = None if self._on_terrain(pose) is None else self.orientation(pose)
        if orientation is None:
            return placed
        east, north, above_sea_m = orientation.position_m.tolist()
        below_m = float(self.relief.terrain.at_en_m([east, north]))
        agl_m = self.view.picture_at(self.view.levels.final).telemetry.agl_m
        if not above_sea_m - below_m > 0:  # also where it is unknown
            return placed
        turned = replace(pose, log_scale=math.log((above_sea_m - below_m) / agl_m))
        x, y = pose.map_px(camera_px) - turned.linear @ camera_px
        return replace(placed, pose=replace(turned, x_px=float(x), y_px=float(y)))

    def _on_terrain(self, pose: Pose) -> _Placed | None:
        """The finalist at a pose, None where it was placed on level ground."""
        near = EXCLUSION_SHARE * self.view.side_px
        for other, found in self._found.items():
            if math.hypot(pose.x_px - other.x_px, pose.y_px - other.y_px) < near:
                return found
        return None

    def templates_at(self, pose: Pose, level: int) -> ViewTemplates | None:
        """The view orthorectified on the terrain under a pose, at a level; None where less than
        half of the window is known."""
        orientation = self.orientation(pose)
        if orientation is None:
            return None
        final = self.view.levels.final
        rows, cols = self.view.templates.valid.shape
        scale = 2.0 ** (final - level)
        shape = round(rows * scale), round(cols * scale)
        nodes = (node_px(shape) - [shape[1] / 2, shape[0] / 2]) * 2.0**level
        ground = self.relief.ground_m(pose.map_px(nodes))
        picture = self.view.picture_at(level)
        return ViewTemplates(*orthorectified(picture, orientation, ground, shape), level)

    def orientation(self, pose: Pose) -> Orientation | None:
        """Where the camera is under a pose; None where less than half of its ground is known."""
        heights = self.relief.ground_m(pose.map_px(self._reference_px))[:, 2]
        known = np.isfinite(heights)
        if known.mean() < MIN_KNOWN:
            return None
        telemetry = self.view.picture_at(self.view.levels.final).telemetry
        above_m = telemetry.agl_m * math.exp(pose.log_scale)
        east, north = self.relief.en_m(pose.map_px(self.view.camera_px))
        position = np.array([east, north, float(heights[known].mean()) + above_m])
        attitude = np.array([math.degrees(pose.turn_rad), telemetry.pitch_deg, telemetry.roll_deg])
        return Orientation(position, attitude)
