"""Inexpensive instruments of an autopilot, with their errors."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.closed_loop.physics import STEP_S, Increments, Motion, Wind, euler_rad

Array = NDArray[np.float64]


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
CALM = Grade(gyro_noise=1e-4, accel_noise=0.005, gyro_bias=math.radians(0.01), accel_bias=0.015)
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

    def imu(self, felt: Increments) -> Increments:
        """Increments as measured."""
        grade, kept = self.grade, math.exp(-STEP_S / self.grade.bias_s)
        fresh = math.sqrt(1 - kept**2)
        self.gyro_bias = kept * self.gyro_bias + fresh * grade.gyro_bias * self._rng.normal(size=3)
        self._accel = kept * self._accel + fresh * grade.accel_bias * self._rng.normal(size=3)
        noise = math.sqrt(STEP_S) * self._rng.normal(size=(2, 3))
        turn = felt.turn + self.gyro_bias * STEP_S + grade.gyro_noise * noise[0]
        push = felt.push + self._accel * STEP_S + grade.accel_noise * noise[1]
        return Increments(turn, push)

    def height_m(self, motion: Motion, since_s: float) -> float:
        """Height by the barometer, `since_s` after the last one."""
        self._baro += self.grade.baro_walk * math.sqrt(since_s) * float(self._rng.normal())
        return float(-motion.position[2] + self._baro + self.grade.baro_m * self._rng.normal())

    def heading_rad(self, motion: Motion) -> float:
        """Heading by the compass."""
        yaw, _, _ = euler_rad(motion.rotation)
        constant, sine, cosine = self._heading.tolist()
        off = constant + sine * math.sin(yaw) + cosine * math.cos(yaw)
        return float(yaw + off + self.grade.heading_noise * self._rng.normal())

    def airspeed_mps(self, motion: Motion, wind: Wind) -> float:
        """True airspeed."""
        speed = float(np.linalg.norm(motion.velocity - wind.now_ned))
        return float(self._scale * speed + self.grade.airspeed_mps * self._rng.normal())

    def gnss(self, motion: Motion) -> tuple[Array, Array]:
        """Position (2,) north and east, and velocity (3,)."""
        half = self.grade.gnss_m / math.sqrt(2)
        self._place = 0.99 * self._place + math.sqrt(1 - 0.99**2) * half * self._rng.normal(size=2)
        place = motion.position[:2] + self._place + half * self._rng.normal(size=2)
        return place, motion.velocity + self.grade.gnss_mps * self._rng.normal(size=3)
