"""Registering a view on the ground as it is, at candidates that were found on level ground.

The pose of a candidate says where the middle of the view's window lies, its heading, and that the
camera is `agl_m * exp(log_scale)` above the mean ground of that window. The view is orthorectified
on the terrain under that pose and registered again, until it stays where it is.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthonav.geo.camera import enu_from_camera, undistort
from orthonav.geo.grid import TileGrid
from orthonav.localizer.orthorectify import Orientation, node_px, orthorectified
from orthonav.localizer.prepared import MIN_AGL_STD, PreparedView
from orthonav.localizer.resection import resected
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
SLOPE_M = 10.0
"""Slopes are those over twice this distance."""
RESECTIONS = 2
"""The view is orthorectified and resected so many times."""
SIGHT_M = 0.5
"""A line of sight has met the terrain where another step moves the point by less."""
SIGHT_ROUNDS = 12
"""Rounds in which a ray meets the ground."""
LARGEST_STD = 0.3
"""Largest standard deviation of the scales searched: three are scales of 0.41 to 2.46."""
Array = NDArray[np.float64]


class LevelTerrain:
    """Level ground at sea level, for views far off nadir over maps without a terrain."""

    def at_en_m(self, points_en_m: ArrayLike) -> Array:
        """Zeros (...) at points (..., 2)."""
        return np.zeros(np.shape(points_en_m)[:-1])


class Relief:
    """The ground of a sheet, for all views. Safe to share between threads."""

    def __init__(self, terrain: TerrainLayer | LevelTerrain, grid: TileGrid) -> None:
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


@dataclass(frozen=True, eq=False)
class _Placed:
    """A candidate on the terrain: its `templates`, and the score at the judged level over that on
    level ground."""

    made: Finished
    gain: float


@dataclass(frozen=True)
class GroundSeen:
    """What a fix says of the ground: `middle_en_m`, that of the picture's middle, metres east and
    north; `gain`, score on the terrain over that on level ground, None without a terrain."""

    middle_en_m: tuple[float, float]
    gain: float | None


@dataclass(frozen=True, eq=False)
class CameraFound:
    """The camera of a view by resection: `agl_m` above the ground below it, the covariance (6, 6)
    of metres east, north, up and degrees of heading, pitch and roll, and what its middle shows."""

    orientation: Orientation
    agl_m: float
    covariance: Array
    middle_en_m: tuple[float, float]


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

    def resected(self, placed: Placed) -> CameraFound | None:
        """The camera of a place with its pitch and roll; None where they are not examined."""
        return None

    def score_near(self, pose: Pose, steps: int, small_step_px: float) -> float:
        """Score at the final level near a pose of `by_camera`."""
        levels = self.view.levels
        refiner = self.registrar.refiner(self.view.templates, levels, levels.final)
        return refiner.place(pose, steps, small_step_px).score


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
        gain: float | None = 1.0 if on_terrain is None else on_terrain.gain
        if isinstance(self.relief.terrain, LevelTerrain):
            gain = None
        seen = GroundSeen(self.middle_en_m(orientation, pose), gain)
        return replace(found, placed=self._by_camera(found.placed), finalists=finalists), seen

    def score_near(self, pose: Pose, steps: int, small_step_px: float) -> float:
        """The same on the terrain."""
        window = self._of_window(pose)
        made = None if window is None else self.templates_at(window, self.view.levels.final)
        if made is None or window is None:
            return super().score_near(pose, steps, small_step_px)
        refiner = self.registrar.refiner(made, self.view.levels, self.view.levels.final)
        return refiner.place(window, steps, small_step_px).score

    def _of_window(self, pose: Pose) -> Pose | None:
        """The inverse of `_by_camera`; None where the ground is unknown."""
        agl_m = self.view.picture_at(self.view.levels.final).telemetry.agl_m
        camera = pose.map_px(self.view.camera_px)
        below_m = float(self.relief.terrain.at_en_m(self.relief.en_m(camera)))
        above_m = below_m + agl_m * math.exp(pose.log_scale) - self._reference_m(pose)
        if not above_m > 0:  # also where it is unknown
            return None
        scaled = replace(pose, log_scale=math.log(above_m / agl_m))
        x, y = camera - scaled.linear @ self.view.camera_px
        return replace(scaled, x_px=float(x), y_px=float(y))

    def middle_en_m(self, orientation: Orientation, pose: Pose) -> tuple[float, float]:
        """Where the middle of the picture looks on the terrain; the middle of the window of `pose`
        where that is unknown."""
        camera = self.view.picture_at(self.view.levels.final).camera
        east, north = self.relief.en_m(np.array([pose.x_px, pose.y_px])).tolist()
        px = np.array([camera.width_px / 2 - camera.cx_px, camera.height_px / 2 - camera.cy_px])
        plane = undistort(camera, px / [camera.fx_px, camera.fy_px])
        ray = enu_from_camera(*orientation.attitude_deg.tolist()) @ [*plane.tolist(), 1.0]
        found = np.array([east, north])
        for _ in range(SIGHT_ROUNDS):
            above_m = orientation.position_m[2] - float(self.relief.terrain.at_en_m(found))
            if not (ray[2] < -1e-6 and above_m > 0):
                return east, north
            before, found = found, orientation.position_m[:2] + ray[:2] * (above_m / -ray[2])
            if math.dist(before, found) < SIGHT_M:
                return float(found[0]), float(found[1])
        return east, north

    def resected(self, placed: Placed) -> CameraFound | None:
        """The camera of a place with its pitch and roll; None where their deviation is not reported
        or the view does not show them."""
        levels, pose = self.view.levels, placed.pose
        picture = self.view.picture_at(levels.final)
        orientation = self.orientation(pose)
        if not picture.telemetry.tilt_std_deg or orientation is None:
            return None
        found = None
        for _ in range(RESECTIONS):
            made = self.templates_at(pose, levels.final, orientation)
            if made is None:
                return None
            template = made.at(levels.final)
            refiner = self.registrar.refiner(made, levels, levels.final)
            to_px = np.array([1.0, -1.0]) / self.relief.grid.gsd_m
            gradient, curvature = refiner.pulls(pose)
            starts = zip(template.block_starts, template.mask.shape, strict=True)
            rows, cols = (
                (np.append(each[1:], side) + each) / 2 - side / 2 for each, side in starts
            )
            middles = np.stack(np.meshgrid(cols, rows), axis=-1).reshape(-1, 2) * 2.0**levels.final
            ground = self.relief.ground_m(pose.map_px(middles))
            found = resected(
                picture.camera,
                orientation,
                ground,
                self.relief.slopes(ground),
                (gradient * to_px, curvature * to_px[:, None] * to_px),
                self._attitude_prior(pose, orientation),
            )
            if found is None:
                return None
            orientation = orientation.moved(found.correction)
        if found is None or not np.isfinite(found.covariance).all():
            return None
        east, north, above_sea_m = orientation.position_m.tolist()
        below_m = float(self.relief.terrain.at_en_m([east, north]))
        if not above_sea_m - below_m > 0:
            return None
        middle = self.middle_en_m(orientation, pose)
        return CameraFound(orientation, above_sea_m - below_m, found.covariance, middle)

    def _attitude_prior(self, pose: Pose, orientation: Orientation) -> tuple[Array, Array]:
        """Expected correction (6,) of an orientation by telemetry, and its information (6, 6)."""
        telemetry, prior = self.view.picture_at(self.view.levels.final).telemetry, self.view.prior
        expected, std = 0.0, prior.log_scale_std
        if prior.scale_map is not None:
            expected, std = prior.scale_map.at(pose.x_px, pose.y_px), prior.scale_map.std
        expected_m = self._reference_m(pose) + telemetry.agl_m * math.exp(expected)
        up_m = expected_m - float(orientation.position_m[2])
        turn = math.degrees(prior.turn_rad or 0.0) - orientation.attitude_deg[0]
        tilt = np.array([telemetry.pitch_deg, telemetry.roll_deg]) - orientation.attitude_deg[1:]
        mean = np.array([0.0, 0.0, up_m, math.remainder(turn, 360.0), *tilt.tolist()])
        tilt_std = max(telemetry.tilt_std_deg or 0.0, 1e-3)
        stds = np.array([1e4, 1e4, telemetry.agl_m * std, 180.0, tilt_std, tilt_std])
        if prior.turn_rad is not None:
            stds[3] = math.degrees(prior.turn_std_rad)
        return mean, np.diag(stds**-2)

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

    def templates_at(
        self, pose: Pose, level: int, orientation: Orientation | None = None
    ) -> ViewTemplates | None:
        """The view orthorectified on the terrain under a pose, at a level; None where less than
        half of the window is known. `orientation`: of the camera; None: that of the pose."""
        orientation = orientation or self.orientation(pose)
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
        reference_m = self._reference_m(pose)
        if math.isnan(reference_m):
            return None
        telemetry = self.view.picture_at(self.view.levels.final).telemetry
        above_m = telemetry.agl_m * math.exp(pose.log_scale)
        east, north = self.relief.en_m(pose.map_px(self.view.camera_px))
        position = np.array([east, north, reference_m + above_m])
        attitude = np.array([math.degrees(pose.turn_rad), telemetry.pitch_deg, telemetry.roll_deg])
        return Orientation(position, attitude)

    def _reference_m(self, pose: Pose) -> float:
        """Mean height of the ground of the window; NaN where less than half of it is known."""
        heights = self.relief.ground_m(pose.map_px(self._reference_px))[:, 2]
        known = np.isfinite(heights)
        return float(heights[known].mean()) if known.mean() >= MIN_KNOWN else math.nan
