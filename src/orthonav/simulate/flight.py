"""Flights over an orthophoto: true pictures of the ground, telemetry that errs, truth beside it.

Positions are arbitrary, never on a tile grid. The picture is rendered with the true attitude and
height; what the telemetry tells differs from it by the stated errors.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.errors import AreaError, CameraError, FlightError
from orthonav.files import replacing_folder
from orthonav.flight.writer import FlightWriter
from orthonav.geo.area import Area
from orthonav.geo.camera import Camera, footprint_en_m
from orthonav.geo.route import Route, along_polyline_en_m
from orthonav.imagery.mosaic import Mosaic, SheetRaster
from orthonav.records import Prior, Telemetry
from orthonav.simulate.render import ViewEffects, render_view

DEFAULT_CAMERA = Camera(1280, 960, 1000.0, 1000.0, 640.0, 480.0)
MAX_VIEWS = 1_000_000
TRIES_PER_VIEW = 400
COVERAGE_PX = 1024
MARGIN_PX = 4
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Errors:
    """Standard deviations of what the telemetry gets wrong, and of how the camera leans.

    `agl_std` is a share of the height; `lean_std_deg` true pitch and roll, which are told;
    `tilt_std_deg` the error of the told ones. `prior_std_m` None tells no prior.
    """

    yaw_std_deg: float = 0.0
    agl_std: float = 0.0
    tilt_std_deg: float = 0.0
    lean_std_deg: float = 0.0
    prior_std_m: float | None = None

    def __post_init__(self) -> None:
        limits = {
            "yaw_std_deg": 180.0,
            "agl_std": 0.5,
            "tilt_std_deg": 20.0,
            "lean_std_deg": 20.0,
            "prior_std_m": 1e6,
        }
        for name, limit in limits.items():
            value = getattr(self, name)
            if value is not None and not 0 <= value <= limit:
                hint = " (a share of the height: 0.05 is 5 %)" if name == "agl_std" else ""
                raise FlightError(f"{name} must be 0 to {limit:g}, got {value}{hint}")


NO_ERRORS = Errors()
USUAL_EFFECTS = ViewEffects()


@dataclass(frozen=True)
class SimulateRequest:
    """What to fly: along `route` every `spacing_m`, or at `random` places; `agl_m` above ground.

    Without `agl_m` the shorter side of the image covers 256 pixels of the orthophoto.
    """

    orthos: Sequence[Path]
    out: Path
    route: Route | None = None
    random: int | None = None
    agl_m: float | None = None
    spacing_m: float | None = None
    speed_mps: float = 25.0
    camera: Camera = DEFAULT_CAMERA
    errors: Errors = NO_ERRORS
    effects: ViewEffects = USUAL_EFFECTS
    seed: int = 0


@dataclass(frozen=True)
class _Pose:
    position_en_m: Array
    yaw_deg: float
    pitch_deg: float
    roll_deg: float
    agl_m: float
    time_s: float


def simulate_flight(
    request: SimulateRequest, progress: Callable[[float], None] | None = None
) -> int:
    """Write a flight folder to `request.out`, whole or not at all; returns the number of views.

    Raises `AreaError` where no view fits into the imagery or the route leaves it, and as
    `Mosaic.open` does.
    """
    if (request.route is None) == (request.random is None):
        raise FlightError("fly along a route or at a number of random places, one of them")
    if request.random is not None and not 1 <= request.random <= MAX_VIEWS:
        raise FlightError(f"number of random places must be 1 to {MAX_VIEWS}: {request.random}")
    if request.seed < 0:
        raise FlightError(f"seed must be 0 or more, got {request.seed}")
    mosaic = Mosaic.open(request.orthos)
    outline = mosaic.outline_latlon_deg
    area = Area.from_outline(outline[:, 0], outline[:, 1])
    agl_m = _height_m(request, mosaic)
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
        coverage = _Coverage(mosaic, area)
        poses = list(_poses(request, area, agl_m, coverage))
        note = f"simulated over {mosaic.sources[0].path.name}, seed {request.seed}"
        writer = FlightWriter(folder, request.camera, note)
        digits = max(4, len(str(len(poses))))
        for number, pose in enumerate(poses):
            rng = np.random.default_rng([request.seed, 1, number])
            image = _picture(request, raster, west, north, gsd_m, pose, rng)
            lat, lon = area.frame.latlon_from_en(pose.position_en_m)
            telemetry = _told(request, area, pose, rng)
            quality = request.effects.jpeg_quality
            name = f"{number + 1:0{digits}d}.jpg"
            writer.add(name, image, telemetry, (float(lat), float(lon)), quality)
            if progress is not None:
                progress((number + 1) / len(poses))
        writer.close()
    return len(poses)


def _height_m(request: SimulateRequest, mosaic: Mosaic) -> float:
    camera = request.camera
    if request.agl_m is None:
        side_m = 256 * mosaic.gsd_m
        return side_m / min(camera.width_px / camera.fx_px, camera.height_px / camera.fy_px)
    if not 1 <= request.agl_m <= 50_000:
        raise FlightError(f"height above ground must be 1 to 50,000 m, got {request.agl_m}")
    return request.agl_m


class _Coverage:
    """Which places the imagery covers, thinned to at most `COVERAGE_PX` pixels across."""

    def __init__(self, mosaic: Mosaic, area: Area) -> None:
        self._west, south, east, self._north = area.extent_en_m
        across = max(east - self._west, self._north - south)
        self._gsd_m = max(mosaic.gsd_m, across / COVERAGE_PX)
        width = math.ceil((east - self._west) / self._gsd_m)
        height = math.ceil((self._north - south) / self._gsd_m)
        with mosaic.sheet(
            area.frame,
            west_m=self._west,
            north_m=self._north,
            width_px=width,
            height_px=height,
            gsd_m=self._gsd_m,
        ) as raster:
            self._missing = ~raster.read(0, 0, width, height).valid

    def sees_ground(self, camera: Camera, pose: _Pose) -> bool:
        """Whether the whole view lies on imagery, the horizon not in it."""
        try:
            return self.whole(_corners_en_m(camera, pose))
        except CameraError:
            return False

    def whole(self, corners_en_m: Array) -> bool:
        """Whether imagery lies under all of the quadrilateral (4, 2)."""
        x = (corners_en_m[:, 0] - self._west) / self._gsd_m
        y = (self._north - corners_en_m[:, 1]) / self._gsd_m
        height, width = self._missing.shape
        if min(x.min(), y.min()) < 0 or x.max() > width or y.max() > height:
            return False
        left, top = int(x.min()), int(y.min())
        part = self._missing[top : math.ceil(y.max()), left : math.ceil(x.max())]
        if not part.any():
            return True
        inside = np.zeros(part.shape, dtype=np.uint8)
        corners = np.round(np.stack([x - left, y - top], axis=1) - 0.5).astype(np.int32)
        cv2.fillConvexPoly(inside, corners, 1)
        return not (part & (inside > 0)).any()


def _poses(
    request: SimulateRequest, area: Area, agl_m: float, coverage: _Coverage
) -> Iterator[_Pose]:
    if request.route is not None:
        yield from _route_poses(request, request.route, area, agl_m, coverage)
        return
    west, south, east, north = area.extent_en_m
    for number in range(request.random or 0):
        rng = np.random.default_rng([request.seed, 0, number])
        for _ in range(TRIES_PER_VIEW):
            place = rng.uniform([west, south], [east, north])
            pose = _leaning(request, rng, place, rng.uniform(0, 360), agl_m, number * 1.0)
            if coverage.sees_ground(request.camera, pose):
                yield pose
                break
        else:
            corners = _corners_en_m(request.camera, _Pose(np.zeros(2), 0, 0, 0, agl_m, 0))
            wide, high = np.ptp(corners, axis=0)
            raise AreaError(
                f"found no place where a view of {wide:.0f} x {high:.0f} m lies within the "
                f"imagery of {east - west:.0f} x {north - south:.0f} m; fly lower (--agl-m)"
            )


def _route_poses(
    request: SimulateRequest, route: Route, area: Area, agl_m: float, coverage: _Coverage
) -> Iterator[_Pose]:
    line = route.points_en_m(area.frame)
    spacing_m = request.speed_mps if request.spacing_m is None else request.spacing_m
    if not (spacing_m > 0 and request.speed_mps > 0):
        raise FlightError("distance between views and speed must be above 0")
    places, courses = along_polyline_en_m(line, spacing_m)
    if len(places) > MAX_VIEWS:
        raise FlightError(f"route gives {len(places)} views, more than {MAX_VIEWS}")
    for number, (place, course) in enumerate(zip(places, courses, strict=True)):
        rng = np.random.default_rng([request.seed, 0, number])
        time_s = number * spacing_m / request.speed_mps
        pose = _leaning(request, rng, place, float(course), agl_m, time_s)
        if not coverage.sees_ground(request.camera, pose):
            lat, lon = area.frame.latlon_from_en(place)
            raise AreaError(
                f"view {number + 1} of the route, at {lat:.5f}, {lon:.5f}, "
                "does not lie wholly within the imagery"
            )
        yield pose


def _leaning(
    request: SimulateRequest,
    rng: np.random.Generator,
    place: Array,
    yaw_deg: float,
    agl_m: float,
    time_s: float,
) -> _Pose:
    lean = np.clip(rng.normal(0, 1, 2), -2.5, 2.5) * request.errors.lean_std_deg
    return _Pose(place, float(yaw_deg), float(lean[0]), float(lean[1]), agl_m, time_s)


def _corners_en_m(camera: Camera, pose: _Pose) -> Array:
    corners = footprint_en_m(camera, pose.yaw_deg, pose.pitch_deg, pose.roll_deg, pose.agl_m)
    return pose.position_en_m + corners


def _picture(
    request: SimulateRequest,
    raster: SheetRaster,
    west_m: float,
    north_m: float,
    gsd_m: float,
    pose: _Pose,
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """What the camera sees (H, W, 3), rendered from the window of imagery under it."""
    corners = _corners_en_m(request.camera, pose)
    cols = (corners[:, 0] - west_m) / gsd_m
    rows = (north_m - corners[:, 1]) / gsd_m
    left, top = math.floor(cols.min()) - MARGIN_PX, math.floor(rows.min()) - MARGIN_PX
    width = math.ceil(cols.max()) + MARGIN_PX - left
    height = math.ceil(rows.max()) + MARGIN_PX - top
    pixels = raster.read(left, top, width, height)
    corner = np.array([west_m + left * gsd_m, north_m - top * gsd_m]) - pose.position_en_m
    attitude = (pose.yaw_deg, pose.pitch_deg, pose.roll_deg, pose.agl_m)
    return render_view(request.camera, attitude, pixels.rgb, corner, gsd_m, request.effects, rng)


def _told(request: SimulateRequest, area: Area, pose: _Pose, rng: np.random.Generator) -> Telemetry:
    """Telemetry of a pose with its errors."""
    errors = request.errors
    prior = None
    if errors.prior_std_m is not None:
        place = pose.position_en_m + rng.normal(0, errors.prior_std_m, 2)
        lat, lon = area.frame.latlon_from_en(place)
        prior = Prior(float(lat), float(lon), errors.prior_std_m)
    return Telemetry(
        time_ns=round(pose.time_s * 1e9),
        yaw_deg=round((pose.yaw_deg + rng.normal(0, 1) * errors.yaw_std_deg) % 360, 3),
        pitch_deg=round(pose.pitch_deg + rng.normal(0, 1) * errors.tilt_std_deg, 3),
        roll_deg=round(pose.roll_deg + rng.normal(0, 1) * errors.tilt_std_deg, 3),
        agl_m=round(pose.agl_m * max(0.05, 1 + rng.normal(0, 1) * errors.agl_std), 3),
        yaw_std_deg=errors.yaw_std_deg or None,
        agl_std_m=errors.agl_std * pose.agl_m or None,
        prior=prior,
    )
