"""Motion along a route: corners, wind, reported velocity, and tilt of camera and horizon."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError
from orthonav.core.geo.camera import attitude_of, enu_from_camera
from orthonav.ground.planning.route import along_polyline_en_m

GUST_STD = 0.15  # standard deviation of the gusts per axis, as a fraction of the wind speed
LARGEST_GUST = 0.4  # largest gust, as a fraction of the wind speed
GUST_TIME_S = 60.0  # time constant of the gusts
DRIFT_TIME_S = 300.0  # time constant of the odometry error, which hardly changes within a minute
ARC_STEP_DEG = 2.0  # angle between the points of an arc
SHARPEST_DEG = 179.0  # sharper corners are flown as turns on the spot
LONGEST_STEP_S = 0.5  # longest time step with constant wind and course
HORIZON_TIME_S = 15.0  # errors of real autopilots change within 10 to 30 s
MAX_STEPS = 1_000_000  # limit of the time steps of a flight in wind: 139 hours
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Wind:
    """Wind that comes from `from_deg` (clockwise from true north). Gusts are an Ornstein-Uhlenbeck
    process per axis."""

    speed_mps: float
    from_deg: float = 270.0

    def __post_init__(self) -> None:
        if not 0 <= self.speed_mps <= 200:
            raise FlightError(f"wind must be 0 to 200 m/s, got {self.speed_mps}")
        if not -360 <= self.from_deg <= 360:
            raise FlightError(
                f"wind direction must be -360 to 360 deg from true north, got {self.from_deg}"
            )

    @property
    def strongest_mps(self) -> float:
        return self.speed_mps * (1 + LARGEST_GUST)

    @property
    def velocity_en_mps(self) -> Array:
        return -self.speed_mps * direction(self.from_deg)


@dataclass(frozen=True, eq=False)
class FlownPath:
    places_en_m: Array  # (N, 2)
    headings_deg: Array  # (N,)
    times_s: Array  # (N,) time since the first
    first_velocity_en_mps: Array  # (2,) velocity over ground at the first

    @property
    def velocities_en_mps(self) -> Array:
        """Mean velocity over ground (N, 2) since the previous view; integrates to the positions."""
        moved = np.diff(self.places_en_m, axis=0) / np.diff(self.times_s)[:, None]
        return np.concatenate([self.first_velocity_en_mps[None], moved])


def steady_path(line_en_m: Array, spacing_m: float, speed_mps: float) -> FlownPath:
    """Path along the polyline (M, 2) in still air; the heading equals the course."""
    places, courses = along_polyline_en_m(line_en_m, spacing_m)
    first = speed_mps * direction(float(courses[0]))
    times = np.arange(len(places), dtype=np.float64) * spacing_m / speed_mps
    return FlownPath(places, courses, times, first)


def windy_path(
    line_en_m: Array,
    spacing_m: float,
    airspeed_mps: float,
    wind: Wind,
    rng: np.random.Generator,
    most: int,
) -> FlownPath:
    """Path along the polyline (M, 2) in wind, with a crab angle and a varying ground speed. Views
    are `spacing_m / airspeed_mps` seconds apart, at most `most` + 1."""
    if wind.strongest_mps >= airspeed_mps:
        raise FlightError(
            f"wind of {wind.speed_mps:g} m/s, {wind.strongest_mps:.3g} m/s in gusts, is too strong "
            f"for an airspeed of {airspeed_mps:g} m/s: the aircraft cannot follow its route"
        )
    legs = np.diff(line_en_m, axis=0)
    lengths = np.linalg.norm(legs, axis=1)
    legs, starts, lengths = legs[lengths > 0], line_en_m[:-1][lengths > 0], lengths[lengths > 0]
    if not len(legs):
        return steady_path(line_en_m, spacing_m, airspeed_mps)
    courses, ends = legs / lengths[:, None], np.cumsum(lengths)
    interval_s = spacing_m / airspeed_mps
    least_s = ends[-1] / (airspeed_mps + wind.strongest_mps)
    if max(least_s, interval_s) > MAX_STEPS * LONGEST_STEP_S:
        raise _too_long()
    steps = math.ceil(interval_s / LONGEST_STEP_S)
    air = _moving_air(wind, interval_s / steps, rng)
    rows: list[tuple[float, ...]] = []
    along_m, number = 0.0, 0
    while along_m <= ends[-1] + 1e-9 and len(rows) <= most:
        leg = min(int(np.searchsorted(ends, along_m)), len(ends) - 1)
        course, moved_by = courses[leg], next(air)
        across = np.array([course[1], -course[0]])
        drift_mps = float(moved_by @ across)
        ahead_mps = math.sqrt(airspeed_mps**2 - drift_mps**2)
        ground_mps = ahead_mps + float(moved_by @ course)
        if number % steps == 0:
            place = starts[leg] + (along_m - (ends[leg] - lengths[leg])) * course
            heading = ahead_mps * course - drift_mps * across
            rows.append((*place, *heading, *(ground_mps * course)))
        along_m += ground_mps * interval_s / steps
        number += 1
        if number > MAX_STEPS:
            raise _too_long()
    made = np.array(rows)
    headings = np.asarray(np.degrees(np.arctan2(made[:, 2], made[:, 3])) % 360, dtype=np.float64)
    times = np.arange(len(made), dtype=np.float64) * interval_s
    return FlownPath(made[:, :2], headings, times, made[0, 4:])


def _too_long() -> FlightError:
    return FlightError(
        f"flight in wind takes more than {MAX_STEPS:,} time steps; shorten the route or raise the "
        "airspeed"
    )


def _moving_air(wind: Wind, step_s: float, rng: np.random.Generator) -> Iterator[Array]:
    std, most = GUST_STD * wind.speed_mps, LARGEST_GUST * wind.speed_mps
    for gust in _wandering(step_s / GUST_TIME_S, rng):
        added = gust * std
        yield wind.velocity_en_mps + added * min(1.0, most / max(float(np.hypot(*added)), 1e-9))


def _wandering(step: float, rng: np.random.Generator) -> Iterator[Array]:
    """A stationary Ornstein-Uhlenbeck process (2,) of standard deviation 1, sampled every `step`
    time constants (Gillespie 1996, doi:10.1103/PhysRevE.54.2084)."""
    decay = math.exp(-step)
    value = rng.normal(0, 1, 2)
    while True:
        yield value
        value = decay * value + math.sqrt(1 - decay**2) * rng.normal(0, 1, 2)


def gauss_markov(step: float, count: int, rng: np.random.Generator) -> Array:
    return np.array([value for value, _ in zip(_wandering(step, rng), range(count), strict=False)])


def drifting(velocities: Array, times_s: Array, drift: float, rng: np.random.Generator) -> Array:
    """Velocities (N, 2) as reported by odometry whose scale (a share) and direction (rad) err with
    the standard deviation `drift`."""
    step_s = float(times_s[1] - times_s[0]) if len(times_s) > 1 else 1.0
    off = drift * gauss_markov(step_s / DRIFT_TIME_S, len(times_s), rng)
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
    if not 1e-6 < abs(turn) < math.radians(SHARPEST_DEG):
        return corner[None]
    tangent_m = min(radius_m * math.tan(abs(turn) / 2), float(lengths.min()) / 2)
    radius_m = tangent_m / math.tan(abs(turn) / 2)
    left = np.array([-into[1], into[0]]) * math.copysign(1.0, turn)
    angles = np.linspace(0, abs(turn), 2 + int(math.degrees(abs(turn)) / ARC_STEP_DEG))[:, None]
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
    step_s = float(times_s[1] - times_s[0]) if len(times_s) > 1 else 1.0
    return std_deg * gauss_markov(step_s / HORIZON_TIME_S, len(times_s), rng)


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
