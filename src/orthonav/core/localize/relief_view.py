"""A view and the ground of a sheet: from poses of its window to the camera and to what it sees.

The pose of a candidate says where the middle of the view's window lies, its heading, and that the
camera is `agl_m * exp(log_scale)` above the mean ground of that window.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import enu_from_camera, undistort
from orthonav.core.geo.ground import sight_on_ground
from orthonav.core.localize.orthorectify import Orientation, node_px, orthorectified
from orthonav.core.localize.prepared import PreparedView
from orthonav.core.localize.rectify import is_oblique
from orthonav.core.localize.relief import Relief
from orthonav.core.register.pose import Pose
from orthonav.core.register.template import ViewTemplates

REFERENCE_NODES = 9
"""Nodes across and down a window whose mean height is its reference."""
MIN_KNOWN = 0.5
"""Windows of which less is known are registered on level ground."""
LEVEL_PX = 0.2
"""Relief that displaces no ground of a window by more (pixels of the final level) is left out."""
Array = NDArray[np.float64]


class ReliefView:
    """One view over the ground of a sheet."""

    def __init__(self, relief: Relief, view: PreparedView) -> None:
        self.relief, self.view = relief, view
        valid = view.templates.valid
        rows, cols = (
            (np.arange(REFERENCE_NODES) + 0.5) * side / REFERENCE_NODES for side in valid.shape
        )
        used = valid[np.ix_(rows.astype(int), cols.astype(int))]
        x, y = np.meshgrid(cols - valid.shape[1] / 2, rows - valid.shape[0] / 2)
        nodes = np.stack([x, y], axis=-1) * 2.0**view.levels.final
        self._reference_px = nodes[used] if used.any() else nodes.reshape(-1, 2)

    @property
    def is_oblique(self) -> bool:
        """Whether the view is far off nadir."""
        return is_oblique(self.view.picture_at(self.view.levels.final))

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
        reference_m = self.reference_m(pose)
        if math.isnan(reference_m):
            return None
        telemetry = self.view.picture_at(self.view.levels.final).telemetry
        above_m = telemetry.agl_m * math.exp(pose.log_scale)
        east, north = self.relief.en_m(pose.map_px(self.view.camera_px))
        position = np.array([east, north, reference_m + above_m])
        attitude = np.array([math.degrees(pose.turn_rad), telemetry.pitch_deg, telemetry.roll_deg])
        return Orientation(position, attitude)

    def reference_m(self, pose: Pose) -> float:
        """Mean height of the ground of the window; NaN where less than half of it is known."""
        heights = self.relief.ground_m(pose.map_px(self._reference_px))[:, 2]
        known = np.isfinite(heights)
        return float(heights[known].mean()) if known.mean() >= MIN_KNOWN else math.nan

    def is_level(self, pose: Pose) -> bool:
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

    def moved_px(self, one: Pose, other: Pose) -> float:
        """How far a window moved at its rim, pixels of level 0."""
        half = self.view.side_px / 2
        corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        moved = one.map_px(corners) - other.map_px(corners)
        return float(np.hypot(*moved.T).max())

    def below_camera(self, pose: Pose) -> Pose:
        """The pose of a window, with its height counted from the ground below the camera."""
        camera_px, orientation = self.view.camera_px, self.orientation(pose)
        if orientation is None:
            return pose
        east, north, above_sea_m = orientation.position_m.tolist()
        below_m = float(self.relief.terrain.at_en_m([east, north]))
        agl_m = self.view.picture_at(self.view.levels.final).telemetry.agl_m
        if not above_sea_m - below_m > 0:  # also where it is unknown
            return pose
        turned = replace(pose, log_scale=math.log((above_sea_m - below_m) / agl_m))
        x, y = pose.map_px(camera_px) - turned.linear @ camera_px
        return replace(turned, x_px=float(x), y_px=float(y))

    def middle_en_m(self, orientation: Orientation, pose: Pose) -> tuple[float, float]:
        """Where the middle of the picture looks on the terrain; the middle of the window of `pose`
        where that is unknown."""
        found = self.sight_en_m(orientation)
        if not np.isfinite(found).all():
            found = self.relief.en_m(np.array([pose.x_px, pose.y_px]))
        return float(found[0]), float(found[1])

    def sight_en_m(self, orientation: Orientation) -> Array:
        """Metres east and north (2,) of the terrain that the middle of the picture shows; NaN where
        that is unknown."""
        camera = self.view.picture_at(self.view.levels.final).camera
        px = np.array([camera.width_px / 2 - camera.cx_px, camera.height_px / 2 - camera.cy_px])
        plane = undistort(camera, px / [camera.fx_px, camera.fy_px])
        ray = enu_from_camera(*orientation.attitude_deg.tolist()) @ [*plane.tolist(), 1.0]
        if not ray[2] < -1e-6:
            return np.full(2, np.nan)

        def above_sea_m(offset_en_m: Array) -> Array:
            return self.relief.terrain.at_en_m(orientation.position_m[:2] + offset_en_m)

        met = sight_on_ground(ray[:2] / -ray[2], float(orientation.position_m[2]), above_sea_m)
        return np.asarray(orientation.position_m[:2] + met)
