"""A generated flight with turns and turbulence, and what its camera sees of the ground of blots.

Nothing here is shared with the program.
"""

import numpy as np
from benchmarks.fakes import SAMPLE_S, wandering
from blots import GROUND, rendered
from scipy.spatial.transform import Rotation

from orthonav.core.geo.camera import Camera

CAMERA = Camera(320, 240, 250.0, 250.0, 160.0, 120.0)
SMALL = Camera(160, 120, 125.0, 125.0, 80.0, 60.0)
G = 9.81


class Flown:
    """Attitude, velocity and place of an aircraft over time; angles in degrees."""

    def __init__(
        self,
        seconds,
        *,
        turns=True,
        turns_until_s=np.inf,
        then_deg_s=0.0,
        turbulence_deg=1.0,
        speed=15.0,
        agl_m=120.0,
        seed=0,
    ):
        rng = np.random.default_rng(seed)
        count = int(seconds / SAMPLE_S) + 1
        self.times = np.arange(count) * SAMPLE_S
        self.speed, self.agl_m = speed, agl_m
        rate = np.zeros(count)  # rad/s
        if turns:
            at = rng.uniform(2.0, 6.0)
            while at < seconds:
                long = rng.uniform(4.0, 9.0)
                inside = (self.times > at) & (self.times < at + long)
                rate[inside] = rng.choice([-1, 1]) * np.radians(rng.uniform(8.0, 16.0))
                at += long + rng.uniform(5.0, 12.0)
        rate[self.times > turns_until_s] = np.radians(then_deg_s)
        kernel = np.hanning(76)
        rate = np.convolve(rate, kernel / kernel.sum(), mode="same")
        bank = np.degrees(np.arctan(speed * rate / G))
        t = turbulence_deg
        self.roll = bank + wandering(rng, count, t, 0.25)
        self.pitch = 2.0 + wandering(rng, count, t, 0.3)
        course = rng.uniform(0, 2 * np.pi) + np.cumsum(rate) * SAMPLE_S
        self.yaw = np.unwrap(course) * 180 / np.pi + wandering(rng, count, 0.5 * t, 0.5)
        fast = speed * (1 + 0.03 * wandering(rng, count, 0.3 * t, 2.0))
        self.velocity = np.stack([fast * np.cos(course), fast * np.sin(course)], axis=1)  # N, E
        self.place = np.cumsum(self.velocity, axis=0) * SAMPLE_S

    def at(self, time_s):
        """Yaw, pitch, roll (deg), velocity north and east, place north and east."""
        angles = [np.interp(time_s, self.times, each) for each in (self.yaw, self.pitch, self.roll)]
        pairs = [
            np.array([np.interp(time_s, self.times, each[:, i]) for i in (0, 1)])
            for each in (self.velocity, self.place)
        ]
        return angles, *pairs

    def picture(self, time_s, camera=CAMERA):
        """What the camera sees then."""
        angles, _, (north, east) = self.at(time_s)
        return rendered(GROUND, (east, north), angles, self.agl_m, camera)

    def ned_from_body(self, time_s, yaw_off_deg=0.0):
        yaw, pitch, roll = self.at(time_s)[0]
        angles = yaw + yaw_off_deg, pitch, roll
        return Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
