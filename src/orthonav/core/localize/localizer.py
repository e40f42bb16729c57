"""A map, the method that places views on it, and the fix of a view."""

import math
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MapFileError, VariantError
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.camera import CameraFound, tilt_std_deg
from orthonav.core.localize.confidence import RegisteredConfidence, within
from orthonav.core.localize.ground import SearchedSheet
from orthonav.core.localize.place import Place
from orthonav.core.localize.policy import DEFAULT_PLAN, SearchPlan
from orthonav.core.localize.rectify import off_nadir_deg
from orthonav.core.localize.search import Search
from orthonav.core.localize.tiles import TileLocalizer, TileProposer
from orthonav.core.localize.view import PreparedView, check_view, prepare
from orthonav.core.mapfile.layer import GreyLayer
from orthonav.core.mapfile.manifest import SheetInfo
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.mapfile.terrain import TerrainLayer
from orthonav.core.records import RADIUS_SHARE, Fix, NoFix, Prior, Telemetry, View
from orthonav.core.register.pose import Pose
from orthonav.core.tiles.position import PositionRule

ERROR_VARIANCE = 1.5  # their tails are heavier than a Gaussian's (docs/decisions/camera.md)
WIDEST_M = 2e7  # half the Earth's circumference


class Localizer:
    """Places views on one map; threads may share it once warm.

    `registration` is None where the map has no layer for it, or it was switched off."""

    def __init__(
        self,
        opened: MapFile,
        *,
        registration: bool = True,
        position: PositionRule = "peak",
        flying: bool = True,
        level_ground: bool = False,
        plan: SearchPlan | None = None,
    ) -> None:
        """Raises `MapFileError` where this program cannot fly the map, `MissingExtraError` for
        onnxruntime.

        Without `registration`, or a layer for it, tiles place the views, by the rule `position`.
        Without `flying`, representations too slow to fly are accepted: only for maps of one's own,
        because networks are loaded from this machine. `level_ground`: without the map's terrain,
        for simulated views."""
        if len(opened.manifest.sheets) != 1:
            raise MapFileError(f"this program flies maps of one sheet: {opened.path}")
        self.opened = opened
        self.tiles = TileLocalizer(opened, position=position, flying=flying)
        self.registration = None
        if registration:
            self.registration = RegistrationLocalizer.of_map(
                opened, self.tiles.proposer(), plan or DEFAULT_PLAN, level_ground=level_ground
            )

    def __repr__(self) -> str:
        kind = "tiles" if self.registration is None else "registration"
        return f"Localizer({self.opened.path}, {kind})"

    @property
    def sheet(self) -> SheetInfo:
        return self.tiles.sheet

    @property
    def grid(self) -> TileGrid:
        return self.tiles.sheet.grid

    @property
    def radius_m(self) -> float:
        """The error that the confidence of tile fixes is about."""
        return self.tiles.radius_m

    def locate(
        self, view: View, *, prior: Prior | None = None, heading_known: bool = True
    ) -> Fix | NoFix:
        """The position from which a view was taken.

        `prior` limits the search to three standard deviations around it. With `heading_known`
        false all headings are tried and the reported heading may be NaN. Any fault of a view makes
        a `NoFix`."""
        refused = check_view(view, self.grid.gsd_m, heading_known)
        if refused is not None:
            return refused
        if prior is not None and prior.std_m > WIDEST_M:
            prior = replace(prior, std_m=WIDEST_M)
        chosen = self.registration or self.tiles
        return chosen.locate(view, prior, heading_known)

    def localize(
        self,
        image: NDArray[Any],
        camera: Camera,
        *,
        agl_m: float,
        heading_deg: float | None = None,
        pitch_deg: float = 0.0,
        roll_deg: float = 0.0,
        prior: Prior | None = None,
        heading_std_deg: float | None = None,
        agl_std_m: float | None = None,
        tilt_std_deg: float | None = None,
    ) -> Fix | NoFix:
        """The position from which an image was taken; for the arguments see `View.of`.

        `heading_deg` None: all headings are tried. `prior`: searched within three of its standard
        deviations; None: on the whole map. Raises `FlightError` for what is no image and
        `CameraError` where image and camera have different aspect ratios."""
        view = View.of(
            image,
            camera,
            agl_m=agl_m,
            heading_deg=heading_deg,
            pitch_deg=pitch_deg,
            roll_deg=roll_deg,
            heading_std_deg=heading_std_deg,
            agl_std_m=agl_std_m,
            tilt_std_deg=tilt_std_deg,
        )
        return self.locate(view, prior=prior, heading_known=heading_deg is not None)


class RegistrationLocalizer(SearchedSheet):
    @classmethod
    def of_map(
        cls,
        opened: MapFile,
        propose: TileProposer | None,
        plan: SearchPlan = DEFAULT_PLAN,
        *,
        level_ground: bool = True,
    ) -> "RegistrationLocalizer | None":
        """For the only sheet of a map; None without a registration layer.

        Raises `MapFileError` where the manifest's registration is damaged."""
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

    def locate(self, view: View, prior: Prior | None, heading_known: bool) -> Fix | NoFix:
        search = self.search(view, prior, heading_known)
        if isinstance(search, NoFix):
            return search
        best = search.run()
        return best if isinstance(best, NoFix) else self.fix(search, best, view.telemetry)

    def search(
        self, view: View, prior: Prior | None = None, heading_known: bool = True
    ) -> Search | NoFix:
        """`NoFix` where the view shows too little."""
        prepared = self.prepared(view, heading_known)
        if isinstance(prepared, NoFix):
            return prepared
        if not self.relief.is_level:
            prepared = replace(prepared, prior=self.relief.expected(prepared))
        return Search(self, prepared, prior)

    def prepared(self, view: View, heading_known: bool) -> PreparedView | NoFix:
        return prepare(view, self.grid.gsd_m, self.pyramid.levels, heading_known)

    def fix(self, search: Search, best: Place, telemetry: Telemetry) -> Fix:
        camera, ground, pose = search.camera(best), search.ground, best.fit.pose
        orientation, middle_en_m = ground.orientation(pose), None
        if camera is not None:
            found = self._by_camera(search.view, camera, telemetry)
            middle_en_m = camera.middle_en_m
        else:
            found = self._by_similarity(search.view, best, telemetry)
            if orientation is not None:
                middle_en_m = ground.middle_en_m(orientation, pose)
        radius_m = max(self.radius_m, RADIUS_SHARE * found.agl_m)
        evidence = best.scores | found.stds
        if found.middle_cov_en_m2 is not None:
            widest = float(np.linalg.eigvalsh(found.middle_cov_en_m2)[-1])
            evidence["middle_std_m"] = math.sqrt(widest)
        if orientation is not None and not self.relief.is_level:
            evidence["terrain_gain"] = best.gain or 1.0
        lat, lon = self.sheet.frame.latlon_from_en(found.place_en_m)
        middle = None
        if middle_en_m is not None:
            middle_deg = self.sheet.frame.latlon_from_en(np.array(middle_en_m))
            middle = float(middle_deg[0]), float(middle_deg[1])
        for each in (found.cov_en_m2, found.middle_cov_en_m2, found.pose_cov):
            if each is not None:
                each.flags.writeable = False
        heading_deg, pitch_deg, roll_deg = found.attitude_deg
        return Fix(
            lat_deg=float(lat),
            lon_deg=float(lon),
            cov_en_m2=found.cov_en_m2,
            confidence=self._confidence_within(best, found, radius_m),
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

    def _confidence_within(self, best: Place, found: "_Exterior", radius_m: float) -> float:
        """That the place is right and the error within the radius."""
        if self.confidence is None:
            return math.nan
        covariance = ERROR_VARIANCE * found.cov_en_m2
        return self.confidence(best.scores) * within(found.place_en_m, covariance, radius_m)

    def _by_camera(
        self, view: PreparedView, camera: CameraFound, telemetry: Telemetry
    ) -> "_Exterior":
        """From the blocks of the view."""
        heading_deg, pitch_deg, roll_deg = camera.orientation.attitude_deg.tolist()
        _, _, up_m, heading, pitch, roll = np.sqrt(np.diag(camera.covariance)).tolist()
        floor_m2, covariance = np.eye(2) * self.floor_m(view) ** 2, camera.covariance.copy()
        covariance[:2, :2] += floor_m2
        middle = camera.middle_covariance
        return _Exterior(
            camera.orientation.position_m[:2],
            (heading_deg, pitch_deg, roll_deg),
            camera.agl_m,
            covariance[:2, :2].copy(),
            None if middle is None else middle + floor_m2,
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

    def _by_similarity(self, view: PreparedView, best: Place, telemetry: Telemetry) -> "_Exterior":
        """Under the reported pitch and roll."""
        pose, covariance = best.pose, best.fit.covariance
        assert covariance is not None
        spread = self.camera_covariance(view, pose, covariance)
        agl_m = telemetry.agl_m * math.exp(pose.log_scale)
        # A line of sight off nadir meets the ground farther out by 1 / cos^2.
        cos = math.cos(math.radians(off_nadir_deg(telemetry)))
        tilt_m = agl_m * math.radians(tilt_std_deg(telemetry)) / cos**2
        floor_m2 = np.eye(2) * self.floor_m(view) ** 2
        return _Exterior(
            self.camera_en_m(view, pose),
            (math.degrees(pose.turn_rad), telemetry.pitch_deg, telemetry.roll_deg),
            agl_m,
            spread[:2, :2] + np.eye(2) * tilt_m**2,
            covariance[:2, :2] * self.grid.gsd_m**2 + floor_m2,
            {
                "heading_std_deg": math.degrees(math.sqrt(spread[2, 2])),
                "log_scale_std": math.sqrt(spread[3, 3]),
            },
        )

    def floor_m(self, view: PreparedView) -> float:
        """Agreement of maps of two dates at the view's final level."""
        # Coarse imagery of another date is displaced by more (benchmarks/pixel_ellipses.py).
        return self.floor_px * self.grid.gsd_m * 2.0**view.levels.final

    def camera_en_m(self, view: PreparedView, pose: Pose) -> NDArray[np.float64]:
        """Of the camera (2,)."""
        return self.relief.en_m(pose.map_px(view.camera_px))

    def seen_from(self, view: PreparedView, pose: Pose) -> NDArray[np.float64]:
        """Of the camera (4,): m east and north, heading (rad), log scale."""
        return np.array([*self.camera_en_m(view, pose), pose.turn_rad, pose.log_scale])

    def pose_of(self, view: PreparedView, seen_from: NDArray[np.float64]) -> Pose:
        """The inverse of `seen_from`."""
        x, y = self.px_of(seen_from[:2])
        turn, log_scale = seen_from[2:].tolist()
        moved = Pose(0.0, 0.0, turn, log_scale).map_px(view.camera_px)
        return Pose(x - float(moved[0]), y - float(moved[1]), turn, log_scale)

    def camera_covariance(
        self, view: PreparedView, pose: Pose, covariance: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Of `seen_from`, by the covariance of the pose."""
        moved = pose.linear @ view.camera_px
        camera_from_pose = np.eye(4)
        camera_from_pose[:2, 2:] = [[-moved[1], moved[0]], [moved[0], moved[1]]]
        spread = camera_from_pose @ covariance @ camera_from_pose.T
        spread[:2, :2] += np.eye(2) * self.floor_px**2
        metres = np.diag([self.grid.gsd_m, -self.grid.gsd_m, 1.0, 1.0])
        return np.asarray(metres @ spread @ metres)


@dataclass(frozen=True, eq=False)
class _Exterior:
    """What a fix says of the camera; `stds` go into its evidence."""

    place_en_m: NDArray[np.float64]
    attitude_deg: tuple[float, float, float]
    agl_m: float
    cov_en_m2: NDArray[np.float64]
    middle_cov_en_m2: NDArray[np.float64] | None
    stds: dict[str, float]
    pose_cov: NDArray[np.float64] | None = None
