"""An inertial Kalman filter of errors, as those of autopilots: 15 states, and the wind.

It runs behind real time by the delay of its slowest measurement, and is brought forward by the IMU
since, as PX4's EKF2 is. Errors (17,): attitude (rad, about north, east, down), velocity, position,
biases of gyroscope and accelerometer, wind north and east.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.closed_loop.physics import (
    GRAVITY,
    STEP_S,
    Increments,
    Motion,
    cross,
    euler_rad,
    integrated,
    turned,
)

TILT, VEL, POS = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO, ACCEL, WIND = slice(9, 12), slice(12, 15), slice(15, 17)
STATES = 17
DELAY_STEPS = 10
"""0.2 s behind: EKF2_DELAY_MAX."""
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Tuning:
    """Noises that a filter assumes, named as its parameters; those of PX4 by default.

    Noises of the IMU are per sample at `rate_hz`. `gravity`: noise of the direction of gravity by
    the accelerometer at 10 Hz, None where it is not fused. `reset_s`: time without an accepted
    position after which the next one is taken over. `gate`: in standard deviations.
    """

    rate_hz: float = 100.0
    gyro: float = 0.015
    accel: float = 0.35
    gyro_bias: float = 1e-3
    accel_bias: float = 3e-3
    accel_bias_limit: float = 0.4
    wind: float = 0.05
    baro_m: float = 3.5
    heading: float = 0.3
    airspeed_mps: float = 1.4
    sideslip: float = 0.3
    gnss_m: float = 0.5
    gnss_mps: float = 0.3
    least_m: float = 0.9
    least_mps: float = 0.3
    gravity: float | None = 0.316
    reset_s: float = 5.0
    gate: float = 3.0


PX4 = Tuning()
"""Defaults of EKF2_ACC_NOISE, EKF2_GYR_NOISE, EKF2_ACC_B_NOISE and so on, of version 1.16."""
ARDUPILOT = Tuning(
    rate_hz=83.0, accel_bias=0.02, accel_bias_limit=1.0, wind=0.1, baro_m=3.0, heading=0.05,
    gnss_mps=0.5, gravity=None, reset_s=7.0, gate=5.0,
)  # fmt: skip
"""The same filter with the defaults of ArduPlane's EK3_ACC_P_NSE, EK3_ABIAS_P_NSE and so on."""


class Filter:
    """One filter. Mutable. `motion` and `covariance` are those of `DELAY_STEPS` ago."""

    def __init__(self, tuning: Tuning, motion: Motion, stds: Array) -> None:
        """`stds` (17,): standard deviations of the errors of the first `motion`."""
        self.tuning, self.motion = tuning, motion
        self.covariance = np.diag(np.square(stds))
        self.gyro_bias, self.accel_bias, self.wind = np.zeros(3), np.zeros(3), np.zeros(2)
        self._steps, self._fused_step = 0, 0
        self._last_imu = Increments(np.zeros(3), np.zeros(3))
        self._imu: deque[Increments] = deque()
        self._waiting: deque[tuple[int, Callable[[], None]]] = deque()

    @property
    def _now(self) -> int:
        return self._steps + len(self._imu)

    @property
    def is_alone(self) -> bool:
        """Whether no position was accepted for a while."""
        return (self._steps - self._fused_step) * STEP_S > self.tuning.reset_s

    def add_imu(self, measured: Increments) -> None:
        """Take the increments of one step, and move on by one once there are enough."""
        self._imu.append(measured)
        if len(self._imu) <= DELAY_STEPS:
            return
        self._predict(self._imu.popleft())
        while self._waiting and self._waiting[0][0] <= self._steps:
            self._waiting.popleft()[1]()

    def measure(self, fuse: Callable[[], None]) -> None:
        """Fuse a measurement of now once the filter gets there. It is one of the methods below."""
        self._waiting.append((self._now, fuse))

    def output(self) -> Motion:
        motion = self.motion
        for measured in self._imu:
            motion = integrated(motion, self._unbiased(measured))
        return motion

    def _unbiased(self, measured: Increments) -> Increments:
        return Increments(
            measured.turn - self.gyro_bias * STEP_S, measured.push - self.accel_bias * STEP_S
        )

    def _predict(self, measured: Increments) -> None:
        imu, before, tuning = self._unbiased(measured), self.motion, self.tuning
        self._last_imu = imu
        self.motion = integrated(before, imu)
        rotation = before.rotation
        push = self.motion.velocity - before.velocity - GRAVITY * STEP_S
        step = np.eye(STATES)
        step[TILT, GYRO] = -rotation * STEP_S
        step[VEL, TILT] = -cross(push)
        step[VEL, ACCEL] = -rotation * STEP_S
        step[POS, VEL] = np.eye(3) * STEP_S
        covariance = step @ self.covariance @ step.T
        share = STEP_S / tuning.rate_hz
        noise = np.zeros(STATES)
        noise[TILT], noise[VEL] = tuning.gyro**2 * share, tuning.accel**2 * share
        noise[GYRO], noise[ACCEL] = tuning.gyro_bias**2 * share, tuning.accel_bias**2 * share
        noise[WIND] = tuning.wind**2 * STEP_S
        covariance[np.diag_indices(STATES)] += noise
        self.covariance = (covariance + covariance.T) / 2
        self._steps += 1

    def _fuse(self, off: float, row: Array, noise: float) -> None:
        """Update with an innovation, its derivatives (17,) and its variance."""
        by_row = self.covariance @ row
        gain = by_row / (float(row @ by_row) + noise)
        self.covariance = self.covariance - np.outer(gain, by_row)
        self._correct(gain * off)

    def _correct(self, error: Array) -> None:
        """Add an error (17,) to the estimate."""
        was, most = self.motion, self.tuning.accel_bias_limit
        self.motion = Motion(
            was.position + error[POS], was.velocity + error[VEL], turned(error[TILT]) @ was.rotation
        )
        self.gyro_bias = self.gyro_bias + error[GYRO]
        self.accel_bias = np.clip(self.accel_bias + error[ACCEL], -most, most)
        self.wind = self.wind + error[WIND]

    def fuse_velocity(self, velocity: Array, std_mps: float) -> None:
        """Fuse a velocity north, east and perhaps down (2 or 3,)."""
        for axis, value in enumerate(velocity.tolist()):
            off, row = value - float(self.motion.velocity[axis]), np.zeros(STATES)
            row[3 + axis] = 1.0
            if off**2 < self.tuning.gate**2 * (self.covariance[3 + axis, 3 + axis] + std_mps**2):
                self._fuse(off, row, std_mps**2)

    def fuse_position(self, place_ne: Array, std_m: float) -> None:
        """Fuse a position (2,); an outlier is rejected, or taken over after `reset_s`."""
        off = place_ne - self.motion.position[:2]
        spread = np.diag(self.covariance)[6:8] + std_m**2
        if (off**2 > self.tuning.gate**2 * spread).any():
            if self.is_alone:
                self._reset(place_ne, std_m)
            return
        self._fused_step = self._steps
        for axis in (0, 1):
            row = np.zeros(STATES)
            row[6 + axis] = 1.0
            self._fuse(float(place_ne[axis] - self.motion.position[axis]), row, std_m**2)

    def _reset(self, place_ne: Array, std_m: float) -> None:
        self.covariance[6:8] = self.covariance[:, 6:8] = 0.0
        self.covariance[[6, 7], [6, 7]] = std_m**2
        was = self.motion
        self.motion = Motion(np.array([*place_ne, was.position[2]]), was.velocity, was.rotation)
        self._fused_step = self._steps

    def fuse_height(self, height_m: float) -> None:
        """Fuse a height of the barometer."""
        row = np.zeros(STATES)
        row[8] = 1.0
        self._fuse(-height_m - float(self.motion.position[2]), row, self.tuning.baro_m**2)

    def fuse_heading(self, heading_rad: float) -> None:
        """Fuse a heading of the compass."""
        yaw, _, _ = euler_rad(self.motion.rotation)
        row = np.zeros(STATES)
        row[2] = 1.0
        self._fuse(math.remainder(heading_rad - yaw, math.tau), row, self.tuning.heading**2)

    def fuse_air(self, airspeed_mps: float) -> None:
        """Fuse a true airspeed, and that there is no sideslip."""
        through = self.motion.velocity - np.array([*self.wind, 0.0])
        speed = float(np.linalg.norm(through))
        if speed < 3.0:
            return
        row = np.zeros(STATES)
        row[VEL] = through / speed
        row[WIND] = -row[3:5]
        self._fuse(airspeed_mps - speed, row, self.tuning.airspeed_mps**2)
        through = self.motion.velocity - np.array([*self.wind, 0.0])
        right = self.motion.rotation[:, 1]
        row = np.zeros(STATES)
        row[TILT], row[VEL], row[WIND] = np.cross(right, through), right, -right[:2]
        self._fuse(-float(right @ through), row, (self.tuning.sideslip * speed) ** 2)

    def fuse_gravity(self) -> None:
        """Fuse that the accelerometer points up, where it feels about that much."""
        if self.tuning.gravity is None:
            return
        push = self._last_imu.push / STEP_S
        strength = float(np.linalg.norm(push))
        if not 0.9 * GRAVITY[2] < strength < 1.1 * GRAVITY[2]:
            return
        for axis, by, sign in ((0, 1, -1.0), (1, 0, 1.0)):
            row = np.zeros(STATES)
            row[by] = sign
            up = self.motion.rotation @ push / strength
            self._fuse(-float(up[axis]), row, self.tuning.gravity**2)


FILTERS = {"px4": PX4, "ardupilot": ARDUPILOT}
