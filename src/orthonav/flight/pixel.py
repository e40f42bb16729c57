"""Where on the ground a pixel of a placed view lies, with its covariance.

Registration places the ground that a view shows; where the camera was follows from it. So errors of
heading, height and tilt move a pixel by what they change between the middle of the view and the
pixel, not by what they change at the camera. Fixes of a track, and those that do not say how well
the middle of their view is known (`middle_std_m`), are positions of the camera: all its errors
count. Errors are taken as independent.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import FlightError
from orthonav.geo.camera import Camera, ground_en_m
from orthonav.geo.frames import LocalFrame
from orthonav.geo.ground import TerrainHeights, sight_on_ground
from orthonav.records import DEFAULT_AGL_STD, DEFAULT_YAW_STD_DEG, Fix, Telemetry

STEP = 1e-3
"""Step of the derivatives: rad, and log scale."""
Array = NDArray[np.float64]
Relief = Callable[[Array], Array]
"""Heights (N,) above the ground under the camera at metres east and north of it (N, 2)."""


@dataclass(frozen=True, eq=False)
class GroundPoint:
    """A point on the ground.

    `lat_deg`, `lon_deg`: WGS84. `height_m`: above mean sea level, NaN without a terrain.
    `cov_en_m2` (2, 2): of east and north. `range_m`: distance from the camera.
    """

    lat_deg: float
    lon_deg: float
    height_m: float
    cov_en_m2: Array
    range_m: float


def locate_pixel(
    camera: Camera,
    telemetry: Telemetry,
    fix: Fix,
    px: tuple[float, float],
    terrain: TerrainHeights | None = None,
) -> GroundPoint:
    """The ground at image coordinates `px` (x, y; 0, 0 is the corner) of a view with a fix.

    `telemetry`: of the view, which gives pitch and roll. Without `terrain` the ground is level.
    Raises `FlightError` where the pixel is outside the picture or shows no ground that is known.
    """
    if not (0 <= px[0] <= camera.width_px and 0 <= px[1] <= camera.height_px):
        size = f"{camera.width_px} x {camera.height_px}"
        raise FlightError(f"pixel {px[0]:g}, {px[1]:g} is outside the picture of {size}")
    frame = LocalFrame(fix.lat_deg, fix.lon_deg)
    relief, below_m = None, math.nan
    if terrain is not None:
        below_m = float(terrain(np.array([fix.lat_deg]), np.array([fix.lon_deg]))[0])
        if not math.isfinite(below_m):
            raise FlightError("the terrain does not reach to the ground under the camera")
        relief = _relief(terrain, frame, below_m)
    values, stds = _orientation(telemetry, fix)
    middle = (camera.width_px / 2, camera.height_px / 2)
    here = _ground(camera, px, values, relief)
    if not np.isfinite(here).all():
        raise FlightError(f"pixel {px[0]:g}, {px[1]:g} shows no ground that is known")
    slopes = _slopes(camera, px, values, relief)
    if not np.isfinite(slopes).all():
        raise FlightError(f"pixel {px[0]:g}, {px[1]:g} is next to the horizon or unknown ground")
    covariance = fix.cov_en_m2 + _spread(slopes, stds)
    middle_m = fix.evidence.get("middle_std_m")
    if middle_m is not None and "heading_bias_std_deg" not in fix.evidence:
        at_middle = np.nan_to_num(_slopes(camera, middle, values, relief))
        covariance = np.eye(2) * middle_m**2 + _spread(slopes - at_middle, stds)
    lat, lon = frame.latlon_from_en(here)
    height_m = math.nan if terrain is None else float(terrain(np.array([lat]), np.array([lon]))[0])
    drop_m = values[1] - (0.0 if terrain is None else height_m - below_m)
    range_m = math.hypot(*here.tolist(), drop_m)
    return GroundPoint(float(lat), float(lon), height_m, covariance, range_m)


def _orientation(telemetry: Telemetry, fix: Fix) -> tuple[Array, Array]:
    """Heading (rad), height above ground (m), pitch and roll (rad), (4,), and the standard
    deviations (4,) of heading, log scale, pitch and roll."""
    evidence = fix.evidence
    biases = [evidence.get(f"{axis}_bias_deg", 0.0) for axis in ("pitch", "roll")]
    angles = np.radians(
        [fix.heading_deg, telemetry.pitch_deg + biases[0], telemetry.roll_deg + biases[1]]
    )
    values = np.array([angles[0], fix.agl_m, *angles[1:]])
    heading = evidence.get("heading_std_deg", evidence.get("heading_bias_std_deg"))
    scale = evidence.get("log_scale_std", evidence.get("log_scale_bias_std"))
    tilt = telemetry.tilt_std_deg or 0.0
    stds = [
        math.radians(DEFAULT_YAW_STD_DEG if heading is None else heading),
        DEFAULT_AGL_STD if scale is None else scale,
        *(math.radians(evidence.get(f"{axis}_bias_std_deg", tilt)) for axis in ("pitch", "roll")),
    ]
    return values, np.array(stds)


def _relief(terrain: TerrainHeights, frame: LocalFrame, below_m: float) -> Relief:
    def heights(points_en_m: Array) -> Array:
        lat, lon = frame.latlon_from_en(points_en_m)
        return np.asarray(terrain(lat, lon) - below_m)

    return heights


def _ground(camera: Camera, px: tuple[float, float], values: Array, relief: Relief | None) -> Array:
    """Metres east and north of the camera (2,) of the ground at a pixel; NaN without any."""
    agl_m = float(values[1])
    yaw_deg, pitch_deg, roll_deg = np.degrees(values[[0, 2, 3]]).tolist()
    # Offset for each metre that the line of sight descends.
    slope = ground_en_m(camera, np.array([px]), yaw_deg, pitch_deg, roll_deg, 1.0)[0]
    if relief is None:
        return np.asarray(slope * agl_m)
    return sight_on_ground(slope, agl_m, relief)


def _slopes(camera: Camera, px: tuple[float, float], values: Array, relief: Relief | None) -> Array:
    """Derivatives (2, 4) of the ground at a pixel by heading, log scale, pitch and roll."""
    columns = []
    for number in range(4):
        sides = []
        for sign in (1, -1):
            moved = values.copy()
            if number == 1:
                moved[1] *= math.exp(sign * STEP)
            else:
                moved[number] += sign * STEP
            sides.append(_ground(camera, px, moved, relief))
        columns.append((sides[0] - sides[1]) / (2 * STEP))
    return np.stack(columns, axis=1)


def _spread(slopes: Array, stds: Array) -> Array:
    """Covariance (2, 2) that standard deviations (4,) make by derivatives (2, 4)."""
    scaled = slopes * stds
    return np.asarray(scaled @ scaled.T)
