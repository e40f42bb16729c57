"""Simulated flights over an orthophoto: images, telemetry with errors, and the true positions.

Positions are arbitrary, never on a tile grid. Images are rendered with the true attitude and
height; the telemetry differs from these by the requested errors."""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError, CameraError, FlightError, UsageError
from orthonav.core.files import GivenPath, replacing_folder, with_paths
from orthonav.core.flight.folder import FlightWriter
from orthonav.core.flight.gnss import FILE as GNSS_FILE
from orthonav.core.flight.gnss import write_gnss
from orthonav.core.geo.camera import Camera, footprint_en_m
from orthonav.core.geo.ground import TerrainHeights
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.records import Prior, Telemetry
from orthonav.ground.build.layer import Surface
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.imagery.terrain import Dem
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Route
from orthonav.ground.planning.spacing import DEFAULT_CAMERA as DEFAULT_CAMERA
from orthonav.ground.simulate.ground import (
    Coverage,
    GroundImagery,
    bare_earth,
    ground_below_m,
    near_ground_en_m,
    reported_heights,
    seen_over,
    surface_of,
)
from orthonav.ground.simulate.motion import (
    FlownPath,
    camera_attitude,
    drifting,
    horizon_errors,
    rounded,
    steady_path,
)
from orthonav.ground.simulate.receiver import Good, samples_of, solutions
from orthonav.ground.simulate.render import Raster, ViewEffects, degraded, projected

MAX_VIEWS = 1_000_000  # sanity limit
Array = NDArray[np.float64]
Clouds = Callable[
    [int, Camera, tuple[float, float, float, float], Array, NDArray[np.uint8]], NDArray[np.uint8]
]
"""A picture with its clouds, such as `lab.clouds` makes: by the number of the view, its camera,
heading, pitch, roll (deg) and height (m), position (2,), and the picture without them."""


@dataclass(frozen=True)
class Errors:
    """Errors of the telemetry, and motion of the camera; none by default.

    Standard deviations of reported values are drawn for every view, and the telemetry states them;
    it states neither biases nor unreported tilt."""

    yaw_std_deg: float = 0.0  # reported heading, 0..180
    agl_std: float = 0.0  # reported height, a fraction of it, 0..0.5
    tilt_std_deg: float = 0.0  # reported pitch and roll, 0..20
    attitude_std_deg: float = 0.0  # true pitch and roll, which are reported, 0..20
    prior_std_m: float | None = None  # reported prior position, per axis, 0..1e6; None: no prior
    yaw_bias_deg: float = 0.0  # reported minus true heading, -180..180
    agl_bias: float = 0.0  # reported minus true height, a fraction of it, -0.5..0.5
    pitch_bias_deg: float = 0.0  # unreported tilt of the camera mount, -20..20
    roll_bias_deg: float = 0.0
    velocity_drift: float | None = None
    """Standard deviation of scale (a share) and direction (rad) of the reported velocity, 0..0.5,
    see `motion.drifting`; None: no velocity is reported."""
    mount_std_deg: float = 0.0  # unreported tilt of the mount, drawn once a flight, 0..20
    horizon_std_deg: float = 0.0
    """Unreported tilt of the horizon, 0..20: independent at random positions, along a route
    correlated over `motion.HORIZON_TIME_S`."""

    def __post_init__(self) -> None:
        limits = {"agl": 0.5, "prior": 1e6, "velocity": 0.5, "yaw": 180.0}  # tilt: 20 deg
        for each in fields(self):
            name, limit = each.name, limits.get(each.name.split("_")[0], 20.0)
            value, least = getattr(self, name), -limit if "_bias" in name else 0.0
            if value is not None and not least <= value <= limit:
                whole = {"agl": "the height", "velocity": "the velocity"}.get(name.split("_")[0])
                hint = f" (a fraction of {whole}: 0.05 is 5 %)" if whole else ""
                raise UsageError(f"{name} must be {least:g} to {limit:g}, got {value}{hint}")

    def mount_deg(self, seed: int) -> Array:
        """Unreported pitch and roll (2,) of the camera in the aircraft."""
        drawn = np.random.default_rng([seed, 6]).normal(0, 1, 2) * self.mount_std_deg
        return np.array([self.pitch_bias_deg, self.roll_bias_deg]) + drawn

    @property
    def reported_tilt_std_deg(self) -> float | None:
        """`tilt_std_deg` as the telemetry states it: None, unknown, where all tilt error is
        unreported; 0, exact, where there is none."""
        biases = self.pitch_bias_deg, self.roll_bias_deg
        if self.tilt_std_deg == 0 and any((self.mount_std_deg, self.horizon_std_deg, *biases)):
            return None
        return self.tilt_std_deg


@dataclass(frozen=True)
class SimulateRequest:
    """Parameters of a simulated flight: along `route`, or at `random` positions, one of the two."""

    orthos: Sequence[GivenPath]  # orthophotos to fly over; earlier ones take precedence
    out: GivenPath  # flight folder to write
    route: Route | None = None
    random: int | None = None  # number of positions, 1..1e6
    agl_m: float | None = None
    """Height above ground, 1..50,000 m; on a route over a terrain that at the first view, and the
    altitude is constant. None: the shorter side of a view covers 256 pixels of the orthophoto."""
    spacing_m: float | None = None  # between views on a route; None: flown in one second
    airspeed_mps: float = 25.0
    camera: Camera = DEFAULT_CAMERA
    errors: Errors = field(default_factory=Errors)
    effects: ViewEffects = field(default_factory=ViewEffects)
    seed: int = 0  # of all random draws, 0 or more; equal requests give equal bytes
    turn_radius_m: float = 0.0  # of the corners of a route, 0..100,000; 0 turns on the spot
    clouds: Callable[[int, int], Clouds] | None = None  # by the number of views and the seed
    terrain: TerrainHeights | None = None
    """Heights above mean sea level. Views are then true perspectives, and the telemetry reports
    heights above sea level and, on a route, above the first view, but none above ground."""
    terrain_posting_m: float = 5.0  # resolution of the terrain, if there is no surface
    surface: Sequence[Dem] = ()
    """Models with houses and trees, which views show, above sea; earlier ones take precedence.
    Heights above ground count from `terrain`, or else from their lower envelope."""
    camera_pitch_deg: float = 0.0  # ahead of straight down, 0..65; reported
    gnss: Good | None = None  # receiver whose solutions are written to `gnss.csv`; only on a route

    def __post_init__(self) -> None:
        if isinstance(self.orthos, str | os.PathLike):
            object.__setattr__(self, "orthos", (self.orthos,))
        with_paths(self, "orthos", "out")

    @property
    def in_perspective(self) -> bool:
        """Whether views are rendered ray by ray; else as level ground seen without the horizon by a
        lens without distortion."""
        has_heights = self.terrain is not None or bool(self.surface)
        return has_heights or self.camera_pitch_deg > 0 or not self.camera.is_pinhole


@dataclass(frozen=True)
class _Pose:
    """True pose of the camera at one view. `reported_deg`: heading, pitch and roll as reported, but
    for noise and bias of the telemetry. `reported_en_mps`: reported velocity over ground, None if
    not reported. `home_m`, `amsl_m`: height above take-off and above sea level, None if not
    reported."""

    position_en_m: Array
    yaw_deg: float
    pitch_deg: float
    roll_deg: float
    agl_m: float
    time_s: float
    reported_deg: tuple[float, float, float]
    reported_en_mps: tuple[float, float] | None = None
    home_m: float | None = None
    amsl_m: float | None = None

    @property
    def attitude(self) -> tuple[float, float, float, float]:
        """Heading, pitch, roll (deg) and height (m) of the camera."""
        return self.yaw_deg, self.pitch_deg, self.roll_deg, self.agl_m


def simulate_flight(
    request: SimulateRequest, progress: Callable[[float], None] | None = None
) -> int:
    """Write a flight folder to `request.out`, complete or not at all; returns the number of views.

    Raises `UsageError` on impossible parameters, `FlightError` where a view would be too low,
    `AreaError` if no view fits into the imagery or the route leaves it, and as `Mosaic.open` does.
    """
    _check(request)
    mosaic = Mosaic.open(request.orthos)
    outline = mosaic.outline_latlon_deg
    area = Area.from_outline(outline[:, 0], outline[:, 1])
    model = Surface(request.surface, area) if request.surface else None
    if model is not None:
        terrain = bare_earth(model, request.terrain)
        request = replace(request, terrain=terrain, terrain_posting_m=model.gsd_m)
    agl_m = request.agl_m or 256 * mosaic.gsd_m / min(request.camera.extent)
    west, south, east, north = area.extent_en_m
    gsd_m = max(mosaic.gsd_m, request.camera.gsd_m(agl_m) * 0.75)
    raster = mosaic.sheet(
        area.frame,
        west_m=west,
        north_m=north,
        width_px=math.ceil((east - west) / gsd_m),
        height_px=math.ceil((north - south) / gsd_m),
        gsd_m=gsd_m,
    )
    with replacing_folder(request.out) as folder, raster:
        scene = _Scene(request, area, agl_m, Coverage(mosaic, area))
        poses = list(scene.poses())
        mirror_en_m = scene.coverage.box_en_m() if request.in_perspective else None
        ground = GroundImagery(raster, west, north, gsd_m, mirror_en_m)
        surface = None
        if request.in_perspective:
            posting_m = request.terrain_posting_m
            surface = surface_of(request.terrain, area.frame, area.extent_en_m, posting_m, model)
            if model is not None:
                _require_above(surface, poses)
        clouds = request.clouds(len(poses), request.seed) if request.clouds else None
        note = f"simulated over {mosaic.sources[0].path.name}, seed {request.seed}"
        writer = FlightWriter(folder, request.camera, note)
        digits = max(4, len(str(len(poses))))
        for number, pose in enumerate(poses):
            rng = np.random.default_rng([request.seed, 1, number])
            image = _picture(request.camera, ground, surface, pose)
            if clouds is not None:
                image = clouds(number, request.camera, pose.attitude, pose.position_en_m, image)
            image = degraded(image, request.effects, rng)
            lat, lon = area.frame.latlon_from_en(pose.position_en_m)
            telemetry, quality = scene.telemetry(pose, rng), request.effects.jpeg_quality
            name = f"{number + 1:0{digits}d}.jpg"
            writer.add(name, image, telemetry, (float(lat), float(lon)), quality)
            if progress is not None:
                progress((number + 1) / len(poses))
        writer.close()
        if request.gnss is not None:
            times = np.array([pose.time_s for pose in poses])
            places = np.array([pose.position_en_m for pose in poses])
            rng = np.random.default_rng([request.seed, 5])
            made = solutions(request.gnss, times, places, rng)
            write_gnss(folder / GNSS_FILE, samples_of(made, area.frame))
    return len(poses)


def _check(request: SimulateRequest) -> None:
    if (request.route is None) == (request.random is None):
        raise UsageError("give either a route or a number of random positions")
    limits: dict[str, tuple[float | None, float, float]] = {
        "random": (request.random, 1, MAX_VIEWS),
        "agl_m": (request.agl_m, 1, 50_000),
        "seed": (request.seed, 0, math.inf),
        "turn_radius_m": (request.turn_radius_m, 0, 100_000),
        "camera_pitch_deg": (request.camera_pitch_deg, 0, 65),
    }
    for what, (value, least, most) in limits.items():
        if value is not None and not least <= value <= most:
            raise UsageError(f"{what} must be {least:,} to {most:,g}, got {value}")
    if request.clouds and request.camera_pitch_deg:
        raise UsageError("clouds are simulated below cameras that look straight down only")
    on_a_route = {
        "turn_radius_m": request.turn_radius_m > 0,
        "velocity_drift": request.errors.velocity_drift is not None,
        "gnss": request.gnss is not None,
    }
    given = [name for name, value in on_a_route.items() if value]
    if request.route is None and given:
        raise UsageError(f"{', '.join(given)}: only along a route, not at random positions")


def _require_above(surface: Raster, poses: Sequence[_Pose]) -> None:
    """Raise `FlightError` for a camera in a house or tree."""
    places = np.array([pose.position_en_m for pose in poses])
    tops_m = surface.at(*places.T)
    for number, (pose, top_m) in enumerate(zip(poses, tops_m.tolist(), strict=True), start=1):
        if pose.amsl_m is not None and pose.amsl_m < top_m + 1:
            raise FlightError(
                f"view {number} is {pose.agl_m:.0f} m above ground, in a house or tree; fly higher "
                "(--agl-m)"
            )


@dataclass(frozen=True, eq=False)
class _Scene:
    """A requested flight in the plane of its imagery; `agl_m`: height of the first view."""

    request: SimulateRequest
    area: Area
    agl_m: float
    coverage: Coverage

    def poses(self) -> Iterator[_Pose]:
        route = self.request.route
        return self._random_poses() if route is None else self._route_poses(route)

    def _random_poses(self) -> Iterator[_Pose]:
        request, errors = self.request, self.request.errors
        west, south, east, north = self.area.extent_en_m
        count, rng = request.random or 0, np.random.default_rng([request.seed, 7])
        horizon = rng.normal(0, 1, (count, 2)) * errors.horizon_std_deg
        for number in range(count):
            rng = np.random.default_rng([request.seed, 0, number])
            for _ in range(400):  # suffices if imagery covers 2 % of random positions
                place = rng.uniform([west, south], [east, north])
                yaw_deg = rng.uniform(0, 360)
                pose = self._pose(rng, place, yaw_deg, self.agl_m, float(number), horizon[number])
                if self._sees_ground(pose):
                    break
            else:
                wide, high = np.ptp(footprint_en_m(request.camera, 0, 0, 0, self.agl_m), axis=0)
                raise AreaError(
                    f"found no position where a view of {wide:.0f} x {high:.0f} m lies within the "
                    f"imagery of {east - west:.0f} x {north - south:.0f} m; fly lower (--agl-m)"
                )
            if request.terrain is not None:
                below_m = ground_below_m(request.terrain, self.area.frame, place[None])
                pose = replace(pose, amsl_m=pose.agl_m + float(below_m[0]))
            yield pose

    def _route_poses(self, route: Route) -> Iterator[_Pose]:
        request, errors, frame = self.request, self.request.errors, self.area.frame
        path = _path(request, route.points_en_m(frame))
        rng = np.random.default_rng([request.seed, 7])
        horizon = horizon_errors(errors.horizon_std_deg, path.times_s, rng)
        reported = None
        if errors.velocity_drift is not None:
            rng = np.random.default_rng([request.seed, 4])
            reported = drifting(path.velocities_en_mps, path.times_s, errors.velocity_drift, rng)
        ground_m = None
        if request.terrain is not None:
            ground_m = ground_below_m(request.terrain, frame, path.places_en_m)
        for number, place in enumerate(path.places_en_m):
            rng = np.random.default_rng([request.seed, 0, number])
            above_m = self.agl_m
            if ground_m is not None:
                above_m += float(ground_m[0] - ground_m[number])
            if not above_m >= 1:
                raise FlightError(
                    f"view {number + 1} of the route is {above_m:.0f} m above the terrain; fly "
                    "higher (--agl-m)"
                )
            heading_deg, time_s = float(path.headings_deg[number]), float(path.times_s[number])
            pose = self._pose(rng, place, heading_deg, above_m, time_s, horizon[number])
            if reported is not None:
                east_mps, north_mps = (round(float(each), 4) for each in reported[number])
                pose = replace(pose, reported_en_mps=(east_mps, north_mps))
            if ground_m is not None:
                amsl_m = self.agl_m + float(ground_m[0])
                pose = replace(pose, home_m=self.agl_m, amsl_m=amsl_m)
            if not self._sees_ground(pose):
                lat, lon = (float(value) for value in frame.latlon_from_en(place))
                raise AreaError(
                    f"view {number + 1} of the route, at {lat:.5f}, {lon:.5f}, "
                    f"does not lie completely within the imagery{_swapped(self.area, route)}"
                )
            yield pose

    def _pose(
        self,
        rng: np.random.Generator,
        place: Array,
        yaw_deg: float,
        agl_m: float,
        time_s: float,
        horizon_deg: Array,
    ) -> _Pose:
        """A pose at a place; `horizon_deg`: unreported pitch and roll (2,) of the horizon."""
        request = self.request
        tilt = np.clip(rng.normal(0, 1, 2), -2.5, 2.5) * request.errors.attitude_std_deg
        reported = yaw_deg, request.camera_pitch_deg + float(tilt[0]), float(tilt[1])
        true = camera_attitude(reported, horizon_deg, request.errors.mount_deg(request.seed))
        return _Pose(place, *true, agl_m, time_s, reported)

    def _sees_ground(self, pose: _Pose) -> bool:
        camera, angles_deg = self.request.camera, pose.attitude[:3]
        if self.request.camera_pitch_deg > 0 or not camera.is_pinhole:
            outline = near_ground_en_m(camera, angles_deg, pose.agl_m)
            return outline is not None and self.coverage.whole(pose.position_en_m + outline)
        try:
            return self.coverage.whole(_corners_en_m(camera, pose))
        except CameraError:
            return False

    def telemetry(self, pose: _Pose, rng: np.random.Generator) -> Telemetry:
        """What is reported of the pose, with its errors."""
        errors, height = self.request.errors, 1 + self.request.errors.agl_bias
        yaw_deg, pitch_deg, roll_deg = pose.reported_deg
        yaw_deg += errors.yaw_bias_deg
        prior = None
        if errors.prior_std_m is not None:
            place = pose.position_en_m + rng.normal(0, errors.prior_std_m, 2)
            lat, lon = self.area.frame.latlon_from_en(place)
            prior = Prior(float(lat), float(lon), errors.prior_std_m)
        telemetry = Telemetry(
            time_ns=round(pose.time_s * 1e9),
            yaw_deg=round((yaw_deg + rng.normal(0, 1) * errors.yaw_std_deg) % 360, 3),
            pitch_deg=round(pitch_deg + rng.normal(0, 1) * errors.tilt_std_deg, 3),
            roll_deg=round(roll_deg + rng.normal(0, 1) * errors.tilt_std_deg, 3),
            agl_m=round(pose.agl_m * max(0.05, height + rng.normal(0, 1) * errors.agl_std), 3),
            yaw_std_deg=errors.yaw_std_deg or None,
            agl_std_m=errors.agl_std * pose.agl_m or None,
            tilt_std_deg=errors.reported_tilt_std_deg,
            prior=prior,
            vel_en_mps=pose.reported_en_mps,
        )
        if pose.amsl_m is None:
            return telemetry
        return reported_heights(telemetry, pose.agl_m, pose.home_m, pose.amsl_m)


def _swapped(area: Area, route: Route) -> str:
    def within(lat: float, lon: float) -> bool:
        return bool(area.contains(area.frame.en_from_latlon([lat], [lon]))[0])

    hints = (swapped_hint(lat, lon, within) for lat, lon in route.waypoints)
    return next(filter(None, hints), "")


def _path(request: SimulateRequest, line_en_m: Array) -> FlownPath:
    airspeed_mps = request.airspeed_mps
    spacing_m = airspeed_mps if request.spacing_m is None else request.spacing_m
    if not (0 < spacing_m < math.inf and 0 < airspeed_mps < math.inf):
        raise UsageError("spacing_m must be above 0, and the airspeed too")
    line = rounded(line_en_m, request.turn_radius_m) if request.turn_radius_m else line_en_m
    length_m = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    if length_m / spacing_m > MAX_VIEWS:
        raise UsageError(
            f"route of {length_m / 1000:,.1f} km with a view every {spacing_m:g} m has more than "
            f"{MAX_VIEWS:,} views; increase the distance between views"
        )
    return steady_path(line, spacing_m, airspeed_mps)


def _corners_en_m(camera: Camera, pose: _Pose) -> Array:
    return pose.position_en_m + footprint_en_m(camera, *pose.attitude)


def _picture(
    camera: Camera, ground: GroundImagery, surface: Raster | None, pose: _Pose
) -> NDArray[np.uint8]:
    if surface is not None:
        above_m = pose.agl_m if pose.amsl_m is None else pose.amsl_m
        position = np.array([*pose.position_en_m, above_m])
        return seen_over(surface, ground, camera, pose.attitude[:3], position, pose.agl_m)
    rgb, corner_en_m = ground.window(_corners_en_m(camera, pose))
    corner = corner_en_m - pose.position_en_m
    return projected(camera, pose.attitude, rgb, corner, ground.gsd_m)
