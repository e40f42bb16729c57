"""Where on the ground a pixel of a placed view lies, with its covariance.

Where a fix states the covariance of position, height and attitude together (`Fix.pose_cov`), all
six move the pixel. Errors of other fixes are taken as independent. Registration places the ground
that a view shows, so errors of heading, height and tilt move a pixel by what they change between
the middle of the view and the pixel. Fixes of a track, and those that do not say how well the
middle of their view is known (`Fix.ground_cov_en_m2`), are positions of the camera: all its errors
count.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError
from orthonav.core.geo.camera import Camera, ground_en_m
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.ground import TerrainHeights, sight_on_ground
from orthonav.core.records import (
    DEFAULT_AGL_STD,
    DEFAULT_TILT_STD_DEG,
    DEFAULT_YAW_STD_DEG,
    Fix,
    Telemetry,
    error_ellipse,
)

STEPS = np.array([0.1, 0.1, 0.1, 0.05, 0.05, 0.05])
"""Steps of the derivatives: metres east, north, up, degrees of heading, pitch, roll."""
Array = NDArray[np.float64]
Relief = Callable[[Array], Array]
"""Heights (N,) above the ground under the camera at metres east and north of it (N, 2)."""
ELLIPSE_95 = math.sqrt(5.991)
"""Axes of the 95 % ellipse over standard deviations: chi-squared of two degrees of freedom."""


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
    """The ground at image coordinates `px` (x, y; 0, 0: the stored corner) of a view with a fix.

    `telemetry`: of the view; it gives pitch and roll where the fix does not. Without
    `terrain` the ground is level.
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
        relief = partial(_relief, terrain, frame, below_m)
    # Metres east, north and up of the fix, heading, pitch and roll in degrees.
    values = np.array([0.0, 0.0, fix.agl_m, fix.heading_deg, *fix.tilt_deg(telemetry)])
    middle = (camera.width_px / 2, camera.height_px / 2)
    here = _ground(camera, px, values, relief)
    if not np.isfinite(here).all():
        raise FlightError(f"pixel {px[0]:g}, {px[1]:g} shows no ground that is known")
    slopes = _slopes(camera, px, values, relief)
    if not np.isfinite(slopes).all():
        raise FlightError(f"pixel {px[0]:g}, {px[1]:g} is next to the horizon or unknown ground")
    if fix.pose_cov is not None:
        covariance = slopes @ fix.pose_cov @ slopes.T
    elif fix.ground_cov_en_m2 is None:
        covariance = fix.cov_en_m2 + _spread(slopes[:, 2:], _stds(telemetry, fix))
    else:
        at_middle = np.nan_to_num(_slopes(camera, middle, values, relief))
        spread = _spread((slopes - at_middle)[:, 2:], _stds(telemetry, fix))
        covariance = np.eye(2) * error_ellipse(fix.ground_cov_en_m2)[0] ** 2 + spread
    lat, lon = frame.latlon_from_en(here)
    height_m = math.nan if terrain is None else float(terrain(np.array([lat]), np.array([lon]))[0])
    drop_m = fix.agl_m - (0.0 if terrain is None else height_m - below_m)
    range_m = math.hypot(*here.tolist(), drop_m)
    return GroundPoint(float(lat), float(lon), height_m, covariance, range_m)


def _stds(telemetry: Telemetry, fix: Fix) -> Array:
    """Standard deviations (4,) of height (m), heading, pitch and roll (deg), taken as
    independent."""
    stated, bias = telemetry.tilt_std_deg, fix.bias
    tilt = DEFAULT_TILT_STD_DEG if stated is None else stated
    choices = (
        (fix.log_scale_std, bias.log_scale_bias_std, DEFAULT_AGL_STD),
        (fix.heading_std_deg, bias.heading_bias_std_deg, DEFAULT_YAW_STD_DEG),
        (bias.pitch_bias_std_deg, tilt),
        (bias.roll_bias_std_deg, tilt),
    )
    stds = [next(filter(math.isfinite, each)) for each in choices]
    return np.array([fix.agl_m * stds[0], *stds[1:]])


def _relief(
    terrain: TerrainHeights, frame: LocalFrame, below_m: float, points_en_m: Array
) -> Array:
    return np.asarray(terrain(*frame.latlon_from_en(points_en_m)) - below_m)


def _ground(camera: Camera, px: tuple[float, float], values: Array, relief: Relief | None) -> Array:
    """Metres east and north (2,) of the fix of the ground that a camera (6,) shows at a pixel; NaN
    without any."""
    place, up_m = values[:2], float(values[2])
    # Offset for each metre that the line of sight descends.
    yaw_deg, pitch_deg, roll_deg = values[3:].tolist()
    slope = ground_en_m(camera, np.array([px]), yaw_deg, pitch_deg, roll_deg, 1.0)[0]
    if relief is None:
        return np.asarray(place + slope * up_m)
    return np.asarray(place + sight_on_ground(slope, up_m, lambda each: relief(each + place)))


def _slopes(camera: Camera, px: tuple[float, float], values: Array, relief: Relief | None) -> Array:
    columns = []
    for step in np.diag(STEPS):
        ahead, behind = (_ground(camera, px, values + sign * step, relief) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step.sum()))
    return np.stack(columns, axis=1)


def _spread(slopes: Array, stds: Array) -> Array:
    """Covariance (2, 2) that standard deviations (4,) make by derivatives (2, 4)."""
    scaled = slopes * stds
    return np.asarray(scaled @ scaled.T)


def ellipse_95(cov_en: NDArray[np.float64]) -> dict[str, float] | None:
    """The 95 % ellipse of a (2, 2) covariance in m^2, as commands and pages write it.

    Semi-axes `major_m` and `minor_m` to a millimetre, `direction_deg` of the major one to a tenth
    of a degree clockwise from north. None where `error_ellipse` has NaN.
    """
    major_m, minor_m, direction_deg = error_ellipse(cov_en)
    if math.isnan(major_m):
        return None
    return {
        "major_m": round(ELLIPSE_95 * major_m, 3),
        "minor_m": round(ELLIPSE_95 * minor_m, 3),
        "direction_deg": round(direction_deg, 1),
    }
