"""Flights of the latency monitor alone: the motion of the pictures is computed, not rendered.

They take a tenth of the time of flights with pictures.
"""

import math

import numpy as np
from benchmarks.fakes import S
from flown import Flown
from scipy.spatial.transform import Rotation

from orthonav.core.geo.attitude import LOOKS_DOWN, enu_from_body_camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.onboard import latency as latencies
from orthonav.onboard.motion import ImageMotion, reported_motion
from orthonav.onboard.telemetry import VehicleState

BEGIN_S = 13.0
FRAME = LocalFrame(0.0, 0.0)
FARTHEST = 0.35  # shift beyond which pictures are not compared
FAR_M = 8.0


class ComputedOdometry:
    """Takes the place of `PictureOdometry`: the true motion with noise."""

    def __init__(self, flight):
        self.flight, self.before = flight, None

    def motion(self, grey, camera, arrived_ns):
        flight, start = self.flight, self.before
        self.before = arrived_ns, flight.exposed_s
        if start is None or not 0 < flight.exposed_s - start[1] < 1.0:
            return None
        seconds = flight.exposed_s - start[1]
        (begin, from_m), (end, to_m) = flight.truth(start[1]), flight.truth(flight.exposed_s)
        velocity, height = np.append((to_m - from_m) / seconds, 0.0), flight.flown.agl_m
        moved = reported_motion(begin[None], end[None], velocity[None], np.array([height]), seconds)
        turn, tilt, by_velocity = (each[0] for each in moved)
        turn = turn + flight.rng.normal(0, 5e-4)
        shift = tilt + by_velocity + flight.rng.normal(0, 1.5e-3, 2)
        if np.hypot(*shift) > FARTHEST:
            return None
        wrong = flight.wrong(flight.exposed_s)
        if flight.mirrored:
            turn, shift = -turn, shift * [-1, 1]
        return ImageMotion(start[0], arrived_ns, float(turn) + wrong / 2, shift + wrong)


class ComputedFlight:
    """A flight whose positions are right about where an image was exposed, but not when."""

    def __init__(self, flown, stated_s, delay_s, *, rate_hz=5.0, seed=0):
        """`delay_s(at_s)`: true latency, by seconds since the start."""
        self.flown, self.delay_s, self.rate_hz = flown, delay_s, rate_hz
        self.rng = np.random.default_rng(seed)
        self.monitor, self.odometry = latencies.LatencyMonitor(stated_s), ComputedOdometry(self)
        self.interruptions, self.states = 0, {}
        self.wrong = lambda exposed_s: 0.0  # added to the motion that is seen
        self.mirrored, self.velocity_off = False, 0.0
        self.images = []  # seconds since the start, reason or None, error of the position

    def truth(self, at_s):
        angles, _, (north, east) = self.flown.at(at_s)
        turn = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
        return enu_from_body_camera(turn, LOOKS_DOWN), np.array([east, north])

    def state_at(self, time_ns):
        """Telemetry: constant errors, and 0.1 deg of jitter."""
        if time_ns not in self.states:
            angles, (north, east), _ = self.flown.at(time_ns / S)
            angles = np.add(angles, (3.0, 0.3, 0.2)) + self.rng.normal(0, 0.1, 3)
            turn = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
            off = self.rng.normal(0, 0.1, 2)
            off += self.velocity_off
            velocity = north + 0.3 + off[0], east - 0.2 + off[1], 0.0
            self.states[time_ns] = VehicleState(
                turn, velocity_ned_mps=velocity, height_m=1.05 * self.flown.agl_m
            )
        return self.states[time_ns]

    def velocity(self, start_ns, end_ns):
        """Reported, mean between two times; None beyond the telemetry."""
        if end_ns > self.covered_ns:
            return None
        moved = self.truth(end_ns / S)[1] - self.truth(start_ns / S)[1]
        east, north = moved / ((end_ns - start_ns) / S) + self.velocity_off + (-0.2, 0.3)
        return east, north

    def fly(self, until_s, arrives=lambda at_s: True):
        """Fly on; the images of this time."""
        before = len(self.images)
        begin = round((self.images[-1][0] if self.images else 0.0) * self.rate_hz)
        for number in range(begin + 1, round(until_s * self.rate_hz) + 1):
            at_s = number / self.rate_hz
            if arrives(at_s):
                self.images.append((at_s, *self._image(at_s)))
        return self.images[before:]

    def sends_all(self, until_s):
        """Fly on; whether every image of this time had a position."""
        return all(reason is None for _, reason, _ in self.fly(until_s))

    def _image(self, at_s):
        arrived_ns = round((BEGIN_S + at_s + abs(self.rng.normal(0, 0.01))) * S)
        self.exposed_s = BEGIN_S + at_s - self.delay_s(at_s)
        self.covered_ns = round((BEGIN_S + at_s - 0.02) * S)
        self.monitor.arrived(arrived_ns, self.interruptions)
        error_m = math.nan
        if self.monitor.may_locate:
            place = self.truth(self.exposed_s)[1]
            exposed_ns = arrived_ns - round(self.monitor.delay_s * S)
            error_m = float(np.hypot(*(place - self.truth(exposed_ns / S)[1])))
            lat, lon = FRAME.latlon_from_en(place + self.rng.normal(0, 1.5, 2))
            self.monitor.located(exposed_ns, (float(lat), float(lon)), 3.5, self.velocity)
        reason = next(iter(self.monitor.reasons()), None)
        if self.monitor._check.odometry is not self.odometry:  # the monitor begins again
            self.odometry = self.monitor._check.odometry = ComputedOdometry(self)
        self.monitor.observe(arrived_ns, None, None, self.state_at, self.covered_ns)
        return reason, error_m


def sent(images):
    """The images with a position, as (seconds since the start, error)."""
    return [(at_s, error_m) for at_s, reason, error_m in images if reason is None]


def straight(seconds, seed=0):
    """A straight flight in calm air."""
    return Flown(seconds, turns=False, turbulence_deg=0.05, seed=seed)
