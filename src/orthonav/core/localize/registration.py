"""Placing a view by registration on the map's imagery.

READ FIRST: `register` is the one way from a view to its best place. It rectifies the view
(`prepared`), and runs the searches (`view_search`) that `plan` chooses; `candidates` runs each of
them, and `orthonav.core.register` judges what they find. `locate` makes a fix of the place,
`tracker`,
`orthonav.ground.atlas` and `orthonav.ground.check` use the place itself.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MapFileError, VariantError
from orthonav.core.localize.camera import CameraFound, tilt_std_deg
from orthonav.core.localize.candidates import ViewCandidates
from orthonav.core.localize.over_relief import ViewOnLevelGround, ViewOverRelief
from orthonav.core.localize.plan import DEFAULT_PLAN, SearchPlan
from orthonav.core.localize.prepared import PreparedView, prepare
from orthonav.core.localize.propose import TileProposer
from orthonav.core.localize.rectify import is_oblique, off_nadir_deg
from orthonav.core.localize.registered import RegisteredConfidence
from orthonav.core.localize.relief import LevelTerrain, Relief
from orthonav.core.localize.view_search import ViewSearch
from orthonav.core.mapfile.layer import GreyLayer
from orthonav.core.mapfile.manifest import SheetInfo
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.mapfile.terrain import TerrainLayer
from orthonav.core.records import RADIUS_SHARE, Fix, NoFix, Prior, Telemetry, View
from orthonav.core.register.pose import Pose
from orthonav.core.register.reference import GreyPyramid, Reference
from orthonav.core.register.refine import Placed
from orthonav.core.register.registrar import Registered, Registrar
from orthonav.core.track.hypotheses import within

ERROR_VARIANCE = 1.5
"""Of errors over what their covariance says, for the confidence: errors of a camera have heavier
tails than a Gaussian (docs/decisions/camera.md)."""


@dataclass(frozen=True, eq=False)
class RegisteredView:
    """A prepared view and its best place; `found` is a `NoFix` where it could not be compared.

    `ground`: the view on the ground of the map, None where it could not be compared.
    """

    prepared: PreparedView
    found: Registered | NoFix
    ground: ViewOnLevelGround | None = None

    def camera(self, placed: Placed) -> CameraFound | None:
        """The camera of one of the places found, with its pitch and roll; None where the reported
        ones are exact or the view does not show them."""
        return None if self.ground is None else self.ground.camera(placed)


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
        self.relief = Relief(terrain or LevelTerrain(), self.grid)

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
        return self.fix(seen, seen.found, view.telemetry)

    def register(
        self, view: View, prior: Prior | None = None, heading_known: bool = True
    ) -> RegisteredView | NoFix:
        """The view and its best place within `prior`; `NoFix` where it shows too little."""
        prepared = self.prepared(view, heading_known)
        if isinstance(prepared, NoFix):
            return prepared
        if not self.relief.is_level:
            prepared = replace(prepared, prior=self.relief.expected(prepared))
        if not self._candidates(prepared, prior).touches_map:
            outside = NoFix("outside_map", "the area of the prior is outside the map")
            return RegisteredView(prepared, outside)
        ground = self.on_ground(prepared)
        found = self.best(prepared, prior, ground)
        if found is None:
            detail = "no part of the map could be compared with the view"
            if prior is None:
                detail += "; a large map needs a prior, or views as large as its tiles"
            return RegisteredView(prepared, NoFix("no_match", detail))
        return RegisteredView(prepared, ground.by_camera(found), ground)

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
        level = self.relief.is_level and not is_oblique(view.picture_at(view.levels.final))
        made = ViewOnLevelGround if level else ViewOverRelief
        return made(self.relief, self.registrar, view)

    def fix(self, seen: RegisteredView, best: Registered, telemetry: Telemetry) -> Fix:
        """The fix of a registered view with this telemetry at its best place."""
        assert seen.ground is not None
        camera, viewed = seen.camera(best.placed), seen.ground.viewed(best)
        floor_m = self.floor_m(seen.prepared)
        if camera is None:
            found = self._by_similarity(seen.prepared, best.placed, telemetry, floor_m)
            middle_en_m = None if viewed is None else viewed.middle_en_m
        else:
            found = _by_camera(camera, telemetry, floor_m)
            middle_en_m = camera.middle_en_m
        evidence = best.evidence()
        confidence = math.nan if self.confidence is None else self.confidence(evidence)
        radius_m = max(self.radius_m, RADIUS_SHARE * found.agl_m)
        # Of the camera: its place is right, and its error is within the radius.
        confidence *= within(found.place_en_m, ERROR_VARIANCE * found.cov_en_m2, radius_m)
        evidence |= found.stds
        if found.middle_cov_en_m2 is not None:
            widest = float(np.linalg.eigvalsh(found.middle_cov_en_m2)[-1])
            evidence["middle_std_m"] = math.sqrt(widest)
        if viewed is not None and viewed.gain is not None:
            evidence["terrain_gain"] = viewed.gain
        lat, lon = self.sheet.frame.latlon_from_en(found.place_en_m)
        middle = None
        if middle_en_m is not None:
            middle_deg = self.sheet.frame.latlon_from_en(middle_en_m)
            middle = float(middle_deg[0]), float(middle_deg[1])
        for each in (found.cov_en_m2, found.middle_cov_en_m2, found.pose_cov):
            if each is not None:
                each.flags.writeable = False
        heading_deg, pitch_deg, roll_deg = found.attitude_deg
        return Fix(
            lat_deg=float(lat),
            lon_deg=float(lon),
            cov_en_m2=found.cov_en_m2,
            confidence=confidence,
            radius_m=radius_m,
            heading_deg=heading_deg % 360,
            agl_m=found.agl_m,
            evidence=MappingProxyType(evidence),
            ground_latlon_deg=middle,
            ground_cov_en_m2=None if middle is None else found.middle_cov_en_m2,
            pitch_deg=pitch_deg,
            roll_deg=roll_deg,
            pose_cov=found.pose_cov,
        )

    def _by_similarity(
        self, view: PreparedView, placed: Placed, telemetry: Telemetry, floor_m: float
    ) -> "_Found":
        """Position, height and heading under the reported pitch and roll."""
        assert placed.covariance is not None
        spread = self.covariance(view, placed)
        agl_m = telemetry.agl_m * math.exp(placed.pose.log_scale)
        covariance = spread[:2, :2]
        # A line of sight off nadir meets the ground farther out by 1 / cos^2.
        cos = math.cos(math.radians(off_nadir_deg(telemetry)))
        tilt_m = agl_m * math.radians(tilt_std_deg(telemetry)) / cos**2
        return _Found(
            self.camera_en_m(view, placed.pose),
            (math.degrees(placed.pose.turn_rad), telemetry.pitch_deg, telemetry.roll_deg),
            agl_m,
            covariance + np.eye(2) * tilt_m**2,
            placed.covariance[:2, :2] * self.grid.gsd_m**2 + np.eye(2) * floor_m**2,
            {
                "heading_std_deg": math.degrees(math.sqrt(spread[2, 2])),
                "log_scale_std": math.sqrt(spread[3, 3]),
            },
        )

    def floor_m(self, view: PreparedView) -> float:
        """Standard deviation with which maps of two dates agree at the final level of a view, m."""
        # Coarse imagery of another date is displaced by more (benchmarks/pixel_ellipses.py).
        return self.floor_px * self.grid.gsd_m * 2.0**view.levels.final

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


@dataclass(frozen=True, eq=False)
class _Found:
    """What a fix says of the camera; see `Fix`. `stds` go into its evidence."""

    place_en_m: NDArray[np.float64]
    attitude_deg: tuple[float, float, float]
    agl_m: float
    cov_en_m2: NDArray[np.float64]
    middle_cov_en_m2: NDArray[np.float64] | None
    stds: dict[str, float]
    pose_cov: NDArray[np.float64] | None = None


def _by_camera(camera: CameraFound, telemetry: Telemetry, floor_m: float) -> _Found:
    """Position, height and attitude from the blocks of the view."""
    heading_deg, pitch_deg, roll_deg = camera.orientation.attitude_deg.tolist()
    _, _, up_m, heading, pitch, roll = np.sqrt(np.diag(camera.covariance)).tolist()
    covariance = camera.covariance.copy()
    covariance[:2, :2] += np.eye(2) * floor_m**2
    middle = camera.middle_covariance
    return _Found(
        camera.orientation.position_m[:2],
        (heading_deg, pitch_deg, roll_deg),
        camera.agl_m,
        covariance[:2, :2].copy(),
        None if middle is None else middle + np.eye(2) * floor_m**2,
        {
            "heading_std_deg": heading,
            "log_scale_std": up_m / camera.agl_m,
            "pitch_bias_deg": pitch_deg - telemetry.pitch_deg,
            "roll_bias_deg": roll_deg - telemetry.roll_deg,
            "pitch_bias_std_deg": pitch,
            "roll_bias_std_deg": roll,
        },
        covariance,
    )
