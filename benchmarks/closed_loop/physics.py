"""A plane and a quadrotor as points with an attitude, in wind, and their inexpensive instruments.

A vehicle steers by estimates (`steer`) and moves by `STEP_S` (`step`).

Axes: north, east, down; the body forward, right, down. The motion is smooth, and the IMU is derived
from it: an integration of its increments gives the motion back.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

STEP_S = 0.02
G_MPS2 = 9.81
GRAVITY = np.array([0.0, 0.0, G_MPS2])
Array = NDArray[np.float64]


def cross(vector: Array) -> Array:
    """The matrix (3, 3) of the cross product with a vector (3,) from the left."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def turned(vector: Array) -> Array:
    """The rotation (3, 3) by a rotation vector (3,), rad (Rodrigues)."""
    x, y, z = vector.tolist()
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    sine, rest = math.sin(angle) / angle if angle else 1.0, 0.5
    if angle > 1e-6:
        rest = (1 - math.cos(angle)) / square
    by_x, by_y, by_z = rest * x, rest * y, rest * z
    return np.array(
        [
            [1 - by_y * y - by_z * z, by_x * y - sine * z, by_x * z + sine * y],
            [by_x * y + sine * z, 1 - by_x * x - by_z * z, by_y * z - sine * x],
            [by_x * z - sine * y, by_y * z + sine * x, 1 - by_x * x - by_y * y],
        ]
    )


def turn_of(rotation: Array) -> Array:
    """The rotation vector (3,) of a small rotation (3, 3)."""
    axis = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    sine = math.sqrt(float(axis @ axis)) / 2
    angle = math.atan2(sine, (float(np.trace(rotation)) - 1) / 2)
    return axis / 2 if sine < 1e-9 else axis * (angle / (2 * sine))


def about(axis: int, angle_rad: float) -> Array:
    """The rotation (3, 3) about a coordinate axis."""
    vector = np.zeros(3)
    vector[axis] = angle_rad
    return turned(vector)


def euler_rad(rotation: Array) -> tuple[float, float, float]:
    """Yaw, pitch and roll of a rotation (3, 3) from body to north-east-down."""
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    pitch = -math.asin(max(-1.0, min(1.0, float(rotation[2, 0]))))
    return yaw, pitch, math.atan2(rotation[2, 1], rotation[2, 2])


@dataclass(frozen=True, eq=False)
class Motion:
    """Position, velocity (3,) and attitude (3, 3, from the body), true or estimated."""

    position: Array
    velocity: Array
    rotation: Array


@dataclass(frozen=True, eq=False)
class Increments:
    """What an IMU feels in a step: rotation vector (3,), rad, and velocity (3,) in the body axes
    of the middle of the step, m/s."""

    turn: Array
    push: Array


def increments(before: Motion, after: Motion) -> Increments:
    """Those of an ideal IMU between two motions a step apart."""
    turn = turn_of(before.rotation.T @ after.rotation)
    middle = before.rotation @ turned(turn / 2)
    return Increments(turn, middle.T @ (after.velocity - before.velocity - GRAVITY * STEP_S))


def integrated(motion: Motion, imu: Increments) -> Motion:
    """The motion a step later, by increments: the inverse of `increments`."""
    push = motion.rotation @ turned(imu.turn / 2) @ imu.push
    velocity = motion.velocity + push + GRAVITY * STEP_S
    position = motion.position + (motion.velocity + velocity) / 2 * STEP_S
    return Motion(position, velocity, motion.rotation @ turned(imu.turn))


class Wander:
    """Smooth noise of some axes: two lags in a row over white noise."""

    def __init__(self, rng: np.random.Generator, std: Array, time_s: float) -> None:
        self._rng, self._std = rng, std
        self._kept = math.exp(-STEP_S / time_s)
        self._lag = STEP_S / (0.3 * time_s)
        # The second lag takes 1 - 1 / (1 + 0.3) of the variance of the first.
        self._first, self._growth = rng.normal(size=len(std)), math.sqrt(1.3)
        self._second = self._first.copy()

    def next(self) -> Array:
        """The value (N,) a step later."""
        fresh = self._rng.normal(size=len(self._std))
        self._first = self._kept * self._first + math.sqrt(1 - self._kept**2) * fresh
        self._second = self._second + self._lag * (self._first - self._second)
        return self._growth * self._std * self._second


@dataclass
class Wind:
    """A steady wind with gusts, after Dryden's spectrum of first order."""

    rng: np.random.Generator
    mean_ned: Array
    gust_std: Array = field(default_factory=lambda: np.array([0.7, 0.7, 0.4]))
    gust_s: float = 8.0

    def __post_init__(self) -> None:
        self._gusts = Wander(self.rng, self.gust_std, self.gust_s)
        self.now_ned = self.mean_ned.copy()

    def next(self) -> Array:
        """The wind (3,) a step later, m/s."""
        self.now_ned = self.mean_ned + self._gusts.next()
        return self.now_ned


def _clip(value: float, most: float) -> float:
    return max(-most, min(most, value))


class Plane:
    """Bank to turn, at a constant airspeed; the wind takes it along with a lag."""

    AIRSPEED_MPS, MOST_ROLL, MOST_CLIMB_MPS = 16.0, math.radians(35.0), 2.0
    ALPHA, LAG_S = math.radians(3.0), 1.5
    SHAKE = np.radians([1.5, 1.0, 1.0])
    """Turbulence of roll, pitch and sideslip."""
    has_airspeed = True

    def __init__(self, rng: np.random.Generator, place_ned: Array, yaw: float) -> None:
        self._yaw, self._roll, self._climb = yaw, 0.0, 0.0
        self._rate, self._wanted_rate, self._wanted_climb = 0.0, 0.0, 0.0
        self._shake = Wander(rng, self.SHAKE, 0.8)
        self._drift: Array | None = None
        self.motion = Motion(place_ned, np.zeros(3), np.eye(3))

    def steer(self, estimate: Motion, carrot_ne: Array | None, height_m: float) -> None:
        """Turn towards a point as L1 guidance does (Park, Deyst and How 2004)."""
        assert carrot_ne is not None
        to, speed = carrot_ne - estimate.position[:2], estimate.velocity[:2]
        across = float(speed[0] * to[1] - speed[1] * to[0])
        lateral = 2 * across * float(np.hypot(*speed)) / max(float(to @ to), 1.0)
        if float(to @ speed) < 0:
            lateral = math.copysign(8.0, across)
        wanted = _clip(math.atan(lateral / G_MPS2), self.MOST_ROLL)
        _, _, roll = euler_rad(estimate.rotation)
        self._wanted_rate = _clip((wanted - roll) / 0.5, math.radians(60.0))
        off_m = height_m + float(estimate.position[2])
        self._wanted_climb = _clip(0.3 * off_m, self.MOST_CLIMB_MPS)

    def step(self, wind_ned: Array) -> None:
        if self._drift is None:
            self._drift = wind_ned.copy()
        self._drift += (wind_ned - self._drift) * (STEP_S / self.LAG_S)
        self._rate += (self._wanted_rate - self._rate) * (STEP_S / 0.15)
        self._climb += (self._wanted_climb / self.AIRSPEED_MPS - self._climb) * STEP_S
        self._roll += self._rate * STEP_S
        shake_roll, shake_pitch, sideslip = self._shake.next().tolist()
        roll = self._roll + shake_roll
        self._yaw += G_MPS2 * math.tan(roll) / self.AIRSPEED_MPS * STEP_S
        path = about(2, self._yaw) @ about(1, self._climb)
        velocity = path[:, 0] * self.AIRSPEED_MPS + self._drift
        if not self.motion.velocity.any():
            self.motion = Motion(self.motion.position, velocity, path)
        tilted = about(0, roll) @ about(1, self.ALPHA / math.cos(roll) + shake_pitch)
        moved = (self.motion.velocity + velocity) / 2 * STEP_S
        self.motion = Motion(
            self.motion.position + moved, velocity, path @ tilted @ about(2, sideslip)
        )


class Quad:
    """Tilts to accelerate; its air resistance is linear."""

    SPEED_MPS, MOST_TILT, DRAG_PER_S = 10.0, math.radians(25.0), 0.15
    SHAKE = np.radians([1.0, 1.0, 0.5])
    """Turbulence of roll, pitch and yaw."""
    has_airspeed = False

    def __init__(self, rng: np.random.Generator, place_ned: Array, yaw: float) -> None:
        self._angles = np.array([0.0, 0.0, yaw])  # roll, pitch, yaw
        self._rates, self._wanted_rates = np.zeros(3), np.zeros(3)
        self._thrust, self._pull = G_MPS2, np.zeros(2)
        self._shake = Wander(rng, self.SHAKE, 0.6)
        self.motion = Motion(place_ned, np.zeros(3), about(2, yaw))

    def steer(self, estimate: Motion, carrot_ne: Array | None, height_m: float) -> None:
        """Fly towards a point with the nose ahead: velocity, then tilt, each by the estimate.

        Without a point it stays level.
        """
        level = carrot_ne is None
        to = np.ones(2) if carrot_ne is None else carrot_ne - estimate.position[:2]
        wanted = to / max(float(np.hypot(*to)), 1.0) * self.SPEED_MPS
        off = wanted - estimate.velocity[:2]
        if not level:
            self._pull = np.clip(self._pull + 0.02 * off, -2.0, 2.0)
        push = np.clip(0.8 * off, -3.0, 3.0) + self._pull
        yaw, pitch, roll = euler_rad(estimate.rotation)
        ahead = float(push @ [math.cos(yaw), math.sin(yaw)])
        right = float(push @ [-math.sin(yaw), math.cos(yaw)])
        most = 0.0 if level else self.MOST_TILT
        to_pitch, to_roll = _clip(-ahead / G_MPS2, most), _clip(right / G_MPS2, most)
        to_yaw = 0.0 if level else math.remainder(math.atan2(to[1], to[0]) - yaw, math.tau)
        self._wanted_rates = np.array(
            [(to_roll - roll) / 0.25, (to_pitch - pitch) / 0.25, _clip(to_yaw, 0.5)]
        )
        climb = _clip(0.5 * (height_m + float(estimate.position[2])), 2.0)
        lift = G_MPS2 + 1.5 * (climb + float(estimate.velocity[2]))
        self._thrust = _clip(lift / max(math.cos(pitch) * math.cos(roll), 0.7), 2 * G_MPS2)

    def step(self, wind_ned: Array) -> None:
        self._rates += (self._wanted_rates - self._rates) * (STEP_S / 0.08)
        self._angles += self._rates * STEP_S
        roll, pitch, yaw = (self._angles + self._shake.next()).tolist()
        rotation = about(2, yaw) @ about(1, pitch) @ about(0, roll)
        before = self.motion
        drag = self.DRAG_PER_S * (wind_ned - before.velocity)
        velocity = before.velocity + (GRAVITY - self._thrust * rotation[:, 2] + drag) * STEP_S
        moved = (before.velocity + velocity) / 2 * STEP_S
        self.motion = Motion(before.position + moved, velocity, rotation)


Vehicle = Plane | Quad
VEHICLES: dict[str, type[Plane] | type[Quad]] = {"plane": Plane, "quad": Quad}


@dataclass(frozen=True)
class Grade:
    """Errors of the instruments; standard deviations.

    `gyro_noise`, `accel_noise`: densities, rad/s and m/s2 per root of a hertz, vibration included.
    `gyro_bias`, `accel_bias`: of the biases, rad/s and m/s2; they wander with `bias_s`, s, by
    temperature and vibration. `baro_m`, `baro_walk`: noise, and drift per root of a second.
    `heading_bias`, `heading_noise`: of the magnetic heading, rad; it also varies with the heading
    by the bias. `airspeed_scale`, `airspeed_mps`: scale error and noise. `gnss_m`, `gnss_mps`:
    noise of position (half of it slow) and velocity.
    """

    gyro_noise: float = 5e-4
    accel_noise: float = 0.02
    gyro_bias: float = math.radians(0.1)
    accel_bias: float = 0.12
    bias_s: float = 90.0
    baro_m: float = 0.3
    baro_walk: float = 0.05
    heading_bias: float = math.radians(2.0)
    heading_noise: float = math.radians(1.0)
    airspeed_scale: float = 0.01
    airspeed_mps: float = 0.5
    gnss_m: float = 0.8
    gnss_mps: float = 0.1


CONSUMER = Grade()
"""Uncalibrated consumer MEMS in an aircraft that vibrates."""
CALIBRATED = Grade(
    gyro_noise=1e-4, accel_noise=0.005, gyro_bias=math.radians(0.01), accel_bias=0.015
)
"""Calibrated for temperature and well damped, as those of ArduPilot's simulator."""


class Instruments:
    """The instruments of one flight. Mutable."""

    def __init__(self, rng: np.random.Generator, grade: Grade) -> None:
        self._rng, self.grade = rng, grade
        self.gyro_bias = grade.gyro_bias * rng.normal(size=3)
        self._accel = grade.accel_bias * rng.normal(size=3)
        self._baro = 0.0
        self._heading = grade.heading_bias * rng.normal(size=3)
        self._scale = 1 + grade.airspeed_scale * float(rng.normal())
        self._place = np.zeros(2)

    def imu(self, ideal: Increments) -> Increments:
        grade, kept = self.grade, math.exp(-STEP_S / self.grade.bias_s)
        fresh = math.sqrt(1 - kept**2)
        self.gyro_bias = kept * self.gyro_bias + fresh * grade.gyro_bias * self._rng.normal(size=3)
        self._accel = kept * self._accel + fresh * grade.accel_bias * self._rng.normal(size=3)
        noise = math.sqrt(STEP_S) * self._rng.normal(size=(2, 3))
        turn = ideal.turn + self.gyro_bias * STEP_S + grade.gyro_noise * noise[0]
        push = ideal.push + self._accel * STEP_S + grade.accel_noise * noise[1]
        return Increments(turn, push)

    def height_m(self, motion: Motion, since_s: float) -> float:
        """Height by the barometer, `since_s` after the last one."""
        self._baro += self.grade.baro_walk * math.sqrt(since_s) * float(self._rng.normal())
        return float(-motion.position[2] + self._baro + self.grade.baro_m * self._rng.normal())

    def heading_rad(self, motion: Motion) -> float:
        yaw, _, _ = euler_rad(motion.rotation)
        constant, sine, cosine = self._heading.tolist()
        off = constant + sine * math.sin(yaw) + cosine * math.cos(yaw)
        return float(yaw + off + self.grade.heading_noise * self._rng.normal())

    def airspeed_mps(self, motion: Motion, wind: Wind) -> float:
        speed = float(np.linalg.norm(motion.velocity - wind.now_ned))
        return float(self._scale * speed + self.grade.airspeed_mps * self._rng.normal())

    def gnss(self, motion: Motion) -> tuple[Array, Array]:
        """Position (2,) north and east, and velocity (3,)."""
        half = self.grade.gnss_m / math.sqrt(2)
        self._place = 0.99 * self._place + math.sqrt(1 - 0.99**2) * half * self._rng.normal(size=2)
        place = motion.position[:2] + self._place + half * self._rng.normal(size=2)
        return place, motion.velocity + self.grade.gnss_mps * self._rng.normal(size=3)
