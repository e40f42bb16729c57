"""A sheet with its ground, level or not, and a view over it: a pose says where the middle of its
window lies, its heading, and that the camera is `agl_m * exp(log_scale)` above its mean ground."""

import math
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthonav.core.geo.camera import enu_from_camera, undistort
from orthonav.core.geo.grid import TileGrid
from orthonav.core.geo.ground import sight_on_ground
from orthonav.core.localize.resection import (
    GroundErrors,
    surface_errors,
    terrain_errors,
    unknown_ground,
)
from orthonav.core.localize.view import (
    LIMITS,
    NODE_PX,
    Orientation,
    PreparedView,
    node_px,
    orthorectified,
    rectified_flat,
)
from orthonav.core.mapfile.manifest import Lean, TerrainInfo
from orthonav.core.records import DEFAULT_AGL_STD
from orthonav.core.register.template import ViewTemplates
from orthonav.core.register.window import (
    COMPARED,
    DirectionPrior,
    Pose,
    Reference,
    ScaleMap,
    rotation,
)

UNKNOWN_LEAN = Lean(0.0, 0.0, 0.15)  # up to 0.3 between the middles of overlapping pictures
Array = NDArray[np.float64]


@dataclass(frozen=True)
class GroundSampling:
    """Where heights are taken, and what is too little to count."""

    map_nodes: int = 256  # of expected scales across the map, at most
    flattened_nodes: int = 32  # across the map, for the slopes of its terrain
    window_nodes: int = 9  # across a window, for its mean height
    slope_m: float = 10.0  # half the base over which slopes are measured
    max_scale_std: float = 0.3  # of log scales searched: three are 0.41 to 2.46
    min_ahead: float = 0.2
    """Least distance of the camera from the middle of its view, of the view's side,"""
    min_rise: float = 0.05
    """and least rise of the ground below it over that in the view, of the height, at which scales
    are expected by place."""
    min_known: float = 0.5  # windows of which less is known are registered on flat ground
    unseen_px: float = 0.2  # relief that displaces less (pixels of the final level) is left out
    surface_node_m: float = 2.0  # largest spacing of heights among houses,
    surface_nodes: int = 320  # but at most so many across a view
    smooth_m: float = 10.0  # width over which these are smoothed for the search


SAMPLING = GroundSampling()


class Terrain(Protocol):
    def at_en_m(self, points_en_m: ArrayLike) -> Array:
        """Heights (...) above sea at points (..., 2); NaN where unknown."""


class FlatTerrain:
    def at_en_m(self, points_en_m: ArrayLike) -> Array:
        return np.zeros(np.shape(points_en_m)[:-1])


class GroundModel:
    """The ground of a sheet; threads may share it."""

    def __init__(
        self,
        terrain: Terrain,
        grid: TileGrid,
        info: TerrainInfo | None = None,
        land: str | None = None,
        surface: Terrain | None = None,
        lean: Lean | None = None,
    ) -> None:
        """`info`: of the terrain; `land`: what it is like without one; `surface`: heights of houses
        and trees above it, where the map shows them; `lean`: of these. None: not known."""
        self.terrain, self.grid, self.info, self.land = terrain, grid, info, land
        self.surface, self._lean = surface, lean or UNKNOWN_LEAN
        self.lean_en = np.array([self._lean.east, self._lean.north])
        self.flat_errors = unknown_ground(land)
        self._means: dict[int, tuple[NDArray[np.float32], float]] = {}

    @property
    def is_flat(self) -> bool:
        return isinstance(self.terrain, FlatTerrain)

    @property
    def leans(self) -> bool:
        """Whether the map shows houses and trees a known distance beside their place."""
        return self.surface is not None and bool(self.lean_en.any())

    def en_m(self, map_px: Array) -> Array:
        """Of map coordinates (..., 2) at level 0."""
        corner = np.array([self.grid.west_m, self.grid.north_m])
        return np.asarray(corner + map_px * [self.grid.gsd_m, -self.grid.gsd_m])

    def map_px(self, place_en_m: Array) -> tuple[float, float]:
        """The inverse of `en_m`, for one place (2,)."""
        (east, north), grid = place_en_m, self.grid
        return (float(east) - grid.west_m) / grid.gsd_m, (grid.north_m - float(north)) / grid.gsd_m

    def ground_m(self, map_px: Array) -> Array:
        """East, north, above sea (..., 3) of map coordinates; NaN where unknown."""
        points = self.en_m(map_px)
        return np.concatenate([points, self.terrain.at_en_m(points)[..., None]], axis=-1)

    def surface_m(self, map_px: Array, smooth: int = 0) -> Array:
        """The same of what the map shows there, houses and trees, unless these are unknown at more
        than half. `smooth`: samples over which their heights are means."""
        ground = self.ground_m(map_px)
        above_m = self._above_m(ground)
        if above_m is not None:
            above_m = _smoothed(above_m, smooth)
            ground[..., 2] += above_m
            ground[..., :2] -= np.nan_to_num(above_m)[..., None] * self.lean_en
        return ground

    def _above_m(self, ground_m: Array) -> Array | None:
        """Of houses and trees (...) at (..., 3), NaN where unknown; None: mostly unknown."""
        if self.surface is None:
            return None
        above_m = self.surface.at_en_m(ground_m[..., :2])
        return above_m if np.isfinite(above_m).mean() >= SAMPLING.min_known else None

    def shows_houses(self, ground_m: Array) -> bool:
        """Whether houses and trees are mostly known at (N, 3)."""
        return self._above_m(ground_m) is not None

    def slopes(self, ground_m: Array) -> Array:
        """Rise (N, 2) per metre east and north at (N, 3)."""
        if self.is_flat:
            return np.zeros((len(ground_m), 2))
        steps = SAMPLING.slope_m * np.concatenate([np.eye(2), -np.eye(2)])
        ahead, behind = np.split(self.terrain.at_en_m(ground_m[:, None, :2] + steps), 2, axis=1)
        return np.asarray((ahead - behind) / (2 * SAMPLING.slope_m))

    def errors(self, ground_m: Array, slopes: Array) -> GroundErrors:
        """Of the heights under a view, by points (N, 3) and slopes (N, 2) there."""
        if self.is_flat:
            return self.flat_errors
        above_m = self._above_m(ground_m)
        if above_m is None:
            return terrain_errors(self.info, slopes)
        return surface_errors(self._lean.std, above_m)

    def flattened(self) -> "GroundModel":
        """Level ground that is known as well as this: of simulated views."""
        if self.is_flat:
            return self
        sides_px = self.grid.width_px, self.grid.height_px
        nodes_px = [np.linspace(0.0, side, SAMPLING.flattened_nodes) for side in sides_px]
        found = GroundModel(FlatTerrain(), self.grid, self.info, self.land)
        ground_m = self.ground_m(np.stack(np.meshgrid(*nodes_px), -1).reshape(-1, 2))
        if (known := np.isfinite(ground_m[:, 2])).any():  # others lie off the route of the map
            ground_m = ground_m[known]
        found.flat_errors = self.errors(ground_m, self.slopes(ground_m))
        return found

    def expected(self, view: PreparedView) -> DirectionPrior:
        """The view's prior, with scales by the height above sea at each place, or else by that of
        the ground below the camera over the ground in the view."""
        telemetry, prior = view.telemetry, view.prior
        below, agl_m = telemetry.below, telemetry.agl_m
        ahead = np.hypot(*view.camera_px) >= SAMPLING.min_ahead * view.side_px
        if below is None and (prior.heading_rad is None or not ahead):
            return prior
        means, step_px = self._mean_heights(view.side_px)
        if below is not None:
            below_m: Array | float = below.height_m
        else:
            below_m = self._at_nodes(step_px, rotation(prior.heading_rad or 0.0) @ view.camera_px)
        over = np.maximum(1 + (below_m - means) / agl_m, 0.05)
        values = np.log(np.where(np.isfinite(over), over, 1.0)).astype(np.float32)
        if below is None and np.abs(values).max() < SAMPLING.min_rise:
            return prior
        own_m, std_m = DEFAULT_AGL_STD * agl_m, 0.0 if below is None else below.std_m
        if telemetry.agl_std_m is not None:
            own_m = math.sqrt(max(telemetry.agl_std_m**2 - std_m**2, 0.0))
        focal_std = view.view.camera.focal_std
        std = max(math.hypot(own_m / agl_m, focal_std), LIMITS.min_agl_std)
        sigmas = COMPARED.sigmas
        reach = min(float(np.abs(values).max()) + sigmas * std, sigmas * prior.log_scale_std)
        if std_m / agl_m > std:
            reach = float(np.abs(values).max()) + sigmas * std
        widest = min(reach / sigmas, SAMPLING.max_scale_std)
        return replace(
            prior,
            log_scale_std=max(widest, LIMITS.min_agl_std),
            scale_map=ScaleMap(values, step_px, min(std, prior.log_scale_std)),
        )

    def _at_nodes(self, step_px: float, moved_px: Array) -> Array:
        """Heights (H, W) at nodes over the sheet, each moved by (2,)."""
        size = self.grid.width_px, self.grid.height_px
        x, y = (np.arange(0.0, side + step_px, step_px) for side in size)
        return np.asarray(self.ground_m(np.stack(np.meshgrid(x, y), -1) + moved_px)[..., 2])

    def _mean_heights(self, side_px: float) -> tuple[NDArray[np.float32], float]:
        """Under windows at nodes over the sheet, and the spacing of these, pixels of level 0."""
        key = round(math.log2(max(side_px, 1.0)))
        if key not in self._means:
            size = self.grid.width_px, self.grid.height_px
            step = max(max(size) / SAMPLING.map_nodes, 2.0**key / 4)
            heights = self._at_nodes(step, np.zeros(2))
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


def _smoothed(heights: Array, side: int) -> Array:
    """Means (h, w) over squares, of what is known; NaN stays where it was."""
    side |= 1  # the middle of an even one lies between samples
    if side < 3:
        return heights
    known = np.isfinite(heights)
    share = cv2.blur(known.astype(np.float64), (side, side))
    mean = cv2.blur(np.where(known, heights, 0.0), (side, side)) / np.maximum(share, 1e-9)
    return np.where(known, mean, np.nan)


class ViewOverGround:
    """A view over a ground: its camera under a pose, and what it sees then."""

    def __init__(self, ground: GroundModel, view: PreparedView, reference: Reference) -> None:
        """`reference`: the imagery of the map there."""
        self.ground, self.view, self.reference = ground, view, reference
        valid = view.templates.valid
        rows, cols = (
            (np.arange(SAMPLING.window_nodes) + 0.5) * side / SAMPLING.window_nodes
            for side in valid.shape
        )
        used = valid[np.ix_(rows.astype(int), cols.astype(int))]
        x, y = np.meshgrid(cols - valid.shape[1] / 2, rows - valid.shape[0] / 2)
        nodes = np.stack([x, y], axis=-1) * 2.0**view.levels.final
        self._reference_px = nodes[used] if used.any() else nodes.reshape(-1, 2)
        self._last_ground: tuple[Pose, Array] | None = None

    def templates_at(
        self,
        pose: Pose,
        level: int,
        orientation: Orientation | None = None,
        *,
        smooth: bool = False,
    ) -> ViewTemplates | None:
        """The view orthorectified under a pose; None where less than half of it is known.

        `smooth`: over houses and trees smoothed, as at coarse levels anyway."""
        orientation = orientation or self.orientation(pose)
        if orientation is None:
            return None
        final = self.view.levels.final
        rows, cols = self.view.templates.valid.shape
        scale = 2.0 ** (final - level)
        shape = round(rows * scale), round(cols * scale)
        picture, middle = self.view.picture_at(level), np.array([shape[1], shape[0]]) / 2
        made = None
        if self.ground.is_flat:
            en_from_window = self._en_from_window(pose, level, middle)
            made = rectified_flat(picture, orientation, en_from_window, shape)
        if made is None:
            smooth = smooth or level > final
            ground, shown = self._nodes_m(pose, level, shape, smooth=smooth)
            sheared = None
            if shown is not None:  # straight lines of sight stay straight
                camera_m = orientation.position_m.copy()
                above_m = camera_m[2] - np.nan_to_num(np.nanmean(ground[..., 2]))
                camera_m[:2] += self.ground.lean_en * above_m
                sheared = shown, camera_m
            made = orthorectified(picture, orientation, ground, shape, sheared)
        return ViewTemplates(*made, level, self.view.templates.grey_share)

    def _nodes_m(
        self, pose: Pose, level: int, shape: tuple[int, int], *, smooth: bool
    ) -> tuple[Array, Array | None]:
        """East, north, above sea (h, w, 3) at `node_px` of a window of a level: with houses and
        trees as they are, or smoothed, which more cameras near the right one fit. And, where they
        lean, the same where the map shows them."""
        middle, unit = np.array([shape[1], shape[0]]) / 2, 2.0**level
        if self.ground.surface is None:
            return self.ground.ground_m(pose.map_px((node_px(shape) - middle) * unit)), None
        node_m = NODE_PX * self.ground.grid.gsd_m * unit
        finer = min(
            math.ceil(node_m / SAMPLING.surface_node_m),
            SAMPLING.surface_nodes * NODE_PX // max(shape),
        )
        finer = max(finer, 1)
        across_m = SAMPLING.smooth_m if smooth else node_m if finer > 1 else 0.0
        map_px = pose.map_px((node_px(shape, finer) - middle) * unit)
        nodes = self.ground.surface_m(map_px, round(across_m * finer / node_m))
        nodes, shown = np.ascontiguousarray(nodes[::finer, ::finer]), None
        if self.ground.leans:
            shown = np.dstack([self.ground.en_m(map_px[::finer, ::finer]), nodes[..., 2]])
        return nodes, shown

    def _en_from_window(self, pose: Pose, level: int, middle: Array) -> Array:
        """Metres by pixels of a window of a level (3, 3)."""
        metres = np.array([1.0, -1.0]) * self.ground.grid.gsd_m
        made = np.eye(3)
        made[:2, :2] = metres[:, None] * pose.linear * 2.0**level
        made[:2, 2] = self.ground.en_m(np.array([pose.x_px, pose.y_px])) - made[:2, :2] @ middle
        return made

    def orientation(self, pose: Pose) -> Orientation | None:
        """Of the camera under a pose; None where less than half of its ground is known."""
        reference_m = self.reference_m(pose)
        if math.isnan(reference_m):
            return None
        telemetry = self.view.telemetry
        above_m = telemetry.agl_m * math.exp(pose.log_scale)
        position = np.array([*self.camera_en_m(pose), reference_m + above_m])
        attitude = np.array(
            [math.degrees(pose.heading_rad), telemetry.pitch_deg, telemetry.roll_deg]
        )
        return Orientation(position, attitude)

    def camera_en_m(self, pose: Pose) -> Array:
        """Of the camera (2,)."""
        return self.ground.en_m(pose.map_px(self.view.camera_px))

    def camera_covariance(self, pose: Pose, covariance: Array, floor_m: float) -> Array:
        """Of the camera (4, 4), m east and north, heading (rad) and log scale, by that of the pose;
        `floor_m`: standard deviation with which maps of two dates agree."""
        moved, gsd_m = pose.linear @ self.view.camera_px, self.ground.grid.gsd_m
        camera_from_pose = np.eye(4)
        camera_from_pose[:2, 2:] = [[-moved[1], moved[0]], [moved[0], moved[1]]]
        spread = camera_from_pose @ covariance @ camera_from_pose.T
        spread[:2, :2] += np.eye(2) * (floor_m / gsd_m) ** 2
        metres = np.diag([gsd_m, -gsd_m, 1.0, 1.0])
        return np.asarray(metres @ spread @ metres)

    def reference_m(self, pose: Pose) -> float:
        """Mean height under the window; NaN where less than half is known."""
        if self.ground.is_flat:
            return 0.0
        heights = self._ground_m(pose)[:, 2]
        known = np.isfinite(heights)
        return float(heights[known].mean()) if known.mean() >= SAMPLING.min_known else math.nan

    def _ground_m(self, pose: Pose) -> Array:
        """East, north, above sea (N, 3) at nodes of the window, kept for the last pose."""
        last = self._last_ground
        if last is None or last[0] != pose:
            last = pose, self.ground.ground_m(pose.map_px(self._reference_px))
            self._last_ground = last
        return last[1]

    def _surface_m(self, pose: Pose) -> Array:
        """The same with houses and trees."""
        if self.ground.surface is None:
            return self._ground_m(pose)
        return self.ground.surface_m(pose.map_px(self._reference_px))

    def is_flat_at(self, pose: Pose) -> bool:
        """Whether relief displaces the window by less than is visible."""
        if self.ground.is_flat:
            return True
        ground = self._surface_m(pose)
        orientation = self.orientation(pose)
        if orientation is None or not np.isfinite(ground).all():
            return False
        offset = ground - orientation.position_m
        rise = np.abs(ground[:, 2] - ground[:, 2].mean())
        shift_m = rise * np.hypot(offset[:, 0], offset[:, 1]) / np.maximum(-offset[:, 2], 1.0)
        pixel_m = self.ground.grid.gsd_m * 2.0**self.view.levels.final
        return bool(shift_m.max() < SAMPLING.unseen_px * pixel_m)

    def moved_px(self, one: Pose, other: Pose) -> float:
        """At the rim of the window, pixels of level 0."""
        half = self.view.side_px / 2
        corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        moved = one.map_px(corners) - other.map_px(corners)
        return float(np.hypot(*moved.T).max())

    def below_camera(self, pose: Pose) -> Pose:
        """With the height counted from the ground below the camera."""
        camera_px, orientation = self.view.camera_px, self.orientation(pose)
        if orientation is None:
            return pose
        east, north, above_sea_m = orientation.position_m.tolist()
        below_m = float(self.ground.terrain.at_en_m([east, north]))
        agl_m = self.view.telemetry.agl_m
        if not above_sea_m - below_m > 0:  # also where it is unknown
            return pose
        turned = replace(pose, log_scale=math.log((above_sea_m - below_m) / agl_m))
        x, y = pose.map_px(camera_px) - turned.linear @ camera_px
        return replace(turned, x_px=float(x), y_px=float(y))

    def middle_en_m(self, sight_en_m: Array, pose: Pose) -> tuple[float, float]:
        """Ground in the middle of the picture; that of the window where unknown."""
        found = sight_en_m
        if not np.isfinite(found).all():
            found = self.ground.en_m(np.array([pose.x_px, pose.y_px]))
        return float(found[0]), float(found[1])

    def sight_en_m(self, orientation: Orientation) -> Array:
        """Ground (2,) in the middle of the picture, NaN where unknown."""
        camera = self.view.picture_at(self.view.levels.final).camera
        px = np.array([camera.width_px / 2 - camera.cx_px, camera.height_px / 2 - camera.cy_px])
        plane = undistort(camera, px / [camera.fx_px, camera.fy_px])
        ray = enu_from_camera(*orientation.attitude_deg.tolist()) @ [*plane.tolist(), 1.0]
        above_m = float(orientation.position_m[2])
        if not ray[2] < -1e-6 or (self.ground.is_flat and not above_m > 0):
            return np.full(2, np.nan)
        if self.ground.is_flat:
            return np.asarray(orientation.position_m[:2] - ray[:2] / ray[2] * above_m)

        def above_sea_m(offset_en_m: Array) -> Array:
            return self.ground.terrain.at_en_m(orientation.position_m[:2] + offset_en_m)

        met = sight_on_ground(ray[:2] / -ray[2], above_m, above_sea_m)
        return np.asarray(orientation.position_m[:2] + met)
