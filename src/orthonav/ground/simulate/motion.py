"""Motion along a route: corners, reported velocity, and tilt of camera and horizon."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import attitude_of, enu_from_camera
from orthonav.ground.planning.route import along_polyline_en_m

HORIZON_TIME_S = 15.0  # errors of real autopilots change within 10 to 30 s
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FlownPath:
    places_en_m: Array  # (N, 2)
    headings_deg: Array  # (N,)
    times_s: Array  # (N,) time since the first
    velocities_en_mps: Array  # (N, 2) mean over ground since the previous view


def steady_path(line_en_m: Array, spacing_m: float, speed_mps: float) -> FlownPath:
    """Path along the polyline (M, 2) in still air; the heading equals the course."""
    places, courses = along_polyline_en_m(line_en_m, spacing_m)
    times = np.arange(len(places), dtype=np.float64) * spacing_m / speed_mps
    first = speed_mps * direction(float(courses[0]))
    moved = np.diff(places, axis=0) / np.diff(times)[:, None]
    return FlownPath(places, courses, times, np.concatenate([first[None], moved]))


def gauss_markov(step: float, count: int, rng: np.random.Generator) -> Array:
    """A stationary Ornstein-Uhlenbeck process (N, 2) of standard deviation 1, sampled every `step`
    time constants (Gillespie 1996, doi:10.1103/PhysRevE.54.2084)."""
    decay = math.exp(-step)
    values = [rng.normal(0, 1, 2)]
    while len(values) < count:
        values.append(decay * values[-1] + math.sqrt(1 - decay**2) * rng.normal(0, 1, 2))
    return np.array(values)


def drifting(velocities: Array, times_s: Array, drift: float, rng: np.random.Generator) -> Array:
    """Velocities (N, 2) as reported by odometry whose scale (a share) and direction (rad) err with
    the standard deviation `drift`."""
    constant_s = 300.0  # it hardly changes within a minute
    off = drift * gauss_markov(_step_s(times_s) / constant_s, len(times_s), rng)
    cos, sin = np.cos(off[:, 1]), np.sin(off[:, 1])
    east, north = velocities.T
    turned = np.stack([cos * east + sin * north, cos * north - sin * east], axis=1)
    return np.asarray((1 + off[:, :1]) * turned)


def rounded(line_en_m: Array, radius_m: float) -> Array:
    """The polyline (M, 2) with rounded corners; arcs are tighter at short legs. About-turns are
    left unchanged."""
    if len(line_en_m) < 3:
        return line_en_m
    parts = [line_en_m[:1]]
    for before, corner, after in zip(line_en_m, line_en_m[1:], line_en_m[2:], strict=False):
        parts.append(_arc(before, corner, after, radius_m))
    return np.concatenate([*parts, line_en_m[-1:]])


def _arc(before: Array, corner: Array, after: Array, radius_m: float) -> Array:
    """Points (K, 2) of the arc between two legs, which replaces at most half of each."""
    legs = np.array([corner - before, after - corner])
    lengths = np.linalg.norm(legs, axis=1)
    if lengths.min() == 0:
        return corner[None]
    into, out = legs / lengths[:, None]
    turn = math.atan2(into[0] * out[1] - into[1] * out[0], float(into @ out))
    if not 1e-6 < abs(turn) < math.radians(179):  # sharper ones are flown on the spot
        return corner[None]
    tangent_m = min(radius_m * math.tan(abs(turn) / 2), float(lengths.min()) / 2)
    radius_m = tangent_m / math.tan(abs(turn) / 2)
    left = np.array([-into[1], into[0]]) * math.copysign(1.0, turn)
    every_2_deg = 2 + int(math.degrees(abs(turn)) / 2)
    angles = np.linspace(0, abs(turn), every_2_deg)[:, None]
    start = corner - tangent_m * into
    return np.asarray(start + radius_m * (np.sin(angles) * into + (1 - np.cos(angles)) * left))


def mounted(
    attitude_deg: tuple[float, float, float], pitch_deg: float, roll_deg: float
) -> tuple[float, float, float]:
    level = enu_from_camera(0.0, 0.0, 0.0)
    tilted = enu_from_camera(0.0, pitch_deg, roll_deg)
    return attitude_of(enu_from_camera(*attitude_deg) @ level.T @ tilted)


def direction(course_deg: float) -> Array:
    """Unit vector (2,), east and north, of a course clockwise from north."""
    angle = math.radians(course_deg)
    return np.array([math.sin(angle), math.cos(angle)])


def horizon_errors(std_deg: float, times_s: Array, rng: np.random.Generator) -> Array:
    """True minus reported pitch and roll (N, 2) along a route, deg, at evenly spaced times (N,). A
    first-order Gauss-Markov process of this standard deviation."""
    return std_deg * gauss_markov(_step_s(times_s) / HORIZON_TIME_S, len(times_s), rng)


def _step_s(times_s: Array) -> float:
    return float(times_s[1] - times_s[0]) if len(times_s) > 1 else 1.0


def camera_attitude(
    reported_deg: tuple[float, float, float], horizon_deg: Array, mount_deg: Array
) -> tuple[float, float, float]:
    """Heading, pitch and roll of a camera whose aircraft is tilted by `horizon_deg` (2,) more than
    reported, in a mount that leans by `mount_deg` (2,)."""
    yaw_deg, pitch_deg, roll_deg = reported_deg
    pitch_off, roll_off = horizon_deg.tolist()
    aircraft = yaw_deg, pitch_deg + pitch_off, roll_deg + roll_off
    pitch_mount, roll_mount = mount_deg.tolist()
    return mounted(aircraft, pitch_mount, roll_mount) if pitch_mount or roll_mount else aircraft
