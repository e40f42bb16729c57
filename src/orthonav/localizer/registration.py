"""Placing a view by registration on the map's imagery.

READ FIRST: `register` is the one way from a view to its best place. It rectifies the view
(`prepared`), and runs the searches (`view_search`) that `plan` chooses; `candidates` runs each of
them, and `orthonav.register` judges what they find. `locate` makes a fix of the place, `tracker`,
`orthonav.atlas` and `orthonav.check` use the place itself.
"""

import functools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from orthonav.confidence.registered import RegisteredConfidence
from orthonav.errors import MapFileError, VariantError
from orthonav.localizer.candidates import ViewCandidates
from orthonav.localizer.over_relief import ViewedGround, ViewOnLevelGround, ViewOverRelief
from orthonav.localizer.plan import DEFAULT_PLAN, SearchPlan
from orthonav.localizer.prepared import PreparedView, prepare
from orthonav.localizer.propose import TileProposer
from orthonav.localizer.rectify import is_oblique, off_nadir_deg
from orthonav.localizer.relief import LevelTerrain, Relief
from orthonav.localizer.relief_camera import CameraFound
from orthonav.localizer.view_search import ViewSearch
from orthonav.mapfile.layer import GreyLayer
from orthonav.mapfile.manifest import SheetInfo
from orthonav.mapfile.reader import MapFile
from orthonav.mapfile.terrain import TerrainLayer
from orthonav.records import Fix, NoFix, Prior, Telemetry, View
from orthonav.register.pose import Pose
from orthonav.register.reference import GreyPyramid, Reference
from orthonav.register.refine import Placed
from orthonav.register.registrar import Registered, Registrar


@dataclass(frozen=True, eq=False)
class RegisteredView:
    """A prepared view and its best place; `found` is a `NoFix` where it could not be compared.

    `ground`: what it saw, where the map has a terrain or the view is oblique. `camera`: makes the
    camera with its pitch and roll, None where these are not examined.
    """

    prepared: PreparedView
    found: Registered | NoFix
    ground: ViewedGround | None = None
    camera: Callable[[], CameraFound | None] = lambda: None


class RegistrationLocalizer:
    """Places views on one sheet by registration. Safe to share between threads."""

    def __init__(
        self,
        sheet: SheetInfo,
        layer: GreyPyramid,
        *,
        confidence: RegisteredConfidence | None,
        radius_m: float,
        floor_px: float,
        propose: TileProposer | None = None,
        plan: SearchPlan = DEFAULT_PLAN,
        terrain: TerrainLayer | None = None,
    ) -> None:
        """Take a sheet and its imagery; `of_map` does so for a map.

        `confidence`: None before it is learnt. `radius_m`: the error that it is about. `floor_px`:
        standard deviation with which maps of two dates agree, in pixels of level 0. Without
        `propose`, candidates come from searches by FFT only; without `terrain` the ground is level.
        """
        self.sheet, self.grid = sheet, sheet.grid
        self._pool = ThreadPoolExecutor(plan.threads) if plan.threads > 1 else None
        self.registrar = Registrar(Reference(layer), self._pool)
        self.confidence, self.radius_m = confidence, radius_m
        self.propose, self.plan = propose, plan
        self.floor_px = floor_px
        self.relief = None if terrain is None else Relief(terrain, self.grid)

    @classmethod
    def of_map(
        cls,
        opened: MapFile,
        propose: TileProposer | None,
        plan: SearchPlan = DEFAULT_PLAN,
        *,
        level_ground: bool = True,
    ) -> "RegistrationLocalizer | None":
        """A localizer for the only sheet of a map; None where the map has no registration layer.

        Unless `level_ground`, views are placed on the map's terrain, where it has one.

        Raises `MapFileError` where the manifest's registration is damaged.
        """
        layer = GreyLayer.of(opened)
        if layer is None:
            return None
        plain = opened.manifest.registration or {}
        try:
            fitted = plain.get("confidence")
            confidence = None if fitted is None else RegisteredConfidence.from_plain(fitted)
            radius_m, floor_px = float(plain["radius_m"]), float(plain["position_floor_px"])
        except (VariantError, KeyError, TypeError, ValueError) as error:
            raise MapFileError(f"map cannot be flown ({error}): {opened.path}") from error
        if not (0 < radius_m < math.inf and 0 <= floor_px < math.inf):
            raise MapFileError(f"map has impossible registration parameters: {opened.path}")
        return cls(
            opened.manifest.sheets[0],
            layer,
            confidence=confidence,
            radius_m=radius_m,
            floor_px=floor_px,
            propose=propose,
            plan=plan,
            terrain=None if level_ground else TerrainLayer.of(opened),
        )

    @property
    def pyramid(self) -> GreyPyramid:
        """The grey levels of the sheet at all its resolutions."""
        return self.registrar.reference.pyramid

    def locate(self, view: View, prior: Prior | None, heading_known: bool) -> Fix | NoFix:
        """The position from which a view was taken; `check_view` has accepted the view."""
        seen = self.register(view, prior, heading_known)
        if isinstance(seen, NoFix):
            return seen
        if isinstance(seen.found, NoFix):
            return seen.found
        return self._fix(seen.prepared, seen.found, view.telemetry, seen)

    def register(
        self, view: View, prior: Prior | None = None, heading_known: bool = True
    ) -> RegisteredView | NoFix:
        """The view and its best place within `prior`; `NoFix` where it shows too little."""
        prepared = self.prepared(view, heading_known)
        if isinstance(prepared, NoFix):
            return prepared
        if self.relief is not None:
            prepared = replace(prepared, prior=self.relief.expected(prepared))
        if not self._candidates(prepared, prior).touches_map:
            outside = NoFix("outside_map", "the area of the prior is outside the map")
            return RegisteredView(prepared, outside)
        ground = self.on_ground(prepared)
        found = self.best(prepared, prior, ground)
        if found is None:
            detail = "no place of the map could be compared with the view"
            if prior is None:
                detail += "; a large map needs a prior, or views as large as its tiles"
            return RegisteredView(prepared, NoFix("no_match", detail))
        resect = functools.partial(ground.resected, found.placed)
        return RegisteredView(prepared, *ground.by_camera(found), resect)

    def prepared(self, view: View, heading_known: bool) -> PreparedView | NoFix:
        """The view rectified and made ready for registration; `NoFix` where it shows too little."""
        return prepare(view, self.grid.gsd_m, self.pyramid.levels, heading_known)

    def best(
        self, view: PreparedView, prior: Prior | None, ground: ViewOnLevelGround | None = None
    ) -> Registered | None:
        """The best place after all searches that had to be run; None where nothing was found.

        `ground`: the view on the ground of the map; None: made here.
        """
        candidates = self._candidates(view, prior)
        return ViewSearch(candidates, ground or self.on_ground(view), self.confidence).best()

    def _candidates(self, view: PreparedView, prior: Prior | None) -> ViewCandidates:
        return ViewCandidates(
            view, prior, self.sheet, self.registrar, self.propose, self.plan, self._pool
        )

    def on_ground(self, view: PreparedView) -> ViewOnLevelGround:
        """A view on the terrain of the map, where it has one."""
        if self.relief is not None:
            return ViewOverRelief(self.relief, self.registrar, view)
        if is_oblique(view.picture_at(view.levels.final)):
            level = Relief(LevelTerrain(), self.grid)
            return ViewOverRelief(level, self.registrar, view)
        return ViewOnLevelGround(self.registrar, view)

    def _fix(
        self,
        view: PreparedView,
        best: Registered,
        telemetry: Telemetry,
        seen: RegisteredView,
    ) -> Fix:
        placed, camera = best.placed, seen.camera()
        place = self.camera_en_m(view, placed.pose)
        spread = self.covariance(view, placed)
        covariance = spread[:2, :2]
        heading_deg = math.degrees(placed.pose.turn_rad) % 360
        agl_m = telemetry.agl_m * math.exp(placed.pose.log_scale)
        assert placed.covariance is not None
        gsd_m = self.grid.gsd_m
        # Coarse imagery of another date is displaced by more (benchmarks/pixel_ellipses.py).
        floor_m = self.floor_px * gsd_m * 2.0**view.levels.final
        of_middle: NDArray[np.float64] | None = placed.covariance[:2, :2] * gsd_m**2
        stds = {
            "heading_std_deg": math.degrees(math.sqrt(spread[2, 2])),
            "log_scale_std": math.sqrt(spread[3, 3]),
        }
        if camera is not None:
            place, agl_m = camera.orientation.position_m[:2], camera.agl_m
            heading_deg = float(camera.orientation.attitude_deg[0]) % 360
            covariance = camera.covariance[:2, :2] + np.eye(2) * floor_m**2
            stds = _attitude_found(camera, telemetry)
            of_middle = camera.middle_covariance
        elif telemetry.tilt_std_deg is not None:
            # A line of sight off nadir meets the ground farther out by 1 / cos^2.
            cos = math.cos(math.radians(off_nadir_deg(telemetry)))
            tilt_m = agl_m * math.radians(telemetry.tilt_std_deg) / cos**2
            covariance = covariance + np.eye(2) * tilt_m**2
        if of_middle is not None:
            widest = float(np.linalg.eigvalsh(of_middle)[-1])
            stds["middle_std_m"] = math.sqrt(widest + floor_m**2)
        lat, lon = self.sheet.frame.latlon_from_en(place)
        covariance.flags.writeable = False
        evidence = best.evidence()
        confidence = math.nan if self.confidence is None else self.confidence(evidence)
        evidence |= stds
        middle = None
        if seen.ground is not None:
            if seen.ground.gain is not None:
                evidence["terrain_gain"] = seen.ground.gain
            middle_en_m = seen.ground.middle_en_m if camera is None else camera.middle_en_m
            middle_deg = self.sheet.frame.latlon_from_en(middle_en_m)
            middle = float(middle_deg[0]), float(middle_deg[1])
        return Fix(
            lat_deg=float(lat),
            lon_deg=float(lon),
            cov_en_m2=covariance,
            confidence=confidence,
            radius_m=self.radius_m,
            heading_deg=heading_deg,
            agl_m=agl_m,
            evidence=MappingProxyType(evidence),
            ground_latlon_deg=middle,
        )

    def camera_en_m(self, view: PreparedView, pose: Pose) -> NDArray[np.float64]:
        """Metres east and north (2,) of the camera where a view's window lies at `pose`."""
        x, y = pose.map_px(view.camera_px)
        gsd_m = self.grid.gsd_m
        return np.array([self.grid.west_m + float(x) * gsd_m, self.grid.north_m - float(y) * gsd_m])

    def seen_from(self, view: PreparedView, pose: Pose) -> NDArray[np.float64]:
        """Where the camera of a view at `pose` is (4,): metres east and north, heading (rad) and
        log scale."""
        return np.array([*self.camera_en_m(view, pose), pose.turn_rad, pose.log_scale])

    def pose_of(self, view: PreparedView, seen_from: NDArray[np.float64]) -> Pose:
        """Where a view's window lies if the camera is at (4,): metres east and north, heading
        (rad) and log scale. The inverse of `seen_from`."""
        east, north, turn, log_scale = seen_from.tolist()
        x, y = (east - self.grid.west_m), (self.grid.north_m - north)
        moved = Pose(0.0, 0.0, turn, log_scale).map_px(view.camera_px)
        gsd_m = self.grid.gsd_m
        return Pose(x / gsd_m - float(moved[0]), y / gsd_m - float(moved[1]), turn, log_scale)

    def covariance(self, view: PreparedView, placed: Placed) -> NDArray[np.float64]:
        """Covariance (4, 4) of the camera's east and north (m), heading (rad) and log scale."""
        assert placed.covariance is not None
        moved = placed.pose.linear @ view.camera_px
        camera_from_pose = np.eye(4)
        camera_from_pose[:2, 2:] = [[-moved[1], moved[0]], [moved[0], moved[1]]]
        spread = camera_from_pose @ placed.covariance @ camera_from_pose.T
        spread[:2, :2] += np.eye(2) * self.floor_px**2
        metres = np.diag([self.grid.gsd_m, -self.grid.gsd_m, 1.0, 1.0])
        return np.asarray(metres @ spread @ metres)


def _attitude_found(camera: CameraFound, telemetry: Telemetry) -> dict[str, float]:
    """Pitch and roll by resection over the reported ones, and standard deviations."""
    _, pitch_deg, roll_deg = camera.orientation.attitude_deg.tolist()
    up_m, heading, pitch, roll = np.sqrt(np.diag(camera.covariance)[2:]).tolist()
    return {
        "heading_std_deg": heading,
        "log_scale_std": up_m / camera.agl_m,
        "pitch_bias_deg": pitch_deg - telemetry.pitch_deg,
        "roll_bias_deg": roll_deg - telemetry.roll_deg,
        "pitch_bias_std_deg": pitch,
        "roll_bias_std_deg": roll,
    }
